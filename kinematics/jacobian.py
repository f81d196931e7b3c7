"""Jacobian of the tool, distances from singularities, and joint velocities for a tool velocity.

The linear algebra of six by six matrices is in plain floats: at this size a numpy call costs more than the arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, fabs, hypot, sqrt
from operator import mul
from typing import Final, NamedTuple, TypeAlias

from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import Pose, Vector, as_floats, require_finite
from kinematics.spherical import has_spherical_wrist

Row: TypeAlias = tuple[float, float, float, float, float, float]
Rows: TypeAlias = tuple[Row, Row, Row, Row, Row, Row]
_Matrix: TypeAlias = Sequence[Sequence[float]]

THRESHOLD: Final = 0.04  # smallest singular value below which `joint_velocity` damps

_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
_PARALLEL: Final = 1e-9  # sine of the angle below which two axes count as parallel
_ORTHOGONAL: Final = 1e-30  # square of the cosine between two rows that count as orthogonal
_SWEEPS: Final = 30  # limit; one-sided Jacobi converges quadratically, in practice in six to eight sweeps


class SingularityDistances(NamedTuple):
    """How far a configuration is from each singularity; each is zero exactly on it, to round-off.

    shoulder: m, distance of the wrist centre from the plane through axis 1 parallel to axis 2. Without a lateral
        offset this is the distance from axis 1 itself. None unless axes 2 and 3 are parallel.
    elbow: rad, 0 to pi/2, angle of upper arm (axis 2 to axis 3) and forearm (axis 3 to the wrist centre), both seen
        along axis 2, from stretched or folded, whichever is nearer. None unless axes 2 and 3 are parallel.
    wrist: rad, 0 to pi/2, angle of joint 5 from the nearest position in which axes 4, 5 and 6 lie in one plane (in a
        right-angled wrist: axes 4 and 6 in one line). Without a spherical wrist all three are None.
    smallest: smallest singular value of the Jacobian with its linear rows divided by `characteristic_length`: the tool
        speed in the worst direction for a joint speed of norm 1 rad/s. Zero on every singularity of every arm.
    """

    shoulder: float | None
    elbow: float | None
    wrist: float | None
    smallest: float


class JointVelocity(NamedTuple):
    """Joint velocity for a tool velocity.

    qd: six rad/s.
    lost: wanted minus achieved tool velocity: vx, vy, vz in m/s, wx, wy, wz in rad/s, base frame.
    damping: lambda of the damped least squares, without unit; 0 away from singularities, at most the threshold.
    scale: factor that keeps the joint speed limits; 1 when no limit is reached.
    """

    qd: Row
    lost: Row
    damping: float
    scale: float


def jacobian(model: ArmModel, q: Sequence[float]) -> Rows:
    """Rows vx, vy, vz (m/s) and wx, wy, wz (rad/s) of the tool's origin in the base frame, for 1 rad/s of each joint.

    `q`: six finite angles, rad; ValueError names one that is not. Column i is (z_i x (p - p_i), z_i): Craig,
    Introduction to Robotics, section 5.7.
    """
    return _rows(frames(model, q))


def jacobian_columns(poses: Sequence[Pose]) -> list[Row]:
    """The six columns of `jacobian`, from the seven poses of `frames`."""
    px, py, pz = poses[6][0]
    columns = []
    for (ox, oy, oz), (_, _, zx, _, _, zy, _, _, zz) in poses[:6]:
        rx = px - ox
        ry = py - oy
        rz = pz - oz
        columns.append((zy * rz - zz * ry, zz * rx - zx * rz, zx * ry - zy * rx, zx, zy, zz))
    return columns


def manipulability(model: ArmModel, q: Sequence[float]) -> float:
    """|det J|, m^3, which is sqrt(det(J J^T)) for six joints; zero on a singularity, the same in every frame.

    `q` and errors as in `jacobian`. Source: Yoshikawa, Manipulability of robotic mechanisms, 1985.
    """
    return fabs(determinant(jacobian(model, q)))


def characteristic_length(model: ArmModel) -> float:
    """The length, m, that makes translations and rotations comparable: half the reach from axis 2 to the tool.

    The reach is the sum of the lengths of rows 2 to 6 and of the tool; 1 m for an arm without any.
    """
    rows = model.rows[1:]
    reach = sum(fabs(row.a) + fabs(row.d) for row in rows) + hypot(*model.tool.position)
    return 0.5 * reach or 1.0


def scaled_rows(rows: Rows, weight: float) -> Rows:
    """The rows of a Jacobian, the three linear ones times `weight` (1 / `characteristic_length`)."""
    linear = [(weight * a, weight * b, weight * c, weight * d, weight * e, weight * f) for a, b, c, d, e, f in rows[:3]]
    return (*linear, *rows[3:])  # type: ignore[return-value]


def singularity_distances(model: ArmModel, q: Sequence[float]) -> SingularityDistances:
    """Distances of a configuration (six angles, rad) from the singularities; about 0.3 ms, too slow for the loop.

    With axes 2 and 3 parallel and a spherical wrist, the determinant of the Jacobian is a product of three factors,
    one for each singularity. The distances are these factors without their constants. Errors as in `jacobian`.
    """
    poses = frames(model, q)
    smallest = min(singular_values(scaled_rows(_rows(poses), 1.0 / characteristic_length(model))))
    if not has_spherical_wrist(model):
        return SingularityDistances(None, None, None, smallest)
    volume = _dot(_axis(poses[3]), _cross(_axis(poses[4]), _axis(poses[5])))
    wrist = asin(min(1.0, fabs(volume / (model.constants[4][0] * model.constants[5][0]))))
    if not fabs(model.constants[2][0]) < _PARALLEL < fabs(model.constants[1][0]):
        return SingularityDistances(None, None, wrist, smallest)
    first, second, centre = _axis(poses[0]), _axis(poses[1]), poses[4].position
    normal = _cross(first, second)
    shoulder = fabs(_dot(normal, _between(poses[0], centre))) / sqrt(_dot(normal, normal))
    upper, fore = _between(poses[1], poses[2].position), _between(poses[2], centre)
    # Only what is perpendicular to axis 2 counts: offsets along it do not change the bend.
    across = fabs(_dot(second, _cross(upper, fore)))
    along = fabs(_dot(upper, fore) - _dot(upper, second) * _dot(fore, second))
    return SingularityDistances(shoulder, atan2(across, along), wrist, smallest)


def joint_velocity(
    model: ArmModel,
    q: Sequence[float],
    twist: Sequence[float],
    *,
    threshold: float = THRESHOLD,
    respect_limits: bool = True,
) -> JointVelocity:
    """Joint velocity for a tool velocity `twist` (vx, vy, vz in m/s, wx, wy, wz in rad/s, base frame).

    Damped least squares: qd = J^T (J J^T + lambda^2)^-1 twist, with the linear rows of J and of the twist divided by
    the arm's `characteristic_length`. sigma = 1 / ||J^-1||, in Frobenius' norm, is at most the smallest singular value
    and at least that over sqrt(6). From `threshold` on lambda is zero and the twist is met exactly; below it
    lambda^2 = threshold^2 - sigma^2. So qd is continuous in q, and |qd| <= |scaled twist| / threshold everywhere.

    With `respect_limits` the whole joint velocity is scaled down until no joint exceeds its speed limit; the tool
    keeps its direction. Position limits are not considered. Raises ValueError naming a value that is not finite.

    Sources: Nakamura and Hanafusa 1986 (damping that varies with the distance from the singularity), Maciejewski and
    Klein 1988 (by the smallest singular value), Chiaverini, Siciliano and Egeland 1994 (this form of lambda).
    """
    require_finite(twist, _TWIST)
    twist = as_floats(twist)
    if not threshold > 0.0:
        raise ValueError(f"threshold is {threshold}; a positive number is required")
    rows = jacobian(model, q)
    weight = 1.0 / characteristic_length(model)
    scaled = scaled_rows(rows, weight)
    wanted = [*(weight * speed for speed in twist[:3]), *twist[3:]]
    matrix = gram(scaled)
    factor = _cholesky(matrix)
    square = 0.0 if factor is None else 1.0 / _inverse_square(factor)
    damping = 0.0
    if factor is None or square < threshold * threshold:
        damping = sqrt(threshold * threshold - square)
        for i, row in enumerate(matrix):
            row[i] += damping * damping
        # Positive definite: no eigenvalue is below threshold^2, as sigma never exceeds the smallest singular value.
        weights = solve_positive(matrix, wanted) or [0.0] * 6
    else:
        weights = _substitute(factor, wanted)
    qd = [sum(map(mul, column, weights)) for column in zip(*scaled, strict=True)]
    scale = 1.0
    if respect_limits:
        for speed, limit in zip(qd, model.limits, strict=True):
            if abs(speed) * scale > limit.velocity:
                scale = limit.velocity / abs(speed)
        qd = [scale * speed for speed in qd]
    lost = [speed - sum(map(mul, row, qd)) for speed, row in zip(twist, rows, strict=True)]
    return JointVelocity(tuple(qd), tuple(lost), damping, scale)


def gram(rows: _Matrix) -> list[list[float]]:
    """A matrix times its transpose: the scalar products of all pairs of rows, symmetric."""
    count = len(rows)
    result = [[0.0] * count for _ in range(count)]
    for i, row in enumerate(rows):
        for j in range(i + 1):
            result[i][j] = result[j][i] = sum(map(mul, row, rows[j]))
    return result


def determinant(matrix: _Matrix) -> float:
    """The determinant of a square matrix, by Gaussian elimination with partial pivoting."""
    rows = [list(row) for row in matrix]
    value = 1.0
    while rows:
        best = max(range(len(rows)), key=lambda i: abs(rows[i][0]))
        pivot = rows.pop(best)
        if pivot[0] == 0.0:
            return 0.0
        value *= -pivot[0] if best % 2 else pivot[0]
        tail = pivot[1:]
        rows = [[x - row[0] / pivot[0] * y for x, y in zip(row[1:], tail, strict=True)] for row in rows]
    return value


def solve_positive(matrix: _Matrix, right: Sequence[float]) -> list[float] | None:
    """Solve a symmetric positive definite system of any size by Cholesky; None when it is not positive definite."""
    lower = _cholesky(matrix)
    return None if lower is None else _substitute(lower, right)


def singular_values(matrix: _Matrix) -> list[float]:
    """The singular values of a square matrix, unsorted, by one-sided Jacobi rotations of its rows (Hestenes 1958).

    Small singular values keep a better relative accuracy than through the eigenvalues of the Gram matrix.
    """
    rows = [list(row) for row in matrix]
    size = len(rows)
    for _ in range(_SWEEPS):
        is_orthogonal = True
        for i in range(size - 1):
            for j in range(i + 1, size):
                u, v = rows[i], rows[j]
                uu, vv, uv = sum(map(mul, u, u)), sum(map(mul, v, v)), sum(map(mul, u, v))
                if uv * uv <= _ORTHOGONAL * uu * vv:
                    continue
                is_orthogonal = False
                zeta = (vv - uu) / (2.0 * uv)
                tangent = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + hypot(1.0, zeta))
                cosine = 1.0 / hypot(1.0, tangent)
                sine = cosine * tangent
                rows[i] = [cosine * x - sine * y for x, y in zip(u, v, strict=True)]
                rows[j] = [sine * x + cosine * y for x, y in zip(u, v, strict=True)]
        if is_orthogonal:
            break
    return [hypot(*row) for row in rows]


def _cholesky(matrix: _Matrix) -> list[list[float]] | None:
    """Rows of the lower triangular factor, each up to the diagonal; None when the matrix is not positive definite."""
    lower: list[list[float]] = []
    for i, source in enumerate(matrix):
        row: list[float] = []
        for j, above in enumerate(lower):
            row.append((source[j] - sum(map(mul, row, above))) / above[j])
        pivot = source[i] - sum(map(mul, row, row))
        if not pivot > 0.0:
            return None
        row.append(sqrt(pivot))
        lower.append(row)
    return lower


def _substitute(lower: _Matrix, right: Sequence[float]) -> list[float]:
    """Solve L L^T x = right."""
    solved: list[float] = []
    for i, row in enumerate(lower):
        solved.append((right[i] - sum(map(mul, row, solved))) / row[i])
    for i in range(len(lower) - 1, -1, -1):
        row = lower[i]
        solved[i] = value = solved[i] / row[i]
        for j in range(i):
            solved[j] -= value * row[j]
    return solved


def _inverse_square(lower: _Matrix) -> float:
    """||L^-1||^2 in Frobenius' norm, which is trace((L L^T)^-1)."""
    inverse: list[list[float]] = []
    square = 0.0
    for i, row in enumerate(lower):
        scale = 1.0 / row[i]
        # row i of the inverse, from the rows above it
        new = [-scale * sum(map(mul, row, column)) for column in zip(*inverse, strict=True)]
        new.append(scale)
        for above in inverse:
            above.append(0.0)
        inverse.append(new)
        square += sum(map(mul, new, new))
    return square


def _rows(poses: Sequence[Pose]) -> Rows:
    return tuple(zip(*jacobian_columns(poses), strict=True))  # type: ignore[return-value]


def _axis(pose: Pose) -> Vector:
    rotation = pose.rotation
    return rotation[2], rotation[5], rotation[8]


def _between(pose: Pose, point: Vector) -> Vector:
    (ax, ay, az), (bx, by, bz) = pose.position, point
    return bx - ax, by - ay, bz - az


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
