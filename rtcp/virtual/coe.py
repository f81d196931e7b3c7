"""CoE: SDO transfers, SDO information and emergency messages (ETG.1000.6, 5.6)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

from rtcp.virtual.device import Emergency, SlaveFaults
from rtcp.virtual.objects import (
    SIGNED,
    AbortCode,
    Access,
    DataType,
    DictionaryObject,
    Entry,
    ObjectCode,
    ObjectDictionary,
    SdoAbort,
    Value,
    byte_size,
    decode,
    encode,
    from_bits,
    to_bits,
)

_READ = {2: Access.READ_PREOP, 4: Access.READ_SAFEOP, 8: Access.READ_OP}
_WRITE = {2: Access.WRITE_PREOP, 4: Access.WRITE_SAFEOP, 8: Access.WRITE_OP}
_STATE = 0x0F
_COUNT_BITS = 16
"""Bits of subindex 0 and its padding at the start of a complete access from subindex 0."""


def read(objects: ObjectDictionary, index: int, subindex: int, complete: bool, state: int) -> bytes:
    """Return the bytes of an entry, or (`complete`) of an object from `subindex` 0 or 1.

    Complete access returns the number of entries in subindex 0; unreadable ones are sent as zero. `state` is the AL
    state (2 PRE-OP, 4 SAFE-OP, 8 OP), without its error flag.

    Raises:
        SdoAbort: absent, write-only, or not readable in the AL state `state`.
    """
    obj = objects.object(index)
    if not complete or obj.code == ObjectCode.VARIABLE:
        entry = objects[index, subindex]
        _check_right(entry, Access.RO, _READ.get(state & _STATE, Access(0)), AbortCode.WRITE_ONLY)
        if entry.on_read is not None:
            entry.on_read(entry)
        return encode(entry, entry.value)
    _check_first(subindex)
    entries = [obj.entries[0]] if subindex == 0 else []
    entries += _members(obj, int(obj.entries[0].value))
    right = _READ.get(state & _STATE, Access(0))
    if entries and not any(entry.access & right for entry in entries):
        known = next((entry for entry in entries if entry.access & Access.RO), entries[0])
        _check_right(known, Access.RO, right, AbortCode.WRITE_ONLY)
    image = offset = 0
    for entry in entries:
        if entry.access & right:
            if entry.on_read is not None:
                entry.on_read(entry)
            image |= to_bits(entry) << offset
        offset += entry.bit_length if entry.subindex else _COUNT_BITS
    return image.to_bytes((offset + 7) // 8, "little")


def check_download(objects: ObjectDictionary, index: int, subindex: int, complete: bool, state: int, size: int) -> None:
    """Refuse a download of `size` bytes that cannot succeed for any data.

    Raises:
        SdoAbort: absent, read-only, not writable in the AL state `state`, or the wrong size.
    """
    obj = objects.object(index)
    if not complete or obj.code == ObjectCode.VARIABLE:
        entry = objects[index, subindex]
        _check_right(entry, Access.WO, _WRITE.get(state & _STATE, Access(0)), AbortCode.READ_ONLY)
        if size > byte_size(entry):
            raise SdoAbort(AbortCode.TOO_LONG)
        # Strings have a maximum length, all other types a fixed length.
        if size < byte_size(entry) and not entry.is_bytes:
            raise SdoAbort(AbortCode.TOO_SHORT)
        return
    _check_first(subindex)
    entries = [entry for entry in obj.entries.values() if entry.access & Access.WO]
    for entry in entries or [obj.entries[0]]:
        _check_right(entry, Access.WO, _WRITE.get(state & _STATE, Access(0)), AbortCode.READ_ONLY)
    whole = sum(entry.bit_length for entry in _members(obj, obj.highest_subindex))
    if size > ((_COUNT_BITS if subindex == 0 else 0) + whole + 7) // 8:
        raise SdoAbort(AbortCode.TOO_LONG)


def write(objects: ObjectDictionary, index: int, subindex: int, complete: bool, state: int, data: bytes) -> None:
    """Store `data` in an entry, or (`complete`) in an object from `subindex` 0 or 1.

    Complete access is all or nothing and skips read-only entries in its data. A writable subindex 0 (PDO assignment and
    mapping) is cleared first and written last.

    Raises:
        SdoAbort: as `check_download`, a value out of range, or refused by the entry's `on_write`.
    """
    check_download(objects, index, subindex, complete, state, len(data))
    obj = objects.object(index)
    if complete and obj.code != ObjectCode.VARIABLE:
        _write_object(obj, subindex, data)
    else:
        entry = objects[index, subindex]
        _store(entry, decode(entry, data))


def _write_object(obj: DictionaryObject, first: int, data: bytes) -> None:
    count = obj.entries[0]
    counted = bool(count.access & Access.WO)
    members = _members(obj, obj.highest_subindex if counted else int(count.value))
    offset = 0
    if first == 0:
        if len(data) < _COUNT_BITS // 8:
            raise SdoAbort(AbortCode.TOO_SHORT)
        offset = _COUNT_BITS
        if counted:
            _check_range(count, data[0])
            members = _members(obj, data[0])
    elif counted:
        members = _that_fit(members, 8 * len(data))
    size = (offset + sum(entry.bit_length for entry in members) + 7) // 8
    if len(data) != size:
        raise SdoAbort(AbortCode.TOO_LONG if len(data) > size else AbortCode.TOO_SHORT)
    image = int.from_bytes(data, "little")
    values: list[tuple[Entry, Value]] = [(count, 0)] if counted and first == 0 else []
    for entry in members:
        if entry.access & Access.WO:
            values.append((entry, from_bits(entry, image >> offset & ((1 << entry.bit_length) - 1))))
        offset += entry.bit_length
    if counted and first == 0:
        values.append((count, data[0]))
    before = [(entry, entry.value) for entry in obj.entries.values()]
    try:
        for entry, value in values:
            _store(entry, value)
    except SdoAbort:
        for entry, value in before:
            entry.value = value
        raise


def _members(obj: DictionaryObject, last: int) -> list[Entry]:
    """Return the entries of subindices 1 to `last`, in order."""
    return [obj.entries[subindex] for subindex in sorted(obj.entries) if 0 < subindex <= last]


def _that_fit(entries: list[Entry], bits: int) -> list[Entry]:
    """Return the first of `entries`, as many as fit in `bits`."""
    fitting = []
    for entry in entries:
        bits -= entry.bit_length
        if bits < 0:
            break
        fitting.append(entry)
    return fitting


def _check_first(subindex: int) -> None:
    """Complete access begins with subindex 0 or 1 (ETG.1000.6, 5.6.2.1)."""
    if subindex > 1:
        raise SdoAbort(AbortCode.UNSUPPORTED_ACCESS)


def _check_right(entry: Entry, any_state: Access, right: Access, never: AbortCode) -> None:
    """Refuse with `never` if no AL state allows the access, with 0x08000022 if another one does."""
    if not entry.access & any_state:
        raise SdoAbort(never)
    if not entry.access & right:
        raise SdoAbort(AbortCode.DEVICE_STATE)


def _check_range(entry: Entry, value: Value) -> None:
    """Refuse a number outside the entry's limits, or larger than its bits if these do not fill bytes (BOOLEAN)."""
    if isinstance(value, bytes):
        return
    if entry.maximum is not None and value > entry.maximum:
        raise SdoAbort(AbortCode.VALUE_TOO_HIGH)
    if entry.minimum is not None and value < entry.minimum:
        raise SdoAbort(AbortCode.VALUE_TOO_LOW)
    if isinstance(value, int) and entry.data_type not in SIGNED and value >> entry.bit_length:
        raise SdoAbort(AbortCode.VALUE_TOO_HIGH)


