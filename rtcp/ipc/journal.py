"""Where the processes write their logs: each into a file of its own, or all into systemd's journal."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import BinaryIO

_STDERR = 2
_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))
"""sd-daemon(3): the level at the beginning of a line becomes the entry's PRIORITY."""


def stderr_is_journal() -> bool:
    """Whether standard error leads to the journal itself: systemd.exec(5), $JOURNAL_STREAM.

    The variable alone does not tell: a terminal that a service of the desktop opened has inherited it.
    """
    try:
        found = os.fstat(_STDERR)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"


def open_log(path: Path) -> BinaryIO:
    """Open what a process is to add its log to: the file, or the journal where standard error is that."""
    if stderr_is_journal():
        path.unlink(missing_ok=True)
        return os.fdopen(os.dup(_STDERR), "wb")
    return open(path, "ab")


def place_of_log(path: Path) -> str:
    """Return where the log is that `open_log` opens, in words."""
    return "the journal" if stderr_is_journal() else str(path)


def log_format() -> logging.Formatter:
    """Return how a line of a log looks: with its time in a file, with its level for the journal, which has the time."""
    return JournalFormat() if stderr_is_journal() else logging.Formatter("%(asctime)s %(message)s")


class JournalFormat(logging.Formatter):
    """Puts the level before every line, those of a traceback too: the journal makes an entry of each."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a record."""
        priority = next(number for level, number in _PRIORITIES if record.levelno >= level)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())
