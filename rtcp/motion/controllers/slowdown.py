"""Coming to rest along a path: the path's own time goes slower and slower until it stands.

A point p(s) of the path is passed with the velocity p'(s) u, where u = ds/dt is 1 on the way and falls to 0. In each
cycle u falls as fast as every joint's acceleration and jerk allow, and never faster.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

_MOST_RATE = 50.0
_MOST_JERK = 2000.0
"""1/s and 1/s^2: where no joint moves nothing else bounds how fast the path's time stands still."""
_STILL = 1e-9
_OF_LIMIT = 0.99
"""Of a joint's acceleration so much is used, so that what is between two cycles keeps to it too."""


class Slowdown:
    """The path's time on its way to rest.

    `speed` is u, 1 at `begin` and 0 at rest; `rate` is du/dt, 1/s.
    """

    def __init__(self) -> None:
        self.speed = 1.0
        self.rate = 0.0

    def begin(self) -> None:
        """Go at full speed, about to slow down."""
        self.speed, self.rate = 1.0, 0.0

    def step(
        self,
        along: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        jerk: Sequence[float],
        dt: float,
    ) -> float:
        """Return u at the end of the next cycle.

        Args:
            along: p'(s), rad/s, at the point that the cycle ends at.
            velocity: what was commanded last, rad/s.
            acceleration, jerk: bounds of each joint, rad/s^2, rad/s^3.
            dt: the cycle, s.
        """
        now, low, high, most = self.speed, 0.0, 1.0, _MOST_JERK
        for at_full, before, bound, jerks in zip(along, velocity, acceleration, jerk, strict=True):
            steep = at_full if at_full >= 0.0 else -at_full
            if steep > 1e-6:
                # |p' u - v| <= a dt, and what the jerk leaves of du/dt's change.
                signed = before if at_full > 0.0 else -before
                room = _OF_LIMIT * bound * dt
                least, largest = (signed - room) / steep, (signed + room) / steep
                low = least if least > low else low
                high = largest if largest < high else high
                allowed = jerks / steep
                most = allowed if allowed < most else most
        rate = self.rate - most * dt
        # So steep that the rate comes back to 0 together with the speed.
        landing = -sqrt(2.0 * most * now)
        rate = rate if rate > landing else landing
        rate = rate if rate > -_MOST_RATE else -_MOST_RATE
        speed = now + rate * dt
        speed = speed if speed < high else high
        speed = speed if speed > low else low
        speed = speed if speed < now else now
        if speed < _STILL or (low == 0.0 and speed < most * dt * dt):
            speed = 0.0
        self.rate = (speed - now) / dt
        self.speed = speed
        return speed
