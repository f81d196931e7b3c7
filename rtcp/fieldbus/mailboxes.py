"""The mailboxes of all slaves: SDO access, and the emergency messages that wait in them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

from rtcp.fieldbus.bus import BusError, MailboxInfo, slave_label, station_of
from rtcp.fieldbus.emergency import Emergency, parse
from rtcp.fieldbus.mailbox import Mailbox
from rtcp.fieldbus.registers import RegisterPort
from rtcp.fieldbus.sdo import SdoClient

_SM1_STATUS, _FULL = 0x080D, 0x08
_MESSAGES_A_POLL = 8


class Mailboxes:
    """One lock a slave: what waits for one of them keeps nobody from another."""

    def __init__(self, port: RegisterPort, names: Sequence[str], infos: Sequence[MailboxInfo | None]) -> None:
        """Take the slaves in the order of the cable: their names, and what their EEPROMs tell of their mailboxes."""
        self._port = port
        self._names = names
        self._infos = infos
        self._locks = [threading.Lock() for _ in names]
        self._emergencies: deque[Emergency] = deque(maxlen=256)

    def sdo(self, position: int) -> SdoClient:
        """Return SDO access to the slave at `position`; raises BusError where there is none."""
        if not 1 <= position <= len(self._names):
            raise BusError(f"there is no slave {position}; the bus has slaves 1 to {len(self._names)}")
        info = self._infos[position - 1]
        mailbox = Mailbox(self._port, station_of(position), info) if info is not None and info.has_coe else None
        return SdoClient(mailbox, position, self._names[position - 1], self._locks[position - 1], self._keep)

    def emergencies(self) -> tuple[Emergency, ...]:
        """Return the emergency messages that came since the last call; without any it takes one frame.

        Raises:
            BusError: a message got lost; whatever else there is comes with the next call.
        """
        full = self._port.read_all(_SM1_STATUS, 1).data
        if any(byte & _FULL for byte in full):
            self._empty_all()
        found = []
        while self._emergencies:
            found.append(self._emergencies.popleft())
        return tuple(found)

    def _empty_all(self) -> None:
        faults: list[str] = []
        for position, info in enumerate(self._infos, 1):
            lock = self._locks[position - 1]
            # While an SDO is under way its answer is in the mailbox; whoever waits for it then meets emergencies too.
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
        # A slave that does not answer is the watcher's business.
        if status is None or not status[0] & _FULL:
            return
        mailbox = Mailbox(self._port, station_of(position), info)
        for _ in range(_MESSAGES_A_POLL):
            message = mailbox.receive()
            if message is None:
                return
            self._keep(message, position)

    def _keep(self, message: bytes, position: int) -> None:
        found = parse(message, position, self._names[position - 1])
        if found is not None:
            self._emergencies.append(found)
