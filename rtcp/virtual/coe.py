"""CoE: services, SDO transfers and emergency messages (ETG.1000.6, 5.6)."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import IntEnum

from rtcp.virtual.abort import AbortCode
from rtcp.virtual.device import Emergency
from rtcp.virtual.objects import ObjectDictionary, SdoAbort
from rtcp.virtual.sdo_access import check_download, read, write
from rtcp.virtual.slave_faults import SlaveFaults

MAILBOX_AND_COE_HEADER = 8
"""Bytes of a mailbox message before the SDO: six of the mailbox header, two of the CoE header."""


class CoeService(IntEnum):
    """Services in the CoE header (ETG.1000.6, table 28)."""

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
        """The two bytes of a CoE header with this service and number 0."""
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
"""A segment has at least seven bytes of data, unused ones counted in bits 1 to 3 of the command."""
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
"""First byte of an answer that is an abort."""


class SdoServer:
    """The SDO server of a slave: one transfer at a time, expedited, normal or segmented (ETG.1000.6, 5.6.2)."""

    MINIMUM_REQUEST = 10
    """Bytes of the shortest request, CoE header included."""

    def __init__(self, objects: ObjectDictionary, send_size: int, faults: SlaveFaults | None = None) -> None:
        """Serve `objects` through a send mailbox of `send_size` bytes."""
        self._objects = objects
        self._faults = SlaveFaults() if faults is None else faults
        self._segment_size = send_size - MAILBOX_AND_COE_HEADER - 1
        self._normal_size = send_size - MAILBOX_AND_COE_HEADER - _SDO.size
        self._transfer: _Upload | _Download | None = None

    def reset(self) -> None:
        """Forget a transfer that is under way."""
        self._transfer = None

    def answer(self, request: bytes, state: int) -> bytes | None:
        """Return the answer to `request` (eight bytes or more), both without CoE header; None to an abort.

        `state` is the AL state that decides on access rights.
        """
        command, index, subindex, number = _SDO.unpack_from(request)
        specifier = command >> 5
        transfer = self._transfer
        if specifier in (Request.UPLOAD_SEGMENT, Request.DOWNLOAD_SEGMENT) and transfer is not None:
            # A segment carries data where other requests carry index and subindex.
            index, subindex = transfer.index, transfer.subindex
        else:
            self._transfer = None
        try:
            if specifier != Request.ABORT and (code := self._faults.sdo_abort(index)):
                raise SdoAbort(code)
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

    def _download(self, command: int, index: int, subindex: int, number: int, rest: bytes, state: int) -> bytes:
        complete = bool(command & _COMPLETE)
        if command & _EXPEDITED:
            size = 4 - (command >> 2 & 3) if command & _SIZE_INDICATED else 4
            write(self._objects, index, subindex, complete, state, number.to_bytes(4, "little")[:size])
        else:
            if len(rest) > number:
                raise SdoAbort(AbortCode.LENGTH)
            if len(rest) < number:
                check_download(self._objects, index, subindex, complete, state, number)
                self._transfer = _Download(index, subindex, complete, number, bytearray(rest))
            else:
                write(self._objects, index, subindex, complete, state, rest)
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
    """Refuse a segment whose toggle bit is not the other of the segment before (ETG.1000.6, 5.6.2.3)."""
    if command & _TOGGLE != transfer.toggle:
        raise SdoAbort(AbortCode.TOGGLE_BIT)
