"""Velocities and accelerations for points that have none: the cubic spline through them, at rest at both ends."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise


def spline_velocities(times: Sequence[float], values: Sequence[float]) -> list[float]:
    """Return the velocity at each point of the twice differentiable cubic spline, 0 at both ends.

    Args:
        times: s, rising, shape (n,).
        values: one joint's positions, rad, shape (n,).

    De Boor, A Practical Guide to Splines, chapter IV: a tridiagonal system, solved by Thomas' elimination.
    """
    n = len(times)
    velocity = [0.0] * n
    if n < 3:
        return velocity
    steps = [after - before for before, after in pairwise(times)]
    slopes = [(after - before) / h for (before, after), h in zip(pairwise(values), steps, strict=True)]
    upper, right = [0.0] * n, [0.0] * n
    for i in range(1, n - 1):
        before, after = steps[i - 1], steps[i]
        wanted = 3.0 * (after * slopes[i - 1] + before * slopes[i])
        pivot = 2.0 * (before + after) - after * upper[i - 1]
        upper[i] = before / pivot
        right[i] = (wanted - after * right[i - 1]) / pivot
    for i in range(n - 2, 0, -1):
        velocity[i] = right[i] - upper[i] * velocity[i + 1]
    return velocity


def spline_accelerations(times: Sequence[float], values: Sequence[float], velocities: Sequence[float]) -> list[float]:
    """Return the spline's acceleration at each point; 0 at both ends, where the motion begins and ends gently."""
    accelerations = [0.0] * len(times)
    for i in range(1, len(times) - 1):
        h = times[i + 1] - times[i]
        slope = (values[i + 1] - values[i]) / h
        accelerations[i] = (6.0 * slope - 4.0 * velocities[i] - 2.0 * velocities[i + 1]) / h
    return accelerations
