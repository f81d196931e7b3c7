"""Whether this process ran all the time: what came while it did not is in its queues, and its senders may be gone."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

HELD_UP_S = 1.0
"""Longest time without a look that passes for running."""
_DRAINED_S = 0.5
"""Time after that in which commands of then arrive."""


class HeldUp:
    """Notices that the process was suspended or swapped out; `look` several times a second.

    Args:
        noticed: called at the first look after that, with the time that it did not run, s.
    """

    def __init__(self, noticed: Callable[[float], None]) -> None:
        self._noticed = noticed
        self._looked_s = time.monotonic()
        self._drained_s = -math.inf

    def look(self) -> None:
        """Compare with the last look."""
        now = time.monotonic()
        gap_s, self._looked_s = now - self._looked_s, now
        if gap_s > HELD_UP_S:
            self._drained_s = now + _DRAINED_S
            self._noticed(gap_s)

    def is_timely(self) -> bool:
        """Whether a command that comes now did not wait in a queue meanwhile."""
        self.look()
        return time.monotonic() >= self._drained_s
