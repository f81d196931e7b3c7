"""The joint speeds of a jog's twist, and the twist scaled with them: within the joints' speeds and accelerations."""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.motion.controllers.jog_bounds import stopping
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState

FULL = 0.98
"""Part of the joints' speeds and accelerations that jogging uses: the guard never has to cut."""
_LAST_RAD = 1e-6


class JogSpeeds:
    """A twist (m/s, rad/s; six numbers along the base's axes) and the joint speeds for it (rad/s, six).

    Args:
        limits: of the joints; read every cycle.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self.twist = [0.0] * 6
        self.speeds = [0.0] * 6

    def make(self, rows: Sequence[Sequence[float]]) -> None:
        """Write the joint speeds for the twist, both scaled to what the joints' speeds allow.

        Args:
            rows: of the inverse Jacobian, shape (6, 6).
        """
        a, b, c, d, e, f = self.twist
        speeds, fastest = self.speeds, self._limits.velocity
        part = 1.0
        for i, (g, h, k, m, n, o) in enumerate(rows):
            speeds[i] = v = a * g + b * h + c * k + d * m + e * n + f * o
            most = FULL * fastest[i]
            if v * part > most or v * part < -most:
                part = most / (v if v > 0.0 else -v)
        self.scale(part)

    def scale(self, part: float) -> None:
        """Multiply both by `part`, where it is less than 1."""
        if part < 1.0:
            twist, speeds = self.twist, self.speeds
            for i in range(6):
                twist[i] *= part
                speeds[i] *= part

    def follow(self, state: ArmState, dt: float) -> bool:
        """Bring the joint speeds, and the twist with them, within what the accelerations allow after `state`.

        Returns:
            Whether all joints are scaled by one factor, so that the tool keeps its direction. Where there is none, each
                goes towards its speed as fast as it may; so it does, too, where its limits leave no more.
        """
        speeds, last, limits = self.speeds, state.commanded_velocity, self._limits
        acceleration = limits.acceleration
        step = FULL * dt
        together = True
        for i in range(6):
            change, most = speeds[i] - last[i], step * acceleration[i]
            if change > most or change < -most:
                together = self._scaled_together(last, step)
                break
        q, low, high, fastest = state.commanded, limits.low, limits.high, limits.velocity
        for i in range(6):
            v, rate, most = speeds[i], acceleration[i], fastest[i]
            if v > most or v < -most:
                least = abs(last[i]) - step * rate
                most = max(most, least)
                speeds[i] = v = most if v > most else -most if v < -most else v
                together = False
            stopping_distance = high[i] - q[i] if v > 0.0 else q[i] - low[i]
            if v * v > 1.8 * rate * stopping_distance:
                most = stopping(stopping_distance - _LAST_RAD, rate, dt)
                least = abs(last[i]) - step * rate if v * last[i] > 0.0 else 0.0
                most = max(most, least)
                if v > most or v < -most:
                    speeds[i] = most if v > 0.0 else -most
                    together = False
        return together

    def _scaled_together(self, last: Sequence[float], step: float) -> bool:
        speeds, acceleration = self.speeds, self._limits.acceleration
        low, high = 0.0, 1e9
        for i in range(6):
            v, w, most = speeds[i], last[i], step * acceleration[i]
            if v > 1e-12:
                least, greatest = (w - most) / v, (w + most) / v
            elif v < -1e-12:
                least, greatest = (w + most) / v, (w - most) / v
            elif -most <= w <= most:
                continue
            else:
                high = -1.0
                break
            low, high = max(low, least), min(high, greatest)
        if low > high:
            self.clip(last, step)
            return False
        # Above 1 it brakes as fast as the joints can.
        factor = low if low > 1.0 else high if high < 1.0 else 1.0
        twist = self.twist
        for i in range(6):
            speeds[i] *= factor
            twist[i] *= factor
        return True

    def clip(self, last: Sequence[float], step: float) -> None:
        """Bring each joint's speed to within acceleration x `step` (s) of its `last` (rad/s), whatever the twist."""
        speeds, acceleration = self.speeds, self._limits.acceleration
        for i in range(6):
            most = step * acceleration[i]
            v, w = speeds[i], last[i]
            speeds[i] = w + most if v > w + most else w - most if v < w - most else v
