"""The arm's workspace: the tool inside a box, its axes in cones, the bodies clear of keep-out boxes and of each other.

Distances are signed, m: positive inside the workspace, negative outside. Bodies are capsules (`kinematics.capsules`);
they keep `cartesian.clearance` from keep-out boxes and from each other, and distances are measured beyond it. A body
that no joint moves, the base, is not compared with boxes. If a fixed end of a body, as the upper arm's in the
shoulder, is nearer to a box than the clearance, the rest of that body may come as near.

The angle of a tool's axis from the surface of its cone counts as the way of the tip of a pointer, `POINTER_M` long,
that turns with the tool: everything that holds for a point and a wall then holds for an orientation and a cone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import atan2, cos, dist, hypot, sqrt
from typing import Final, NamedTuple, Protocol

from kinematics.capsules import Placed, between_axes, capsules, distance, from_box, outside, point_at, self_pairs
from kinematics.forward import frames
from kinematics.model import JOINTS, ArmModel, Capsule
from kinematics.pose import Pose, Rotation, Vector
from rtcp.config.model import MOST_TOOLS
from rtcp.ipc.schema import FIRST_CONE
from rtcp.motion.limits import Cone, Corners

TOOL: Final = 6
"""Index of the tool in `frames`."""
INNER_BOX: Final = -1
"""Zone number of the box around the tool; the keep-out boxes are numbered from 0."""
ITSELF: Final = 1000
"""Zone number of the first pair of the arm's own bodies; the cones are numbered from `FIRST_CONE`, which is less."""
POINTER_M: Final = 0.25
"""Way of the pointer's tip for a turn of the tool by 1 rad, m/rad: about the length that the wrist turns."""
_FAR: Final = 1e9
"""Distance without any boundary, m."""
_FIXED_M: Final = 0.005
"""How much nearer to a box than its fixed end a body may come, m."""
_NO_SHARE: Final = 1e-6
_SAME_M: Final = 1e-9


class Boxes(Protocol):
    """Holder of boxes: the limits in force, or new ones."""

    @property
    def box(self) -> Corners | None:
        """Box that the tool stays inside."""
        ...

    @property
    def keep_out(self) -> tuple[Corners, ...]:
        """Boxes that the arm's bodies stay outside of."""
        ...

    @property
    def cones(self) -> tuple[Cone, ...]:
        """Cones that axes of the tool stay inside."""
        ...


class Clearance(NamedTuple):
    """Signed distance of a point of the arm from a boundary, m.

    `zone`: number of the box, cone or pair. The point is at `place`, m, and moves with `link`; the unit vector `normal`
    points away from the boundary, which moves with the link `other`; 0: fixed. For a cone `normal` is the axis of the
    rotation that leads the tool's axis straight away from the boundary.
    """

    distance: float
    zone: int
    link: int
    other: int
    place: Vector
    normal: Vector


class Gap(NamedTuple):
    """A pair of bodies, a body and a keep-out box, or the tool and its box or a cone: distance (m), number, first body.

    A motion of the arm's farthest point changes the distance by at most `share` of it; a bend of that point from its
    chord bends the bodies of the gap by at most `bend` of it.
    """

    distance: float
    zone: int
    body: int
    share: float
    bend: float


def inside(x: float, y: float, z: float, box: Corners) -> float:
    """Return the distance of a point from the nearest wall of the box around it; negative: outside."""
    a, b, c, d, e, f = box
    return min(x - a, d - x, y - b, e - y, z - c, f - z)


def is_cone(zone: int) -> bool:
    """Return whether a zone number is that of a cone."""
    return FIRST_CONE <= zone < ITSELF


def reported(zone: int, distance: float) -> float:
    """Return a distance (m) as events report it: m, that from a cone in rad."""
    return distance / POINTER_M if is_cone(zone) else distance


def inside_cone(rotation: Rotation, cone: Cone) -> float:
    """Return the angle of a tool's axis from the surface of its cone, rad; negative: outside."""
    axis, u, v, w, angle = cone
    x, y, z = rotation[axis], rotation[axis + 3], rotation[axis + 6]
    return angle - atan2(hypot(y * w - z * v, z * u - x * w, x * v - y * u), x * u + y * v + z * w)