def _store(entry: Entry, value: Value) -> None:
    _check_range(entry, value)
    if entry.on_write is not None:
        entry.on_write(entry, value)
    entry.value = value


MAILBOX_AND_COE_HEADER = 8
"""Bytes before the SDO: six of the mailbox header, two of the CoE header."""


class CoeService(IntEnum):
    """Services in the CoE header (ETG.1000.6, table 29)."""

    EMERGENCY = 1
    SDO_REQUEST = 2
    SDO_RESPONSE = 3
    TXPDO = 4
    RXPDO = 5
    TXPDO_REMOTE_REQUEST = 6
    RXPDO_REMOTE_REQUEST = 7
    SDO_INFORMATION = 8

    @property
    def header(self) -> bytes:
        """Return the two bytes of a CoE header with this service and number 0."""
        return bytes((0, self << 4))


class Request(IntEnum):
    """Client command specifiers, the upper three bits of the command (ETG.1000.6, 5.6.2)."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    ABORT = 4


class Response(IntEnum):
    """Server commands without their flags (ETG.1000.6, 5.6.2)."""

    UPLOAD_SEGMENT = 0x00
    DOWNLOAD_SEGMENT = 0x20
    UPLOAD = 0x40
    DOWNLOAD = 0x60
    ABORT = 0x80


_SIZE_INDICATED = 0x01
_EXPEDITED = 0x02
_COMPLETE = 0x10
_TOGGLE = 0x10
_LAST = 0x01
_SDO = struct.Struct("<BHBI")
_SEGMENT_MINIMUM = 7
"""Least data bytes of a segment; bits 1 to 3 of the command count the unused ones."""
_EMERGENCY = struct.Struct("<HB5s")


def emergency_message(emergency: Emergency) -> bytes:
    """Return an emergency message: CoE header and eight bytes (ETG.1000.6, 5.6.4)."""
    return CoeService.EMERGENCY.header + _EMERGENCY.pack(emergency.error_code, emergency.error_register, emergency.data)


@dataclass
class _Upload:
    index: int
    subindex: int
    rest: bytes
    toggle: int = 0


@dataclass
class _Download:
    index: int
    subindex: int
    complete: bool
    size: int
    data: bytearray = field(default_factory=bytearray)
    toggle: int = 0


ABORT = int(Response.ABORT)
"""First byte of an abort."""


class SdoServer:
    """The SDO server of a slave: one transfer at a time, expedited, normal or segmented (ETG.1000.6, 5.6.2)."""

    MINIMUM_REQUEST = 10
    """Bytes of the shortest request, CoE header included."""

    def __init__(self, objects: ObjectDictionary, send_size: int, faults: SlaveFaults | None = None,
                 complete_access: bool = True) -> None:  # fmt: skip
        """Serve `objects` through a send mailbox of `send_size` bytes."""
        self._objects = objects
        self._complete_access = complete_access
        self._faults = SlaveFaults() if faults is None else faults
        self._segment_size = send_size - MAILBOX_AND_COE_HEADER - 1
        self._normal_size = send_size - MAILBOX_AND_COE_HEADER - _SDO.size
        self._transfer: _Upload | _Download | None = None

    def answer(self, request: bytes, state: int) -> bytes | None:
        """Return the answer to `request` (eight bytes or more), both without CoE header; None for an abort.

        `state`: AL state, for the access rights.
        """
        command, index, subindex, number = _SDO.unpack_from(request)
        specifier = command >> 5
        transfer = self._transfer
        if specifier in (Request.UPLOAD_SEGMENT, Request.DOWNLOAD_SEGMENT) and transfer is not None:
            # A segment has data in place of index and subindex.
            index, subindex = transfer.index, transfer.subindex
        else:
            self._transfer = None
        try:
            if specifier != Request.ABORT and (code := self._faults.sdo_abort(index)):
                raise SdoAbort(code)
            if specifier in (Request.UPLOAD, Request.DOWNLOAD) and command & _COMPLETE and not self._complete_access:
                raise SdoAbort(AbortCode.UNSUPPORTED_ACCESS)
            if specifier == Request.UPLOAD:
                return self._upload(command, index, subindex, state)
            if specifier == Request.DOWNLOAD:
                return self._download(command, index, subindex, number, request[_SDO.size :], state)
            if specifier == Request.UPLOAD_SEGMENT and isinstance(transfer, _Upload):
                return self._upload_segment(command, transfer)
            if specifier == Request.DOWNLOAD_SEGMENT and isinstance(transfer, _Download):
                return self._download_segment(command, transfer, request[1:], state)
            if specifier == Request.ABORT:
                return None
            raise SdoAbort(AbortCode.COMMAND_SPECIFIER)
        except SdoAbort as abort:
            self._transfer = None
            return _SDO.pack(Response.ABORT, index, subindex, abort.code)

    def _upload(self, command: int, index: int, subindex: int, state: int) -> bytes:
        complete = command & _COMPLETE
        data = read(self._objects, index, subindex, bool(complete), state)
        if 0 < len(data) <= 4:
            flags = complete | (4 - len(data)) << 2 | _EXPEDITED | _SIZE_INDICATED
            return _SDO.pack(Response.UPLOAD | flags, index, subindex, int.from_bytes(data, "little"))
        if len(data) > self._normal_size:
            self._transfer = _Upload(index, subindex, data[self._normal_size :])
        head = _SDO.pack(Response.UPLOAD | complete | _SIZE_INDICATED, index, subindex, len(data))
        return head + data[: self._normal_size]

    def _upload_segment(self, command: int, transfer: _Upload) -> bytes:
        _check_toggle(command, transfer)
        data, transfer.rest = transfer.rest[: self._segment_size], transfer.rest[self._segment_size :]
        unused = max(0, _SEGMENT_MINIMUM - len(data))
        last = 0 if transfer.rest else _LAST
        answer = bytes((Response.UPLOAD_SEGMENT | transfer.toggle | unused << 1 | last,)) + data + bytes(unused)
        transfer.toggle ^= _TOGGLE
        if last:
            self._transfer = None
        return answer

    def _download(self, command: int, index: int, subindex: int, number: int, content: bytes, state: int) -> bytes:
        complete = bool(command & _COMPLETE)
        if command & _EXPEDITED:
            size = 4 - (command >> 2 & 3) if command & _SIZE_INDICATED else 4
            write(self._objects, index, subindex, complete, state, number.to_bytes(4, "little")[:size])
        else:
            if len(content) > number:
                raise SdoAbort(AbortCode.LENGTH)
            if len(content) < number:
                check_download(self._objects, index, subindex, complete, state, number)
                self._transfer = _Download(index, subindex, complete, number, bytearray(content))
            else:
                write(self._objects, index, subindex, complete, state, content)
        return _SDO.pack(Response.DOWNLOAD | command & _COMPLETE, index, subindex, 0)

    def _download_segment(self, command: int, transfer: _Download, data: bytes, state: int) -> bytes:
        _check_toggle(command, transfer)
        if len(data) == _SEGMENT_MINIMUM:
            data = data[: _SEGMENT_MINIMUM - (command >> 1 & 7)]
        transfer.data += data
        if len(transfer.data) > transfer.size:
            raise SdoAbort(AbortCode.TOO_LONG)
        if command & _LAST:
            if len(transfer.data) < transfer.size:
                raise SdoAbort(AbortCode.TOO_SHORT)
            arguments = (transfer.index, transfer.subindex, transfer.complete, state, bytes(transfer.data))
            write(self._objects, *arguments)
            self._transfer = None
        answer = bytes((Response.DOWNLOAD_SEGMENT | transfer.toggle,)) + bytes(_SEGMENT_MINIMUM)
        transfer.toggle ^= _TOGGLE
        return answer


def _check_toggle(command: int, transfer: _Upload | _Download) -> None:
    """Refuse a segment whose toggle bit equals that of the segment before (ETG.1000.6, 5.6.2.3)."""
    if command & _TOGGLE != transfer.toggle:
        raise SdoAbort(AbortCode.TOGGLE_BIT)


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
    """Lengths of the five lists."""
    ALL = 1
    RXPDO = 2
    TXPDO = 3
    REPLACEMENT = 4
    """Objects to store for a device replacement."""
    STARTUP = 5
    """Start-up parameters."""


class ValueInfo(IntFlag):
    """Optional contents of an entry description (ETG.1000.6, 5.6.3.6)."""

    ACCESS = 0x01
    CATEGORY = 0x02
    MAPPABLE = 0x04
    UNIT = 0x08
    DEFAULT = 0x10
    MINIMUM = 0x20
    MAXIMUM = 0x40


_HIGHEST_INDEX = 0xFFFF
"""Highest CoE index; numbers above it are PDOs without their own index."""
_ALWAYS_REPORTED = ValueInfo.ACCESS | ValueInfo.CATEGORY | ValueInfo.MAPPABLE
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
        # Even, so that no index is split between two fragments.
        self._fragment_size = (send_size - MAILBOX_AND_COE_HEADER - _HEADER.size) & ~1
        self._services: dict[int, tuple[Operation, Callable[[bytes], bytes]]] = {
            Operation.LIST_REQUEST: (Operation.LIST_RESPONSE, self._list),
            Operation.OBJECT_REQUEST: (Operation.OBJECT_RESPONSE, self._object),
            Operation.ENTRY_REQUEST: (Operation.ENTRY_RESPONSE, self._entry),
        }

    def answer(self, request: bytes) -> list[bytes]:
        """Return the fragments of the answer to `request` (six bytes or more), without CoE header."""
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
        remaining = range(len(parts) - 1, -1, -1)
        return [
            _HEADER.pack(operation | (_INCOMPLETE if after else 0), 0, after) + part
            for part, after in zip(parts, remaining, strict=True)
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
        """Return the indices of a list; the lists for replacement and start-up are always empty."""
        if kind == ListType.ALL:
            return [obj.index for obj in self._objects if obj.index <= _HIGHEST_INDEX]
        wanted = {ListType.RXPDO: Access.RXPDO, ListType.TXPDO: Access.TXPDO}.get(kind, Access(0))
        return [obj.index for obj in self._objects if any(entry.access & wanted for entry in obj.entries.values())]

    def _object(self, request: bytes) -> bytes:
        """Return index, data type, highest subindex, object code and name."""
        (index,) = struct.unpack_from("<H", request)
        obj = self._objects.object(index)
        head = _OBJECT.pack(index, _data_type(obj), obj.highest_subindex, obj.code)
        return head + obj.name.encode("ascii", "replace")

    def _entry(self, request: bytes) -> bytes:
        """Return the description of an entry with the available part of the requested value information."""
        if len(request) < _ENTRY_REQUEST.size:
            raise SdoAbort(AbortCode.LENGTH)
        index, subindex, requested = _ENTRY_REQUEST.unpack_from(request)
        if 0 < subindex < self._objects.object(index).highest_subindex and (index, subindex) not in self._objects:
            # A gap in a record has no type, bits or rights: masters continue after it, but treat an abort as a fault.
            return _ENTRY.pack(index, subindex, requested & _ALWAYS_REPORTED, 0, 0, 0)
        entry = self._objects[index, subindex]
        reported, limits = _limits(entry, ValueInfo(requested & 0x7F))
        head = _ENTRY.pack(index, subindex, reported, entry.data_type, entry.bit_length, entry.access)
        return head + limits + entry.name.encode("ascii", "replace")


def _limits(entry: Entry, requested: ValueInfo) -> tuple[ValueInfo, bytes]:
    """Return the reported part of `requested`, and the bytes of minimum and maximum."""
    reported, data = requested & _ALWAYS_REPORTED, b""
    for flag, limit in ((ValueInfo.MINIMUM, entry.minimum), (ValueInfo.MAXIMUM, entry.maximum)):
        if flag & requested and limit is not None:
            reported |= flag
            data += encode(entry, limit).ljust(byte_size(entry), b"\0")
    return reported, data


def _data_type(obj: DictionaryObject) -> int:
    """Return the data type of a variable, of an array's elements, or of a record."""
    if obj.code == ObjectCode.RECORD:
        return _RECORD_TYPES.get(obj.index, 0)
    return obj.entries[obj.highest_subindex].data_type
