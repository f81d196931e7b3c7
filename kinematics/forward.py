"""Forward kinematics: the tool and every frame of the arm for given joint angles, one configuration or many at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import cos, sin
from typing import TYPE_CHECKING, Any, Final

from kinematics.model import JOINTS, ArmModel
from kinematics.pose import IDENTITY, Pose, as_floats, require_finite

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

_BLOCK: Final = 2048  # configurations: the arrays of a block stay in a second-level cache of 1 MiB


def forward(model: ArmModel, q: Sequence[float]) -> Pose:
    """The tool's pose in the base frame for six joint angles `q`, rad.

    The product of T(i-1, i) = Rx(alpha) Tx(a) Rz(q + offset) Tz(d) over the rows, then the tool (Craig, Introduction to
    Robotics, section 3.4). Raises ValueError for a count other than six, and for an angle that is NaN or infinite,
    naming the joint.
    """
    q = _checked(model, q)
    xx = yy = zz = 1.0
    xy = xz = yx = yz = zx = zy = px = py = pz = 0.0
    for (sa, ca, a, d, offset), angle in zip(model.constants, q, strict=True):
        s, c = sin(angle + offset), cos(angle + offset)
        px, py, pz = px + a * xx, py + a * xy, pz + a * xz
        # Rx(alpha) rotates the y and z axes, Rz(theta) then x and the new y
        tx, ty, tz = ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz
        zx, zy, zz = ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz
        yx, yy, yz = c * tx - s * xx, c * ty - s * xy, c * tz - s * xz
        xx, xy, xz = c * xx + s * tx, c * xy + s * ty, c * xz + s * tz
        px, py, pz = px + d * zx, py + d * zy, pz + d * zz
    flange = Pose((px, py, pz), (xx, yx, zx, xy, yy, zy, xz, yz, zz))
    return flange @ model.tool


def frames(model: ArmModel, q: Sequence[float]) -> tuple[Pose, ...]:
    """Seven poses in the base frame: frames 1 to 6 (frame i moves with joint i) and the tool; errors as `forward`."""
    q = _checked(model, q)
    poses = []
    xx = yy = zz = 1.0
    xy = xz = yx = yz = zx = zy = px = py = pz = 0.0
    for (sa, ca, a, d, offset), angle in zip(model.constants, q, strict=True):
        s, c = sin(angle + offset), cos(angle + offset)
        px, py, pz = px + a * xx, py + a * xy, pz + a * xz
        tx, ty, tz = ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz
        zx, zy, zz = ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz
        yx, yy, yz = c * tx - s * xx, c * ty - s * xy, c * tz - s * xz
        xx, xy, xz = c * xx + s * tx, c * xy + s * ty, c * xz + s * tz
        px, py, pz = px + d * zx, py + d * zy, pz + d * zz
        poses.append(Pose((px, py, pz), (xx, yx, zx, xy, yy, zy, xz, yz, zz)))
    poses.append(poses[-1] @ model.tool)
    return tuple(poses)


def forward_batch(model: ArmModel, q: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Tool poses of N configurations: positions (N, 3), m, and rotations (N, 3, 3), base <- tool.

    `q` has the shape (N, 6), rad. Agrees with `forward` to round-off (1e-14 of the reach). Raises ValueError for
    another shape, and for a value that is not finite, naming its row and column.
    """
    import numpy as np  # here, because the loop's process imports this module and must not load numpy

    angles = _batch(q, "q")
    positions = np.empty((len(angles), 3))
    rotations = np.empty((len(angles), 3, 3))
    tool = np.reshape(model.tool.rotation, (3, 3))
    for start in range(0, len(angles), _BLOCK):
        block = slice(start, start + _BLOCK)
        for frame in _frames_batch(model, angles[block]):
            x, y, z, origin = frame  # the last is the flange
        for length, axis in zip(model.tool.position, (x, y, z), strict=True):
            origin = origin + length * axis if length else origin
        if model.tool.rotation != IDENTITY.rotation:
            x, y, z = (tool[0, j] * x + tool[1, j] * y + tool[2, j] * z for j in range(3))
        positions[block] = origin.T
        for j, axis in enumerate((x, y, z)):
            rotations[block, :, j] = axis.T
    return positions, rotations


def twist_batch(model: ArmModel, q: npt.ArrayLike, velocity: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Velocities of the tool in N configurations, (N, 6): vx, vy, vz, m/s, and wx, wy, wz, rad/s, in the base frame.

    `q`, rad, and `velocity` of the joints, rad/s, have the shape (N, 6). The product `jacobian(q) velocity`, as the sum
    over the joints of z_i qd_i x (p - p_i) and of z_i qd_i. Raises ValueError as `forward_batch`.
    """
    import numpy as np

    angles, rates = _batch(q, "q"), _batch(velocity, "velocity")
    twists = np.empty((len(angles), JOINTS))
    for start in range(0, len(angles), _BLOCK):
        block = slice(start, start + _BLOCK)
        rotation, moment = np.zeros((3, len(angles[block]))), np.zeros((3, len(angles[block])))
        for rate, frame in zip(rates[block].T, _frames_batch(model, angles[block]), strict=True):
            x, y, z, origin = frame
            rotation += rate * z
            moment += _cross(rate * z, origin)
        tool = sum((length * axis for length, axis in zip(model.tool.position, (x, y, z), strict=True)), origin)
        twists[block, :3], twists[block, 3:] = (_cross(rotation, tool) - moment).T, rotation.T
    return twists


def _cross(one: Any, other: Any) -> npt.NDArray[np.float64]:
    """The vector product of arrays (3, n); `numpy.cross` would take longer than the rest of `twist_batch`."""
    import numpy as np

    (a, b, c), (x, y, z) = one, other
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x])


def _batch(given: npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
    import numpy as np

    values = np.asarray(given, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != JOINTS:
        raise ValueError(f"{name} has shape {values.shape}; expected (N, {JOINTS})")
    if not np.isfinite(values).all():
        row, joint = np.argwhere(~np.isfinite(values))[0]
        raise ValueError(f"{name}[{row}, {joint}] is {values[row, joint]}; a finite number is required")
    return values


def _frames_batch(model: ArmModel, angles: npt.NDArray[np.float64]) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Yield the axes x, y, z and the origin of frames 1 to 6, each (3, n) or (3, 1), for angles (n, 6)."""
    import numpy as np

    theta = np.ascontiguousarray(angles.T) + [[row.offset] for row in model.rows]
    x, y, z = np.eye(3)[:, :, None]
    origin = np.zeros((3, 1))
    for (sa, ca, a, d, _), s, c in zip(model.constants, np.sin(theta), np.cos(theta), strict=True):
        origin = origin + a * x if a else origin
        if sa == 0.0:
            y, z = ca * y, ca * z
        elif ca == 0.0:
            y, z = sa * z, -sa * y
        else:
            y, z = ca * y + sa * z, ca * z - sa * y
        origin = origin + d * z if d else origin
        x, y = c * x + s * y, c * y - s * x
        yield x, y, z, origin


def _checked(model: ArmModel, q: Sequence[float]) -> Sequence[float]:
    if len(q) != JOINTS:
        raise ValueError(f"{len(q)} joint angles given; {JOINTS} are required")
    require_finite(q, model.joint_names)
    return as_floats(q)
