"""The object dictionary of a slave: entries, and their values as bytes (ETG.1000.6, 5.2 and 5.6.7)."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Any


class DataType(IntEnum):
    """Data types of CoE objects (ETG.1000.6, table 64; BYTE to BIT16: ETG.1020, table 98)."""

    UNKNOWN = 0x0000
    BOOLEAN = 0x0001
    INTEGER8 = 0x0002
    INTEGER16 = 0x0003
    INTEGER32 = 0x0004
    UNSIGNED8 = 0x0005
    UNSIGNED16 = 0x0006
    UNSIGNED32 = 0x0007
    REAL32 = 0x0008
    VISIBLE_STRING = 0x0009
    OCTET_STRING = 0x000A
    UNICODE_STRING = 0x000B
    TIME_OF_DAY = 0x000C
    TIME_DIFFERENCE = 0x000D
    INTEGER24 = 0x0010
    REAL64 = 0x0011
    INTEGER40 = 0x0012
    INTEGER48 = 0x0013
    INTEGER56 = 0x0014
    INTEGER64 = 0x0015
    UNSIGNED24 = 0x0016
    UNSIGNED40 = 0x0018
    UNSIGNED48 = 0x0019
    UNSIGNED56 = 0x001A
    UNSIGNED64 = 0x001B
    GUID = 0x001D
    BYTE = 0x001E
    WORD = 0x001F
    DWORD = 0x0020
    PDO_MAPPING = 0x0021
    IDENTITY = 0x0023
    BITARR8 = 0x002D
    BITARR16 = 0x002E
    BITARR32 = 0x002F
    BIT1 = 0x0030
    BIT2 = 0x0031
    BIT3 = 0x0032
    BIT4 = 0x0033
    BIT5 = 0x0034
    BIT6 = 0x0035
    BIT7 = 0x0036
    BIT8 = 0x0037
    BIT9 = 0x0038
    BIT10 = 0x0039
    BIT11 = 0x003A
    BIT12 = 0x003B
    BIT13 = 0x003C
    BIT14 = 0x003D
    BIT15 = 0x003E
    BIT16 = 0x003F


class ObjectCode(IntEnum):
    """Kinds of CoE objects (ETG.1000.6, table 62)."""

    VARIABLE = 7
    ARRAY = 8
    RECORD = 9


class Access(IntFlag):
    """Access rights of an entry as SDO information reports them (ETG.1000.6, 5.6.3.6.2)."""

    READ_PREOP = 0x01
    READ_SAFEOP = 0x02
    READ_OP = 0x04
    WRITE_PREOP = 0x08
    WRITE_SAFEOP = 0x10
    WRITE_OP = 0x20
    RXPDO = 0x40
    TXPDO = 0x80
    # Numbers, because the compiler refuses members in the terms of others.
    RO = 0x07
    WO = 0x38
    RW = 0x3F
    RW_PREOP = 0x0F


class SdoAbort(Exception):
    """An SDO service refused with one of the standard's abort codes (ETG.1000.6, table 41)."""

    def __init__(self, code: int) -> None:
        check_whole("code of SdoAbort", code, 0xFFFFFFFF)
        super().__init__(f"SDO abort 0x{code:08X}")
        self.code = code


def check_whole(name: str, number: object, most: int) -> None:
    """Raise ValueError unless `number` is a whole number from 0 to `most`."""
    if not isinstance(number, int) or not 0 <= number <= most:
        raise ValueError(f"{name}: found {number!r}, allowed is a whole number from 0 to {most}")


