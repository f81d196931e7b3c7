"""Position inverse kinematics: joints 1 to 3 for a wrist centre, where axes 2 and 3 are parallel (nearly all arms).

With f = (fx, fy) the wrist centre seen from axis 2, in the plane of the upper arm and the forearm, and h its constant
height along axis 2, the wrist centre in frame 1 is

    (a1 + fx,  cos(alpha1) fy - sin(alpha1) h,  sin(alpha1) fy + cos(alpha1) h)

Its z is that of the target and gives fy; its y is then known, and the distance from axis 1 gives x = a1 + fx up to
the sign: front or back. The triangle with the sides a2 (upper arm), l (forearm) and |f| remains: elbow up or down.
For other arms see `position_ik_general`.
"""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, cos, hypot, inf, pi, sin, sqrt, tau
from typing import Final

from kinematics.model import ArmModel
from kinematics.pose import Rotation, Vector
from kinematics.solution import BACK, CONFIRMED, DOWN, ELBOW, ON_EDGE, SHOULDER, SLACK, Angles

_SAMPLES: Final = 48
_VALLEYS: Final = 2
_GOLDEN: Final = 0.6180339887498949
_GOLDEN_STEPS: Final = 46  # of golden section, down to 1e-10 rad: a distance of 1e-6 m is then exact to 1e-8 of it


