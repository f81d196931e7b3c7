"""Steps of trapezoidal motion profiles (0x6086 = 0), exact at any step size."""

from __future__ import annotations

from math import sqrt


def approach(
    position: float, velocity: float, target: float, top: float, acceleration: float, deceleration: float, h: float
) -> tuple[float, float]:
    """Return position and velocity after `h` seconds on the way to rest at `target`, at most `top` fast.

    SI units; `top`, `acceleration`, `deceleration` are positive. The target is met exactly, without overshoot unless
    the velocity at the start forces one.
    """
    distance = target - position
    direction = 1.0 if distance >= 0.0 else -1.0
    distance *= direction
    along = velocity * direction
    # The fastest speed from which whole steps of deceleration * h still stop at the target.
    allowed = deceleration * (sqrt(0.25 * h * h + 2.0 * distance / deceleration) - 0.5 * h)
    wanted = min(top, allowed, distance / h)
    if along > wanted:
        along = max(wanted, along - deceleration * h)
    elif along < 0.0:
        along = min(wanted, along + deceleration * h)
    else:
        along = min(wanted, along + acceleration * h)
    # The last step is shorter than one of deceleration: it ends on the target, at rest.
    if distance <= along * h * (1.0 + 1e-9) and along <= deceleration * h * (1.0 + 1e-9):
        return target, 0.0
    return position + direction * along * h, direction * along


def ramp(velocity: float, target: float, acceleration: float, deceleration: float, h: float) -> float:
    """Return the velocity after `h` seconds on the way to `target`, by `deceleration` when slowing."""
    slowing = abs(target) < abs(velocity) or target * velocity < 0.0
    change = (deceleration if slowing else acceleration) * h
    if velocity < target:
        return min(target, velocity + change)
    return max(target, velocity - change)
