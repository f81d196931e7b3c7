"""Joint targets from outside, at any rate: followed smoothly under the limits, and to rest when they cease."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from ruckig import InputParameter, Ruckig, Trajectory

from rtcp.ipc.commands import Command, StreamPosition
from rtcp.ipc.events import ControllerFailed, StreamEnded
from rtcp.ipc.refusals import Refusal, StampNotFinite, StreamPointDropped
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.joint_motion import allowed_accelerations, find_way, leaves_range, stoppable_speed
from rtcp.motion.state import ArmState, Phase, Setpoint

TIMEOUT_S = 0.2
"""A stream that is silent for this long has ended."""
_LOOK_AHEAD_S = 0.2
"""A target is met no further ahead than this."""
_LATE = 2.5
"""A target is missing this many intervals after the last one; until then the speed is kept."""
_INSIDE = 1.0 - 1e-6
_SHARE = 0.2
"""Weight of a new interval in the mean."""
_OVER_S = 0.01
"""The speed of a target is estimated over this at least: steps of an encoder, or noise, are no speed."""
_AT_LEAST_S = 0.01
"""The joints take this long at least to meet a target: in less, what is lost to rounding would take a detour."""
_LONGER = 1.05
"""And this much longer than they need, since the shortest way is the only one in its time."""
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
        self._period_s = setup.period_s
        self._otg = Ruckig(n, setup.period_s)
        self._way, self._found = InputParameter(n), Trajectory(n)
        # The same way as the moving target sees it, whose duration tells where the two meet.
        self._relative, self._catch_up = InputParameter(n), Trajectory(n)
        self._wanted = [0.0] * n
        self._speed = [0.0] * n
        # Targets from which on the speed is estimated.
        self._older, self._newer = [0.0] * n, [0.0] * n
        self._older_s = self._newer_s = 0.0
        self._last, self._acceleration = [0.0] * n, [0.0] * n
        self._stamp_s = 0.0
        self._came_ns = 0
        self._interval_s = 0.0
        self._lag_s = 0.0
        self._late_s = 0.0
        self._elapsed_s = 0.0
        self._bounds: tuple[float, ...] = ()
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
        self._late_s = lag - self._lag_s
        if self._first or step > TIMEOUT_S:
            self._speed = list(self._zero)
            self._interval_s = 0.0
            self._older[:] = self._newer[:] = q
            self._older_s = self._newer_s = stamp_s
        else:
            self._learn(q, stamp_s, step)
        self._wanted[:] = q
        self._stamp_s, self._came_ns = stamp_s, now_ns
        self._first, self._fresh = False, True
        return None

    def _learn(self, q: Sequence[float], stamp_s: float, step: float) -> None:
        """Estimate the interval, and with which speed the target moves: over 10 to 20 ms, or the last interval."""
        interval = self._interval_s
        self._interval_s = step if interval == 0.0 else interval + _SHARE * (step - interval)
        if stamp_s - self._newer_s >= _OVER_S:
            self._older, self._newer = self._newer, self._older
            self._older_s, self._newer_s = self._newer_s, stamp_s
            self._newer[:] = q
        older, speed, limits = self._older, self._speed, self.limits.velocity
        over = stamp_s - self._older_s
        for i in self._joints:
            bound = limits[i] * _INSIDE
            v = (q[i] - older[i]) / over
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
        elif any(self._way.target_velocity) and not self._may_go_on(state):
            self._begin(state)
            self._tracks = self._plan(self._wanted, self._zero)
        if not self._tracks:
            return self.give_up(state, ControllerFailed())
        self._elapsed_s += self._period_s
        # After its end the way goes on at the target's speed.
        target.position, target.velocity, self._acceleration = self._found.at_time(self._elapsed_s)
        self._last = target.position
        self._tracks = self._elapsed_s < self._found.duration or any(self._way.target_velocity)
        return target

    def _is_own(self, state: ArmState) -> bool:
        """Whether the state is where the way under way has led."""
        return self._tracks and state.commanded == self._last

    def _begin(self, state: ArmState) -> None:
        """Let the next way begin in the state."""
        way, limits = self._way, self.limits
        way.current_position, way.current_velocity = state.commanded, state.commanded_velocity
        # Where nothing was cut the way's own acceleration is known better.
        way.current_acceleration = allowed_accelerations(
            self._acceleration if self._is_own(state) else state.commanded_acceleration,
            state, limits.velocity, limits.acceleration, limits.jerk,
        )  # fmt: skip
        way.max_velocity = [max(b, abs(v)) for b, v in zip(limits.velocity, state.commanded_velocity, strict=True)]
        way.max_acceleration = limits.acceleration

    def _aim(self, state: ArmState) -> None:
        """Plan to where the newest target is met if it keeps its speed; where that cannot be, to rest at it."""
        wanted, speed, limits = self._wanted, self._speed, self.limits
        bounds = (*limits.velocity, *limits.acceleration, *limits.jerk)
        moves = any(speed)
        # Planned anew, a way to the same rest could by rounding be another one, which passes it.
        if not moves and self._is_own(state) and self._way.target_position == wanted and bounds == self._bounds:
            return
        self._bounds = bounds
        self._begin(state)
        if moves:
            duration = self._time_to_meet()
            ahead = duration + self._late_s
            for i in self._joints:
                v = speed[i]
                # Where the two meet, the joint must still be able to stop inside its range.
                stopping_distance = limits.high[i] - wanted[i] if v > 0.0 else wanted[i] - limits.low[i]
                stops = stoppable_speed(0.9 * stopping_distance, limits.acceleration[i], limits.jerk[i], ahead)
                speed[i] = stops if v > stops else -stops if v < -stops else v
            meets = [q + v * ahead for q, v in zip(wanted, speed, strict=True)]
            if self._plan(meets, speed, duration) and leaves_range(self._found, state.commanded, limits) is None:
                self._tracks = True
                return
        self._tracks = self._plan(wanted, self._zero)

    def _time_to_meet(self) -> float:
        """Return how long it takes at least to be where the moving target is then, s, up to 0.2 s."""
        way, seen, speed = self._way, self._relative, self._speed
        n = self._joints
        late_s = self._late_s
        seen.current_position = [way.current_position[i] - self._wanted[i] - speed[i] * late_s for i in n]
        seen.current_velocity = [way.current_velocity[i] - speed[i] for i in n]
        seen.current_acceleration = way.current_acceleration
        seen.max_velocity = [way.max_velocity[i] - speed[i] for i in n]
        seen.min_velocity = [-way.max_velocity[i] - speed[i] for i in n]
        seen.max_acceleration = way.max_acceleration
        if not find_way(self._otg, seen, self.limits.jerk, self._catch_up):
            # The target is as fast as the joint may be.
            return _LOOK_AHEAD_S
        duration: float = self._catch_up.duration
        return min(_LOOK_AHEAD_S, _AT_LEAST_S + _LONGER * duration)

    def _plan(self, position: list[float], velocity: list[float], duration_s: float | None = None) -> bool:
        """Find the way to a position and velocity, which takes at least so long."""
        way = self._way
        way.target_position, way.target_velocity, way.minimum_duration = position, velocity, duration_s
        self._elapsed_s = 0.0
        return find_way(self._otg, way, self.limits.jerk, self._found)

    def _may_go_on(self, state: ArmState) -> bool:
        """Whether a target may just be late, and joints that have met it can still stop inside their range."""
        if (state.now_ns - self._came_ns) * 1e-9 > _LATE * self._interval_s:
            return False
        if self._elapsed_s < self._found.duration:
            return True
        limits, speed, position = self.limits, self._speed, state.commanded
        for i in self._joints:
            v = speed[i]
            stopping_distance = limits.high[i] - position[i] if v > 0.0 else position[i] - limits.low[i]
            most = stoppable_speed(0.9 * stopping_distance, limits.acceleration[i], limits.jerk[i])
            if not -most <= v <= most:
                return False
        return True
