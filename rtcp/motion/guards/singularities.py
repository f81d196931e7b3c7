"""How far a configuration is from the shoulder's, the elbow's and the wrist's singularity, for every cycle.

The same distances as `kinematics.singularity_distances`, which takes too long: with axis 2 parallel to axis 3 and
a spherical wrist, each is one factor of the Jacobian's determinant.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, sqrt
from typing import NamedTuple

from kinematics.jacobian import singularity_distances
from kinematics.model import JOINTS, ArmModel
from kinematics.pose import Pose

_SOMEWHERE = [0.2] * JOINTS


class Distances(NamedTuple):
    """Shoulder: m of the wrist centre from the plane of axes 1 and 2; elbow, wrist: rad. Infinite: there is none."""

    shoulder: float
    elbow: float
    wrist: float


class Singularities:
    """The singularities of an arm.

    Args:
        model: the geometry; which of the three it has is found out once.
    """

    def __init__(self, model: ArmModel) -> None:
        shoulder, _, wrist, _ = singularity_distances(model, _SOMEWHERE)
        self._has_arm, self._has_wrist = shoulder is not None, wrist is not None
        self._scale = 1.0 / (model.constants[4][0] * model.constants[5][0]) if self._has_wrist else 0.0

    def distances(self, poses: Sequence[Pose]) -> Distances:
        """Return the three for the `frames` of a configuration."""
        shoulder = elbow = wrist = float("inf")
        fourth, fifth = poses[3], poses[4]
        if self._has_wrist:
            _, _, ax, _, _, ay, _, _, az = fourth[1]
            _, _, bx, _, _, by, _, _, bz = fifth[1]
            _, _, cx, _, _, cy, _, _, cz = poses[5][1]
            sine = (ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)) * self._scale
            sine = sine if sine >= 0.0 else -sine
            wrist = asin(sine if sine < 1.0 else 1.0)
        if self._has_arm:
            (px, py, pz), (_, _, ax, _, _, ay, _, _, az) = poses[0]
            (sx, sy, sz), (_, _, bx, _, _, by, _, _, bz) = poses[1]
            ex, ey, ez = poses[2][0]
            wx, wy, wz = fifth[0]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            off = (nx * (wx - px) + ny * (wy - py) + nz * (wz - pz)) / sqrt(nx * nx + ny * ny + nz * nz)
            shoulder = off if off >= 0.0 else -off
            ux, uy, uz, fx, fy, fz = ex - sx, ey - sy, ez - sz, wx - ex, wy - ey, wz - ez
            across = bx * (uy * fz - uz * fy) + by * (uz * fx - ux * fz) + bz * (ux * fy - uy * fx)
            # Along axis 2 both may be displaced, which moves nothing: only what is perpendicular to it counts.
            along = ux * fx + uy * fy + uz * fz - (ux * bx + uy * by + uz * bz) * (fx * bx + fy * by + fz * bz)
            elbow = atan2(across if across >= 0.0 else -across, along if along >= 0.0 else -along)
        return Distances(shoulder, elbow, wrist)
