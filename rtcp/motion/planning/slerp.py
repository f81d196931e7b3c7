"""Orientations between two: unit quaternions (w, x, y, z) outside the cycle, a turn about a fixed axis in it."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, copysign, cos, fabs, hypot, sin, sqrt
from typing import TypeAlias

from kinematics.pose import Rotation, Vector, times

Quaternion: TypeAlias = tuple[float, float, float, float]
_NO_TURN = 1e-12


def quaternion(rotation: Rotation) -> Quaternion:
    """Return the unit quaternion of a rotation, w >= 0 (Shepperd 1978: by the largest of the four)."""
    a, b, c, d, e, f, g, h, i = rotation
    w = sqrt(max(0.0, 1.0 + a + e + i))
    x = copysign(sqrt(max(0.0, 1.0 + a - e - i)), h - f)
    y = copysign(sqrt(max(0.0, 1.0 - a + e - i)), c - g)
    z = copysign(sqrt(max(0.0, 1.0 - a - e + i)), d - b)
    largest = max(w, fabs(x), fabs(y), fabs(z))
    if largest > w:
        # Near a half turn the differences that give the signs vanish: the products of the largest give them.
        if largest == fabs(x):
            w, x, y, z = (h - f) / largest, largest, (b + d) / largest, (c + g) / largest
        elif largest == fabs(y):
            w, x, y, z = (c - g) / largest, (b + d) / largest, largest, (f + h) / largest
        else:
            w, x, y, z = (d - b) / largest, (c + g) / largest, (f + h) / largest, largest
    size = copysign(hypot(w, x, y, z), w)
    return w / size, x / size, y / size, z / size


def rotation(q: Sequence[float]) -> Rotation:
    """Return the rotation of a quaternion, whose size does not matter."""
    w, x, y, z = q
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y),
    )  # fmt: skip


def turn_between(start: Sequence[float], end: Sequence[float]) -> tuple[Vector, float]:
    """Return axis, in the frame of `start`, and angle, 0 to pi, of the shorter turn between two orientations."""
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
