"""Plans: rows of `COLUMNS` doubles, written outside the cycle (`rtcp.motion.planning`) and read in it, row by row.

A waypoint of a trajectory (`WAYPOINT`), for up to `MOST_AXES` joints:

    column 0              t, s from the start of the motion; rising from waypoint to waypoint
    POSITIONS and on      position of each joint, rad          (those beyond the joints are 0)
    VELOCITIES and on     velocity of each joint, rad/s
    ACCELERATIONS and on  acceleration of each joint, rad/s^2
    column KIND           the piece that ends here: `CUBIC` (its accelerations are ignored) or `QUINTIC`

A straight piece of a path (`LINE`), from rest to rest, travelled by a fraction that goes from 0 to 1:

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
"""Straight pieces of a plan."""
POSITIONS, VELOCITIES, ACCELERATIONS = 1, 1 + MOST_AXES, 1 + 2 * MOST_AXES
KIND = COLUMNS - 1
CUBIC, QUINTIC, LINE = 3.0, 5.0, 1.0
LONGEST_S: Final = 86_400.0
"""Longest duration of a plan."""
_UNIT: Final = 1e-6
_FASTEST: Final = 1e9
_LONGEST_M: Final = 1e3


ZoneAt = Callable[[Sequence[float]], "str | None"]
"""Answers for joint angles, rad, which box the arm would be in, in words ("the keep-out box user"), or None."""


class PlanRefused(ValueError):
    """The plan cannot be carried out; the message is a sentence with the place, what was found and what is allowed."""


class AlreadyThere(PlanRefused):
    """The arm is where the motion leads."""


class PlanTooFast(PlanRefused):
    """A joint would exceed its limit of velocity, acceleration or jerk: the same plan in more time may pass."""


@dataclass(frozen=True)
class Plan:
    """What the loop is given.

    rows: of `COLUMNS` doubles each, `len(rows)` is the count of the command. duration_s: from the start to rest.
    length_m: of the lines, 0 for a trajectory. slowed: 1 where the lines keep the speed asked for, less where a joint's
    limits made them slower. end: the joints' position at the end, rad. tool: number of the tool for which it was made.
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
    """Return the first column that is no finite number, or -1."""
    # A sum is finite where all numbers are that a plan can hold.
    if isfinite(sum(row)):
        return -1
    for column, number in enumerate(row):
        if not isfinite(number):
            return column
    return COLUMNS


def damaged_line(row: list[float]) -> float | None:
    """Return the number in a straight piece that cannot be, or None."""
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
