"""Equations in the cosine and sine of an angle: of first degree, and of second by a quartic in tan(angle / 2)."""

from __future__ import annotations

from math import atan, atan2, cos, hypot, pi, sin, sqrt
from typing import TypeAlias

from kinematics.roots import real_roots

# constant, factor of cos, factor of sin
Linear: TypeAlias = tuple[float, float, float]
# constant, factors of cos x, sin x, cos 2x, sin 2x
Quadratic: TypeAlias = tuple[float, ...]

_NEARLY = (
    1e-7  # relative to the largest factor: what misses zero by less is a root lost to round-off, or one to be refused
)


def product(one: Linear, other: Linear) -> Quadratic:
    """The product of two linear forms."""
    k, c, s = one
    m, d, t = other
    return (
        k * m + 0.5 * (c * d + s * t),
        k * d + c * m,
        k * t + s * m,
        0.5 * (c * d - s * t),
        0.5 * (c * t + s * d),
    )


def solve_linear(form: Linear) -> list[float]:
    """The angles (rad) where the form is zero: two, one where they meet, or none."""
    constant, along, across = form
    size = hypot(along, across)
    if size == 0.0 or abs(constant) > size * (1.0 + _NEARLY):
        return []
    middle = atan2(across, along)
    half = atan2(sqrt(max(0.0, (size - constant) * (size + constant))), -constant)
    return [middle + half, middle - half]


def solve_quadratic(form: Quadratic) -> list[float]:
    """The angles (rad) where the form is zero: up to four; also those where it all but touches zero."""
    constant, c1, s1, c2, s2 = form
    if not max(map(abs, form)) > 0.0:
        return []

    def at(angle: float) -> float:
        return constant + c1 * cos(angle) + s1 * sin(angle) + c2 * cos(2.0 * angle) + s2 * sin(2.0 * angle)

    # tan(x / 2) is infinite at x = pi: x is counted from where the form is largest half a turn away
    start = max((0.25 * pi * eighth for eighth in range(8)), key=lambda angle: abs(at(angle + pi)))
    c, s = cos(start), sin(start)
    c1, s1 = c * c1 + s * s1, c * s1 - s * c1
    c, s = cos(2.0 * start), sin(2.0 * start)
    c2, s2 = c * c2 + s * s2, c * s2 - s * c2
    quartic = (
        constant - c1 + c2,
        2.0 * s1 - 4.0 * s2,
        2.0 * constant - 6.0 * c2,
        2.0 * s1 + 4.0 * s2,
        constant + c1 + c2,
    )
    return [start + 2.0 * atan(tangent) for tangent in real_roots(quartic, _NEARLY)]
