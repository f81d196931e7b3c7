"""How well the host kept its promises while a test ran: the longest delay of a wake-up, and the stolen time.

A watcher process wakes up every 4 ms with real-time priority. It writes the longest delay of a wake-up into shared
memory. As the platform's loop it would notice if the host stopped the whole machine. Where the user has no right to
SCHED_FIFO, the watcher has an ordinary priority and sees the load of the other tests, too.

A run of tests that is killed leaves its platforms behind, with real-time priority. The watcher ends them.
"""

from __future__ import annotations

import mmap
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.leftovers import end_marked, mark
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[1]
STALL_LIMIT_S = 0.005
"""From this delay of a wake-up on the host counts as stalled, s."""
STEAL_LIMIT = 0.05
"""From this share of stolen CPU time on the host counts as stalled."""
_INTERVAL_S = 0.004
_PRIORITY = 81
"""One above the loop's, so that the watcher measures the host and not the loops of the tests."""
_DELAY = struct.Struct("d")
_NOT_YET = -1.0
"""In place of the delay before the watcher runs."""


@dataclass(frozen=True)
class HostFigures:
    """What the host did during one test."""

    longest_stall_s: float
    stolen: float
    """Part of the CPU time that the hypervisor took away, 0 to 1."""
    load: float
    """Load average over the last minute."""

    @property
    def stalled(self) -> bool:
        """Whether the host can have disturbed a measurement of time."""
        return self.longest_stall_s > STALL_LIMIT_S or self.stolen > STEAL_LIMIT

    def __str__(self) -> str:
        stall_ms, stolen = 1e3 * self.longest_stall_s, 100 * self.stolen
        return f"longest stall {stall_ms:.1f} ms, stolen {stolen:.0f} %, load {self.load:.1f}"


class Host:
    """Watches the host from `reset` on."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory
        self._ticks = _cpu_ticks()

    def reset(self) -> None:
        """Forget what happened before."""
        _DELAY.pack_into(self._memory, 0, 0.0)
        self._ticks = _cpu_ticks()

    def figures(self) -> HostFigures:
        """Return what happened since `reset`."""
        stolen, total = (now - before for now, before in zip(_cpu_ticks(), self._ticks, strict=True))
        longest = float(_DELAY.unpack_from(self._memory)[0])
        return HostFigures(longest, stolen / total if total else 0.0, os.getloadavg()[0])


def _cpu_ticks() -> tuple[int, int]:
    """Stolen and total time of all CPUs in ticks (proc(5), /proc/stat)."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().partition("\n")[0].split()[1:9]]
    return ticks[7], sum(ticks)


@contextmanager
def watched() -> Iterator[Host]:
    """Watch the host in this block."""
    descriptor = os.memfd_create("rtcp-host")
    os.ftruncate(descriptor, _DELAY.size)
    command = [sys.executable, "-m", "tests.host", str(descriptor), str(os.getpid()), mark()]
    with mmap.mmap(descriptor, _DELAY.size) as memory:
        _DELAY.pack_into(memory, 0, _NOT_YET)
        watcher = subprocess.Popen(command, cwd=ROOT, pass_fds=(descriptor,))
        os.close(descriptor)
        until(lambda: _DELAY.unpack_from(memory)[0] != _NOT_YET, "the watcher of the host")
        yield Host(memory)
    watcher.returncode = 0  # it lives until this process ends, and is not waited for


def main() -> None:
    """Measure until the parent process has ended, then end what it has left."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except PermissionError:
        pass
    with mmap.mmap(int(sys.argv[1]), _DELAY.size) as memory:
        parent, before = int(sys.argv[2]), time.monotonic()
        _DELAY.pack_into(memory, 0, 0.0)
        while os.getppid() == parent:
            time.sleep(_INTERVAL_S)
            now = time.monotonic()
            delay = now - before - _INTERVAL_S
            before = now
            if delay > _DELAY.unpack_from(memory)[0]:
                _DELAY.pack_into(memory, 0, delay)
    end_marked(sys.argv[3])


if __name__ == "__main__":
    main()
