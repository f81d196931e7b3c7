"""Joint velocities with ramps, which expire unless they are renewed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, RuckigError, Synchronization

from rtcp.ipc.commands import Command, MoveAtVelocity
from rtcp.ipc.events import CommandExpired, ControllerFailed
from rtcp.ipc.refusals import JointSpeedOutOfRange, Refusal
from rtcp.ipc.schema import HELD_RANGE_AT
from rtcp.ipc.states import ControlMode
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.joint_motion import allowed_accelerations
from rtcp.motion.state import ArmState, Phase, Setpoint

_POSITION, _VELOCITY = ControlInterface.Position, ControlInterface.Velocity
_HALT = [0.0, 0.0, 0.0, 0.0]
_EARLY: Final = 1.5
_NEAR_RAD: Final = 0.02
"""A joint heads for the edge of its range when it is this much nearer than it takes to stop."""
_SLOWEST_RAD_S: Final = 1e-5


class VelocityController(Controller):
    """Accepts `MoveAtVelocity`: each joint's velocity is reached under its acceleration and jerk."""

    name = "velocity"
    commands = (MoveAtVelocity,)
    control_modes = frozenset({ControlMode.VELOCITY})
    tolerates_saturation = True

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        n = len(self._zero)
        self._otg = Ruckig(n, setup.period_s)
        self._way, self._output = InputParameter(n), OutputParameter(n)
        self._way.synchronization = Synchronization.No
        self._way.target_acceleration = [0.0] * n
        self._wanted = [0.0] * n
        self._goals_before: list[float] = []
        self._until_ns = 0
        self._last: list[float] = []

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Ramp to the velocities, and to rest when they expire."""
        assert isinstance(command, MoveAtVelocity)
        return self.ramp_to(command.velocity, command.hold_s, state, continues)

    def ramp_to(self, velocity: Sequence[float], hold_s: float, state: ArmState, continues: bool) -> Refusal | None:
        """Ramp to joint velocities, rad/s, for `hold_s` s; return why not."""
        refusal = self.not_within(velocity, self.limits.velocity, hold_s, JointSpeedOutOfRange)
        if refusal is not None:
            return refusal
        if not continues or self.phase is not Phase.MOVE:
            self.begin()
            self._last = []
        self._wanted = list(velocity)
        self._until_ns = state.now_ns + round(hold_s * 1e9)
        return None

    def stop(self, state: ArmState) -> None:
        """Ramp down to rest."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP
            self._wanted = list(self._zero)

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        target = self.setpoint
        if self.phase is Phase.MOVE and state.now_ns > self._until_ns:
            if any(self._wanted):
                self.ended = CommandExpired()
            self.stop(state)
        way, output = self._way, self._output
        goals = self._goals(state)
        # What the guards changed, or what is asked for anew, begins at the state; else the ramp goes on.
        moved = state.commanded != self._last
        if moved or goals != self._goals_before:
            self._aim(state, goals, moved)
        self._goals_before = goals
        result = self._step()
        if result < 0:
            # ruckig finds no way to an edge where a distance is exactly a border between two profiles: a ramp it finds.
            self._aim(state, _HALT * len(self._wanted), moved=True)
            self._goals_before = []
            result = self._step()
        if result < 0:
            self.phase, self.ended = Phase.HOLD, ControllerFailed()
            return self.rest(state)
        target.position, target.velocity = output.new_position, output.new_velocity
        self._last = output.new_position
        self._note_range(goals, target.velocity, state.commanded_velocity)
        output.pass_to_input(way)
        if self.phase is Phase.STOP and result == Result.Finished:
            self.phase = Phase.HOLD
            target.velocity = self._zero
        return target

    def _note_range(self, goals: list[float], speeds: Sequence[float], before: Sequence[float]) -> None:
        """Set `held` to the first joint that the edge of its range makes slower than it is wanted, rad/s."""
        fraction = self.speed_override.fraction
        for i, wanted in enumerate(self._wanted):
            speed = abs(speeds[i])
            if goals[4 * i] == 1.0 and speed < fraction * abs(wanted) - _SLOWEST_RAD_S and speed <= abs(before[i]):
                self.held = (i + 1) << HELD_RANGE_AT
                return

    def _step(self) -> Result:
        try:
            return self._otg.update(self._way, self._output)
        except (RuckigError, ValueError):
            return Result.Error

    def _goals(self, state: ArmState) -> list[float]:
        """Return what each joint goes to: four numbers each, of which the first says whether it is a position."""
        goals: list[float] = []
        limits, fraction = self.limits, self.speed_override.fraction
        for i, asked in enumerate(self._wanted):
            wanted = fraction * asked
            acceleration, jerk, now = limits.acceleration[i], limits.jerk[i], state.commanded_velocity[i]
            edge = limits.high[i] if wanted > 0.0 else limits.low[i]
            stopping_distance = edge - state.commanded[i] if wanted > 0.0 else state.commanded[i] - edge
            fast, faster = abs(now), abs(wanted)
            fast = (fast if fast > faster else faster) + 0.5 * acceleration * acceleration / jerk
            near = stopping_distance < _EARLY * fast * (0.5 * fast / acceleration + acceleration / jerk) + _NEAR_RAD
            if wanted and near:
                # Rounding beside the edge; and ruckig knows no ways that take hours.
                goals += (1.0, edge, faster, jerk) if faster > _SLOWEST_RAD_S else (0.0, 0.0, acceleration, jerk)
            else:
                goals += (0.0, wanted, acceleration, jerk)
        return goals

    def _aim(self, state: ArmState, goals: list[float], moved: bool) -> None:
        """Set ruckig's goals: a speed, or, near an edge of the range, the edge, no faster than the speed."""
        way, limits = self._way, self.limits
        kinds, targets = [goal == 1.0 for goal in goals[::4]], goals[1::4]
        way.per_dof_control_interface = [_POSITION if kind else _VELOCITY for kind in kinds]
        way.target_position = [target if kind else 0.0 for kind, target in zip(kinds, targets, strict=True)]
        way.target_velocity = [0.0 if kind else target for kind, target in zip(kinds, targets, strict=True)]
        way.max_velocity = [
            goals[4 * i + 2] if kind else limits.velocity[i] for i, kind in enumerate(kinds)
        ]  # fmt: skip
        way.current_position, way.current_velocity = state.commanded, state.commanded_velocity
        way.max_acceleration, way.max_jerk = limits.acceleration, limits.jerk
        if moved:
            way.current_acceleration = allowed_accelerations(
                state.commanded_acceleration, state, limits.velocity, limits.acceleration, limits.jerk
            )
