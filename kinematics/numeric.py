"""Numeric inverse kinematics for any arm of six joints, and the nearest pose where there is no solution."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import atan2, hypot, pi, sqrt
from operator import add, mul
from typing import NamedTuple, TypeAlias

from kinematics.forward import frames
from kinematics.jacobian import Row, characteristic_length, jacobian_columns
from kinematics.linear import gram, solve_positive
from kinematics.model import ArmModel
from kinematics.pose import Pose, Rotation, Vector, require_finite
from kinematics.reasons import refuse_no_rotation

TOLERANCE = 1e-9  # m and rad, below which a pose counts as reached

_STARTS = 24
_ITERATIONS = 80  # of one start
_FINE = 1e-24  # square of the scaled error below which nothing is left to gain
_ROUGH, _FINAL = 1e-5, 1e-12  # fractions of the cost: three steps in a row that gain less end a descent
_EQUAL = 0.999  # ratio of two costs from which on they count as equal
_GOLDEN = 1.1127756842787055  # root of x^7 = x + 1: its powers fill six dimensions evenly (Roberts 2018)


_Bound: TypeAlias = tuple[float, float] | None  # None: the joint may turn without end
_Bounds: TypeAlias = Sequence[_Bound]
_UNBOUNDED: _Bounds = (None,) * 6


class NumericResult(NamedTuple):
    """The configuration found, and how far its tool pose is from the wanted one.

    q: six rad. converged: both errors below 1e-9. position_error: m. rotation_error: rad, 0 to pi. iterations: of all
    starts together.
    """

    q: Row
    converged: bool
    position_error: float
    rotation_error: float
    iterations: int


class _Point(NamedTuple):
    """A configuration on the way: its frames, its error (three scaled lengths, three angles), the error's square."""

    q: list[float]
    poses: Sequence[Pose]
    error: list[float]
    cost: float


def solve_numeric(
    model: ArmModel, pose: Pose, q_near: Sequence[float], *, respect_limits: bool = True
) -> NumericResult:
    """A configuration that brings the tool to `pose`, or as near as it comes; not for the loop (0.3 ms to 0.2 s).

    Damped least squares from `q_near` (six rad), then from fixed starts spread over the joints' ranges, until one
    reaches the pose. It gives one solution, often but not always the nearest to `q_near`, and always the same for the
    same arguments. Where no start reaches the pose, the result has the smallest sum of squares found of the position
    error, in units of the arm's `characteristic_length`, and the rotation error in rad: the nearest pose, as far as
    the starts can tell.

    With `respect_limits` every joint is inside its limits. Joints are given in the turn nearest to `q_near` that the
    limits allow. ValueError for a value that is not finite, which it names, and for a rotation that is none.

    Sources: Marquardt 1963 for the damping, Bertsekas 1982 for the bounds: a joint at a bound that would leave it is
    held for the step.
    """
    pose.require_finite()
    require_finite(q_near, model.joint_names)
    refuse_no_rotation(pose)
    bounds: _Bounds = _UNBOUNDED
    if respect_limits:
        bounds = [(limit.lower, limit.upper) for limit in model.limits]
    length = characteristic_length(model)
    start = _inside(map(_near_turn, q_near, q_near, bounds), bounds)
    best, iterations = _descend(model, pose, start, bounds, length)
    for start in _starts(bounds):
        if max(_errors(best, length)) < TOLERANCE:
            break
        reached, count = _descend(model, pose, start, bounds, length)
        iterations += count
        best = _nearer(best, reached)
        if respect_limits and max(_errors(best, length)) >= TOLERANCE:
            # A way to the pose may lead through what the limits forbid.
            beyond, count = _descend(model, pose, start, _UNBOUNDED, length)
            turned = map(_near_turn, beyond.q, q_near, bounds)
            reached, again = _descend(model, pose, _inside(turned, bounds), bounds, length)
            iterations += count + again
            best = _nearer(best, reached)
    if max(_errors(best, length)) >= TOLERANCE:
        best, count = _descend(model, pose, best.q, bounds, length, _FINAL)
        iterations += count
    q = tuple(_near_turn(angle, near, bound) for angle, near, bound in zip(best.q, q_near, bounds, strict=True))
    position, rotation = _errors(best, length)
    return NumericResult(q, max(position, rotation) < TOLERANCE, position, rotation, iterations)  # type: ignore[arg-type]


def _errors(point: _Point, length: float) -> tuple[float, float]:
    return length * hypot(*point.error[:3]), hypot(*point.error[3:])


def _nearer(first: _Point, other: _Point) -> _Point:
    """The better of two; of equals the first, which lies nearer to where the search began."""
    return other if other.cost < _EQUAL * first.cost else first


def _inside(q: Iterable[float], bounds: _Bounds) -> list[float]:
    return [_clip(angle, bound) for angle, bound in zip(q, bounds, strict=True)]


