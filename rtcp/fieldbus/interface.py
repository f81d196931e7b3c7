"""The network interface: whether the master can use it, its flags, its namespace, its exclusive use."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import socket
import struct

from rtcp.fieldbus.errors import BusError

# netdevice(7): struct ifreq of 40 bytes, name and flags.
_SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8913, 0x8914
_IFF_UP, _IFF_LOOPBACK, _IFF_PROMISC = 0x1, 0x8, 0x100
_REQUEST = struct.Struct("=16sH22x")


def check_name(name: str) -> None:
    """Raise BusError where no interface has this name, or it is the loopback."""
    known = [interface for _, interface in socket.if_nameindex()]
    if name not in known:
        raise BusError(f"there is no network interface {name} (`interface`); there are {', '.join(known) or 'none'}")
    if _flags(name) & _IFF_LOOPBACK:
        raise BusError(
            f"interface {name} (`interface`) is the loopback, which has no cable: an Ethernet interface is expected"
        )


def check_interface(name: str) -> None:
    """Do `check_name`; raise BusError also where the interface is down."""
    check_name(name)
    if not _flags(name) & _IFF_UP:
        raise BusError(f"network interface {name} is down: `ip link set {name} up` brings it up")


class PromiscuousMode:
    """Restores, at `close`, the promiscuous mode of an interface, which SOEM switches on and leaves on."""

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._before = _flags(interface) & _IFF_PROMISC

    def close(self) -> None:
        """Switch the mode off if it was off; may be called twice, and when the interface is gone."""
        with contextlib.suppress(OSError):
            flags = _flags(self._interface)
            if flags & _IFF_PROMISC and not self._before:
                _ioctl(_SIOCSIFFLAGS, self._interface, flags & ~_IFF_PROMISC)


def _flags(name: str) -> int:
    return int(_REQUEST.unpack(_ioctl(_SIOCGIFFLAGS, name, 0))[1])


def _ioctl(request: int, name: str, flags: int) -> bytes:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        return fcntl.ioctl(probe, request, _REQUEST.pack(name.encode(), flags))


_CLONE_NEWUSER = 0x10000000
_CLONE_NEWNET = 0x40000000
# os.setns came with Python 3.12 only.
_libc = ctypes.CDLL(None, use_errno=True)


def enter(pid: int) -> None:
    """Join the user namespace (where it differs) and the network namespace of process `pid`.

    The kernel lets only a single-threaded process join a user namespace: call this before any thread is started.

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


def claim(interface: str) -> socket.socket:
    """Claim the interface for this process: two masters on one cable would disturb each other.

    The claim is an abstract socket name, which the kernel keeps per network namespace and frees with the process.

    Raises:
        BusError: another process of this platform has the claim.
    """
    mine = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        mine.bind(f"\0rtcp-bus-{interface}")
    except OSError as error:
        mine.close()
        raise BusError(
            f"interface {interface} is in use by another process of this platform: `rtcp stop` it first"
        ) from error
    return mine
