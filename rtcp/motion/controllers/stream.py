"""Joint targets from outside, at any rate: followed smoothly under the limits, to rest when they end."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Final

from ruckig import InputParameter, Ruckig, Trajectory

from rtcp.config.model import MOST_AXES
from rtcp.ipc.commands import Command, OpenStream, StreamPosition
from rtcp.ipc.events import (
    ControllerFailed,
    MotionEnded,
    SetpointNotFinite,
    SetpointOutOfOrder,
    SetpointOutOfRange,
    StreamEnded,
)
from rtcp.ipc.layout import SETPOINT_ENDS, SETPOINT_HAS_ACCELERATION, SETPOINT_HAS_VELOCITY
from rtcp.ipc.refusals import Malformed, Refusal, StampNotFinite, StreamPointDropped
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.joint_motion import allowed_accelerations, find_trajectory, leaves_range, stoppable_speed
from rtcp.motion.state import ArmState, Phase, Setpoint
from rtcp.motion.step_group import StepPhase

TIMEOUT_S: Final = 0.2
"""Silence after which a stream has ended, s."""
_LOOK_AHEAD_S: Final = 0.2
"""Upper bound on the time to meet a target, s."""
_LATE: Final = 2.5
"""Intervals after the last target until one counts as missing; until then the joints keep their speed."""
_INSIDE = 1.0 - 1e-6
_SHARE: Final = 0.2
"""Weight of a new interval in the mean."""
_OVER_S: Final = 0.01
"""Shortest time base for a target's speed, s: averages out encoder steps and noise."""
_AT_LEAST_S: Final = 0.01
"""Shortest time to meet a target, s: in less, correcting a rounding error takes a detour."""
_MOST_LATE_S: Final = 1e9
"""Upper bound on a reported lateness, s: the difference of two stamps may be infinite."""
_LONGER: Final = 1.05
"""Factor on the shortest time: without a margin, rounding can leave no solution."""
_DRIFT: Final = 1e-4
"""Fraction by which the sender's clock may be slower than ours."""
_TIMEOUT_NS = round(TIMEOUT_S * 1e9)


