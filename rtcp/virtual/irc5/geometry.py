"""Forward kinematics of the controller, from the rows of an arm's file in `config/`.

Independent of `kinematics`, which the master's side uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, radians, sin, sqrt
from typing import NamedTuple

MM_PER_M = 1000.0


class FlangePose(NamedTuple):
    """Pose of the flange (ABB's tool0) in the base: mm, and the unit quaternion u0 (= w) to u3."""

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


class Geometry:
    """An arm of six joints."""

    def __init__(self, rows: Sequence[tuple[float, float, float, float]]) -> None:
        """`rows`: alpha (rad), a, d (m), offset (rad) of T(i-1, i) = Rx(alpha) Tx(a) Rz(q + offset) Tz(d)."""
        self._rows = tuple((cos(alpha), sin(alpha), a, d, offset) for alpha, a, d, offset in rows)

    def flange(self, joints: Sequence[float]) -> FlangePose:
        """Return the pose at joint angles in degrees; axes beyond the sixth are ignored."""
        # Orientation, by columns (xx, xy, xz), (yx, yy, yz), (zx, zy, zz), and position, m, of the current frame.
        xx = yy = zz = 1.0
        xy = xz = yx = yz = zx = zy = px = py = pz = 0.0
        for (ca, sa, a, d, offset), joint in zip(self._rows, joints, strict=False):
            angle = radians(joint) + offset
            c, s = cos(angle), sin(angle)
            # Rx(alpha) rotates y and z about x.
            bx, by, bz = ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz
            zx, zy, zz = ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz
            px, py, pz = px + a * xx + d * zx, py + a * xy + d * zy, pz + a * xz + d * zz
            # Rz(theta) rotates x and y about z.
            yx, yy, yz, xx, xy, xz = (
                c * bx - s * xx, c * by - s * xy, c * bz - s * xz, c * xx + s * bx, c * xy + s * by, c * xz + s * bz,
            )  # fmt: skip
        return FlangePose(
            (px * MM_PER_M, py * MM_PER_M, pz * MM_PER_M), _quaternion(xx, xy, xz, yx, yy, yz, zx, zy, zz)
        )


def _quaternion(xx: float, xy: float, xz: float, yx: float, yy: float, yz: float, zx: float, zy: float,
                zz: float) -> tuple[float, float, float, float]:  # fmt: skip
    """Return the quaternion of a rotation given by columns, from its largest component (Shepperd 1978)."""
    trace = xx + yy + zz
    largest = max(trace, xx, yy, zz)
    if largest == trace:
        u = (1.0 + trace, yz - zy, zx - xz, xy - yx)
    elif largest == xx:
        u = (yz - zy, 1.0 + xx - yy - zz, xy + yx, zx + xz)
    elif largest == yy:
        u = (zx - xz, xy + yx, 1.0 + yy - zz - xx, yz + zy)
    else:
        u = (xy - yx, zx + xz, yz + zy, 1.0 + zz - xx - yy)
    length = sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + u[3] * u[3])
    return u[0] / length, u[1] / length, u[2] / length, u[3] / length
