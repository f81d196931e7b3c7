"""File access over EtherCAT (ETG.1000.6, 5.8): the slave's side, one transfer at a time."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum

from rtcp.virtual.behaviour import FileBusy, FileRefused, FoeError, HookFailed, Runner

_HEADER = struct.Struct("<BxI")
"""Operation code and password, packet number or error code."""
_BUSY = struct.Struct("<BxHH")
LARGEST_FILE = 1 << 26
"""Upper bound on a file written by a master, bytes."""
_MAILBOX_HEADER = 6


class Operation(IntEnum):
    """Operation codes (ETG.1000.6, 5.8.1)."""

    READ = 1
    WRITE = 2
    DATA = 3
    ACKNOWLEDGE = 4
    ERROR = 5
    BUSY = 6


class FoeServer:
    """The FoE server of a slave; its behaviour receives and provides the files."""

    def __init__(self, runner: Runner) -> None:
        self._runner = runner
        self.open(0)

    def open(self, receive_size: int) -> None:
        """Reset for a mailbox of `receive_size` bytes, including headers."""
        self._most_received = receive_size - _MAILBOX_HEADER - _HEADER.size
        self._end()

    def _end(self) -> None:
        """Reset the transfer."""
        self._name: str | None = None
        """Name of the file being written."""
        self._received = bytearray()
        self._unacknowledged: bytes | None = None
        """Part of a file being read that is not acknowledged yet."""
        self._packet = 0

    def __call__(self, message: bytes, room: int) -> Iterator[bytes]:
        """Yield the answer to a message, if any, of at most `room` bytes."""
        try:
            answer = self._answer(message, room - _HEADER.size)
        except FileRefused as refused:
            self._end()
            text = refused.text.encode("utf-8", "replace")[: max(0, room - _HEADER.size)]
            answer = _HEADER.pack(Operation.ERROR, refused.code) + text
        except FileBusy as busy:
            answer = _BUSY.pack(Operation.BUSY, busy.done, busy.entire)
        except HookFailed:
            self._end()
            answer = _HEADER.pack(Operation.ERROR, FoeError.PROGRAM_ERROR)
        if answer is not None:
            yield answer

    def _answer(self, message: bytes, most: int) -> bytes | None:
        if len(message) < _HEADER.size:
            raise FileRefused(FoeError.ILLEGAL, "message too short")
        operation, number = _HEADER.unpack_from(message)
        content = message[_HEADER.size :]
        if operation == Operation.READ:
            return self._begin_read(content, most)
        if operation == Operation.ACKNOWLEDGE and self._unacknowledged is not None:
            return self._continue_read(number, most)
        if operation == Operation.WRITE:
            self._end()
            self._name = _name(content)
            return _HEADER.pack(Operation.ACKNOWLEDGE, 0)
        if operation == Operation.DATA and self._name is not None:
            return self._continue_write(number, content)
        if operation not in (Operation.ERROR, Operation.ACKNOWLEDGE):
            raise FileRefused(FoeError.ILLEGAL)
        # An error message of the master, or a late acknowledgement.
        self._end()
        return None

    def _begin_read(self, content: bytes, most: int) -> bytes:
        self._name = None
        file = self._runner.read_file(_name(content))
        if file is None:
            raise FileRefused(FoeError.NOT_FOUND, "file not found")
        self._unacknowledged, self._packet = file, 1
        return _HEADER.pack(Operation.DATA, 1) + self._unacknowledged[:most]

    def _continue_read(self, number: int, most: int) -> bytes | None:
        assert self._unacknowledged is not None
        if number != self._packet:
            raise FileRefused(FoeError.PACKET_NUMBER, f"packet {number} acknowledged, {self._packet} was sent")
        if len(self._unacknowledged) < most:
            self._end()  # that was the last packet
            return None
        self._unacknowledged = self._unacknowledged[most:]
        self._packet += 1
        return _HEADER.pack(Operation.DATA, self._packet) + self._unacknowledged[:most]

    def _continue_write(self, number: int, content: bytes) -> bytes:
        assert self._name is not None
        if number != self._packet + 1:
            raise FileRefused(FoeError.PACKET_NUMBER, f"packet {number} came, {self._packet + 1} was expected")
        if len(self._received) + len(content) > LARGEST_FILE:
            raise FileRefused(FoeError.DISK_FULL, f"at most {LARGEST_FILE} bytes")
        if len(content) < self._most_received:
            # A busy behaviour gets the file again when the master repeats the packet.
            self._runner.on_file(self._name, bytes(self._received) + content)
            self._name = None
        else:
            self._received += content
        self._packet = number
        return _HEADER.pack(Operation.ACKNOWLEDGE, number)


def _name(content: bytes) -> str:
    return content.split(b"\0", 1)[0].decode("utf-8", "replace")
