"""Real roots of a polynomial, none missing: between two neighbouring stationary points there is at most one."""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign

_STEPS = 200  # at most; some ten do


def real_roots(coefficients: Sequence[float], nearly: float) -> list[float]:
    """The real roots, ascending, of a polynomial given with its highest power first, whose coefficient is not zero.

    A stationary point that misses zero by less than `nearly` times the size of the polynomial's terms is given as a
    root too: where round-off has made two roots that were one complex.
    """
    degree = len(coefficients) - 1
    if degree == 1:
        return [-coefficients[1] / coefficients[0]]
    slope = [factor * (degree - index) for index, factor in enumerate(coefficients[:-1])]
    bound = 1.0 + max(abs(factor / coefficients[0]) for factor in coefficients[1:])
    stationary = real_roots(slope, 0.0)
    roots = []
    lower, at_lower = -bound, value(coefficients, -bound)
    for upper in (*stationary, bound):
        at_upper = value(coefficients, upper)
        if at_upper == 0.0 or (at_lower < 0.0) != (at_upper < 0.0):
            roots.append(_between(coefficients, slope, lower, upper, at_lower))
        elif upper != bound and abs(at_upper) <= nearly * value(list(map(abs, coefficients)), abs(upper)):
            roots.append(upper)
        lower, at_lower = upper, at_upper
    return roots


def value(coefficients: Sequence[float], x: float) -> float:
    """The polynomial at x (Horner)."""
    result = 0.0
    for factor in coefficients:
        result = result * x + factor
    return result


def _between(
    coefficients: Sequence[float], slope: Sequence[float], lower: float, upper: float, at_lower: float
) -> float:
    """The root in an interval at whose ends the signs differ: Newton's steps, halves where they leave the interval."""
    below = copysign(1.0, at_lower)
    x = 0.5 * (lower + upper)
    for _ in range(_STEPS):
        here = value(coefficients, x)
        if here == 0.0:
            return x
        if here * below > 0.0:
            lower = x
        else:
            upper = x
        steepness = value(slope, x)
        candidate = x - here / steepness if steepness != 0.0 else lower
        if not lower < candidate < upper:
            candidate = 0.5 * (lower + upper)
            if not lower < candidate < upper:
                return x
        if candidate == x:
            return x
        x = candidate
    return x
