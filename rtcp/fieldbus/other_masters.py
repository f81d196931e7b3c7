"""Detects a second master on the cable: frames that this one did not send, told apart by their source address.

A second master sends through another card (its frames come back through the last slave's open port), or another program
sends on the same interface. Either takes the slaves away. SOEM always sends from 01:01:01:01:01:01, so a second master
that is SOEM too is told apart only before this one has sent anything.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import Counter

from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import ETHERTYPE, SOURCE, attach_program

_SOEM = b"\x01" * 6
_FROM_SLAVE = 0xFDFF_FFFF
"""Without the bit that a slave sets in the source address of each frame that it processes (ETG.1000.4, 5.2)."""
_SOURCE_AT, _HEADER_AT = 6, 14
_DATAGRAMS = 1
"""Type of a frame with datagrams (ETG.1000.4, 5.3.1)."""
_SMALLEST = 28
_LARGEST_COMMAND = 14
_FEW = 3
"""A source of fewer frames is noise, or a late answer to a process that has ended."""
_MOST_SOURCES = 64
_AT_ONCE = 64


class OtherMasters:
    """Listens to the frames on an interface. The kernel drops this master's own frames, so an idle poll is one call."""

    def __init__(self, interface: str, listen_s: float = 0.05) -> None:
        """Listen for `listen_s` before this master sends its first frame; raises BusError without the right to."""
        self._counts: Counter[bytes] = Counter()
        try:
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
            self._socket.bind((interface, ETHERTYPE))
        except OSError as error:
            raise BusError(f"a raw socket on {interface} cannot be opened: {error.strerror}") from error
        time.sleep(listen_s)
        self._socket.setblocking(False)
        self._ignore_own()
        self._read()

    def address(self) -> str:
        """Return the source address of a second master, as 01:23:45:67:89:ab; empty: none was heard."""
        self._read()
        source, count = max(self._counts.items(), key=lambda item: item[1], default=(b"", 0))
        return source.hex(":") if count >= _FEW else ""

    def forget(self) -> None:
        """Forget what was heard."""
        self._counts.clear()

    def close(self) -> None:
        """Close the socket; may be called twice."""
        self._socket.close()

    def _read(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                frame = self._socket.recv(1518)
            except OSError:  # nothing waits, or the interface is gone, which others report
                return
            if _is_ethercat(frame):
                if len(self._counts) >= _MOST_SOURCES:
                    self._counts.clear()
                self._counts[frame[_SOURCE_AT : _SOURCE_AT + 6]] += 1

    def _ignore_own(self) -> None:
        """Let the kernel drop frames from the addresses of SOEM and of the register port; those that wait stay."""
        lines = [(0x20, 0, 0, _SOURCE_AT), (0x54, 0, 0, _FROM_SLAVE)]  # A = the first four bytes, masked
        for address in (_SOEM, SOURCE):
            high, low = struct.unpack(">IH", address)
            # A differs: the next address. Else A = the last two bytes; equal: drop.
            lines += [
                (0x15, 0, 3, high & _FROM_SLAVE),
                (0x28, 0, 0, _SOURCE_AT + 4),
                (0x15, 0, 1, low),
                (0x06, 0, 0, 0),
            ]
            lines += [(0x20, 0, 0, _SOURCE_AT), (0x54, 0, 0, _FROM_SLAVE)]
        lines.append((0x06, 0, 0, 0xFFFF))
        attach_program(self._socket, lines)


def other_master_words(address: str) -> str:
    """Return the sentence for a second master."""
    return (
        f"frames that this platform did not send come from the address {address}: a second EtherCAT master is on the "
        "cable, or another program sends on this interface; disconnect or stop it"
    )


def _is_ethercat(frame: bytes) -> bool:
    """Whether a frame's header and its first datagram's command and length are those of EtherCAT."""
    if len(frame) < _SMALLEST:
        return False
    header = int.from_bytes(frame[_HEADER_AT : _HEADER_AT + 2], "little")
    length = int.from_bytes(frame[_HEADER_AT + 8 : _HEADER_AT + 10], "little") & 0x07FF
    return header >> 12 == _DATAGRAMS and frame[_HEADER_AT + 2] <= _LARGEST_COMMAND and _SMALLEST + length <= len(frame)
