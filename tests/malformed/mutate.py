"""Mutated frames, as of a broken cable, a broken master or an attacker."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from random import Random

from rtcp.virtual import protocol

EDGES = (0, 1, 2, 3, 4, 7, 8, 13, 15, 16, 0x7F, 0x80, 0xFF, 0x100, 0x400, 0x7FE, 0x7FF, 0x800, 0xFFF, 0x1000, 0x3FFF,
         0x7FFF, 0x8000, 0xFFFE, 0xFFFF)  # fmt: skip
REGISTERS = (
    0x0000,
    0x0010,
    0x0012,
    0x0100,
    0x0102,
    0x0110,
    0x0120,
    0x0130,
    0x0200,
    0x0300,
    0x0400,
    0x0420,
    0x0500,
    0x0502,
    0x0504,
    0x0508,
    0x0600,
    0x0610,
    0x0620,
    0x0800,
    0x0808,
    0x0810,
    0x0818,
    0x0820,
    0x0900,
    0x0910,
    0x0920,
    0x0928,
    0x0930,
    0x0981,
    0x0990,
    0x09A0,
    0x0F80,
    0x1000,
    0x1080,
    0x1100,
    0x1400,
    0x1FFF,
    0x2FFF,
)
"""Addresses of registers with a function."""
LARGEST = 2048
"""Bytes of the segment's buffer."""
_INDEX_AT = protocol.FIRST_DATAGRAM + 1
Mutation = Callable[[bytearray, Random], None]


def places(frame: bytes | bytearray) -> list[tuple[int, int]]:
    """Return the offset and the data length of each datagram that fits in the frame."""
    datagrams, at = [], protocol.FIRST_DATAGRAM
    while at + protocol.DATAGRAM_HEADER + protocol.COUNTER <= len(frame):
        flags = frame[at + 6] | frame[at + 7] << 8
        length = flags & protocol.LENGTH_MASK
        if at + protocol.DATAGRAM_HEADER + length + protocol.COUNTER > len(frame):
            break
        datagrams.append((at, length))
        if not flags & protocol.MORE_FOLLOWS:
            break
        at += protocol.DATAGRAM_HEADER + length + protocol.COUNTER
    return datagrams


def shape(frame: bytes | bytearray) -> tuple[int, ...]:
    """Return what makes a frame a kind of its own: commands, addresses within a slave, lengths; of mailboxes also what
    is asked."""
    key: list[int] = []
    for at, length in places(frame):
        command, _, _, offset, _, _ = protocol.HEADER.unpack_from(frame, at)
        data = at + protocol.DATAGRAM_HEADER
        key += [command, offset, length]
        if offset == 0x1000 and length >= 16:
            # The SDO command with index and subindex.
            key += frame[data + 8 : data + 12]
        elif offset == 0x0120:
            key += frame[data : data + 1]
    return tuple(key)


def _datagram(frame: bytearray, random: Random) -> tuple[int, int]:
    datagrams = places(frame)
    return random.choice(datagrams) if datagrams else (protocol.FIRST_DATAGRAM, 0)


def _put(frame: bytearray, at: int, value: int) -> None:
    if at + 2 <= len(frame):
        frame[at : at + 2] = (value & 0xFFFF).to_bytes(2, "little")


def _word(random: Random) -> int:
    return random.choice(EDGES) if random.random() < 0.5 else random.randrange(1 << 16)


def flip_bits(frame: bytearray, random: Random) -> None:
    for _ in range(random.randrange(1, 9)):
        frame[random.randrange(len(frame))] ^= 1 << random.randrange(8)


def other_bytes(frame: bytearray, random: Random) -> None:
    at = random.randrange(len(frame))
    count = random.randrange(1, 17)
    frame[at : at + count] = random.randbytes(len(frame[at : at + count]))


def other_command(frame: bytearray, random: Random) -> None:
    at, _ = _datagram(frame, random)
    if at < len(frame):
        frame[at] = random.randrange(16) if random.random() < 0.9 else random.randrange(256)


def other_index(frame: bytearray, random: Random) -> None:
    if len(frame) > _INDEX_AT:
        frame[_INDEX_AT] = random.randrange(256)


def other_station(frame: bytearray, random: Random) -> None:
    at, _ = _datagram(frame, random)
    _put(frame, at + 2, random.choice((random.randrange(0x0FFE, 0x100A), -random.randrange(9), _word(random))))


def other_address(frame: bytearray, random: Random) -> None:
    at, _ = _datagram(frame, random)
    near = random.choice(REGISTERS) + random.randrange(-4, 5)
    _put(frame, at + 4, near if random.random() < 0.8 else _word(random))


def other_logical(frame: bytearray, random: Random) -> None:
    """A logical command at another address, in the process image or outside."""
    at, _ = _datagram(frame, random)
    if at + 6 <= len(frame):
        frame[at] = random.choice((10, 11, 12))
        _put(frame, at + 2, random.randrange(256) if random.random() < 0.5 else _word(random))
        _put(frame, at + 4, random.choice((0, 1, 0x10, _word(random))))


