"""Position inverse kinematics: joints 1 to 3 for a wrist centre, where axes 2 and 3 are not parallel.

Relative to the link that joint 2 moves, the wrist centre is g(theta3) = (g1, g2, g3), linear in cos and sin(theta3).
Joint 2 rotates it to f = Rz(theta2) g, and in frame 1 it is (a1, 0, 0) + Rx(alpha1) f. Neither its z nor its distance
from the origin depends on theta1 (Pieper 1968), which gives for a target at the height z and the distance R:

    sin(alpha1) f2 = z - cos(alpha1) g3          2 a1 f1 = R^2 - a1^2 - g^2

f1^2 + f2^2 = g1^2 + g2^2 is then an equation in theta3 alone, of second degree in its cosine and sine: a quartic in
tan(theta3 / 2). Where a1 or sin(alpha1) is zero, one of the two equations is already independent of theta2. Newton's
method polishes all roots.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, atan2, copysign, cos, hypot, pi, remainder, sin, sqrt, tau
from typing import Final, TypeAlias

from kinematics.model import ArmModel
from kinematics.pose import Rotation, Vector, applied, times, transposed, turned
from kinematics.position_ik import smallest_of_turn
from kinematics.solution import BACK, CONFIRMED, DOWN, ELBOW, SHOULDER, SLACK, Angles

# constant, factor of cos, factor of sin
Linear: TypeAlias = tuple[float, float, float]
# constant, factors of cos x, sin x, cos 2x, sin 2x
Quadratic: TypeAlias = tuple[float, ...]

# a1 (m) or sin(alpha1): below SMALL, roots of the quartic lie so close together that round-off may hide them, and the
# roots of the equation that neglects the value are tried too. Below ZERO the value counts as zero.
_SMALL: Final = 1e-4
_ZERO: Final = 1e-12
_LOOSE: Final = 10.0  # relative tolerance of those roots, per unit of the neglected value
_SAME: Final = 1e-7  # rad; solutions nearer than that are the same, on a singularity
# Determinants of the wrist centre's Jacobian, in units of size^3: below REGULAR everywhere, the arm moves it in two
# directions only; below FLAT, Newton's method has no step.
_REGULAR: Final = 1e-6
_FLAT: Final = 1e-12
_NEWTON_STEPS: Final = 20  # limit; near a double root each step only halves the error
_ROOT_STEPS: Final = 200  # limit; about ten are usual
# Relative to the terms of the polynomial: an extremum this near to zero is a root that round-off may have removed.
# A false root is rejected by the check of the wrist centre.
_NEARLY: Final = 1e-7


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
        """Whether the three joints can move the wrist centre in three directions; `solve` requires it."""
        samples = ((0.3 + 0.9 * i, 0.1 + 0.7 * j) for i in range(7) for j in range(9))
        return max(abs(self._determinant(*sample)) for sample in samples) > _REGULAR * self._size**3

    def solve(self, wx: float, wy: float, wz: float, near1: float, near2: float) -> list[Angles]:
        """As `PlanarArm.solve`."""
        solutions: list[Angles] = []
        for angle, f1, f2 in self._planes(wx, wy, wz):
            g1, g2, g3 = self._wrist(angle)
            theta2 = near2 if hypot(g1, g2) < SLACK else atan2(f2, f1) - atan2(g2, g1)
            singular = 0
            if hypot(wx, wy) < SLACK:
                theta1, singular = near1, SHOULDER
            else:
                theta1 = atan2(wy, wx) - atan2(self._c1 * f2 - self._s1 * g3, self._a1 + f1)
            theta1, theta2, theta3 = angles = self._polish((theta1, theta2, angle), (wx, wy, wz))
            if not self._reaches(angles, (wx, wy, wz)) or any(_same(angles, known[:3]) for known in solutions):
                continue
            x = self._point(0.0, theta2, theta3)[0]
            determinant = self._determinant(theta2, theta3)
            if abs(determinant) < _SAME * self._size**3 and not singular:
                singular = ELBOW
            down = determinant < 0.0 if self._c2 >= 0.0 else determinant > 0.0
            solutions.append((theta1, theta2, theta3, (BACK if x < 0.0 else 0) | (DOWN if down else 0), singular))
        return solutions

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
        """As `PlanarArm.shortfall`, but by search over joints 2 and 3: 20 ms, too slow for the loop."""
        radius = hypot(wx, wy)

        def of_plane(theta3: float) -> float:
            def of_point(theta2: float) -> float:
                x, y, z = self._point(0.0, theta2, theta3)
                return hypot(hypot(x, y) - radius, z - wz)

            return smallest_of_turn(of_point)

        return smallest_of_turn(of_plane)

    def _planes(self, wx: float, wy: float, wz: float) -> list[tuple[float, float, float]]:
        """Return all (theta3, f1, f2) that satisfy the equations of the module for z = wz and R = |w|."""
        a1, s1, c1 = self._a1, self._s1, self._c1
        constant, along, across = self._square
        # R^2 - a1^2 - g^2 and z - cos(alpha1) g3
        far = (wx * wx + wy * wy + wz * wz - a1 * a1 - constant, -along, -across)
        high = (wz - c1 * self._g3[0], -c1 * self._g3[1], -c1 * self._g3[2])
        planes = []
        if abs(a1) < _SMALL <= abs(s1):
            planes = [
                (theta3, f1, f2)
                for theta3 in _starts(far, a1)
                for f2 in (_at(high, theta3) / s1,)
                for f1 in self._other(theta3, f2, a1)
            ]
        elif abs(s1) < _SMALL <= abs(a1):
            planes = [
                (theta3, f1, f2)
                for theta3 in _starts(high, s1)
                for f1 in (_at(far, theta3) / (2.0 * a1),)
                for f2 in self._other(theta3, f1, s1)
            ]
        if min(abs(a1), abs(s1)) < _ZERO:
            return planes
        # sin(alpha1)^2 far^2 + 4 a1^2 high^2 = 4 a1^2 sin(alpha1)^2 (g^2 - g3^2)
        scale = 4.0 * a1 * a1 * s1 * s1
        linear = (scale * constant, scale * along, scale * across, 0.0, 0.0)
        terms = zip(product(far, far), product(high, high), product(self._g3, self._g3), linear, strict=True)
        equation = tuple(s1 * s1 * f + 4.0 * a1 * a1 * h + scale * g - k for f, h, g, k in terms)
        return planes + [
            (theta3, _at(far, theta3) / (2.0 * a1), _at(high, theta3) / s1) for theta3 in solve_quadratic(equation)
        ]

    def _other(self, theta3: float, one: float, left_out: float) -> list[float]:
        """Return f2 for f1, or f1 for f2, with both signs.

        `left_out`: the neglected value; `one` is scaled down by the tolerance, so that a double root is not missed.
        """
        g1, g2, _ = self._wrist(theta3)
        size = hypot(g1, g2)
        if abs(left_out) > _ZERO:
            one *= 1.0 - _LOOSE * abs(left_out)
        if abs(one) > size + SLACK:
            return []
        root = sqrt(max(0.0, (size - one) * (size + one)))
        return [root, -root]

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
        """Derivatives of the wrist centre by joints 1 to 3, in frame 1."""
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
        """Newton's method, while it brings the wrist centre nearer to the point."""
        error = self._error(angles, point)
        for _ in range(_NEWTON_STEPS):
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
    """Return the roots of a form. If it neglects a value, `left_out`, also those with a constant reduced by the
    tolerance, so that a double root is not missed."""
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


