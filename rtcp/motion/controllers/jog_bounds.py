"""Bounds on the velocity of a jogged tool: joint ranges, boxes, cones and singularities.

A bound is a row r and a speed b >= 0: r . (vx, vy, vz, wx, wy, wz) <= b. `slide` removes the part of the motion that
exceeds a bound and keeps the rest; singularities halt the whole motion instead (`halt`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Final

from kinematics.pose import Pose
from rtcp.ipc.schema import HELD_BOX_AT, HELD_CONE, HELD_ITSELF, HELD_RANGE_AT, HELD_SHOULDER
from rtcp.motion.controllers.jog_inverse import JogInverse, Row
from rtcp.motion.guards.zones import INNER_BOX, ITSELF, POINTER_M, Clearance, Zones, is_cone
from rtcp.motion.limits import Limits

STANDOFF_M: Final = 0.008
"""Distance at which a tool stops before a boundary, m; more than the guard's own stop needs."""
_GUARD_M: Final = 0.003
"""Part of a distance that is left to the guard's stop, m."""
JOINT_MARGIN_RAD: Final = 2e-4
_BRAKES: Final = 0.5
"""Share of a joint's acceleration for its braking envelope; the rest is for the path."""
_WITHIN_M: Final = 0.13
"""Nearer boundaries are bounds, m."""
_FASTEST_POINT_M_S: Final = 2.0
"""Upper bound on the speed of any point of the arm, m/s."""
_PASSES: Final = 6
"""Limit on the number of bounds that are applied to a twist."""
_TOLERANCE: Final = 1e-9


