"""Real-time scheduling of the cycle: its sleep, SCHED_FIFO, a CPU, locked memory, idle states, no garbage collection.

The loop runs without any of it: what the host refuses becomes a note in `rtcp status`.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import resource
import struct
import sys
import time
from dataclasses import dataclass, field

_TIMER_ABSTIME = 1
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_TIMERSLACK = 29
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
_PREFAULT_BYTES = 4 << 20
_STACK_BYTES = 256 << 10


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class Sleeper:
    """Sleeps until an instant of CLOCK_MONOTONIC; everything it needs is allocated once.

    The call goes through ctypes, which releases the interpreter while it sleeps.
    """

    def __init__(self) -> None:
        libc = ctypes.CDLL(None, use_errno=False)
        self._call = libc.clock_nanosleep
        self._call.restype = ctypes.c_int
        self._call.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
        self._until = _Timespec()
        self._address = ctypes.addressof(self._until)

    def until(self, instant_ns: int) -> None:
        """Sleep until `instant_ns`; return at once where it lies in the past. Signals do not shorten the sleep."""
        until = self._until
        until.tv_sec, until.tv_nsec = divmod(instant_ns, 1_000_000_000)
        # A signal interrupts the sleep without ending it: the absolute instant makes the repetition exact.
        while self._call(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, self._address, None) == errno.EINTR:
            pass


@dataclass
class Realtime:
    """Real-time properties of the loop, and what the host refused."""

    scheduler: str = "SCHED_OTHER"
    """SCHED_OTHER, or SCHED_FIFO and its priority."""
    memory_locked: bool = False
    cpu: int = -1
    notes: list[str] = field(default_factory=list)
    _latency_file: int = -1


def available_cpus() -> list[int]:
    """Return the CPUs that this process may use, in order."""
    return sorted(os.sched_getaffinity(0))


def choose_cpu(wanted: int | None) -> int:
    """Return the CPU for the cycle: the one wanted, or the last available (interrupts gather on the first)."""
    return available_cpus()[-1] if wanted is None else wanted


def prepare(granted: Realtime, priority: int, cpu: int | None) -> None:
    """Prepare the calling thread to run the cycle: pin it, lock and prefault memory, freeze the collector, SCHED_FIFO.

    Call it after everything is imported and built; what was granted goes into `granted`.
    """
    _pin(granted, cpu)
    _lock_memory(granted)
    _hold_latency(granted)
    _timer_slack()
    _fifo(granted, priority)
    freeze_garbage()


def freeze_garbage() -> None:
    """Collect garbage once, exempt what is alive from collection, and switch the collector off."""
    gc.collect()
    gc.freeze()
    gc.disable()


def release(granted: Realtime) -> None:
    """Withdraw the CPU latency request."""
    if granted._latency_file >= 0:
        os.close(granted._latency_file)
        granted._latency_file = -1


def _pin(granted: Realtime, cpu: int | None) -> None:
    allowed = available_cpus()
    chosen = choose_cpu(cpu)
    try:
        # Also a CPU that is isolated: no process has it among its CPUs before it asks.
        os.sched_setaffinity(0, {chosen})
    except (OSError, ValueError, OverflowError):
        granted.notes.append(f"cycle.cpu is {chosen}, which this process may not use (allowed: {allowed}): not pinned")
        return
    granted.cpu = chosen


def _lock_memory(granted: Realtime) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    # Freed memory stays in the process, so that a later allocation does not fault pages in again.
    libc.mallopt(_M_TRIM_THRESHOLD, -1)
    libc.mallopt(_M_MMAP_MAX, 0)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        allowed = "unlimited" if limit == resource.RLIM_INFINITY else f"{limit // 1024} KiB"
        granted.notes.append(
            f"memory is not locked ({os.strerror(ctypes.get_errno())}): allow it with LimitMEMLOCK=infinity or "
            f"CAP_IPC_LOCK (RLIMIT_MEMLOCK is {allowed})"
        )
        return
    granted.memory_locked = True
    bytearray(_PREFAULT_BYTES)
    _touch_stack()


def _touch_stack() -> None:
    page = (ctypes.c_char * _STACK_BYTES)()
    ctypes.memset(page, 0, _STACK_BYTES)


def _hold_latency(granted: Realtime) -> None:
    try:
        granted._latency_file = os.open("/dev/cpu_dma_latency", os.O_WRONLY)
        os.write(granted._latency_file, struct.pack("=i", 0))
    except OSError as error:
        granted.notes.append(f"idle states are not held off: /dev/cpu_dma_latency: {error.strerror}")


def _timer_slack() -> None:
    # Matters only without SCHED_FIFO: ordinary timers are else up to 50 us late on purpose.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def _fifo(granted: Realtime, priority: int) -> None:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        granted.notes.append(
            f"SCHED_FIFO {priority} is refused ({error.strerror}): allow it with CAP_SYS_NICE or "
            f"LimitRTPRIO={priority}; the cycle runs on as an ordinary thread"
        )
        return
    granted.scheduler = f"SCHED_FIFO {priority}"


def thread_beside(avoid_cpu: int, priority: int) -> None:
    """Keep the calling thread off the cycle's CPU where there is another; SCHED_FIFO `priority` where allowed.

    The thread shares the interpreter's lock with the cycle: an ordinary thread that is preempted while it holds the
    lock would make the cycle wait for as long as others run there.
    """
    others = set(available_cpus()) - {avoid_cpu}
    if others:
        os.sched_setaffinity(0, others)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(max(priority, 1)))


def cpu_hint(cpu: int) -> str:
    """Return a hint about the cycle's CPU for software on this host that answers the frames; empty without SCHED_FIFO.

    The cycle waits for its frame without sleeping: an ordinary process on its CPU runs after that, too late to answer.
    """
    if os.sched_getscheduler(os.getpid()) != os.SCHED_FIFO:
        return ""
    return (
        f"; the cycle keeps CPU {cpu} under SCHED_FIFO while it waits: software on this host that answers the frames "
        "needs another CPU (`taskset`, or cycle.cpu)"
    )


def share_interpreter_quickly() -> None:
    """Return the interpreter to the cycle from another thread within 50 us instead of 5 ms."""
    sys.setswitchinterval(50e-6)