def product(one: Linear, other: Linear) -> Quadratic:
    """The product of two linear forms."""
    k, c, s = one
    m, d, t = other
    return k * m + 0.5 * (c * d + s * t), k * d + c * m, k * t + s * m, 0.5 * (c * d - s * t), 0.5 * (c * t + s * d)


def solve_linear(form: Linear) -> list[float]:
    """The angles (rad) where the form is zero: two, which may coincide, or none."""
    constant, along, across = form
    size = hypot(along, across)
    if size == 0.0 or abs(constant) > size * (1.0 + _NEARLY):
        return []
    middle = atan2(across, along)
    half = atan2(sqrt(max(0.0, (size - constant) * (size + constant))), -constant)
    return [middle + half, middle - half]


def solve_quadratic(form: Quadratic) -> list[float]:
    """The angles (rad) where the form is zero or nearly touches zero: up to four."""
    constant, c1, s1, c2, s2 = form
    if not max(map(abs, form)) > 0.0:
        return []
    # tan(x / 2) is infinite at x = pi: x counts from the angle opposite to which the form is largest
    start, largest = 0.0, -1.0
    for eighth in range(8):
        angle = 0.25 * pi * eighth
        x = angle + pi
        size = abs(constant + c1 * cos(x) + s1 * sin(x) + c2 * cos(2.0 * x) + s2 * sin(2.0 * x))
        if size > largest:
            start, largest = angle, size
    c, s = cos(start), sin(start)
    c1, s1 = c * c1 + s * s1, c * s1 - s * c1
    c, s = cos(2.0 * start), sin(2.0 * start)
    c2, s2 = c * c2 + s * s2, c * s2 - s * c2
    quartic = (
        constant - c1 + c2, 2.0 * s1 - 4.0 * s2, 2.0 * constant - 6.0 * c2, 2.0 * s1 + 4.0 * s2, constant + c1 + c2
    )  # fmt: skip
    return [start + 2.0 * atan(tangent) for tangent in real_roots(quartic, _NEARLY)]


