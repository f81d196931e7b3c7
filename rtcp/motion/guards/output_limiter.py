"""Last check before the drives: clamps every target to its limits, whatever its origin.

Position inside the joint's range, no step beyond speed x cycle, speed and torque inside their bounds, finite numbers
only; no change of target velocity beyond acceleration x cycle, whatever the position loop closed in CSV makes of a
disturbance. A joint that was enabled outside its range returns slowly. Outside its range no torque accelerates a joint
further out; the torque that carries its weight stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign, isnan
from typing import Final

from rtcp.motion.drive_writers import Commanded
from rtcp.motion.guards.braking import fastest_stoppable
from rtcp.motion.limits import Limits
from rtcp.motion.tool_in_use import Gravity

BACK_RAD_S: Final = 0.05
"""Speed limit of the uncommanded return of a joint into its range, rad/s. At a reach of 1.3 m it is 65 mm/s, below the
250 mm/s of reduced speed (ISO 10218-1)."""
_FADE_RAD: Final = 0.003
"""Distance from the range, rad, over which an outward torque fades to the joint's weight. A torque that is cut at the
edge would let a joint whose weight pulls inward fall and catch it, again and again."""
_BRAKING: Final = 4.0
"""Damping of a joint that still moves outward there, as a multiple of `cst_damping`."""


class OutputLimiter:
    """Clamps the targets of all drives, once a cycle, after the drive writer.

    `held` is a bit mask of the joints whose target was clamped in the last call; `sent` has the last target positions,
    rad.

    Args:
        limits: of the joints.
        period_s: cycle time, s.
        damping: by which the outward torque of a joint outside its range depends on its velocity, Nm s/rad; empty: 0.
        gravity: weight of the joints; None: unknown.
    """

    def __init__(
        self, limits: Limits, period_s: float, damping: Sequence[float] = (), gravity: Gravity | None = None
    ) -> None:
        self._period_s = period_s
        self._damping = list(damping) or [0.0] * len(limits.low)
        self.gravity = gravity
        self.take(limits)
        self.sent = [0.0] * len(self._low)
        self._pace = [0.0] * len(self._low)
        """Present return speed of each joint outside its range, rad/s; 0 for all others."""
        self._velocity = [0.0] * len(self._low)
        self.held = 0

    def take(self, limits: Limits) -> None:
        """Replace the limits."""
        self._low, self._high = limits.low, limits.high
        self._speed, self._torque = limits.velocity, limits.torque
        # Rounding of setpoints is not a violation.
        self._change = [acceleration * self._period_s for acceleration in limits.acceleration]
        self._step = [velocity * self._period_s * (1 + 1e-6) for velocity in limits.velocity]
        self._back = [min(BACK_RAD_S, velocity) for velocity in limits.velocity]

    def latch(self, axis: int, position: float, velocity: float = 0.0) -> None:
        """Set the last targets, rad and rad/s: without torque, and in CST, the joint is not at its target."""
        self.sent[axis] = position
        self._pace[axis], self._velocity[axis] = 0.0, velocity

    def check(self, drives: Sequence[Commanded]) -> None:
        """Clamp every target of every drive in place."""
        sent, lows, highs, steps, changes = self.sent, self._low, self._high, self._step, self._change
        fastest, strongest, velocity = self._speed, self._torque, self._velocity
        held = 0
        for i, drive in enumerate(drives):
            wanted, before, lowest, highest, step = drive.target_position, sent[i], lows[i], highs[i], steps[i]
            # A comparison with NaN is false: NaN is clamped too, and the target stays.
            if not (lowest <= wanted <= highest and lowest <= before <= highest and -step <= wanted - before <= step):
                allowed = self._allowed(i, wanted)
                if allowed != wanted:
                    held |= 1 << i
                    drive.target_position = wanted = allowed
            sent[i] = wanted
            speed = drive.target_velocity
            if speed == 0.0 == drive.target_torque and velocity[i] == 0.0:
                continue  # as in CSP: zero is inside every bound
            bound = fastest[i]
            if not (-bound <= speed <= bound):
                held |= 1 << i
                speed = bound if speed > bound else -bound if speed < -bound else 0.0
            torque = drive.target_torque
            bound = strongest[i]
            if not (-bound <= torque <= bound):
                held |= 1 << i
                torque = bound if torque > bound else -bound if torque < -bound else 0.0
            # Outside the range no target leads further out.
            position = drive.position
            if not lowest <= position <= highest:
                side = 1.0 if position > highest else -1.0
                if speed * side > 0.0:
                    held |= 1 << i
                    speed = 0.0
                if torque * side > 0.0:
                    outward = self._outward(i, drives, side, position - highest if side > 0.0 else lowest - position)
                    if torque * side > outward:
                        held |= 1 << i
                        torque = side * outward
            before, change = velocity[i], changes[i]
            if speed > before + change:
                speed = before + change
            elif speed < before - change:
                speed = before - change
            velocity[i] = drive.target_velocity = speed
            drive.target_torque = torque
        self.held = held

    def _outward(self, i: int, drives: Sequence[Commanded], side: float, beyond: float) -> float:
        """Return the largest outward torque, Nm, of a joint that is `beyond` rad outside its range."""
        weight = 0.0
        if self.gravity is not None:
            weight = max(side * self.gravity.torques([drive.position for drive in drives])[i], 0.0)
        share = max(1.0 - beyond / _FADE_RAD, 0.0)
        velocity = side * drives[i].velocity
        braking = self._damping[i] * velocity * (_BRAKING * (1.0 - share) if velocity > 0.0 else 1.0)
        return max(weight + share * max(self._torque[i] - weight, 0.0) - braking, 0.0)

    def _allowed(self, i: int, wanted: float) -> float:
        """Return the allowed target nearest to `wanted`, rad; for NaN the last target."""
        before, lowest, highest = self.sent[i], self._low[i], self._high[i]
        if not lowest <= before <= highest:
            return self._led_back(i)
        if isnan(wanted):
            return before
        step = self._step[i]
        return min(max(wanted, lowest, before - step), highest, before + step)

    def _led_back(self, i: int) -> float:
        """Return the next target, rad, of a joint whose last target was outside its range: nearer to the edge.

        The first one after `latch` equals the last. Then the speed rises and falls under the joint's acceleration,
        up to `BACK_RAD_S` or the joint's own limit.
        """
        before, dt = self.sent[i], self._period_s
        edge = self._high[i] if before > self._high[i] else self._low[i]
        pace = self._pace[i]
        remaining = max(abs(before - edge) - pace * dt, 0.0)
        change = self._change[i]
        self._pace[i] = min(pace + change, self._back[i], fastest_stoppable(remaining, change, dt))
        return edge + copysign(remaining, before - edge)
