"""Mailboxes of the slaves: SDO access and emergency messages (ETG.1000.4, 5.6; ETG.1000.6, 5.6.2).

Not through SOEM: some slaves send an abort as an SDO response instead of a request, which SOEM's download takes for a
success and its upload for a wrong length; and its functions cannot run in steps.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import ClassVar

from rtcp.fieldbus.bus import MailboxInfo, slave_label, station_of
from rtcp.fieldbus.errors import BusError, Refused, SdoAborted
from rtcp.fieldbus.registers import DatagramCommand, Register, RegisterPort, Steps, T, finish, pause
from rtcp.ipc.events import EmergencyMessage, ErrorReset

_RETRY_S = 0.01
"""Pause before a service is tried again, s."""
_TIMEOUT_S = 0.7
"""Longest time for the answer to one request, s."""
_PATIENCE_S = 3.0
"""Longest wait for another service of the same slave to end, s."""
_SDO = struct.Struct("<BHBI")
_EMERGENCY_MESSAGE = struct.Struct("<HHB5s")
_COE_HEADER = 2
_EMERGENCY, _REQUEST, _RESPONSE, _INFORMATION = 1, 2, 3, 8
"""CoE services (ETG.1000.6, table 29)."""
_INFORMATION_HEADER = struct.Struct("<BxH")
"""Operation code with the flag for further fragments; number of fragments left."""
_INCOMPLETE, _INFORMATION_ERROR = 0x80, 7
_EXPEDITED, _SIZED, _TOGGLE, _LAST, _COMPLETE = 0x02, 0x01, 0x10, 0x01, 0x10
_DOWNLOAD, _DOWNLOAD_SEGMENT, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 0x20, 0x00, 0x40, 0x60, 0x80
"""Commands of the client (upper three bits)."""
_UPLOADED, _UPLOADED_SEGMENT, _DOWNLOADED, _DOWNLOADED_SEGMENT = 0x40, 0x00, 0x60, 0x20
"""Commands of the server."""
_SPECIFIER = 0xE0
_SEGMENT_DATA = 7
"""Least data of a segment, padded, bytes (ETG.1000.6, 5.6.2.5 and 5.6.2.3)."""
_LARGEST_OBJECT = 1 << 16
"""Largest accepted object, bytes; objects of drives and terminals are far smaller."""


class MailboxClient:
    """One protocol of a slave's mailbox, one service at a time.

    Args:
        mailbox: the slave's mailbox; None: it has none for the protocol.
        position: position of the slave on the cable, from 1.
        name: name of the slave.
        lock: the lock of this slave's mailbox.
        receive_coe: receives CoE messages that are not the answer (emergencies), with the slave's position.
    """

    protocol: ClassVar[str]
    tries: ClassVar[int]
    """Least number of attempts of a service whose messages get lost."""
    is_patient: ClassVar[bool] = True
    """Whether more attempts follow until the slave's patience ends; a transfer of a file begins anew each time."""

    def __init__(
        self,
        mailbox: Mailbox | None,
        position: int,
        name: str,
        lock: threading.Lock,
        receive_coe: Callable[[bytes, int], None],
    ) -> None:
        self.position = position
        self.name = name
        self._mailbox = mailbox
        self._lock = lock
        self._receive_coe = receive_coe

    def _call(self, task: str, service: Callable[[Mailbox], Steps[T]]) -> Steps[T]:
        where = slave_label(self.position, self.name)
        if self._mailbox is None:
            raise BusError(f"{where}: {task} is not possible, its EEPROM lists no {self.protocol} mailbox")
        deadline = time.monotonic() + _PATIENCE_S
        while not self._lock.acquire(blocking=False):
            if time.monotonic() >= deadline:
                raise BusError(f"{where}, {task}: its mailbox is in use by others")
            yield
        try:
            until = time.monotonic() + self._mailbox.patience_s
            attempt = 0
            while True:
                attempt += 1
                try:
                    return (yield from service(self._mailbox))
                except Refused as error:
                    raise type(error)(f"{where} refused the {task}: {error}", error.code) from error
                except BusError as error:
                    # Each message is sent and fetched once only, so a lost frame fails the attempt.
                    if attempt >= self.tries and (not self.is_patient or time.monotonic() >= until):
                        raise BusError(f"{where}, {task}: {error}") from error
                # An immediate second attempt may fail where one a little later works (SOEM#825).
                yield from pause(_RETRY_S)
        finally:
            self._lock.release()


