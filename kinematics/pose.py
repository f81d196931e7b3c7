"""Poses as plain floats: positions, rotations and the three angles of a rotation.

A rotation is a 3x3 matrix, row by row in a tuple of nine. Its angles are those of R = Rx(rx) Ry(ry) Rz(rz).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

Vector: TypeAlias = tuple[float, float, float]
Rotation: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]

# cos(ry) below which the two outer axes coincide: only rx + rz or rx - rz is then defined.
_SINGULAR_COSINE: Final = 1e-12


def as_floats(values: Sequence[float]) -> Sequence[float]:
    """Return the values as compiled code accepts them: a list or tuple unchanged, others as a list of floats."""
    return values if type(values) is list or type(values) is tuple else [float(value) for value in values]


def require_finite(values: Iterable[float], names: Iterable[str]) -> None:
    """Raise ValueError naming the first value that is NaN or infinite; `names` may be the longer of the two."""
    for value, name in zip(values, names):  # noqa: B905
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}; a finite number is required")


def rotation_from_rpy(rx: float, ry: float, rz: float) -> Rotation:
    """R = Rx(rx) Ry(ry) Rz(rz), angles in rad."""
    sx, cx, sy, cy, sz, cz = math.sin(rx), math.cos(rx), math.sin(ry), math.cos(ry), math.sin(rz), math.cos(rz)
    return (
        cy * cz, -cy * sz, sy,
        cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy,
        sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy,
    )  # fmt: skip


def turned(sine: float, cosine: float, theta: float) -> Rotation:
    """Rx(alpha) Rz(theta), the rotation of one Denavit-Hartenberg row; sine and cosine of alpha, theta in rad."""
    s, c = math.sin(theta), math.cos(theta)
    return c, -s, 0.0, cosine * s, cosine * c, -sine, sine * s, sine * c, cosine


def times(one: Rotation, other: Rotation) -> Rotation:
    """The product of two rotations."""
    a, b, c, d, e, f, g, h, i = one
    j, k, m, n, o, p, q, r, s = other
    return (
        a * j + b * n + c * q, a * k + b * o + c * r, a * m + b * p + c * s,
        d * j + e * n + f * q, d * k + e * o + f * r, d * m + e * p + f * s,
        g * j + h * n + i * q, g * k + h * o + i * r, g * m + h * p + i * s,
    )  # fmt: skip


def transposed(rotation: Rotation) -> Rotation:
    """The inverse of a rotation."""
    a, b, c, d, e, f, g, h, i = rotation
    return a, d, g, b, e, h, c, f, i


def applied(rotation: Rotation, vector: Vector) -> Vector:
    """The rotated vector."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = vector
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def rpy_from_rotation(rotation: Rotation) -> Vector:
    """The angles (rx, ry, rz), rad, with R = Rx(rx) Ry(ry) Rz(rz), ry in [-pi/2, pi/2], rx and rz in [-pi, pi].

    At ry = +-pi/2 only rx + rz (or rx - rz) is defined: rz = 0 by convention, and rx is the whole angle.
    """
    _, _, r02, r10, r11, r12, r20, r21, r22 = rotation
    cosine = math.hypot(r12, r22)
    ry = math.atan2(r02, cosine)
    if cosine < _SINGULAR_COSINE:
        return math.atan2(r21, r11), ry, 0.0
    rx = math.atan2(-r12, r22)
    sx, cx = math.sin(rx), math.cos(rx)
    # rz from Rx(-rx) R instead of r00, r01: beside the singular orientation the error of rx then cancels in R
    return rx, ry, math.atan2(cx * r10 + sx * r20, cx * r11 + sx * r21)


def rpy_batch(rotations: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """`rpy_from_rotation` of N matrices, (N, 3, 3): angles (N, 3), rad."""
    import numpy as np  # here, because the loop's process imports this module and must not load numpy

    r = rotations
    cosine = np.hypot(r[:, 1, 2], r[:, 2, 2])
    singular = cosine < _SINGULAR_COSINE
    rx = np.where(singular, np.arctan2(r[:, 2, 1], r[:, 1, 1]), np.arctan2(-r[:, 1, 2], r[:, 2, 2]))
    sx, cx = np.sin(rx), np.cos(rx)
    rz = np.arctan2(cx * r[:, 1, 0] + sx * r[:, 2, 0], cx * r[:, 1, 1] + sx * r[:, 2, 1])
    return np.column_stack([rx, np.arctan2(r[:, 0, 2], cosine), np.where(singular, 0.0, rz)])


def orthonormality_error(rotation: Rotation) -> float:
    """The largest entry of R R^T - 1: 0 for a rotation; 2 for a reflection."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    determinant = (
        r00 * (r11 * r22 - r12 * r21) - r01 * (r10 * r22 - r12 * r20) + r02 * (r10 * r21 - r11 * r20)
    )  # fmt: skip
    if determinant < 0.0:
        return 2.0
    return max(
        abs(r00 * r00 + r01 * r01 + r02 * r02 - 1.0),
        abs(r10 * r10 + r11 * r11 + r12 * r12 - 1.0),
        abs(r20 * r20 + r21 * r21 + r22 * r22 - 1.0),
        abs(r00 * r10 + r01 * r11 + r02 * r12),
        abs(r00 * r20 + r01 * r21 + r02 * r22),
        abs(r10 * r20 + r11 * r21 + r12 * r22),
    )


class Pose(NamedTuple):
    """A frame's `position` (3), m, and `rotation` (9), row by row; the columns of the matrix are the frame's axes."""

    position: Vector
    rotation: Rotation

    @classmethod
    def from_xyzrpy(cls, x: float, y: float, z: float, rx: float, ry: float, rz: float) -> Pose:
        """The pose at x, y, z (m) with R = Rx(rx) Ry(ry) Rz(rz) (rad); ValueError names a value that is not finite."""
        require_finite((x, y, z, rx, ry, rz), ("x", "y", "z", "rx", "ry", "rz"))
        return cls((float(x), float(y), float(z)), rotation_from_rpy(rx, ry, rz))

    @property
    def rpy(self) -> Vector:
        """The angles (rx, ry, rz), rad, as `rpy_from_rotation` defines them."""
        return rpy_from_rotation(self.rotation)

    def __matmul__(self, other: Pose) -> Pose:
        """Compose two transforms: A <- C from A <- B (this one) and B <- C (`other`)."""
        x, y, z = applied(self.rotation, other.position)
        px, py, pz = self.position
        return Pose((px + x, py + y, pz + z), times(self.rotation, other.rotation))

    def inverse(self) -> Pose:
        """The inverse transform: B <- A from A <- B."""
        back = transposed(self.rotation)
        x, y, z = applied(back, self.position)
        return Pose((-x, -y, -z), back)

    def require_finite(self) -> None:
        """Raise ValueError naming the first entry that is NaN or infinite."""
        require_finite(self.position, ("x", "y", "z"))
        require_finite(self.rotation, (f"rotation[{row}][{column}]" for row in range(3) for column in range(3)))


IDENTITY = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