class StreamController(Controller):
    """Accepts `StreamPosition` and `OpenStream`, and the setpoints `put` into an open stream.

    A `StreamPosition` that is out of order or late by more than the timeout is dropped; in an open stream, whose sender
    waits for no answer, such a setpoint ends the stream.
    """

    name = "stream"
    commands = (StreamPosition, OpenStream)

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        n = len(self._zero)
        self._period_s = setup.period_s
        self._otg = Ruckig(n, setup.period_s)
        self._inp, self._trajectory = InputParameter(n), Trajectory(n)
        # The motion relative to the moving target; its duration gives the meeting point.
        self._relative, self._catch_up = InputParameter(n), Trajectory(n)
        self._wanted = [0.0] * n
        self._speed = [0.0] * n
        # Earlier targets, for the speed estimate.
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
        self._keeps_speed = False
        self._rate = [0.0] * n
        """Target acceleration as sent, rad/s^2."""
        self.stream = 0
        """Number of the open stream; 0: none, or it has ended."""
        self._group = setup.group
        self._in_step = False

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        """Follow the target from the next cycle."""
        if isinstance(command, OpenStream):
            if command.stream <= 0:
                return Malformed(command.number)
            if command.motion and (refusal := self._group.refusal(command.motion, command.partners, state.now_ns)):
                return refusal
            self._start(state)
            self.stream = command.stream
            self._in_step = command.motion > 0
            if self._in_step:
                self._group.join(command.motion, command.partners, 0)
            return None
        assert isinstance(command, StreamPosition)
        if (refusal := self.not_in_range(command.q)) is not None:
            return refusal
        if not isfinite(command.stamp_s):
            return StampNotFinite(command.stamp_s)
        if not continues or self.phase is not Phase.MOVE:
            self._start(state)
        late_s = self._take(command.q, command.stamp_s, state.now_ns)
        return None if late_s is None else StreamPointDropped(late_s)

    def put(self, state: ArmState, bits: int, stamp_s: float, numbers: Sequence[float]) -> None:
        """Follow a setpoint of the open stream; an invalid one ends the stream.

        Args:
            state: of the arm.
            bits: `SETPOINT_...` of `rtcp.ipc.layout`.
            stamp_s: clock of the sender, s.
            numbers: 3 x `MOST_AXES`: positions, rad, velocities, rad/s, accelerations, rad/s^2.
        """
        if bits & SETPOINT_ENDS:
            if self._in_step:
                self._group.phase, self._in_step = StepPhase.DONE, False
            self.stop(state)
            return
        low, high = self.limits.low, self.limits.high
        for i in self._joints:
            q = numbers[i]
            if not isfinite(q + numbers[MOST_AXES + i] + numbers[2 * MOST_AXES + i] + stamp_s):
                self._end(state, SetpointNotFinite(i))
                return
            if not low[i] <= q <= high[i]:
                self._end(state, SetpointOutOfRange(i, q, high[i] if q > high[i] else low[i]))
                return
        late_s = self._take(numbers[: len(low)], stamp_s, state.now_ns)
        if late_s is not None:
            self._end(state, SetpointOutOfOrder(late_s))
            return
        if bits & SETPOINT_HAS_VELOCITY:
            speed, rate, limits, rates = self._speed, self._rate, self.limits.velocity, self.limits.acceleration
            for i in self._joints:
                bound, v = limits[i] * _INSIDE, numbers[MOST_AXES + i]
                speed[i] = bound if v > bound else -bound if v < -bound else v
                bound, a = rates[i], numbers[2 * MOST_AXES + i] if bits & SETPOINT_HAS_ACCELERATION else 0.0
                rate[i] = bound if a > bound else -bound if a < -bound else a

    def _end(self, state: ArmState, ended: MotionEnded) -> None:
        self.ended = ended
        self.brake(state)

    def hold(self) -> None:
        """End the motion at the current setpoints."""
        super().hold()
        self._leave()

    def brake(self, state: ArmState) -> None:
        """Bring each joint to rest; ends an open stream."""
        super().brake(state)
        self._leave()

    def _leave(self) -> None:
        self.stream = 0
        if self._in_step:
            self._group.leave()
            self._in_step = False

    def _start(self, state: ArmState) -> None:
        self.begin()
        self._leave()
        self._rate[:] = self._zero
        self._first, self._interval_s = True, 0.0
        self._came_ns = state.now_ns
        self._fresh = self._tracks = False
        self._wanted = list(state.commanded)
        self._speed = list(self._zero)

    def _take(self, q: Sequence[float], stamp_s: float, now_ns: int) -> float | None:
        """Accept a target, or drop it and return its lateness, s."""
        lag = now_ns * 1e-9 - stamp_s
        step = stamp_s - self._stamp_s
        if not self._first:
            if step <= 0.0:
                return min(-step, _MOST_LATE_S)
            # The least lag is the clock difference: the excess over it is the lateness of a target.
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
        """Estimate the interval, and the target's speed over 10 to 20 ms or over a longer last interval."""
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
        if self._in_step:
            if self._group.is_finished():
                # The commander closed the stream of one arm: that ends all.
                self._group.phase, self._in_step = StepPhase.DONE, False
                self.stop(state)
                return self.update(state)
            ended = self._group.lost(state.now_ns, not self._first)
            if ended is not None:
                return self.give_up(state, ended)
        if state.now_ns - self._came_ns > _TIMEOUT_NS and not self._first:
            return self.give_up(state, StreamEnded())
        if self._in_step and (self._group.phase is StepPhase.ARMED or self._group.waiting() >= 0):
            return self.rest(state)
        if self._fresh:
            self._fresh = False
            self._aim(state)
        elif not self._tracks:
            # It rests at the last target.
            return self.rest(state)
        elif self._keeps_speed and not self._may_go_on(state):
            self._begin(state)
            self._tracks = self._plan(self._wanted, self._zero)
        if not self._tracks:
            return self.give_up(state, ControllerFailed())
        self._elapsed_s += self._period_s
        # After its end the motion continues at the target's speed.
        target.position, target.velocity, self._acceleration = self._trajectory.at_time(self._elapsed_s)
        self._last = target.position
        self._tracks = self._elapsed_s < self._trajectory.duration or self._keeps_speed
        return target

    def _is_own(self, state: ArmState) -> bool:
        """Whether the state is the last setpoint of the current plan, unchanged by the guards."""
        return self._tracks and state.commanded == self._last

    def _begin(self, state: ArmState) -> None:
        """Set the state and the limits in force as the start of the next plan."""
        inp, limits = self._inp, self.limits
        inp.current_position, inp.current_velocity = state.commanded, state.commanded_velocity
        # Unless a guard cut the setpoint, the plan's own acceleration is more exact.
        inp.current_acceleration = allowed_accelerations(
            self._acceleration if self._is_own(state) else state.commanded_acceleration,
            state, limits.velocity, limits.acceleration, limits.jerk,
        )  # fmt: skip
        inp.max_velocity = [max(b, abs(v)) for b, v in zip(limits.velocity, state.commanded_velocity, strict=True)]
        inp.max_acceleration = limits.acceleration

    def _aim(self, state: ArmState) -> None:
        """Plan to meet the newest target, assumed at constant speed; if that is impossible, to rest at it."""
        wanted, speed, limits = self._wanted, self._speed, self.limits
        bounds = (*limits.velocity, *limits.acceleration, *limits.jerk)
        moves = any(speed)
        # Replanning to the same goal may, by rounding, choose a profile that overshoots.
        if not moves and self._is_own(state) and self._inp.target_position == wanted and bounds == self._bounds:
            return
        self._bounds = bounds
        self._begin(state)
        if moves:
            duration = self._time_to_meet(state)
            ahead = duration + self._late_s
            for i in self._joints:
                # At the meeting point the joint must still be able to stop inside its range.
                v, most = speed[i], self._stoppable(i, speed[i], wanted[i], ahead)
                speed[i] = most if v > most else -most if v < -most else v
            rate = self._rate
            meets = [wanted[i] + (speed[i] + 0.5 * rate[i] * ahead) * ahead for i in self._joints]
            if any(rate):
                for i in self._joints:
                    v, most = speed[i] + rate[i] * ahead, self._stoppable(i, speed[i], meets[i])
                    speed[i] = most if v > most else -most if v < -most else v
            if self._plan(meets, speed, duration) and leaves_range(self._trajectory, state.commanded, limits) is None:
                self._tracks = True
                return
        self._tracks = self._plan(wanted, self._zero)

    def _time_to_meet(self, state: ArmState) -> float:
        """Return the shortest time to meet the moving target, with a margin, s; at most 0.2 s."""
        relative, wanted, speed, n = self._relative, self._wanted, self._speed, self._joints
        q, v, late_s, most = state.commanded, state.commanded_velocity, self._late_s, self._inp.max_velocity
        relative.current_position = [q[i] - wanted[i] - speed[i] * late_s for i in n]
        relative.current_velocity = [v[i] - speed[i] for i in n]
        relative.current_acceleration = self._inp.current_acceleration
        relative.max_velocity = [most[i] - speed[i] for i in n]
        relative.min_velocity = [-most[i] - speed[i] for i in n]
        relative.max_acceleration = self.limits.acceleration
        if not find_trajectory(self._otg, relative, self.limits.jerk, self._catch_up):
            # The target moves at the joint's speed limit.
            return _LOOK_AHEAD_S
        duration: float = self._catch_up.duration
        return min(_LOOK_AHEAD_S, _AT_LEAST_S + _LONGER * duration)

    def _plan(self, position: list[float], velocity: list[float], duration_s: float | None = None) -> bool:
        """Plan to a position, rad, and velocity, rad/s, with a minimum duration; return whether a plan exists."""
        inp = self._inp
        self._keeps_speed = any(velocity)
        inp.target_position, inp.target_velocity, inp.minimum_duration = position, velocity, duration_s
        self._elapsed_s = 0.0
        return find_trajectory(self._otg, inp, self.limits.jerk, self._trajectory)

    def _may_go_on(self, state: ArmState) -> bool:
        """Whether the next target may merely be late, and the joints can still stop inside their ranges."""
        if (state.now_ns - self._came_ns) * 1e-9 > _LATE * self._interval_s:
            return False
        if self._elapsed_s < self._trajectory.duration:
            return True
        speed, position = self._speed, state.commanded
        for i in self._joints:  # noqa: SIM110  a generator allocates in the cycle
            if abs(speed[i]) > self._stoppable(i, speed[i], position[i]):
                return False
        return True

    def _stoppable(self, i: int, v: float, position: float, kept_s: float = 0.0) -> float:
        """Return the highest speed towards v, rad/s, held for `kept_s`, that still stops inside the range."""
        limits = self.limits
        distance = limits.high[i] - position if v > 0.0 else position - limits.low[i]
        return stoppable_speed(0.9 * distance, limits.acceleration[i], limits.jerk[i], kept_s)
