"""Work in small steps: a generator that yields wherever it has to wait.

Whoever has nothing else to do lets `finish` drive it; the thread beside the cycle takes a step now and then, so that
one slave that is slow keeps neither the other slaves nor an emergency waiting.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Steps = Generator[None, None, T]
_POLL_S = 0.0002


def finish(steps: Steps[T]) -> T:
    """Take all steps, asleep between them; return what they return, raise what they raise."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            found: T = end.value
            return found
        time.sleep(_POLL_S)


def pause(seconds: float) -> Steps[None]:
    """Let time pass."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        yield
