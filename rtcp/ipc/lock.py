"""The runtime directory's lock: who starts, stops or replaces processes of the platform does so alone."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

_POLL_S = 0.02


class Busy(Exception):
    """Another process holds the lock."""


@contextlib.contextmanager
def alone(directory: Path, patience_s: float = 0.0, waits: Callable[[], None] | None = None) -> Iterator[None]:
    """Hold the directory's lock.

    Args:
        directory: the runtime directory.
        patience_s: how long to wait for whoever holds it.
        waits: is called once where it has to be waited for.

    Raises:
        Busy: another still holds it.
    """
    until = time.monotonic() + patience_s
    descriptor = os.open(directory / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until:
                    raise Busy from None
            if waits is not None:
                waits()
                waits = None
            time.sleep(_POLL_S)
        yield
    finally:
        os.close(descriptor)
