"""A slave's mailbox, through a RegisterPort (ETG.1000.4, 5.6 and 6.7: sync managers 0 and 1 in mailbox mode)."""

from __future__ import annotations

import struct
from enum import IntEnum

from rtcp.fieldbus.bus import BusError, MailboxInfo
from rtcp.fieldbus.registers import Command, RegisterPort

_SM0_STATUS, _SM1_STATUS, _FULL = 0x0805, 0x080D, 0x08
_HEADER = struct.Struct("<HHBB")


class MailboxType(IntEnum):
    """Protocols of a mailbox message (ETG.1000.4, table 29)."""

    ERROR = 0
    COE = 3


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
    """Messages to and from one slave. Nothing is waited for but the frames."""

    def __init__(self, port: RegisterPort, station: int, info: MailboxInfo) -> None:
        """Take the mailbox of the slave at configured address `station`."""
        self._port = port
        self._station = station
        self._info = info

    @property
    def room(self) -> int:
        """Bytes that a message to the slave may have behind its mailbox header."""
        return self._info.receive_size - _HEADER.size

    @property
    def patience_s(self) -> float:
        """For how long a service whose messages get lost is tried again, s."""
        return self._port.patience_s

    def send(self, content: bytes) -> bool:
        """Give the slave a CoE message; return False while its mailbox is still full.

        Args:
            content: CoE header and what follows, `room` bytes at most.

        Raises:
            BusError: the slave does not answer.
        """
        if self._is_full(_SM0_STATUS):
            return False
        # Counter 0 is not checked by slaves; SOEM counts its own messages 1 to 7, unknown to us (ETG.1000.4, table 29).
        message = _HEADER.pack(len(content), 0, 0, MailboxType.COE) + content
        message = message.ljust(self._info.receive_size, b"\0")
        # Once only: whether a lost frame reached the slave is not known.
        start = self._info.receive_start
        if self._port.exchange(Command.FPWR, self._station, start, message, tries=1).wkc != 1:
            raise BusError("it did not take the message")
        return True

    def receive(self) -> bytes | None:
        """Return a CoE message that waits (CoE header first), None where none does.

        Raises:
            BusError: the slave answered with a mailbox error, or its message got lost.
        """
        if not self._is_full(_SM1_STATUS):
            return None
        # Once only: the mailbox is empty after its last byte was read.
        message = self._port.read(self._station, self._info.send_start, self._info.send_size, tries=1)
        if message is None:
            raise BusError("its message got lost")
        length, _, _, kind = _HEADER.unpack_from(message)
        content = message[_HEADER.size : _HEADER.size + length]
        if kind & 0x0F == MailboxType.ERROR:
            code = int.from_bytes(content[2:4], "little")
            raise BusError(f"mailbox error {code}: {_ERRORS.get(code, 'not in the standard')}")
        return content if kind & 0x0F == MailboxType.COE else None

    def _is_full(self, register: int) -> bool:
        status = self._port.read(self._station, register, 1)
        if status is None:
            raise BusError("it does not answer")
        return bool(status[0] & _FULL)