class JogBounds:
    """Bounds of one arm at one configuration.

    Args:
        limits: ranges, speeds and accelerations of the joints, and the boxes; read every cycle.
        zones: measures clearances; None: the arm has no boxes and no bodies.
        inverse: inverse Jacobian of the current configuration.
        braking: deceleration before a box, m/s^2.
        turning: deceleration before a cone, rad/s^2.
        singularity: smallest distances from shoulder, elbow and wrist singularity, m, rad, rad; 0: no bound.
        dt: the cycle, s.
    """

    def __init__(
        self,
        limits: Limits,
        zones: Zones | None,
        inverse: JogInverse,
        braking: float,
        turning: float,
        singularity: Sequence[float],
        dt: float,
    ) -> None:
        self._limits, self._inverse, self._dt = limits, inverse, dt
        self._zones = zones
        self._braking, self._turning = braking, POINTER_M * turning
        self._nearest = tuple(singularity)
        self.near: Sequence[Clearance] = ()
        self._idle = 0
        self._boxes: object = None
        self._rotation_weight = 1.0 / inverse.length**2
        self.axis = self.box = -2
        """Joint, and box, cone or pair (`zones`), that limited the motion in this cycle; -2: none."""
        self._singular = 0

    def update(self, poses: Sequence[Pose], position: Sequence[float], jumped: bool) -> None:
        """Find the boundaries within 0.13 m.

        After a search without result the next one waits until a point could have come that near.

        Args:
            poses: `frames` of the configuration.
            position: the joints, rad.
            jumped: whether `position` does not continue that of the last cycle.
        """
        self.axis = self.box = -2
        self._singular = 0
        self._position = position
        zones, limits = self._zones, self._limits
        self.watched = zones is not None and zones.any
        if zones is None or not self.watched:
            self.near = ()
            return
        boxes = (limits.box, limits.keep_out, limits.cones)
        self._idle -= 1
        if self._idle > 0 and not jumped and boxes == self._boxes:
            return
        self._boxes = boxes
        self.near = zones.clearances(poses, _WITHIN_M)
        self._idle = 0
        if not self.near:
            self._idle = int((zones.room(poses) - _WITHIN_M) / (_FASTEST_POINT_M_S * self._dt))

    @property
    def held(self) -> int:
        """What limited the motion in this cycle: bits `HELD_...` of `rtcp.ipc.schema`."""
        bits = self._singular
        if self.axis >= 0:
            bits |= (self.axis + 1) << HELD_RANGE_AT
        if self.box >= INNER_BOX:
            bits |= (held_zone(self.box) + 2) << HELD_BOX_AT
        return bits

    def passed(self, poses: Sequence[Pose], twist: Sequence[float], speeds: Sequence[float]) -> bool:
        """Return whether `twist`, with its joint speeds, may exceed a bound, so that `slide` has to check it."""
        if self.near or self._inverse.lost:
            return True
        limits, q = self._limits, self._position
        low, high, acceleration = limits.low, limits.high, limits.acceleration
        for i in range(6):
            v = speeds[i]
            stopping_distance = (high[i] - q[i] if v > 0.0 else q[i] - low[i]) - JOINT_MARGIN_RAD
            # v^2 > 2 a s, with a margin for the time steps
            if v * v > 1.8 * _BRAKES * acceleration[i] * stopping_distance and v:
                return True
        return False

    def slide(self, poses: Sequence[Pose], twist: list[float], moves: bool, rotates: bool) -> bool:
        """Remove from `twist` what exceeds a bound; return False where the tool has to stand still.

        A pure translation gets no rotation, and a pure rotation no translation.

        Args:
            poses: `frames` of the configuration.
            twist: vx, vy, vz, wx, wy, wz along the base's axes; changed.
            moves: whether the linear part may change.
            rotates: whether the angular part may change.
        """
        weight = (1.0 if moves else 0.0, self._rotation_weight if rotates else 0.0)
        basis: list[Sequence[float]] = []
        locked = -1
        for row in self._inverse.lost:
            locked = self._inverse.locked.index(True, locked + 1)
            along = _along(row, twist)
            if along > _TOLERANCE or along < -_TOLERANCE:
                self._singular |= HELD_SHOULDER << locked
                if not _subtract(twist, row, along, weight, basis):
                    return False
        for _ in range(_PASSES):
            worst, excess = self._worst(poses, twist)
            if worst is None:
                return True
            if not _subtract(twist, worst, excess, weight, basis):
                return False
        return self._worst(poses, twist)[0] is None

    def _worst(self, poses: Sequence[Pose], twist: Sequence[float]) -> tuple[Row | None, float]:
        """Return the most exceeded bound and its excess, m/s or rad/s."""
        limits, dt = self._limits, self._dt
        low, high, acceleration, fastest = limits.low, limits.high, limits.acceleration, limits.velocity
        a, b, c, d, e, f = twist
        q = self._position
        worst: Row | None = None
        most = _TOLERANCE
        for i, row in enumerate(self._inverse.rows):
            r0, r1, r2, r3, r4, r5 = row
            speed = r0 * a + r1 * b + r2 * c + r3 * d + r4 * e + r5 * f
            if speed > 0.0:
                stopping_distance = high[i] - JOINT_MARGIN_RAD - q[i]
            else:
                stopping_distance = q[i] - low[i] - JOINT_MARGIN_RAD
                speed = -speed
                r0, r1, r2, r3, r4, r5 = -r0, -r1, -r2, -r3, -r4, -r5
            rate = _BRAKES * acceleration[i]
            if stopping_distance * rate * 2.0 > fastest[i] * fastest[i] * 1.1:
                continue
            excess = speed - stopping(stopping_distance, rate, dt)
            if excess > most:
                worst, most, self.axis = (r0, r1, r2, r3, r4, r5), excess, i
        for clearance in self.near:
            row = self._approach(poses, clearance)
            excess = _along(row, twist) - self.allowed(clearance)
            if excess > most:
                worst, most, self.box = row, excess, clearance.zone
        return worst, most

    def allowed(self, clearance: Clearance) -> float:
        """Return the speed towards a boundary that can still stop before it, m/s."""
        rate = self._turning if is_cone(clearance.zone) else self._braking
        return stopping(clearance.distance - STANDOFF_M, rate, self._dt)

    def _approach(self, poses: Sequence[Pose], clearance: Clearance) -> Row:
        """Return the row whose product with a twist is the speed of a point towards its boundary, m/s."""
        x, y, z = clearance.normal
        x, y, z = -x, -y, -z
        if clearance.zone == INNER_BOX:
            return x, y, z, 0.0, 0.0, 0.0
        if is_cone(clearance.zone):
            return 0.0, 0.0, 0.0, POINTER_M * x, POINTER_M * y, POINTER_M * z
        total = [0.0] * 6
        for i in range(clearance.other, clearance.link):
            k = -lever(poses[i], clearance)
            row = self._inverse.rows[i]
            for j in range(6):
                total[j] += k * row[j]
        a, b, c, d, e, f = total
        return a, b, c, d, e, f

    def halt(self, twist: Sequence[float]) -> float:
        """Return the part of `twist`, 0 to 1, that can still stop before a singularity."""
        share = 1.0
        inverse, limits = self._inverse, self._limits
        for singularity in range(3):
            nearest = self._nearest[singularity]
            distance = inverse.distance[singularity]
            if nearest == 0.0 or inverse.locked[singularity] or distance > 6.0 * nearest + 0.2:
                continue
            approach = -_along(inverse.rate[singularity], twist)
            if approach <= _TOLERANCE:
                continue
            # From the greatest possible speed, braking begins at three times the smallest distance.
            greatest, rate = 0.25, 0.25
            if singularity:
                joint = 2 * singularity
                greatest, rate = limits.velocity[joint], 0.35 * limits.acceleration[joint]
            slow = 0.25 * greatest * greatest / nearest
            allowed = stopping(distance - nearest, slow if slow < rate else rate, self._dt)
            if approach * share > allowed:
                share = allowed / approach
                self._singular |= HELD_SHOULDER << singularity
        return share

    def stoppable(self, poses: Sequence[Pose], speeds: Sequence[float]) -> float:
        """Return the part of the joint speeds, 0 to 1, from which a stop hits no box.

        In a stop each joint decelerates by itself, so the tool leaves its line. To first order a joint displaces a
        point by its lever times v^2 / 2a; the displacements towards the box are added up.
        """
        share = 1.0
        acceleration = self._limits.acceleration
        for clearance in self.near:
            travel = 0.0
            for i in range(clearance.other, clearance.link):
                v = speeds[i]
                towards = -lever(poses[i], clearance) * v
                if towards > 0.0:
                    travel += towards * (v if v > 0.0 else -v) / acceleration[i]
            travel *= 0.5
            distance = clearance.distance
            stopping_distance = max(distance - _GUARD_M, 0.4 * distance)
            if stopping_distance > 0.0 and travel * share * share > stopping_distance:
                share = sqrt(stopping_distance / travel)
                self.box = clearance.zone
        return share