def _starts(bounds: _Bounds) -> Iterator[list[float]]:
    for count in range(1, _STARTS):
        start = []
        for joint, bound in enumerate(bounds):
            lower, upper = bound or (-pi, pi)
            start.append(lower + (upper - lower) * ((0.5 + count * _GOLDEN ** -(joint + 1)) % 1.0))
        yield start


def _descend(
    model: ArmModel, pose: Pose, start: list[float], bounds: _Bounds, length: float, stalled: float = _ROUGH
) -> tuple[_Point, int]:
    """The minimum downhill of `start`, and how many steps were tried."""
    point = _point(model, pose, start, length)
    damping = 1e-2
    small_gains = 0
    for count in range(_ITERATIONS):
        if point.cost < _FINE or small_gains == 3 or damping > 1e8:
            return point, count
        step = _step(point, bounds, damping, length)
        if step is None:
            damping *= 10.0
            continue
        candidate = _point(model, pose, _inside(map(add, point.q, step), bounds), length)
        gain = point.cost - candidate.cost
        if gain > 0.0:
            small_gains = small_gains + 1 if gain < stalled * point.cost else 0
            damping = max(1e-12, 0.1 * damping)
            point = candidate
        else:
            damping *= 10.0
    return point, _ITERATIONS


def _step(point: _Point, bounds: _Bounds, damping: float, length: float) -> list[float] | None:
    """(J^T J + damping)^-1 J^T error over the joints that are free to move; None where it cannot be solved."""
    columns = [
        (vx / length, vy / length, vz / length, wx, wy, wz) for vx, vy, vz, wx, wy, wz in jacobian_columns(point.poses)
    ]
    downhill = [sum(map(mul, column, point.error)) for column in columns]
    free = [
        bound is None or not ((angle <= bound[0] and slope < 0.0) or (angle >= bound[1] and slope > 0.0))
        for angle, bound, slope in zip(point.q, bounds, downhill, strict=True)
    ]
    matrix = gram([column for column, is_free in zip(columns, free, strict=True) if is_free])
    for i, row in enumerate(matrix):
        row[i] += damping
    solved = solve_positive(matrix, [slope for slope, is_free in zip(downhill, free, strict=True) if is_free])
    if solved is None:
        return None
    moves = iter(solved)
    return [next(moves) if is_free else 0.0 for is_free in free]


def _point(model: ArmModel, pose: Pose, q: list[float], length: float) -> _Point:
    poses = frames(model, q)
    tool = poses[6]
    error = [(wanted - actual) / length for wanted, actual in zip(pose.position, tool.position, strict=True)]
    error += _rotation_error(pose.rotation, tool.rotation)
    return _Point(q, poses, error, sum(map(mul, error, error)))


def _rotation_error(wanted: Rotation, actual: Rotation) -> Vector:
    """Axis times angle (rad, 0 to pi) of the turn, about the base's axes, from the actual to the wanted rotation."""
    a, b, c, d, e, f, g, h, i = wanted
    j, k, m, n, o, p, r, s, t = actual
    # wanted actual^T, entry by entry
    xx, xy, xz = a * j + b * k + c * m, a * n + b * o + c * p, a * r + b * s + c * t
    yx, yy, yz = d * j + e * k + f * m, d * n + e * o + f * p, d * r + e * s + f * t
    zx, zy, zz = g * j + h * k + i * m, g * n + h * o + i * p, g * r + h * s + i * t
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine, cosine = sqrt(x * x + y * y + z * z), 0.5 * (xx + yy + zz - 1.0)
    if sine > 1e-6 or cosine > 0.0:
        factor = atan2(sine, cosine) / sine if sine > 0.0 else 1.0
        return factor * x, factor * y, factor * z
    # Half a turn: the axis is the longest column of the symmetric part, R = 2 n n^T - 1.
    axis = max(
        (xx + 1.0, 0.5 * (xy + yx), 0.5 * (xz + zx)),
        (0.5 * (xy + yx), yy + 1.0, 0.5 * (yz + zy)),
        (0.5 * (xz + zx), 0.5 * (yz + zy), zz + 1.0),
        key=lambda column: hypot(*column),
    )
    factor = atan2(sine, cosine) / hypot(*axis)
    return factor * axis[0], factor * axis[1], factor * axis[2]


def _clip(angle: float, bound: _Bound) -> float:
    return angle if bound is None else min(max(angle, bound[0]), bound[1])


def _near_turn(angle: float, near: float, bound: _Bound) -> float:
    """`angle` plus the turns of 2 pi that bring it nearest to `near` inside the bound; a joint in no turn stays."""
    turn = 2.0 * pi
    nearest = angle + turn * round((near - angle) / turn)
    if bound is None or bound[0] <= nearest <= bound[1]:
        return nearest
    inside = [candidate for candidate in (nearest - turn, nearest + turn) if bound[0] <= candidate <= bound[1]]
    return min(inside, key=lambda candidate: abs(candidate - near), default=angle)
