"""Geometric Jacobian of the tool point, and how far a configuration is from a singularity."""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, fabs, hypot, sqrt
from typing import NamedTuple, TypeAlias

from kinematics.forward import frames
from kinematics.linear import determinant, smallest_singular_value
from kinematics.model import ArmModel
from kinematics.pose import Pose
from kinematics.spherical import has_spherical_wrist

Row: TypeAlias = tuple[float, float, float, float, float, float]
Rows: TypeAlias = tuple[Row, Row, Row, Row, Row, Row]
_Triple: TypeAlias = tuple[float, float, float]

_PARALLEL = 1e-9  # sine of the angle below which two axes count as parallel


class SingularityDistances(NamedTuple):
    """How far a configuration is from each singularity; each is zero exactly on it, to round-off.

    shoulder: m, distance of the wrist centre from the plane that holds axis 1 and the direction of axis 2. Without a
        lateral offset of the arm this is its distance from axis 1 itself. Needs axis 2 parallel to axis 3, else None.
    elbow: rad, 0 to pi/2, angle of the upper arm (axis 2 to axis 3) and the forearm (axis 3 to the wrist centre), both
        seen along axis 2, from stretched or folded, whichever is nearer. Needs axis 2 parallel to axis 3, else None.
    wrist: rad, 0 to pi/2, angle of joint 5 from the nearest position in which axes 4, 5 and 6 lie in one plane (in the
        common wrist: axes 4 and 6 in one line). Needs a spherical wrist, without which all three are None.
    smallest: smallest singular value of the Jacobian whose linear rows are divided by `characteristic_length`; for
        every arm, and zero on every singularity. It is the speed, in characteristic lengths or rad per second, that the
        tool reaches in its worst direction with joint speeds of 1 rad/s in all.
    """

    shoulder: float | None
    elbow: float | None
    wrist: float | None
    smallest: float


def jacobian(model: ArmModel, q: Sequence[float]) -> Rows:
    """Rows vx, vy, vz (m/s) and wx, wy, wz (rad/s) of the tool point along the base's axes, for 1 rad/s of each joint.

    The velocity is that of the tool's origin, in directions of the base frame. `q`: six finite angles in rad;
    ValueError names one that is not. Column i is (z_i x (p - p_i), z_i): Craig, Introduction to Robotics, section 5.7.
    """
    return _rows(frames(model, q))


def jacobian_columns(poses: Sequence[Pose]) -> list[Row]:
    """The six columns of `jacobian`, from the seven poses that `frames` gives."""
    px, py, pz = poses[6][0]
    columns = []
    for (ox, oy, oz), (_, _, zx, _, _, zy, _, _, zz) in poses[:6]:
        rx = px - ox
        ry = py - oy
        rz = pz - oz
        columns.append((zy * rz - zz * ry, zz * rx - zx * rz, zx * ry - zy * rx, zx, zy, zz))
    return columns


def tool_jacobian(model: ArmModel, q: Sequence[float]) -> Rows:
    """The same velocity of the same point as `jacobian`, in directions of the tool frame."""
    poses = frames(model, q)
    xx, yx, zx, xy, yy, zy, xz, yz, zz = poses[6].rotation
    vx, vy, vz, wx, wy, wz = _rows(poses)

    def along(x: float, y: float, z: float, a: Row, b: Row, c: Row) -> Row:
        return tuple(x * i + y * j + z * k for i, j, k in zip(a, b, c, strict=True))  # type: ignore[return-value]

    return (
        along(xx, xy, xz, vx, vy, vz),
        along(yx, yy, yz, vx, vy, vz),
        along(zx, zy, zz, vx, vy, vz),
        along(xx, xy, xz, wx, wy, wz),
        along(yx, yy, yz, wx, wy, wz),
        along(zx, zy, zz, wx, wy, wz),
    )


def manipulability(model: ArmModel, q: Sequence[float]) -> float:
    """|det J| in m^3, which is sqrt(det(J J^T)) for six joints; zero on a singularity, the same in every frame.

    Yoshikawa, Manipulability of robotic mechanisms, 1985.
    """
    return fabs(determinant(jacobian(model, q)))


def characteristic_length(model: ArmModel) -> float:
    """The length in m that makes translations and rotations comparable: half the reach from axis 2 to the tool.

    The reach is the sum of the lengths of rows 2 to 6 and of the tool; 1 m for an arm without any.
    """
    rows = model.rows[1:]
    reach = sum(fabs(row.a) + fabs(row.d) for row in rows) + hypot(*model.tool.position)
    return 0.5 * reach or 1.0


def scaled_rows(rows: Rows, weight: float) -> Rows:
    """The rows of a Jacobian with the three linear ones times `weight`, 1 / `characteristic_length`."""
    linear = [(weight * a, weight * b, weight * c, weight * d, weight * e, weight * f) for a, b, c, d, e, f in rows[:3]]
    return (*linear, *rows[3:])  # type: ignore[return-value]


def singularity_distances(model: ArmModel, q: Sequence[float]) -> SingularityDistances:
    """Distances of a configuration (six rad) from the singularities; not meant for the loop (some 0.3 ms).

    With axis 2 parallel to axis 3 and a spherical wrist, the determinant of the Jacobian is a product of three factors,
    one for each singularity: these are they, each divided by its constants.
    """
    poses = frames(model, q)
    length = characteristic_length(model)
    smallest = smallest_singular_value(scaled_rows(_rows(poses), 1.0 / length))
    if not has_spherical_wrist(model):
        return SingularityDistances(None, None, None, smallest)
    volume = _dot(_axis(poses[3]), _cross(_axis(poses[4]), _axis(poses[5])))
    wrist = asin(min(1.0, fabs(volume / (model.constants[4][0] * model.constants[5][0]))))
    shoulder = elbow = None
    if fabs(model.constants[2][0]) < _PARALLEL < fabs(model.constants[1][0]):
        shoulder, elbow = _arm_distances(poses)
    return SingularityDistances(shoulder, elbow, wrist, smallest)


def _rows(poses: Sequence[Pose]) -> Rows:
    return tuple(zip(*jacobian_columns(poses), strict=True))  # type: ignore[return-value]


def _arm_distances(poses: Sequence[Pose]) -> tuple[float, float]:
    """Shoulder in m and elbow in rad."""
    first, second, centre = _axis(poses[0]), _axis(poses[1]), poses[4].position
    normal = _cross(first, second)
    shoulder = fabs(_dot(normal, _between(poses[0], centre))) / sqrt(_dot(normal, normal))
    upper, fore = _between(poses[1], poses[2].position), _between(poses[2], centre)
    # Along axis 2 both may be displaced, which moves nothing: only what is perpendicular to it counts.
    across = fabs(_dot(second, _cross(upper, fore)))
    along = fabs(_dot(upper, fore) - _dot(upper, second) * _dot(fore, second))
    return shoulder, atan2(across, along)


def _axis(pose: Pose) -> _Triple:
    rotation = pose.rotation
    return rotation[2], rotation[5], rotation[8]


def _between(pose: Pose, point: _Triple) -> _Triple:
    (ax, ay, az), (bx, by, bz) = pose.position, point
    return bx - ax, by - ay, bz - az


def _dot(a: _Triple, b: _Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: _Triple, b: _Triple) -> _Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
