"""Joint torques that hold the arm against gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

from kinematics.forward import frames
from kinematics.model import ArmModel, LinkMass
from kinematics.pose import Pose, as_floats, require_finite

Torques = tuple[float, float, float, float, float, float]

STANDARD_GRAVITY = (0.0, 0.0, -9.80665)  # m/s^2 in the base frame of an upright arm; CGPM 1901
_SWEEPS, _BETTER = 4, 1e-9
"""Most sweeps over all joints of a search, and the least improvement, Nm."""
_THIRD, _HALF_TURNS = 2.0 * math.pi / 3.0, 4


def gravity_torques(
    model: ArmModel,
    q: Sequence[float],
    gravity: Sequence[float] = STANDARD_GRAVITY,
    payload: LinkMass | None = None,
) -> Torques:
    """Six torques, Nm, that hold the arm still at `q` (rad): g(q) of M(q) q'' + c(q, q') + g(q) = tau.

    `gravity`: acceleration of free fall, m/s^2, in the base frame. `payload`: a mass whose centre is given in the
    tool frame. Raises ValueError when the model has no link masses, and for a value that is not finite, naming it.

    Statics: joint i carries the moment of the weights of links i to 6, -z_i . (sum over j >= i of (c_j - p_i) x m_j g).
    """
    if not model.links:
        raise ValueError(f"arm {model.name!r} has no link masses; gravity torques need `links`")
    gx, gy, gz = as_floats(gravity)
    require_finite((gx, gy, gz), ("gravity x", "gravity y", "gravity z"))
    poses = frames(model, q)
    mass = mx = my = mz = 0.0  # mass (kg) and first moment about the base (kg m) of all bodies beyond the joint
    if payload is not None:
        mass, mx, my, mz = _moment(poses[6], payload)
    torques = []
    for pose, link in zip(reversed(poses[:6]), reversed(model.links), strict=True):
        m, x, y, z = _moment(pose, link)
        mass += m
        mx += x
        my += y
        mz += z
        (px, py, pz), (_, _, zx, _, _, zy, _, _, zz) = pose
        rx = mx - mass * px
        ry = my - mass * py
        rz = mz - mass * pz
        torques.append(zx * (rz * gy - ry * gz) + zy * (rx * gz - rz * gx) + zz * (ry * gx - rx * gy))
    torques.reverse()
    return tuple(torques)  # type: ignore[return-value]


def _moment(pose: Pose, body: LinkMass) -> tuple[float, float, float, float]:
    """Mass, kg, and mass times the centre's position in the base frame, kg m."""
    (px, py, pz), (a, b, c, d, e, f, g, h, i) = pose
    m = body.mass
    x, y, z = body.centre
    return m, m * (px + a * x + b * y + c * z), m * (py + d * x + e * y + f * z), m * (pz + g * x + h * y + i * z)


def worst_torques(model: ArmModel, ranges: Sequence[tuple[float, float]]) -> Torques:
    """Return the largest holding torque of each joint, Nm, that a search of its range finds; `ranges`: rad, six pairs.

    As a function of one angle each torque is a + b cos(q) + c sin(q), whose extremes are known: the search goes from
    extreme to extreme, joint by joint, until no angle improves. Collisions of the arm with itself are not considered.
    """
    return _worst_torques(model, tuple(ranges))


@lru_cache(maxsize=32)
def _worst_torques(model: ArmModel, ranges: tuple[tuple[float, float], ...]) -> Torques:
    starts = [[low + part * (high - low) for low, high in ranges] for part in (0.5, 0.2)]
    return tuple(max(_climb(model, ranges, i, list(q)) for q in starts) for i in range(6))  # type: ignore[return-value]


def _climb(model: ArmModel, ranges: Sequence[tuple[float, float]], joint: int, q: list[float]) -> float:
    """Return the largest magnitude of a joint's torque, Nm, by coordinate search from the pose `q`."""

    def torque(axis: int, angle: float) -> float:
        return gravity_torques(model, [*q[:axis], angle, *q[axis + 1 :]])[joint]

    best = abs(torque(0, q[0]))
    for _ in range(_SWEEPS):
        before = best
        for axis, (low, high) in enumerate(ranges):
            thirds = [torque(axis, k * _THIRD) for k in range(3)]
            b = (2.0 * thirds[0] - thirds[1] - thirds[2]) / 3.0
            c = (thirds[1] - thirds[2]) / math.sqrt(3.0)
            peak = math.atan2(c, b)
            peaks = [peak + k * math.pi for k in range(-_HALF_TURNS, _HALF_TURNS + 1)]
            for angle in (low, high, *(angle for angle in peaks if low < angle < high)):
                if abs(torque(axis, angle)) > best + _BETTER:
                    best = abs(torque(axis, angle))
                    q[axis] = angle
        if best <= before:
            break
    return best
