"""The last place before the drives: no target outside a limit passes, whatever asked for it.

Position inside the joint's range, no step beyond speed x cycle, speed and torque inside their bounds, finite numbers
only; and no target velocity that changes by more than acceleration x cycle,
whatever the position loop that is closed in CSV makes of a disturbance. A joint that was enabled outside its range is
led back into it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign, isnan
from typing import Final

from rtcp.motion.drive_writers import Commanded
from rtcp.motion.guards.braking import fastest_stoppable
from rtcp.motion.limits import Limits

BACK_RAD_S: Final = 0.05
"""A joint that stands beyond its range is led back to the edge no faster: nobody has asked it to move. At a reach of
1.3 m it is 65 mm/s, below the 250 mm/s of reduced speed (ISO 10218-1)."""


class OutputLimiter:
    """Clamps the targets of all drives, once a cycle, after the mode.

    `held` is a bit mask of the joints whose target was changed in the last call; `sent` are the target positions sent
    last, rad.
    """

    def __init__(self, limits: Limits, period_s: float) -> None:
        self._period_s = period_s
        self.take(limits)
        self.sent = [0.0] * len(self._low)
        self._pace = [0.0] * len(self._low)
        """Speed, rad/s, of the next step back of a joint that is led back into its range; 0 of all others."""
        self._velocity = [0.0] * len(self._low)
        self.held = 0

    def take(self, limits: Limits) -> None:
        """Check against other limits from now on."""
        self._low, self._high = limits.low, limits.high
        self._speed, self._torque = limits.velocity, limits.torque
        # Rounding of the setpoints is no violation.
        self._change = [acceleration * self._period_s for acceleration in limits.acceleration]
        self._step = [velocity * self._period_s * (1 + 1e-6) for velocity in limits.velocity]
        self._back = [min(BACK_RAD_S, velocity) for velocity in limits.velocity]

    def latch(self, axis: int, position: float) -> None:
        """Set the target sent last to `position`, rad: while a drive has no torque, its target is where it is."""
        self.sent[axis] = position
        self._pace[axis] = self._velocity[axis] = 0.0

    def check(self, drives: Sequence[Commanded]) -> None:
        """Clamp every target of every drive in place."""
        sent, lows, highs, steps, changes = self.sent, self._low, self._high, self._step, self._change
        fastest, strongest, velocity = self._speed, self._torque, self._velocity
        held = 0
        for i, drive in enumerate(drives):
            wanted, before, lowest, highest, step = drive.target_position, sent[i], lows[i], highs[i], steps[i]
            # A comparison with NaN is false: what is no number fails it, and the target stays.
            if not (lowest <= wanted <= highest and lowest <= before <= highest and -step <= wanted - before <= step):
                allowed = self._allowed(i, wanted)
                if allowed != wanted:
                    held |= 1 << i
                    drive.target_position = wanted = allowed
            sent[i] = wanted
            speed = drive.target_velocity
            if speed == 0.0 == drive.target_torque and velocity[i] == 0.0:
                continue  # as in CSP: zero is inside every bound, and changes nothing
            bound = fastest[i]
            if not (-bound <= speed <= bound):
                held |= 1 << i
                speed = bound if speed > bound else -bound if speed < -bound else 0.0
            torque = drive.target_torque
            bound = strongest[i]
            if not (-bound <= torque <= bound):
                held |= 1 << i
                torque = bound if torque > bound else -bound if torque < -bound else 0.0
            # Beyond the range nothing drives further out.
            position = drive.position
            if position > highest:
                outward = speed > 0.0 or torque > 0.0
                speed, torque = min(speed, 0.0), min(torque, 0.0)
            elif position < lowest:
                outward = speed < 0.0 or torque < 0.0
                speed, torque = max(speed, 0.0), max(torque, 0.0)
            else:
                outward = False
            if outward:
                held |= 1 << i
            before, change = velocity[i], changes[i]
            if speed > before + change:
                speed = before + change
            elif speed < before - change:
                speed = before - change
            velocity[i] = drive.target_velocity = speed
            drive.target_torque = torque
        self.held = held

    def _allowed(self, i: int, wanted: float) -> float:
        """Return the allowed target, rad, that is nearest to `wanted`; the last one where that is no number."""
        before, lowest, highest = self.sent[i], self._low[i], self._high[i]
        if not lowest <= before <= highest:
            return self._led_back(i)
        if isnan(wanted):
            return before
        step = self._step[i]
        return min(max(wanted, lowest, before - step), highest, before + step)

    def _led_back(self, i: int) -> float:
        """Return the next target, rad, of a joint whose last lay outside its range: nearer to the edge, gently.

        The first after `latch` is the last itself. From there on the speed is bounded by `BACK_RAD_S` and the joint's
        own, and rises and falls under the joint's acceleration.
        """
        before, dt = self.sent[i], self._period_s
        edge = self._high[i] if before > self._high[i] else self._low[i]
        pace = self._pace[i]
        left = max(abs(before - edge) - pace * dt, 0.0)
        change = self._change[i]
        self._pace[i] = min(pace + change, self._back[i], fastest_stoppable(left, change, dt))
        return edge + copysign(left, before - edge)
