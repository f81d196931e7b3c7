"""SDO access to one slave, every failure a sentence (ETG.1000.6, 5.6.2).

Not through SOEM: beside the cycle its functions poll without a pause, and an abort that a slave sends as an SDO
response (some do; the standard says request) is a success to its download and a wrong length to its upload.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable

from rtcp.fieldbus.abort import abort_meaning
from rtcp.fieldbus.bus import BusError, SdoAborted, slave_label
from rtcp.fieldbus.mailbox import Mailbox
from rtcp.fieldbus.steps import Steps, T, finish, pause

_RETRY_S = 0.01
_TIMEOUT_S = 0.7
_PATIENCE_S = 3.0
"""For the mailbox, while another service of the same slave is under way."""
_SDO = struct.Struct("<BHBI")
_COE_HEADER = 2
_REQUEST, _RESPONSE = 2, 3
"""CoE services (ETG.1000.6, table 28)."""
_EXPEDITED, _SIZED, _TOGGLE, _LAST = 0x02, 0x01, 0x10, 0x01
_DOWNLOAD, _DOWNLOAD_SEGMENT, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 0x20, 0x00, 0x40, 0x60, 0x80
"""Commands of the client (upper three bits)."""
_UPLOADED, _UPLOADED_SEGMENT, _DOWNLOADED, _DOWNLOADED_SEGMENT = 0x40, 0x00, 0x60, 0x20
"""Commands of the server."""
_SPECIFIER = 0xE0
_SEGMENT_DATA = 7
"""Bytes of data that a segment has at least, filled up (ETG.1000.6, 5.6.2.5 and 5.6.2.3)."""
_LARGEST_OBJECT = 1 << 16
"""Bytes; no object of a drive or a terminal comes near it."""


class SdoClient:
    """Reads and writes objects of a slave, one service at a time: at once (`read`) or in steps (`reading`)."""

    def __init__(
        self,
        mailbox: Mailbox | None,
        position: int,
        name: str,
        lock: threading.Lock,
        other: Callable[[bytes, int], None],
    ) -> None:
        """Take the mailbox of the slave at `position` (from 1); None where it has none for CoE.

        Args:
            mailbox: the slave's mailbox.
            position: position of the slave on the cable, from 1.
            name: name of the slave.
            lock: the lock of this slave's mailbox.
            other: takes CoE messages that are no SDO (emergencies), with the slave's position.
        """
        self.position = position
        self.name = name
        self._mailbox = mailbox
        self._lock = lock
        self._other = other

    def read(self, index: int, subindex: int) -> bytes:
        """Return an object's value.

        Raises:
            SdoAborted: the slave refused.
            BusError: the slave did not answer.
        """
        return finish(self.reading(index, subindex))

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object's value; raises as `read`."""
        finish(self.writing(index, subindex, data))

    def reading(self, index: int, subindex: int) -> Steps[bytes]:
        """Return an object's value; raises as `read`."""
        return self._call(f"read of 0x{index:04X}:{subindex}", lambda box: self._upload(box, index, subindex))

    def writing(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """Write an object's value; raises as `read`."""
        shown = data.hex(" ") if len(data) <= 8 else f"{len(data)} bytes"
        what = f"write of {shown or 'nothing'} to 0x{index:04X}:{subindex}"
        return self._call(what, lambda box: self._download(box, index, subindex, data))

    def reading_int(self, index: int, subindex: int) -> Steps[int]:
        """Return an object's value as an unsigned integer; raises as `read`."""
        return int.from_bytes((yield from self.reading(index, subindex)), "little")

    def writing_int(self, index: int, subindex: int, value: int, length: int) -> Steps[None]:
        """Write an unsigned integer of `length` bytes; raises as `read`."""
        return self.writing(index, subindex, value.to_bytes(length, "little"))

    def _call(self, what: str, service: Callable[[Mailbox], Steps[T]]) -> Steps[T]:
        where = slave_label(self.position, self.name)
        if self._mailbox is None:
            raise BusError(f"{where}: {what} is not possible, its EEPROM tells of no CoE mailbox")
        deadline = time.monotonic() + _PATIENCE_S
        while not self._lock.acquire(blocking=False):
            if time.monotonic() >= deadline:
                raise BusError(f"{where}, {what}: its mailbox is in use by others")
            yield
        try:
            until = time.monotonic() + self._mailbox.patience_s
            tried_again = False
            while True:
                try:
                    return (yield from service(self._mailbox))
                except SdoAborted as error:
                    raise SdoAborted(f"{where} refused the {what}: {error}", error.code) from error
                except BusError as error:
                    # Its messages are sent and fetched once only each: of many frames that get lost some are theirs.
                    if tried_again and time.monotonic() >= until:
                        raise BusError(f"{where}, {what}: {error}") from error
                tried_again = True
                # An immediate second try may fail where one a little later works (SOEM#825).
                yield from pause(_RETRY_S)
        finally:
            self._lock.release()

    def _exchange(
        self, mailbox: Mailbox, request: bytes, specifier: int, address: tuple[int, int] | None
    ) -> Steps[bytes]:  # fmt: skip
        """Return the answer to an SDO request, from its command on; `address`: index and subindex it must repeat."""
        deadline = time.monotonic() + _TIMEOUT_S
        # What is left of an earlier service, or an emergency, would be taken for the answer.
        while (left := mailbox.receive()) is not None:
            self._other(left, self.position)
            _check_time(deadline, "its mailbox does not get empty")
        while not mailbox.send((_REQUEST << 12).to_bytes(2, "little") + request):
            if time.monotonic() >= deadline:
                raise BusError("its mailbox stays full")
            yield
        while True:
            if (message := mailbox.receive()) is None:
                if time.monotonic() >= deadline:
                    raise BusError("no answer in time")
                yield
                continue
            if len(message) < _COE_HEADER + _SDO.size or message[1] >> 4 not in {_REQUEST, _RESPONSE}:
                self._other(message, self.position)
                _check_time(deadline, "no answer in time, but other messages")
                continue
            command, index, subindex, number = _SDO.unpack_from(message, _COE_HEADER)
            if command == _ABORT:
                raise SdoAborted(f"abort code 0x{number:08X}, {abort_meaning(number)}", number)
            if command & _SPECIFIER != specifier or (address is not None and address != (index, subindex)):
                raise BusError(f"it answered something else (command 0x{command:02X})")
            return message[_COE_HEADER:]

    def _upload(self, mailbox: Mailbox, index: int, subindex: int) -> Steps[bytes]:
        request = _SDO.pack(_UPLOAD, index, subindex, 0)
        answer = yield from self._exchange(mailbox, request, _UPLOADED, (index, subindex))
        command, _, _, size = _SDO.unpack_from(answer)
        if command & _EXPEDITED:
            return answer[4 : 8 - (command >> 2 & 3) if command & _SIZED else 8]
        if size > _LARGEST_OBJECT:
            raise BusError(f"it tells of {size} bytes; at most {_LARGEST_OBJECT} are read")
        data = bytearray(answer[8:])
        toggle = 0
        while len(data) < size:
            request = _SDO.pack(_UPLOAD_SEGMENT | toggle, 0, 0, 0)
            answer = yield from self._exchange(mailbox, request, _UPLOADED_SEGMENT, None)
            command = answer[0]
            if command & _TOGGLE != toggle:
                raise BusError("it repeated a segment")
            part = answer[1:]
            # Seven bytes or fewer: the command tells how many of them count.
            data += part[: _SEGMENT_DATA - (command >> 1 & 7)] if len(part) == _SEGMENT_DATA else part
            toggle ^= _TOGGLE
            if command & _LAST:
                break
            if len(answer) < 2 or (len(part) == _SEGMENT_DATA and command >> 1 & 7 == _SEGMENT_DATA):
                raise BusError("it sent a segment without data")
        return bytes(data[:size])

    def _download(self, mailbox: Mailbox, index: int, subindex: int, data: bytes) -> Steps[None]:
        if 1 <= len(data) <= 4:
            command = _DOWNLOAD | _EXPEDITED | _SIZED | (4 - len(data)) << 2
            request = _SDO.pack(command, index, subindex, 0)[:4] + data.ljust(4, b"\0")
            yield from self._exchange(mailbox, request, _DOWNLOADED, (index, subindex))
            return
        first = mailbox.room - _COE_HEADER - _SDO.size
        request = _SDO.pack(_DOWNLOAD | _SIZED, index, subindex, len(data)) + data[:first]
        yield from self._exchange(mailbox, request, _DOWNLOADED, (index, subindex))
        size = mailbox.room - _COE_HEADER - 1
        toggle = 0
        for start in range(first, len(data), size):
            part = data[start : start + size]
            missing = max(_SEGMENT_DATA - len(part), 0)
            last = _LAST if start + size >= len(data) else 0
            request = bytes((_DOWNLOAD_SEGMENT | toggle | missing << 1 | last,)) + part.ljust(_SEGMENT_DATA, b"\0")
            yield from self._exchange(mailbox, request, _DOWNLOADED_SEGMENT, None)
            toggle ^= _TOGGLE


def _check_time(deadline: float, sentence: str) -> None:
    if time.monotonic() >= deadline:
        raise BusError(sentence)
