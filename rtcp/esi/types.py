"""Base data types: names of ETG.2000, numbers and lengths of ETG.1000.6 (table 64) and ETG.1020, and their values."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

from rtcp.esi.model import EsiError

Value = int | float | str | bytes


class Kind(Enum):
    """How the bytes of a type are read."""

    UNSIGNED = "unsigned"
    SIGNED = "signed"
    REAL = "real"
    TEXT = "text"
    BYTES = "bytes"


@dataclass(frozen=True)
class BaseType:
    """A base data type."""

    name: str
    """Name of ETG.2000; of an alias the one that it stands for."""
    number: int
    """Number of ETG.1000.6, as SDO information and the SII have it; 0: none."""
    bits: int
    """Length; 0: any."""
    kind: Kind

    @property
    def size(self) -> int:
        """Bytes that a value takes in an SDO."""
        return (self.bits + 7) // 8


def _table() -> dict[str, BaseType]:
    table: dict[str, BaseType] = {}

    def add(kind: Kind, number: int, bits: int, *names: str) -> None:
        table.update(dict.fromkeys(names, BaseType(names[0], number, bits, kind)))

    add(Kind.UNSIGNED, 0x01, 1, "BOOL", "BOOLEAN", "BIT")
    for number, bits, *names in (
        (0x02, 8, "SINT", "INT8"),
        (0x03, 16, "INT", "INT16"),
        (0x04, 32, "DINT", "INT32"),
        (0x10, 24, "INT24"),
        (0x12, 40, "INT40"),
        (0x13, 48, "INT48"),
        (0x14, 56, "INT56"),
        (0x15, 64, "LINT", "INT64"),
    ):
        add(Kind.SIGNED, number, bits, *names, f"INTEGER{bits}")
    for number, bits, *names in (
        (0x05, 8, "USINT", "UINT8", "ENUM8"),
        (0x06, 16, "UINT", "UINT16", "ENUM16"),
        (0x07, 32, "UDINT", "UINT32", "ENUM32"),
        (0x16, 24, "UINT24"),
        (0x18, 40, "UINT40"),
        (0x19, 48, "UINT48"),
        (0x1A, 56, "UINT56"),
        (0x1B, 64, "ULINT", "UINT64"),
    ):
        add(Kind.UNSIGNED, number, bits, *names, f"UNSIGNED{bits}")
    for number, bits, name in (
        (0x1E, 8, "BYTE"),
        (0x1F, 16, "WORD"),
        (0x20, 32, "DWORD"),
        (0x0C, 48, "TIME_OF_DAY"),
        (0x0D, 48, "TIME_DIFFERENCE"),
        (0x2D, 8, "BITARR8"),
        (0x2E, 16, "BITARR16"),
        (0x2F, 32, "BITARR32"),
    ):
        add(Kind.UNSIGNED, number, bits, name)
    for bits in range(1, 17):
        add(Kind.UNSIGNED, 0x2F + bits, bits, f"BIT{bits}")
    add(Kind.REAL, 0x08, 32, "REAL", "REAL32", "FLOAT")
    add(Kind.REAL, 0x11, 64, "LREAL", "REAL64", "DOUBLE")
    add(Kind.TEXT, 0x09, 0, "STRING", "VISIBLE_STRING")
    add(Kind.BYTES, 0x0A, 0, "OCTET_STRING", "ARRAY OF BYTE")
    add(Kind.BYTES, 0x0B, 0, "UNICODE_STRING", "WSTRING")
    add(Kind.BYTES, 0x0F, 0, "DOMAIN")
    add(Kind.BYTES, 0x1D, 128, "GUID")
    add(Kind.BYTES, 0x260, 0, "ARRAY OF INT")
    add(Kind.BYTES, 0x261, 0, "ARRAY OF SINT")
    add(Kind.BYTES, 0x262, 0, "ARRAY OF DINT")
    add(Kind.BYTES, 0x263, 0, "ARRAY OF UDINT")
    return table


_BY_NAME = _table()
_BY_NUMBER = {entry.number: entry for entry in reversed(_BY_NAME.values())}
_BY_BITS = {entry.bits: entry for entry in reversed(_BY_NAME.values()) if 0x30 <= entry.number < 0x37} | {
    bits: _BY_NAME[name]
    for bits, name in (
        (1, "BOOL"),
        (8, "USINT"),
        (16, "UINT"),
        (24, "UINT24"),
        (32, "UDINT"),
        (40, "UINT40"),
        (48, "UINT48"),
        (56, "UINT56"),
        (64, "ULINT"),
    )
}
_STRING = re.compile(r"(STRING|VISIBLE_STRING|OCTET_STRING|UNICODE_STRING|WSTRING)\s*[\[(]\s*(\d{1,6})\s*[\])]")
_ARRAY = re.compile(r"ARRAY\s*\[\s*(\d{1,6})\s*\.\.\s*(\d{1,6})\s*\]\s*OF\s+(\w+)")
_CHARACTER_BITS = {"UNICODE_STRING": 16, "WSTRING": 16}


@lru_cache(maxsize=1024)
def named(name: str) -> BaseType | None:
    """Return the type of a name, `STRING(12)` and `ARRAY [0..30] OF BYTE` among them; None: it is no base type."""
    name = name.strip().upper()
    if name in _BY_NAME:
        return _BY_NAME[name]
    if match := _STRING.fullmatch(name):
        entry = _BY_NAME[match[1]]
        return BaseType(name, entry.number, int(match[2]) * _CHARACTER_BITS.get(match[1], 8), entry.kind)
    if match := _ARRAY.fullmatch(name):
        element = _BY_NAME.get(match[3])
        if element is not None and element.bits and int(match[2]) >= int(match[1]):
            number = _BY_NAME[f"ARRAY OF {element.name}"].number if f"ARRAY OF {element.name}" in _BY_NAME else 0
            return BaseType(name, number, (int(match[2]) - int(match[1]) + 1) * element.bits, Kind.BYTES)
    return None


def of_bits(bits: int) -> BaseType:
    """Return the plainest type of a length: unsigned, or an array of bytes."""
    if bits in _BY_BITS:
        return _BY_BITS[bits]
    return BaseType(f"ARRAY [0..{max((bits + 7) // 8 - 1, 0)}] OF BYTE", 0x0A, bits, Kind.BYTES)


def of_number(number: int, bits: int) -> BaseType:
    """Return the type of a number of ETG.1000.6; a number or a length that does not fit: the plainest of the length."""
    entry = _BY_NUMBER.get(number)
    if entry is None or (entry.bits and bits and entry.bits != bits):
        return of_bits(bits)
    return entry


@lru_cache(maxsize=1024)
def resolve(name: str, bits: int) -> BaseType:
    """Return the type of a name; where it is none, or of another length than `bits`, the plainest of the length."""
    entry = named(name)
    if entry is None or (bits and entry.bits != bits):
        if entry is not None and entry.kind in (Kind.TEXT, Kind.BYTES):
            return BaseType(entry.name, entry.number, bits, entry.kind)
        return of_bits(bits) if bits or entry is None else entry
    return entry


def encode(data_type: BaseType, value: Value) -> bytes:
    """Return a value as little-endian bytes. Raises EsiError where it does not fit."""
    size = data_type.size
    try:
        if data_type.kind is Kind.REAL:
            return struct.pack("<f" if size == 4 else "<d", float(value))
        if data_type.kind is Kind.TEXT:
            data = value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")
        elif isinstance(value, bytes):
            data = value
        elif data_type.kind is Kind.BYTES and isinstance(value, str):
            data = value.encode("utf-8", "replace")
        else:
            number = int(value)
            half = 1 << (data_type.bits or 64)
            if not -(half >> 1) <= number < half:
                raise OverflowError
            return (number % half).to_bytes(size or 8, "little")
    except (ValueError, OverflowError, struct.error):
        raise EsiError(
            data_type.name, f"the value {str(value)[:40]!r} does not fit into {data_type.bits} bits"
        ) from None
    if size and len(data) > size:
        raise EsiError(data_type.name, f"a value of {len(data)} bytes does not fit into {size}")
    return data


def decode(data_type: BaseType, data: bytes) -> Value:
    """Return the value of little-endian bytes: int, float, text without its trailing zeros, or the bytes themselves."""
    if data_type.kind is Kind.TEXT:
        return data.rstrip(b"\0").decode("utf-8", "replace")
    if data_type.kind is Kind.REAL:
        padded = data[: data_type.size].ljust(data_type.size, b"\0")
        return float(struct.unpack("<f" if data_type.size == 4 else "<d", padded)[0])
    if data_type.kind is Kind.BYTES:
        return data
    number = int.from_bytes(data[: data_type.size], "little") & ((1 << data_type.bits) - 1)
    if data_type.kind is Kind.SIGNED and number >> (data_type.bits - 1):
        number -= 1 << data_type.bits
    return number
