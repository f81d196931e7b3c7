"""How a command ends: exit codes, errors, and the signals that interrupt it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from types import FrameType


class ExitCode(IntEnum):
    """Exit codes of `rtcp`, for scripts."""

    DONE = 0
    INTERNAL = 1
    USAGE = 2
    """The command line or the configuration is wrong; nothing was started or moved."""
    REFUSED = 3
    """The platform runs and refuses the command in its present state."""
    NOT_RUNNING = 4
    FAULT = 5
    """The command started and failed, or timed out."""
    INTERRUPTED = 130


_CODES = {
    "invalid": ExitCode.USAGE,
    "usage": ExitCode.USAGE,
    "config": ExitCode.USAGE,
    "refused": ExitCode.REFUSED,
    "not running": ExitCode.NOT_RUNNING,
    "internal": ExitCode.INTERNAL,
}
SUSPENDING = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
"""Signals that suspend a command: Ctrl-Z, and terminal access from the background."""


class CommandError(Exception):
    """A failed command: the message (one line for each problem) and the exit code."""

    def __init__(self, message: str, code: int = ExitCode.USAGE) -> None:
        super().__init__(message)
        self.message = message
        self.code = int(code)


class Interrupted(KeyboardInterrupt):
    """A signal that ends the command with the same clean-up as Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.code = 128 + number


def code_of(kind: str) -> ExitCode:
    """Return the exit code of an error kind; kinds that are not listed (fault, timeout, lost) give FAULT."""
    return _CODES.get(kind, ExitCode.FAULT)


def interruption_code(error: KeyboardInterrupt) -> int:
    """Return 130 for Ctrl-C and 128 + number for another signal, as shells do."""
    return error.code if isinstance(error, Interrupted) else ExitCode.INTERRUPTED


@contextmanager
def signals_raise(*more: signal.Signals) -> Iterator[None]:
    """Raise `Interrupted` on SIGTERM, SIGHUP and `more` while inside, so that `finally` blocks run."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted(number)

    handlers = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP, *more)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