class SdoClient(MailboxClient):
    """Reads and writes objects of a slave: at once (`read`) or in steps (`reading`)."""

    protocol, tries = "CoE", 2

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

    def reading(self, index: int, subindex: int, complete: bool = False) -> Steps[bytes]:
        """Return an object's value; `complete`: complete access from `subindex`, 0 or 1, on. Raises as `read`."""
        how = ", complete access" if complete else ""
        return self._call(
            f"read of 0x{index:04X}:{subindex}{how}", lambda box: self._upload(box, index, subindex, complete)
        )

    def writing(self, index: int, subindex: int, data: bytes, complete: bool = False) -> Steps[None]:
        """Write an object's value; `complete` as in `reading`. Raises as `read`."""
        value = data.hex(" ") if len(data) <= 8 else f"{len(data)} bytes"
        task = f"write of {value or 'nothing'} to 0x{index:04X}:{subindex}{', complete access' if complete else ''}"
        return self._call(task, lambda box: self._download(box, index, subindex, data, complete))

    def reading_int(self, index: int, subindex: int) -> Steps[int]:
        """Return an object's value as an unsigned integer; raises as `read`."""
        return int.from_bytes((yield from self.reading(index, subindex)), "little")

    def writing_int(self, index: int, subindex: int, value: int, length: int) -> Steps[None]:
        """Write an unsigned integer of `length` bytes; raises as `read`."""
        return self.writing(index, subindex, value.to_bytes(length, "little"))

    def information(self, service: int, data: bytes) -> Steps[bytes]:
        """Return the answer to a service of SDO information (ETG.1000.6, 5.6.3), fragments joined; raises as `read`.

        Args:
            service: operation code of the request; the answer has the next one.
            data: content of the request after its header.
        """
        task = f"SDO information {service} of {data.hex(' ')}"
        return self._call(task, lambda box: self._information(box, service, data))

    def _information(self, mailbox: Mailbox, service: int, data: bytes) -> Steps[bytes]:
        deadline = time.monotonic() + _TIMEOUT_S
        yield from self._send_alone(mailbox, _INFORMATION, _INFORMATION_HEADER.pack(service, 0) + data, deadline)
        answer = b""
        while True:
            message = yield from self._receive(mailbox, (_INFORMATION,), _INFORMATION_HEADER.size, deadline)
            operation, left = _INFORMATION_HEADER.unpack_from(message, _COE_HEADER)
            content = message[_COE_HEADER + _INFORMATION_HEADER.size :]
            if operation & 0x7F == _INFORMATION_ERROR:
                code = int.from_bytes(content[:4], "little")
                raise SdoAborted(f"abort code 0x{code:08X}, {abort_meaning(code)}", code)
            if operation & 0x7F != service + 1:
                raise BusError(f"it answered something else (operation {operation & 0x7F})")
            answer += content
            if not operation & _INCOMPLETE or not left:
                return answer
            deadline = time.monotonic() + _TIMEOUT_S

    def _receive(self, mailbox: Mailbox, services: tuple[int, ...], size: int, deadline: float) -> Steps[bytes]:
        """Return the next message of these CoE services with at least `size` bytes behind its CoE header."""
        while True:
            if (message := mailbox.receive()) is None:
                check_time(deadline, "no answer in time")
                yield
            elif len(message) >= _COE_HEADER + size and message[1] >> 4 in services:
                return message
            else:
                self._receive_coe(message, self.position)
                check_time(deadline, "no answer in time, but other messages")

    def _send_alone(self, mailbox: Mailbox, service: int, request: bytes, deadline: float) -> Steps[None]:
        """Empty the slave's mailbox, so that no old message is taken for the answer, and send a request."""
        while (left := mailbox.receive()) is not None:
            self._receive_coe(left, self.position)
            check_time(deadline, "its mailbox does not get empty")
        while not mailbox.send((service << 12).to_bytes(2, "little") + request):
            check_time(deadline, "its mailbox stays full")
            yield

    def _exchange(
        self, mailbox: Mailbox, request: bytes, specifier: int, address: tuple[int, int] | None
    ) -> Steps[bytes]:  # fmt: skip
        """Return the answer to an SDO request, from its command on; `address`: expected index and subindex in it."""
        deadline = time.monotonic() + _TIMEOUT_S
        yield from self._send_alone(mailbox, _REQUEST, request, deadline)
        message = yield from self._receive(mailbox, (_REQUEST, _RESPONSE), _SDO.size, deadline)
        command, index, subindex, number = _SDO.unpack_from(message, _COE_HEADER)
        if command == _ABORT:
            raise SdoAborted(f"abort code 0x{number:08X}, {abort_meaning(number)}", number)
        if command & _SPECIFIER != specifier or (address is not None and address != (index, subindex)):
            raise BusError(f"it answered something else (command 0x{command:02X})")
        return message[_COE_HEADER:]

    def _upload(self, mailbox: Mailbox, index: int, subindex: int, complete: bool) -> Steps[bytes]:
        request = _SDO.pack(_UPLOAD | complete * _COMPLETE, index, subindex, 0)
        answer = yield from self._exchange(mailbox, request, _UPLOADED, (index, subindex))
        command, _, _, size = _SDO.unpack_from(answer)
        if command & _EXPEDITED:
            return answer[4 : 8 - (command >> 2 & 3) if command & _SIZED else 8]
        if size > _LARGEST_OBJECT:
            raise BusError(f"it announces {size} bytes; at most {_LARGEST_OBJECT} are read")
        data = bytearray(answer[8:])
        toggle = 0
        while len(data) < size:
            request = _SDO.pack(_UPLOAD_SEGMENT | toggle, 0, 0, 0)
            answer = yield from self._exchange(mailbox, request, _UPLOADED_SEGMENT, None)
            command = answer[0]
            if command & _TOGGLE != toggle:
                raise BusError("it repeated a segment")
            part = answer[1:]
            # In a segment of seven bytes the command gives the number of unused ones.
            data += part[: _SEGMENT_DATA - (command >> 1 & 7)] if len(part) == _SEGMENT_DATA else part
            toggle ^= _TOGGLE
            if command & _LAST:
                break
            if len(answer) < 2 or (len(part) == _SEGMENT_DATA and command >> 1 & 7 == _SEGMENT_DATA):
                raise BusError("it sent a segment without data")
        return bytes(data[:size])

    def _download(self, mailbox: Mailbox, index: int, subindex: int, data: bytes, complete: bool) -> Steps[None]:
        if 1 <= len(data) <= 4 and not complete:
            command = _DOWNLOAD | _EXPEDITED | _SIZED | (4 - len(data)) << 2
            request = _SDO.pack(command, index, subindex, 0)[:4] + data.ljust(4, b"\0")
            yield from self._exchange(mailbox, request, _DOWNLOADED, (index, subindex))
            return
        first = mailbox.room - _COE_HEADER - _SDO.size
        command = _DOWNLOAD | _SIZED | complete * _COMPLETE
        request = _SDO.pack(command, index, subindex, len(data)) + data[:first]
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


