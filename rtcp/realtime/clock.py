"""Absolute sleeping on CLOCK_MONOTONIC: the one clock of the cycle."""

from __future__ import annotations

import ctypes
import errno
import time
from time import monotonic_ns

__all__ = ["Sleeper", "monotonic_ns"]

_TIMER_ABSTIME = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class Sleeper:
    """Sleeps until an instant of CLOCK_MONOTONIC; everything it needs is allocated once.

    The call goes through ctypes, which lets go of the interpreter while it sleeps.
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
