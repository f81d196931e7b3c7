"""What a joint's limits leave room for: accelerations that a speed allows, speeds that a range allows."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rtcp.motion.state import ArmState

_INSIDE = 1.0 - 1e-6
"""What the guards have cut may lie a rounding beyond a limit, where ruckig accepts no state."""


def allowed_acceleration(acceleration: float, speed: float, fastest: float, most: float, jerk: float) -> float:
    """Return the acceleration, rad/s^2, cut to `most`, and to what ends before the speed passes `fastest`.

    An acceleration a that falls to 0 with the jerk j still adds a^2 / 2j to the speed.
    """
    outward = acceleration if speed >= 0.0 else -acceleration
    bound = most
    if outward > 0.0:
        left = fastest - (speed if speed >= 0.0 else -speed)
        rising = sqrt(2.0 * jerk * left) if left > 0.0 else 0.0
        bound = rising if rising < most else most
    bound *= _INSIDE
    return bound if acceleration > bound else -bound if acceleration < -bound else acceleration


def allowed_accelerations(
    state: ArmState, fastest: Sequence[float], most: Sequence[float], jerk: Sequence[float]
) -> list[float]:
    """Return `allowed_acceleration` of every joint of a state; bounds of shape (n,)."""
    return [
        allowed_acceleration(now, state.commanded_velocity[i], fastest[i], most[i], jerk[i])
        for i, now in enumerate(state.commanded_acceleration)
    ]


def stoppable_speed(stopping_distance: float, acceleration: float, jerk: float) -> float:
    """Return the speed, rad/s, that comes to rest within `stopping_distance` rad, after an acceleration ramp.

    v^2 / 2a + v a / 2j = stopping_distance, solved for v.
    """
    if not stopping_distance > 0.0:
        return 0.0
    ramp = 0.5 * acceleration * acceleration / jerk
    return sqrt(ramp * ramp + 2.0 * acceleration * stopping_distance) - ramp
