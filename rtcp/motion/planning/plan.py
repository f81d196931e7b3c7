"""Plans: rows of `COLUMNS` doubles, written outside the cycle (`rtcp.motion.planning`) and read in it one by one.

A waypoint of a trajectory (`WAYPOINT`), for up to `MOST_AXES` joints:

    column 0              t, s from the start of the motion; rising from waypoint to waypoint
    POSITIONS and on      position of each joint, rad          (unused columns are 0)
    VELOCITIES and on     velocity of each joint, rad/s
    ACCELERATIONS and on  acceleration of each joint, rad/s^2
    column KIND           the piece that ends here: `CUBIC` (its accelerations are ignored) or `QUINTIC`

A straight piece of a path (`LINE`), from rest to rest, parametrized by a fraction from 0 to 1:

    columns 0 .. 2    position of the tool at its start, m
    columns 3 .. 6    orientation there, unit quaternion w, x, y, z
    columns 7 .. 9    position at its end, m
    columns 10 .. 13  orientation there
    columns 14 .. 16  largest speed, acceleration and jerk of the fraction, 1/s, 1/s^2, 1/s^3
    column 17         its length, m
    column 18         how long it and all pieces after it take, s
    column KIND       `LINE`
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

from rtcp.config.model import MOST_AXES
from rtcp.ipc.layout import PLAN_COLUMNS

COLUMNS = PLAN_COLUMNS
MOST_LINES: Final = 256
"""Upper bound on the straight pieces of a plan."""
POSITIONS, VELOCITIES, ACCELERATIONS = 1, 1 + MOST_AXES, 1 + 2 * MOST_AXES
KIND = COLUMNS - 1
CUBIC, QUINTIC, LINE = 3.0, 5.0, 1.0
LONGEST_S: Final = 86_400.0
"""Upper bound on the duration of a plan."""
_UNIT: Final = 1e-6
_FASTEST: Final = 1e9
_LONGEST_M: Final = 1e3


ZoneAt = Callable[[Sequence[float]], "str | None"]
"""Returns the box that the arm would be in at joint angles, rad, in words ("the keep-out box user"), or None."""


class PlanRefused(ValueError):
    """The plan cannot be executed; the message is a sentence with the place, the value and its limit."""


class AlreadyThere(PlanRefused):
    """The arm is already at the end of the motion."""


class PlanTooFast(PlanRefused):
    """A joint would exceed its limit of velocity, acceleration or jerk; a slower plan may be accepted."""


@dataclass(frozen=True)
class Plan:
    """A checked plan, ready for the loop.

    rows: of `COLUMNS` doubles each, `len(rows)` is the count of the command. duration_s: from the start to rest.
    length_m: of the lines, 0 for a trajectory. slowed: ratio of the lines' speed to the commanded speed; below 1 the
    joint limits made them slower. end: joint positions at the end, rad. tool: number of the tool it was made for.
    """

    rows: tuple[tuple[float, ...], ...]
    duration_s: float
    length_m: float
    slowed: float
    end: tuple[float, ...]
    tool: int = 0


def read_row(rows: memoryview[float], index: int) -> list[float]:
    """Return the numbers of a row."""
    at = index * COLUMNS
    return list(rows[at : at + COLUMNS])


def first_not_finite(row: list[float]) -> int:
    """Return the first column that is not finite, or -1."""
    # The sum of valid numbers of a plan is finite.
    if isfinite(sum(row)):
        return -1
    for column, number in enumerate(row):
        if not isfinite(number):
            return column
    return COLUMNS


def damaged_line(row: list[float]) -> float | None:
    """Return the invalid number of a damaged straight piece, or None."""
    column = first_not_finite(row)
    if column >= 0:
        return row[min(column, KIND)]
    if row[KIND] != LINE:
        return row[KIND]
    for at in (3, 10):
        size = sum(c * c for c in row[at : at + 4])
        if not abs(size - 1.0) <= _UNIT:
            return size
    if not 0.0 <= row[17] <= _LONGEST_M:
        return row[17]
    for at, most in ((14, _FASTEST), (15, _FASTEST), (16, _FASTEST), (18, LONGEST_S)):
        if not 0.0 < row[at] <= most:
            return row[at]
    return None
