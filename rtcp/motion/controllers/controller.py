"""What every motion controller is: the base class, what it is made from, and how controllers are found.

A controller turns commands into setpoints, one `update` a cycle while it moves the arm. A new one is a subclass of
`Controller` and an entry point of the group `rtcp.controllers`, here or in a package outside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import isfinite
from typing import ClassVar, Final

from mypy_extensions import mypyc_attr

from rtcp.config.find import load_class, registered
from rtcp.config.model import ArmConfig, ConfigError
from rtcp.ipc.commands import Command
from rtcp.ipc.events import ControllerFailed, MotionEnded
from rtcp.ipc.layout import PLANS
from rtcp.ipc.refusals import HoldTimeOutOfRange, NotFinite, PositionOutOfRange, Refusal, WrongCount, WrongRowCount
from rtcp.ipc.states import ControlMode
from rtcp.motion.guards.trajectory_guard import TrajectoryGuard
from rtcp.motion.joint_motion import JointMotion
from rtcp.motion.limits import Limits
from rtcp.motion.speed_override import SpeedOverride
from rtcp.motion.state import ArmState, Phase, Setpoint
from rtcp.motion.step_group import StepGroup
from rtcp.motion.tool_in_use import ToolInUse

ENTRY_POINTS = "rtcp.controllers"
LONGEST_HOLD_S: Final = 1.0
"""A velocity, a torque or a jog counts for at most this long, s; then it must be commanded again."""


@dataclass(frozen=True)
class ControllerSetup:
    """What controllers are made from."""

    config: ArmConfig
    limits: Limits
    """Limits of the joints in force; the lists change in place."""
    trajectory_guard: TrajectoryGuard
    """Knows the boxes, and the poses of what is commanded."""
    period_s: float
    """The cycle, s."""
    plan: Callable[[int], memoryview[float]]
    """Returns the rows of a slot of the plan area (`rtcp.motion.planning.plan`)."""
    group: StepGroup = field(default_factory=StepGroup)
    """Partners in a cell, and the motion in step."""
    speed_override: SpeedOverride = field(default_factory=SpeedOverride)
    tool: ToolInUse = field(default_factory=ToolInUse)


@mypyc_attr(allow_interpreted_subclasses=True)
class Controller:
    """Base of all controllers: phases, the stop of the joints, checks that commands have in common.

    A subclass names its commands, overrides `accept` and `advance`, and `stop` where it stops along its path. In
    `advance` it allocates nothing that lasts, raises nothing, blocks and logs nothing.
    """

    name: ClassVar[str]
    commands: ClassVar[tuple[type[Command], ...]]
    """Commands that it accepts; no two controllers accept the same one."""
    control_modes: ClassVar[frozenset[ControlMode]] = frozenset({ControlMode.JOINT, ControlMode.CARTESIAN})
    """Control modes in which it accepts them."""
    tolerates_saturation: ClassVar[bool] = False
    """True where a setpoint that a guard cuts is normal (jog, velocity); False where the motion cannot continue."""
    pausable: ClassVar[bool] = False
    """Whether it rests on its path at a speed override of 0, and continues from there."""
    needs_geometry: ClassVar[bool] = False
    """Whether it is left out where the geometry of the arm is unknown."""

    def __init__(self, setup: ControllerSetup) -> None:
        limits = setup.limits
        self.config = setup.config
        self.limits = limits
        self.period_s = setup.period_s
        self.speed_override = setup.speed_override
        self.phase = Phase.HOLD
        self.ended: MotionEnded | None = None
        """Why it ended the motion by itself; None from the beginning of each motion on."""
        self.elapsed_s = self.duration_s = 0.0
        """Progress; 0 and 0 where there is none."""
        self.held = 0
        """What keeps the motion below the commanded velocity in this cycle: `HELD_...` of `rtcp.ipc.schema`."""
        self.setpoint = Setpoint(len(limits.velocity))
        self.motion = JointMotion(
            setup.period_s, limits.velocity, limits.acceleration, limits.jerk, setup.speed_override
        )
        """Brings the joints to rest; free for other use before that."""
        self._rows_in = setup.plan
        self._joints = range(len(limits.velocity))
        self._zero = [0.0] * len(limits.velocity)
        self._braking = False

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Check a command and carry it out from the next `update` on; return why not, and what runs continues.

        Args:
            command: one of `commands`.
            state: what the motion begins with.
            continues: whether this controller is moving the arm for the same commander: it is not started anew.
        """
        raise NotImplementedError

    def use_tool(self, number: int) -> None:
        """Use another tool from now on, `ArmConfig.models[number]`; called at rest. Nothing is computed here."""

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle, in the phases MOVE and STOP; they are valid until the next call.

        Fill lists of your own and set them in `setpoint`: after `rest` its lists are those of the state. Set `phase` to
        HOLD in the cycle that reaches the end; `give_up` ends a motion early.
        """
        raise NotImplementedError

    def begin(self) -> None:
        """Enter phase MOVE."""
        self.phase, self.ended, self._braking = Phase.MOVE, None, False
        self.elapsed_s = self.duration_s = 0.0

    def hold(self) -> None:
        """End the motion where the setpoints are; only at standstill, or where drives have no torque."""
        self.phase, self._braking = Phase.HOLD, False
        self.motion.hold()

    def stop(self, state: ArmState) -> None:
        """Come to rest under the limits: phase STOP, then HOLD. Does nothing at rest and while it stops."""
        if self.phase is Phase.MOVE:
            self.brake(state)

    def brake(self, state: ArmState) -> None:
        """Bring each joint to rest as fast as its limits allow, whatever the path."""
        if self.motion.phase is Phase.STOP:
            # An earlier stop; a move under way knows its acceleration.
            self.motion.hold()
        self.motion.stop(state)
        self.phase, self._braking = Phase.STOP, True

    def give_up(self, state: ArmState, ended: MotionEnded) -> Setpoint:
        """End the motion with an event and brake; return the setpoints of the next cycle."""
        self.ended = ended
        self.brake(state)
        return self.update(state)

    def rest(self, state: ArmState) -> Setpoint:
        """Return the setpoints of an arm at rest."""
        setpoint = self.setpoint
        setpoint.position, setpoint.velocity = state.commanded, self._zero
        return setpoint

    def update(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle; they are valid until the next call."""
        self.held = 0
        if not self.phase:
            return self.rest(state)
        return self.follow_motion(state) if self._braking else self.advance(state)

    def follow_motion(self, state: ArmState) -> Setpoint:
        """Return the setpoints of `motion`, and take over its phase."""
        motion = self.motion
        setpoint = motion.update(state)
        self.phase = motion.phase
        if motion.failed:
            self.ended = ControllerFailed()
        return setpoint

    def not_finite(self, values: Sequence[float]) -> Refusal | None:
        """Return why `values` are not one finite number for each joint, or None."""
        if len(values) != len(self._zero):
            return WrongCount(len(values), len(self._zero))
        for axis, value in enumerate(values):
            if not isfinite(value):
                return NotFinite(axis, value)
        return None

    def not_in_range(self, q: Sequence[float]) -> Refusal | None:
        """Return why the joints cannot go to `q` (rad), or None."""
        low, high = self.limits.low, self.limits.high
        if (refusal := self.not_finite(q)) is not None:
            return refusal
        for axis, wanted in enumerate(q):
            if not low[axis] <= wanted <= high[axis]:
                return PositionOutOfRange(axis, wanted, high[axis] if wanted > high[axis] else low[axis])
        return None

    def not_within(
        self,
        values: Sequence[float],
        bounds: Sequence[float],
        hold_s: float,
        refusal: Callable[[int, float, float], Refusal],
    ) -> Refusal | None:
        """Return why `values` for `hold_s` seconds are not allowed within +-`bounds`, or None."""
        if not 0.0 < hold_s <= LONGEST_HOLD_S:
            return HoldTimeOutOfRange(hold_s, LONGEST_HOLD_S)
        if (wrong := self.not_finite(values)) is not None:
            return wrong
        for axis, (value, bound) in enumerate(zip(values, bounds, strict=True)):
            if not -bound <= value <= bound:
                return refusal(axis, value, bound)
        return None

    def rows_of(self, slot: int, rows: int, most: int) -> memoryview[float] | Refusal:
        """Return the rows of the plan in `slot`, or a refusal: `rows` is not 1 to `most`, or there is no such slot."""
        return self._rows_in(slot) if slot in range(PLANS) and 1 <= rows <= most else WrongRowCount(rows, most)


@cache
def installed() -> tuple[type[Controller], ...]:
    """Return the classes of all controllers that are installed.

    Raises:
        PluginError: an entry point is not a controller.
    """
    return tuple(load_class(entry, Controller) for entry in registered(ENTRY_POINTS).values())


def load_controllers(setup: ControllerSetup) -> dict[type[Command], Controller]:
    """Return for each motion command the controller that accepts it.

    Where the geometry of the arm is unknown, controllers that need it are left out: their commands are refused with
    `rtcp.ipc.refusals.NoGeometry`.

    Raises:
        ConfigError: two controllers accept the same command, or `installed` raises it.
    """
    made: dict[type[Command], Controller] = {}
    for kind in installed():
        if kind.needs_geometry and setup.config.arm is None:
            continue
        controller = kind(setup)
        for command in kind.commands:
            if command in made:
                raise ConfigError([f"the controllers {made[command].name} and {kind.name} both accept {command.name}"])
            made[command] = controller
    return made
