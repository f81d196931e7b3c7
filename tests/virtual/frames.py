"""EtherCAT frames built and read by the tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rtcp.virtual import protocol


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
        more = protocol.MORE_FOLLOWS if number + 1 < len(datagrams) else 0
        body += protocol.HEADER.pack(datagram.command, datagram.index, datagram.address, datagram.offset,
                            len(datagram.data) | more, datagram.event)  # fmt: skip
        body += datagram.data + datagram.counter.to_bytes(protocol.COUNTER, "little")
    header = (len(body) | protocol.TYPE_DATAGRAMS << 12).to_bytes(protocol.FRAME_HEADER, "little")
    return (b"\xff" * 6 + source + protocol.ETHERTYPE.to_bytes(2, "big") + header + body).ljust(60, b"\0")


def parse(frame: bytes | bytearray | memoryview) -> Iterator[Datagram]:
    """Yield the datagrams of a frame; a cut datagram and what follows it are left out."""
    if len(frame) < protocol.FIRST_DATAGRAM or int.from_bytes(frame[12:14], "big") != protocol.ETHERTYPE:
        return
    header = int.from_bytes(frame[14:16], "little")
    if header >> 12 != protocol.TYPE_DATAGRAMS:
        return
    end = min(len(frame), protocol.FIRST_DATAGRAM + (header & protocol.LENGTH_MASK))
    at = protocol.FIRST_DATAGRAM
    while at + protocol.DATAGRAM_HEADER + protocol.COUNTER <= end:
        command, index, address, offset, length, event = protocol.HEADER.unpack_from(frame, at)
        data = at + protocol.DATAGRAM_HEADER
        behind = data + (length & protocol.LENGTH_MASK)
        if behind + protocol.COUNTER > end:
            return
        counter = int.from_bytes(frame[behind : behind + protocol.COUNTER], "little")
        yield Datagram(command, index, address, offset, bytes(frame[data:behind]), counter, event)
        if not length & protocol.MORE_FOLLOWS:
            return
        at = behind + protocol.COUNTER
