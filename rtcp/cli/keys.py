"""Keys of a terminal: which one is pressed, and whether it is held.

A terminal tells presses and no releases: a held key shows only by its repetition.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from types import TracebackType

REPEATS_WITHIN_S = 1.0
"""A keyboard's first repetition comes within so long (250 to 660 ms is usual)."""
RELEASED_AFTER_S = 0.2
"""Without another repetition for so long the key has been let go."""

_SEQUENCES = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "right", b"\x1b[D": "left",
              b"\x1bOA": "up", b"\x1bOB": "down", b"\x1bOC": "right", b"\x1bOD": "left"}  # fmt: skip
ESCAPE = "escape"
_ESCAPE_S = 0.02


class Keys:
    """The keyboard of the terminal on standard input, a key at a time and not shown; as it was again afterwards."""

    def __init__(self) -> None:
        self._descriptor = sys.stdin.fileno()
        self._waiting = b""

    def __enter__(self) -> Keys:
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def read(self, patience_s: float) -> str:
        """Return the next key within `patience_s`: a letter, an arrow's name, `escape`; or an empty string.

        Raises:
            EOFError: the terminal has gone.
        """
        if not self._waiting:
            if not select.select([self._descriptor], [], [], max(patience_s, 0.0))[0]:
                return ""
            self._waiting = os.read(self._descriptor, 256)
            if not self._waiting:
                raise EOFError
        if self._waiting == b"\x1b" and select.select([self._descriptor], [], [], _ESCAPE_S)[0]:
            self._waiting += os.read(self._descriptor, 256)
        for sequence, name in _SEQUENCES.items():
            if self._waiting.startswith(sequence):
                self._waiting = self._waiting[len(sequence) :]
                return name
        first, self._waiting = self._waiting[:1], self._waiting[1:]
        if first == b"\x1b":
            self._waiting = b""  # an unknown sequence is one key, not several letters
            return ESCAPE
        return first.decode("latin-1")

    def drain(self) -> set[str]:
        """Return what was typed and not read so far: keys of the past, which lead nothing any more."""
        typed = set()
        while key := self.read(0.0):
            typed.add(key)
        return typed


class HeldKey:
    """Tells by the repetition of a key that it is held.

    Until its first repetition a key does not count as held: a tap must not move the arm for as long as the keyboard
    waits before it repeats.
    """

    def __init__(self) -> None:
        self._key = ""
        self._last_s = float("-inf")
        self._repeats = False

    def press(self, key: str, now_s: float) -> None:
        """Take a key that came at `now_s`."""
        patience_s = RELEASED_AFTER_S if self._repeats else REPEATS_WITHIN_S
        self._repeats = key == self._key and now_s - self._last_s <= patience_s
        self._key, self._last_s = key, now_s

    def held(self, now_s: float) -> str:
        """Return the key that is held at `now_s`, or an empty string."""
        return self._key if self._repeats and now_s - self._last_s <= RELEASED_AFTER_S else ""

    def release(self) -> None:
        """Take it as let go: another key has come."""
        self._repeats = False
        self._key = ""
