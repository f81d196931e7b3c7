"""Joint targets from outside, at any rate: followed smoothly under the limits, and to rest when they cease."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from ruckig import InputParameter, OutputParameter, Result, Ruckig, RuckigError, Trajectory

from rtcp.ipc.commands import Command, StreamPosition
from rtcp.ipc.events import ControllerFailed, StreamEnded
from rtcp.ipc.refusals import Refusal, StampNotFinite, StreamPointDropped
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.joint_motion import allowed_accelerations, stoppable_speed
from rtcp.motion.state import ArmState, Phase, Setpoint

TIMEOUT_S = 0.2
"""A stream that is silent for this long has ended."""
_LATE = 2.5
"""A target is missing this many intervals after the last one; until then the speed is kept."""
_INSIDE = 1.0 - 1e-6
_SHARE = 0.2
"""Weight of a new interval in the mean."""
_SLACK = 1e-6
_DRIFT = 1e-4
"""The sender's clock may be slower than ours by this fraction."""
_TIMEOUT_NS = round(TIMEOUT_S * 1e9)


class StreamController(Controller):
    """Accepts `StreamPosition`. A target that is late by more than the timeout, or out of order, is dropped."""

    name = "stream"
    commands = (StreamPosition,)

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        n = len(self._zero)
        self._otg = Ruckig(n, setup.period_s)
        self._way, self._output, self._found = InputParameter(n), OutputParameter(n), Trajectory(n)
        self._wanted = [0.0] * n
        self._speed = [0.0] * n
        self._last: list[float] = []
        self._stamp_s = 0.0
        self._came_ns = 0
        self._interval_s = 0.0
        self._lag_s = 0.0
        self._first = True
        self._fresh = self._tracks = False

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Follow the target from the next cycle on."""
        assert isinstance(command, StreamPosition)
        if (refusal := self.not_in_range(command.q)) is not None:
            return refusal
        if not isfinite(command.stamp_s):
            return StampNotFinite(command.stamp_s)
        if not continues or self.phase is not Phase.MOVE:
            self._start(state)
        late_s = self._take(command.q, command.stamp_s, state.now_ns)
        return None if late_s is None else StreamPointDropped(late_s)

    def _start(self, state: ArmState) -> None:
        self.begin()
        self._first, self._interval_s = True, 0.0
        self._came_ns = state.now_ns
        self._fresh = self._tracks = False
        self._wanted = list(state.commanded)
        self._speed = list(self._zero)

    def _take(self, q: Sequence[float], stamp_s: float, now_ns: int) -> float | None:
        """Accept a target, or drop it and return how late it is, s."""
        lag = now_ns * 1e-9 - stamp_s
        step = stamp_s - self._stamp_s
        if not self._first:
            if step <= 0.0:
                return -step
            # The least lag is the difference of the clocks: what exceeds it is how late a target came.
            self._lag_s = min(lag, self._lag_s + _DRIFT * step)
            if lag - self._lag_s > TIMEOUT_S:
                return lag - self._lag_s
        else:
            self._lag_s = lag
        if self._first or step > TIMEOUT_S:
            self._speed = list(self._zero)
            self._interval_s = 0.0
        else:
            self._learn(q, step)
        self._wanted[:] = q
        self._stamp_s, self._came_ns = stamp_s, now_ns
        self._first, self._fresh = False, True
        return None

    def _learn(self, q: Sequence[float], step: float) -> None:
        """Estimate the interval, and with which speed the target moves."""
        interval = self._interval_s
        self._interval_s = step if interval == 0.0 else interval + _SHARE * (step - interval)
        limits, wanted, speed = self.limits, self._wanted, self._speed
        over = 1.0 / step
        for i in self._joints:
            v = (q[i] - wanted[i]) * over
            # Where the target is, the joint must still be able to stop inside its range.
            stopping_distance = limits.high[i] - q[i] if v > 0.0 else q[i] - limits.low[i]
            stops = stoppable_speed(0.9 * stopping_distance, limits.acceleration[i], limits.jerk[i])
            bound = limits.velocity[i] * _INSIDE
            bound = stops if stops < bound else bound
            speed[i] = bound if v > bound else -bound if v < -bound else v

    def advance(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle."""
        target = self.setpoint
        if state.now_ns - self._came_ns > _TIMEOUT_NS:
            return self.give_up(state, StreamEnded())
        if self._fresh:
            self._fresh = False
            self._aim(state)
        elif not self._tracks:
            # It rests at the last target.
            return self.rest(state)
        output = self._output
        try:
            result = self._otg.update(self._way, output)
        except (RuckigError, ValueError):
            result = Result.Error
        if result < 0:
            return self.give_up(state, ControllerFailed())
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
        way, limits = self._way, self.limits
        # Where nothing was cut the state is ruckig's own, which knows its acceleration better.
        if not self._tracks or state.commanded != self._last:
            way.current_position, way.current_velocity = state.commanded, state.commanded_velocity
            way.current_acceleration = allowed_accelerations(
                state.commanded_acceleration, state, limits.velocity, limits.acceleration, limits.jerk
            )
        self._tracks = True
        way.max_velocity = [max(b, abs(v)) for b, v in zip(limits.velocity, state.commanded_velocity, strict=True)]
        way.max_acceleration, way.max_jerk = limits.acceleration, limits.jerk
        way.target_position, way.target_velocity = self._wanted, self._speed
        if not self._stays_inside(state):
            self._aim_to_rest()

    def _stays_inside(self, state: ArmState) -> bool:
        """Whether there is a way to the target at its speed, and the run-up for it lies inside the range."""
        try:
            if self._otg.calculate(self._way, self._found) < 0:
                return False
        except (RuckigError, ValueError):
            return False
        low, high, extrema = self.limits.low, self.limits.high, self._found.position_extrema
        for i in self._joints:
            here = state.commanded[i]
            if extrema[i].min < min(low[i], here) - _SLACK or extrema[i].max > max(high[i], here) + _SLACK:
                return False
        return True

    def _may_go_on(self, state: ArmState) -> bool:
        """Whether a target may just be late, and the joints can still stop inside their range."""
        if (state.now_ns - self._came_ns) * 1e-9 > _LATE * self._interval_s:
            return False
        limits, speed, position = self.limits, self._speed, state.commanded
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
