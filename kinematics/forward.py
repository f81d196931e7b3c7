"""Where the tool, and every frame of the arm, is for given joint angles; plain floats, for one configuration.

For many configurations at once see `kinematics.batch`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

from kinematics.model import JOINTS, ArmModel
from kinematics.pose import Pose, require_finite


def forward(model: ArmModel, q: Sequence[float]) -> Pose:
    """The tool's pose in the base frame for six joint angles `q`, rad.

    The product of T(i-1, i) = Rx(alpha) Tx(a) Rz(q + offset) Tz(d) over the rows, then the tool. Raises ValueError
    for another count than six, and for an angle that is NaN or infinite, naming the joint.
    """
    _check(model, q)
    xx = yy = zz = 1.0
    xy = xz = yx = yz = zx = zy = px = py = pz = 0.0
    for (sa, ca, a, d, offset), angle in zip(model.constants, q, strict=True):
        s, c = sin(angle + offset), cos(angle + offset)
        px, py, pz = px + a * xx, py + a * xy, pz + a * xz
        # Rx(alpha) turns the y and z axes, Rz(theta) then x and the new y
        tx, ty, tz = ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz
        zx, zy, zz = ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz
        yx, yy, yz = c * tx - s * xx, c * ty - s * xy, c * tz - s * xz
        xx, xy, xz = c * xx + s * tx, c * xy + s * ty, c * xz + s * tz
        px, py, pz = px + d * zx, py + d * zy, pz + d * zz
    flange = Pose((px, py, pz), (xx, yx, zx, xy, yy, zy, xz, yz, zz))
    return flange @ model.tool


def frames(model: ArmModel, q: Sequence[float]) -> tuple[Pose, ...]:
    """Seven poses in the base frame: frames 1 to 6 (frame i moves with joint i) and the tool; errors as `forward`."""
    _check(model, q)
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


def _check(model: ArmModel, q: Sequence[float]) -> None:
    if len(q) != JOINTS:
        raise ValueError(f"{len(q)} joint angles were given: {JOINTS} are needed")
    require_finite(q, model.joint_names)