def check_time(deadline: float, sentence: str) -> None:
    """Raise BusError with this sentence once `deadline` (time.monotonic) has passed."""
    if time.monotonic() >= deadline:
        raise BusError(sentence)


ABSENT = frozenset((0x06020000, 0x06090011))
"""Abort codes of an object or a subindex that does not exist."""

ABORT_CODES: dict[int, str] = {
    0x05030000: "toggle bit not changed",
    0x05040000: "SDO protocol timeout",
    0x05040001: "command specifier not valid or unknown",
    0x05040005: "out of memory",
    0x06010000: "unsupported access to an object",
    0x06010001: "attempt to read a write-only object",
    0x06010002: "attempt to write a read-only object",
    0x06010003: "subindex cannot be written, subindex 0 must be 0 first",
    0x06010004: "complete access not supported for objects of variable length",
    0x06010005: "object longer than the mailbox",
    0x06010006: "object is mapped to an RxPDO, download blocked",
    0x06020000: "the object does not exist",
    0x06040041: "the object cannot be mapped into the PDO",
    0x06040042: "number and length of the mapped objects exceed the PDO",
    0x06040043: "general parameter incompatibility",
    0x06040047: "general internal incompatibility of the device",
    0x06060000: "access failed because of a hardware error",
    0x06070010: "data type does not match: length differs",
    0x06070012: "data type does not match: too long",
    0x06070013: "data type does not match: too short",
    0x06090011: "the subindex does not exist",
    0x06090030: "value out of range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06090036: "maximum below minimum",
    0x08000000: "general error",
    0x08000020: "data cannot be transferred or stored",
    0x08000021: "data cannot be transferred or stored: local control",
    0x08000022: "data cannot be transferred or stored in the present state of the device",
    0x08000023: "no object dictionary is present",
}


