"""Why a pose has no solution, in a sentence. For failures only: nothing here runs when there is one."""

from __future__ import annotations

from kinematics.pose import Pose, orthonormality_error
from kinematics.spherical import SphericalArm
from kinematics.wrist import ObliqueWrist

_NO_ROTATION = 1e-10  # error of orthonormality that keeps a solution from being confirmed


def refuse_no_rotation(pose: Pose) -> None:
    """Raise ValueError for a pose whose rotation is none."""
    error = orthonormality_error(pose[1])
    if not error <= _NO_ROTATION:
        raise ValueError(f"the rotation of the pose is none: R R^T differs from 1 by {error:.3g}")


def why_none(arm: SphericalArm, pose: Pose) -> tuple[str, float]:
    """The sentence, and by how much (m) the wrist centre is out of reach: 0 where only the orientation is.

    ValueError when the rotation of the pose is none.
    """
    refuse_no_rotation(pose)
    point, rotation = arm.target(pose)
    branches = arm.arm.solve(*point, 0.0, 0.0)
    if not branches:
        gap = arm.arm.shortfall(*point)
        x, y, z = arm.wrist_centre(pose)
        return f"out of reach by {gap:.6g} m: the wrist centre cannot be brought to ({x:.6g}, {y:.6g}, {z:.6g}) m", gap
    if isinstance(arm.wrist, ObliqueWrist):
        inner = (arm.arm.confirm(*branch[:3], point, rotation) for branch in branches)
        missing = min((arm.wrist.shortfall(rotation) for rotation in inner if rotation is not None), default=0.0)
        if missing > 0.0:
            return f"out of reach by {missing:.6g} rad: the wrist cannot turn axis 6 so far", 0.0
    return "no solution was confirmed by forward kinematics", 0.0
