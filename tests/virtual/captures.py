"""Captured frames of real devices, and what the segment answers to the same requests."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rtcp.virtual.segment import Segment

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_ETHERTYPE = b"\x88\xa4"
_ANSWERED = 0x02
"""Bit of the source address that the first slave sets (ETG.1000.3)."""
_EEPROM_CONTROL, _EEPROM_ADDRESS, _EEPROM_DATA = 0x0502, 0x0504, 0x0508
BY_POSITION, BY_STATION, TO_ALL = (1, 2, 3, 13), (4, 5, 6, 14), (7, 8, 9)
LOGICAL = (10, 11, 12)


@dataclass(frozen=True)
class Datagram:
    """One command of a frame."""

    command: int
    index: int
    station: int
    address: int
    data: bytes
    wkc: int


@dataclass(frozen=True)
class Exchange:
    """A frame and its answer, instants in ns."""

    sent_at: int
    request: bytes
    answer: bytes


def packets(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield instant (ns) and bytes of each frame of a pcapng file."""
    data, at, ticks = path.read_bytes(), 0, [10**6]
    while at + 12 <= len(data):
        kind, length = struct.unpack_from("<II", data, at)
        body = data[at + 8 : at + length - 4]
        if kind == _SECTION:
            ticks = []
        elif kind == _INTERFACE:
            ticks.append(_resolution(body[8:]))
        elif kind == _PACKET:
            interface, high, low, captured, _ = struct.unpack_from("<5I", body)
            yield (high << 32 | low) * 10**9 // ticks[interface], body[20 : 20 + captured]
        at += length


def _resolution(options: bytes) -> int:
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from("<HH", options, at)
        if code == 9:
            value = options[at + 4]
            return 1 << (value & 0x7F) if value & 0x80 else 10**value
        if code == 0:
            break
        at += 4 + (length + 3) // 4 * 4
    return 10**6


def datagrams(frame: bytes) -> list[Datagram]:
    """Return the datagrams of an EtherCAT frame."""
    at, parsed = 16, []
    more = True
    while more and at + 12 <= len(frame):
        command, index, station, address, length, _ = struct.unpack_from("<BBHHHH", frame, at)
        more, size = bool(length & 0x8000), length & 0x7FF
        data = frame[at + 10 : at + 10 + size]
        parsed.append(
            Datagram(command, index, station, address, data, *struct.unpack_from("<H", frame, at + 10 + size))
        )
        at += 12 + size
    return parsed


def exchanges(path: Path) -> Iterator[Exchange]:
    """Yield the frames of a capture with their answers; those without one are left out."""
    waiting: dict[tuple[tuple[int, int], ...], tuple[int, bytes]] = {}
    for instant, frame in packets(path):
        if frame[12:14] != _ETHERTYPE:
            continue
        key = tuple((each.command, each.index) for each in datagrams(frame))
        if not frame[6] & _ANSWERED:
            waiting[key] = instant, frame
        elif key in waiting:
            yield Exchange(*waiting.pop(key), frame)


def eeproms(path: Path) -> dict[int, bytearray]:
    """Return the EEPROM of each slave as far as the master has read it, by station address; unread bytes are 0xFF."""
    images: dict[int, bytearray] = {}
    addresses: dict[int, int] = {}
    for exchange in exchanges(path):
        for sent, answer in zip(datagrams(exchange.request), datagrams(exchange.answer), strict=True):
            if sent.command in (2, 5, 8) and answer.wkc and sent.address == _EEPROM_CONTROL and len(sent.data) >= 6:
                station = sent.station
                addresses[station] = int.from_bytes(sent.data[2:6], "little")
            elif sent.command in (1, 4) and answer.wkc:
                start = _EEPROM_DATA - sent.address
                if 0 <= start < len(answer.data) and sent.station in addresses and sent.address >= _EEPROM_CONTROL:
                    data = answer.data[start : start + 8]
                    image = images.setdefault(sent.station, bytearray(b"\xff" * 4096))
                    at = 2 * addresses[sent.station]
                    image[at : at + len(data)] = data
    return images


class Difference(NamedTuple):
    """A datagram that the segment answered otherwise than the devices did."""

    at: int
    """Number of the exchange."""
    sent: Datagram
    device: Datagram
    segment: Datagram | None


def replay(path: Path, segment: Segment, start: int) -> Iterator[Difference | None]:
    """Send a capture's requests to a segment at the instants of the capture; yield one item a datagram.

    None where both answered the same.
    """
    first: int | None = None
    frame = bytearray(2048)
    for number, exchange in enumerate(exchanges(path)):
        first = exchange.sent_at if first is None else first
        t = start + exchange.sent_at - first
        while segment.next_event <= t:
            segment.tick(segment.next_event)
            while segment.busy:
                segment.step_one()
        size = len(exchange.request)
        frame[:size] = exchange.request
        came_back = segment.process(frame, size, t)
        answers = datagrams(bytes(frame[:size])) if came_back else []
        segment.settle(t)
        while segment.busy:
            segment.step_one()
        expected = datagrams(exchange.answer)
        for place, (sent, device) in enumerate(zip(datagrams(exchange.request), expected, strict=True)):
            ours = answers[place] if place < len(answers) else None
            same = ours is not None and (ours.data, ours.wkc, ours.station) == (device.data, device.wkc, device.station)
            yield None if same else Difference(number, sent, device, ours)
