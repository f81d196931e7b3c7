"""Points of the arm, from the table of the facts alone: plain 4x4 matrices, nothing of `kinematics`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import cos, dist, hypot, pi, sin, sqrt

L1, L2, L3, L4, L5 = 0.170, 0.440, 0.450, 0.100, 0.140
TABLE = (
    (0.0, 0.0, L1, 0.0),
    (-pi / 2, 0.0, 0.0, -pi / 2),
    (pi, L2, 0.0, -pi / 2),
    (-pi / 2, 0.0, L3 + L4, 0.0),
    (-pi / 2, 0.0, 0.0, 0.0),
    (pi / 2, 0.0, L5, 0.0),
)
"""alpha, a, d, offset of each row: T = Rx(alpha) Tx(a) Rz(q + offset) Tz(d)."""
RADIUS = 0.045 * (L1 + L2 + L3 + L4 + L5) * hypot(1.0, 1.25)
"""m, of all bodies: the circumscribed sphere of a joint's cylinder in the arm's URDF."""
CLEARANCE = 0.01
"""Default of `cartesian.clearance`, m."""
Point = tuple[float, float, float]
Matrix = list[list[float]]


def _times(a: Matrix, b: Matrix) -> Matrix:
    return [[sum(a[i][k] * b[k][j] for k in range(4)) for j in range(4)] for i in range(4)]


def points(q: Sequence[float]) -> tuple[Point, Point, Point]:
    """Return tool, wrist centre and elbow, m; `q` in rad, shape (6,)."""
    frame = [[float(i == j) for j in range(4)] for i in range(4)]
    origins = []
    for (alpha, a, d, offset), angle in zip(TABLE, q, strict=True):
        sa, ca, s, c = sin(alpha), cos(alpha), sin(angle + offset), cos(angle + offset)
        turn_x = [[1.0, 0.0, 0.0, a], [0.0, ca, -sa, 0.0], [0.0, sa, ca, 0.0], [0.0, 0.0, 0.0, 1.0]]
        turn_z = [[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, d], [0.0, 0.0, 0.0, 1.0]]
        frame = _times(frame, _times(turn_x, turn_z))
        origins.append((frame[0][3], frame[1][3], frame[2][3]))
    return origins[5], origins[4], origins[2]


def depth(point: Point, box: Sequence[float]) -> float:
    """Return the depth, m, of a point inside a box (lower corner, upper corner); negative: outside."""
    return min(min(x - a, b - x) for x, a, b in zip(point, box[:3], box[3:], strict=True))


def axes(q: Sequence[float]) -> tuple[tuple[Point, Point], ...]:
    """Return the axes of base, upper arm, forearm and hand, m."""
    tool, wrist, elbow = points(q)
    shoulder = (0.0, 0.0, L1)
    return ((0.0, 0.0, 0.0), shoulder), (shoulder, elbow), (elbow, wrist), (wrist, tool)


def own_gap(q: Sequence[float]) -> float:
    """Return the least distance of the arm's bodies from each other, beyond their clearance, m."""
    base, upper, forearm, hand = axes(q)
    pairs = (base, forearm), (base, hand), (upper, hand)
    distance = min(_least(lambda u, a=a, b=b: _from_segment(_along(a, u), b)) for a, b in pairs)  # type: ignore[misc]
    return distance - 2.0 * RADIUS - CLEARANCE


def box_gaps(q: Sequence[float], box: Sequence[float]) -> list[float]:
    """Return the distances of upper arm, forearm and hand from a box, beyond their clearance, m; negative: too near."""
    return [_least(lambda u, a=axis: _outside(_along(a, u), box)) - RADIUS - CLEARANCE for axis in axes(q)[1:]]  # type: ignore[misc]


def _least(of: Callable[[float], float]) -> float:
    """The least value of a convex function between 0 and 1, by golden section."""
    part = 0.5 * (sqrt(5.0) - 1.0)
    low, high = 0.0, 1.0
    left, right = high - part, low + part
    a, b = of(left), of(right)
    for _ in range(45):
        if a < b:
            high, right, b = right, left, a
            left = high - part * (high - low)
            a = of(left)
        else:
            low, left, a = left, right, b
            right = low + part * (high - low)
            b = of(right)
    return min(a, b, of(0.0), of(1.0))


def _along(axis: tuple[Point, Point], u: float) -> Point:
    (a, b, c), (d, e, f) = axis
    return a + u * (d - a), b + u * (e - b), c + u * (f - c)


def _outside(point: Point, box: Sequence[float]) -> float:
    beyond = [max(a - x, x - b) for x, a, b in zip(point, box[:3], box[3:], strict=True)]
    return hypot(*(max(part, 0.0) for part in beyond)) if max(beyond) > 0.0 else max(beyond)


def _from_segment(point: Point, axis: tuple[Point, Point]) -> float:
    start, end = axis
    along = [b - a for a, b in zip(start, end, strict=True)]
    part = sum((x - a) * n for x, a, n in zip(point, start, along, strict=True)) / sum(n * n for n in along)
    return dist(point, _along(axis, min(max(part, 0.0), 1.0)))
