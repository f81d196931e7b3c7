"""The speed override, the fraction of its speed at which the arm moves; and how motions along a path follow it.

A motion that is planned keeps its path: the path's own time passes more slowly (`TimeScale`). Asked again with a lower
speed, ruckig would brake to below it, at times to backward motion, and would choose another way.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Final

LOWEST: Final = 0.01
"""Lowest speed override that can be chosen; 0 is a pause, which ends with its motion."""
_MOST_RATE: Final = 50.0
_MOST_JERK: Final = 2000.0
"""1/s and 1/s^2: bounds of how fast the path's time slows down where no joint moves."""
_STILL: Final = 1e-9
STOP: Final = -1.0
"""Goal of a path that ends where it comes to rest."""
_OF_LIMIT: Final = 0.99
"""Share of a joint's acceleration that a change of speed uses, so that what is between two cycles keeps to it too."""
_OF_JERK: Final = 0.5
"""Share of a joint's jerk that a change of speed on the way to a goal uses; the rest is the path's own."""
_LANDING: Final = 0.7
"""Share of that with which u comes to its goal: where the path becomes steeper there is less of it."""
_LEAST_JERK: Final = 4.0
"""1/s^2: how fast the rate changes at least, where the path bends as the joints' jerks allow no change of it."""


class SpeedOverride:
    """One for all controllers; only the state machine and the loop's command handler write it.

    `fraction`: what motions follow, `LOWEST` to 1.0, or 0 while a motion is paused. `chosen`: what it is without pause.
    """

    __slots__ = ("chosen", "fraction")

    def __init__(self) -> None:
        self.fraction = self.chosen = 1.0

    @property
    def paused(self) -> bool:
        """Whether a motion rests on its path until `resume`."""
        return self.fraction == 0.0

    def choose(self, fraction: float) -> None:
        """Set the fraction, which a pause outlasts."""
        self.fraction, self.chosen = 0.0 if self.paused else fraction, fraction

    def pause(self) -> None:
        """Bring the motion under way to rest on its path."""
        self.fraction = 0.0

    def resume(self) -> None:
        """Let motions follow the chosen fraction."""
        self.fraction = self.chosen


class TimeScale:
    """How fast the path's own time s passes: at 1, slower, or ever slower until it stands.

    A point p(s) of the path is passed with the velocity p'(s) u, where u = ds/dt is between 0 and 1. In each cycle
    u changes as fast as every joint's acceleration and jerk allow. `speed` is u, `rate` is du/dt, 1/s.
    """

    def __init__(self) -> None:
        self.speed = 1.0
        self.rate = 0.0

    def begin(self, speed: float = 1.0) -> None:
        """Start at a speed: at full speed, or, from rest, at that of the override."""
        self.speed, self.rate = speed, 0.0

    def step(
        self,
        goal: float,
        along: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        jerk: Sequence[float],
        dt: float,
    ) -> float:
        """Return u at the end of the next cycle.

        Args:
            goal: what u is led to, 0 to 1; `STOP`: to rest, as fast as the joints can.
            along: p'(s), rad/s, at the point that the cycle ends at.
            velocity: what was commanded last, rad/s.
            acceleration, jerk: bounds of each joint, rad/s^2, rad/s^3.
            dt: the cycle, s.
        """
        now, last, low, high, most = self.speed, self.rate, 0.0, 1.0, _MOST_JERK
        # What the joints accelerate with along the path changes with u too: a part of their jerk, 3 p''(s) u du/dt.
        bent = 3.0 * abs(last) / (now * dt) if goal >= 0.0 and now > 0.0 else 0.0
        for at_full, before, bound, jerks in zip(along, velocity, acceleration, jerk, strict=True):
            steep = at_full if at_full >= 0.0 else -at_full
            if steep > 1e-6:
                # |p' u - v| <= a dt, and what the jerk leaves of du/dt's change.
                signed = before if at_full > 0.0 else -before
                room = _OF_LIMIT * bound * dt
                least, largest = (signed - room) / steep, (signed + room) / steep
                low = least if least > low else low
                high = largest if largest < high else high
                bend = steep * now - signed
                allowed = (jerks - bent * (bend if bend >= 0.0 else -bend)) / steep
                most = allowed if allowed < most else most
        if goal < 0.0:
            rate = last - most * dt
            # So steep that the rate comes back to 0 together with the speed.
            landing = -sqrt(2.0 * most * now)
            rate = rate if rate > landing else landing
            near = most * dt * dt
        else:
            change = (_OF_JERK * most if most > _LEAST_JERK else _OF_JERK * _LEAST_JERK) * dt
            # The same in both directions, for cycles; the goal may move meanwhile, so the rate never changes by more.
            half, away = 0.5 * _LANDING * change, goal - now if goal > now else now - goal
            rate = sqrt(half * half + 4.0 * half * away / dt) - half
            rate = rate if goal > now else -rate
            rate = rate if rate > last - change else last - change
            rate = rate if rate < last + change else last + change
            near = change * dt
        if low > high and goal >= 0.0:
            # What one joint needs is too much for another: at a steady u no joint accelerates more than its path does.
            rate, low, high = 0.0, now, now
        rate = rate if rate > -_MOST_RATE else -_MOST_RATE
        rate = rate if rate < _MOST_RATE else _MOST_RATE
        speed = now + rate * dt
        ceiling = speed if rate > 0.0 else now
        speed = speed if speed < high else high
        speed = speed if speed > low else low
        speed = speed if speed < ceiling else ceiling
        if goal < 0.0:
            if speed < _STILL or (low == 0.0 and speed < near):
                speed = 0.0
        elif low <= goal <= high and -near <= goal - now <= near and -2.0 * near <= last * dt <= 2.0 * near:
            speed = now = goal  # and the rate 0: it rests there
        self.rate = (speed - now) / dt
        self.speed = speed
        return speed