def other_length(frame: bytearray, random: Random) -> None:
    at, length = _datagram(frame, random)
    near = max(0, length + random.randrange(-3, 4))
    _put(frame, at + 6, random.choice((near, near | protocol.MORE_FOLLOWS, _word(random))))


def other_frame_length(frame: bytearray, random: Random) -> None:
    kind = protocol.TYPE_DATAGRAMS if random.random() < 0.9 else random.randrange(16)
    whole = len(frame) - protocol.FIRST_DATAGRAM
    size = random.choice((whole, whole - random.randrange(12), whole + random.randrange(12), _word(random)))
    _put(frame, 14, (size & protocol.LENGTH_MASK) | kind << 12)


def other_counter(frame: bytearray, random: Random) -> None:
    at, length = _datagram(frame, random)
    _put(frame, at + protocol.DATAGRAM_HEADER + length, _word(random))


def other_event(frame: bytearray, random: Random) -> None:
    at, _ = _datagram(frame, random)
    _put(frame, at + 8, _word(random))


def other_data(frame: bytearray, random: Random) -> None:
    at, length = _datagram(frame, random)
    data = at + protocol.DATAGRAM_HEADER
    if not length:
        return
    if random.random() < 0.3:
        frame[data : data + length] = random.choice((b"\x00", b"\xff", b"\x80", b"\x7f")) * length
    else:
        first = data + random.randrange(length)
        count = min(random.choice((1, 2, 4, 8, length)), data + length - first)
        frame[first : first + count] = random.randbytes(count)


def mailbox_message(frame: bytearray, random: Random) -> None:
    """Other mailbox and CoE headers, other SDO commands."""
    at, length = _datagram(frame, random)
    data = at + protocol.DATAGRAM_HEADER
    if length < 16:
        return
    for place, choice in (
        (0, random.choice((0, 1, 2, 9, 10, 11, length, length - 6, 0xFF))),
        (5, random.randrange(8) << 4 | random.choice((0, 3, 3, 3, random.randrange(16)))),
        (7, random.choice((1, 2, 2, 2, 3, 8, random.randrange(16))) << 4),
        (8, random.randrange(256)),
        (9, random.randrange(256)), (10, random.choice((0x10, 0x16, 0x1A, 0x1C, 0x60, random.randrange(256)))),
        (11, random.choice((0, 1, 0xFF, random.randrange(256)))), (12, random.randrange(256)),
        (15, random.randrange(256)),
    ):  # fmt: skip
        if random.random() < 0.3:
            frame[data + place] = choice & 0xFF


def cut(frame: bytearray, random: Random) -> None:
    del frame[random.randrange(len(frame)) :]


def grow(frame: bytearray, random: Random) -> None:
    frame += random.randbytes(random.choice((1, 2, 40, max(0, protocol.MAX_FRAME - len(frame)), random.randrange(200))))


def repeat(frame: bytearray, random: Random) -> None:
    """Several datagrams: each says that more follow, also the last."""
    datagrams = places(frame)
    if not datagrams:
        return
    body = b"".join(
        bytes(frame[at : at + protocol.DATAGRAM_HEADER + length + protocol.COUNTER]) for at, length in datagrams
    )
    copies = random.choice((2, 3, 8, 60))
    whole = bytearray(body * copies)[: protocol.MAX_FRAME - protocol.FIRST_DATAGRAM]
    frame[protocol.FIRST_DATAGRAM :] = whole
    for at, length in places(frame):
        _put(frame, at + 6, length | protocol.MORE_FOLLOWS)
    _put(frame, 14, len(whole) | protocol.TYPE_DATAGRAMS << 12)


def all_of_chance(frame: bytearray, random: Random) -> None:
    head = bytes(frame[: protocol.FIRST_DATAGRAM]) if random.random() < 0.8 else b""
    frame[:] = head + random.randbytes(random.randrange(LARGEST - 16))


MUTATIONS: tuple[Mutation, ...] = (
    flip_bits, other_bytes, other_command, other_station, other_address, other_logical, other_length,
    other_frame_length, other_counter, other_event, other_data, other_data, mailbox_message, cut, grow, repeat,
    all_of_chance,
)  # fmt: skip


def mutated(frame: bytes, random: Random, mutations: Sequence[Mutation] = MUTATIONS) -> bytearray:
    """Return `frame` with one to four mutations, at most as long as the segment's buffer."""
    mutated = bytearray(frame)
    for _ in range(random.choice((1, 1, 1, 2, 2, 3, 4))):
        if len(mutated) < protocol.FIRST_DATAGRAM:
            break
        random.choice(mutations)(mutated, random)
    del mutated[LARGEST:]
    return mutated


ANSWERS: tuple[Mutation, ...] = (
    flip_bits, other_bytes, other_command, other_station, other_address, other_length, other_frame_length,
    other_counter, other_counter, other_event, other_data, other_data, other_data, mailbox_message, other_index, cut,
    grow, repeat, all_of_chance,
)  # fmt: skip


def garbled(frame: bytes, random: Random) -> bytes:
    """Return an answer with one to four mutations, no longer than what a network card takes."""
    return bytes(mutated(frame, random, ANSWERS)[: protocol.MAX_FRAME]).ljust(protocol.FIRST_DATAGRAM, b"\0")
