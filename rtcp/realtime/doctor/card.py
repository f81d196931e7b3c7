"""What only the network card's driver tells: its coalescing and its address, asked with ioctl."""

from __future__ import annotations

import array
import errno
import fcntl
import os
import socket
import struct
from dataclasses import dataclass

from rtcp.realtime.doctor.host import NotKnown

_SIOCGIFADDR = 0x8915
_SIOCETHTOOL = 0x8946
_ETHTOOL_GCOALESCE = 0x0E
_COALESCE_WORDS = 23
"""`struct ethtool_coalesce` of linux/ethtool.h: the command and 22 settings, 32 bits each."""
_REQUEST = struct.Struct("16sP16x")
_ADDRESS = struct.Struct("16sHH4s16x")


@dataclass(frozen=True)
class Coalescing:
    """How long the card waits for further frames before it reports one."""

    receive_us: int
    send_us: int
    adaptive: bool
    """The driver changes the times with the traffic."""


class Card:
    """Asks the kernel of this machine."""

    def coalescing(self, interface: str) -> Coalescing | None:
        """Return the card's coalescing, None where its driver has none to set.

        Raises:
            NotKnown: the kernel does not say.
        """
        words = array.array("I", [_ETHTOOL_GCOALESCE] + [0] * (_COALESCE_WORDS - 1))
        try:
            _ask(_SIOCETHTOOL, bytearray(_REQUEST.pack(interface.encode(), words.buffer_info()[0])))
        except OSError as error:
            if error.errno == errno.EOPNOTSUPP:
                return None
            raise NotKnown(f"ethtool -c {interface}: {os.strerror(error.errno or 0)}") from error
        return Coalescing(words[1], words[5], bool(words[10] or words[11]))

    def address(self, interface: str) -> str | None:
        """Return the interface's IPv4 address, None where it has none.

        Raises:
            NotKnown: the kernel does not say.
        """
        request = bytearray(_ADDRESS.pack(interface.encode(), socket.AF_INET, 0, bytes(4)))
        try:
            _ask(_SIOCGIFADDR, request)
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                return None
            raise NotKnown(f"the address of {interface}: {os.strerror(error.errno or 0)}") from error
        return socket.inet_ntoa(_ADDRESS.unpack(request)[3])


def _ask(number: int, request: bytearray) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        fcntl.ioctl(asking, number, request, True)
