"""EGM's control law: position and speed references become joint speeds. Degrees and s.

speed = k * (pos_ref - pos) + speed_ref, low pass, MaxSpeedDeviation and speed limits, MaxPosDeviation. ABB, Application
manual Externally Guided Motion, 3HAC073318-001 rev K. `pos` is the planned position; the servo follows it after a dead
time (`mechanical_unit.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, pi

from rtcp.virtual.irc5.config import EgmConfig


class ControlLaw:
    """Speeds of all joints of a unit, with the state of the low pass and the ramp."""

    def __init__(self, config: EgmConfig, speed_limits: Sequence[float]) -> None:
        """`speed_limits`: of each joint, degrees/s."""
        self._gain = config.position_gain * config.pos_corr_gain
        self._cutoff = 2.0 * pi * config.low_pass_hz
        self._ramp_in = config.ramp_in_s
        self._limits = tuple(min(limit, config.max_speed_deviation) for limit in speed_limits)
        self._speed_limits = tuple(speed_limits)
        self._filtered = [0.0] * len(speed_limits)
        self.utilization = 0.0
        """Largest requested share of a joint's speed limit in the last step, %."""
        self._elapsed = 0.0

    def restart(self, speeds: Sequence[float]) -> None:
        """Start the ramp at these speeds, degrees/s."""
        self._filtered = list(speeds)
        self.utilization = 0.0
        self._elapsed = 0.0

    def speeds(
        self,
        position: Sequence[float],
        position_reference: Sequence[float] | None,
        speed_reference: Sequence[float] | None,
        dt: float,
    ) -> list[float]:
        """Return the speeds, degrees/s, scaled by one factor to their limits."""
        self._elapsed += dt
        ramp = 1.0 if self._elapsed >= self._ramp_in else self._elapsed / self._ramp_in
        share = 1.0 if self._cutoff == 0.0 else 1.0 - exp(-self._cutoff * dt)
        filtered, scale, used = self._filtered, 1.0, 0.0
        for i, limit in enumerate(self._limits):
            speed = 0.0
            if position_reference is not None:
                speed = self._gain * (position_reference[i] - position[i])
            if speed_reference is not None:
                speed += speed_reference[i]
            filtered[i] += share * (speed * ramp - filtered[i])
            size = abs(filtered[i])
            used = max(used, size / self._speed_limits[i])
            if size * scale > limit:
                scale = limit / size
        self.utilization = 100.0 * used
        return [speed * scale for speed in filtered]
