"""Jerk-limited joint motion (ruckig): move to a configuration, come to rest.

The commanded position is always continuous: every motion begins at the last setpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Final

from ruckig import (
    ControlInterface,
    InputParameter,
    OutputParameter,
    Result,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from rtcp.motion.limits import Limits
from rtcp.motion.speed_override import SpeedOverride, TimeScale
from rtcp.motion.state import ArmState, Phase, Setpoint

LONGEST_S: Final = 600.0
"""Upper bound on the duration of a move, s; ruckig's own arithmetic fails at about 7600 s."""
# ruckig finds no solution for a distance exactly between two profiles, as 2 a^3 / j^2: a little more jerk avoids it.
# Less jerk would let a joint at its speed limit exceed the limit.
_JERK_SCALES = (1.0, 1.0 + 1e-4, 1.0 + 1e-3, 1.0 - 1e-2)
_SLACK: Final = 1e-6
"""Tolerance of a range for rounding, rad."""
_INSIDE = 1.0 - 1e-6
"""A state cut by a guard may exceed a limit by rounding; ruckig does not accept it."""


def allowed_acceleration(acceleration: float, speed: float, fastest: float, most: float, jerk: float) -> float:
    """Return the acceleration, rad/s^2, limited to `most` and so that the speed does not exceed `fastest`.

    An acceleration a that falls to 0 at the jerk j still adds a^2 / 2j to the speed.
    """
    outward = acceleration if speed >= 0.0 else -acceleration
    bound = most
    if outward > 0.0:
        margin = fastest - (speed if speed >= 0.0 else -speed)
        rising = sqrt(2.0 * jerk * margin) if margin > 0.0 else 0.0
        bound = rising if rising < most else most
    bound *= _INSIDE
    return bound if acceleration > bound else -bound if acceleration < -bound else acceleration


def allowed_accelerations(
    acceleration: Sequence[float],
    state: ArmState,
    fastest: Sequence[float],
    most: Sequence[float],
    jerk: Sequence[float],
) -> list[float]:
    """Return `allowed_acceleration` of every joint of a state; the acceleration and the bounds of shape (n,)."""
    speed = state.commanded_velocity
    return [allowed_acceleration(a, speed[i], fastest[i], most[i], jerk[i]) for i, a in enumerate(acceleration)]


def stoppable_speed(distance: float, acceleration: float, jerk: float, kept_s: float = 0.0) -> float:
    """Return the speed, rad/s, held for `kept_s`, that stops within `distance` rad, after an acceleration ramp.

    v kept + v^2 / 2a + v a / 2j = distance, solved for v.
    """
    if not distance > 0.0:
        return 0.0
    ramp = acceleration * (0.5 * acceleration / jerk + kept_s)
    return sqrt(ramp * ramp + 2.0 * acceleration * distance) - ramp


def find_trajectory(otg: Ruckig, inp: InputParameter, jerk: Sequence[float], trajectory: Trajectory) -> bool:
    """Calculate a trajectory with approximately this jerk, shape (n,), rad/s^3; return whether one exists."""
    for scale in _JERK_SCALES:
        inp.max_jerk = [scale * limit for limit in jerk]
        try:
            if otg.calculate(inp, trajectory) >= 0:
                return True
        except (RuckigError, ValueError):
            # ruckig raises if its algorithm fails, or if its binding does not know the result code.
            continue
    return False


def leaves_range(trajectory: Trajectory, begin: Sequence[float], limits: Limits) -> tuple[int, float] | None:
    """Return the first joint that leaves its range, and its extreme, rad; None: all stay inside.

    A joint that starts outside, by a rounding of the guards, must not move further out.
    """
    extrema, low, high = trajectory.position_extrema, limits.low, limits.high
    for i, here in enumerate(begin):
        least, largest = extrema[i].min, extrema[i].max
        further = limits.velocity[i] * trajectory.duration
        if least - further < low[i] or largest + further > high[i]:
            # ruckig omits zero crossings of the speed at constant acceleration.
            profile = trajectory.profiles[0][i]
            p, v, a, j = profile.p, profile.v, profile.a, profile.j
            for k in range(len(j)):
                if j[k] == 0.0 and v[k] * v[k + 1] < 0.0:
                    extremum = p[k] - 0.5 * v[k] * v[k] / a[k]
                    least, largest = min(least, extremum), max(largest, extremum)
        if least < min(low[i], here) - _SLACK:
            return i, least
        if largest > max(high[i], here) + _SLACK:
            return i, largest
    return None