def real_roots(coefficients: Sequence[float], nearly: float) -> list[float]:
    """The real roots, ascending, of a polynomial given highest power first; the first coefficient is not zero.

    Between two neighbouring stationary points there is at most one. A stationary point that misses zero by less than
    `nearly` times the size of the polynomial's terms is a root too: round-off may have made a double root complex.
    """
    degree = len(coefficients) - 1
    if degree == 1:
        return [-coefficients[1] / coefficients[0]]
    slope = [factor * (degree - index) for index, factor in enumerate(coefficients[:-1])]
    bound = 1.0 + max(abs(factor / coefficients[0]) for factor in coefficients[1:])
    roots = []
    lower, at_lower = -bound, _value(coefficients, -bound)
    for upper in (*real_roots(slope, 0.0), bound):
        at_upper = _value(coefficients, upper)
        if at_upper == 0.0 or (at_lower < 0.0) != (at_upper < 0.0):
            roots.append(_root_between(coefficients, slope, lower, upper, at_lower))
        elif upper != bound and abs(at_upper) <= nearly * _value(list(map(abs, coefficients)), abs(upper)):
            roots.append(upper)
        lower, at_lower = upper, at_upper
    return roots


def _value(coefficients: Sequence[float], x: float) -> float:
    """The polynomial at x (Horner)."""
    result = 0.0
    for factor in coefficients:
        result = result * x + factor
    return result


def _root_between(
    coefficients: Sequence[float], slope: Sequence[float], lower: float, upper: float, at_lower: float
) -> float:
    """The root in an interval with a change of sign: Newton's steps, bisection where they leave the interval."""
    sign = copysign(1.0, at_lower)
    x = 0.5 * (lower + upper)
    for _ in range(_ROOT_STEPS):
        here = _value(coefficients, x)
        if here == 0.0:
            return x
        if here * sign > 0.0:
            lower = x
        else:
            upper = x
        steepness = _value(slope, x)
        candidate = x - here / steepness if steepness != 0.0 else lower
        if not lower < candidate < upper:
            candidate = 0.5 * (lower + upper)
            if not lower < candidate < upper:
                break
        if candidate == x:
            break
        x = candidate
    return x