class Zones:
    """The boxes and cones of an arm, and the arm itself.

    Args:
        model: the geometry.
        boxes: read every time.
        clearance: least distance of bodies from boxes and from each other, m.
    """

    def __init__(self, model: ArmModel, boxes: Boxes, clearance: float) -> None:
        self.model = model
        self._boxes = boxes
        self._clearance = clearance
        geometry = _geometry(model)
        self._pairs, self._shares, self._fixed = geometry.pairs, geometry.shares, geometry.fixed
        self._pair_shares, self._all_shares = geometry.pair_shares, geometry.all_shares
        self.reach, self.pair_reach = geometry.reach, geometry.pair_reach
        if boxes.cones:
            self.reach = [max(POINTER_M, reach) for reach in geometry.reach]
        self._turn_share = POINTER_M / min(self.reach) if boxes.cones else 1.0
        """Of `reach`: the part of the pointer; a cone has it as its `share` and `bend`."""
        self.before, self.after = Placed(geometry.bodies), Placed(geometry.bodies)
        """The bodies at the two ends of a piece of the motion."""
        self._moving = [number for number, body in enumerate(geometry.bodies) if body.link]
        self._whole = [1.0] * (len(geometry.bodies) + len(self._pairs))

    @property
    def any(self) -> bool:
        """Whether there are boxes, cones or pairs of bodies."""
        boxes = self._boxes
        return boxes.box is not None or bool(boxes.keep_out) or bool(boxes.cones) or bool(self._pairs)

    def links(self, zone: int) -> tuple[int, int]:
        """Return the links of a pair of the arm's own bodies, the inner one first."""
        i, j = self._pairs[zone - ITSELF]
        first, second = self.before.bodies[i].link, self.before.bodies[j].link
        return (first, second) if first < second else (second, first)

    def distance(self, poses: Sequence[Pose]) -> tuple[float, int]:
        """Return the least signed distance at the frames of a configuration, and its box, cone or pair."""
        least, zone = self.box_distance(poses)
        own, pair = self.own_distance(poses)
        return (own, pair) if own < least else (least, zone)

    def box_distance(self, poses: Sequence[Pose]) -> tuple[float, int]:
        """Return the least signed distance from the boxes and cones, and that box or cone."""
        return self._from_boxes(poses, self._whole, 1.0)

    def own_distance(self, poses: Sequence[Pose]) -> tuple[float, int]:
        """Return the least signed distance of the arm's bodies from each other, and that pair."""
        return self._from_itself(poses, self._whole)

    def room(self, poses: Sequence[Pose]) -> float:
        """Return the least motion of the arm's farthest point before a contact is possible, m."""
        return min(
            self._from_boxes(poses, self._shares, self._turn_share)[0], self._from_itself(poses, self._all_shares)[0]
        )

    def _margin(self, body: int, box: Corners) -> float:
        """Return the required distance of a body from a box, m."""
        least = self._clearance
        for place in self._fixed[body]:
            least = min(least, outside(*place, box) - self.before.radii[body] - _FIXED_M)
        return least

    def _from_boxes(self, poses: Sequence[Pose], shares: Sequence[float], turn_share: float) -> tuple[float, int]:
        least, zone = _FAR, INNER_BOX
        boxes, placed = self._boxes, self.before
        if boxes.box is not None:
            x, y, z = poses[TOOL][0]
            least = inside(x, y, z, boxes.box)
        if boxes.cones:
            for number, cone in enumerate(boxes.cones, FIRST_CONE):
                room = POINTER_M * inside_cone(poses[TOOL].rotation, cone) / turn_share
                if room < least:
                    least, zone = room, number
        if boxes.keep_out:
            placed.place(poses)
            for number, box in enumerate(boxes.keep_out):
                for body in self._moving:
                    share, clearance = shares[body], self._margin(body, box)
                    room = (from_box(placed, body, box, least * share + clearance)[0] - clearance) / share
                    if room < least:
                        least, zone = room, number
        return least, zone

    def _from_itself(self, poses: Sequence[Pose], shares: Sequence[float]) -> tuple[float, int]:
        least, zone = _FAR, ITSELF
        placed = self.before
        if self._pairs:
            placed.place(poses)
            for number, pair in enumerate(self._pairs):
                room = (distance(placed, placed, (pair,))[0] - self._clearance) / shares[number]
                if room < least:
                    least, zone = room, ITSELF + number
        return least, zone

    def gaps(self, poses: Sequence[Pose], within: float, pairs_within: float) -> list[Gap]:
        """Return possible contacts if the arm moves by `within`, and pairs by `pairs_within`, m; places `before`."""
        boxes, placed, clearance, shares = self._boxes, self.before, self._clearance, self._shares
        placed.place(poses)
        gaps = []
        if boxes.box is not None:
            x, y, z = poses[TOOL][0]
            apart = inside(x, y, z, boxes.box)
            if apart <= within:
                gaps.append(Gap(apart, INNER_BOX, TOOL, 1.0, 1.0))
        if boxes.cones:
            share = self._turn_share
            for number, cone in enumerate(boxes.cones, FIRST_CONE):
                apart = POINTER_M * inside_cone(poses[TOOL].rotation, cone)
                if apart <= share * within:
                    gaps.append(Gap(apart, number, TOOL, share, share))
        for number, box in enumerate(boxes.keep_out):
            for body in self._moving:
                share, margin = shares[body], self._margin(body, box)
                apart = from_box(placed, body, box, share * within + margin)[0] - margin
                if apart <= share * within:
                    gaps.append(Gap(apart, number, body, share, share))
        for number, (i, j) in enumerate(self._pairs):
            share = self._pair_shares[number]
            apart = distance(placed, placed, ((i, j),))[0] - clearance
            if apart <= share * pairs_within:
                gaps.append(Gap(apart, ITSELF + number, i, share, shares[i] + shares[j]))
        return gaps

    def remeasure(self, gap: Gap, poses: Sequence[Pose]) -> float:
        """Return the distance of a gap at `poses`, m; `after` must have been placed there."""
        boxes, placed = self._boxes, self.after
        if gap.zone == INNER_BOX:
            assert boxes.box is not None
            return inside(*poses[TOOL][0], boxes.box)
        if is_cone(gap.zone):
            return POINTER_M * inside_cone(poses[TOOL].rotation, boxes.cones[gap.zone - FIRST_CONE])
        if gap.zone < ITSELF:
            box = boxes.keep_out[gap.zone]
            return from_box(placed, gap.body, box)[0] - self._margin(gap.body, box)
        return distance(placed, placed, (self._pairs[gap.zone - ITSELF],))[0] - self._clearance

    def depth(self, zone: int, distance: float) -> float:
        """Return how deep the pointer's tip is behind the plane through the rim of a cone, m.

        All that is inside the cone lies behind this plane, whatever the angle: a tip that moves straight between two
        depths stays as deep as the lesser one.

        Args:
            zone: of the cone.
            distance: of the tip from the cone, m along its arc.
        """
        angle = self._boxes.cones[zone - FIRST_CONE].angle
        return POINTER_M * (cos(angle - distance / POINTER_M) - cos(angle))

    def parted(self, gap: Gap, margin: float) -> bool:
        """Return whether one plane separates the two sides of a gap at both ends of a piece, `before` and `after`.

        A point that moves straight between the ends stays on its side.

        Args:
            gap: of a body and a box, or of two bodies.
            margin: required distance beyond radius and clearance, m.
        """
        own_at, before, after = 6 * gap.body, self.before.axes, self.after.axes
        margin += self.thickness(gap)
        other_at = -1
        if gap.zone >= ITSELF:
            j = self._pairs[gap.zone - ITSELF][1]
            other_at = 6 * j
        for placed in (self.before, self.after):
            if other_at < 0:
                box = self._boxes.keep_out[gap.zone]
                x, y, z = _way_out(point_at(placed.axes, own_at, from_box(placed, gap.body, box)[1]), box)
                far = max(x * box[0], x * box[3]) + max(y * box[1], y * box[4]) + max(z * box[2], z * box[5])
            else:
                x, y, z = _apart(placed.axes, own_at, other_at)[2]
                far = max(_greatest(before, other_at, x, y, z), _greatest(after, other_at, x, y, z))
            near = -max(_greatest(before, own_at, -x, -y, -z), _greatest(after, own_at, -x, -y, -z))
            if near - far >= margin:
                return True
        return False

    def thickness(self, gap: Gap) -> float:
        """Return the distance of the axes of two bodies, or of an axis and a box, at a gap of 0, m."""
        radius = self.before.radii[gap.body]
        if gap.zone < ITSELF:
            return radius + self._margin(gap.body, self._boxes.keep_out[gap.zone])
        return radius + self.before.radii[self._pairs[gap.zone - ITSELF][1]] + self._clearance

    def swap(self) -> None:
        """Make `after` the new `before`."""
        self.before, self.after = self.after, self.before

    def clearances(self, poses: Sequence[Pose], within: float) -> list[Clearance]:
        """Return the boundaries nearer than `within` (m), nearest first, for controllers that slow down and slide.

        `within` is scaled to the share of each body, as in `room`. A body near a box has a boundary at its nearest
        point and one at each end, which a rotation may bring nearer.
        """
        clearances: list[Clearance] = []
        boxes, placed, clearance = self._boxes, self.before, self._clearance
        placed.place(poses)
        if boxes.box is not None:
            position = poses[TOOL][0]
            for axis in range(3):
                for apart, sign in (
                    (position[axis] - boxes.box[axis], 1.0),
                    (boxes.box[axis + 3] - position[axis], -1.0),
                ):
                    if apart < within:
                        clearances.append(Clearance(apart, INNER_BOX, TOOL, 0, position, _unit(axis, sign)))
        for number, cone in enumerate(boxes.cones, FIRST_CONE):
            apart = POINTER_M * inside_cone(poses[TOOL].rotation, cone)
            if apart < self._turn_share * within:
                turn = _turn_inward(poses[TOOL].rotation, cone)
                clearances.append(Clearance(apart, number, TOOL, 0, poses[TOOL][0], turn))
        for number, box in enumerate(boxes.keep_out):
            for body in self._moving:
                near, margin = self._shares[body] * within, self._margin(body, box)
                apart, part = from_box(placed, body, box, near + margin)
                if apart - margin < near:
                    beyond = placed.radii[body] + margin
                    for at in sorted({part, 0.0, 1.0}):
                        place = point_at(placed.axes, 6 * body, at)
                        apart = outside(*place, box) - beyond
                        if apart < near:
                            link = placed.bodies[body].link
                            clearances.append(Clearance(apart, number, link, 0, place, _way_out(place, box)))
        for number, (i, j) in enumerate(self._pairs):
            if distance(placed, placed, ((i, j),))[0] - clearance < self._all_shares[number] * within:
                beyond = placed.radii[i] + placed.radii[j] + clearance
                # Of the outer body, relative to the inner one.
                apart, place, normal = _apart(placed.axes, 6 * j, 6 * i)
                links = placed.bodies[j].link, placed.bodies[i].link
                clearances.append(Clearance(apart - beyond, ITSELF + number, *links, place, normal))
        clearances.sort(key=lambda clearance: clearance.distance)
        return clearances


