"""The EEPROM of a slave (SII): access rights, reading and writing (ETG.1000.4, 6.4)."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable

from rtcp.esi.sii import HEADER_BYTES, MAX_BYTES, SOEM_BYTES, crc
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import Register, RegisterPort, Steps, finish, pause

ALIAS_WORD, CHECKSUM_WORD, BOOTSTRAP_WORD, SIZE_WORD = 0x04, 0x07, 0x14, 0x3E
"""Word addresses (ETG.2010, table 2): alias, checksum of the words before it, mailboxes in BOOT, size in KiBit."""
_EIGHT_BYTES = 0x0040
"""Status bit: a read returns eight bytes."""
_READ, _WRITE = 0x0100, 0x0201
"""Commands; a write includes the write enable bit (bit 0)."""
_BUSY, _FAILED = 0x8000, 0x6000
"""Status bits: busy; command not acknowledged or wrong, write without permission. A wrong checksum is no failure."""
_READY_S = 0.5
_ATTEMPTS = 5
_RETRY_S = 0.005
Progress = Callable[[float], None]
"""Receives the completed fraction of a transfer, 0 to 1."""


def eeprom_to_device(port: RegisterPort, station: int) -> bool:
    """Give the slave access to its EEPROM, which some need to leave INIT (ETG.1000.4, 6.4.2); return whether it did."""
    return port.write(station, Register.EEPROM_CONFIG, b"\x01\x00")


def eeprom_to_master(port: RegisterPort, station: int) -> bool:
    """Give the master access to the EEPROM, by force if need be; return whether it has it (ETG.1000.4, 6.4.2)."""
    return all(port.write(station, Register.EEPROM_CONFIG, value) for value in (b"\x02\x00", b"\x00\x00"))


def reading_words(port: RegisterPort, station: int, word: int, label: str) -> Steps[bytes]:
    """Return four or eight bytes from `word` on; the master must have access. Raises BusError."""
    status = 0
    for _ in range(_ATTEMPTS):
        status = yield from _command(port, station, _READ, word, label, "read")
        data = port.read(station, Register.EEPROM_DATA, 8 if status & _EIGHT_BYTES else 4)
        if data is not None and not status & _FAILED:
            return data
        # An EEPROM is busy for some milliseconds after a write and refuses commands meanwhile.
        yield from pause(_RETRY_S)
    raise BusError(f"{label}: word 0x{word:04X} of its EEPROM cannot be read (status 0x{status:04X})")


def writing_word(port: RegisterPort, station: int, word: int, data: bytes, label: str) -> Steps[None]:
    """Write the two bytes of `word` and read them back; repeats after a failure (SOEM#675); raises BusError."""
    status = 0
    kept = b""
    for _ in range(_ATTEMPTS):
        port.put(station, Register.EEPROM_DATA, data, label)
        status = yield from _command(port, station, _WRITE, word, label, "written")
        if not status & _FAILED:
            kept = (yield from reading_words(port, station, word, label))[:2]
            if kept == data:
                return
        yield from pause(_RETRY_S)
    outcome = f"reads back as {kept.hex(' ')}" if kept else f"was refused (status 0x{status:04X})"
    raise BusError(f"{label}: word 0x{word:04X} of its EEPROM was set to {data.hex(' ')} and {outcome}")


def _command(port: RegisterPort, station: int, command: int, word: int, label: str, done: str) -> Steps[int]:
    """Send a command and return the status after it."""
    port.put(station, Register.EEPROM_CONTROL, struct.pack("<HI", command, word), label)
    deadline = time.monotonic() + _READY_S
    while True:
        data = port.read(station, Register.EEPROM_CONTROL, 2)
        if data is None:
            raise BusError(f"{label} stopped answering while its EEPROM was {done}")
        status = int.from_bytes(data, "little")
        if not status & _BUSY:
            return status
        if time.monotonic() >= deadline:
            raise BusError(f"{label}: its EEPROM stays busy")
        yield


def is_sound(header: bytes) -> bool:
    """Return whether word 7 is the checksum of the words before it; `header`: 16 bytes or more."""
    return header[2 * CHECKSUM_WORD] == crc(header[: 2 * CHECKSUM_WORD])


def alias_of(header: bytes) -> int:
    """Return the station alias."""
    return int.from_bytes(word_of(header, ALIAS_WORD), "little")


def with_alias(image: bytes, alias: int) -> bytes:
    """Return an image, or its first 16 bytes, with this station alias and a new checksum."""
    at, check = 2 * ALIAS_WORD, 2 * CHECKSUM_WORD
    covered = image[:at] + alias.to_bytes(2, "little") + image[at + 2 : check]
    return covered + bytes((crc(covered),)) + image[check + 1 :]


def size_of(header: bytes) -> int:
    """Return the size of an EEPROM by its header, bytes; with a wrong checksum limited to the size that masters read.

    Args:
        header: its first 128 bytes.
    """
    size = 128 * (int.from_bytes(word_of(header, SIZE_WORD), "little") + 1)
    return min(size, MAX_BYTES if is_sound(header) else SOEM_BYTES)


def read_eeprom(port: RegisterPort, station: int, label: str, progress: Progress, size: int | None = None) -> bytes:
    """Return `size` bytes of a slave's EEPROM, None: `size_of`; raises BusError."""
    _take(port, station, label)
    try:
        if size is None:
            size = size_of(_read(port, station, label, HEADER_BYTES, lambda part: None))
        return _read(port, station, label, size, progress)
    finally:
        eeprom_to_device(port, station)


def write_eeprom(port: RegisterPort, station: int, label: str, image: bytes, progress: Progress) -> int:
    """Write the words of `image` that differ, from word 0 on, and read each back; return their number.

    The checksum stays wrong until the last word is written, so that a half-written EEPROM is recognized.

    Args:
        port: the port to write through.
        station: the slave's configured address.
        label: the slave in messages.
        image: 16 bytes or more, with a correct checksum.
        progress: receives the completed fraction, 0 to 1.

    Raises:
        BusError: a word reads back differently, or the slave stopped answering; words written before stay.
    """
    _take(port, station, label)
    try:
        before = _read(port, station, label, len(image), lambda part: progress(part / 2))
        words = [word for word in range(len(image) // 2) if word_of(image, word) != word_of(before, word)]
        if not words:
            progress(1.0)
            return 0
        rights = (crc(before[: 2 * CHECKSUM_WORD]), image[2 * CHECKSUM_WORD])
        wrong = next(value for value in range(3) if value not in rights)
        finish(writing_word(port, station, CHECKSUM_WORD, bytes((wrong, 0)), label))
        others = [word for word in reversed(words) if word != CHECKSUM_WORD]
        for count, word in enumerate((*others, CHECKSUM_WORD), 1):
            finish(writing_word(port, station, word, word_of(image, word), label))
            progress(0.5 + 0.5 * count / (len(others) + 1))
        return len(words)
    finally:
        eeprom_to_device(port, station)


def word_of(image: bytes, word: int) -> bytes:
    """Return the two bytes of a word."""
    return image[2 * word : 2 * word + 2]


def _read(port: RegisterPort, station: int, label: str, size: int, progress: Progress) -> bytes:
    image = bytearray()
    while len(image) < size:
        image += finish(reading_words(port, station, len(image) // 2, label))
        progress(min(len(image) / size, 1.0))
    return bytes(image[:size])


def _take(port: RegisterPort, station: int, label: str) -> None:
    if not eeprom_to_master(port, station):
        raise BusError(f"{label} did not take the request for its EEPROM in register 0x{Register.EEPROM_CONFIG:04X}")
