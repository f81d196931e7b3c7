"""EtherCAT frames on the wire: header, datagram headers and commands (ETG.1000.4, clause 5)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

ETHERTYPE = 0x88A4
ETHERNET_HEADER = 14
FRAME_HEADER = 2
"""Bytes of the EtherCAT header: 11 bits length, 1 reserved, 4 bits type (1: datagrams)."""
FIRST_DATAGRAM = ETHERNET_HEADER + FRAME_HEADER
DATAGRAM_HEADER = 10
COUNTER = 2
"""Bytes of the working counter behind a datagram's data."""
LENGTH_MASK = 0x07FF
MORE_FOLLOWS = 0x8000
CIRCULATING = 0x4000
TYPE_DATAGRAMS = 0x1
MAX_FRAME = 1514
LOCAL_BIT = 0x02
"""Bit of the source address' first byte that the first slave sets: locally administered."""

HEADER = struct.Struct("<BBHHHH")
"""Command, index, address (position or station), offset, length and flags, event request."""


class Command(IntEnum):
    """Datagram commands (ETG.1000.4, table 15 and following)."""

    NOP = 0
    APRD = 1
    APWR = 2
    APRW = 3
    FPRD = 4
    FPWR = 5
    FPRW = 6
    BRD = 7
    BWR = 8
    BRW = 9
    LRD = 10
    LWR = 11
    LRW = 12
    ARMW = 13
    FRMW = 14


@dataclass(frozen=True)
class Datagram:
    """One datagram as it stands in a frame."""

    command: int
    index: int
    address: int
    """Position or station address; for logical commands the low half of the logical address."""
    offset: int
    """Register or RAM address; for logical commands the high half of the logical address."""
    data: bytes
    counter: int = 0
    event: int = 0

    @property
    def logical(self) -> int:
        """The 32-bit logical address."""
        return self.address | self.offset << 16


def build(*datagrams: Datagram, source: bytes = b"\x01\x01\x01\x01\x01\x01") -> bytes:
    """Put `datagrams` into one Ethernet frame (broadcast, without FCS, padded to 60 bytes)."""
    body = bytearray()
    for number, datagram in enumerate(datagrams):
        more = MORE_FOLLOWS if number + 1 < len(datagrams) else 0
        body += HEADER.pack(datagram.command, datagram.index, datagram.address, datagram.offset,
                            len(datagram.data) | more, datagram.event)  # fmt: skip
        body += datagram.data + datagram.counter.to_bytes(COUNTER, "little")
    header = (len(body) | TYPE_DATAGRAMS << 12).to_bytes(FRAME_HEADER, "little")
    return (b"\xff" * 6 + source + ETHERTYPE.to_bytes(2, "big") + header + body).ljust(60, b"\0")


def parse(frame: bytes | bytearray | memoryview) -> Iterator[Datagram]:
    """Yield the datagrams of a frame; a cut datagram and what follows it are left out."""
    if len(frame) < FIRST_DATAGRAM or int.from_bytes(frame[12:14], "big") != ETHERTYPE:
        return
    header = int.from_bytes(frame[14:16], "little")
    if header >> 12 != TYPE_DATAGRAMS:
        return
    end = min(len(frame), FIRST_DATAGRAM + (header & LENGTH_MASK))
    at = FIRST_DATAGRAM
    while at + DATAGRAM_HEADER + COUNTER <= end:
        command, index, address, offset, length, event = HEADER.unpack_from(frame, at)
        data = at + DATAGRAM_HEADER
        behind = data + (length & LENGTH_MASK)
        if behind + COUNTER > end:
            return
        counter = int.from_bytes(frame[behind : behind + COUNTER], "little")
        yield Datagram(command, index, address, offset, bytes(frame[data:behind]), counter, event)
        if not length & MORE_FOLLOWS:
            return
        at = behind + COUNTER
