"""The first three joints of an arm in general geometry: how they bring the wrist centre to a point.

Seen from what joint 2 turns, the wrist centre is g(theta3) = (g1, g2, g3), linear in the cosine and sine of theta3.
Joint 2 turns it to f = Rz(theta2) g, and in frame 1 it is (a1, 0, 0) + Rx(alpha1) f. Neither its z nor its distance
from the origin depends on theta1 (Pieper 1968), which gives for the wanted point, at the height z and the distance R:

    sin(alpha1) f2 = z - cos(alpha1) g3          2 a1 f1 = R^2 - a1^2 - g^2

f1^2 + f2^2 = g1^2 + g2^2 is then an equation of theta3 alone, of second degree in its cosine and sine: a quartic in
tan(theta3 / 2). Where a1 or sin(alpha1) is zero one of the two equations is already free of theta2. Newton's method
makes all roots exact.
"""

from __future__ import annotations

from math import atan2, cos, hypot, remainder, sin, sqrt, tau

from kinematics.model import ArmModel
from kinematics.pose import Rotation, Vector, applied, times, transposed, turned
from kinematics.reach import smallest_of_turn
from kinematics.solution import BACK, CONFIRMED, DOWN, ELBOW, SHOULDER, SLACK, Angles
from kinematics.trigonometric import product, solve_linear, solve_quadratic

# m, or a sine. What is smaller than SMALL brings roots of the quartic so near to each other that round-off may hide
# them: the roots without it are then tried too. What is smaller than ZERO is none.
_SMALL = 1e-4
_ZERO = 1e-12
_LOOSE = 10.0  # so many times what is left out, relative, they may then be out of reach
_SAME = 1e-7  # rad; two solutions that are nearer are one, on a singularity
_REGULAR = 1e-6  # determinant, in units of the size, that an arm reaches somewhere if it is one
_FLAT = 1e-12  # determinant, in units of the size, with which there is no step
_STEPS = 20  # of Newton's method, at most: towards a double root each only halves the way


