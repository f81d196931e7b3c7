"""The speed override, as a fraction of the planned speed, and the path time of motions that follow it.

A planned motion keeps its path; only its path time runs more slowly (`TimeScale`). Replanning with a lower speed is no
alternative: ruckig would brake below it, at times into backward motion, and would choose another path.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Final

LOWEST: Final = 0.01
"""Lowest speed override; 0 is a pause, which ends with its motion."""
_MOST_RATE: Final = 50.0
_MOST_JERK: Final = 2000.0
"""Upper bound on the changes of the path time's rate while no joint moves, 1/s and 1/s^2."""
_STILL: Final = 1e-9
STOP: Final = -1.0
"""Goal of a stop, which ends the path."""
_OF_LIMIT: Final = 0.99
"""Share of a joint's acceleration for a change of speed, so that the limit holds between two cycles too."""
_OF_JERK: Final = 0.5
"""Share of a joint's jerk for a change of speed towards a goal; the rest is for the path itself."""
_LANDING: Final = 0.7
"""Share of that jerk with which u approaches its goal: a steeper path leaves less."""
_LEAST_JERK: Final = 4.0
"""Least change of the rate, 1/s^2, where the bends of the path use up the joints' jerks."""


class SpeedOverride:
    """Shared by all controllers; only the state machine and the loop's command handler write it.

    `fraction`: present override, `LOWEST` to 1.0, or 0 during a pause. `chosen`: the override without a pause.
    """

    __slots__ = ("chosen", "fraction")

    def __init__(self) -> None:
        self.fraction = self.chosen = 1.0

    @property
    def paused(self) -> bool:
        """True while a motion rests on its path until `resume`."""
        return self.fraction == 0.0

    def choose(self, fraction: float) -> None:
        """Set the override; a pause continues."""
        self.fraction, self.chosen = 0.0 if self.paused else fraction, fraction

    def pause(self) -> None:
        """Bring the current motion to rest on its path."""
        self.fraction = 0.0

    def resume(self) -> None:
        """Return to the chosen override."""
        self.fraction = self.chosen


class TimeScale:
    """The rate u of the path time s: 1, less, or falling to 0.

    The velocity at a point p(s) of the path is p'(s) u, with u = ds/dt between 0 and 1. In each cycle u changes as
    fast as every joint's acceleration and jerk allow. `speed` is u, `rate` is du/dt, 1/s.
    """

    def __init__(self) -> None:
        self.speed = 1.0
        self.rate = 0.0

    def begin(self, speed: float = 1.0) -> None:
        """Start at a speed: 1 in motion, or the override from rest."""
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
            goal: of u, 0 to 1; `STOP`: to rest, as fast as the joints can.
            along: p'(s), rad/s, at the end of the cycle.
            velocity: last commanded, rad/s.
            acceleration, jerk: bounds of each joint, rad/s^2, rad/s^3.
            dt: cycle time, s.
        """
        now, last, low, high, most = self.speed, self.rate, 0.0, 1.0, _MOST_JERK
        # The acceleration along the path changes with u too: part of the jerk, 3 p''(s) u du/dt.
        bent = 3.0 * abs(last) / (now * dt) if goal >= 0.0 and now > 0.0 else 0.0
        for at_full, before, bound, jerks in zip(along, velocity, acceleration, jerk, strict=True):
            steep = at_full if at_full >= 0.0 else -at_full
            if steep > 1e-6:
                # |p' u - v| <= a dt, and the change of du/dt that the jerk allows.
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
            # The rate at which rate and speed difference reach 0 together.
            landing = -sqrt(2.0 * most * now)
            rate = rate if rate > landing else landing
            near = most * dt * dt
        else:
            change = (_OF_JERK * most if most > _LEAST_JERK else _OF_JERK * _LEAST_JERK) * dt
            # The same in both directions, in cycles; the goal may move, so the rate never changes by more.
            half, away = 0.5 * _LANDING * change, goal - now if goal > now else now - goal
            rate = sqrt(half * half + 4.0 * half * away / dt) - half
            rate = rate if goal > now else -rate
            rate = rate if rate > last - change else last - change
            rate = rate if rate < last + change else last + change
            near = change * dt
        if low > high and goal >= 0.0:
            # Conflicting bounds of two joints: at a constant u each joint accelerates only as its path does.
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
            speed = now = goal  # and the rate 0: at rest
        self.rate = (speed - now) / dt
        self.speed = speed
        return speed
