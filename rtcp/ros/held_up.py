"""Detects suspensions of this process: commands queued meanwhile are stale, and their senders may be gone."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

HELD_UP_S = 1.0
"""Interval between two checks above which the process counts as suspended, s."""
_DRAINED_S = 0.5
"""Time after a suspension during which queued commands arrive, s."""


class HeldUp:
    """Detects that the process was suspended or swapped out; call `check` several times a second.

    Args:
        noticed: called at the first check after a suspension, with its duration, s.
    """

    def __init__(self, noticed: Callable[[float], None]) -> None:
        self._noticed = noticed
        self._checked_s = time.monotonic()
        self._drained_s = -math.inf

    def check(self) -> None:
        """Report a suspension since the last check."""
        now = time.monotonic()
        gap_s, self._checked_s = now - self._checked_s, now
        if gap_s > HELD_UP_S:
            self._drained_s = now + _DRAINED_S
            self._noticed(gap_s)

    def is_timely(self) -> bool:
        """Whether a command that arrives now was not queued during a suspension."""
        self.check()
        return time.monotonic() >= self._drained_s
