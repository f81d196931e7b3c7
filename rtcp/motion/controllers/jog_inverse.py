"""Inverse of the Jacobian at a configuration, row by row, and the distances to the singularities.

A spherical wrist decouples it: joints 1 to 3 move the wrist centre, joints 4 to 6 rotate the hand. With axes 2 and 3
parallel the first part decouples too: joint 1 alone moves the centre along axis 2. Near a singularity (`SHOULDER_M`,
`SINE`) the joint whose speed would be unbounded is locked, and `lost` has the direction that the tool loses.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, pi, sqrt
from typing import Final, TypeAlias

from kinematics.jacobian import characteristic_length
from kinematics.model import ArmModel
from kinematics.pose import Pose
from kinematics.spherical import has_spherical_wrist
from rtcp.motion.limits import Limits

Row: TypeAlias = tuple[float, float, float, float, float, float]
_Triple: TypeAlias = tuple[float, float, float]
SHOULDER, ELBOW, WRIST = 0, 1, 2
SHOULDER_M: Final = 0.001
SINE: Final = 0.002
"""Distances to a singularity below which its joint is locked: m of the wrist centre; sine of the bend."""
_ZERO: _Triple = (0.0, 0.0, 0.0)
_FAR: Final = 1e9
_INWARD_M_S: Final = 1e-3
"""Commanded inward speed of the tool above which a stretched elbow bends, m/s."""
_STRAIGHT_RAD: Final = 1e-9
_BENDING: Final = 0.4
"""Share of the joint speeds with which it bends."""
_LOST: Final = 1e-3


class JogInverse:
    """Joint speeds for a tool velocity; `at` computes all attributes for a configuration.

    `rows`: for each joint the six numbers that give its speed, rad/s, from vx, vy, vz (m/s), wx, wy, wz (rad/s) of the
    tool along the base's axes. `distance` and `rate`: distances to the singularities of shoulder (m), elbow and wrist
    (rad), as in `singularity_distances`, and the rows of their growth. `locked`: the locked ones of the three. `lost`:
    rows of the directions the tool has lost.

    Args:
        model: of an arm; `usable` is False unless it has a spherical wrist.
    """

    def __init__(self, model: ArmModel) -> None:
        self.usable = has_spherical_wrist(model)
        self.parallel = abs(model.constants[2][0]) < 1e-9 < abs(model.constants[1][0])
        self.length = characteristic_length(model)
        self._shoulder_sine = abs(model.constants[1][0])
        self._wrist_sine = abs(model.constants[4][0] * model.constants[5][0])
        self.rows: list[Row] = []
        self.distance = [_FAR, _FAR, _FAR]
        self.rate: list[Row] = []
        self.locked = [False, False, False]
        self.lost: list[Row] = []
        self.stretched = True
        self.bend = 0.0
        """Angle of joint 3 from the stretched elbow, rad, with the sign of joint 3."""
        self.wrist_sign = 1.0
        """Sign of the motion of joint 5 away from its singularity."""
        self.arm: Sequence[_Triple] = (_ZERO, _ZERO, _ZERO)
        """Velocity of the wrist centre, m/s, for 1 rad/s of joints 1 to 3."""
        self.to_centre = _ZERO
        """Vector from the tool to the wrist centre, m."""

    def at(self, poses: Sequence[Pose]) -> bool:
        """Compute for the poses of `frames`; return whether an inverse exists, possibly with locked joints."""
        (p1x, p1y, p1z), (_, _, ax, _, _, ay, _, _, az) = poses[0]
        (p2x, p2y, p2z), (_, _, bx, _, _, by, _, _, bz) = poses[1]
        (p3x, p3y, p3z), (_, _, cx, _, _, cy, _, _, cz) = poses[2]
        wx, wy, wz = poses[4][0]
        tx, ty, tz = poses[6][0]
        self.to_centre = ox, oy, oz = wx - tx, wy - ty, wz - tz
        x, y, z = wx - p1x, wy - p1y, wz - p1z
        ux, uy, uz = ay * z - az * y, az * x - ax * z, ax * y - ay * x
        x, y, z = wx - p2x, wy - p2y, wz - p2z
        vx, vy, vz = by * z - bz * y, bz * x - bx * z, bx * y - by * x
        fx, fy, fz = wx - p3x, wy - p3y, wz - p3z
        sx, sy, sz = cy * fz - cz * fy, cz * fx - cx * fz, cx * fy - cy * fx
        self.arm = (ux, uy, uz), (vx, vy, vz), (sx, sy, sz)
        self.lost = lost = []
        locked = self.locked
        locked[0] = locked[1] = locked[2] = False
        # across: twice the area of the triangle of joint 2, joint 3 and the wrist centre
        across = (vy * sz - vz * sy) * bx + (vz * sx - vx * sz) * by + (vx * sy - vy * sx) * bz
        if self.parallel:
            lateral = ux * bx + uy * by + uz * bz
            if -SHOULDER_M < lateral < SHOULDER_M:
                locked[0] = True
                d1x = d1y = d1z = 0.0
                lost.append(self._of_centre(bx, by, bz))
            else:
                d1x, d1y, d1z = bx / lateral, by / lateral, bz / lateral
            gx, gy, gz = p3x - p2x, p3y - p2y, p3z - p2z
            along = gx * fx + gy * fy + gz * fz - (gx * bx + gy * by + gz * bz) * (fx * bx + fy * by + fz * bz)
            sign = 1.0 if bx * cx + by * cy + bz * cz > 0.0 else -1.0
            self.stretched = along > 0.0
            self.bend = bend = sign * atan2(sign * across, along)
            if -SINE * abs(along) < across < SINE * abs(along):
                locked[1] = True
                n = 1.0 / (vx * vx + vy * vy + vz * vz)
                d2x, d2y, d2z = vx * n, vy * n, vz * n
                d3x = d3y = d3z = 0.0
                n = sqrt(n)
                lx, ly, lz = n * (vy * bz - vz * by), n * (vz * bx - vx * bz), n * (vx * by - vy * bx)
                m = lx * ux + ly * uy + lz * uz
                lost.append(self._of_centre(lx - m * d1x, ly - m * d1y, lz - m * d1z))
            else:
                n = 1.0 / across
                d2x, d2y, d2z = n * (sy * bz - sz * by), n * (sz * bx - sx * bz), n * (sx * by - sy * bx)
                d3x, d3y, d3z = n * (by * vz - bz * vy), n * (bz * vx - bx * vz), n * (bx * vy - by * vx)
            m = d2x * ux + d2y * uy + d2z * uz
            d2x, d2y, d2z = d2x - m * d1x, d2y - m * d1y, d2z - m * d1z
            m = d3x * ux + d3y * uy + d3z * uz
            d3x, d3y, d3z = d3x - m * d1x, d3y - m * d1y, d3z - m * d1z
        else:
            kx, ky, kz = vy * sz - vz * sy, vz * sx - vx * sz, vx * sy - vy * sx
            volume = kx * ux + ky * uy + kz * uz
            if -1e-6 < volume < 1e-6:
                return False
            n = 1.0 / volume
            d1x, d1y, d1z = n * kx, n * ky, n * kz
            d2x, d2y, d2z = n * (sy * uz - sz * uy), n * (sz * ux - sx * uz), n * (sx * uy - sy * ux)
            d3x, d3y, d3z = n * (uy * vz - uz * vy), n * (uz * vx - ux * vz), n * (ux * vy - uy * vx)

        _, (_, _, hx, _, _, hy, _, _, hz) = poses[3]
        _, (_, _, ix, _, _, iy, _, _, iz) = poses[4]
        _, (_, _, jx, _, _, jy, _, _, jz) = poses[5]
        nx, ny, nz = iy * jz - iz * jy, iz * jx - ix * jz, ix * jy - iy * jx
        volume = hx * nx + hy * ny + hz * nz
        sine = volume / self._wrist_sine
        if -SINE < sine < SINE:
            locked[2] = True
            dot = ix * jx + iy * jy + iz * jz
            n = 1.0 / (1.0 - dot * dot)
            wrist_rows: tuple[_Triple, ...] = (
                _ZERO,
                (n * (ix - dot * jx), n * (iy - dot * jy), n * (iz - dot * jz)),
                (n * (jx - dot * ix), n * (jy - dot * iy), n * (jz - dot * iz)),
                (nx, ny, nz),
            )
        else:
            n = 1.0 / volume
            wrist_rows = (
                (n * nx, n * ny, n * nz),
                (n * (jy * hz - jz * hy), n * (jz * hx - jx * hz), n * (jx * hy - jy * hx)),
                (n * (hy * iz - hz * iy), n * (hz * ix - hx * iz), n * (hx * iy - hy * ix)),
            )
        rows = [
            (d1x, d1y, d1z, oy * d1z - oz * d1y, oz * d1x - ox * d1z, ox * d1y - oy * d1x),
            (d2x, d2y, d2z, oy * d2z - oz * d2y, oz * d2x - ox * d2z, ox * d2y - oy * d2x),
            (d3x, d3y, d3z, oy * d3z - oz * d3y, oz * d3x - ox * d3z, ox * d3y - oy * d3x),
        ]
        for ex, ey, ez in wrist_rows:
            k1, k2 = ex * ax + ey * ay + ez * az, ex * bx + ey * by + ez * bz
            k3 = ex * cx + ey * cy + ez * cz
            rx, ry = -k1 * d1x - k2 * d2x - k3 * d3x, -k1 * d1y - k2 * d2y - k3 * d3y
            rz = -k1 * d1z - k2 * d2z - k3 * d3z
            rows.append((rx, ry, rz, ex + oy * rz - oz * ry, ey + oz * rx - ox * rz, ez + ox * ry - oy * rx))
        if locked[2]:
            lost.append(rows.pop())
        self.rows = rows

        distance = self.distance
        distance[2] = asin(sine if 0.0 <= sine <= 1.0 else -sine if -1.0 <= sine < 0.0 else 1.0)
        dot = (hx * ix + hy * iy + hz * iz) * (ix * jx + iy * jy + iz * jz) - hx * jx - hy * jy - hz * jz
        self.wrist_sign = 1.0 if dot * volume >= 0.0 else -1.0
        fifth = _signed(rows[4], dot * volume)
        if not self.parallel:
            self.rate = [rows[0], rows[2], fifth]
            return True
        distance[0] = (lateral if lateral >= 0.0 else -lateral) / self._shoulder_sine
        size = bend if bend >= 0.0 else -bend
        distance[1] = size if self.stretched else pi - size
        x, y, z = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
        n = (1.0 if lateral >= 0.0 else -1.0) / self._shoulder_sine
        k2, k3 = n * (x * vx + y * vy + z * vz), n * (x * sx + y * sy + z * sz)
        a, b, c, d, e, f = rows[1]
        g, h, i, j, k, m = rows[2]
        self.rate = [
            (k2 * a + k3 * g, k2 * b + k3 * h, k2 * c + k3 * i, k2 * d + k3 * j, k2 * e + k3 * k, k2 * f + k3 * m),
            _signed(rows[2], bend if self.stretched else -bend),
            fifth,
        ]
        return True

    def _of_centre(self, x: float, y: float, z: float) -> Row:
        """Return the row that gives a component of the wrist centre's velocity from the tool twist."""
        ox, oy, oz = self.to_centre
        return x, y, z, oy * z - oz * y, oz * x - ox * z, ox * y - oy * x


