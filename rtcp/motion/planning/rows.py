"""Plans as rows of 20 doubles, written outside the cycle (`rtcp.motion.planning`) and read in it, row by row.

A waypoint of a trajectory (`WAYPOINT`), for n <= 6 joints:

    column 0          t, s from the start of the motion; rising from waypoint to waypoint
    columns 1 .. 6    position of each joint, rad          (those beyond n are 0)
    columns 7 .. 12   velocity of each joint, rad/s
    columns 13 .. 18  acceleration of each joint, rad/s^2
    column 19         the piece that leads here: `CUBIC` (its accelerations are not looked at) or `QUINTIC`

A straight piece of a path (`LINE`), from rest to rest, travelled by a fraction that goes from 0 to 1:

    columns 0 .. 2    position of the tool at its start, m
    columns 3 .. 6    orientation there, unit quaternion w, x, y, z
    columns 7 .. 9    position at its end, m
    columns 10 .. 13  orientation there
    columns 14 .. 16  largest speed, acceleration and jerk of the fraction, 1/s, 1/s^2, 1/s^3
    column 17         its length, m
    column 18         how long it and all pieces after it take, s
    column 19         `LINE`
"""

from __future__ import annotations

from enum import IntEnum
from math import isfinite
from typing import NamedTuple

COLUMNS = 20
MOST_JOINTS = 6
KIND = COLUMNS - 1
CUBIC, QUINTIC, LINE = 3.0, 5.0, 1.0
LONGEST_S = 86_400.0
"""Nothing takes longer: a time beyond it is no time."""
_UNIT = 1e-6
_FASTEST = 1e9
_LONGEST_M = 1e3


class Wrong(IntEnum):
    """Why a plan is not started."""

    DAMAGED = 1
    """A row is none; `at`: the row, `value`: what was found, `limit`: its column."""
    START = 2
    """It does not begin where the arm is commanded; `at`: the joint, `value`: planned, `limit`: commanded."""
    START_SPEED = 3
    """It begins at time 0 with another speed than the arm has; `at`: the joint."""
    UNREACHABLE = 4
    """The way to its beginning cannot be made; `at`: the joint or -1."""
    MOVING = 5
    """A line begins at rest; `at`: the first joint that is commanded to move, `value`: its speed."""


class Refused(NamedTuple):
    """The answer of `start` where nothing was started; what was under way goes on."""

    wrong: Wrong
    at: int
    value: float
    limit: float


def read_row(rows: memoryview[float], index: int) -> list[float]:
    """Return the 20 numbers of a row."""
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


def damaged_line(row: list[float], index: int) -> Refused | None:
    """Return what is wrong with a straight piece, or None."""
    column = first_not_finite(row)
    if column >= 0:
        return Refused(Wrong.DAMAGED, index, row[min(column, KIND)], float(column))
    if row[KIND] != LINE:
        return Refused(Wrong.DAMAGED, index, row[KIND], float(KIND))
    for at in (3, 10):
        size = sum(c * c for c in row[at : at + 4])
        if not abs(size - 1.0) <= _UNIT:
            return Refused(Wrong.DAMAGED, index, size, float(at))
    if not 0.0 <= row[17] <= _LONGEST_M:
        return Refused(Wrong.DAMAGED, index, row[17], 17.0)
    for at, most in ((14, _FASTEST), (15, _FASTEST), (16, _FASTEST), (18, LONGEST_S)):
        if not 0.0 < row[at] <= most:
            return Refused(Wrong.DAMAGED, index, row[at], float(at))
    return None