class PlanarArm:
    """The first three joints of `model`, whose axes 2 and 3 are parallel and axes 1 and 2 are not.

    Points and rotations are in the fixed frame whose z is axis 1 and in which frame 1 is Rz(theta1); angles are
    theta = q + offset, rad.
    """

    def __init__(self, model: ArmModel) -> None:
        (_, self._a1, d2, s1, c1), (_, self._a2, d3, _, sign), (_, a3, d4, s3, c3) = (
            (row.alpha, row.a, row.d, *constants[:2])
            for row, constants in zip(model.rows[1:4], model.constants[1:4], strict=True)
        )
        self._s1, self._c1, self._sign = s1, c1, sign
        self._px, self._py = a3, -s3 * d4
        self._length = hypot(self._px, self._py)
        self._phase = atan2(self._py, self._px)
        self._height = d2 + sign * (c3 * d4 + d3)
        self._longest = abs(self._a2) + self._length
        self._shortest = abs(abs(self._a2) - self._length)
        # Rx(alpha2) Rz(theta3) Rx(alpha3) = Rz(sign theta3) Rx(alpha2 + alpha3)
        self._s3, self._c3 = sign * s3, sign * c3
        # sign of the bend for front and up
        self._up = -1.0 if sign * s1 * self._a2 > 0.0 else 1.0

    def numbers(self) -> dict[str, float]:
        """The constants by their names in `solver.c`."""
        return {
            "A1": self._a1, "A2": self._a2, "S1": self._s1, "C1": self._c1, "SIGN": self._sign, "PX": self._px,
            "PY": self._py, "LENGTH": self._length, "PHASE": self._phase, "HEIGHT": self._height,
            "LONGEST": self._longest, "SHORTEST": self._shortest, "S3": self._s3, "C3": self._c3, "UP": self._up,
        }  # fmt: skip

    def solve(self, wx: float, wy: float, wz: float, near1: float, near2: float) -> list[Angles]:
        """All angles of joints 1 to 3 that bring the wrist centre to the point; empty when it is out of reach.

        On a singularity joint 1 (or 2, where the wrist centre is on axis 2) stays at `near1` (`near2`), and branches
        that coincide are returned once.
        """
        height = self._height
        fy = (wz - self._c1 * height) / self._s1
        y = self._c1 * fy - self._s1 * height
        width = abs(y)
        radius = sqrt(wx * wx + wy * wy)
        beyond = radius - width
        sides: tuple[tuple[float, float, int, int], ...]
        if beyond >= ON_EDGE and radius >= SLACK:
            x = sqrt(beyond * (radius + width))
            around = atan2(wy, wx)
            sides = ((x, around - atan2(y, x), 0, 0), (-x, around - atan2(y, -x), BACK, 0))
        elif width < SLACK:
            sides = ((0.0, near1, 0, SHOULDER),)
        elif beyond >= -SLACK:
            sides = ((0.0, atan2(wy, wx) - atan2(y, 0.0), 0, SHOULDER),)
        else:
            return []
        branches: list[Angles] = []
        a2, length, sign = self._a2, self._length, self._sign
        for x, theta1, bits, singular in sides:
            fx = x - self._a1
            reach = sqrt(fx * fx + fy * fy)
            outer, inner = self._longest - reach, reach - self._shortest
            if outer >= ON_EDGE and inner >= ON_EDGE:
                # cos and sin of the bend by half angles: exact also beside the edge
                stretch, fold = outer * (self._longest + reach), inner * (reach + self._shortest)
                if a2 < 0.0:
                    stretch, fold = fold, stretch
                whole = stretch + fold
                cosine, sine = (fold - stretch) / whole, 2.0 * sqrt(fold * stretch) / whole
                bend = self._up * atan2(sine, cosine)
                if bits:
                    bend = -bend
                if reach < SLACK:
                    branches.append((theta1, near2, bend - self._phase, bits, singular | ELBOW))
                    continue
                towards = atan2(fy, fx)
                inside = atan2(sign * length * sine, a2 + length * cosine)
                if bend < 0.0:
                    inside = -inside
                branches += (
                    (theta1, towards - inside, bend - self._phase, bits, singular),
                    (theta1, towards + inside, -bend - self._phase, bits | DOWN, singular),
                )
            elif outer >= -SLACK and inner >= -SLACK:
                straight = (outer < ON_EDGE) == (a2 > 0.0)
                bend = 0.0 if straight else pi
                if reach < SLACK:
                    theta2 = near2
                else:
                    theta2 = atan2(fy, fx) - (0.0 if a2 + (length if straight else -length) > 0.0 else pi)
                branches.append((theta1, theta2, bend - self._phase, bits, singular | ELBOW))
        return branches

    def confirm(
        self, theta1: float, theta2: float, theta3: float, point: Vector, rotation: Rotation
    ) -> Rotation | None:
        """`rotation` relative to the forearm at these angles (rad); None when they do not reach `point` (m)."""
        sine, cosine = sin(theta2), cos(theta2)
        theta23 = theta2 + self._sign * theta3
        sb, cb = sin(theta23), cos(theta23)
        sa, ca = sin(theta1), cos(theta1)
        s1, c1, sign, height = self._s1, self._c1, self._sign, self._height
        px, py = self._px, sign * self._py
        x = self._a1 + self._a2 * cosine + cb * px - sb * py
        fy = self._a2 * sine + sb * px + cb * py
        y = c1 * fy - s1 * height
        wx, wy, wz = point
        dx, dy, dz = ca * x - sa * y - wx, sa * x + ca * y - wy, s1 * fy + c1 * height - wz
        if not dx * dx + dy * dy + dz * dz <= CONFIRMED:
            return None
        # The axes of the forearm u, v, z: rows of Rx(-alpha2 - alpha3) Rz(-theta23) Rx(-alpha1) Rz(-theta1)
        s3, c3 = self._s3, self._c3
        k, m = c1 * cb, c1 * sb
        ux, uy, uz = cb * ca - m * sa, cb * sa + m * ca, s1 * sb
        tx, ty, tz = -sb * ca - k * sa, k * ca - sb * sa, s1 * cb
        nx, ny, nz = s1 * sa, -s1 * ca, c1
        vx, vy, vz = c3 * tx + s3 * nx, c3 * ty + s3 * ny, c3 * tz + s3 * nz
        zx, zy, zz = c3 * nx - s3 * tx, c3 * ny - s3 * ty, c3 * nz - s3 * tz
        a, b, c, d, e, f, g, h, i = rotation
        return (
            ux * a + uy * d + uz * g, ux * b + uy * e + uz * h, ux * c + uy * f + uz * i,
            vx * a + vy * d + vz * g, vx * b + vy * e + vz * h, vx * c + vy * f + vz * i,
            zx * a + zy * d + zz * g, zx * b + zy * e + zz * h, zx * c + zy * f + zz * i,
        )  # fmt: skip

    def shortfall(self, wx: float, wy: float, wz: float) -> float:
        """Distance, m, from a point out of reach to the nearest wrist centre; joint limits are not considered."""
        radius = hypot(wx, wy)
        a1, s1, c1, height = self._a1, self._s1, self._c1, self._height
        if c1 == 0.0 and height == 0.0:  # the edges are circles in a plane with axis 1
            edges = (self._longest, self._shortest)
            return min(abs(hypot(radius - centre, wz) - edge) for centre in (a1, -a1) for edge in edges)

        def distance(fx: float, fy: float) -> float:
            x, y = a1 + fx, c1 * fy - s1 * height
            return hypot(hypot(x, y) - radius, s1 * fy + c1 * height - wz)

        def at_tube(angle: float) -> float:
            """At x = 0 in frame 1: as near to axis 1 as the lateral offset allows."""
            fy = self._longest * sin(angle)
            return distance(-a1, fy) if self._shortest <= hypot(a1, fy) <= self._longest else inf

        def at_edge(edge: float) -> float:
            return smallest_of_turn(lambda angle: distance(edge * cos(angle), edge * sin(angle)))

        return min(at_edge(self._longest), at_edge(self._shortest), smallest_of_turn(at_tube))


def smallest_of_turn(function: Callable[[float], float]) -> float:
    """The smallest value of a function of an angle (rad) over one turn.

    By sampling, then golden section in the two lowest valleys.
    """
    step = tau / _SAMPLES
    values = [function(index * step) for index in range(_SAMPLES)]
    valleys = sorted(
        (value, index)
        for index, value in enumerate(values)
        if value <= values[index - 1] and value <= values[(index + 1) % _SAMPLES]
    )
    return min(_golden_section(function, (index - 1) * step, (index + 1) * step) for _, index in valleys[:_VALLEYS])


def _golden_section(function: Callable[[float], float], lower: float, upper: float) -> float:
    left, right = upper - _GOLDEN * (upper - lower), lower + _GOLDEN * (upper - lower)
    at_left, at_right = function(left), function(right)
    for _ in range(_GOLDEN_STEPS):
        if at_left < at_right:
            upper, right, at_right = right, left, at_left
            left = upper - _GOLDEN * (upper - lower)
            at_left = function(left)
        else:
            lower, left, at_left = left, right, at_right
            right = lower + _GOLDEN * (upper - lower)
            at_right = function(right)
    return min(at_left, at_right)
