"""Polynomials of one joint between two waypoints over the fraction x = (t - t0) / T, and their exact extremes.

Coefficients rise: c[0] + c[1] x + .. Derivatives are by x: a speed is the first over T, an acceleration the second over
T^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb
from typing import TypeAlias

Coefficients: TypeAlias = tuple[float, float, float, float, float, float]
_NEARLY = 1e-15
"""A root is known so closely, as a fraction of the piece."""


def cubic(q0: float, v0: float, q1: float, v1: float, duration: float) -> Coefficients:
    """Return the cubic with these positions and velocities (rad, rad/s) at both ends of `duration` s."""
    v0, v1, way = v0 * duration, v1 * duration, q1 - q0
    return q0, v0, 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way, 0.0, 0.0


def quintic(q0: float, v0: float, a0: float, q1: float, v1: float, a1: float, duration: float) -> Coefficients:
    """Return the quintic with these positions, velocities and accelerations at both ends of `duration` s."""
    v0, v1 = v0 * duration, v1 * duration
    a0, a1 = 0.5 * a0 * duration * duration, 0.5 * a1 * duration * duration
    way = q1 - q0
    return (
        q0,
        v0,
        a0,
        10.0 * way - 6.0 * v0 - 4.0 * v1 - 3.0 * a0 + a1,
        -15.0 * way + 8.0 * v0 + 7.0 * v1 + 3.0 * a0 - 2.0 * a1,
        6.0 * way - 3.0 * (v0 + v1) - a0 + a1,
    )


def value(coefficients: Sequence[float], x: float) -> float:
    """Return the polynomial's value."""
    result = 0.0
    for c in reversed(coefficients):
        result = result * x + c
    return result


def derivative(coefficients: Sequence[float]) -> list[float]:
    """Return the coefficients of the derivative."""
    return [power * c for power, c in enumerate(coefficients)][1:] or [0.0]


def sign_changes(coefficients: Sequence[float]) -> list[float]:
    """Return where in (0, 1) the polynomial changes its sign, rising.

    Between two neighbouring sign changes of its derivative a polynomial is monotone, and has one root at most: the
    roots of each derivative are found from those of the next, down to a straight line.
    """
    if not any(coefficients[1:]):
        return []
    edges = [0.0, *sign_changes(derivative(coefficients)), 1.0]
    values = [value(coefficients, x) for x in edges]
    found: list[float] = []
    for low, high, at_low, at_high in zip(edges, edges[1:], values, values[1:], strict=False):
        if at_low * at_high < 0.0:
            found.append(_root(coefficients, low, high, at_low < 0.0))
    return found


def _root(coefficients: Sequence[float], low: float, high: float, rising: bool) -> float:
    """Newton's steps inside an interval that halves where they leave it or are slow."""
    slope = derivative(coefficients)
    x = 0.5 * (low + high)
    last = high - low
    while high - low > _NEARLY:
        y = value(coefficients, x)
        if y == 0.0:
            return x
        if (y < 0.0) == rising:
            low = x
        else:
            high = x
        steep = value(slope, x)
        step = y / steep if steep else last
        slow = not low < x - step < high or abs(step) > 0.5 * last
        following = 0.5 * (low + high) if slow else x - step
        last = abs(following - x)
        if last <= _NEARLY:
            return following
        x = following
    return x


def extremes(coefficients: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the least value on [0, 1], where it is, the largest and where it is; exact but for rounding."""
    places = [0.0, *sign_changes(derivative(coefficients)), 1.0]
    values = [value(coefficients, x) for x in places]
    least, largest = min(values), max(values)
    return least, places[values.index(least)], largest, places[values.index(largest)]


def beyond(coefficients: Sequence[float], low: float, high: float) -> tuple[float, float] | None:
    """Return the extreme outside [low, high] that the polynomial has on [0, 1] and where it is, or None."""
    # The hull of Bernstein's coefficients holds the curve: most pieces are inside at this glance.
    if _hull_is_inside(coefficients, low, high):
        return None
    least, at_least, largest, at_largest = extremes(coefficients)
    if largest > high:
        return largest, at_largest
    if least < low:
        return least, at_least
    return None


def _hull_is_inside(coefficients: Sequence[float], low: float, high: float) -> bool:
    degree = len(coefficients) - 1
    over = _OVER_BINOMIAL[degree]
    for k in range(degree + 1):
        point = 0.0
        for j in range(k + 1):
            point += over[k][j] * coefficients[j]
        if not low <= point <= high:
            return False
    return True


def _over_binomials(degree: int) -> list[list[float]]:
    """b[k] = sum over j <= k of C(k, j) / C(degree, j) c[j] (Farouki 2012, section 2)."""
    return [[comb(k, j) / comb(degree, j) for j in range(k + 1)] for k in range(degree + 1)]


_OVER_BINOMIAL = [_over_binomials(degree) for degree in range(6)]
