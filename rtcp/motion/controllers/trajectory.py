"""A list of timed joint points, cubic or quintic in between; the plan was checked whole by `rtcp.motion.planning`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtcp.motion.controllers.approach import Approach
from rtcp.motion.controllers.joint_move import JointMoveController
from rtcp.motion.controllers.slowdown import Slowdown
from rtcp.motion.planning.polynomials import Coefficients, cubic, quintic
from rtcp.motion.planning.rows import CUBIC, KIND, LONGEST_S, QUINTIC, Refused, Wrong, first_not_finite, read_row
from rtcp.motion.state import ArmState, Phase, Reason, Setpoint

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

AT_START_RAD = 1e-3
"""A plan with a point at time 0 has to begin so near to where the arm is commanded; what is left fades out."""
AT_START_RAD_S = 1e-2
"""And with so nearly the velocity that the arm has."""
_FADE_S = 0.5
_EXACT = 1e-12
_AT_ONCE_S = 1e-9
_SLACK = 1e-6


class TrajectoryController:
    """The mode `trajectory`.

    Args:
        limits: of the joints; read in every cycle.
        period_s: the cycle, s.
    """

    def __init__(self, limits: Limits, period_s: float) -> None:
        n = len(limits.velocity)
        self._limits = limits
        self._brake = JointMoveController(period_s, limits.velocity, limits.acceleration, limits.jerk)
        self._brakes = False
        self._slowdown = Slowdown()
        self._approach = Approach(limits)
        self._approach_s = 0.0
        self._target = Setpoint(n)
        self._zero = [0.0] * n
        self._joints = range(n)
        self._position = [0.0] * n
        self._velocity = [0.0] * n
        self._pieces: list[Coefficients] = [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)] * n
        self._fade: list[Coefficients] = list(self._pieces)
        self._fade_s = 0.0
        self._waypoint = [0.0] * 20
        self._rows: memoryview[float] | None = None
        self._row = self._count = 0
        self._from_s = self._to_s = 0.0
        self._delay_s = 0.0
        self.tolerates_saturation = False
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: ArmState, rows: memoryview[float], count: int) -> Refused | None:
        """Begin a plan of `count` waypoints (`rtcp.motion.planning.rows`) from `state`; return why not, or None.

        Where the first waypoint's time is 0, the arm has to be there. Otherwise an approach leads from the state's
        position, velocity and acceleration, under the joints' limits; it ends at the waypoint's time, or later where
        the limits demand it, and what follows is as much later. Where it is refused, what was under way goes on.
        """
        first, last = read_row(rows, 0), read_row(rows, count - 1)
        for index, row in ((0, first), (count - 1, last)):
            if (wrong := self._damage(row, index)) is not None:
                return wrong
        if last[0] <= _EXACT:
            return Refused(Wrong.DAMAGED, count - 1, last[0], 0.0)
        there = first[0] <= _EXACT
        if there:
            refused = self._is_elsewhere(state, first)
        else:
            refused = self._approach.plan(
                state.commanded, state.commanded_velocity, state.commanded_acceleration, first
            )
        if refused is not None:
            return refused
        self._fade_s = self._approach_s = 0.0
        if there:
            self._fade_out(state, first, last[0])
        else:
            self._approach_s = self._approach.duration_s
        self._rows, self._row, self._count = rows, 0, count
        self._waypoint = first
        self._delay_s = max(self._approach_s - first[0], 0.0)
        self._from_s = self._to_s = first[0] + self._delay_s
        self.duration_s = last[0] + self._delay_s
        self.elapsed_s = 0.0
        self._brakes = False
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        return None

    def _damage(self, row: list[float], index: int) -> Refused | None:
        column = first_not_finite(row)
        if column >= 0:
            return Refused(Wrong.DAMAGED, index, row[min(column, KIND)], float(column))
        if not 0.0 <= row[0] <= LONGEST_S:
            return Refused(Wrong.DAMAGED, index, row[0], 0.0)
        if row[KIND] not in (CUBIC, QUINTIC):
            return Refused(Wrong.DAMAGED, index, row[KIND], float(KIND))
        limits = self._limits
        for i in self._joints:
            q, v = row[1 + i], row[7 + i]
            if not limits.low[i] - _SLACK <= q <= limits.high[i] + _SLACK:
                return Refused(Wrong.DAMAGED, index, q, 1.0 + i)
            if not -limits.velocity[i] - _SLACK <= v <= limits.velocity[i] + _SLACK:
                return Refused(Wrong.DAMAGED, index, v, 7.0 + i)
        return None

    def _is_elsewhere(self, state: ArmState, first: list[float]) -> Refused | None:
        for i in self._joints:
            if not abs(state.commanded[i] - first[1 + i]) <= AT_START_RAD:
                return Refused(Wrong.START, i, first[1 + i], state.commanded[i])
            if not abs(state.commanded_velocity[i] - first[7 + i]) <= AT_START_RAD_S:
                return Refused(Wrong.START_SPEED, i, first[7 + i], state.commanded_velocity[i])
        return None

    def _fade_out(self, state: ArmState, first: list[float], last_s: float) -> None:
        for i in self._joints:
            ahead, faster = state.commanded[i] - first[1 + i], state.commanded_velocity[i] - first[7 + i]
            if abs(ahead) > _EXACT or abs(faster) > _EXACT:
                self._fade_s = min(_FADE_S, last_s)
            self._fade[i] = quintic(ahead, faster, 0.0, 0.0, 0.0, 0.0, min(_FADE_S, last_s))

    def stop(self, state: ArmState) -> None:
        """Brake along the path, as fast as the joints' limits allow."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP
            self._slowdown.begin()

    def update(self, state: ArmState, dt: float) -> Setpoint:
        """Return the set-points of the next cycle."""
        target = self._target
        if self._brakes:
            target = self._brake.update(state, dt)
            self.phase = self._brake.phase
            self._brakes = self.phase is not Phase.HOLD
            return target
        if self.phase is Phase.MOVE:
            if not self._go_to(self.elapsed_s + dt):
                return self._give_up(state, dt)
            self.elapsed_s = min(self.elapsed_s + dt, self.duration_s)
            if self.elapsed_s >= self.duration_s - _AT_ONCE_S and not self._arrives():
                return self._give_up(state, dt)
        elif self.phase is Phase.STOP:
            slowdown, limits = self._slowdown, self._limits
            before = slowdown.speed
            # Where the cycle ends hardly depends on how much slower it gets.
            if not self._go_to(self.elapsed_s + (before + 0.5 * slowdown.rate * dt) * dt):
                return self._give_up(state, dt)
            speed = slowdown.step(self._velocity, state.commanded_velocity, limits.acceleration, limits.jerk, dt)
            self.elapsed_s = min(self.elapsed_s + 0.5 * (before + speed) * dt, self.duration_s)
            if not self._go_to(self.elapsed_s):
                return self._give_up(state, dt)
            velocity = self._velocity
            for i in self._joints:
                velocity[i] *= speed
            if speed == 0.0:
                self.phase = Phase.HOLD
            elif self.elapsed_s >= self.duration_s - _AT_ONCE_S and not self._arrives():
                return self._give_up(state, dt)
        else:
            target.position, target.velocity = state.commanded, self._zero
            return target
        target.position, target.velocity = self._position, self._velocity
        return target

    def _arrives(self) -> bool:
        """Come to rest at the end; False where a damaged plan does not end at rest."""
        self.phase = Phase.HOLD
        for i in self._joints:
            speed = self._velocity[i]
            if not -_SLACK < speed < _SLACK:
                self.axis, self.value, self.limit = self._count - 1, speed, 7.0 + i
                return False
            self._velocity[i] = 0.0
        return True

    def _give_up(self, state: ArmState, dt: float) -> Setpoint:
        """The plan is damaged: come to rest from the state, whatever the path."""
        self.reason = Reason.PLAN
        self.phase = Phase.STOP
        self._brakes = True
        brake, limits = self._brake, self._limits
        brake.set_limits(limits.velocity, limits.acceleration, limits.jerk)
        brake.hold()
        brake.stop(state)
        return self.update(state, dt)

    def _go_to(self, at_s: float) -> bool:
        """Write position and velocity of the path at its time `at_s`; False where the plan is damaged."""
        position, velocity = self._position, self._velocity
        if at_s < self._approach_s:
            position[:], velocity[:], _ = self._approach.at(at_s)
            return True
        while at_s > self._to_s and self._row < self._count - 1:
            if not self._next():
                return False
        length = self._to_s - self._from_s
        if length > 0.0:
            x = (at_s - self._from_s) / length
            x = 1.0 if x > 1.0 else x
            over = 1.0 / length
            for i, (c0, c1, c2, c3, c4, c5) in enumerate(self._pieces):
                position[i] = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
                velocity[i] = (c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))) * over
        else:
            waypoint = self._waypoint
            n = len(position)
            position[:], velocity[:] = waypoint[1 : 1 + n], waypoint[7 : 7 + n]
        if at_s < self._fade_s:
            x, over = at_s / self._fade_s, 1.0 / self._fade_s
            for i, (c0, c1, c2, c3, c4, c5) in enumerate(self._fade):
                position[i] += c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
                velocity[i] += (c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))) * over
        return True

    def _next(self) -> bool:
        """Take the next waypoint; what is between it and the last becomes the current piece."""
        rows = self._rows
        assert rows is not None
        index = self._row + 1
        before, waypoint = self._waypoint, read_row(rows, index)
        wrong = self._damage(waypoint, index)
        length = waypoint[0] - before[0]
        if wrong is None and not 0.0 < length <= LONGEST_S:
            wrong = Refused(Wrong.DAMAGED, index, waypoint[0], 0.0)
        if wrong is not None:
            self.axis, self.value, self.limit = wrong.at, wrong.value, wrong.limit
            return False
        pieces = self._pieces
        if waypoint[KIND] == CUBIC:
            for i in self._joints:
                pieces[i] = cubic(before[1 + i], before[7 + i], waypoint[1 + i], waypoint[7 + i], length)
        else:
            for i in self._joints:
                pieces[i] = quintic(
                    before[1 + i],
                    before[7 + i],
                    before[13 + i],
                    waypoint[1 + i],
                    waypoint[7 + i],
                    waypoint[13 + i],
                    length,
                )
        self._row, self._waypoint = index, waypoint
        self._from_s, self._to_s = before[0] + self._delay_s, waypoint[0] + self._delay_s
        return True
