"""SDO information: lists and descriptions of the object dictionary (ETG.1000.6, 5.6.3)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum, IntFlag

from rtcp.virtual.abort import AbortCode
from rtcp.virtual.coe import MAILBOX_AND_COE_HEADER
from rtcp.virtual.encoding import byte_size, encode
from rtcp.virtual.objects import Access, DataType, DictionaryObject, Entry, ObjectCode, ObjectDictionary, SdoAbort

_HEADER = struct.Struct("<BBH")
_INCOMPLETE = 0x80
"""Bit 7 of the operation code: more fragments follow."""
_OBJECT = struct.Struct("<HHBB")
_ENTRY = struct.Struct("<HBBHHH")
_ENTRY_REQUEST = struct.Struct("<HBB")


class Operation(IntEnum):
    """Operation codes of SDO information (ETG.1000.6, 5.6.3.2)."""

    LIST_REQUEST = 1
    LIST_RESPONSE = 2
    OBJECT_REQUEST = 3
    OBJECT_RESPONSE = 4
    ENTRY_REQUEST = 5
    ENTRY_RESPONSE = 6
    ERROR = 7


class ListType(IntEnum):
    """Lists of objects (ETG.1000.6, 5.6.3.3)."""

    COUNTS = 0
    """How many objects each of the five lists has."""
    ALL = 1
    RXPDO = 2
    TXPDO = 3
    REPLACEMENT = 4
    """Objects to be stored for the replacement of a device."""
    STARTUP = 5
    """Start-up parameters."""


class ValueInfo(IntFlag):
    """What an entry description tells beside type and length (ETG.1000.6, 5.6.3.6)."""

    ACCESS = 0x01
    CATEGORY = 0x02
    MAPPABLE = 0x04
    UNIT = 0x08
    DEFAULT = 0x10
    MINIMUM = 0x20
    MAXIMUM = 0x40


_ALWAYS_TOLD = ValueInfo.ACCESS | ValueInfo.CATEGORY | ValueInfo.MAPPABLE
_RECORD_TYPES = {
    **dict.fromkeys(range(0x1600, 0x1800), DataType.PDO_MAPPING),
    **dict.fromkeys(range(0x1A00, 0x1C00), DataType.PDO_MAPPING),
    0x1018: DataType.IDENTITY,
}
"""Data types of the records that the standard defines (ETG.1000.6, table 64)."""


class SdoInformation:
    """The SDO information server of a slave."""

    MINIMUM_REQUEST = 8
    """Bytes of the shortest request, CoE header included."""

    def __init__(self, objects: ObjectDictionary, send_size: int) -> None:
        """Describe `objects` through a send mailbox of `send_size` bytes."""
        self._objects = objects
        # Even, so that no index is torn between two fragments.
        self._fragment_size = (send_size - MAILBOX_AND_COE_HEADER - _HEADER.size) & ~1
        self._services: dict[int, tuple[Operation, Callable[[bytes], bytes]]] = {
            Operation.LIST_REQUEST: (Operation.LIST_RESPONSE, self._list),
            Operation.OBJECT_REQUEST: (Operation.OBJECT_RESPONSE, self._object),
            Operation.ENTRY_REQUEST: (Operation.ENTRY_RESPONSE, self._entry),
        }

    def answer(self, request: bytes) -> list[bytes]:
        """Return the fragments that answer `request` (six bytes or more), all without CoE header."""
        operation = request[0] & ~_INCOMPLETE
        try:
            if operation not in self._services:
                raise SdoAbort(AbortCode.COMMAND_SPECIFIER)
            response, service = self._services[operation]
            return self._fragments(response, service(request[_HEADER.size :]))
        except SdoAbort as abort:
            return self._fragments(Operation.ERROR, struct.pack("<I", abort.code))

    def _fragments(self, operation: Operation, data: bytes) -> list[bytes]:
        size = self._fragment_size
        parts = [data[start : start + size] for start in range(0, len(data), size)]
        left = range(len(parts) - 1, -1, -1)
        return [
            _HEADER.pack(operation | (_INCOMPLETE if after else 0), 0, after) + part
            for part, after in zip(parts, left, strict=True)
        ]

    def _list(self, request: bytes) -> bytes:
        """Return list type and indices, or the lengths of the five lists."""
        (kind,) = struct.unpack_from("<H", request)
        if kind == ListType.COUNTS:
            numbers = [len(self._indices(listed)) for listed in ListType if listed != ListType.COUNTS]
        elif kind <= ListType.STARTUP:
            numbers = self._indices(ListType(kind))
        else:
            raise SdoAbort(AbortCode.VALUE_RANGE)
        return struct.pack(f"<H{len(numbers)}H", kind, *numbers)

    def _indices(self, kind: ListType) -> list[int]:
        """Return the indices of one list; no entry can be marked for replacement or start-up: those lists are empty."""
        if kind == ListType.ALL:
            return [found.index for found in self._objects]
        wanted = {ListType.RXPDO: Access.RXPDO, ListType.TXPDO: Access.TXPDO}.get(kind, Access(0))
        return [
            found.index for found in self._objects if any(entry.access & wanted for entry in found.entries.values())
        ]

    def _object(self, request: bytes) -> bytes:
        """Return index, data type, highest subindex, object code and name."""
        (index,) = struct.unpack_from("<H", request)
        found = self._objects.object(index)
        head = _OBJECT.pack(index, _data_type(found), found.highest_subindex, found.code)
        return head + found.name.encode("ascii", "replace")

    def _entry(self, request: bytes) -> bytes:
        """Return the description of an entry with as much of the value information asked for as there is."""
        if len(request) < _ENTRY_REQUEST.size:
            raise SdoAbort(AbortCode.LENGTH)
        index, subindex, asked = _ENTRY_REQUEST.unpack_from(request)
        entry = self._objects[index, subindex]
        told, limits = _limits(entry, ValueInfo(asked & 0x7F))
        head = _ENTRY.pack(index, subindex, told, entry.data_type, entry.bit_length, entry.access)
        return head + limits + entry.name.encode("ascii", "replace")


def _limits(entry: Entry, asked: ValueInfo) -> tuple[ValueInfo, bytes]:
    """Return which of `asked` is told, and the bytes of minimum and maximum where they are."""
    told, data = asked & _ALWAYS_TOLD, b""
    for flag, limit in ((ValueInfo.MINIMUM, entry.minimum), (ValueInfo.MAXIMUM, entry.maximum)):
        if flag & asked and limit is not None:
            told |= flag
            data += encode(entry, limit).ljust(byte_size(entry), b"\0")
    return told, data


def _data_type(found: DictionaryObject) -> int:
    """Return the data type of an object: of a variable or an array that of its elements, of a record its own."""
    if found.code == ObjectCode.RECORD:
        return _RECORD_TYPES.get(found.index, 0)
    return found.entries[found.highest_subindex].data_type