def abort_meaning(code: int) -> str:
    """Return what an abort code means."""
    return ABORT_CODES.get(code, "not in the standard")


_SM0_STATUS, _SM1_STATUS, _FULL = Register.SYNC_MANAGER + 5, Register.SYNC_MANAGER + 13, 0x08
_SM1_ACTIVATE, _SM1_PDI_CONTROL, _REPEAT = Register.SYNC_MANAGER + 14, Register.SYNC_MANAGER + 15, 0x02
"""Repeat request, and repeat acknowledge, which the slave toggles (ETG.1000.4, 6.7.1)."""
_ENABLED = 0x01
"""Bit of the same register: the sync manager works."""
_MOST_READS = 20
"""Most reads of the repeat acknowledge."""
_HEADER = struct.Struct("<HHBB")


class MailboxType(IntEnum):
    """Protocols of a mailbox message (ETG.1000.4, table 29)."""

    ERROR = 0
    COE = 3
    FOE = 4


_TYPES = {kind.value: kind for kind in MailboxType}
# Detail codes of a mailbox error reply (ETG.1000.4, table 30)
_ERRORS = {
    1: "syntax of the mailbox header is wrong",
    2: "the protocol is not supported",
    3: "the channel is wrong",
    4: "the service is not supported",
    5: "the header is invalid",
    6: "the message is too short",
    7: "no memory",
    8: "the length is inconsistent",
}


class Mailbox:
    """Mailbox messages to and from one slave. It waits for frames only, never for the slave."""

    def __init__(self, port: RegisterPort, station: int, info: MailboxInfo) -> None:
        """Use the mailbox of the slave at configured address `station`."""
        self._port = port
        self._station = station
        self._info = info

    @property
    def room(self) -> int:
        """Largest content of a message to the slave, bytes after the mailbox header."""
        return self._info.receive_size - _HEADER.size

    @property
    def patience_s(self) -> float:
        """Time for which a service whose messages get lost is repeated, s."""
        return self._port.patience_s

    @property
    def sent_room(self) -> int:
        """Largest content of a message from the slave, bytes after the mailbox header."""
        return self._info.send_size - _HEADER.size

    def send(self, content: bytes, kind: MailboxType = MailboxType.COE) -> bool:
        """Send the slave a message; return False while its mailbox is still full.

        Args:
            content: bytes after the mailbox header, at most `room`.
            kind: its protocol.

        Raises:
            BusError: the slave does not answer, or the content does not fit its mailbox.
        """
        if len(content) > self.room:
            raise BusError(f"a message of {len(content)} bytes does not fit into its mailbox: at most {self.room}")
        if self._is_full(_SM0_STATUS):
            return False
        # Slaves do not check counter 0; SOEM counts its own messages from 1 to 7 (ETG.1000.4, table 29).
        message = _HEADER.pack(len(content), 0, 0, kind) + content
        message = message.ljust(self._info.receive_size, b"\0")
        # Once only: a lost frame may have reached the slave.
        start = self._info.receive_start
        if self._port.exchange(DatagramCommand.FPWR, self._station, start, message, tries=1).wkc != 1:
            raise BusError("it did not take the message")
        return True

    def receive(self) -> bytes | None:
        """Return a waiting CoE message, CoE header first, None where there is none; raises as `receive_any`."""
        message = self.receive_any()
        return None if message is None or message[0] is not MailboxType.COE else message[1]

    def receive_any(self) -> tuple[MailboxType | None, bytes] | None:
        """Return protocol (None: unknown) and content of a waiting message, None where there is none.

        Raises:
            BusError: the slave answered with a mailbox error, or its message got lost.
        """
        if not self._is_full(_SM1_STATUS):
            return None
        # Once only: reading the last byte empties the mailbox.
        message = self._read() or self._read_again()
        if message is None:
            raise BusError("its message got lost")
        length, _, _, kind = _HEADER.unpack_from(message)
        content = message[_HEADER.size : _HEADER.size + length]
        if kind & 0x0F == MailboxType.ERROR:
            code = int.from_bytes(content[2:4], "little")
            raise BusError(f"mailbox error {code}: {_ERRORS.get(code, 'not in the standard')}")
        return _TYPES.get(kind & 0x0F), content

    def _read(self) -> bytes | None:
        return self._port.read(self._station, self._info.send_start, self._info.send_size, tries=1)

    def _read_again(self) -> bytes | None:
        """Return a message whose frame got lost: still in the mailbox, or repeated by the slave; None: neither."""
        if not self._is_full(_SM1_STATUS):
            control = self._port.read(self._station, _SM1_ACTIVATE, 1)
            if control is None:
                return None
            # Of what was read only the bit to toggle is used: a false bit 0 would switch the mailbox off.
            toggled = bytes((_ENABLED | (control[0] ^ _REPEAT) & _REPEAT,))
            if not self._port.write(self._station, _SM1_ACTIVATE, toggled):
                return None
            states = (self._port.read(self._station, _SM1_PDI_CONTROL, 1) for _ in range(_MOST_READS))
            if not any(state is not None and not (state[0] ^ toggled[0]) & _REPEAT for state in states):
                return None
            if not self._is_full(_SM1_STATUS):
                return None
        return self._read()

    def _is_full(self, register: int) -> bool:
        status = self._port.read(self._station, register, 1)
        if status is None:
            raise BusError("it does not answer")
        return bool(status[0] & _FULL)


