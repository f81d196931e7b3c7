"""The plan area of the blackboard: two places for rows of doubles, one written while the plan in the other runs."""

from __future__ import annotations

import array
import mmap
from collections.abc import Sequence

from rtcp.ipc.layout import PLAN_COLUMNS, PLAN_IN_USE_AT, PLAN_ROWS, PLAN_SIZE, PLANS, PLANS_AT
from rtcp.ipc.words import Words


class PlanTooLong(ValueError):
    """More rows than fit; the message is a sentence."""


def place(memory: mmap.mmap, slot: int) -> memoryview[float]:
    """Return the doubles of a place, row by row: for the loop, which reads them as it comes to them."""
    at = PLANS_AT + slot * PLAN_SIZE
    return memoryview(memory)[at : at + PLAN_SIZE].cast("d")


def mark_in_use(words: Words, slot: int) -> None:
    """Say which place the loop reads from; -1: none."""
    words[PLAN_IN_USE_AT] = slot + 1


def write_plan(memory: mmap.mmap, words: Words, rows: Sequence[Sequence[float]]) -> int:
    """Write a plan into the place that the loop does not read from and return its slot. Only under the lease.

    Raises:
        PlanTooLong: with the number of rows and how many fit.
    """
    if len(rows) > PLAN_ROWS:
        raise PlanTooLong(f"the plan has {len(rows)} rows, at most {PLAN_ROWS} fit: give fewer points")
    flat = array.array("d")
    for row in rows:
        flat.extend(row)
        flat.extend([0.0] * (PLAN_COLUMNS - len(row)))
    slot = 0 if words[PLAN_IN_USE_AT] != 1 else PLANS - 1
    at = PLANS_AT + slot * PLAN_SIZE
    encoded = flat.tobytes()
    memory[at : at + len(encoded)] = encoded
    words.fence()
    return slot
