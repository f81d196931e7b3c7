"""Interpolation: polynomials of a joint and their exact extremes, splines through points, rotations of the tool.

A polynomial c[0] + c[1] x + .. is a function of the fraction x = (t - t0) / T from 0 to 1. Derivatives are by x: a
speed is the first over T, an acceleration the second over T^2. Orientations are unit quaternions (w, x, y, z) outside
the cycle and a rotation about a fixed axis in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import atan2, comb, copysign, cos, fabs, hypot, sin, sqrt
from typing import Final, TypeAlias

from kinematics.pose import Rotation, Vector, times

Quaternion: TypeAlias = tuple[float, float, float, float]
Coefficients: TypeAlias = tuple[float, float, float, float, float, float]
_NO_TURN: Final = 1e-12
_NEARLY: Final = 1e-15
"""Tolerance of a root, as a fraction of the piece."""


def cubic(q0: float, v0: float, q1: float, v1: float, duration: float) -> Coefficients:
    """Return the cubic with these positions and velocities (rad, rad/s) at both ends of `duration` s."""
    v0, v1, distance = v0 * duration, v1 * duration, q1 - q0
    return q0, v0, 3.0 * distance - 2.0 * v0 - v1, v0 + v1 - 2.0 * distance, 0.0, 0.0


def quintic(q0: float, v0: float, a0: float, q1: float, v1: float, a1: float, duration: float) -> Coefficients:
    """Return the quintic with these positions, velocities and accelerations at both ends of `duration` s."""
    v0, v1 = v0 * duration, v1 * duration
    a0, a1 = 0.5 * a0 * duration * duration, 0.5 * a1 * duration * duration
    distance = q1 - q0
    return (
        q0,
        v0,
        a0,
        10.0 * distance - 6.0 * v0 - 4.0 * v1 - 3.0 * a0 + a1,
        -15.0 * distance + 8.0 * v0 + 7.0 * v1 + 3.0 * a0 - 2.0 * a1,
        6.0 * distance - 3.0 * (v0 + v1) - a0 + a1,
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
    """Return the places in (0, 1) where the polynomial changes its sign, in rising order.

    Between two neighbouring sign changes of its derivative a polynomial is monotone and has at most one root: the roots
    follow from those of the derivative, recursively down to a straight line.
    """
    if not any(coefficients[1:]):
        return []
    edges = [0.0, *sign_changes(derivative(coefficients)), 1.0]
    values = [value(coefficients, x) for x in edges]
    roots: list[float] = []
    for low, high, at_low, at_high in zip(edges, edges[1:], values, values[1:], strict=False):
        if at_low * at_high < 0.0:
            roots.append(_root(coefficients, low, high, at_low < 0.0))
    return roots


def _root(coefficients: Sequence[float], low: float, high: float, rising: bool) -> float:
    """Newton's method in an interval, with bisection for steps that leave it or converge slowly."""
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
    """Return the least value on [0, 1] and its place, the largest and its place; exact but for rounding."""
    places = [0.0, *sign_changes(derivative(coefficients)), 1.0]
    values = [value(coefficients, x) for x in places]
    least, largest = min(values), max(values)
    return least, places[values.index(least)], largest, places[values.index(largest)]


def beyond(coefficients: Sequence[float], low: float, high: float) -> tuple[float, float] | None:
    """Return an extreme of the polynomial on [0, 1] that is outside [low, high], and its place; or None."""
    # The hull of the Bernstein coefficients contains the curve: a quick check that most pieces pass.
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
    """Return the spline's acceleration at each point; 0 at both ends, for a smooth start and end."""
    accelerations = [0.0] * len(times)
    for i in range(1, len(times) - 1):
        h = times[i + 1] - times[i]
        slope = (values[i + 1] - values[i]) / h
        accelerations[i] = (6.0 * slope - 4.0 * velocities[i] - 2.0 * velocities[i + 1]) / h
    return accelerations


def quaternion(rotation: Rotation) -> Quaternion:
    """Return the unit quaternion of a rotation, w >= 0 (Shepperd 1978: by the largest of the four)."""
    a, b, c, d, e, f, g, h, i = rotation
    w = sqrt(max(0.0, 1.0 + a + e + i))
    x = copysign(sqrt(max(0.0, 1.0 + a - e - i)), h - f)
    y = copysign(sqrt(max(0.0, 1.0 - a + e - i)), c - g)
    z = copysign(sqrt(max(0.0, 1.0 - a - e + i)), d - b)
    largest = max(w, fabs(x), fabs(y), fabs(z))
    if largest > w:
        # Near a half turn the differences that give the signs vanish: take the signs from products with the largest.
        if largest == fabs(x):
            w, x, y, z = (h - f) / largest, largest, (b + d) / largest, (c + g) / largest
        elif largest == fabs(y):
            w, x, y, z = (c - g) / largest, (b + d) / largest, largest, (f + h) / largest
        else:
            w, x, y, z = (d - b) / largest, (c + g) / largest, (f + h) / largest, largest
    size = copysign(hypot(w, x, y, z), w)
    return w / size, x / size, y / size, z / size


def rotation(q: Sequence[float]) -> Rotation:
    """Return the rotation of a quaternion of any norm."""
    w, x, y, z = q
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y),
    )  # fmt: skip


def turn_between(start: Sequence[float], end: Sequence[float]) -> tuple[Vector, float]:
    """Return axis, in the frame of `start`, and angle, 0 to pi, of the shorter rotation between two orientations."""
    (a, b, c, d), (w, x, y, z) = start, end
    # conj(start) * end
    turn_w = a * w + b * x + c * y + d * z
    turn_x = a * x - b * w - c * z + d * y
    turn_y = a * y + b * z - c * w - d * x
    turn_z = a * z - b * y + c * x - d * w
    size = hypot(turn_x, turn_y, turn_z)
    if size < _NO_TURN:
        return (0.0, 0.0, 1.0), 0.0
    sign = copysign(1.0 / size, turn_w)
    return (sign * turn_x, sign * turn_y, sign * turn_z), 2.0 * atan2(size, fabs(turn_w))


def turned_by(start: Rotation, axis: Vector, angle: float) -> Rotation:
    """Return `start` turned by `angle` about an axis of its own frame (Rodrigues)."""
    x, y, z = axis
    s, c = sin(angle), cos(angle)
    k = 1.0 - c
    return times(
        start,
        (
            c + k * x * x, k * x * y - s * z, k * x * z + s * y,
            k * x * y + s * z, c + k * y * y, k * y * z - s * x,
            k * x * z - s * y, k * y * z + s * x, c + k * z * z,
        ),
    )  # fmt: skip
