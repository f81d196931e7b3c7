"""The last place before the drives: no target outside a limit passes, whatever asked for it.

Promises 1 and 2 of the design: position inside the joint's range, no step beyond speed x cycle, speed and torque
inside their bounds, never a number that is none; and no target velocity that changes by more than acceleration x cycle,
whatever the position loop that is closed in CSV makes of a disturbance.
"""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.motion.limits import Limits
from rtcp.motion.modes import Commanded


class Guard:
    """Clamps the targets of all drives, once a cycle, after the mode.

    `held` is a bit mask of the joints whose target was changed in the last call.
    """

    def __init__(self, limits: Limits, period_s: float) -> None:
        self._period_s = period_s
        self.take(limits)
        self._last = [0.0] * len(self._low)
        self._velocity = [0.0] * len(self._low)
        self.held = 0

    def take(self, limits: Limits) -> None:
        """Check against other limits from now on."""
        self._low, self._high = limits.low, limits.high
        self._speed, self._torque = limits.velocity, limits.torque
        # Rounding of the set-points is no violation.
        self._change = [acceleration * self._period_s for acceleration in limits.acceleration]
        self._step = [velocity * self._period_s * (1 + 1e-6) for velocity in limits.velocity]

    def latch(self, axis: int, position: float) -> None:
        """Take `position` (rad) as the target sent last: while a drive has no torque, its target is where it is."""
        self._last[axis] = position
        self._velocity[axis] = 0.0

    def check(self, drives: Sequence[Commanded]) -> None:
        """Clamp every target of every drive in place."""
        last = self._last
        held = 0
        for i, drive in enumerate(drives):
            wanted = drive.target_position
            before = last[i]
            step = self._step[i]
            low = max(self._low[i], before - step)
            high = min(self._high[i], before + step)
            if low > high:
                # The last target lay outside the range: step by step back into it.
                low = high = before - step if before > self._high[i] else before + step
            # A comparison with NaN is false: what is no number fails the first test and the target stays.
            if not (low <= wanted <= high):
                held |= 1 << i
                wanted = high if wanted > high else low if wanted < low else min(max(before, low), high)
            last[i] = drive.target_position = wanted
            speed = drive.target_velocity
            bound = self._speed[i]
            if not (-bound <= speed <= bound):
                held |= 1 << i
                speed = bound if speed > bound else -bound if speed < -bound else 0.0
            torque = drive.target_torque
            bound = self._torque[i]
            if not (-bound <= torque <= bound):
                held |= 1 << i
                torque = bound if torque > bound else -bound if torque < -bound else 0.0
            # Beyond the range nothing drives further out.
            if drive.position > self._high[i]:
                outward = speed > 0.0 or torque > 0.0
                speed, torque = min(speed, 0.0), min(torque, 0.0)
            elif drive.position < self._low[i]:
                outward = speed < 0.0 or torque < 0.0
                speed, torque = max(speed, 0.0), max(torque, 0.0)
            else:
                outward = False
            if outward:
                held |= 1 << i
            before, change = self._velocity[i], self._change[i]
            if speed > before + change:
                speed = before + change
            elif speed < before - change:
                speed = before - change
            self._velocity[i] = drive.target_velocity = speed
            drive.target_torque = torque
        self.held = held