class _Geometry(NamedTuple):
    """Constants of the bodies of a model.

    `pairs`: pairs that may collide, the inner body first. `reach`: upper bound on the distance of a body's axis, or the
    tool, from each joint's axis, m. `pair_reach`: upper bound on the change of a pair's distance by each joint, m/rad.
    `shares`: largest part of `reach` of each body; `pair_shares`: of `pair_reach`, of each pair; `all_shares`: of
    `reach`, of each pair. `fixed`: positions of the ends of each body that no joint moves, m.
    """

    bodies: tuple[Capsule, ...]
    pairs: tuple[tuple[int, int], ...]
    reach: list[float]
    pair_reach: list[float]
    shares: list[float]
    pair_shares: list[float]
    all_shares: list[float]
    fixed: list[list[Vector]]


@lru_cache(maxsize=2 * MOST_TOOLS)
def _geometry(model: ArmModel) -> _Geometry:
    bodies = capsules(model)
    pairs = tuple((i, j) if bodies[i].link < bodies[j].link else (j, i) for i, j in self_pairs(model))
    lengths = [hypot(row.a, row.d) for row in model.rows]
    reaches = [_reach(lengths, body.link, max(hypot(*body.start), hypot(*body.end))) for body in bodies]
    tool = _reach(lengths, JOINTS, hypot(*model.tool.position))
    reach = [max(of_joint) for of_joint in zip(tool, *reaches, strict=True)]
    swept = [_swept(model, lengths, bodies[i], bodies[j].link, reaches[j]) for i, j in pairs]
    pair_reach = [max(of_joint) for of_joint in zip([0.0] * JOINTS, *swept, strict=True)]
    shares = [_share(levers, reach) for levers in reaches]
    pair_shares, all_shares = ([_share(levers, whole) for levers in swept] for whole in (pair_reach, reach))
    return _Geometry(bodies, pairs, reach, pair_reach, shares, pair_shares, all_shares, _fixed(model, bodies))


