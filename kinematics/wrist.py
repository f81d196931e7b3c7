"""The last three joints of a spherical wrist: the angles of a given rotation.

The rotation of frame 6, seen from what joint 4 turns in, is M = Rz(theta4) Rx(alpha4) Rz(theta5) Rx(alpha5) Rz(theta6).
Its last column n, axis 6, does not depend on theta6:

    n = Rz(theta4) (sin5 sin(alpha5),  -cos(alpha4) cos5 sin(alpha5) - sin(alpha4) cos(alpha5),
                    cos(alpha4) cos(alpha5) - sin(alpha4) cos5 sin(alpha5))

The third entry gives theta5 up to its sign, the other two then theta4. With theta4 known, axis 5 is
v = Rz(theta4) (0, -sin(alpha4), cos(alpha4)), and v M = (sin(alpha5) sin6, sin(alpha5) cos6, cos(alpha5)): theta6 is
taken from there because it makes good what theta4 has lost beside the singularity, where only their sum is defined.
"""

from __future__ import annotations

from math import atan2, cos, pi, remainder, sin, sqrt, tau

from kinematics.pose import Rotation, times, turned
from kinematics.solution import FLIP, WRIST, Angles

_EDGE = 1e-14  # rad; nearer to the edge of the orientations that an oblique wrist reaches than this is on it


class RightAngledWrist:
    """A wrist whose neighbouring axes are at right angles; it reaches every orientation, always in two ways."""

    def __init__(self, sine4: float, sine5: float, free: float) -> None:
        """The sines of alpha4 and alpha5 (+-1), and the |sin theta5| below which joint 4 is free."""
        self._sine5 = sine5
        self._both = sine4 * sine5
        self._free = free

    def solve(self, rotation: Rotation, near4: float) -> tuple[Angles, ...]:
        """Both (theta4, theta5, theta6) with their bits; one, with theta4 = `near4`, where axes 4 and 6 coincide."""
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
        other = (theta4 + pi, -theta5, theta6 + pi)
        if self._sine5 > 0.0:
            return ((theta4, theta5, theta6, 0, 0), (*other, FLIP, 0))
        return ((*other, 0, 0), (theta4, theta5, theta6, FLIP, 0))

    def error(self, theta4: float, theta5: float, theta6: float, rotation: Rotation) -> float:
        """The sum of squares of what the rotation of these angles differs by: 2 angle^2 for a small angle."""
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
    """A wrist whose axes meet in one point at other angles; it reaches some orientations only."""

    def __init__(self, turn4: tuple[float, float], turn5: tuple[float, float], free: float) -> None:
        """(sine, cosine) of alpha4 and alpha5, and the sine between axes 4 and 6 below which joint 4 is free."""
        self._s4, self._c4 = turn4
        self._s5, self._c5 = turn5
        self._free = free
        alpha4, alpha5 = atan2(*turn4), atan2(*turn5)
        # between axes 4 and 6, at theta5 = 0 and at theta5 = pi
        self._at_zero, self._at_pi = abs(remainder(alpha4 + alpha5, tau)), abs(remainder(alpha4 - alpha5, tau))

    def solve(self, rotation: Rotation, near4: float) -> tuple[Angles, ...]:
        """All (theta4, theta5, theta6) with their bits: two, one on the edge and on the singularity, or none."""
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
        found = []
        around = atan2(ny, nx)
        for theta5 in angles:
            theta4 = around - atan2(-self._c4 * cos(theta5) * self._s5 - self._s4 * self._c5, sin(theta5) * self._s5)
            theta6 = self._last(sin(theta4), cos(theta4), rotation)
            found.append((theta4, theta5, theta6, FLIP if theta5 < 0.0 else 0, singular))
        return tuple(found)

    def shortfall(self, rotation: Rotation) -> float:
        """By what angle (rad) axis 6 would stay from the wanted one, 0 inside what the wrist reaches."""
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
        m00, m01, _, m10, m11, _, m20, m21, _ = rotation
        x, y, z = self._s4 * s4, -self._s4 * c4, self._c4
        return atan2((x * m00 + y * m10 + z * m20) / self._s5, (x * m01 + y * m11 + z * m21) / self._s5)


def _cosine_difference(one: float, other: float) -> float:
    """Cosine of `one` minus cosine of `other`, exact also where they are nearly equal."""
    return -2.0 * sin(0.5 * (one + other)) * sin(0.5 * (one - other))
