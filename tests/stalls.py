"""How long the host kept the CPU from a process that wanted it: the reason to repeat a test in real time.

Without the right to SCHED_FIFO every process of a test can lose the CPU like that, and the watcher does not see it.

As a program it wakes up every 2 ms and writes into a file the longest delay of a wake-up, s, since the number there was
last set to 0.
"""

from __future__ import annotations

import mmap
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

LIMIT_S = 0.005
"""Delay from which a test may be repeated: more than two cycles of a platform under test."""
_INTERVAL_S = 0.002
_NICENESS = 5
"""Of a watcher that may not be of real time: more important, it would see no delay that a test suffers."""
_DELAY = struct.Struct("d")


def may_run_in_real_time() -> bool:
    """Whether this user has the right to SCHED_FIFO."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        return False
    os.sched_setscheduler(0, *before)
    return True


class Stalls:
    """The longest delay since `reset`, measured by another process."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory

    def reset(self) -> None:
        """Forget earlier delays."""
        _DELAY.pack_into(self._memory, 0, 0.0)

    @property
    def longest_s(self) -> float:
        """Longest delay since `reset`, s."""
        return float(_DELAY.unpack_from(self._memory)[0])


@contextmanager
def watched() -> Iterator[Stalls]:
    """Watch the host in this block."""
    with tempfile.NamedTemporaryFile(dir="/dev/shm") as file:
        file.write(bytes(_DELAY.size))
        file.flush()
        command = [sys.executable, __file__, file.name, str(os.getpid())]
        watcher = subprocess.Popen(command)
        try:
            with mmap.mmap(file.fileno(), _DELAY.size) as memory:
                yield Stalls(memory)
        finally:
            watcher.kill()
            watcher.wait()


def main() -> None:
    """Measure until the parent process has ended."""
    try:
        # Then it sees the host, and not the tests beside it.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        os.nice(_NICENESS)
    with open(sys.argv[1], "r+b") as file, mmap.mmap(file.fileno(), _DELAY.size) as memory:
        asking, before = int(sys.argv[2]), time.monotonic()
        while os.getppid() == asking:
            time.sleep(_INTERVAL_S)
            now = time.monotonic()
            delay = now - before - _INTERVAL_S
            before = now
            if delay > _DELAY.unpack_from(memory)[0]:
                _DELAY.pack_into(memory, 0, delay)


if __name__ == "__main__":
    main()
