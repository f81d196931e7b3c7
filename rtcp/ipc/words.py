"""Words of shared memory that two processes use at once: each is read and written by one 8-byte access.

`struct` would not do: `pack_into` clears the whole buffer first, and "<Q" is read and written byte by byte, so that
another process could see a lease of 0 or half of a counter.
"""

from __future__ import annotations

import mmap
import threading


class Words:
    """64-bit unsigned words of a mapped file, by byte offset (a multiple of 8)."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._view = memoryview(memory)
        self._words = self._view.cast("Q")
        self._lock = threading.Lock()

    def __getitem__(self, at: int) -> int:
        return self._words[at >> 3]

    def __setitem__(self, at: int, value: int) -> None:
        self._words[at >> 3] = value

    def fence(self) -> None:
        """Order the stores before against those after, also on weakly ordered CPUs (aarch64): two passes of a lock."""
        lock = self._lock
        lock.acquire()
        lock.release()
        lock.acquire()
        lock.release()

    def close(self) -> None:
        """Let go of the file, which cannot be unmapped before."""
        self._words.release()
        self._view.release()