_MESSAGES_A_POLL = 8


def parse_emergency(message: bytes, position: int) -> EmergencyMessage | None:
    """Return the emergency in a CoE message of a slave (ETG.1000.6, 5.6.4.2), None for any other message."""
    if len(message) < _EMERGENCY_MESSAGE.size:
        return None
    coe, code, register, data = _EMERGENCY_MESSAGE.unpack_from(message)
    kind = EmergencyMessage if code else ErrorReset
    return kind(position, code, register, int.from_bytes(data, "big")) if coe >> 12 == _EMERGENCY else None


class Mailboxes:
    """The mailboxes of all slaves, with a lock each: a slow slave does not block the others."""

    def __init__(self, port: RegisterPort, names: Sequence[str], infos: Sequence[MailboxInfo | None]) -> None:
        """Use these names and mailboxes of the slaves, in the order of the cable."""
        self._port = port
        self._names = names
        self._infos = infos
        self._locks = [threading.Lock() for _ in names]
        self._emergencies: deque[EmergencyMessage] = deque(maxlen=256)

    def sdo(self, position: int) -> SdoClient:
        """Return SDO access to the slave at `position`; raises BusError where there is none."""
        if not 1 <= position <= len(self._names):
            raise BusError(f"there is no slave {position}; the bus has slaves 1 to {len(self._names)}")
        info = self._infos[position - 1]
        mailbox = Mailbox(self._port, station_of(position), info) if info is not None and info.has_coe else None
        return SdoClient(mailbox, position, self._names[position - 1], self._locks[position - 1], self._keep)

    def access(self, position: int) -> tuple[threading.Lock, Callable[[bytes, int], None]]:
        """Return, for another protocol of a slave's mailbox, its lock and the receiver of CoE messages."""
        return self._locks[position - 1], self._keep

    def emergencies(self) -> tuple[EmergencyMessage, ...]:
        """Return the emergency messages received since the last call; costs one frame where there are none.

        Raises:
            BusError: a message got lost; the next call returns the others.
        """
        full = self._port.read_all(_SM1_STATUS, 1).data
        if any(byte & _FULL for byte in full):
            self._empty_all()
        messages = []
        while self._emergencies:
            messages.append(self._emergencies.popleft())
        return tuple(messages)

    def _empty_all(self) -> None:
        faults: list[str] = []
        for position, info in enumerate(self._infos, 1):
            lock = self._locks[position - 1]
            # While an SDO service runs, its client reads the mailbox and collects the emergencies.
            if info is None or not lock.acquire(blocking=False):
                continue
            try:
                self._empty(position, info)
            except BusError as error:
                faults.append(f"{slave_label(position, self._names[position - 1])}, reading its mailbox: {error}")
            finally:
                lock.release()
        if faults:
            raise BusError(*faults)

    def _empty(self, position: int, info: MailboxInfo) -> None:
        status = self._port.read(station_of(position), _SM1_STATUS, 1, tries=1)
        # The watcher handles slaves that do not answer.
        if status is None or not status[0] & _FULL:
            return
        mailbox = Mailbox(self._port, station_of(position), info)
        for _ in range(_MESSAGES_A_POLL):
            message = mailbox.receive()
            if message is None:
                return
            self._keep(message, position)

    def _keep(self, message: bytes, position: int) -> None:
        if (emergency := parse_emergency(message, position)) is not None:
            self._emergencies.append(emergency)
