"""How near a configuration is to each singularity, in a few us; `kinematics.singularity_distances` is the reference."""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, hypot

from kinematics.pose import Pose


def nearness(poses: Sequence[Pose]) -> tuple[float, float, float]:
    """Return the distances of shoulder (m), elbow and wrist (rad) for `frames` of an arm with parallel axes 2 and 3.

    The wrist's angle supposes axes 4, 5, 6 at right angles to one another in turn.
    """
    first, second, third, fourth, fifth, sixth = poses[:6]
    a, b = first.rotation, second.rotation
    ax, ay, az, bx, by, bz = a[2], a[5], a[8], b[2], b[5], b[8]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    (ox, oy, oz), (sx, sy, sz), (ex, ey, ez) = first.position, second.position, third.position
    cx, cy, cz = fifth.position
    shoulder = abs(nx * (cx - ox) + ny * (cy - oy) + nz * (cz - oz)) / hypot(nx, ny, nz)
    ux, uy, uz, fx, fy, fz = ex - sx, ey - sy, ez - sz, cx - ex, cy - ey, cz - ez
    across = abs(bx * (uy * fz - uz * fy) + by * (uz * fx - ux * fz) + bz * (ux * fy - uy * fx))
    along = (ux * fx + uy * fy + uz * fz) - (ux * bx + uy * by + uz * bz) * (fx * bx + fy * by + fz * bz)
    d, e, f = fourth.rotation, fifth.rotation, sixth.rotation
    px, py, pz, qx, qy, qz = e[2], e[5], e[8], f[2], f[5], f[8]
    volume = abs(d[2] * (py * qz - pz * qy) + d[5] * (pz * qx - px * qz) + d[8] * (px * qy - py * qx))
    return shoulder, atan2(across, abs(along)), asin(volume if volume < 1.0 else 1.0)
