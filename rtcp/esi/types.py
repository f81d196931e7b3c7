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
    """Interpretation of the bytes of a type."""

    UNSIGNED = "unsigned"
    SIGNED = "signed"
    REAL = "real"
    TEXT = "text"
    BYTES = "bytes"


@dataclass(frozen=True)
class BaseType:
    """A base data type."""

    name: str
    """Name in ETG.2000, with aliases resolved."""
    number: int
    """Number of ETG.1000.6, as SDO information and the SII have it; 0: none."""
    bits: int
    """Length; 0: any."""
    kind: Kind

    @property
    def size(self) -> int:
        """Bytes that a value takes in an SDO."""
        return (self.bits + 7) // 8


_TABLE = """
0x01   1 u BOOL BOOLEAN BIT               0x02  8 s SINT INT8 INTEGER8       0x03 16 s INT INT16 INTEGER16
0x04  32 s DINT INT32 INTEGER32           0x05  8 u USINT UINT8 UNSIGNED8    0x06 16 u UINT UINT16 UNSIGNED16
0x07  32 u UDINT UINT32 UNSIGNED32        0x08 32 r REAL REAL32 FLOAT        0x09  0 t STRING VISIBLE_STRING
0x0A   0 b OCTET_STRING ARRAY_OF_BYTE     0x0B  0 b UNICODE_STRING WSTRING   0x0C 48 u TIME_OF_DAY
0x0D  48 u TIME_DIFFERENCE                0x0F  0 b DOMAIN                   0x10 24 s INT24 INTEGER24
0x11  64 r LREAL REAL64 DOUBLE            0x12 40 s INT40 INTEGER40          0x13 48 s INT48 INTEGER48
0x14  56 s INT56 INTEGER56                0x15 64 s LINT INT64 INTEGER64     0x16 24 u UINT24 UNSIGNED24
0x18  40 u UINT40 UNSIGNED40              0x19 48 u UINT48 UNSIGNED48        0x1A 56 u UINT56 UNSIGNED56
0x1B  64 u ULINT UINT64 UNSIGNED64        0x1D 128 b GUID                    0x1E  8 u BYTE
0x1F  16 u WORD                           0x20 32 u DWORD                    0x2D  8 u BITARR8
0x2E  16 u BITARR16                       0x2F 32 u BITARR32                 0x260 0 b ARRAY_OF_INT
0x261  0 b ARRAY_OF_SINT                  0x262 0 b ARRAY_OF_DINT            0x263 0 b ARRAY_OF_UDINT
"""
"""Number, bits, kind, names. BIT1 to BIT16 follow: 0x30 to 0x3F."""
_KINDS = dict(zip("usrtb", Kind, strict=True))
_BY_NAME: dict[str, BaseType] = {}
for _number, _bits, _kind, _names in re.findall(r"(0x\w+)\s+(\d+) (\w)((?: [A-Z]\w+)+)", _TABLE):
    _names = _names.split()
    _BY_NAME.update(dict.fromkeys(_names, BaseType(_names[0], int(_number, 16), int(_bits), _KINDS[_kind])))
_BY_NAME |= {f"BIT{bits}": BaseType(f"BIT{bits}", 0x2F + bits, bits, Kind.UNSIGNED) for bits in range(1, 17)}
_BY_NUMBER = {entry.number: entry for entry in _BY_NAME.values()}
_PLAIN = ["BOOL", "USINT", "UINT", "UINT24", "UDINT", "UINT40", "UINT48", "UINT56", "ULINT"]
_BY_BITS = {_BY_NAME[name].bits: _BY_NAME[name] for name in (*(f"BIT{bits}" for bits in range(2, 16)), *_PLAIN)}
_OCTETS = 0x0A
"""Number of a type of any number of bytes."""
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
            listed = _BY_NAME.get(f"ARRAY_OF_{element.name}")
            number = listed.number if listed is not None else 0
            return BaseType(name, number, (int(match[2]) - int(match[1]) + 1) * element.bits, Kind.BYTES)
    return None


def of_bits(bits: int) -> BaseType:
    """Return the generic type of a length: unsigned, or an array of bytes."""
    return _BY_BITS[bits] if bits in _BY_BITS else _bytes(bits)


def _bytes(bits: int) -> BaseType:
    return BaseType(f"ARRAY [0..{max((bits + 7) // 8 - 1, 0)}] OF BYTE", _OCTETS, bits, Kind.BYTES)


def of_number(number: int, bits: int) -> BaseType:
    """Return the type of a number of ETG.1000.6; unknown or not `bits` long: the generic type of that length."""
    entry = _BY_NUMBER.get(number)
    if entry is None or (entry.bits and bits and entry.bits != bits):
        return of_bits(bits)
    if entry.bits or not bits:
        return entry
    if number == _OCTETS:
        return _bytes(bits)
    name = f"{entry.name}({bits // 8})" if entry.kind is Kind.TEXT else entry.name
    return BaseType(name, number, bits, entry.kind)


@lru_cache(maxsize=1024)
def resolve(name: str, bits: int) -> BaseType:
    """Return the type with this name; if it is unknown or not `bits` long, the generic type of that length."""
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
