"""Inverse kinematics of any arm of the model: chooses the method that its geometry allows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from kinematics.model import JOINTS, ArmModel
from kinematics.near import solve_near
from kinematics.numeric import NumericResult, solve_numeric
from kinematics.pose import Pose, require_finite
from kinematics.reasons import refuse_no_rotation, why_none
from kinematics.solution import Near, Singularity, Solution, Solutions
from kinematics.spherical import SphericalArm, has_spherical_wrist
from kinematics.turns import Turns

Method = Literal["spherical wrist, parallel axes 2 and 3", "spherical wrist, general", "numeric"]


class InverseKinematics:
    """Joint angles for tool poses of one arm; everything that is constant is computed once, here.

    `method` says how: in closed form where axes 4 to 6 meet in one point (with axes 2 and 3 parallel by a triangle,
    otherwise by Pieper's quartic), else numerically. All that is called afterwards computes with plain floats, imports
    nothing, and keeps no state.
    """

    def __init__(self, model: ArmModel) -> None:
        self.model = model
        self.method: Method = "numeric"
        self._arm: SphericalArm | None = None
        if has_spherical_wrist(model):
            arm = SphericalArm(model)
            if arm.is_regular:
                self._arm = arm
                self.method = "spherical wrist, parallel axes 2 and 3" if arm.parallel else "spherical wrist, general"
        self._home = tuple(min(max(0.0, limit.lower), limit.upper) for limit in model.limits)

    def solve(self, pose: Pose, q_near: Sequence[float] | None = None) -> Solutions:
        """All configurations that bring the tool to `pose` (base frame), each confirmed by forward kinematics.

        Joint limits are told of, not kept. On a singularity the solutions are given that leave the free joint at
        `q_near` (six rad; default: zero, or the limit nearest to it). Numerically: one solution, the one found from
        there, inside the limits if one is found. Raises ValueError for numbers that are not finite, naming them, and
        for a rotation that is none.
        """
        near = self._home if q_near is None else q_near
        _require_finite(self.model, pose, near)
        if self._arm is None:
            return self._solve_numeric(pose, near)
        point, rotation = self._arm.target(pose)
        solutions = self._arm.solve(point, rotation, near)
        if solutions:
            return Solutions(tuple(solutions), None)
        return Solutions((), why_none(self._arm, pose)[0])

    def solve_near(self, pose: Pose, q_near: Sequence[float]) -> Near:
        """The solution inside the joint limits that is nearest to `q_near` (six rad), or why there is none.

        Nearest is the one whose joint that moves most moves least, turns of 2 pi considered; so along a continuous
        motion it is the branch that continues. It may still be far away, where no near one exists: how large a step may
        be is for the caller to say. A joint that is free on a singularity stays where it is. Raises ValueError as
        `solve`.
        """
        _require_finite(self.model, pose, q_near)
        if self._arm is None:
            return self._near_numeric(pose, q_near)
        return solve_near(self._arm, pose, q_near)

    def solve_nearest(self, pose: Pose, q_near: Sequence[float]) -> NumericResult:
        """The configuration inside the joint limits that comes as near to `pose` as the numeric method can get.

        For a pose out of reach, and for any arm; outside the loop: it takes milliseconds. Raises ValueError as `solve`.
        """
        return solve_numeric(self.model, pose, q_near)

    def _solve_numeric(self, pose: Pose, q_near: Sequence[float]) -> Solutions:
        refuse_no_rotation(pose)
        result = solve_numeric(self.model, pose, q_near)
        if not result.converged:
            result = solve_numeric(self.model, pose, q_near, respect_limits=False)
        if not result.converged:
            return Solutions((), _nearest(result))
        turns = Turns(self.model)
        (arm, beyond), (hand, outside) = turns.into_limits(0, *result.q[:3]), turns.into_limits(3, *result.q[3:])
        outside = beyond + outside
        return Solutions((Solution((*arm, *hand), None, not outside, outside, Singularity.NONE),), None)

    def _near_numeric(self, pose: Pose, q_near: Sequence[float]) -> Near:
        refuse_no_rotation(pose)
        result = solve_numeric(self.model, pose, q_near)
        if result.converged:
            return Near(result.q, "", Singularity.NONE, 0.0, -1)
        return Near(None, _nearest(result), Singularity.NONE, result.position_error, -1)


def _nearest(result: NumericResult) -> str:
    return (
        f"no solution was found inside the joint limits: the nearest stays away by {result.position_error:.6g} m and "
        f"{result.rotation_error:.6g} rad"
    )


def _require_finite(model: ArmModel, pose: Pose, q_near: Sequence[float]) -> None:
    """One sum finds whether a number is not finite; only then each is looked at."""
    if len(q_near) != JOINTS:
        raise ValueError(f"q_near has {len(q_near)} joint angles: {JOINTS} are needed")
    (x, y, z), (a, b, c, d, e, f, g, h, i) = pose
    q1, q2, q3, q4, q5, q6 = q_near
    rest = x + y + z + a + b + c + d + e + f + g + h + i + q1 + q2 + q3 + q4 + q5 + q6
    if rest - rest != 0.0:
        Pose(*pose).require_finite()
        require_finite(q_near, (f"{name} of q_near" for name in model.joint_names))
