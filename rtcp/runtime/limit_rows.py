"""Limits as rows of the plan area, for the command that changes them: written by the gateway, read by the loop.

Row 0 low and row 1 high (rad), 2 velocity, 3 acceleration, 4 jerk, 5 torque: one number a joint. Row 6: 1 and the box's
six numbers, or 0 where there is none. From row 7 on: six numbers of each keep-out box.
"""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.motion.limits import Corners, Values
from rtcp.runtime.layout import PLAN_COLUMNS

JOINT_ROWS = 6
BOX_ROW = 6
LEAST_ROWS = 7


def to_rows(values: Values) -> list[list[float]]:
    """Return the rows of `values`."""
    joints = (values.low, values.high, values.velocity, values.acceleration, values.jerk, values.torque)
    box = [0.0] if values.box is None else [1.0, *values.box]
    return [*(list(row) for row in joints), box, *(list(corners) for corners in values.keep_out)]


def from_rows(plan: Sequence[float], count: int, joints: int) -> Values:
    """Return the limits that `count` rows, at least `LEAST_ROWS`, of the plan area hold for so many joints."""
    low, high, velocity, acceleration, jerk, torque = (
        tuple(plan[row * PLAN_COLUMNS + joint] for joint in range(joints)) for row in range(JOINT_ROWS)
    )
    at = BOX_ROW * PLAN_COLUMNS
    box = _corners(plan, at + 1) if plan[at] else None
    keep_out = tuple(_corners(plan, row * PLAN_COLUMNS) for row in range(LEAST_ROWS, count))
    return Values(low, high, velocity, acceleration, jerk, torque, box, keep_out)


def _corners(plan: Sequence[float], at: int) -> Corners:
    a, b, c, d, e, f = plan[at : at + 6]
    return a, b, c, d, e, f
