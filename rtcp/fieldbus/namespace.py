"""Joining the namespaces of another process: the virtual segment's network is seen from inside only."""

from __future__ import annotations

import ctypes
import errno
import os

from rtcp.fieldbus.bus import BusError

_CLONE_NEWUSER = 0x10000000
_CLONE_NEWNET = 0x40000000
# os.setns came with Python 3.12 only.
_libc = ctypes.CDLL(None, use_errno=True)


def enter(pid: int) -> None:
    """Join the user namespace (where it differs from ours) and the network namespace of process `pid`.

    The kernel lets only a process of a single thread join a user namespace: call this before any thread is started.

    Raises:
        BusError: the process does not exist, or the kernel refuses.
    """
    for kind, flag in (("user", _CLONE_NEWUSER), ("net", _CLONE_NEWNET)):
        try:
            target = os.open(f"/proc/{pid}/ns/{kind}", os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise BusError(
                f"the {kind} namespace of process {pid} cannot be opened: {error.strerror}; is the segment running?"
            ) from error
        try:
            theirs, ours = os.fstat(target), os.stat(f"/proc/self/ns/{kind}")
            if (theirs.st_dev, theirs.st_ino) == (ours.st_dev, ours.st_ino):
                continue
            if _libc.setns(target, flag) != 0:
                raise BusError(_refusal(kind, pid, ctypes.get_errno()))
        finally:
            os.close(target)


def _refusal(kind: str, pid: int, number: int) -> str:
    why = os.strerror(number)
    if kind == "user" and number == errno.EINVAL:
        why += "; only a process of a single thread may join a user namespace"
    if number == errno.EPERM:
        why += "; the segment must have been started by the same user, or this must be root"
    return f"the {kind} namespace of process {pid} cannot be joined: {why}"
