"""Boxes in space: the tool stays inside one, and tool, wrist and elbow outside the others.

Distances are signed, m: positive where it is allowed to be, negative where it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, sqrt
from typing import Final, NamedTuple, Protocol

from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.motion.limits import Corners

ELBOW, WRIST, TOOL = 2, 4, 6
"""Places in `frames` of the points that are watched: the origins of frames 3 and 5, and the tool."""
POINTS = (TOOL, WRIST, ELBOW)
INNER_BOX: Final = -1
"""Number of the box that the tool stays inside; the keep-out boxes are numbered from 0."""


class Boxes(Protocol):
    """Whoever has boxes: limits in force, or those that are to be."""

    @property
    def box(self) -> Corners | None:
        """The tool stays inside it."""
        ...

    @property
    def keep_out(self) -> tuple[Corners, ...]:
        """Tool, wrist and elbow stay outside them."""
        ...


class Clearance(NamedTuple):
    """The nearest boundary: how far (m, signed), of which box, from which point; the way out of it, a unit vector."""

    distance: float
    box: int
    point: int
    normal: tuple[float, float, float]


class Gap(NamedTuple):
    """One of the points that are watched beside one of the boxes: signed distance (m), which, and the point's place."""

    distance: float
    box: int
    point: int
    corners: Corners
    place: tuple[float, float, float]


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
        boxes: read every time.
    """

    def __init__(self, model: ArmModel, boxes: Boxes) -> None:
        self.model = model
        self._boxes = boxes
        self.reach = _reaches(model)
        """For each joint how far from its axis the farthest watched point can be, m."""

    @property
    def any(self) -> bool:
        """Whether there is a box at all."""
        return self._boxes.box is not None or bool(self._boxes.keep_out)

    def distance(self, poses: Sequence[Pose]) -> tuple[float, int]:
        """Return the least signed distance for the frames of a configuration, and the number of its box."""
        least, which = 1e9, INNER_BOX
        boxes = self._boxes
        (tx, ty, tz), (wx, wy, wz), (ex, ey, ez) = poses[TOOL][0], poses[WRIST][0], poses[ELBOW][0]
        if boxes.box is not None:
            least = inside(tx, ty, tz, boxes.box)
        for number, box in enumerate(boxes.keep_out):
            found = min(outside(tx, ty, tz, box), outside(wx, wy, wz, box), outside(ex, ey, ez, box))
            if found < least:
                least, which = found, number
        return least, which

    def clearances(self, poses: Sequence[Pose], within: float) -> list[Clearance]:
        """Return every boundary nearer than `within` (m), the nearest first: for who slows down and slides."""
        found: list[Clearance] = []
        boxes = self._boxes
        if boxes.box is not None:
            position = poses[TOOL][0]
            for axis in range(3):
                for distance, sign in (
                    (position[axis] - boxes.box[axis], 1.0),
                    (boxes.box[axis + 3] - position[axis], -1.0),
                ):
                    if distance < within:
                        found.append(Clearance(distance, INNER_BOX, TOOL, _unit(axis, sign)))
        for number, box in enumerate(boxes.keep_out):
            for point in POINTS:
                x, y, z = poses[point][0]
                distance = outside(x, y, z, box)
                if distance < within:
                    found.append(Clearance(distance, number, point, _way_out(x, y, z, box)))
        found.sort(key=lambda clearance: clearance.distance)
        return found

    def gaps(self, poses: Sequence[Pose], within: float) -> list[Gap]:
        """Return every pair of a point and a box that are nearer than `within`, m."""
        boxes = self._boxes
        found = []
        if boxes.box is not None:
            x, y, z = poses[TOOL][0]
            distance = inside(x, y, z, boxes.box)
            if distance <= within:
                found.append(Gap(distance, INNER_BOX, TOOL, boxes.box, (x, y, z)))
        for number, box in enumerate(boxes.keep_out):
            for point in POINTS:
                x, y, z = poses[point][0]
                distance = outside(x, y, z, box)
                if distance <= within:
                    found.append(Gap(distance, number, point, box, (x, y, z)))
        return found


def _reaches(model: ArmModel) -> list[float]:
    """Lengths along a joint's own axis do not count; the reach of an outer joint is never the longer one."""
    reach = sqrt(sum(component * component for component in model.tool.position))
    reaches = []
    for row in reversed(model.rows):
        reaches.append(reach)
        reach += abs(row.d) + abs(row.a)
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
