"""The guards of the set-points: behind every mode, before the law of the drives.

For each joint the next speed is within its limit, differs from the last by no more than acceleration x cycle, and leaves
room to stop inside the range: with the mean speed w of a cycle and u = a dt, a stop that begins in the next cycle comes to
rest after w^2 / (2 a) - w dt / 2, so that w <= sqrt(u^2 / 4 + 2 a (high - q)) - u / 2. Whoever keeps to this once can keep to
it for ever: w - u fulfils it in the next cycle. The boxes are kept in the same way: a set-point is passed on only if the
stop from it touches none, so that the stop from the last one, which was examined a cycle ago, is always at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from math import sqrt

from kinematics.forward import frames
from kinematics.pose import Pose
from rtcp.config.model import ArmConfig
from rtcp.motion.limits import Limits
from rtcp.motion.state import MotionState, Reason, Target
from rtcp.motion.zones import Zones

_ROUNDING = 1e-6
"""Part of a limit by which a target may pass it: the generators' own arithmetic."""
_ROUNDING_RAD_S = 1e-7
_SAME_RAD_S = 1e-9


class Verdict(IntEnum):
    """What became of a target."""

    PASS = 0
    CLAMPED = 1
    STOPPING = 2
    """The guard brakes; targets are not looked at until the arm stands."""
    STOPPED = 3
    """The guard's stop has come to rest in this cycle."""


