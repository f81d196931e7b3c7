"""Where the arm's points are, from the table of the facts alone: plain 4x4 matrices, nothing of `kinematics`."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin

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
    """Return how deep, m, a point is inside a box (lower corner, upper corner); negative: outside."""
    return min(min(x - a, b - x) for x, a, b in zip(point, box[:3], box[3:], strict=True))
