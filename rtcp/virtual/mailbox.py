"""The mailbox of a slave: headers, counters, error replies and the send queue (ETG.1000.4, 5.6 and 6.7)."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType

from rtcp.virtual.coe import ABORT, CoeService, SdoInformation, SdoServer, emergency_message
from rtcp.virtual.device import FULL_COE, CoeFeatures, DeviceModel, Emergency, MailboxHandler, SlaveFaults
from rtcp.virtual.esc import SyncManager
from rtcp.virtual.objects import ObjectDictionary
from rtcp.virtual.protocol import MailboxType

_HEADER = struct.Struct("<HHBB")
_ERROR_REPLY = struct.Struct("<HH")
_ERROR_COMMAND = 0x0001
_SERVICES = frozenset(CoeService)
MINIMUM_SIZE = 16
"""Smallest mailbox: header, CoE header and an expedited SDO."""
MAX_WAITING = 64
"""Upper bound on queued answers; beyond it the mailbox reports no memory."""


class MailboxError(IntEnum):
    """Mailbox error codes (ETG.1000.4, table 30)."""

    SYNTAX = 0x0001
    """The six bytes of the mailbox header are wrong."""
    UNSUPPORTED_PROTOCOL = 0x0002
    INVALID_CHANNEL = 0x0003
    SERVICE_NOT_SUPPORTED = 0x0004
    """The slave lacks this service of the protocol."""
    INVALID_HEADER = 0x0005
    """The header of the protocol (not the mailbox header) is wrong."""
    SIZE_TOO_SHORT = 0x0006
    NO_MORE_MEMORY = 0x0007
    INVALID_SIZE = 0x0008
    """The length in the header does not match the data."""


class Mailbox:
    """The mailbox service of a slave: requests in SM0, answers in SM1."""

    def __init__(
        self,
        objects: ObjectDictionary,
        emergencies: deque[Emergency],
        receive_size: int,
        send_size: int,
        faults: SlaveFaults | None = None,
        protocols: Mapping[MailboxType, MailboxHandler] = MappingProxyType({}),
        coe: CoeFeatures | None = FULL_COE,
    ) -> None:
        """Serve `objects` over mailboxes of `receive_size` (SM0) and `send_size` (SM1) bytes, and further `protocols`.

        `coe`: optional CoE services; None: no CoE.

        Raises:
            ValueError: a mailbox smaller than 16 bytes.
        """
        for name, size in (("receive", receive_size), ("send", send_size)):
            if size < MINIMUM_SIZE:
                raise ValueError(f"the {name} mailbox has {size} bytes, allowed are {MINIMUM_SIZE} and more")
        self._emergencies = emergencies
        self._receive_size = receive_size
        self._room = send_size - _HEADER.size
        self._protocols = protocols
        self._faults = SlaveFaults() if faults is None else faults
        self._sdo = SdoServer(objects, send_size, self._faults, coe is None or coe.complete_access)
        self._information = SdoInformation(objects, send_size) if coe is not None and coe.sdo_information else None
        self._known = frozenset(protocols) if coe is None else frozenset((*protocols, MailboxType.COE))
        self._waiting: deque[tuple[MailboxType, int, bytes, int]] = deque()
        self._master_counter = 0
        self._own_counter = 0

    def receive(self, data: bytes, state: int, t: int = 0) -> None:
        """Process the master's message in SM0 (the whole buffer) at instant `t`; `state` determines the access rights.

        A malformed message gets a mailbox error; a message with the same counter as the last one is a repetition and
        gets no second answer.
        """
        if len(data) < _HEADER.size:
            self._refuse(0, MailboxError.SYNTAX)
            return
        # Queued emergencies go out before the answer, an emergency caused by the service after it.
        self._queue_emergencies()
        length, address, channel, kind = _HEADER.unpack_from(data)
        counter = kind >> 4 & 0x7
        if counter and counter == self._master_counter:
            return
        self._master_counter = counter
        if len(self._waiting) >= MAX_WAITING:
            if self._waiting[-1][2] != _error(MailboxError.NO_MORE_MEMORY):
                self._refuse(address, MailboxError.NO_MORE_MEMORY)
        elif length > min(len(data), self._receive_size) - _HEADER.size:
            self._refuse(address, MailboxError.INVALID_SIZE)
        elif (protocol := kind & 0xF) not in self._known:
            self._refuse(address, MailboxError.UNSUPPORTED_PROTOCOL)
        elif channel & 0x3F:
            self._refuse(address, MailboxError.INVALID_CHANNEL)
        else:
            content = bytes(data[_HEADER.size : _HEADER.size + length])
            if protocol == MailboxType.COE:
                self._coe(address, content, state, t)
            else:
                self._of_model(address, MailboxType(protocol), content)

    def pending(self, t: int = 0) -> bool:
        """Return whether a message for SM1 is due at instant `t`."""
        if self._waiting:
            return self._waiting[0][3] <= t
        return bool(self._emergencies)

    def next_message(self, t: int = 0) -> bytes | None:
        """Return the next message for SM1 with its mailbox header, at most `send_size` bytes; None: none is queued.

        Answers and emergencies go out in their order of origin. Bytes after the message in SM1's buffer are undefined.
        """
        if not self.pending(t):
            return None
        if not self._waiting:
            self._queue_emergencies()
        kind, address, content, _ = self._waiting.popleft()
        self._own_counter = self._own_counter % 7 + 1
        return _HEADER.pack(len(content), address, 0, self._own_counter << 4 | kind) + content

    def _queue_emergencies(self) -> None:
        while self._emergencies:
            self._waiting.append((MailboxType.COE, 0, emergency_message(self._emergencies.popleft()), 0))

    def _refuse(self, address: int, error: MailboxError) -> None:
        self._waiting.append((MailboxType.ERROR, address, _error(error), 0))

    def _coe(self, address: int, content: bytes, state: int, t: int) -> None:
        """Serve a CoE message; its header has a 9-bit number and above it the service (ETG.1000.6, 5.6.1)."""
        if len(content) < 2:
            self._refuse(address, MailboxError.SIZE_TOO_SHORT)
            return
        service = content[1] >> 4
        if service == CoeService.SDO_REQUEST:
            self._sdo_request(address, content, state, t)
        elif service == CoeService.SDO_INFORMATION and self._information is not None:
            self._sdo_information(address, content, self._information)
        elif service in _SERVICES:
            self._refuse(address, MailboxError.SERVICE_NOT_SUPPORTED)
        else:
            self._refuse(address, MailboxError.INVALID_HEADER)

    def _of_model(self, address: int, protocol: MailboxType, content: bytes) -> None:
        """Let the device model answer a message of one of its protocols."""
        for answer in self._protocols[protocol](content, self._room):
            if len(answer) > self._room:
                self._refuse(address, MailboxError.INVALID_SIZE)
            else:
                self._waiting.append((protocol, address, answer, 0))

    def _sdo_request(self, address: int, content: bytes, state: int, t: int) -> None:
        if len(content) < SdoServer.MINIMUM_REQUEST:
            self._refuse(address, MailboxError.SIZE_TOO_SHORT)
            return
        answer = self._sdo.answer(content[2:], state)
        if answer is not None:
            # An abort is an SDO request of the server (ETG.1000.6, 5.6.2.7); masters recognize it by that.
            service = CoeService.SDO_REQUEST if answer[0] == ABORT else CoeService.SDO_RESPONSE
            self._waiting.append((MailboxType.COE, address, service.header + answer, t + self._faults.sdo_delay()))

    def _sdo_information(self, address: int, content: bytes, information: SdoInformation) -> None:
        if len(content) < SdoInformation.MINIMUM_REQUEST:
            self._refuse(address, MailboxError.SIZE_TOO_SHORT)
            return
        for answer in information.answer(content[2:]):
            self._waiting.append((MailboxType.COE, address, CoeService.SDO_INFORMATION.header + answer, 0))


def _error(error: MailboxError) -> bytes:
    """Return the content of an error reply (ETG.1000.4, table 30)."""
    return _ERROR_REPLY.pack(_ERROR_COMMAND, error)


class MailboxService:
    """Carries messages between sync managers and `Mailbox`; repeats the last one on request."""

    def __init__(self, device: DeviceModel, out: SyncManager, in_: SyncManager, faults: SlaveFaults,
                 boot: bool = False) -> None:  # fmt: skip
        """The master writes `out` and reads `in_`, both already configured. In BOOT only FoE is served."""
        self._out = out
        self._in = in_
        device.emergencies.clear()
        device.open_mailbox(out.length, in_.length)
        protocols = device.mailbox_protocols
        if boot:
            protocols = {kind: handler for kind, handler in protocols.items() if kind == MailboxType.FOE}
        coe = None if boot else device.coe
        self._mailbox = Mailbox(
            device.objects, device.emergencies if coe else deque(), out.length, in_.length, faults, protocols,
            coe,
        )  # fmt: skip
        self._outbox: deque[bytes] = deque()
        self._present: bytes | None = None
        self._last: bytes | None = None

    def serve(self, state: int, t: int) -> None:
        """Process the master's message in AL state `state` at instant `t`, and put the next message into SM1."""
        if self._out.full:
            self._mailbox.receive(self._out.take(), state, t)
        reader = self._in
        if not reader.full and self._present is not None:
            self._last, self._present = self._present, None
        if reader.repeat_wanted:
            self._repeat()
        if not reader.full:
            message = self._outbox.popleft() if self._outbox else self._mailbox.next_message(t)
            if message is not None:
                self._present = message
                reader.put(message)

    def pending(self, t: int) -> bool:
        """Whether a message is due at instant `t` and SM1 is empty."""
        return self._mailbox.pending(t) and not self._in.full

    def _repeat(self) -> None:
        """Put the last read message into SM1 again, and the present one after it."""
        if self._present is not None:
            self._outbox.appendleft(self._present)
            self._present = None
        if self._last is not None:
            self._present = self._last
            self._in.put(self._last)
        self._in.acknowledge_repeat()
