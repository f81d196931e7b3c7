"""What has to be said again and again: whether it was, or the process was suspended or its host stalled meanwhile."""

from __future__ import annotations


class Renewal:
    """Watches the turns of a command that renews something.

    Whoever was silent for longer than its word counts must not go on as if nothing had been: the arm has stopped, and
    a person may have come near since.

    Args:
        hold_s: so long a word counts.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._last_s: float | None = None

    def missed(self, now_s: float) -> float:
        """Take a turn at `now_s`; return how long ago the last one was, s, where that is too long, and else 0.

        The instant is one before the word is sent: a process that is stopped while it waits for the answer shows too.
        """
        passed_s = 0.0 if self._last_s is None else now_s - self._last_s
        self._last_s = now_s
        return passed_s if passed_s > self._hold_s else 0.0
