"""What a plan is made from and what it is: points, stops, rows, and the refusal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rtcp.config.model import Point, Stop

__all__ = ["Plan", "PlanRefused", "Point", "Stop", "ZoneAt"]

ZoneAt = Callable[[Sequence[float]], "str | None"]
"""Answers for joint angles, rad, which box the arm would be in, in words ("the keep-out box user"), or None."""


class PlanRefused(ValueError):
    """The plan cannot be carried out; the message is a sentence with the place, what was found and what is allowed."""


@dataclass(frozen=True)
class Plan:
    """What the loop is given.

    rows: of 20 doubles each, `len(rows)` is the count of the command. duration_s: from the start to rest. length_m: of
    the lines, 0 for a trajectory. slowed: 1 where the lines keep the speed asked for, less where a joint's limits made
    them slower. end: the joints' position at the end, rad.
    """

    rows: tuple[tuple[float, ...], ...]
    duration_s: float
    length_m: float
    slowed: float
    end: tuple[float, ...]
