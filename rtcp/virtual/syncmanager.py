"""Sync managers: consistent buffers and mailboxes in the process data RAM (ETG.1000.4, 6.4)."""

from __future__ import annotations

from rtcp.virtual.registers import SM_SIZE, Register

CONTROL_MODE = 0x03
MODE_BUFFERED = 0x00
MODE_MAILBOX = 0x02
CONTROL_DIRECTION = 0x0C
DIRECTION_MASTER_WRITES = 0x04
CONTROL_WATCHDOG = 0x40
ACTIVATE = 0x01
REPEAT_REQUEST = 0x02
PDI_DEACTIVATE = 0x01
REPEAT_ACKNOWLEDGE = 0x02
STATUS_WRITTEN = 0x01
STATUS_READ = 0x02
STATUS_FULL = 0x08
# Offsets of the bytes within a sync manager's registers.
CONTROL, STATUS, ACTIVATION, PDI = 4, 5, 6, 7


class SyncManager:
    """One sync manager. `memory` is the controller's whole memory, `writable` its map of bytes open to the master.

    A buffered area is held as the last complete buffer in `buffer`; what the master writes in parts gathers in the RAM
    and is handed over with its last byte, as with three buffers. A mailbox is the RAM itself and the full flag.
    """

    __slots__ = (
        "_memory", "_open", "_writable", "base", "buffer", "control", "enabled", "end", "index", "length", "locked",
        "start",
    )  # fmt: skip

    def __init__(self, index: int, memory: bytearray, writable: bytearray) -> None:
        self.index = index
        self.base = Register.SYNC_MANAGER + SM_SIZE * index
        self._memory = memory
        self._writable = writable
        self._open = False
        self.buffer: memoryview = memoryview(bytearray())
        """The last complete buffer of a buffered sync manager: what the other side sees. Set by the segment."""
        self.start = self.end = self.length = self.control = 0
        self.enabled = False
        self.locked = False
        self.load()

    @property
    def mailbox(self) -> bool:
        """Whether it works as a mailbox (full or empty) and not as a buffer."""
        return self.control & CONTROL_MODE == MODE_MAILBOX

    @property
    def master_writes(self) -> bool:
        """Whether the master writes and the device reads."""
        return self.control & CONTROL_DIRECTION == DIRECTION_MASTER_WRITES

    @property
    def watchdog_trigger(self) -> bool:
        """Whether a complete write feeds the process data watchdog."""
        return bool(self.control & CONTROL_WATCHDOG)

    @property
    def full(self) -> bool:
        """Whether a mailbox holds a message."""
        return bool(self._memory[self.base + STATUS] & STATUS_FULL)

    @property
    def repeat_wanted(self) -> bool:
        """Whether the master has asked for the last message once more and got no acknowledgement yet."""
        memory, base = self._memory, self.base
        return bool((memory[base + ACTIVATION] & REPEAT_REQUEST) ^ (memory[base + PDI] & REPEAT_ACKNOWLEDGE))

    def load(self) -> None:
        """Take the settings from the registers after these were written."""
        memory, base = self._memory, self.base
        was_enabled, length = self.enabled, self.length
        self.start = int.from_bytes(memory[base : base + 2], "little")
        self.length = int.from_bytes(memory[base + 2 : base + 4], "little")
        self.end = self.start + self.length
        self.control = memory[base + CONTROL]
        self.enabled = bool(memory[base + ACTIVATION] & ACTIVATE) and self.length > 0
        self.locked = bool(memory[base + PDI] & PDI_DEACTIVATE)
        # Start, length and control are open only while the sync manager is off (ETG.1000.4, table 58).
        self._writable[base : base + 5] = bytes(5) if memory[base + ACTIVATION] & ACTIVATE else b"\x01" * 5
        self._writable[base + STATUS] = self._writable[base + PDI] = 0
        if self.length != length:
            self.buffer = memoryview(bytearray(self.length))
        if not self.enabled or not was_enabled:
            self._open = False
            memory[base + STATUS] = 0

    def lock(self, locked: bool) -> None:
        """The device closes the area to the master (`locked`) or opens it; closing empties it."""
        pdi = self.base + PDI
        self._memory[pdi] = self._memory[pdi] & ~PDI_DEACTIVATE | locked
        if locked:
            self._memory[self.base + STATUS] = 0
            self._open = False
        self.locked = locked

    def write(self, address: int, data: bytes) -> bool | None:
        """The master writes within the area. Returns None if refused, True if the buffer is complete, else False."""
        if self.locked or not self.master_writes:
            return None
        if address == self.start:
            if self.mailbox and self.full:
                return None
            self._open = True
        elif not self._open:
            return None
        self._memory[address : address + len(data)] = data
        if address + len(data) < self.end:
            return False
        self._open = False
        if self.mailbox:
            self._memory[self.base + STATUS] |= STATUS_FULL | STATUS_WRITTEN
        else:
            self.buffer[:] = self._memory[self.start : self.end]
            self._memory[self.base + STATUS] |= STATUS_WRITTEN
        return True

    def read(self, address: int, length: int) -> tuple[bytes, bool] | None:
        """The master reads within the area. Returns None if refused, else the data and whether the last byte was read.

        The last byte makes a mailbox empty.
        """
        if self.locked or self.master_writes:
            return None
        if address == self.start:
            if self.mailbox:
                if not self.full:
                    return None
            else:
                self._memory[self.start : self.end] = self.buffer
            self._open = True
        elif not self._open:
            return None
        data = bytes(self._memory[address : address + length])
        last = address + length == self.end
        if last:
            self._open = False
            status = self.base + STATUS
            self._memory[status] = self._memory[status] & ~(STATUS_FULL | STATUS_WRITTEN) | STATUS_READ
        return data, last

    def take(self) -> bytes:
        """The device takes a message out of a mailbox that the master writes; the mailbox is empty then."""
        self._memory[self.base + STATUS] &= ~(STATUS_FULL | STATUS_WRITTEN)
        return bytes(self._memory[self.start : self.end])

    def put(self, message: bytes) -> None:
        """The device puts a message into a mailbox that the master reads; the rest of the area is zeroed."""
        self._memory[self.start : self.end] = message.ljust(self.length, b"\0")[: self.length]
        status = self.base + STATUS
        self._memory[status] = self._memory[status] & ~STATUS_READ | STATUS_FULL

    def acknowledge_repeat(self) -> None:
        """The device has put the last message there again: make the acknowledge bit equal to the request."""
        memory, base = self._memory, self.base
        memory[base + PDI] = memory[base + PDI] & ~REPEAT_ACKNOWLEDGE | memory[base + ACTIVATION] & REPEAT_REQUEST