def stopping(stopping_distance: float, rate: float, dt: float) -> float:
    """Return the speed that stops within `stopping_distance` at the deceleration `rate`, in steps of `dt`."""
    if stopping_distance <= 0.0:
        return 0.0
    half = 0.5 * rate * dt
    return sqrt(half * half + 2.0 * rate * stopping_distance) - half


def held_zone(zone: int) -> int:
    """Return the number of a box, cone or pair in `held`."""
    return HELD_ITSELF if zone >= ITSELF else HELD_CONE if is_cone(zone) else min(zone, HELD_CONE - 1)


def lever(pose: Pose, clearance: Clearance) -> float:
    """Return the speed away from a boundary for 1 rad/s about the axis of a frame, m/s."""
    (ox, oy, oz), (_, _, ax, _, _, ay, _, _, az) = pose
    (px, py, pz), (x, y, z) = clearance.place, clearance.normal
    if is_cone(clearance.zone):
        return POINTER_M * (ax * x + ay * y + az * z)
    rx, ry, rz = px - ox, py - oy, pz - oz
    return (ay * rz - az * ry) * x + (az * rx - ax * rz) * y + (ax * ry - ay * rx) * z


def _along(row: Row, twist: Sequence[float]) -> float:
    a, b, c, d, e, f = row
    g, h, i, j, k, m = twist
    return a * g + b * h + c * i + d * j + e * k + f * m


def _subtract(
    twist: list[float], row: Row, excess: float, weight: tuple[float, float], basis: list[Sequence[float]]
) -> bool:
    """Remove `excess` along a row from the twist, orthogonal to the previous rows; return False if impossible."""
    move, rotate = weight
    a, b, c, d, e, f = row
    g, h, i, j, k, m = move * a, move * b, move * c, rotate * d, rotate * e, rotate * f
    whole = a * g + b * h + c * i + d * j + e * k + f * m
    for basis_row in basis:
        part = _along(row, basis_row)
        g, h, i = g - part * basis_row[0], h - part * basis_row[1], i - part * basis_row[2]
        j, k, m = j - part * basis_row[3], k - part * basis_row[4], m - part * basis_row[5]
    remaining = a * g + b * h + c * i + d * j + e * k + f * m
    if remaining <= 1e-6 * whole or remaining <= 1e-12:
        return False
    part = excess / remaining
    twist[0] -= part * g
    twist[1] -= part * h
    twist[2] -= part * i
    twist[3] -= part * j
    twist[4] -= part * k
    twist[5] -= part * m
    n = 1.0 / sqrt(remaining)
    basis.append((g * n, h * n, i * n, j * n, k * n, m * n))
    return True