class JointMotion:
    """A motion of `n` joints, one `update` a cycle: HOLD at rest, MOVE to a configuration, STOP while braking.

    Args:
        period_s: cycle time, s.
        velocity, acceleration, jerk: bounds of each joint, shape (n,), rad/s, rad/s^2, rad/s^3; read at the start of
            a motion and kept to its end.
        speed_override: of moves; None: always 1.
    """

    def __init__(
        self,
        period_s: float,
        velocity: Sequence[float],
        acceleration: Sequence[float],
        jerk: Sequence[float],
        speed_override: SpeedOverride | None = None,
    ) -> None:
        n = len(velocity)
        self._otg = Ruckig(n, period_s)
        self._output = OutputParameter(n)
        self._plan, self._spare = Trajectory(n), Trajectory(n)
        # Double buffer: a new plan replaces the current one only if planning succeeds.
        self._inputs = [InputParameter(n), InputParameter(n), InputParameter(n)]
        self._stop = self._inputs[2]
        self._stop.control_interface = ControlInterface.Velocity
        # Every joint stops as fast as it may: stopping matters more than the path.
        self._stop.synchronization = Synchronization.No
        self._zero = [0.0] * n
        self._active = self._inputs[0]
        self._target = Setpoint(n)
        self._velocity_limit, self._acceleration_limit, self._jerk_limit = velocity, acceleration, jerk
        self._period_s = period_s
        self._speed_override = speed_override or SpeedOverride()
        self._time_scale = TimeScale()
        self._is_scaled = False
        """True once the move has been slower than planned: from then on it samples its own plan."""
        self.phase = Phase.HOLD
        self.failed = False
        """True after ruckig refused its input; the setpoints stand since."""
        self.duration_s = 0.0
        self.elapsed_s = 0.0

    def hold(self) -> None:
        """Hold the present state; only at standstill."""
        self.phase = Phase.HOLD
        self.failed = False

    def move_to(self, state: ArmState, target: Sequence[float], speed: float, *, synchronized: bool = True) -> bool:
        """Move to `target` (rad, shape (n,)); return False if no plan is found.

        Without a plan, or with one longer than `LONGEST_S`, the current motion continues.

        Args:
            state: initial state of the motion.
            target: inside the joint limits; the caller checks it.
            speed: bound of every joint's speed, rad/s, besides each joint's own limit.
            synchronized: all joints arrive together; otherwise each as soon as it can.
        """
        move = self._inputs[1] if self._active is self._inputs[0] else self._inputs[0]
        self._carry_over(move, state)
        move.synchronization = Synchronization.Time if synchronized else Synchronization.No
        move.target_position = list(target)
        move.target_velocity = self._zero
        # A joint that is faster than the new bound needs room to slow down.
        move.max_velocity = [
            max(min(speed, limit), abs(now))
            for limit, now in zip(self._velocity_limit, move.current_velocity, strict=True)
        ]  # fmt: skip
        if not find_trajectory(self._otg, move, self._jerk_limit, self._spare) or self._spare.duration > LONGEST_S:
            return False
        self._plan, self._spare = self._spare, self._plan
        self._active = move
        self._begin(Phase.MOVE)
        return True

    @property
    def planned_duration_s(self) -> float:
        """Duration of the last move, s."""
        return float(self._plan.duration)

    def planned_position(self, time_s: float) -> tuple[float, ...]:
        """Return the joint positions of the last move at a time since its start; outside the cycle."""
        position, _, _ = self._plan.at_time(time_s)
        return tuple(position)

    def stop(self, state: ArmState) -> None:
        """Come to rest under the acceleration and jerk limits; at rest, cancel a move that has not begun."""
        if self.phase is Phase.STOP:
            return
        if not (any(state.commanded_velocity) or any(state.commanded_acceleration)):
            self.hold()
            return
        self._carry_over(self._stop, state)
        self._stop.max_velocity = self._velocity_limit
        self._stop.max_jerk = self._jerk_limit
        self._stop.target_velocity = self._zero
        self._active = self._stop
        self._begin(Phase.STOP)

    def _begin(self, phase: Phase) -> None:
        self.phase = phase
        self.failed = False
        self.elapsed_s = 0.0
        self._is_scaled = False

    def _carry_over(self, inp: InputParameter, state: ArmState) -> None:
        inp.current_position = state.commanded
        inp.current_velocity = state.commanded_velocity
        bounds, target, now = self._acceleration_limit, self._target, state.commanded_acceleration
        inp.max_acceleration = bounds
        if self.phase and state.commanded == target.position and state.commanded_velocity == target.velocity:
            # No guard cut the setpoint: use ruckig's own acceleration. With the state's mean of the last cycle, a
            # joint that brakes for the end of its range would come to rest beyond it.
            now = self._active.current_acceleration
        inp.current_acceleration = allowed_accelerations(now, state, self._velocity_limit, bounds, self._jerk_limit)
        inp.target_acceleration = self._zero

    def update(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle; if ruckig refuses, they stand and `failed` is set."""
        target = self._target
        if not self.phase:
            target.position = state.commanded
            target.velocity = self._zero
            return target
        if self._is_scaled or (self._speed_override.fraction != 1.0 and self.phase is Phase.MOVE):
            return self._follow_plan(state)
        output = self._output
        try:
            result = self._otg.update(self._active, output)
        except (RuckigError, ValueError):
            result = Result.Error
        if result < 0:
            target.position = state.commanded
            target.velocity = self._zero
            self.phase = Phase.HOLD
            self.failed = True
            return target
        target.position = output.new_position
        target.velocity = output.new_velocity
        self.duration_s = output.trajectory.duration
        self.elapsed_s = output.time
        if result == Result.Finished:
            target.velocity = self._zero
            self.phase = Phase.HOLD
        else:
            output.pass_to_input(self._active)
        return target

    def _follow_plan(self, state: ArmState) -> Setpoint:
        """Return the setpoints of the next cycle at the speed override: the same path at a slower path time."""
        target, plan, scale, dt = self._target, self._plan, self._time_scale, self._period_s
        if not self._is_scaled:
            from_rest = self.elapsed_s == 0.0 and not any(state.commanded_velocity)
            scale.begin(self._speed_override.fraction if from_rest else 1.0)
            self._is_scaled, self.duration_s = True, plan.duration
        before, goal = scale.speed, self._speed_override.fraction
        speed = 1.0
        if not goal == before == 1.0:
            # The end point of the cycle hardly depends on the change of u.
            _, along, _ = plan.at_time(self.elapsed_s + (before + 0.5 * scale.rate * dt) * dt)
            bounds, jerk = self._acceleration_limit, self._jerk_limit
            speed = scale.step(goal, along, state.commanded_velocity, bounds, jerk, dt)
        self.elapsed_s = min(self.elapsed_s + 0.5 * (before + speed) * dt, self.duration_s)
        target.position, along, bend = plan.at_time(self.elapsed_s)
        target.velocity = [speed * v for v in along]
        # Initial state of a stop or of another move.
        rate = scale.rate
        self._active.current_acceleration = [speed * speed * a + rate * v for a, v in zip(bend, along, strict=True)]
        if self.elapsed_s >= self.duration_s:
            target.velocity = self._zero
            self.phase = Phase.HOLD
        return target
