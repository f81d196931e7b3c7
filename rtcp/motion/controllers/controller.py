"""Base class of the motion controllers, their constructor arguments, and how entry points register them.

A controller turns commands into setpoints, one `update` a cycle while it moves the arm. A new one is a subclass of
`Controller` and an entry point of the group `rtcp.controllers`, in this package or another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint
from math import isfinite
from typing import ClassVar, Final

from mypy_extensions import mypyc_attr

from rtcp.config.find import definition_of, load_class, made_by, registered
from rtcp.config.model import ArmConfig, ConfigError, PluginError
from rtcp.ipc.commands import Command, MotionCommand
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
"""Upper bound on the hold time of a velocity, torque or jog command, s."""


@dataclass(frozen=True)
class ControllerSetup:
    """Constructor arguments of a controller."""

    config: ArmConfig
    limits: Limits
    """Limits of the joints in force; the lists change in place."""
    trajectory_guard: TrajectoryGuard
    """Holds the boxes and the frames of the commanded position."""
    period_s: float
    """Cycle time, s."""
    plan: Callable[[int], memoryview[float]]
    """Returns the rows of a slot of the plan area (`rtcp.motion.planning.plan`)."""
    group: StepGroup = field(default_factory=StepGroup)
    """Partners in a cell, and the motion in step."""
    speed_override: SpeedOverride = field(default_factory=SpeedOverride)
    tool: ToolInUse = field(default_factory=ToolInUse)


@mypyc_attr(allow_interpreted_subclasses=True)
class Controller:
    """Base of all controllers: phases, the joint stop, common checks of commands.

    A subclass lists its commands and overrides `accept` and `advance`; it overrides `stop` to stop along its path.
    `advance` keeps no new objects, raises nothing, never blocks and never logs.
    """

    name: ClassVar[str]
    commands: ClassVar[tuple[type[Command], ...]]
    """Commands it accepts; each command belongs to one controller."""
    control_modes: ClassVar[frozenset[ControlMode]] = frozenset({ControlMode.JOINT, ControlMode.CARTESIAN})
    """Control modes in which it accepts commands."""
    tolerates_saturation: ClassVar[bool] = False
    """True: a setpoint cut by a guard is normal (jog, velocity). False: a cut ends the motion."""
    follows_joints: ClassVar[bool] = False
    """True: torques move the joints, and the setpoints only follow: a guard looks ahead from the measured joints."""
    pausable: ClassVar[bool] = False
    """True: a speed override of 0 pauses the motion on its path."""
    needs_geometry: ClassVar[bool] = False
    """True: not loaded for an arm without geometry."""

    def __init__(self, setup: ControllerSetup) -> None:
        limits = setup.limits
        self.config = setup.config
        self.limits = limits
        self.period_s = setup.period_s
        self.speed_override = setup.speed_override
        self.phase = Phase.HOLD
        self.ended: MotionEnded | None = None
        """Reason why the controller ended the motion; each new motion resets it to None."""
        self.elapsed_s = self.duration_s = 0.0
        """Progress, s; both 0 for a motion without a duration."""
        self.held = 0
        """What slows the motion below its commanded velocity in this cycle: `HELD_...` of `rtcp.ipc.schema`."""
        self.setpoint = Setpoint(len(limits.velocity))
        self.motion = JointMotion(
            setup.period_s, limits.velocity, limits.acceleration, limits.jerk, setup.speed_override
        )
        """Brings the joints to rest; a subclass may use it for its own motion."""
        self._rows_in = setup.plan
        self._joints = range(len(limits.velocity))
        self._zero = [0.0] * len(limits.velocity)
        self._braking = False

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Check a command and execute it from the next `update`; on a refusal the current motion continues.

        Args:
            command: one of `commands`.
            state: initial state of the motion.
            continues: True while this controller already moves the arm for the same commander.
        """
        raise NotImplementedError

    def use_tool(self, number: int) -> None:
        """Switch to tool `ArmConfig.models[number]`. Called at rest; must not compute."""

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle, valid until the next call; called in the phases MOVE and STOP.

        Assign your own lists to `setpoint`: after `rest` it refers to those of the state. Set `phase` to HOLD in the
        cycle that reaches the end; `give_up` ends a motion early.
        """
        raise NotImplementedError

    def begin(self) -> None:
        """Enter phase MOVE."""
        self.phase, self.ended, self._braking = Phase.MOVE, None, False
        self.elapsed_s = self.duration_s = 0.0

    def hold(self) -> None:
        """End the motion at the current setpoints. Only at standstill, or while the drives have no torque."""
        self.phase, self._braking = Phase.HOLD, False
        self.motion.hold()

    def stop(self, state: ArmState) -> None:
        """Come to rest under the limits: phase STOP, then HOLD. No effect at rest or during a stop.

        A controller of another package that takes more than twice the longest controlled stop is a fault.
        """
        if self.phase is Phase.MOVE:
            self.brake(state)

    def brake(self, state: ArmState) -> None:
        """Bring each joint to rest as fast as its limits allow, off the path if necessary."""
        if self.motion.phase is Phase.STOP:
            # Discard a previous stop; a move in progress keeps its acceleration.
            self.motion.hold()
        self.motion.stop(state)
        self.phase, self._braking = Phase.STOP, True

    def give_up(self, state: ArmState, ended: MotionEnded) -> Setpoint:
        """End the motion for the reason `event` and brake; return the setpoints of the next cycle."""
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
        """Return the setpoints of `motion` and copy its phase."""
        motion = self.motion
        setpoint = motion.update(state)
        self.phase = motion.phase
        if motion.failed:
            self.ended = ControllerFailed()
        return setpoint

    def not_finite(self, values: Sequence[float]) -> Refusal | None:
        """Return a refusal unless `values` has one finite number per joint."""
        if len(values) != len(self._zero):
            return WrongCount(len(values), len(self._zero))
        for axis, value in enumerate(values):
            if not isfinite(value):
                return NotFinite(axis, value)
        return None

    def not_in_range(self, q: Sequence[float]) -> Refusal | None:
        """Return a refusal unless `q` (rad) is finite and inside the joint ranges."""
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
        """Return a refusal unless `values` are within +-`bounds` and `hold_s` is allowed."""
        if not 0.0 < hold_s <= LONGEST_HOLD_S:
            return HoldTimeOutOfRange(hold_s, LONGEST_HOLD_S)
        if (wrong := self.not_finite(values)) is not None:
            return wrong
        for axis, (value, bound) in enumerate(zip(values, bounds, strict=True)):
            if not -bound <= value <= bound:
                return refusal(axis, value, bound)
        return None

    def rows_of(self, slot: int, rows: int, most: int) -> memoryview[float] | Refusal:
        """Return the rows of the plan in `slot`; a refusal if `rows` is not 1 to `most` or the slot does not exist."""
        return self._rows_in(slot) if slot in range(PLANS) and 1 <= rows <= most else WrongRowCount(rows, most)


@cache
def installed() -> tuple[tuple[EntryPoint, type[Controller]], ...]:
    """Return the classes of all installed controllers, with their entry points.

    Raises:
        PluginError: an entry point is not a controller.
    """
    return tuple((entry, load_class(entry, Controller)) for entry in registered(ENTRY_POINTS).values())


def load_controllers(setup: ControllerSetup) -> dict[type[Command], Controller]:
    """Return the controller of each motion command.

    For an arm without geometry, controllers that need it are not loaded; their commands are refused with
    `rtcp.ipc.refusals.NoGeometry`.

    Raises:
        ConfigError: two controllers accept the same command, or `installed` raises it.
        PluginError: an attribute of a class is missing or wrong, or its constructor raises an exception.
    """
    controllers: dict[type[Command], Controller] = {}
    for entry, kind in installed():
        if kind.needs_geometry and setup.config.arm is None:
            continue
        if wrong := _wrong_attribute(kind):
            raise PluginError(entry, f"cannot be used: {wrong} ({definition_of(kind)})")
        with made_by(entry):
            controller = kind(setup)
        for command in kind.commands:
            if command in controllers:
                other = controllers[command].name
                raise ConfigError([f"the controllers {other} and {kind.name} both accept {command.name}"])
            controllers[command] = controller
    return controllers


def _wrong_attribute(kind: type[Controller]) -> str:
    """Return which attribute of a controller's class is missing or wrong, with its value; empty: none."""
    name: object = getattr(kind, "name", None)
    if not isinstance(name, str) or not name:
        return f"`name` is {name!r:.80}, allowed is a text"
    commands: object = getattr(kind, "commands", None)
    if not isinstance(commands, tuple) or not all(
        isinstance(command, type) and issubclass(command, MotionCommand) for command in commands
    ):
        return f"`commands` is {commands!r:.80}, allowed is a tuple of subclasses of MotionCommand"
    modes: object = getattr(kind, "control_modes", None)
    if not isinstance(modes, frozenset) or not modes or not all(isinstance(mode, ControlMode) for mode in modes):
        return f"`control_modes` is {modes!r:.80}, allowed is a frozenset of ControlMode with at least one"
    return ""
