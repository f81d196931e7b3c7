"""How a command ends: its exit codes, and what each kind of error means to a shell."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from types import FrameType


class ExitCode(IntEnum):
    """Exit codes of `rtcp`; scripts tell them apart."""

    DONE = 0
    INTERNAL = 1
    USAGE = 2
    """The command line or the configuration is wrong; nothing was started or moved."""
    REFUSED = 3
    """The platform runs and will not do this now."""
    NOT_RUNNING = 4
    FAULT = 5
    """It was begun and went wrong, or took too long."""
    INTERRUPTED = 130


_CODES = {
    "invalid": ExitCode.USAGE,
    "usage": ExitCode.USAGE,
    "config": ExitCode.USAGE,
    "refused": ExitCode.REFUSED,
    "not running": ExitCode.NOT_RUNNING,
    "fault": ExitCode.FAULT,
    "timeout": ExitCode.FAULT,
    "lost": ExitCode.FAULT,
    "internal": ExitCode.INTERNAL,
}


class CommandError(Exception):
    """A command's end that is not success: a sentence (or several, a line each) and the exit code."""

    def __init__(self, message: str, code: int = ExitCode.USAGE) -> None:
        super().__init__(message)
        self.message = message
        self.code = int(code)


SUSPENDING = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
"""What suspends a command: Ctrl-Z, and a terminal that one in the background reads or, by its setting, writes."""


class Interrupted(KeyboardInterrupt):
    """A signal came that ends a command: everything winds up as after Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.code = 128 + number


def code_of(kind: str) -> ExitCode:
    """Return the exit code of an error's kind; a kind that nobody foresaw is a fault."""
    return _CODES.get(kind, ExitCode.FAULT)


def interruption_code(error: KeyboardInterrupt) -> int:
    """Return 130 for Ctrl-C and 128 + number for another signal, as shells have it."""
    return error.code if isinstance(error, Interrupted) else ExitCode.INTERRUPTED


@contextmanager
def orderly_signals(*more: signal.Signals) -> Iterator[None]:
    """While inside, SIGTERM, SIGHUP and `more` raise `Interrupted`, so that `finally` ends what was started."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted(number)

    kept = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP, *more)}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