Value = int | float | bytes
WriteHook = Callable[["Entry", Value], None]
ReadHook = Callable[["Entry"], None]
STRUCT_CODES = {
    DataType.BYTE: "B",
    DataType.WORD: "H",
    DataType.DWORD: "I",
    DataType.BITARR8: "B",
    DataType.BITARR16: "H",
    DataType.BITARR32: "I",
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
"""`struct` codes of the types that fill whole bytes."""
BITS = {DataType.BOOLEAN: 1, **{data_type: 8 * struct.calcsize(code) for data_type, code in STRUCT_CODES.items()}}
BITS |= {
    DataType.INTEGER24: 24, DataType.INTEGER40: 40, DataType.INTEGER48: 48, DataType.INTEGER56: 56,
    DataType.UNSIGNED24: 24, DataType.UNSIGNED40: 40, DataType.UNSIGNED48: 48, DataType.UNSIGNED56: 56,
    **{DataType(DataType.BIT1 + n): n + 1 for n in range(16)},
}  # fmt: skip
SIGNED = frozenset(data_type for data_type, code in STRUCT_CODES.items() if code in "bhiq") | {
    DataType.INTEGER24, DataType.INTEGER40, DataType.INTEGER48, DataType.INTEGER56,
}  # fmt: skip
_FLOATS = (DataType.REAL32, DataType.REAL64)
LARGEST = {DataType.REAL32: (2.0 - 2.0**-23) * 2.0**127, DataType.REAL64: sys.float_info.max}
"""Largest finite number of the floating-point types."""
_BYTES = (DataType.VISIBLE_STRING, DataType.OCTET_STRING, DataType.UNICODE_STRING, DataType.GUID)


class Number:
    """Holder of a value that a model reads and writes every step: an entry, or the place of one that a drive lacks."""

    __slots__ = ("value",)

    def __init__(self, value: Value) -> None:
        # Not `Value`: the type follows from an entry's data type, unknown to mypy.
        self.value: Any = value


class Entry(Number):
    """One entry of the object dictionary.

    `value` is an int, a float or (strings) bytes, in the entry's own counts. `minimum` and `maximum` bound SDO writes.
    `on_write` is called with the entry and the new value before it is stored, `on_read` with the entry before an SDO
    reads its value; both may raise `SdoAbort`.
    """

    __slots__ = (
        "access", "bit_length", "data_type", "index", "maximum", "minimum", "name", "on_read", "on_write", "samples",
        "subindex",
    )  # fmt: skip

    def __init__(
        self,
        index: int,
        subindex: int,
        name: str,
        data_type: DataType,
        value: Value = 0,
        access: Access = Access.RO,
        *,
        bit_length: int | None = None,
        minimum: float | None = None,
        maximum: float | None = None,
        on_write: WriteHook | None = None,
    ) -> None:
        super().__init__(value)
        self.index = index
        self.subindex = subindex
        self.name = name
        self.data_type = data_type
        self.access = access
        if bit_length is None:
            bit_length = BITS[data_type] if data_type in BITS else 8 * len(value)  # type: ignore[arg-type]
        self.bit_length = bit_length
        self.minimum = minimum
        self.maximum = maximum
        self.on_write = on_write
        self.on_read: ReadHook | None = None
        self.samples: Sequence[Value] = ()
        """Values of one cycle, oldest first, where its PDO is assigned several times; empty: each is `value`."""

    @property
    def is_float(self) -> bool:
        """Whether the value is a floating-point number."""
        return self.data_type in _FLOATS

    @property
    def is_bytes(self) -> bool:
        """Whether the value is a string of bytes."""
        return self.data_type in _BYTES

    def __repr__(self) -> str:
        return f"Entry(0x{self.index:04X}:{self.subindex}, {self.name!r}, {self.value!r})"


@dataclass
class DictionaryObject:
    """An object: a variable (subindex 0 only), an array or a record (subindex 0 counts the entries)."""

    index: int
    name: str
    code: ObjectCode
    entries: dict[int, Entry] = field(default_factory=dict)

    @property
    def highest_subindex(self) -> int:
        """The highest subindex that exists."""
        return max(self.entries)


class ObjectDictionary:
    """The objects of a slave by index and subindex."""

    def __init__(self) -> None:
        self._objects: dict[int, DictionaryObject] = {}
        self.mappings: dict[int, tuple[Entry, int]] = {}
        """Accepted mappings with another length than their object: the entry and the mapped bits."""

    def variable(self, index: int, name: str, data_type: DataType, value: Value = 0, access: Access = Access.RO,
                 *, minimum: int | None = None, maximum: int | None = None,
                 on_write: WriteHook | None = None) -> Entry:  # fmt: skip
        """Add a variable; return its only entry."""
        entry = Entry(index, 0, name, data_type, value, access, minimum=minimum, maximum=maximum, on_write=on_write)
        self._objects[index] = DictionaryObject(index, name, ObjectCode.VARIABLE, {0: entry})
        return entry

    def record(self, index: int, name: str, entries: list[Entry], *, code: ObjectCode = ObjectCode.RECORD,
               count_access: Access = Access.RO) -> DictionaryObject:  # fmt: skip
        """Add a record or an array of `entries` (subindex 1 upwards) with their number in subindex 0."""
        count = Entry(index, 0, "Number of entries", DataType.UNSIGNED8, len(entries), count_access, maximum=255)
        obj = DictionaryObject(index, name, code, {0: count, **{entry.subindex: entry for entry in entries}})
        self.add(obj)
        return obj

    def add(self, obj: DictionaryObject) -> None:
        """Add an object; it replaces one with the same index."""
        self._objects[obj.index] = obj

    def remove(self, index: int) -> None:
        """Remove an object, if there is one."""
        self._objects.pop(index, None)

    def __getitem__(self, key: tuple[int, int]) -> Entry:
        """Return the entry.

        Raises:
            SdoAbort: 0x06020000 for an unknown object, 0x06090011 for an unknown subindex.
        """
        obj = self.object(key[0])
        try:
            return obj.entries[key[1]]
        except KeyError:
            raise SdoAbort(0x06090011) from None

    def object(self, index: int) -> DictionaryObject:
        """Return the object; raises SdoAbort 0x06020000 if it does not exist."""
        try:
            return self._objects[index]
        except KeyError:
            raise SdoAbort(0x06020000) from None

    def __contains__(self, key: tuple[int, int]) -> bool:
        obj = self._objects.get(key[0])
        return obj is not None and key[1] in obj.entries

    def __iter__(self) -> Iterator[DictionaryObject]:
        """Iterate over the objects in the order of their indices."""
        return iter(sorted(self._objects.values(), key=lambda obj: obj.index))


def byte_size(entry: Entry) -> int:
    """Return the size of `entry` in an SDO, bytes; of a string, its maximum."""
    return (entry.bit_length + 7) // 8


def encode(entry: Entry, value: Value) -> bytes:
    """Return `value` as bytes of `entry`'s type; an integer out of range is truncated to the type's bits."""
    if isinstance(value, bytes):
        return value
    if entry.is_float:
        return struct.pack("<" + STRUCT_CODES[entry.data_type], value)
    return (int(value) & ((1 << entry.bit_length) - 1)).to_bytes(byte_size(entry), "little")


def decode(entry: Entry, data: bytes) -> Value:
    """Return the value of `data` for `entry`.

    Raises:
        struct.error: wrong length of `data` for a floating-point entry.
    """
    if entry.is_bytes:
        return bytes(data)
    if entry.is_float:
        value: float = struct.unpack("<" + STRUCT_CODES[entry.data_type], data)[0]
        return value
    return int.from_bytes(data, "little", signed=entry.data_type in SIGNED)


def bounds(entry: Entry) -> tuple[int, int]:
    """Return the lowest and the highest number in the bits of an entry."""
    if entry.data_type in SIGNED:
        return -(1 << entry.bit_length - 1), (1 << entry.bit_length - 1) - 1
    return 0, (1 << entry.bit_length) - 1


def to_bits(entry: Entry) -> int:
    """Return the stored value as an unsigned integer of `entry.bit_length` bits."""
    return int.from_bytes(encode(entry, entry.value), "little") & ((1 << entry.bit_length) - 1)


def from_bits(entry: Entry, bits: int) -> Value:
    """Return the value of the unsigned integer `bits`, of `entry.bit_length` bits, for `entry`."""
    if entry.data_type in SIGNED:
        sign = 1 << (entry.bit_length - 1)
        return (bits ^ sign) - sign
    if entry.is_float or entry.is_bytes:
        return decode(entry, bits.to_bytes(byte_size(entry), "little"))
    return bits


def struct_code(entry: Entry) -> str | None:
    """Return the `struct` code of `entry`; None: it does not fill the bytes of its type."""
    if entry.is_bytes:
        return f"{byte_size(entry)}s" if entry.bit_length % 8 == 0 else None
    if entry.bit_length != BITS.get(entry.data_type):
        return None
    return STRUCT_CODES.get(entry.data_type)


class AbortCode(IntEnum):
    """SDO abort codes (ETG.1000.6, table 41)."""

    TOGGLE_BIT = 0x05030000
    """Toggle bit not changed."""
    COMMAND_SPECIFIER = 0x05040001
    """Client or server command specifier not valid or unknown."""
    UNSUPPORTED_ACCESS = 0x06010000
    """Unsupported access to an object."""
    WRITE_ONLY = 0x06010001
    """Attempt to read a write-only object."""
    READ_ONLY = 0x06010002
    """Attempt to write a read-only object."""
    SUBINDEX_0_NOT_ZERO = 0x06010003
    """Subindex cannot be written, subindex 0 must be 0 for write access."""
    NO_OBJECT = 0x06020000
    """The object does not exist in the object dictionary."""
    NOT_MAPPABLE = 0x06040041
    """The object cannot be mapped into the PDO."""
    PDO_LENGTH = 0x06040042
    """The number and length of the objects to be mapped would exceed the PDO length."""
    LENGTH = 0x06070010
    """Data type does not match, length of service parameter does not match."""
    TOO_LONG = 0x06070012
    """Data type does not match, length of service parameter too high."""
    TOO_SHORT = 0x06070013
    """Data type does not match, length of service parameter too low."""
    NO_SUBINDEX = 0x06090011
    """Subindex does not exist."""
    VALUE_RANGE = 0x06090030
    """Value range of parameter exceeded (write access only)."""
    VALUE_TOO_HIGH = 0x06090031
    """Value of parameter written too high."""
    VALUE_TOO_LOW = 0x06090032
    """Value of parameter written too low."""
    DEVICE_STATE = 0x08000022
    """Data cannot be transferred or stored because of the present device state."""
