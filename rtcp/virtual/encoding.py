"""Values of entries as bytes and bits: little endian, two's complement, IEEE 754 (ETG.1000.6, 5.2)."""

from __future__ import annotations

import struct

from rtcp.virtual.objects import BITS, DataType, Entry, Value

SIGNED = frozenset({DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32, DataType.INTEGER64})
STRUCT_CODES = {
    DataType.INTEGER8: "b",
    DataType.INTEGER16: "h",
    DataType.INTEGER32: "i",
    DataType.INTEGER64: "q",
    DataType.UNSIGNED8: "B",
    DataType.UNSIGNED16: "H",
    DataType.UNSIGNED32: "I",
    DataType.UNSIGNED64: "Q",
    DataType.REAL32: "f",
    DataType.REAL64: "d",
}
"""Codes of the `struct` module for the types that fill whole bytes."""


def byte_size(entry: Entry) -> int:
    """Return the number of bytes that `entry` takes in an SDO; of a string, the largest number."""
    return (entry.bit_length + 7) // 8


def encode(entry: Entry, value: Value) -> bytes:
    """Return `value` as the bytes of `entry`'s type; an integer out of range is cut to the type's bits."""
    if isinstance(value, bytes):
        return value
    if entry.is_float:
        return struct.pack("<" + STRUCT_CODES[entry.data_type], value)
    return (int(value) & ((1 << entry.bit_length) - 1)).to_bytes(byte_size(entry), "little")


def decode(entry: Entry, data: bytes) -> Value:
    """Return the value that `data` means for `entry`.

    Raises:
        struct.error: a floating-point entry whose data has another length than its type.
    """
    if entry.is_bytes:
        return bytes(data)
    if entry.is_float:
        value: float = struct.unpack("<" + STRUCT_CODES[entry.data_type], data)[0]
        return value
    return int.from_bytes(data, "little", signed=entry.data_type in SIGNED)


def to_bits(entry: Entry) -> int:
    """Return the stored value as an unsigned integer of `entry.bit_length` bits."""
    return int.from_bytes(encode(entry, entry.value), "little") & ((1 << entry.bit_length) - 1)


def from_bits(entry: Entry, bits: int) -> Value:
    """Return the value that the unsigned integer `bits` of `entry.bit_length` bits means for `entry`."""
    if entry.data_type in SIGNED:
        sign = 1 << (entry.bit_length - 1)
        return (bits ^ sign) - sign
    if entry.is_float or entry.is_bytes:
        return decode(entry, bits.to_bytes(byte_size(entry), "little"))
    return bits


def struct_code(entry: Entry) -> str | None:
    """Return the `struct` code of `entry`, None where it does not fill the bytes of its type."""
    if entry.is_bytes:
        return f"{byte_size(entry)}s" if entry.bit_length % 8 == 0 else None
    if entry.bit_length != BITS.get(entry.data_type):
        return None
    return STRUCT_CODES.get(entry.data_type)