def _signed(row: Row, sign: float) -> Row:
    if sign >= 0.0:
        return row
    a, b, c, d, e, f = row
    return -a, -b, -c, -d, -e, -f


def bend(
    inverse: JogInverse,
    poses: Sequence[Pose],
    position: Sequence[float],
    wanted: Sequence[float],
    speeds: list[float],
    limits: Limits,
    wrist_least: float,
) -> None:
    """Bend a stretched (or open a folded) elbow, if the commanded twist needs it.

    To first order the joints move without moving the tool: joint 2 cancels the effect of joint 3 on the wrist
    centre, and the hand keeps its orientation. To second order the tool moves in its only possible direction.

    Args:
        inverse: of this cycle, with the elbow locked.
        poses: `frames` of the commanded position.
        position: rad, six.
        wanted: commanded twist, six, along the base's axes.
        speeds: joint speeds, rad/s, six; the bending motion is added.
        limits: of the joints.
        wrist_least: least distance of the wrist to its singularity, rad.
    """
    row = inverse.lost[1 if inverse.locked[SHOULDER] else 0]
    x, y, z = row[:3]
    (px, py, pz), (wx, wy, wz) = poses[1].position, poses[4].position
    outward = sum(a1 * b1 for a1, b1 in zip(row, wanted, strict=True))
    if (x * (wx - px) + y * (wy - py) + z * (wz - pz) < 0.0) is inverse.stretched:
        outward = -outward
    if outward > -_INWARD_M_S:
        return
    angle = inverse.bend
    if -_STRAIGHT_RAD < angle < _STRAIGHT_RAD:
        angle = 1.0 if limits.high[2] - position[2] >= position[2] - limits.low[2] else -1.0
    elif not inverse.stretched:
        angle = -angle
    third = 1.0 if angle > 0.0 else -1.0
    _, (a, b, c), (d, e, f) = inverse.arm
    second = -third * (a * d + b * e + c * f) / (a * a + b * b + c * c)
    _, _, x2, _, _, y2, _, _, z2 = poses[1].rotation
    _, _, x3, _, _, y3, _, _, z3 = poses[2].rotation
    x, y, z = -second * x2 - third * x3, -second * y2 - third * y3, -second * z2 - third * z3
    ox, oy, oz = inverse.to_centre
    # Twist of the hand about the wrist centre.
    hand = (-y * oz + z * oy, -z * ox + x * oz, -x * oy + y * ox, x, y, z)
    wrist = [sum(a1 * b1 for a1, b1 in zip(inverse.rows[i], hand, strict=True)) for i in (3, 4, 5)]
    if inverse.locked[WRIST]:
        lost = sum(a1 * b1 for a1, b1 in zip(inverse.lost[-1], hand, strict=True))
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
