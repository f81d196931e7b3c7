"""A network interface as the kernel knows it: whether it can be the master's end of a cable, and its flags."""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct

from rtcp.fieldbus.bus import BusError

# netdevice(7): struct ifreq of 40 bytes, name and flags.
_SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8913, 0x8914
_IFF_UP, _IFF_LOOPBACK, _IFF_PROMISC = 0x1, 0x8, 0x100
_REQUEST = struct.Struct("=16sH22x")


def check_name(name: str) -> None:
    """Raise BusError where no interface has this name, or the one that has it has no cable."""
    known = [found for _, found in socket.if_nameindex()]
    if name not in known:
        raise BusError(f"there is no network interface {name} (`interface`); there are {', '.join(known) or 'none'}")
    if _flags(name) & _IFF_LOOPBACK:
        raise BusError(
            f"interface {name} (`interface`) is the loopback, which has no cable: an Ethernet interface is expected"
        )


def check_interface(name: str) -> None:
    """Raise BusError where `check_name` does, or the interface is down."""
    check_name(name)
    if not _flags(name) & _IFF_UP:
        raise BusError(f"network interface {name} is down: `ip link set {name} up` brings it up")


class PromiscuousMode:
    """Whether an interface was promiscuous; `close` makes it so again. SOEM switches that on and leaves it on."""

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._before = _flags(interface) & _IFF_PROMISC

    def close(self) -> None:
        """Switch the mode off where it was off; may be called twice, and when the interface is gone."""
        with contextlib.suppress(OSError):
            flags = _flags(self._interface)
            if flags & _IFF_PROMISC and not self._before:
                _ioctl(_SIOCSIFFLAGS, self._interface, flags & ~_IFF_PROMISC)


def _flags(name: str) -> int:
    return int(_REQUEST.unpack(_ioctl(_SIOCGIFFLAGS, name, 0))[1])


def _ioctl(request: int, name: str, flags: int) -> bytes:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        return fcntl.ioctl(probe, request, _REQUEST.pack(name.encode(), flags))
