"""Stops: the way of halt, disable and shutdown to the loop, past all queues and without a lease.

The blackboard has three words for each kind of stop. A process requests a stop by writing the instant of the request
into the first word. The loop compares that word with the last one that it handled before it reads the command ring.
Any number of processes may write at any time: requests of one kind become one stop. A command that was requested before
a stop, and that the loop reads after it, is refused (`rtcp.ipc.refusals.Superseded`).
"""

from __future__ import annotations

import contextlib
import mmap
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from rtcp.ipc.closing import Closing
from rtcp.ipc.commands import Command, Disable, Halt, Shutdown
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.layout import MAGIC, STOP_SIZE, STOPS_AT, AtomicWords
from rtcp.ipc.refusals import WrongState
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.states import State

STOPS: Final[tuple[type[Command], ...]] = (Shutdown, Disable, Halt)
"""The kinds of stops, in the order of their words and in which the loop reads them: the one that ends most first."""
_OLDEST_NS = 10_000_000_000
"""Age of a request, ns, beyond which its time stamp is not believed: the request counts from now."""
_TAKEN_S = 0.05
"""Longest time in which a loop that runs takes a stop, s: several of the longest cycles."""


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

    @property
    def is_open(self) -> bool:
        """Whether there is a blackboard."""
        return self._words is not None

    @contextlib.contextmanager
    def requested(self, method: str, params: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
        """Request the stop of a method, if it is one; in the block its end is confirmed through the gateway.

        Yields the parameters by which the gateway knows the stop. A stop that `params` names by its `requested_ns` is
        not requested again.

        Raises:
            RtcpError: that of the block. If the gateway did not answer, the message and the field `stop_taken` say
                whether the loop has taken the stop.
        """
        kind, words = self._KINDS.get(method), self._words
        if kind is None or words is None:
            yield params
            return
        requested_ns = request(words, kind, params.get("requested_ns", 0))
        try:
            yield {**params, "requested_ns": requested_ns}
        except RtcpError as error:
            is_answered = error.kind not in ("not running", "lost", "timeout") or "stop_taken" in error.fields
            if is_answered or self._words is None:  # None: closed in the meantime
                raise
            is_taken = _is_taken(words, kind, requested_ns)
            taken = "the loop has taken it" if is_taken else f"the loop has not taken it within {_TAKEN_S:g} s"
            message = f"{method!r} was requested and {taken}, but the gateway did not confirm its end: {error.message}"
            raise RtcpError(error.kind, message, error.reason, {**error.fields, "stop_taken": is_taken}) from error


def _is_taken(words: AtomicWords, kind: type[Command], requested_ns: int) -> bool:
    """Wait for at most `_TAKEN_S` until the loop has answered a stop; return whether it has."""
    until = time.monotonic() + _TAKEN_S
    while refusal(words, kind, requested_ns) is False:
        if time.monotonic() > until:
            return False
        time.sleep(0.001)
    return True


@contextlib.contextmanager
def requested(directory: Path, method: str) -> Iterator[Mapping[str, Any]]:
    """Request a stop before the platform is connected to; as `StopWriter.requested`."""
    with StopWriter(directory) as stops, stops.requested(method, {}) as params:
        yield params
