"""Joint velocity for a wanted tool velocity, bounded also where the arm cannot follow."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from operator import mul
from typing import NamedTuple

from kinematics.jacobian import Row, characteristic_length, jacobian, scaled_rows
from kinematics.linear import gram, inverse, product, solve_positive
from kinematics.model import ArmModel
from kinematics.pose import require_finite

THRESHOLD = 0.04  # of the smallest singular value, below which damping begins

_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")


class JointVelocity(NamedTuple):
    """Joint velocity for a tool velocity, and what of that tool velocity it does not give.

    qd: six rad/s.
    lost: six numbers, wanted minus achieved tool velocity: vx, vy, vz in m/s, wx, wy, wz in rad/s, base frame.
    damping: lambda of the damped least squares, without unit; 0 away from singularities, at most the threshold.
    scale: what the joint velocity was multiplied with to keep the joint speed limits; 1 when they did not matter.
    """

    qd: Row
    lost: Row
    damping: float
    scale: float


def joint_velocity(
    model: ArmModel,
    q: Sequence[float],
    twist: Sequence[float],
    *,
    threshold: float = THRESHOLD,
    respect_limits: bool = True,
) -> JointVelocity:
    """Joint velocity with which the tool point moves with `twist` (vx, vy, vz in m/s, wx, wy, wz in rad/s, base frame).

    Damped least squares: qd = J^T (J J^T + lambda^2)^-1 twist, with the linear rows of J and of the twist divided by
    the arm's `characteristic_length`. sigma = 1 / ||J^-1||, in Frobenius' norm, is at most the smallest singular value
    and at least that over sqrt(6). From `threshold` on lambda is zero and the twist is met exactly; below it
    lambda^2 = threshold^2 - sigma^2. So qd is continuous in q, and |qd| <= |scaled twist| / threshold everywhere.

    With `respect_limits` the whole joint velocity is scaled down until no joint exceeds its speed limit, so that the
    tool keeps its direction. Position limits are not looked at. ValueError names a value that is not finite.

    Sources: Nakamura and Hanafusa 1986 (damping that varies with the distance from the singularity), Maciejewski and
    Klein 1988 (by the smallest singular value), Chiaverini, Siciliano and Egeland 1994 (this form of lambda).
    """
    require_finite(twist, _TWIST)
    if not threshold > 0.0:
        raise ValueError(f"threshold is {threshold}: a positive number is needed")
    vx, vy, vz, wx, wy, wz = twist
    rows = jacobian(model, q)
    weight = 1.0 / characteristic_length(model)
    scaled = scaled_rows(rows, weight)
    wanted = (weight * vx, weight * vy, weight * vz, wx, wy, wz)

    qd: list[float]
    damping = 0.0
    inverted = inverse(scaled)
    sigma = 0.0 if inverted is None else 1.0 / sqrt(sum(sum(map(mul, row, row)) for row in inverted))
    if inverted is not None and sigma >= threshold:
        qd = product(inverted, wanted)
    else:
        square = threshold * threshold - sigma * sigma
        damping = sqrt(square)
        matrix = gram(scaled)
        for i, row in enumerate(matrix):
            row[i] += square
        # Positive definite: no eigenvalue is below threshold^2, as sigma is never above the smallest singular value.
        middle = solve_positive(matrix, wanted) or [0.0] * 6
        qd = [sum(map(mul, column, middle)) for column in zip(*scaled, strict=True)]

    scale = 1.0
    if respect_limits:
        for speed, limit in zip(qd, model.limits, strict=True):
            if abs(speed) * scale > limit.velocity:
                scale = limit.velocity / abs(speed)
        if scale < 1.0:
            qd = [scale * speed for speed in qd]
    lost = [a - b for a, b in zip(twist, product(rows, qd), strict=True)]
    return JointVelocity(tuple(qd), tuple(lost), damping, scale)  # type: ignore[arg-type]
