"""Joint targets from outside, at any rate: followed smoothly under the limits, and to rest when they cease."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import TYPE_CHECKING

from ruckig import InputParameter, OutputParameter, Result, Ruckig, RuckigError, Trajectory

from rtcp.motion.controllers.joint_move import JointMoveController
from rtcp.motion.controllers.room import allowed_accelerations, stoppable_speed
from rtcp.motion.state import ArmState, Phase, Reason, Setpoint

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

TIMEOUT_S = 0.2
"""A stream that is silent for so long has ended."""
_LATE = 2.5
"""So many intervals after the last target one is missing; until then its speed is kept."""
_INSIDE = 1.0 - 1e-6
_SHARE = 0.2
"""How much a new interval counts in the mean."""
_SLACK = 1e-6
_DRIFT = 1e-4
"""The sender's clock may run so much slower than ours, as a fraction."""


class StreamController:
    """The mode `stream`.

    Args:
        limits: of the joints; read in every cycle.
        period_s: the cycle, s.
        timeout_s: so long after the last target the arm comes to rest.
    """

    def __init__(self, limits: Limits, period_s: float, timeout_s: float = TIMEOUT_S) -> None:
        n = len(limits.velocity)
        self._limits = limits
        self._brake = JointMoveController(period_s, limits.velocity, limits.acceleration, limits.jerk)
        self._brakes = False
        self._otg = Ruckig(n, period_s)
        self._way, self._output, self._plan = InputParameter(n), OutputParameter(n), Trajectory(n)
        self._target = Setpoint(n)
        self._zero = [0.0] * n
        self._joints = range(n)
        self._timeout_ns = round(timeout_s * 1e9)
        self._wanted = [0.0] * n
        self._speed = [0.0] * n
        self._last: list[float] = []
        self._stamp_s = 0.0
        self._came_ns = 0
        self._interval_s = 0.0
        self._lag_s = 0.0
        self._samples = 0
        self._fresh = self._tracks = False
        self.tolerates_saturation = False
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0
        self.accepted = self.dropped = 0
        """How many targets were taken and how many were not, since the stream began."""
        self.late_s = 0.0
        """How late the last one that was dropped came, s; 0 for one that was none."""

    def start(self, state: ArmState) -> None:
        """Begin at `state`; the next target that `feed` takes is the first."""
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self._samples = self.accepted = self.dropped = 0
        self._interval_s = 0.0
        self._came_ns = state.now_ns
        self._fresh = self._tracks = self._brakes = False
        # Until the first target comes, what moves comes to rest.
        self._rest_from(state)
        self._wanted = list(state.commanded)
        self._speed = list(self._zero)

    def feed(self, q: Sequence[float], stamp_s: float, now_ns: int) -> bool:
        """Take a target and return True, or drop it and return False.

        Dropped is what is no number or outside the joints' range, what is stamped no later than the last one taken, and
        what comes later than the others by more than the timeout.

        Args:
            q: rad, shape (n,) at least; what is beyond is not looked at.
            stamp_s: the sender's clock, s; only differences count.
            now_ns: as `ArmState.now_ns`.
        """
        self.late_s = 0.0
        if self.phase is not Phase.MOVE or not isfinite(stamp_s) or not self._inside(q):
            self.dropped += 1
            return False
        now_s = now_ns * 1e-9
        lag = now_s - stamp_s
        first = self._samples == 0
        if not first:
            step = stamp_s - self._stamp_s
            if step <= 0.0:
                self.late_s = -step
                self.dropped += 1
                return False
            # The least lag of all is the clocks' difference: what exceeds it is how late a target came.
            self._lag_s = min(lag, self._lag_s + _DRIFT * step)
            late = lag - self._lag_s
            if late * 1e9 > self._timeout_ns:
                self.late_s = late
                self.dropped += 1
                return False
            if step * 1e9 > self._timeout_ns:
                first = True
        if first:
            if self._samples == 0:
                self._lag_s = lag
            self._speed = list(self._zero)
            self._interval_s = 0.0
        else:
            self._learn(q, step)
        wanted = self._wanted
        for i in self._joints:
            wanted[i] = q[i]
        self._stamp_s, self._came_ns = stamp_s, now_ns
        self._samples += 1
        self.accepted += 1
        self._fresh = True
        return True

    def _inside(self, q: Sequence[float]) -> bool:
        low, high = self._limits.low, self._limits.high
        # A comparison with what is no number is false.
        return all(low[i] <= q[i] <= high[i] for i in self._joints)

    def _learn(self, q: Sequence[float], step: float) -> None:
        """Estimate the interval, and with which speed the target moves."""
        interval = self._interval_s
        self._interval_s = step if interval == 0.0 else interval + _SHARE * (step - interval)
        limits, wanted, speed = self._limits, self._wanted, self._speed
        over = 1.0 / step
        for i in self._joints:
            v = (q[i] - wanted[i]) * over
            # Where the target is, the joint must still be able to stop inside its range.
            stopping_distance = limits.high[i] - q[i] if v > 0.0 else q[i] - limits.low[i]
            stops = stoppable_speed(0.9 * stopping_distance, limits.acceleration[i], limits.jerk[i])
            bound = limits.velocity[i] * _INSIDE
            bound = stops if stops < bound else bound
            speed[i] = bound if v > bound else -bound if v < -bound else v

    def stop(self, state: ArmState) -> None:
        """Come to rest under the limits; further targets are dropped."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP
            self._rest_from(state)
            self._brakes = True

    def _rest_from(self, state: ArmState) -> None:
        brake, limits = self._brake, self._limits
        brake.set_limits(limits.velocity, limits.acceleration, limits.jerk)
        brake.hold()
        brake.stop(state)

    def update(self, state: ArmState, dt: float) -> Setpoint:
        """Return the set-points of the next cycle."""
        target = self._target
        if self._brakes:
            target = self._brake.update(state, dt)
            if not self._brake.phase:
                self._brakes, self.phase = False, Phase.HOLD
            return target
        if not self.phase:
            target.position, target.velocity = state.commanded, self._zero
            return target
        silent_ns = state.now_ns - self._came_ns
        if silent_ns > self._timeout_ns:
            self.reason, self.value, self.limit = Reason.STREAM_ENDED, silent_ns * 1e-9, self._timeout_ns * 1e-9
            self.stop(state)
            return self.update(state, dt)
        if self._fresh:
            self._fresh = False
            self._aim(state)
        elif not self._tracks:
            return self._brake.update(state, dt)
        output = self._output
        try:
            result = self._otg.update(self._way, output)
        except (RuckigError, ValueError):
            result = Result.Error
        if result < 0:
            self.reason = Reason.GENERATOR
            self.stop(state)
            return self.update(state, dt)
        target.position = self._last = output.new_position
        target.velocity = output.new_velocity
        if result == Result.Finished:
            self._tracks = any(self._way.target_velocity)
            if self._tracks:
                output.pass_to_input(self._way)
                # ruckig goes on at the target's speed; where no new one comes, back to rest at the last.
                if not self._may_go_on(state):
                    self._aim_to_rest()
        else:
            output.pass_to_input(self._way)
        return target

    def _aim(self, state: ArmState) -> None:
        """Plan from the state to the newest target, with the speed that it has; where that cannot be, to rest at it."""
        way, limits = self._way, self._limits
        self._brake.hold()
        # Where nothing was cut the state is ruckig's own, which knows its acceleration better.
        if not self._tracks or state.commanded != self._last:
            way.current_position, way.current_velocity = state.commanded, state.commanded_velocity
            way.current_acceleration = allowed_accelerations(state, limits.velocity, limits.acceleration, limits.jerk)
        self._tracks = True
        way.max_velocity = [max(b, abs(v)) for b, v in zip(limits.velocity, state.commanded_velocity, strict=True)]
        way.max_acceleration, way.max_jerk = limits.acceleration, limits.jerk
        way.target_position, way.target_velocity = self._wanted, self._speed
        if not self._stays_inside(state):
            self._aim_to_rest()

    def _stays_inside(self, state: ArmState) -> bool:
        """Whether there is a way to the target at its speed, and the run-up for it lies inside the range."""
        try:
            if self._otg.calculate(self._way, self._plan) < 0:
                return False
        except (RuckigError, ValueError):
            return False
        low, high, extrema = self._limits.low, self._limits.high, self._plan.position_extrema
        for i in self._joints:
            here = state.commanded[i]
            if extrema[i].min < min(low[i], here) - _SLACK or extrema[i].max > max(high[i], here) + _SLACK:
                return False
        return True

    def _may_go_on(self, state: ArmState) -> bool:
        """Whether a target may just be late, and the joints can still stop inside their range."""
        if (state.now_ns - self._came_ns) * 1e-9 > _LATE * self._interval_s:
            return False
        limits, speed, position = self._limits, self._speed, state.commanded
        for i in self._joints:
            v = speed[i]
            stopping_distance = limits.high[i] - position[i] if v > 0.0 else position[i] - limits.low[i]
            most = stoppable_speed(0.9 * stopping_distance, limits.acceleration[i], limits.jerk[i])
            if not -most <= v <= most:
                return False
        return True

    def _aim_to_rest(self) -> None:
        way = self._way
        way.target_position, way.target_velocity = self._wanted, self._zero
