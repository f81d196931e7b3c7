"""Where the arm is, from the Denavit-Hartenberg table of the facts alone: plain matrices, nothing of `kinematics`."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin

Point = tuple[float, float, float]
Box = tuple[Sequence[float], Sequence[float]]
"""Lower and upper corner, m."""

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
REACH = (L2 + L3 + L4 + L5, L2 + L3 + L4 + L5, L3 + L4 + L5, L5, L5, 0.0)
"""m a rad: how far a point of the arm moves at most when the joint turns."""


def _times(a: list[list[float]], b: list[list[float]]) -> list[list[float]]:
    return [[sum(a[i][k] * b[k][j] for k in range(4)) for j in range(4)] for i in range(4)]


def _row(alpha: float, a: float, d: float, theta: float) -> list[list[float]]:
    about_x = [[1, 0, 0, a], [0, cos(alpha), -sin(alpha), 0], [0, sin(alpha), cos(alpha), 0], [0, 0, 0, 1.0]]
    about_z = [[cos(theta), -sin(theta), 0, 0], [sin(theta), cos(theta), 0, 0], [0, 0, 1, d], [0, 0, 0, 1.0]]
    return _times(about_x, about_z)


def points(q: Sequence[float]) -> tuple[Point, Point, Point]:
    """Return the elbow, the wrist's centre and the tool, m in the base's frame; `q` in rad, shape (6,)."""
    frame = [[1.0 if i == j else 0.0 for j in range(4)] for i in range(4)]
    origins = []
    for (alpha, a, d, offset), angle in zip(TABLE, q, strict=True):
        frame = _times(frame, _row(alpha, a, d, angle + offset))
        origins.append((frame[0][3], frame[1][3], frame[2][3]))
    return origins[2], origins[4], origins[5]


def depth(point: Point, box: Box) -> float:
    """Return how deep, m, the point is inside the box; negative: how far from it along the farthest axis."""
    low, high = box
    return min(min(x - a, b - x) for x, a, b in zip(point, low, high, strict=True))
