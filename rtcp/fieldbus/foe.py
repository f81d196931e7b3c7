"""Files of a slave over its mailbox (ETG.1000.6, 5.8), and its mailboxes in BOOT."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable

from rtcp.fieldbus.al_state import AlState, request_state, wait_for_state
from rtcp.fieldbus.bus import MailboxInfo, slave_label
from rtcp.fieldbus.errors import BusError, FoeRefused
from rtcp.fieldbus.mailbox import Mailbox, MailboxClient, MailboxType, check_time
from rtcp.fieldbus.registers import Register, RegisterPort, Steps, T, finish, pause

FOE_ERRORS = {
    0x8000: "not defined",
    0x8001: "there is no such file",
    0x8002: "access denied",
    0x8003: "its memory is full",
    0x8004: "it does not know this operation",
    0x8005: "the packet number is wrong",
    0x8006: "the file exists already",
    0x8007: "there is no user",
    0x8008: "only in BOOT: add --boot",
    0x8009: "not in BOOT: leave --boot out",
    0x800A: "the password gives no right to it",
    0x800B: "program error",
}
"""Error codes in words (ETG.1000.6, table 92)."""
_READ, _WRITE, _DATA, _ACKNOWLEDGE, _ERROR, _BUSY = range(1, 7)
"""Operation codes (ETG.1000.6, 5.8.1)."""
_HEADER = struct.Struct("<BxI")
"""Operation code; password, packet number or error code."""
_TIMEOUT_S, _BUSY_S = 5.0, 60.0
"""Longest time for the answer to a packet (flash memory is slow), and for a slave to stay busy, s."""
_PAUSE_S = 0.01


class FoeClient(MailboxClient):
    """Reads and writes files of a slave (ETG.1000.6, 5.8)."""

    protocol, tries, is_patient = "FoE", 3, False

    def read(self, name: str, password: int, progress: Callable[[int], None]) -> bytes:
        """Return a file; `progress` receives the number of bytes read.

        Raises:
            FoeRefused: the slave refused.
            BusError: it did not answer.
        """
        request = _HEADER.pack(_READ, password) + name.encode()
        return self._transfer(f"read of file {name!r}", request, lambda box: self._reading(box, request, progress))

    def write(self, name: str, data: bytes, password: int, progress: Callable[[int], None]) -> None:
        """Write a file; `progress` receives the number of bytes written. Raises as `read`."""
        request = _HEADER.pack(_WRITE, password) + name.encode()
        return self._transfer(
            f"write of {len(data)} bytes to file {name!r}",
            request,
            lambda box: self._writing(box, request, data, progress),
        )

    def _transfer(self, task: str, request: bytes, service: Callable[[Mailbox], Steps[T]]) -> T:
        if self._mailbox is not None and len(request) > self._mailbox.room:
            room = self._mailbox.room - _HEADER.size
            raise BusError(
                f"{slave_label(self.position, self.name)}: {task} is not possible, the name has "
                f"{len(request) - _HEADER.size} bytes, its mailbox takes {room}: give a shorter name"
            )
        return finish(self._call(task, service))

    def _reading(self, box: Mailbox, request: bytes, progress: Callable[[int], None]) -> Steps[bytes]:
        data = bytearray()
        number = 1
        while True:
            answer = yield from self._exchange(box, request, _DATA, number, progress, len(data))
            data += answer
            progress(len(data))
            request = _HEADER.pack(_ACKNOWLEDGE, number)
            if len(answer) < box.sent_room - _HEADER.size:
                yield from self._send(box, request)
                return bytes(data)
            number += 1

    def _writing(self, box: Mailbox, request: bytes, data: bytes, progress: Callable[[int], None]) -> Steps[None]:
        yield from self._exchange(box, request, _ACKNOWLEDGE, 0, progress, 0)
        size = box.room - _HEADER.size
        # A packet that is not full ends the file, if need be an empty one.
        for number, at in enumerate(range(0, len(data) + 1, size), 1):
            packet = _HEADER.pack(_DATA, number) + data[at : at + size]
            yield from self._exchange(box, packet, _ACKNOWLEDGE, number, progress, at)
            progress(min(at + size, len(data)))

    def _send(self, box: Mailbox, request: bytes) -> Steps[None]:
        deadline = time.monotonic() + _TIMEOUT_S
        while not box.send(request, MailboxType.FOE):
            check_time(deadline, "its mailbox stays full")
            yield

    def _exchange(
        self, box: Mailbox, request: bytes, expected: int, number: int, progress: Callable[[int], None], done: int
    ) -> Steps[bytes]:
        """Send a packet, again while the slave is busy, and return the data behind its answer.

        Args:
            box: the slave's mailbox.
            request: the packet.
            expected: operation code of its answer.
            number: packet number of its answer.
            progress: receives `done` at each busy answer, so that the caller sees that the slave lives.
            done: bytes transferred so far.
        """
        patience = time.monotonic() + _BUSY_S
        while True:
            yield from self._send(box, request)
            answer = yield from self._receive(box)
            operation, value = _HEADER.unpack_from(answer)
            if operation == _ERROR:
                text = answer[_HEADER.size :].rstrip(b"\0").decode("utf-8", "replace")
                meaning = FOE_ERRORS.get(value, "not in the standard")
                raise FoeRefused(f"error 0x{value:04X}, {meaning}" + (f" ({text})" if text else ""), value)
            if operation == _BUSY:
                check_time(patience, f"it stays busy for {_BUSY_S:g} s")
                progress(done)
                yield from pause(_PAUSE_S)
                continue
            if (operation, value) != (expected, number):
                raise BusError(f"it answered something else (operation {operation}, packet {value}, not {number})")
            return answer[_HEADER.size :]

    def _receive(self, box: Mailbox) -> Steps[bytes]:
        deadline = time.monotonic() + _TIMEOUT_S
        while True:
            message = box.receive_any()
            if message is not None and message[0] is MailboxType.FOE and len(message[1]) >= _HEADER.size:
                return message[1]
            if message is not None and message[0] is MailboxType.COE:
                self._receive_coe(message[1], self.position)
            check_time(deadline, "no answer in time")
            yield


_SYNC_MANAGER = struct.Struct("<HHBBBB")
_RECEIVE, _SEND = 0x26, 0x22
"""Control bytes of the mailboxes' sync managers: mailbox mode, written by the master, read by the master."""