class GeneralArm:
    """The first three joints of `model`; angles and points as in `PlanarArm`."""

    def __init__(self, model: ArmModel) -> None:
        (_, self._a1, d2, self._s1, self._c1), (_, self._a2, d3, s2, c2), (_, a3, d4, s3, c3) = (
            (row.alpha, row.a, row.d, *constants[:2])
            for row, constants in zip(model.rows[1:4], model.constants[1:4], strict=True)
        )
        x, y, z = a3, -s3 * d4, c3 * d4 + d3
        a2 = self._a2
        self._s2, self._c2, self._d2, self._x, self._y, self._z = s2, c2, d2, x, y, z
        self._inner = turned(s3, c3, 0.0)
        self._size = abs(self._a1) + abs(a2) + abs(d2) + hypot(x, y, z)
        # g3 and g^2: constant, factor of cos(theta3), factor of sin(theta3)
        self._g3 = (c2 * z + d2, s2 * y, s2 * x)
        self._square = (
            a2 * a2 + d2 * d2 + x * x + y * y + z * z + 2.0 * d2 * c2 * z,
            2.0 * (a2 * x + d2 * s2 * y),
            2.0 * (d2 * s2 * x - a2 * y),
        )

    def is_regular(self) -> bool:
        """Whether the three joints can move the wrist centre in three directions; else nothing can be solved."""
        samples = ((0.3 + 0.9 * i, 0.1 + 0.7 * j) for i in range(7) for j in range(9))
        return max(abs(self._determinant(*sample)) for sample in samples) > _REGULAR * self._size**3

    def solve(self, wx: float, wy: float, wz: float, near1: float, near2: float) -> list[Angles]:
        """As `PlanarArm.solve`."""
        found: list[Angles] = []
        for angle, f1, f2 in self._planes(wx, wy, wz):
            g1, g2, g3 = self._wrist(angle)
            theta2 = near2 if hypot(g1, g2) < SLACK else atan2(f2, f1) - atan2(g2, g1)
            singular = 0
            if hypot(wx, wy) < SLACK:
                theta1, singular = near1, SHOULDER
            else:
                theta1 = atan2(wy, wx) - atan2(self._c1 * f2 - self._s1 * g3, self._a1 + f1)
            theta1, theta2, theta3 = angles = self._polish((theta1, theta2, angle), (wx, wy, wz))
            if not self._reaches(angles, (wx, wy, wz)) or any(_same(angles, known[:3]) for known in found):
                continue
            x = self._point(0.0, theta2, theta3)[0]
            determinant = self._determinant(theta2, theta3)
            if abs(determinant) < _SAME * self._size**3 and not singular:
                singular = ELBOW
            down = determinant < 0.0 if self._c2 >= 0.0 else determinant > 0.0
            found.append((theta1, theta2, theta3, (BACK if x < 0.0 else 0) | (DOWN if down else 0), singular))
        return found

    def confirm(
        self, theta1: float, theta2: float, theta3: float, point: Vector, rotation: Rotation
    ) -> Rotation | None:
        """As `PlanarArm.confirm`."""
        if not self._reaches((theta1, theta2, theta3), point):
            return None
        upper = times(turned(0.0, 1.0, theta1), turned(self._s1, self._c1, theta2))
        forearm = times(times(upper, turned(self._s2, self._c2, theta3)), self._inner)
        return times(transposed(forearm), rotation)

    def shortfall(self, wx: float, wy: float, wz: float) -> float:
        """As `PlanarArm.shortfall`, but by search over joints 2 and 3: 20 ms, too long for the loop."""
        radius = hypot(wx, wy)

        def of_plane(theta3: float) -> float:
            def of_point(theta2: float) -> float:
                x, y, z = self._point(0.0, theta2, theta3)
                return hypot(hypot(x, y) - radius, z - wz)

            return smallest_of_turn(of_point)

        return smallest_of_turn(of_plane)

    def _planes(self, wx: float, wy: float, wz: float) -> list[tuple[float, float, float]]:
        """(theta3, f1, f2) that give the point its height and its distance from the origin."""
        a1, s1, c1 = self._a1, self._s1, self._c1
        constant, along, across = self._square
        # R^2 - a1^2 - g^2 and z - cos(alpha1) g3
        far = (wx * wx + wy * wy + wz * wz - a1 * a1 - constant, -along, -across)
        high = (wz - c1 * self._g3[0], -c1 * self._g3[1], -c1 * self._g3[2])
        found = []
        if abs(a1) < _SMALL <= abs(s1):
            found = [
                (theta3, f1, f2)
                for theta3 in _starts(far, a1)
                for f2 in (_at(high, theta3) / s1,)
                for f1 in self._other(theta3, f2, a1)
            ]
        elif abs(s1) < _SMALL <= abs(a1):
            found = [
                (theta3, f1, f2)
                for theta3 in _starts(high, s1)
                for f1 in (_at(far, theta3) / (2.0 * a1),)
                for f2 in self._other(theta3, f1, s1)
            ]
        if min(abs(a1), abs(s1)) < _ZERO:
            return found
        # sin(alpha1)^2 far^2 + 4 a1^2 high^2 = 4 a1^2 sin(alpha1)^2 (g^2 - g3^2)
        scale = 4.0 * a1 * a1 * s1 * s1
        linear = (scale * constant, scale * along, scale * across, 0.0, 0.0)
        terms = zip(product(far, far), product(high, high), product(self._g3, self._g3), linear, strict=True)
        equation = tuple(s1 * s1 * f + 4.0 * a1 * a1 * h + scale * g - k for f, h, g, k in terms)
        return found + [
            (theta3, _at(far, theta3) / (2.0 * a1), _at(high, theta3) / s1) for theta3 in solve_quadratic(equation)
        ]

    def _other(self, theta3: float, one: float, left_out: float) -> list[float]:
        """The second of f1 and f2, both signs, where the first is known; with something left out, not quite."""
        g1, g2, _ = self._wrist(theta3)
        size = hypot(g1, g2)
        if abs(left_out) > _ZERO:
            one *= 1.0 - _LOOSE * abs(left_out)
        if abs(one) > size + SLACK:
            return []
        rest = sqrt(max(0.0, (size - one) * (size + one)))
        return [rest, -rest]

    def _wrist(self, theta3: float) -> Vector:
        s, c = sin(theta3), cos(theta3)
        x, y, z = self._x * c - self._y * s, self._x * s + self._y * c, self._z
        return self._a2 + x, self._c2 * y - self._s2 * z, self._s2 * y + self._c2 * z + self._d2

    def _point(self, theta1: float, theta2: float, theta3: float) -> Vector:
        g1, g2, g3 = self._wrist(theta3)
        s, c = sin(theta2), cos(theta2)
        x, f2 = self._a1 + c * g1 - s * g2, s * g1 + c * g2
        y, z = self._c1 * f2 - self._s1 * g3, self._s1 * f2 + self._c1 * g3
        s, c = sin(theta1), cos(theta1)
        return c * x - s * y, s * x + c * y, z

    def _columns(self, theta2: float, theta3: float) -> tuple[Vector, Vector, Vector]:
        """What the wrist centre moves by with each joint, in frame 1."""
        x, y, _ = self._point(0.0, theta2, theta3)
        upper = times(turned(self._s1, self._c1, theta2), turned(self._s2, self._c2, theta3))
        g1, g2, _ = self._wrist(theta3)
        s, c = sin(theta2), cos(theta2)
        f1, f2 = c * g1 - s * g2, s * g1 + c * g2
        return (-y, x, 0.0), (-f2, self._c1 * f1, self._s1 * f1), applied(upper, (-self._y, self._x, 0.0))

    def _determinant(self, theta2: float, theta3: float) -> float:
        return _triple(*self._columns(theta2, theta3))

    def _error(self, angles: Vector, point: Vector) -> Vector:
        x, y, z = self._point(*angles)
        wx, wy, wz = point
        return wx - x, wy - y, wz - z

    def _reaches(self, angles: Vector, point: Vector) -> bool:
        x, y, z = self._error(angles, point)
        return x * x + y * y + z * z <= CONFIRMED

    def _polish(self, angles: Vector, point: Vector) -> Vector:
        """Newton's method, for as long as it brings the wrist centre nearer to the point."""
        error = self._error(angles, point)
        for _ in range(_STEPS):
            theta1, theta2, theta3 = angles
            one, two, three = self._columns(theta2, theta3)
            s, c = sin(theta1), cos(theta1)
            x, y, z = error
            wanted = (c * x + s * y, c * y - s * x, z)
            determinant = _triple(one, two, three)
            if abs(determinant) < _FLAT * self._size**3:
                break
            better = (
                theta1 + _triple(wanted, two, three) / determinant,
                theta2 + _triple(one, wanted, three) / determinant,
                theta3 + _triple(one, two, wanted) / determinant,
            )
            remaining = self._error(better, point)
            if not hypot(*remaining) < hypot(*error):
                break
            angles, error = better, remaining
        return angles


def _starts(form: Vector, left_out: float) -> list[float]:
    """Where the form is zero; with something left out of it also those to start from where it just is not."""
    angles = solve_linear(form)
    if abs(left_out) > _ZERO:
        angles += solve_linear((form[0] * (1.0 - _LOOSE * abs(left_out)), form[1], form[2]))
    return angles


def _at(form: Vector, angle: float) -> float:
    return form[0] + form[1] * cos(angle) + form[2] * sin(angle)


def _triple(one: Vector, two: Vector, three: Vector) -> float:
    """The determinant of three columns."""
    (a, d, g), (b, e, h), (c, f, i) = one, two, three
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _same(one: Vector, other: Vector) -> bool:
    return all(abs(remainder(angle - known, tau)) < _SAME for angle, known in zip(one, other, strict=True))