def _fixed(model: ArmModel, bodies: Sequence[Capsule]) -> list[list[Vector]]:
    """Return the ends of each body with the same position in three configurations without symmetry."""
    placed, places = Placed(bodies), []
    for q in ((0.3, -0.7, 1.1, 0.5, -0.9, 0.2), (-1.2, 0.4, -0.6, 1.7, 0.8, -2.1), (2.2, 1.3, 0.4, -0.8, 1.9, 0.7)):
        placed.place(frames(model, q))
        places.append([[point_at(placed.axes, 6 * body, end) for end in (0.0, 1.0)] for body in range(len(bodies))])
    return [
        [a for a, b, c in zip(*ends, strict=True) if max(dist(a, b), dist(a, c)) < _SAME_M]
        for ends in zip(*places, strict=True)
    ]


def _reach(lengths: Sequence[float], link: int, beyond: float) -> list[float]:
    """Return the upper bound on the distance of a point, `beyond` m off a link's origin, from each joint's axis, m."""
    return [sum(lengths[joint + 1 : link]) + beyond if joint < link else 0.0 for joint in range(JOINTS)]


def _swept(model: ArmModel, lengths: Sequence[float], inner: Capsule, link: int, reach: Sequence[float]) -> list[float]:
    """Return the upper bound on the change of a body's distance from an outer body by each joint, m/rad.

    Rotating the outer body about an axis equals rotating the inner one back: the one nearer to the axis counts.
    """
    sine, cosine, a, d, _ = model.constants[inner.link]
    ends = (inner.start, inner.end)
    swept = [0.0] * JOINTS
    for joint in range(inner.link, link):
        if joint == inner.link:  # its axis is fixed in the inner link
            near = max([hypot(x - a, cosine * y + sine * z) for x, y, z in ends])
        else:
            near = max([hypot(x - a, y + sine * d, z - cosine * d) for x, y, z in ends])
            near += sum(lengths[inner.link + 1 : joint + 1])
        swept[joint] = min(near, reach[joint])
    return swept


