"""An independent reading of process data and of the arm's bodies, for the checkers of simulated sessions.

Nothing here is shared with the product: a mistake in its kinematics, distances or decoding cannot hide itself. Only
plain numbers of the loaded configuration are read: bit lengths, factors, Denavit-Hartenberg parameters, capsules.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from math import acos, cos, hypot, inf, sin, sqrt
from typing import Any, NamedTuple

Point = tuple[float, float, float]
Box = Sequence[float]
"""x, y, z of the lower corner, then of the upper one, m."""

_CODES = {(8, True): "b", (8, False): "B", (16, True): "h", (16, False): "H", (32, True): "i", (32, False): "I",
          (64, True): "q", (64, False): "Q"}  # fmt: skip
"""Codes of the `struct` module by length in bits and sign."""
_REALS = {"float32": "f", "float64": "d"}
_JOINT_RADIUS, _HALF_LENGTH = 0.045, 1.25
"""Radius of a joint's cylinder, relative to the sum of the arm's lengths, and half its length, relative to the radius:
the default bodies are as thick as the sphere around this cylinder (docs/kinematics.md)."""
_FIXED_M = 0.005
"""How much nearer to a box than its fixed end a body may come, m (docs/kinematics.md)."""
_SAME_M = 1e-9
_GOLDEN = 0.5 * (sqrt(5.0) - 1.0)
_SECTIONS = 24
"""Golden sections of an axis: the nearest point is found to 0.618^24 = 1e-5 of its length, 10 um for an axis of 1 m."""
_POSES = ((0.4, -0.6, 1.3, 0.7, -1.1, 0.1), (-0.9, 0.5, -0.8, 1.4, 0.6, -2.0), (1.9, 1.2, 0.3, -0.5, 1.7, 0.8))
"""Joint positions without symmetry, rad: a point with the same position in all of them is fixed."""


# -- process data ---------------------------------------------------------------------------------------------------


def unpacker(
    pdos: Sequence[Any], axis: int, names: Sequence[str]
) -> tuple[Callable[[bytes], tuple[Any, ...]], list[int], list[float]]:
    """Return the function that unpacks the named objects of a drive's axis from its process data.

    The objects follow one another without gaps, by sync manager, and each sync manager begins at a whole byte
    (ETG.1000.6, 5.6.5).

    Args:
        pdos: the process data objects of one direction, from the device description.
        axis: axis of the drive, from 1.
        names: names of the objects.

    Returns:
        The function, the index of each name in its result (-1: the object is not mapped), and the SI units per count.

    Raises:
        ValueError: an object does not begin or end at a whole byte.
    """
    managers: dict[int, list[Any]] = {}
    for pdo in pdos:
        managers.setdefault(pdo.sync_manager or 0, []).append(pdo)
    form, end, at = "<", 0, 0
    places, factors, count = [-1] * len(names), [0.0] * len(names), 0
    for manager in sorted(managers):
        at = (at + 7) // 8 * 8
        for pdo in managers[manager]:
            for entry in pdo.channels:
                of_axis = pdo.axis if entry.axis is None else entry.axis
                if entry.index and of_axis == axis and entry.name in names:
                    code = _REALS.get(entry.type) or _CODES.get((entry.length, entry.type.startswith("int")))
                    if at % 8 or code is None:
                        raise ValueError(f"the channel {entry.name} is not of whole bytes")
                    form += f"{at // 8 - end}x{code}"
                    end = (at + entry.length) // 8
                    places[names.index(entry.name)], factors[names.index(entry.name)] = count, entry.factor
                    count += 1
                at += entry.length
    return struct.Struct(form).unpack_from, places, factors


# -- bodies ---------------------------------------------------------------------------------------------------------


class Body(NamedTuple):
    """All that is nearer than `radius` to the straight line from `start` to `end`, m in the frame of its link."""

    link: int
    """0: the base; i moves with joint i."""
    start: Point
    end: Point
    radius: float


class Placed(NamedTuple):
    """A body in the world: start of its axis, vector to the end, and radius, m."""

    start: Point
    along: Point
    radius: float


class Shape:
    """The bodies of an arm with one of its tools.

    Args:
        models: the geometry of the arm with each of its tools.
        tool: number of the tool; None: the bodies of all tools together, as the partners in a cell see the arm.
        clearance: least distance of bodies from boxes and from each other, m.
    """

    def __init__(self, models: Sequence[Any], tool: int | None, clearance: float) -> None:
        model = models[tool or 0]
        self._clearance = clearance
        self._rows = [(sin(row.alpha), cos(row.alpha), row.a, row.d, row.offset) for row in model.rows]
        self._tool: Point = tuple(model.tool.position)
        self._axes = tuple(model.tool.rotation)
        own = [Body(*_numbers(body)) for body in model.bodies]
        lengths = [hypot(row.a, row.d) for row in model.rows]
        extent = sum(abs(row.a) + abs(row.d) for row in model.rows) or 1.0
        radius = _JOINT_RADIUS * extent * hypot(1.0, _HALF_LENGTH)
        if not own:
            own = [Body(link, start, end, radius) for link, start, end in self._pieces() if start != end]
        derived = 0 if model.bodies else len(own)
        for each in models if tool is None else [model]:
            if each.tool_bodies is not None:
                own += [Body(*_numbers(body)) for body in each.tool_bodies]
            elif not model.bodies and any(each.tool.position):
                own.insert(derived, Body(len(self._rows), (0.0, 0.0, 0.0), tuple(each.tool.position), radius))
                derived += 1
        self.bodies = own
        ranges = [(limit.lower, limit.upper) for limit in model.limits]
        self._pairs = list(self._colliding(derived, lengths, [min(max(0.0, low), high) for low, high in ranges]))
        self._moving = [number for number, body in enumerate(own) if body.link]
        self._fixed = self._fixed_ends()
        beyond = max([hypot(*self._tool), *(hypot(*end) for body in own for end in (body.start, body.end))])
        self.reach = [sum(lengths[joint + 1 :]) + beyond for joint in range(len(lengths))]
        """Largest distance that a point of the arm moves by each joint, m/rad."""

    def _pieces(self) -> Iterator[tuple[int, Point, Point]]:
        """Yield the straight pieces from each joint to the next: link, start and end."""
        for link, (sine, cosine, a, d, _) in enumerate(self._rows):
            corner = (a, 0.0, 0.0)
            yield link, (0.0, 0.0, 0.0), corner
            yield link, corner, (a, -sine * d, cosine * d)

    def _colliding(self, derived: int, lengths: Sequence[float], home: Sequence[float]) -> Iterator[tuple[int, int]]:
        """Yield the pairs of bodies that may collide: neither neighbours nor bodies that always overlap.

        Default bodies that overlap with the joints at home do not count: they are too thick for the arm.
        """
        there = self.placed(home)
        for i, j in combinations(range(len(self.bodies)), 2):
            a, b = sorted((self.bodies[i], self.bodies[j]), key=lambda body: body.link)
            if b.link - a.link < 2:
                continue
            sine, cosine, x, d, _ = self._rows[a.link]
            joint = (x, -sine * d, cosine * d)
            farthest = _from_axis(joint, a.start, _minus(a.end, a.start)) + sum(lengths[a.link + 1 : b.link])
            farthest += _from_axis((0.0, 0.0, 0.0), b.start, _minus(b.end, b.start))
            if farthest <= a.radius + b.radius:
                continue
            if min(i, j) >= derived or _gap(there[i], there[j]) > 0.0:
                yield i, j

    def _fixed_ends(self) -> list[list[Point]]:
        """Return the ends of each body that no joint moves."""
        ends = [[(start, _plus(start, along)) for start, along, _ in self.placed(q)] for q in _POSES]
        return [
            [a for a, b, c in zip(*of_body, strict=True) if max(_far(a, b), _far(a, c)) < _SAME_M]
            for of_body in zip(*ends, strict=True)
        ]

    @property
    def is_guarded(self) -> bool:
        """Whether there are bodies that may collide with each other."""
        return bool(self._pairs)

    def frames(self, q: Sequence[float]) -> list[tuple[tuple[float, ...], Point]]:
        """Return rotation (by rows) and origin, m, of the base and of the frame that moves with each joint.

        T = Rx(alpha) Tx(a) Rz(q + offset) Tz(d) for each row.

        Args:
            q: joint positions, rad.
        """
        a, b, c, d, e, f, g, h, i = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
        x = y = z = 0.0
        found: list[tuple[tuple[float, ...], Point]] = [((a, b, c, d, e, f, g, h, i), (x, y, z))]
        for (sine, cosine, length, depth, offset), angle in zip(self._rows, q, strict=False):
            s, t = sin(angle + offset), cos(angle + offset)
            v, w = -sine * depth, cosine * depth
            x, y, z = (
                x + a * length + b * v + c * w, y + d * length + e * v + f * w, z + g * length + h * v + i * w,
            )  # fmt: skip
            sc, ss, tc, ts = s * cosine, s * sine, t * cosine, t * sine
            a, b, c = a * t + b * sc + c * ss, -a * s + b * tc + c * ts, -b * sine + c * cosine
            d, e, f = d * t + e * sc + f * ss, -d * s + e * tc + f * ts, -e * sine + f * cosine
            g, h, i = g * t + h * sc + i * ss, -g * s + h * tc + i * ts, -h * sine + i * cosine
            found.append(((a, b, c, d, e, f, g, h, i), (x, y, z)))
        return found

    def placed(self, q: Sequence[float]) -> list[Placed]:
        """Return the bodies at joint positions, rad, in the frame of the base."""
        return self._place(self.frames(q))

    def _place(self, frames: Sequence[tuple[tuple[float, ...], Point]]) -> list[Placed]:
        found = []
        for link, start, end, radius in self.bodies:
            rotation, origin = frames[link]
            first = _plus(origin, _turned(rotation, start))
            found.append(Placed(first, _minus(_plus(origin, _turned(rotation, end)), first), radius))
        return found

    def tool(self, q: Sequence[float]) -> Point:
        """Return the position of the tool at joint positions, rad."""
        rotation, origin = self.frames(q)[-1]
        return _plus(origin, _turned(rotation, self._tool))

    def tilt(self, q: Sequence[float], axis: int, direction: Sequence[float]) -> float:
        """Return the angle between an axis of the tool (0 to 2: x, y, z) and a direction of the base, rad."""
        rotation, _ = self.frames(q)[-1]
        along = _turned(rotation, (self._axes[axis], self._axes[3 + axis], self._axes[6 + axis]))
        x, y, z = direction
        cosine = _dot(along, (x, y, z)) / hypot(x, y, z)
        return acos(min(max(cosine, -1.0), 1.0))

    def distance(self, q: Sequence[float], box: Box | None, keep_out: Sequence[Box]) -> float:
        """Return by how much the arm is clear of all that it has to keep clear of, m; negative: it is not.

        Bodies that move keep the clearance from each keep-out box, and all keep it from each other. The tool stays
        inside its box. A body with a fixed end that is nearer to a box may come as near everywhere.

        Args:
            q: joint positions, rad.
            box: the box that the tool stays inside; None: none.
            keep_out: the keep-out boxes.
        """
        frames = self.frames(q)
        rotation, origin = frames[-1]
        least = inf
        if box is not None:
            at = _plus(origin, _turned(rotation, self._tool))
            least = min(min(at[k] - box[k], box[k + 3] - at[k]) for k in range(3))
        bodies = self._place(frames)
        for walls in keep_out:
            for number in self._moving:
                body, margin = bodies[number], self._clearance
                for end in self._fixed[number]:
                    margin = min(margin, _outside(end, walls) - body.radius - _FIXED_M)
                apart = _from_box(body, walls, least + body.radius + margin) - body.radius - margin
                least = min(least, apart)
        for i, j in self._pairs:
            if _far_apart(bodies[i], bodies[j], least + self._clearance):
                continue
            apart = _gap(bodies[i], bodies[j]) - self._clearance
            least = min(least, apart)
        return least


def apart(one: Sequence[Placed], other: Sequence[Placed]) -> float:
    """Return the least distance of the bodies of two arms in the world, m; negative: they overlap."""
    least = inf
    for a in one:
        for b in other:
            if not _far_apart(a, b, least):
                least = min(least, _gap(a, b))
    return least


def in_world(bodies: Sequence[Placed], position: Point, rpy: Point) -> list[Placed]:
    """Return bodies in the world.

    Args:
        bodies: bodies in the frame of the base of their arm.
        position: position of the base, m.
        rpy: rotation of the base, rad: R = Rx Ry Rz (docs/cell.md).
    """
    (sr, sp, sy), (cr, cp, cy) = map(sin, rpy), map(cos, rpy)
    turn = (
        cp * cy, -cp * sy, sp,
        cr * sy + sr * sp * cy, cr * cy - sr * sp * sy, -sr * cp,
        sr * sy - cr * sp * cy, sr * cy + cr * sp * sy, cr * cp,
    )  # fmt: skip
    return [Placed(_plus(position, _turned(turn, a)), _turned(turn, b), radius) for a, b, radius in bodies]


def _numbers(body: Any) -> tuple[int, Point, Point, float]:
    return body.link, tuple(body.start), tuple(body.end), body.radius


def _plus(a: Point, b: Point) -> Point:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _minus(a: Point, b: Point) -> Point:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _far(a: Point, b: Point) -> float:
    return hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _turned(rotation: Sequence[float], point: Point) -> Point:
    (a, b, c, d, e, f, g, h, i), (x, y, z) = rotation, point
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _from_axis(point: Point, start: Point, along: Point) -> float:
    """Return the distance of a point from a straight line with two ends, m."""
    square = _dot(along, along)
    part = min(max(_dot(_minus(point, start), along) / square, 0.0), 1.0) if square else 0.0
    return _far(point, (start[0] + part * along[0], start[1] + part * along[1], start[2] + part * along[2]))


def _gap(one: Placed, other: Placed) -> float:
    """Return the distance of two bodies, m; negative: they overlap.

    Two straight lines with ends are nearest between two inner points, where the connection is normal to both, or at
    one of the four ends.
    """
    (p, u, r), (q, v, s) = one, other
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    w = _minus(q, p)
    square = uu * vv - uv * uv
    if square > 1e-12 * uu * vv:
        uw, vw = _dot(u, w), _dot(v, w)
        i, j = (uw * vv - vw * uv) / square, (uw * uv - vw * uu) / square
        if 0.0 <= i <= 1.0 and 0.0 <= j <= 1.0:
            return hypot(*(j * b - i * a + c for a, b, c in zip(u, v, w, strict=True))) - r - s
    nearest = min(
        _from_axis(p, q, v), _from_axis(_plus(p, u), q, v), _from_axis(q, p, u), _from_axis(_plus(q, v), p, u)
    )  # fmt: skip
    return nearest - r - s


def _far_apart(one: Placed, other: Placed, within: float) -> bool:
    """Return whether balls around two bodies are farther apart than `within`, m."""
    (p, u, r), (q, v, s) = one, other
    between = hypot(*(a - b + 0.5 * (c - d) for a, b, c, d in zip(p, q, u, v, strict=True)))
    return between - 0.5 * (hypot(*u) + hypot(*v)) - r - s > within


def _outside(point: Point, box: Box) -> float:
    """Return how far a point is outside a box, m; negative: how deep inside."""
    (x, y, z), (a, b, c, d, e, f) = point, box
    x, y, z = max(a - x, x - d), max(b - y, y - e), max(c - z, z - f)
    nearest = max(x, y, z)
    return nearest if nearest <= 0.0 else hypot(max(x, 0.0), max(y, 0.0), max(z, 0.0))


def _from_box(body: Placed, box: Box, within: float) -> float:
    """Return the signed distance of the axis of a body from a box, m, to 10 um; from `within` on only a lower bound.

    The signed distance of a point from a box is convex, and so it is along a straight line: golden section finds it.
    """
    (x, y, z), (u, v, w), _ = body
    bound = _outside((x + 0.5 * u, y + 0.5 * v, z + 0.5 * w), box) - 0.5 * hypot(u, v, w)
    if bound >= within:
        return bound

    def at(part: float) -> float:
        return _outside((x + part * u, y + part * v, z + part * w), box)

    low, high = 0.0, 1.0
    left, right = high - _GOLDEN, low + _GOLDEN
    a, b = at(left), at(right)
    for _ in range(_SECTIONS):
        if a < b:
            high, right, b = right, left, a
            left = high - _GOLDEN * (high - low)
            a = at(left)
        else:
            low, left, a = left, right, b
            right = low + _GOLDEN * (high - low)
            b = at(right)
    return min(a, b, at(0.0), at(1.0))
