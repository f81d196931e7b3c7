"""The keyboard of a terminal: which key is pressed, whether it is held, and whether its reader was suspended.

A terminal reports presses and no releases: a held key shows only by its repetition.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from types import TracebackType

REPEATS_WITHIN_S = 1.0
"""Longest time to a keyboard's first repetition (250 to 660 ms is usual)."""
RELEASED_AFTER_S = 0.2
"""A key without another repetition for this long is released."""
ESCAPE = "escape"
QUIT = frozenset({"q", ESCAPE, "\x04"})
_ESCAPE_S = 0.02
_ARROWS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}
_SEQUENCES = {start + end: name for start in (b"\x1b[", b"\x1bO") for end, name in _ARROWS.items()}


class Keyboard:
    """The terminal on standard input, read key by key without echo; its settings are restored on exit."""

    def __init__(self) -> None:
        self._descriptor = sys.stdin.fileno()
        self._pending = b""

    def __enter__(self) -> Keyboard:
        self._settings = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._settings)

    def read(self, timeout_s: float) -> str:
        """Return the next key within `timeout_s`: a letter, the name of an arrow, `escape`; or an empty string.

        Raises:
            EOFError: the terminal was closed.
        """
        if not self._pending:
            if not select.select([self._descriptor], [], [], max(timeout_s, 0.0))[0]:
                return ""
            self._pending = os.read(self._descriptor, 256)
            if not self._pending:
                raise EOFError
        if self._pending == b"\x1b" and select.select([self._descriptor], [], [], _ESCAPE_S)[0]:
            self._pending += os.read(self._descriptor, 256)
        for sequence, name in _SEQUENCES.items():
            if self._pending.startswith(sequence):
                self._pending = self._pending[len(sequence) :]
                return name
        first, self._pending = self._pending[:1], self._pending[1:]
        if first == b"\x1b":
            self._pending = b""  # an unknown sequence is one key, not several letters
            return ESCAPE
        return first.decode("latin-1")

    def drain(self) -> set[str]:
        """Return the keys typed and not read so far: those pressed before a stall are ignored."""
        typed = set()
        while key := self.read(0.0):
            typed.add(key)
        return typed


class HeldKey:
    """Detects by its repetition that a key is held.

    Until its first repetition a key does not count: a tap must not move the arm until the keyboard would repeat.
    """

    def __init__(self) -> None:
        self._key = ""
        self._last_s = float("-inf")
        self._repeats = False

    def press(self, key: str, now_s: float) -> None:
        """Register a key that arrived at `now_s`."""
        within_s = RELEASED_AFTER_S if self._repeats else REPEATS_WITHIN_S
        self._repeats = key == self._key and now_s - self._last_s <= within_s
        self._key, self._last_s = key, now_s

    def held(self, now_s: float) -> str:
        """Return the key that is held at `now_s`, or an empty string."""
        return self._key if self._repeats and now_s - self._last_s <= RELEASED_AFTER_S else ""

    def release(self) -> None:
        """Forget the key."""
        self._repeats = False
        self._key = ""


class RenewalCheck:
    """Detects that a command was not renewed in time, because its process was suspended or its host stalled.

    The arm has stopped by then and a person may have come near: the command must not continue.

    Args:
        hold_s: how long a command is valid, s.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._last_s: float | None = None

    def overdue(self, now_s: float) -> float:
        """Register a renewal at `now_s`; return the time since the last one, s, where it is too long, else 0.

        `now_s` is an instant before the command is sent, so that a stall during its answer is detected too.
        """
        passed_s = 0.0 if self._last_s is None else now_s - self._last_s
        self._last_s = now_s
        return passed_s if passed_s > self._hold_s else 0.0
