"""Waiting for a condition. The limit only ends a test that hangs; it is not part of what a test proves."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

HANG_S = 60.0
"""After this time a condition counts as never met, s."""
T = TypeVar("T")


def until(met: Callable[[], T], goal: str, interval_s: float = 0.02) -> T:
    """Call `met` until it returns a true value; return that value. `goal` names the condition in the failure."""
    end = time.monotonic() + HANG_S
    while not (value := met()):
        assert time.monotonic() < end, f"never came: {goal}; last seen: {value!r}"
        time.sleep(interval_s)
    return value
