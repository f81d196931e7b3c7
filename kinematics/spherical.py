"""Inverse kinematics of arms with a spherical wrist: the wrist centre by joints 1 to 3, the orientation by 4 to 6.

Joints 4 to 6 do not move the point in which their axes meet (Pieper 1968). So where that point has to be is a problem
of three joints, for `planar` or `regional`, and the rotation that is left is one for `wrist`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

from kinematics.model import ArmModel
from kinematics.planar import PlanarArm
from kinematics.pose import IDENTITY, Pose, Rotation, Vector, applied, times, transposed, turned
from kinematics.regional import GeneralArm
from kinematics.solution import BRANCHES, SINGULARITIES, Solution, six
from kinematics.turns import Turns
from kinematics.wrist import ObliqueWrist, RightAngledWrist

_ZERO = 1e-12  # m: a length of the table that is meant to be none
_PARALLEL = 1e-6  # sine of the angle below which two neighbouring axes are no pair to solve for


def has_spherical_wrist(model: ArmModel) -> bool:
    """Whether axes 4, 5 and 6 meet in one point, exactly, and none is parallel to the next."""
    five, six = model.rows[4], model.rows[5]
    sines = (model.constants[4][0], model.constants[5][0])
    return max(abs(five.a), abs(five.d), abs(six.a)) < _ZERO and min(map(abs, sines)) > _PARALLEL


class SphericalArm:
    """All that is constant in the inverse kinematics of an arm with a spherical wrist, and the solution of a pose."""

    def __init__(self, model: ArmModel) -> None:
        """`has_spherical_wrist(model)` must hold. Where `is_regular` then does not, nothing may be solved."""
        first, last = model.rows[0], model.rows[5]
        self.model = model
        general = GeneralArm(model)
        self.is_regular = general.is_regular()
        self.parallel = model.constants[2][0] == 0.0
        self.arm: PlanarArm | GeneralArm = PlanarArm(model) if self.parallel else general
        self.offsets = six(row.offset for row in model.rows)
        self.turns = Turns(model)
        self._tool = transposed(model.tool.rotation)
        x, y, z = model.tool.position
        self._tool_is_straight = model.tool.rotation == IDENTITY.rotation
        # from the wrist centre to the tool, in the tool's frame
        self._lever = applied(self._tool, (x, y, z + last.d))
        self._base = transposed(turned(*model.constants[0][:2], 0.0))
        self._base_is_straight = self._base == IDENTITY.rotation
        self._a0, self._d1 = first.a, first.d
        # Wrist centre and rotation together keep the tool within 1e-9 m and 1e-9 rad
        accuracy = 5e-10 / max(1.0, hypot(*self._lever))
        self.confirmed = 2.0 * accuracy * accuracy
        turn4, turn5 = model.constants[4][:2], model.constants[5][:2]
        self.wrist: RightAngledWrist | ObliqueWrist
        if turn4[1] == 0.0 and turn5[1] == 0.0:
            self.wrist = RightAngledWrist(turn4[0], turn5[0], 0.8 * accuracy)
        else:
            self.wrist = ObliqueWrist(turn4, turn5, 0.8 * accuracy)

    def target(self, pose: Pose) -> tuple[Vector, Rotation]:
        """Where a tool pose has the wrist centre and frame 6, seen from what joint 1 turns in."""
        (x, y, z), rotation = pose
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
        wx, wy, wz = self._lever
        x -= r00 * wx + r01 * wy + r02 * wz + self._a0
        y -= r10 * wx + r11 * wy + r12 * wz
        z -= r20 * wx + r21 * wy + r22 * wz
        if not self._tool_is_straight:
            rotation = times(rotation, self._tool)
        if not self._base_is_straight:
            x, y, z = applied(self._base, (x, y, z))
            rotation = times(self._base, rotation)
        return (x, y, z - self._d1), rotation

    def wrist_centre(self, pose: Pose) -> Vector:
        """Where a tool pose has the wrist centre, in the base frame."""
        dx, dy, dz = applied(pose[1], self._lever)
        x, y, z = pose[0]
        return x - dx, y - dy, z - dz

    def solve(self, point: Vector, rotation: Rotation, near: Sequence[float]) -> list[Solution]:
        """All solutions of a target, each confirmed by forward kinematics; a free joint stays at `near` (rad)."""
        o1, o2, o3, o4, o5, o6 = self.offsets
        near4 = near[3] + o4
        confirm, into_limits = self.arm.confirm, self.turns.into_limits
        wrist, error, confirmed = self.wrist.solve, self.wrist.error, self.confirmed
        found = []
        for theta1, theta2, theta3, arm_bits, arm_singular in self.arm.solve(*point, near[0] + o1, near[1] + o2):
            inner = confirm(theta1, theta2, theta3, point, rotation)
            if inner is None:
                continue
            arm, beyond = into_limits(0, theta1 - o1, theta2 - o2, theta3 - o3)
            for theta4, theta5, theta6, bits, singular in wrist(inner, near4):
                if error(theta4, theta5, theta6, inner) <= confirmed:
                    hand, outside = into_limits(3, theta4 - o4, theta5 - o5, theta6 - o6)
                    outside = beyond + outside
                    branch, singularity = BRANCHES[arm_bits | bits], SINGULARITIES[arm_singular | singular]
                    found.append(Solution((*arm, *hand), branch, not outside, outside, singularity))
        return found