def bootstrap_mailbox(words: bytes) -> MailboxInfo | None:
    """Return the mailboxes in BOOT from words 0x14 to 0x17 of the EEPROM; None: it has none."""
    receive_start, receive_size, send_start, send_size = struct.unpack("<4H", words)
    if not receive_start or not send_start or 0 in (receive_size, send_size) or 0xFFFF in (receive_size, send_size):
        return None
    return MailboxInfo(receive_start, receive_size, send_start, send_size, ("FoE",))


def enter_boot(port: RegisterPort, station: int, label: str, mailbox: MailboxInfo, timeout_s: float) -> None:
    """Bring a slave to BOOT with its BOOT mailboxes; raises BusError where it refuses."""
    _go_to(port, station, label, AlState.INIT, timeout_s)
    managers = _SYNC_MANAGER.pack(mailbox.receive_start, mailbox.receive_size, _RECEIVE, 0, 1, 0)
    managers += _SYNC_MANAGER.pack(mailbox.send_start, mailbox.send_size, _SEND, 0, 1, 0)
    # An ESC accepts address and length of a sync manager only while it is off.
    port.put(station, Register.SYNC_MANAGER, bytes(len(managers)), label)
    port.put(station, Register.SYNC_MANAGER, managers, label)
    _go_to(port, station, label, AlState.BOOT, timeout_s)


def _go_to(port: RegisterPort, station: int, label: str, state: AlState, timeout_s: float) -> None:
    request_state(port, (station,), state)
    if refused := wait_for_state(port, {station: label}, state, timeout_s):
        raise BusError(*refused)
