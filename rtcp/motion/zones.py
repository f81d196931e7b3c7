"""Boxes in space: the tool stays inside one, and tool, wrist and elbow outside the others.

Distances are signed, m: positive where it is allowed to be, negative where it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, hypot, sqrt
from typing import NamedTuple

from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.motion.limits import Corners, Limits

ELBOW, WRIST, TOOL = 2, 4, 6
"""Places in `frames` of the points that are watched: the origins of frames 3 and 5, and the tool."""
POINTS = (TOOL, WRIST, ELBOW)
INNER_BOX = -1
"""Number of the box that the tool stays inside; the keep-out boxes are numbered from 0."""
_SPACING_M = 0.005
_MOST_SAMPLES = 48
_ROUNDING_M = 1e-9


class Clearance(NamedTuple):
    """The nearest boundary: how far (m, signed), of which box, from which point, and the way out of it, a unit vector."""

    distance: float
    box: int
    point: int
    normal: tuple[float, float, float]


_FREE = Clearance(1e9, INNER_BOX, TOOL, (0.0, 0.0, 0.0))


def outside(x: float, y: float, z: float, box: Corners) -> float:
    """Return how far a point is outside a box; negative: how deep inside."""
    a, b, c, d, e, f = box
    dx = a - x if a - x > x - d else x - d
    dy = b - y if b - y > y - e else y - e
    dz = c - z if c - z > z - f else z - f
    if dx <= 0.0 and dy <= 0.0 and dz <= 0.0:
        return max(dx, dy, dz)
    return hypot(dx if dx > 0.0 else 0.0, dy if dy > 0.0 else 0.0, dz if dz > 0.0 else 0.0)


def inside(x: float, y: float, z: float, box: Corners) -> float:
    """Return how far a point is from the nearest wall of the box that it is in; negative: how far beyond it."""
    a, b, c, d, e, f = box
    return min(x - a, d - x, y - b, e - y, z - c, f - z)


class Zones:
    """The boxes of an arm.

    Args:
        model: the geometry.
        limits: where the boxes are.
    """

    def __init__(self, model: ArmModel, limits: Limits) -> None:
        self._model = model
        self._limits = limits
        self._reach = _reaches(model)

    @property
    def any(self) -> bool:
        """Whether there is a box at all."""
        return self._limits.box is not None or bool(self._limits.keep_out)

    def distance(self, poses: Sequence[Pose]) -> tuple[float, int]:
        """Return the least signed distance for the frames of a configuration, and the number of its box."""
        least, which = 1e9, INNER_BOX
        limits = self._limits
        (tx, ty, tz), (wx, wy, wz), (ex, ey, ez) = poses[TOOL][0], poses[WRIST][0], poses[ELBOW][0]
        if limits.box is not None:
            least = inside(tx, ty, tz, limits.box)
        for number, box in enumerate(limits.keep_out):
            found = min(outside(tx, ty, tz, box), outside(wx, wy, wz, box), outside(ex, ey, ez, box))
            if found < least:
                least, which = found, number
        return least, which

    def clearances(self, poses: Sequence[Pose], within: float) -> list[Clearance]:
        """Return every boundary nearer than `within` (m), the nearest first: for who slows down and slides."""
        found: list[Clearance] = []
        limits = self._limits
        if limits.box is not None:
            position = poses[TOOL][0]
            for axis in range(3):
                for distance, sign in (
                    (position[axis] - limits.box[axis], 1.0),
                    (limits.box[axis + 3] - position[axis], -1.0),
                ):
                    if distance < within:
                        found.append(Clearance(distance, INNER_BOX, TOOL, _unit(axis, sign)))
        for number, box in enumerate(limits.keep_out):
            for point in POINTS:
                x, y, z = poses[point][0]
                distance = outside(x, y, z, box)
                if distance < within:
                    found.append(Clearance(distance, number, point, _way_out(x, y, z, box)))
        found.sort(key=lambda clearance: clearance.distance)
        return found

    def clearance(self, poses: Sequence[Pose]) -> Clearance:
        """Return the nearest boundary."""
        found = self.clearances(poses, 1e9)
        return found[0] if found else _FREE

    def blocked(
        self,
        q: Sequence[float],
        v: Sequence[float],
        poses: Sequence[Pose],
        before: float,
        acceleration: Sequence[float],
    ) -> tuple[int, float] | None:
        """Return the box that a stop from `q` (rad) with `v` (rad/s) would touch and how far it is, or None.

        Each joint ramps down with its own acceleration. Nothing is sampled where no point can travel as far as the
        nearest boundary is away. Where the arm stands too near already (`before`, the distance of where it is now), it
        may go on as long as it comes no nearer.

        Args:
            q: the configuration that is to be commanded.
            v: with these speeds.
            poses: `frames` of `q`.
            before: signed distance of what is commanded now, m.
            acceleration: rad/s^2 of each joint.
        """
        travel = longest = 0.0
        for i, reach in enumerate(self._reach):
            speed = v[i] if v[i] >= 0.0 else -v[i]
            if speed:
                time = speed / acceleration[i]
                travel += 0.5 * speed * time * reach
                if time > longest:
                    longest = time
        distance, which = self.distance(poses)
        if distance > travel + _ROUNDING_M:
            return None
        samples = min(ceil(travel / _SPACING_M), _MOST_SAMPLES)
        least = min(0.5 * travel / samples if samples else 0.0, before) - _ROUNDING_M
        if distance < least:
            return which, distance
        for sample in range(1, samples + 1):
            poses = frames(self._model, _braked(q, v, acceleration, longest * sample / samples))
            distance, which = self.distance(poses)
            if distance < least:
                return which, distance
        return None


def _braked(q: Sequence[float], v: Sequence[float], acceleration: Sequence[float], time: float) -> list[float]:
    """Return where the joints are `time` after they began to ramp down."""
    found = []
    for here, speed, rate in zip(q, v, acceleration, strict=True):
        full = abs(speed) / rate
        t = time if time < full else full
        found.append(here + speed * t - (0.5 if speed > 0.0 else -0.5) * rate * t * t)
    return found


def _reaches(model: ArmModel) -> list[float]:
    """Return for each joint how far from its axis the farthest watched point can be, m."""
    reach = sqrt(sum(component * component for component in model.tool.position))
    reaches = []
    for row in reversed(model.rows):
        reach += abs(row.d)
        reaches.append(reach)
        reach += abs(row.a)
    reaches.reverse()
    return reaches


def _unit(axis: int, sign: float) -> tuple[float, float, float]:
    x, y, z = (sign if axis == at else 0.0 for at in range(3))
    return x, y, z


def _way_out(x: float, y: float, z: float, box: Corners) -> tuple[float, float, float]:
    a, b, c, d, e, f = box
    gaps = [(a - x if x < a else d - x if x > d else 0.0) for x, a, d in ((x, a, d), (y, b, e), (z, c, f))]
    length = hypot(*gaps)
    if length > 0.0:
        return -gaps[0] / length, -gaps[1] / length, -gaps[2] / length
    walls = [(x - a, 0, -1.0), (d - x, 0, 1.0), (y - b, 1, -1.0), (e - y, 1, 1.0), (z - c, 2, -1.0), (f - z, 2, 1.0)]
    _, axis, sign = min(walls)
    return _unit(axis, sign)