class SetPointGuard:
    """Guards the set-points of one arm.

    After a cut, `held` is the bit mask of the joints that were clamped, and `code`, `axis`, `value` and `limit` say what the
    guard's stop was for.

    Args:
        config: the arm; without its geometry no box is looked at.
        limits: read every cycle.
        dt: the cycle, s.
    """

    def __init__(self, config: ArmConfig, limits: Limits, dt: float) -> None:
        n = len(config.joints)
        self._limits = limits
        self._dt = dt
        self._model = config.arm
        self.zones = None if config.arm is None else Zones(config.arm, limits)
        self._joints = range(n)
        self._mean = [0.0] * n
        """Mean speed of each joint in the last cycle: what its acceleration is counted from."""
        self._next = [0.0] * n
        self._position = [0.0] * n
        self._distance = 1e9
        self.poses: Sequence[Pose] = ()
        """`frames` of what is commanded; empty without geometry or boxes."""
        self.stopping = False
        self.held = 0
        self.code = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0

    def latch(self, state: MotionState) -> None:
        """Begin at rest where `state` is."""
        for i in self._joints:
            self._mean[i] = state.velocity[i] = state.acceleration[i] = 0.0
        self.stopping = False
        self.held = 0
        if self.zones is not None and self._model is not None:
            self.poses = frames(self._model, state.position)
            self._distance = self.zones.distance(self.poses)[0]

    def zone_at(self, q: Sequence[float]) -> int | None:
        """Return the number of the box (`zones`) whose bounds the arm would pass at `q` (rad), or None."""
        if self.zones is None or self._model is None:
            return None
        distance, which = self.zones.distance(frames(self._model, q))
        return which if distance < 0.0 else None

    def probe(self, state: MotionState, position: Sequence[float], velocity: Sequence[float]) -> bool:
        """Return whether a target would pass as it is."""
        return not self._bound(state, position) and self._free(position, self._next) is None

    def apply(self, state: MotionState, target: Target, clamps: bool) -> Verdict:
        """Write what may be commanded of `target` into `state`: position, velocity, acceleration.

        Args:
            state: what was commanded in the last cycle.
            target: what the mode wants; numbers that are none are cut as any other.
            clamps: whether the mode lives with a target that is cut; otherwise a cut is the begin of a stop.
        """
        if self.stopping:
            return self._brake(state)
        self.held = held = self._bound(state, target.position)
        if held and not clamps:
            return self._stop(state, Reason.JOINT_LIMIT, *self._excess(state, target.position))
        position, mean, dt = self._position, self._next, self._dt
        wanted = target.position
        for i in self._joints:
            position[i] = state.position[i] + mean[i] * dt if held >> i & 1 else wanted[i]
        touched = self._free(position, mean)
        if touched is not None:
            return self._stop(state, Reason.KEEP_OUT, touched[0], touched[1], 0.0)
        speeds = target.velocity
        for i in self._joints:
            speed = mean[i] if held >> i & 1 or not abs(speeds[i] - mean[i]) < 1.0 else speeds[i]
            state.acceleration[i] = (speed - state.velocity[i]) / dt
            state.velocity[i] = speed
            state.position[i] = position[i]
            self._mean[i] = mean[i]
        return Verdict.CLAMPED if held else Verdict.PASS

    def _bound(self, state: MotionState, wanted: Sequence[float]) -> int:
        """Put the allowed mean speeds into `_next`; return the mask of the joints whose target was cut."""
        limits, dt, last, allowed = self._limits, self._dt, self._mean, self._next
        held = 0
        for i in self._joints:
            q, v, rate = state.position[i], last[i], limits.acceleration[i]
            u = rate * dt
            fastest = limits.velocity[i]
            up, down = limits.high[i] - q, q - limits.low[i]
            quarter = 0.25 * u * u
            high = sqrt(quarter + 2.0 * rate * up) - 0.5 * u if up > 0.0 else 0.0
            low = 0.5 * u - sqrt(quarter + 2.0 * rate * down) if down > 0.0 else 0.0
            if high > fastest:
                high = fastest
            if low < -fastest:
                low = -fastest
            # No joint slows down faster than it may: what is beyond a limit comes back at that rate.
            if high < v - u:
                high = v - u
            elif high > v + u:
                high = v + u
            if low > v + u:
                low = v + u
            elif low < v - u:
                low = v - u
            w = (wanted[i] - q) / dt
            slack = _ROUNDING * (fastest if fastest < u else u) + _ROUNDING_RAD_S
            if low - slack <= w <= high + slack:
                allowed[i] = w
                continue
            held |= 1 << i
            # A comparison with NaN is false: what is no number brakes.
            allowed[i] = high if w > high else low if w < low else min(max(0.0, low), high)
        return held

    def _free(self, position: Sequence[float], velocity: Sequence[float]) -> tuple[int, float] | None:
        zones, model = self.zones, self._model
        if zones is None or model is None or not zones.any or not any(velocity):
            return None
        poses = frames(model, position)
        touched = zones.blocked(position, velocity, poses, self._distance, self._limits.acceleration)
        if touched is None:
            self.poses = poses
            self._distance = zones.distance(poses)[0]
        return touched

    def _excess(self, state: MotionState, wanted: Sequence[float]) -> tuple[int, float, float]:
        """Return the first joint that was cut, what was wanted of it and what is allowed."""
        axis = (self.held & -self.held).bit_length() - 1
        target, limits = wanted[axis], self._limits
        if target > limits.high[axis]:
            return axis, target, limits.high[axis]
        if target < limits.low[axis]:
            return axis, target, limits.low[axis]
        return axis, (target - state.position[axis]) / self._dt, self._next[axis]

    def _stop(self, state: MotionState, code: Reason, axis: int, value: float, limit: float) -> Verdict:
        self.stopping = True
        self.code, self.axis, self.value, self.limit = code, axis, value, limit
        return self._brake(state)

    def _brake(self, state: MotionState) -> Verdict:
        limits, dt, mean = self._limits, self._dt, self._mean
        moving = False
        for i in self._joints:
            v, u = mean[i], limits.acceleration[i] * dt
            w = v - u if v > u else v + u if v < -u else 0.0
            state.acceleration[i] = (w - v) / dt
            state.position[i] += w * dt
            state.velocity[i] = mean[i] = w
            moving = moving or abs(w) > _SAME_RAD_S
        if self.zones is not None and self._model is not None and self.zones.any:
            self.poses = frames(self._model, state.position)
            self._distance = self.zones.distance(self.poses)[0]
        if moving:
            return Verdict.STOPPING
        self.stopping = False
        for i in self._joints:
            state.velocity[i] = state.acceleration[i] = mean[i] = 0.0
        return Verdict.STOPPED
