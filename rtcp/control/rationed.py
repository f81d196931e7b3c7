"""Sentences in bounds: what is said again and again, or by too many at once, is counted and told later."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

SAY_AGAIN_S = 10.0
"""An identical sentence is said at most so often."""


@dataclass
class _Said:
    at: float
    again: int = 0


class Rationed:
    """Says a sentence at once the first time, and at most every 10 s how often it has come again.

    Args:
        say: takes the sentences.
        most: so many different ones are said in 10 s.
        what: how the sentence on those beyond names them, as `messages of slave 3`.
    """

    def __init__(self, say: Callable[[str], None], most: int, what: str) -> None:
        self._say = say
        self._most = most
        self._what = what
        self._said: dict[str, _Said] = {}
        self._beyond = 0
        self._beyond_at = 0.0

    def say(self, sentence: str) -> None:
        """Say `sentence`, or count it."""
        now = time.monotonic()
        said = self._said.get(sentence)
        if said is not None:
            said.again += 1
        elif len(self._said) < self._most:
            self._said[sentence] = _Said(now)
            self._say(sentence)
        else:
            self._beyond_at = self._beyond_at if self._beyond else now
            self._beyond += 1

    def tell(self) -> None:
        """Say what was counted and is due, and forget what did not come again; to be called now and then."""
        now = time.monotonic()
        for sentence, said in tuple(self._said.items()):
            if now - said.at < SAY_AGAIN_S:
                continue
            if said.again:
                self._say(f"{sentence} ({_times(said.again)} again in {now - said.at:.0f} s)")
                said.at, said.again = now, 0
            else:
                del self._said[sentence]
        if self._beyond and now - self._beyond_at >= SAY_AGAIN_S:
            self._say(f"further {self._what} were left out: {self._beyond} in {now - self._beyond_at:.0f} s")
            self._beyond = 0


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
