"""Joint speeds with ramps; they have to be said again before they run out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, RuckigError, Synchronization

from rtcp.motion.controllers.room import allowed_accelerations
from rtcp.motion.state import ArmState, Phase, Reason, Setpoint

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

_POSITION, _VELOCITY = ControlInterface.Position, ControlInterface.Velocity
_HALT = [0.0, 0.0, 0.0, 0.0]
_EARLY = 1.5
_NEAR_RAD = 0.02
"""A joint heads for the edge of its range where it is so much nearer than it takes to stop."""
_SLOWEST_RAD_S = 1e-5


class VelocityController:
    """The mode `velocity`: each joint's speed, reached under its acceleration and jerk.

    Args:
        limits: of the joints; read in every cycle.
        period_s: the cycle, s.
    """

    def __init__(self, limits: Limits, period_s: float) -> None:
        n = len(limits.velocity)
        self._limits = limits
        self._otg = Ruckig(n, period_s)
        self._way, self._output = InputParameter(n), OutputParameter(n)
        self._way.synchronization = Synchronization.No
        self._way.target_acceleration = [0.0] * n
        self._target = Setpoint(n)
        self._zero = [0.0] * n
        self._joints = range(n)
        self._wanted = [0.0] * n
        self._said: list[float] = []
        self._until_ns = 0
        self._last: list[float] = []
        self.tolerates_saturation = True
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: ArmState) -> None:
        """Begin at `state`, with no speed asked for yet."""
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self._wanted = list(self._zero)
        self._until_ns = state.now_ns
        self._last = []

    def command(self, speeds: Sequence[float], hold_s: float, now_ns: int) -> None:
        """Ask for joint speeds, rad/s, of shape (n,), finite; they count for `hold_s` from `now_ns` on.

        While the mode stops they are not taken; a stop that has ended is begun anew with `start`.
        """
        if self.phase is not Phase.MOVE:
            return
        wanted, bounds = self._wanted, self._limits.velocity
        for i in self._joints:
            v, bound = speeds[i], bounds[i]
            wanted[i] = bound if v > bound else -bound if v < -bound else v
        self._until_ns = now_ns + round(hold_s * 1e9)

    def stop(self, state: ArmState) -> None:
        """Ramp down to rest."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP
            self._wanted = list(self._zero)

    def update(self, state: ArmState, dt: float) -> Setpoint:
        """Return the set-points of the next cycle."""
        target = self._target
        if not self.phase:
            target.position, target.velocity = state.commanded, self._zero
            return target
        if self.phase is Phase.MOVE and state.now_ns > self._until_ns:
            if any(self._wanted):
                self.reason, self.value = Reason.COMMAND_ENDED, 0.0
            self.stop(state)
        way, output = self._way, self._output
        goals = self._goals(state)
        # What the guards changed, or what is asked for anew, begins at the state; else the ramp goes on.
        moved = state.commanded != self._last
        if moved or goals != self._said:
            self._plan(state, goals, moved)
        self._said = goals
        result = self._step()
        if result < 0:
            # ruckig finds no way to an edge where a distance is exactly a border between two profiles: a ramp it finds.
            self._plan(state, _HALT * len(self._wanted), moved=True)
            self._said = []
            result = self._step()
        if result < 0:
            self.phase, self.reason = Phase.HOLD, Reason.GENERATOR
            target.position, target.velocity = state.commanded, self._zero
            return target
        target.position, target.velocity = output.new_position, output.new_velocity
        self._last = output.new_position
        output.pass_to_input(way)
        if self.phase is Phase.STOP and result == Result.Finished:
            self.phase = Phase.HOLD
            target.velocity = self._zero
        return target

    def _step(self) -> Result:
        try:
            return self._otg.update(self._way, self._output)
        except (RuckigError, ValueError):
            return Result.Error

    def _goals(self, state: ArmState) -> list[float]:
        """Return what each joint goes to: four numbers each, of which the first says whether it is a position."""
        goals: list[float] = []
        limits = self._limits
        for i, wanted in enumerate(self._wanted):
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

    def _plan(self, state: ArmState, goals: list[float], moved: bool) -> None:
        """Give ruckig the goals: a speed, or, near an edge of the range, the edge, no faster than the speed."""
        way, limits = self._way, self._limits
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
            way.current_acceleration = allowed_accelerations(state, limits.velocity, limits.acceleration, limits.jerk)
