"""Damped least squares (Marquardt 1963): numeric inverse kinematics of any arm, small steps through singularities."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import atan2, hypot, inf, pi, sqrt, tau
from operator import add, mul
from typing import Final, NamedTuple, TypeAlias

from kinematics.forward import frames
from kinematics.jacobian import characteristic_length, gram, jacobian_columns, solve_positive
from kinematics.model import ArmModel
from kinematics.pose import Pose, Rotation, Vector, as_floats, orthonormality_error, require_finite
from kinematics.solution import Six, six

TOLERANCE: Final = 1e-9  # m and rad: a pose with smaller errors is reached

_STARTS: Final = 24
_ITERATIONS: Final = 80  # of one start
_FINE: Final = 1e-24  # square of the scaled error at which a descent ends
_ROUGH, _FINAL = 1e-5, 1e-12  # relative gain in cost; three smaller ones in a row end a descent
_EQUAL: Final = 0.999  # ratio of two costs above which they count as equal
_GOLDEN: Final = 1.1127756842787055  # root of x^7 = x + 1: its powers fill six dimensions evenly (Roberts 2018)

# Of `damped_least_squares`
_STEPS: Final = 7  # limit; two or three are usual, and on the edge of the workspace each halves the error
_DAMPING, _RELAXATION, _LEAST_DAMPING = 1e-3, 1e-3, 1e-13
_ENOUGH: Final = 1e-28  # m^2 and rad^2: beside a singularity the error that remains is amplified
_REACHED = (5e-10) ** 2
_HOPEFUL: Final = 1e-4  # of the initial cost; give up when three steps do not reach it

_INVALID_ROTATION: Final = 1e-10  # orthonormality error that prevents a solution from being confirmed

_Bounds: TypeAlias = Sequence[tuple[float, float]]
_UNBOUNDED: _Bounds = ((-inf, inf),) * 6


class NumericResult(NamedTuple):
    """Result of `solve_numeric`: a configuration, and the errors of its tool pose.

    q: six angles, rad. converged: both errors below 1e-9. position_error: m. rotation_error: rad, 0 to pi. iterations:
    total of all starts.
    """

    q: Six
    converged: bool
    position_error: float
    rotation_error: float
    iterations: int


class _Point(NamedTuple):
    """A configuration during a descent: its frames, its error (three scaled lengths, three angles) and its square."""

    q: list[float]
    poses: Sequence[Pose]
    error: list[float]
    cost: float


def pose_error(wanted: Pose, actual: Pose) -> list[float]:
    """Difference of two poses that are close: three lengths (m) and three angles (rad) in the base frame."""
    (x, y, z), (a, b, c, d, e, f, g, h, i) = wanted
    (px, py, pz), (j, k, m, n, o, p, q, r, s) = actual
    return [
        x - px,
        y - py,
        z - pz,
        0.5 * (n * g - q * d + o * h - r * e + p * i - s * f),
        0.5 * (q * a - j * g + r * b - k * h + s * c - m * i),
        0.5 * (j * d - n * a + k * e - o * b + m * f - p * c),
    ]


def damped_least_squares(model: ArmModel, pose: Pose, q_near: Sequence[float]) -> Six | None:
    """The configuration at `pose` reached from `q_near` (rad) by the smallest joint steps, or None; 0.1 ms a step.

    For poses a small step away, where singularities meet. The closed form solves the joints one after the other. At one
    singularity it chooses the angle of a free joint, and it knows the bend of a stretched arm to 1e-8 only; beside a
    second singularity this makes the later joints jump. Least squares move all joints at once. The damping decreases
    with every step; None also when three steps have not reduced the squared error to 1e-4 of its initial value.
    """
    q = list(q_near)
    damping = _DAMPING
    poses = frames(model, q)
    error = pose_error(pose, poses[6])
    cost = start = sum(map(mul, error, error))
    for step in range(_STEPS):
        if cost < _ENOUGH or (step == 3 and cost > _HOPEFUL * start):
            break
        columns = jacobian_columns(poses)
        matrix = gram(list(zip(*columns, strict=True)))
        for index, row in enumerate(matrix):
            row[index] += damping
        weights = solve_positive(matrix, error)
        if weights is None:
            break
        q = [angle + sum(map(mul, column, weights)) for angle, column in zip(q, columns, strict=True)]
        poses = frames(model, q)
        error = pose_error(pose, poses[6])
        cost = sum(map(mul, error, error))
        damping = max(_LEAST_DAMPING, _RELAXATION * damping)
    return six(q) if cost < _REACHED else None


def solve_numeric(
    model: ArmModel, pose: Pose, q_near: Sequence[float], *, respect_limits: bool = True
) -> NumericResult:
    """A configuration that brings the tool to `pose`, or as near as possible; too slow for the loop (0.3 ms to 0.2 s).

    Damped least squares from `q_near` (six rad), then from fixed starts spread over the joint ranges, until one
    reaches the pose. The result is deterministic, and often but not always the solution nearest to `q_near`. When no
    start reaches the pose, it is the configuration with the smallest sum of squares of the position error, in units of
    the arm's `characteristic_length`, and the rotation error, rad.

    With `respect_limits` every joint is inside its limits. Each joint is wrapped to the value nearest to `q_near` that
    the limits allow. Raises ValueError for a value that is not finite, naming it, and for an invalid rotation.

    Bounds as Bertsekas 1982: a joint at a bound that the step would exceed is held for this step.
    """
    pose.require_finite()
    require_finite(q_near, model.joint_names)
    require_rotation(pose)
    q_near = as_floats(q_near)
    bounds = [(limit.lower, limit.upper) for limit in model.limits] if respect_limits else _UNBOUNDED
    length = characteristic_length(model)
    start = _inside(_wrapped(q_near, q_near, bounds), bounds)
    best, iterations = _descend(model, pose, start, bounds, length)
    for start in _starts(bounds):
        if max(_errors(best, length)) < TOLERANCE:
            break
        reached, count = _descend(model, pose, start, bounds, length)
        iterations += count
        best = _nearer(best, reached)
        if respect_limits and max(_errors(best, length)) >= TOLERANCE:
            # The path of a descent may leave the limits and return.
            beyond, count = _descend(model, pose, start, _UNBOUNDED, length)
            inside = _inside(_wrapped(beyond.q, q_near, bounds), bounds)
            reached, again = _descend(model, pose, inside, bounds, length)
            iterations += count + again
            best = _nearer(best, reached)
    if max(_errors(best, length)) >= TOLERANCE:
        best, count = _descend(model, pose, best.q, bounds, length, _FINAL)
        iterations += count
    q = six(_wrapped(best.q, q_near, bounds))
    position, rotation = _errors(best, length)
    return NumericResult(q, max(position, rotation) < TOLERANCE, position, rotation, iterations)


def _errors(point: _Point, length: float) -> tuple[float, float]:
    return length * hypot(*point.error[:3]), hypot(*point.error[3:])


def _nearer(first: _Point, second: _Point) -> _Point:
    """The better of two; of equals the first, which is nearer to the start of the search."""
    return second if second.cost < _EQUAL * first.cost else first


def _inside(q: Iterable[float], bounds: _Bounds) -> list[float]:
    return [min(max(angle, lower), upper) for angle, (lower, upper) in zip(q, bounds, strict=True)]


def _starts(bounds: _Bounds) -> Iterator[list[float]]:
    for count in range(1, _STARTS):
        shares = [(0.5 + count * _GOLDEN ** -(joint + 1)) % 1.0 for joint in range(len(bounds))]
        ranges = [(-pi, pi) if upper == inf else (lower, upper) for lower, upper in bounds]
        yield [lower + (upper - lower) * share for share, (lower, upper) in zip(shares, ranges, strict=True)]


def _descend(
    model: ArmModel, pose: Pose, start: list[float], bounds: _Bounds, length: float, stalled: float = _ROUGH
) -> tuple[_Point, int]:
    """The local minimum reached from `start`, and the number of steps."""
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
    """(J^T J + damping)^-1 J^T error over the joints that no bound stops; None when it has no solution."""
    columns = [
        (vx / length, vy / length, vz / length, wx, wy, wz) for vx, vy, vz, wx, wy, wz in jacobian_columns(point.poses)
    ]
    downhill = [sum(map(mul, column, point.error)) for column in columns]
    free = [
        not ((angle <= lower and slope < 0.0) or (angle >= upper and slope > 0.0))
        for angle, (lower, upper), slope in zip(point.q, bounds, downhill, strict=True)
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
    """Axis times angle (rad, 0 to pi), in the base frame, from the actual to the wanted rotation."""
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
    # Near pi the axis is the longest column of the symmetric part, since R = 2 n n^T - 1.
    axis = max(
        (xx + 1.0, 0.5 * (xy + yx), 0.5 * (xz + zx)),
        (0.5 * (xy + yx), yy + 1.0, 0.5 * (yz + zy)),
        (0.5 * (xz + zx), 0.5 * (yz + zy), zz + 1.0),
        key=lambda column: hypot(*column),
    )
    factor = atan2(sine, cosine) / hypot(*axis)
    return factor * axis[0], factor * axis[1], factor * axis[2]


def _wrapped(q: Sequence[float], q_near: Sequence[float], bounds: _Bounds) -> Iterator[float]:
    """Each angle plus the multiple of 2 pi that brings it nearest to `q_near` inside its bounds, else the angle."""
    for angle, near, (lower, upper) in zip(q, q_near, bounds, strict=True):
        nearest = angle + tau * round((near - angle) / tau)
        if not lower <= nearest <= upper:
            inside = [candidate for candidate in (nearest - tau, nearest + tau) if lower <= candidate <= upper]
            nearest = inside[0] if inside else angle
        yield nearest


def require_rotation(pose: Pose) -> None:
    """Raise ValueError unless the rotation of the pose is orthonormal."""
    error = orthonormality_error(pose[1])
    if not error <= _INVALID_ROTATION:
        raise ValueError(f"the rotation of the pose is invalid: R R^T differs from 1 by {error:.3g}")
