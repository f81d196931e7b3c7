"""Ramped joint velocities, which expire unless renewed."""

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
"""Margin on the stopping distance inside which the range end becomes the joint's target, rad."""
_SLOWEST_RAD_S: Final = 1e-5


class VelocityController(Controller):
    """Accepts `MoveAtVelocity`: each joint ramps to its velocity under its acceleration and jerk limits."""

    name = "velocity"
    commands = (MoveAtVelocity,)
    control_modes = frozenset({ControlMode.VELOCITY})
    tolerates_saturation = True

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        n = len(self._zero)
        self._otg = Ruckig(n, setup.period_s)
        self._inp, self._output = InputParameter(n), OutputParameter(n)
        self._inp.synchronization = Synchronization.No
        self._inp.target_acceleration = [0.0] * n
        self._wanted = [0.0] * n
        self._goals_before: list[float] = []
        self._until_ns = 0
        self._last: list[float] = []

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Ramp to the velocities, then to rest when they expire."""
        assert isinstance(command, MoveAtVelocity)
        return self.ramp_to(command.velocity, command.hold_s, state, continues)

    def ramp_to(self, velocity: Sequence[float], hold_s: float, state: ArmState, continues: bool) -> Refusal | None:
        """Ramp to joint velocities, rad/s, for `hold_s` s; or return a refusal."""
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
        inp, output = self._inp, self._output
        goals = self._goals(state)
        # After a cut by a guard, or a new command, start from the state; otherwise continue the ramp.
        moved = state.commanded != self._last
        if moved or goals != self._goals_before:
            self._aim(state, goals, moved)
        self._goals_before = goals
        result = self._step()
        if result < 0:
            # ruckig finds no profile for a distance exactly between two profile types; a ramp always works.
            self._aim(state, _HALT * len(self._wanted), moved=True)
            self._goals_before = []
            result = self._step()
        if result < 0:
            self.phase, self.ended = Phase.HOLD, ControllerFailed()
            return self.rest(state)
        target.position, target.velocity = output.new_position, output.new_velocity
        self._last = output.new_position
        self._note_range(goals, target.velocity, state.commanded_velocity)
        output.pass_to_input(inp)
        if self.phase is Phase.STOP and result == Result.Finished:
            self.phase = Phase.HOLD
            target.velocity = self._zero
        return target

    def _note_range(self, goals: list[float], speeds: Sequence[float], before: Sequence[float]) -> None:
        """Set `held` to the first joint that its range end makes slower than commanded."""
        fraction = self.speed_override.fraction
        for i, wanted in enumerate(self._wanted):
            speed = abs(speeds[i])
            if goals[4 * i] == 1.0 and speed < fraction * abs(wanted) - _SLOWEST_RAD_S and speed <= abs(before[i]):
                self.held = (i + 1) << HELD_RANGE_AT
                return

    def _step(self) -> Result:
        try:
            return self._otg.update(self._inp, self._output)
        except (RuckigError, ValueError):
            return Result.Error

    def _goals(self, state: ArmState) -> list[float]:
        """Return four numbers per joint: 1 for a position goal or 0 for a velocity, the goal, two bounds."""
        goals: list[float] = []
        limits, fraction = self.limits, self.speed_override.fraction
        for i, commanded in enumerate(self._wanted):
            wanted = fraction * commanded
            acceleration, jerk, now = limits.acceleration[i], limits.jerk[i], state.commanded_velocity[i]
            edge = limits.high[i] if wanted > 0.0 else limits.low[i]
            stopping_distance = edge - state.commanded[i] if wanted > 0.0 else state.commanded[i] - edge
            fast, faster = abs(now), abs(wanted)
            fast = (fast if fast > faster else faster) + 0.5 * acceleration * acceleration / jerk
            near = stopping_distance < _EARLY * fast * (0.5 * fast / acceleration + acceleration / jerk) + _NEAR_RAD
            if wanted and near:
                # Guards against rounding at the range end; ruckig also fails on trajectories of hours.
                goals += (1.0, edge, faster, jerk) if faster > _SLOWEST_RAD_S else (0.0, 0.0, acceleration, jerk)
            else:
                goals += (0.0, wanted, acceleration, jerk)
        return goals

    def _aim(self, state: ArmState, goals: list[float], moved: bool) -> None:
        """Set ruckig's goals: the speed or, near a range end, that position at no more than the speed."""
        inp, limits = self._inp, self.limits
        kinds, targets = [goal == 1.0 for goal in goals[::4]], goals[1::4]
        inp.per_dof_control_interface = [_POSITION if kind else _VELOCITY for kind in kinds]
        inp.target_position = [target if kind else 0.0 for kind, target in zip(kinds, targets, strict=True)]
        inp.target_velocity = [0.0 if kind else target for kind, target in zip(kinds, targets, strict=True)]
        inp.max_velocity = [
            goals[4 * i + 2] if kind else limits.velocity[i] for i, kind in enumerate(kinds)
        ]  # fmt: skip
        inp.current_position, inp.current_velocity = state.commanded, state.commanded_velocity
        inp.max_acceleration, inp.max_jerk = limits.acceleration, limits.jerk
        if moved:
            inp.current_acceleration = allowed_accelerations(
                state.commanded_acceleration, state, limits.velocity, limits.acceleration, limits.jerk
            )
