"""How a jog leaves the stretched elbow: bent by its joints, which no inverse Jacobian says there."""

from __future__ import annotations

from collections.abc import Sequence

from kinematics.pose import Pose
from rtcp.motion.controllers.jog_inverse import SHOULDER, WRIST, JogInverse
from rtcp.motion.limits import Limits

_INWARD_M_S = 1e-3
"""An elbow that is stretched bends where the tool is wanted to come inwards faster than this."""
_STRAIGHT_RAD = 1e-9
_BENDING = 0.4
"""Part of the joints' speeds with which it bends."""
_LOST = 1e-3


def bend(
    inverse: JogInverse,
    poses: Sequence[Pose],
    position: Sequence[float],
    wanted: Sequence[float],
    speeds: list[float],
    limits: Limits,
    wrist_least: float,
) -> None:
    """Bend a stretched (or open a folded) elbow, where the tool is to go that way.

    The joints then move as they can without moving the tool, to first order: joint 2 takes back what joint 3 does
    to the wrist centre, and the hand keeps its direction. To second order the tool goes the only way that it can.

    Args:
        inverse: of this cycle, the elbow locked.
        poses: `frames` of what is commanded.
        position: rad, six.
        wanted: the twist that is wanted, six, along the base's axes.
        speeds: rad/s, six; what bends is added.
        limits: of the joints.
        wrist_least: as near as the wrist may come to its singularity, rad.
    """
    row = inverse.lost[1 if inverse.locked[SHOULDER] else 0]
    x, y, z = row[:3]
    (px, py, pz), (wx, wy, wz) = poses[1].position, poses[4].position
    outward = sum(one * other for one, other in zip(row, wanted, strict=True))
    if (x * (wx - px) + y * (wy - py) + z * (wz - pz) < 0.0) is inverse.stretched:
        outward = -outward
    if outward > -_INWARD_M_S:
        return
    way = inverse.bend
    if -_STRAIGHT_RAD < way < _STRAIGHT_RAD:
        way = 1.0 if limits.high[2] - position[2] >= position[2] - limits.low[2] else -1.0
    elif not inverse.stretched:
        way = -way
    third = 1.0 if way > 0.0 else -1.0
    _, (a, b, c), (d, e, f) = inverse.arm
    second = -third * (a * d + b * e + c * f) / (a * a + b * b + c * c)
    _, _, x2, _, _, y2, _, _, z2 = poses[1].rotation
    _, _, x3, _, _, y3, _, _, z3 = poses[2].rotation
    x, y, z = -second * x2 - third * x3, -second * y2 - third * y3, -second * z2 - third * z3
    ox, oy, oz = inverse.to_centre
    # The twist that turns the hand about the wrist centre.
    hand = (-y * oz + z * oy, -z * ox + x * oz, -x * oy + y * ox, x, y, z)
    wrist = [sum(one * other for one, other in zip(inverse.rows[i], hand, strict=True)) for i in (3, 4, 5)]
    if inverse.locked[WRIST]:
        lost = sum(one * other for one, other in zip(inverse.lost[-1], hand, strict=True))
        if abs(lost) > _LOST:
            return
    elif inverse.distance[WRIST] < wrist_least and wrist[1] * inverse.wrist_sign < 0.0:
        return
    rate = 1.0
    for i, v in enumerate((0.0, second, third, *wrist)):
        if abs(v) * rate > _BENDING * limits.velocity[i]:
            rate = _BENDING * limits.velocity[i] / abs(v)
    for i, v in enumerate((0.0, second, third, *wrist)):
        speeds[i] += rate * v