def _share(part: Sequence[float], whole: Sequence[float]) -> float:
    """Return the greatest ratio of `part` to `whole` over all joints; at least `_NO_SHARE`, as callers divide by it."""
    return max([_NO_SHARE, *[a / b for a, b in zip(part, whole, strict=True) if b > 0.0]])


def _apart(axes: Sequence[float], first: int, second: int) -> tuple[float, Vector, Vector]:
    """Return the distance of two axes, m, the nearest point of the first, and the unit vector to it from the second."""
    square, s, t = between_axes(axes, first, axes, second)
    place, (x, y, z) = point_at(axes, first, s), point_at(axes, second, t)
    apart = sqrt(square)
    if apart == 0.0:
        return 0.0, place, (0.0, 0.0, 1.0)
    return apart, place, ((place[0] - x) / apart, (place[1] - y) / apart, (place[2] - z) / apart)


def _greatest(axes: Sequence[float], at: int, x: float, y: float, z: float) -> float:
    """Return the coordinate along (x, y, z) of the farther end of an axis, m."""
    start = x * axes[at] + y * axes[at + 1] + z * axes[at + 2]
    along = x * axes[at + 3] + y * axes[at + 4] + z * axes[at + 5]
    return start + along if along > 0.0 else start


def _unit(axis: int, sign: float) -> Vector:
    x, y, z = (sign if axis == at else 0.0 for at in range(3))
    return x, y, z


def _turn_inward(rotation: Rotation, cone: Cone) -> Vector:
    """Return the axis of the shortest rotation of a tool's axis to the middle of its cone; 0 where there is no one."""
    axis, u, v, w, _ = cone
    x, y, z = rotation[axis], rotation[axis + 3], rotation[axis + 6]
    x, y, z = y * w - z * v, z * u - x * w, x * v - y * u
    length = hypot(x, y, z)
    return (x / length, y / length, z / length) if length > 0.0 else (0.0, 0.0, 0.0)


def _way_out(place: Vector, box: Corners) -> Vector:
    (x, y, z), (a, b, c, d, e, f) = place, box
    gaps = [(a - x if x < a else d - x if x > d else 0.0) for x, a, d in ((x, a, d), (y, b, e), (z, c, f))]
    length = hypot(*gaps)
    if length > 0.0:
        return -gaps[0] / length, -gaps[1] / length, -gaps[2] / length
    walls = [(x - a, 0, -1.0), (d - x, 0, 1.0), (y - b, 1, -1.0), (e - y, 1, 1.0), (z - c, 2, -1.0), (f - z, 2, 1.0)]
    _, axis, sign = min(walls)
    return _unit(axis, sign)
