"""All solutions of an arm with a spherical wrist: joints 1 to 3 position the wrist centre, 4 to 6 orient the tool.

Joints 4 to 6 do not move the point where their axes meet (Pieper 1968). `position_ik` and `position_ik_general` solve
its position. The rotation that remains is M = Rz(theta4) Rx(alpha4) Rz(theta5) Rx(alpha5) Rz(theta6). Its last column
n, axis 6, does not depend on theta6:

    n = Rz(theta4) (sin5 sin(alpha5),  -cos(alpha4) cos5 sin(alpha5) - sin(alpha4) cos(alpha5),
                    cos(alpha4) cos(alpha5) - sin(alpha4) cos5 sin(alpha5))

The third entry gives theta5 up to its sign, the other two then theta4. With theta4 known, axis 5 is
v = Rz(theta4) (0, -sin(alpha4), cos(alpha4)), and v M = (sin(alpha5) sin6, sin(alpha5) cos6, cos(alpha5)) gives theta6.
This compensates the error of theta4 beside the singularity, where only the sum of the two is well defined.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, hypot, pi, remainder, sin, sqrt, tau
from typing import Final

from kinematics.model import ArmModel
from kinematics.pose import IDENTITY, Pose, Rotation, Vector, applied, times, transposed, turned
from kinematics.position_ik import PlanarArm
from kinematics.position_ik_general import GeneralArm
from kinematics.solution import BRANCHES, FLIP, SINGULARITIES, WRIST, Angles, AngleWrap, Solution, six

_ZERO: Final = 1e-12  # m: a shorter length counts as zero
_PARALLEL: Final = 1e-6  # sine of the angle below which two neighbouring axes count as parallel
_EDGE: Final = 1e-14  # rad: an orientation nearer to the edge of what an oblique wrist reaches is on it


def has_spherical_wrist(model: ArmModel) -> bool:
    """Whether axes 4, 5 and 6 meet in one point, to 1e-12 m, and none is parallel to the next."""
    five, six = model.rows[4], model.rows[5]
    sines = (model.constants[4][0], model.constants[5][0])
    return max(abs(five.a), abs(five.d), abs(six.a)) < _ZERO and min(map(abs, sines)) > _PARALLEL


class SphericalArm:
    """Solver for an arm with a spherical wrist; the constructor computes everything that is constant."""

    def __init__(self, model: ArmModel) -> None:
        """Requires `has_spherical_wrist(model)`; `solve` also requires `is_regular`."""
        first, last = model.rows[0], model.rows[5]
        self.model = model
        general = GeneralArm(model)
        self.is_regular = general.is_regular()
        self.parallel = model.constants[2][0] == 0.0
        self.arm: PlanarArm | GeneralArm = PlanarArm(model) if self.parallel else general
        self.offsets = six(row.offset for row in model.rows)
        self.wrap = AngleWrap(model)
        self._tool = transposed(model.tool.rotation)
        x, y, z = model.tool.position
        self._tool_is_straight = model.tool.rotation == IDENTITY.rotation
        # from the wrist centre to the tool, in the tool frame
        self._lever = applied(self._tool, (x, y, z + last.d))
        self._base = transposed(turned(*model.constants[0][:2], 0.0))
        self._base_is_straight = self._base == IDENTITY.rotation
        self._a0, self._d1 = first.a, first.d
        # These errors of wrist centre and rotation together keep the tool within 1e-9 m and 1e-9 rad.
        accuracy = 5e-10 / max(1.0, hypot(*self._lever))
        self.confirmed = 2.0 * accuracy * accuracy
        turn4, turn5 = model.constants[4][:2], model.constants[5][:2]
        self._oblique = ObliqueWrist(turn4, turn5, 0.8 * accuracy)
        self.wrist: RightAngledWrist | ObliqueWrist = self._oblique
        if turn4[1] == 0.0 and turn5[1] == 0.0:
            self.wrist = RightAngledWrist(turn4[0], turn5[0], 0.8 * accuracy)

    def numbers(self) -> dict[str, float | tuple[float, ...]]:
        """The constants by their names in `solver.c`, without those of joints 1 to 3."""
        return {
            "A0": self._a0, "D1": self._d1, "BASE_INVERSE": self._base, "TOOL_INVERSE": self._tool,
            "LEVER": self._lever, "CONFIRMED": self.confirmed, "LIMIT_SLACK": self.wrap.slack,
            **self._oblique.numbers(),
        }  # fmt: skip

    def target(self, pose: Pose) -> tuple[Vector, Rotation]:
        """Wrist centre and rotation of frame 6 for a tool pose, in the fixed frame that `PlanarArm` uses."""
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
        """Wrist centre for a tool pose, in the base frame."""
        dx, dy, dz = applied(pose[1], self._lever)
        x, y, z = pose[0]
        return x - dx, y - dy, z - dz

    def solve(self, point: Vector, rotation: Rotation, near: Sequence[float]) -> list[Solution]:
        """All solutions for the wrist centre `point` (m) and `rotation` of `target`, confirmed by forward kinematics.

        A free joint stays at `near` (six angles, rad).
        """
        o1, o2, o3, o4, o5, o6 = self.offsets
        near4 = near[3] + o4
        confirm, into_limits = self.arm.confirm, self.wrap.into_limits
        wrist, error, confirmed = self.wrist.solve, self.wrist.error, self.confirmed
        solutions = []
        for theta1, theta2, theta3, arm_bits, arm_singular in self.arm.solve(*point, near[0] + o1, near[1] + o2):
            inner = confirm(theta1, theta2, theta3, point, rotation)
            if inner is None:
                continue
            arm, arm_outside = into_limits(0, theta1 - o1, theta2 - o2, theta3 - o3)
            for theta4, theta5, theta6, bits, singular in wrist(inner, near4):
                if error(theta4, theta5, theta6, inner) <= confirmed:
                    hand, outside = into_limits(3, theta4 - o4, theta5 - o5, theta6 - o6)
                    outside = arm_outside + outside
                    branch, singularity = BRANCHES[arm_bits | bits], SINGULARITIES[arm_singular | singular]
                    solutions.append(Solution((*arm, *hand), branch, not outside, outside, singularity))
        return solutions


class RightAngledWrist:
    """A wrist whose neighbouring axes are at right angles; it reaches every orientation in two ways."""

    def __init__(self, sine4: float, sine5: float, free: float) -> None:
        """`sine4` and `sine5` of alpha4 and alpha5 are +-1; below |sin theta5| = `free` joint 4 is free."""
        self._sine5 = sine5
        self._both = sine4 * sine5
        self._free = free

    def solve(self, rotation: Rotation, near4: float) -> tuple[Angles, ...]:
        """Both (theta4, theta5, theta6) with their bits; one with theta4 = `near4` where axes 4 and 6 coincide."""
        m00, m01, nx, m10, m11, ny, _, _, nz = rotation
        both = self._both
        sine = sqrt(nx * nx + ny * ny)
        if sine < self._free:
            s4, c4 = sin(near4), cos(near4)
            theta6 = atan2(both * (s4 * m00 - c4 * m10), both * (s4 * m01 - c4 * m11))
            return ((near4, 0.0 if both * nz < 0.0 else pi, theta6, 0, WRIST),)
        theta4 = atan2(ny, nx)
        theta5 = atan2(self._sine5 * sine, -both * nz)
        theta6 = atan2(both * (ny * m00 - nx * m10), both * (ny * m01 - nx * m11))
        flipped = (theta4 + pi, -theta5, theta6 + pi)
        if self._sine5 > 0.0:
            return ((theta4, theta5, theta6, 0, 0), (*flipped, FLIP, 0))
        return ((*flipped, 0, 0), (theta4, theta5, theta6, FLIP, 0))

    def error(self, theta4: float, theta5: float, theta6: float, rotation: Rotation) -> float:
        """Sum of squares of the entries by which the rotation of these angles differs: 2 angle^2 if small."""
        s4, c4, s5, c5, s6, c6 = sin(theta4), cos(theta4), sin(theta5), cos(theta5), sin(theta6), cos(theta6)
        sine5, both = self._sine5, self._both
        sine4 = both * sine5
        # Rx(alpha4) Rz(theta5) Rx(alpha5) has the rows (c5, 0, sine5 s5), (0, -both, 0), (sine4 s5, 0, -both c5)
        m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotation
        ax, ay = c5 * c6, -c5 * s6
        bx, by = -both * s6, -both * c6
        az = sine5 * s5
        e00, e01, e02 = c4 * ax - s4 * bx - m00, c4 * ay - s4 * by - m01, c4 * az - m02
        e10, e11, e12 = s4 * ax + c4 * bx - m10, s4 * ay + c4 * by - m11, s4 * az - m12
        e20, e21, e22 = sine4 * s5 * c6 - m20, -sine4 * s5 * s6 - m21, -both * c5 - m22
        return (
            e00 * e00 + e01 * e01 + e02 * e02 + e10 * e10 + e11 * e11 + e12 * e12
            + e20 * e20 + e21 * e21 + e22 * e22
        )  # fmt: skip


class ObliqueWrist:
    """A wrist whose axes meet at other angles; it reaches some orientations only."""

    def __init__(self, turn4: tuple[float, float], turn5: tuple[float, float], free: float) -> None:
        """`turn4` and `turn5`: (sine, cosine) of alpha4 and alpha5; below the sine `free` between axes 4 and 6, joint 4
        is free.
        """
        self._s4, self._c4 = turn4
        self._s5, self._c5 = turn5
        self._free = free
        alpha4, alpha5 = atan2(*turn4), atan2(*turn5)
        # angle between axes 4 and 6 at theta5 = 0 and at theta5 = pi
        self._at_zero, self._at_pi = abs(remainder(alpha4 + alpha5, tau)), abs(remainder(alpha4 - alpha5, tau))

    def numbers(self) -> dict[str, float]:
        """The constants by their names in `solver.c`."""
        return {
            "SINE4": self._s4, "COSINE4": self._c4, "SINE5": self._s5, "COSINE5": self._c5,
            "AT_ZERO": self._at_zero, "AT_PI": self._at_pi, "FREE": self._free,
        }  # fmt: skip

    def solve(self, rotation: Rotation, near4: float) -> tuple[Angles, ...]:
        """All (theta4, theta5, theta6) with their bits: two, one at an edge or on the singularity, or none."""
        _, _, nx, _, _, ny, _, _, nz = rotation
        sine = sqrt(nx * nx + ny * ny)
        between = atan2(sine, nz)
        zero, half = self._at_zero, self._at_pi
        # 1 - cos5 and 1 + cos5, as products because they vanish at the edges
        less = _cosine_difference(between, zero) / (self._s4 * self._s5)
        more = _cosine_difference(half, between) / (self._s4 * self._s5)
        if sine < self._free and min(abs(between - zero), abs(between - half)) < self._free:
            s4, c4 = sin(near4), cos(near4)
            return ((near4, 0.0 if less < more else pi, self._last(s4, c4, rotation), 0, WRIST),)
        singular = 0
        for edge in (zero, half):
            outside = edge - between if edge < 0.5 * (zero + half) else between - edge
            if outside > self._free:
                return ()
            if outside > -_EDGE and 0.0 < edge < pi:
                singular = WRIST
        if singular:
            angles = [0.0 if less < more else pi]
        else:
            theta5 = 2.0 * atan2(sqrt(max(less, 0.0)), sqrt(max(more, 0.0)))
            angles = [theta5, -theta5]
        solutions = []
        around = atan2(ny, nx)
        for theta5 in angles:
            theta4 = around - atan2(-self._c4 * cos(theta5) * self._s5 - self._s4 * self._c5, sin(theta5) * self._s5)
            theta6 = self._last(sin(theta4), cos(theta4), rotation)
            solutions.append((theta4, theta5, theta6, FLIP if theta5 < 0.0 else 0, singular))
        return tuple(solutions)

    def shortfall(self, rotation: Rotation) -> float:
        """Angle, rad, from the wanted axis 6 to the nearest one within reach; 0 when it is in reach."""
        between = atan2(sqrt(rotation[2] * rotation[2] + rotation[5] * rotation[5]), rotation[8])
        lowest, highest = sorted((self._at_zero, self._at_pi))
        return max(lowest - between, between - highest, 0.0)

    def error(self, theta4: float, theta5: float, theta6: float, rotation: Rotation) -> float:
        """As `RightAngledWrist.error`."""
        actual = turned(0.0, 1.0, theta4)
        for sine, cosine, angle in ((self._s4, self._c4, theta5), (self._s5, self._c5, theta6)):
            actual = times(actual, turned(sine, cosine, angle))
        return sum((is_at - wanted) ** 2 for is_at, wanted in zip(actual, rotation, strict=True))

    def _last(self, s4: float, c4: float, rotation: Rotation) -> float:
        """Angle theta6, rad, for sine and cosine of theta4."""
        m00, m01, _, m10, m11, _, m20, m21, _ = rotation
        x, y, z = self._s4 * s4, -self._s4 * c4, self._c4
        return atan2((x * m00 + y * m10 + z * m20) / self._s5, (x * m01 + y * m11 + z * m21) / self._s5)


def _cosine_difference(a: float, b: float) -> float:
    """cos(a) - cos(b), without cancellation where they are nearly equal."""
    return -2.0 * sin(0.5 * (a + b)) * sin(0.5 * (a - b))
