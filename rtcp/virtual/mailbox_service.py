"""The device's side of its two mailboxes: from SM0 to the mailbox protocols and from there to SM1 (ETG.1000.4, 6.4)."""

from __future__ import annotations

from collections import deque

from rtcp.virtual.device import Device
from rtcp.virtual.mailbox import Mailbox
from rtcp.virtual.slave_faults import SlaveFaults
from rtcp.virtual.syncmanager import SyncManager


class MailboxService:
    """Carries messages between sync managers and `Mailbox`, and repeats the last one when the master lost it."""

    def __init__(self, device: Device, out: SyncManager, in_: SyncManager, faults: SlaveFaults) -> None:
        """`out` is SM0, which the master writes, `in_` is SM1, which it reads; both configured by now."""
        self._out = out
        self._in = in_
        device.emergencies.clear()
        self._mailbox = Mailbox(device.objects, device.emergencies, out.length, in_.length, faults)
        self._outbox: deque[bytes] = deque()
        self._present: bytes | None = None
        self._last: bytes | None = None

    def serve(self, state: int, t: int) -> None:
        """Take what the master wrote, in AL state `state` at instant `t`, and put the next message where it reads."""
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
        """Whether a message waits at instant `t` and SM1 has room for it."""
        return self._mailbox.pending(t) and not self._in.full

    def stop(self) -> None:
        """The slave goes to INIT: forget everything."""
        self._mailbox.reset()

    def _repeat(self) -> None:
        """Put the last message that was read there again, and what stands there now after it."""
        if self._present is not None:
            self._outbox.appendleft(self._present)
            self._present = None
        if self._last is not None:
            self._present = self._last
            self._in.put(self._last)
        self._in.acknowledge_repeat()
