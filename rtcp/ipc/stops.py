"""Stops: the way of halt, disable and shutdown to the loop, past all queues and without a lease.

The blackboard has three words for each kind of stop. A process requests a stop by writing the instant of the request
into the first word. The loop compares that word with the last one that it handled before it reads the command ring.
Any number of processes may write at any time: requests of one kind become one stop. A command that was requested before
a stop, and that the loop reads after it, is refused (`rtcp.ipc.refusals.Superseded`).
"""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rtcp.ipc.closing import Closing
from rtcp.ipc.commands import Command, Disable, Halt, Shutdown
from rtcp.ipc.layout import MAGIC, STOP_SIZE, STOPS_AT, AtomicWords
from rtcp.ipc.refusals import WrongState
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.states import State

STOPS: Final[tuple[type[Command], ...]] = (Shutdown, Disable, Halt)
"""The kinds of stops, in the order of their words and in which the loop reads them: the one that ends most first."""
_OLDEST_NS = 10_000_000_000
"""Age of a request, ns, beyond which its time stamp is not believed: the request counts from now."""


def words_of(kind: type[Command]) -> int:
    """Return the offset of the words of a kind of stop."""
    return STOPS_AT + STOPS.index(kind) * STOP_SIZE


def request(words: AtomicWords, kind: type[Command], requested_ns: int = 0) -> int:
    """Request a stop; return the instant of the request, CLOCK_MONOTONIC, ns.

    A stop that was requested at this instant or later is not requested again: a client and the gateway may both request
    the same stop.

    Args:
        words: those of the blackboard.
        kind: one of `STOPS`.
        requested_ns: when its sender requested it, CLOCK_MONOTONIC, ns; 0, or an instant in the future or long ago:
            now.
    """
    now = time.monotonic_ns()
    if not now - _OLDEST_NS < requested_ns <= now:
        requested_ns = now
    at = words_of(kind)
    words[at] = max(words[at], requested_ns)
    return requested_ns


def refusal(words: AtomicWords, kind: type[Command], requested_ns: int) -> WrongState | bool:
    """Return the loop's answer to a stop: its refusal, True where it was accepted, False where there is none yet."""
    at = words_of(kind)
    if words.acquire(at + 8) < requested_ns:
        words[at] = max(words[at], requested_ns)  # another process may have written an earlier request over it
        return False
    state = words[at + 16]
    return WrongState(kind.number, State(state - 1)) if state else True


class StopWriter(Closing):
    """A client's way to the stops of a platform: its stops neither pass the gateway nor need a file descriptor.

    Args:
        directory: the runtime directory of the platform. Where it has no blackboard, no stop is requested this way.
    """

    _KINDS: Final = {"halt": Halt, "disable": Disable}
    """Stops by their method. `stop` passes the gateway, which first notes that the end of the loop is wanted."""

    def __init__(self, directory: Path) -> None:
        self._words: AtomicWords | None = None
        try:
            descriptor = os.open(blackboard_file(directory), os.O_RDWR | os.O_CLOEXEC)
        except OSError:
            return
        try:
            if os.fstat(descriptor).st_size >= mmap.PAGESIZE:
                self._map = mmap.mmap(descriptor, mmap.PAGESIZE)
                self._words = AtomicWords(self._map)
        finally:
            os.close(descriptor)
        if self._words is not None and self._words[0] != MAGIC:
            self.close()  # of another version

    def close(self) -> None:
        """Unmap the blackboard."""
        words, self._words = self._words, None
        if words is not None:
            words.close()
            self._map.close()

    def request_of(self, method: str, params: Mapping[str, Any]) -> Mapping[str, Any]:
        """Request the stop of a method, if it is one; return the parameters by which the gateway knows the stop."""
        kind = self._KINDS.get(method)
        if kind is None or self._words is None:
            return params
        return {**params, "requested_ns": request(self._words, kind)}
