"""EtherCAT slave controller: sync managers and memory, from master's and device's side (ETG.1000.4, clause 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from rtcp.virtual.distributed_clock import Clock, DistributedClockUnit
from rtcp.virtual.pdo import BUFFERS
from rtcp.virtual.protocol import (
    DC_SPACE,
    DEFAULTS,
    ERROR_COUNTERS,
    FEATURE_DC,
    FEATURE_DC_64,
    FEATURE_DC_SYNC_ENHANCED,
    FEATURE_SEPARATE_FCS,
    FMMU_COUNT,
    FMMU_SIZE,
    ONLY_IN_64_BITS,
    RAM_SIZE,
    REGISTER_SPACE,
    SM_COUNT,
    SM_SIZE,
    SYSTEM_TIME_SPACE,
    WRITABLE,
    WRITABLE_DC,
    AlState,
    EcatEvent,
    Register,
)
from rtcp.virtual.sii import EepromInterface

IO_SPACE = 0x0F00
"""Start of digital outputs, general purpose IO and user RAM; a sync manager may cover them."""
PORTS = range(4)
DEVICE_EMULATION: Final = 0x01
"""Bit of 0x0141: the controller follows AL control without firmware."""
ALIAS_ENABLE = 0x01
"""Bit of 0x0103: the alias is a valid station address."""
LINK = 0x0010
"""DL status bit (ETG.1000.4, table 34) of a physical link at port 0; shifted left by n for port n."""
LOOP_CLOSED = 0x0100
COMMUNICATION = 0x0200
"""DL status bits of port 0: loop closed, communication established; shifted left by 2n for port n."""
LOOP_AUTO_CLOSE, LOOP_OPEN, LOOP_ALWAYS_CLOSED = 1, 2, 3
"""Loop settings of a port, two bits each in 0x0101 (ETG.1000.4, 6.1.3); 0: automatic."""
PDI_RUNS = 0x0001
WATCHDOG_OK = 0x0002
WATCHDOG_CLOCK_NS = 40
"""Period of the watchdog divider's 25 MHz clock (ETG.1000.4, 6.3)."""
RESET_SEQUENCE = b"RES"
"""Values of three consecutive writes to 0x0040 that reset the controller and its device."""

# Bits of a sync manager's control, activation, PDI control and status registers (ETG.1000.4, 6.7.2).
CONTROL_MODE: Final = 0x03
MODE_MAILBOX: Final = 0x02
CONTROL_DIRECTION: Final = 0x0C
DIRECTION_MASTER_WRITES: Final = 0x04
CONTROL_ECAT_EVENT: Final = 0x10
CONTROL_WATCHDOG: Final = 0x40
ACTIVATE = 0x01
REPEAT_REQUEST = 0x02
PDI_DEACTIVATE = 0x01
REPEAT_ACKNOWLEDGE = 0x02
STATUS_WRITTEN: Final = 0x01
STATUS_READ: Final = 0x02
STATUS_FULL: Final = 0x08
# Offsets of the bytes within a sync manager's registers.
CONTROL, STATUS, ACTIVATION, PDI = 4, 5, 6, 7


def _nothing() -> None:
    return


def port_descriptor(physics: str) -> int:
    """Return register 0x0007 for the ports in `physics`, two bits each (ETG.1000.4, 6.1.1)."""
    kinds = {"Y": 0b11, "H": 0b11, "K": 0b10}
    return sum(kinds.get(kind, 0) << 2 * port for port, kind in zip(PORTS, physics.upper(), strict=False))


class SyncManager:
    """A sync manager. `memory` is the controller's whole memory, `writable` its map of bytes open to the master.

    For a buffered area `buffer` has the last complete buffer; partial writes of the master collect in the RAM and
    become the new buffer with the last byte, as with three buffers. A mailbox is the RAM itself and the full flag.
    """

    __slots__ = (
        "_memory", "_open", "_writable", "base", "buffer", "control", "enabled", "end", "index", "length", "locked",
        "on_event", "process_data", "start", "virtual",
    )  # fmt: skip

    def __init__(self, index: int, memory: bytearray, writable: bytearray) -> None:
        self.index = index
        self.base = Register.SYNC_MANAGER + SM_SIZE * index
        self._memory = memory
        self._writable = writable
        self._open = False
        self.buffer: memoryview = memoryview(bytearray())
        """Last complete buffer, visible to the other side. Set by the segment."""
        self.on_event: Callable[[], None] = _nothing
        """Called when the event of a sync manager with `ecat_event` may change."""
        self.process_data = False
        """True: process data, with one buffer (mailbox mode) or three."""
        self.virtual = False
        """True: it has no registers; FMMUs map the device's memory directly."""
        self.start = self.end = self.length = self.control = 0
        self.enabled = False
        self.locked = False
        self.load()

    @property
    def mailbox(self) -> bool:
        """Whether it is in mailbox mode, not buffered mode."""
        return self.control & CONTROL_MODE == MODE_MAILBOX

    @property
    def buffers(self) -> int:
        """Number of buffers in the memory."""
        return 1 if self.mailbox else BUFFERS

    @property
    def master_writes(self) -> bool:
        """Whether the master writes and the device reads."""
        return self.control & CONTROL_DIRECTION == DIRECTION_MASTER_WRITES

    @property
    def watchdog_trigger(self) -> bool:
        """Whether a complete write triggers the process data watchdog."""
        return bool(self.control & CONTROL_WATCHDOG)

    @property
    def ecat_event(self) -> bool:
        """Whether it has a bit in the ECAT event request register 0x0210."""
        return bool(self.control & CONTROL_ECAT_EVENT)

    @property
    def pending(self) -> bool:
        """Whether its ECAT event is pending: the device has written the inputs or read the outputs."""
        wanted = STATUS_READ if self.master_writes else STATUS_WRITTEN
        return self.enabled and self.ecat_event and bool(self._memory[self.base + STATUS] & wanted)

    @property
    def full(self) -> bool:
        """Whether a mailbox holds a message."""
        return bool(self._memory[self.base + STATUS] & STATUS_FULL)

    @property
    def repeat_wanted(self) -> bool:
        """Whether the master has requested a repeat that is not acknowledged yet."""
        memory, base = self._memory, self.base
        return bool((memory[base + ACTIVATION] & REPEAT_REQUEST) ^ (memory[base + PDI] & REPEAT_ACKNOWLEDGE))

    def load(self) -> None:
        """Load the settings from the written registers."""
        memory, base = self._memory, self.base
        was_enabled, length = self.enabled, self.length
        self.start = int.from_bytes(memory[base : base + 2], "little")
        self.length = int.from_bytes(memory[base + 2 : base + 4], "little")
        self.end = self.start + self.length
        self.control = memory[base + CONTROL]
        self.enabled = bool(memory[base + ACTIVATION] & ACTIVATE) and self.length > 0
        self.locked = bool(memory[base + PDI] & PDI_DEACTIVATE)
        # Start, length and control are writable only while the sync manager is off (ETG.1000.4, table 58).
        closed = self.virtual or memory[base + ACTIVATION] & ACTIVATE
        self._writable[base : base + 5] = bytes(5) if closed else b"\x01" * 5
        self._writable[base + STATUS] = self._writable[base + PDI] = 0
        if self.length != length:
            self.buffer = memoryview(bytearray(self.length))
        if not self.enabled or not was_enabled:
            self._open = False
            memory[base + STATUS] = 0
        self.on_event()

    def lock(self, locked: bool) -> None:
        """Close the area to the master (`locked`) or open it, from the device's side; closing empties it."""
        pdi = self.base + PDI
        self._memory[pdi] = self._memory[pdi] & ~PDI_DEACTIVATE | locked
        if locked:
            self._set_status(0, 0xFF)
            self._open = False
        self.locked = locked

    def _set_status(self, bits: int, cleared: int) -> None:
        status = self.base + STATUS
        self._memory[status] = self._memory[status] & ~cleared | bits
        if self.control & CONTROL_ECAT_EVENT:
            self.on_event()

    def write(self, address: int, data: bytes) -> bool | None:
        """Write, from the master's side, within the area. Return whether the buffer is complete; None if refused."""
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
            self._set_status(STATUS_FULL | STATUS_WRITTEN, STATUS_READ)
        else:
            self.buffer[:] = self._memory[self.start : self.end]
            self._set_status(STATUS_WRITTEN, STATUS_READ)
        return True

    def read(self, address: int, length: int) -> tuple[bytes, bool] | None:
        """Read, from the master's side, within the area. Return data and whether they end it; None if refused.

        Reading the last byte empties a mailbox.
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
            self._set_status(STATUS_READ, STATUS_FULL | STATUS_WRITTEN)
        return data, last

    def take(self) -> bytes:
        """Take a message from a mailbox written by the master, from the device's side."""
        self._set_status(STATUS_READ, STATUS_FULL | STATUS_WRITTEN)
        return bytes(self._memory[self.start : self.end])

    def put(self, message: bytes) -> None:
        """Put a message into a mailbox read by the master, from the device's side; zero the rest of the area."""
        self._memory[self.start : self.end] = message.ljust(self.length, b"\0")[: self.length]
        self._set_status(STATUS_FULL | STATUS_WRITTEN, STATUS_READ)

    def exchanged(self) -> None:
        """Raise the ECAT event, if any, after the device has read (outputs) or written (inputs) the buffer."""
        self._set_status(*((STATUS_READ, STATUS_WRITTEN) if self.master_writes else (STATUS_WRITTEN, STATUS_READ)))

    def acknowledge_repeat(self) -> None:
        """Set the acknowledge bit to the request bit after the device has repeated the last message."""
        memory, base = self._memory, self.base
        memory[base + PDI] = memory[base + PDI] & ~REPEAT_ACKNOWLEDGE | memory[base + ACTIVATION] & REPEAT_REQUEST


class Esc:
    """The memory of a slave controller, read and written by address.

    `clock` is None for a slave without distributed clocks. `physics` names its ports, `links` tells which have a link.
    Instants `t` are arrivals of the frame at this slave, in ns of the host's monotonic clock.
    """

    def __init__(self, eeprom: bytes, clock: Clock | None, links: Sequence[bool] = (False,) * 4, physics: str = "YY",
                 ram_size: int = RAM_SIZE) -> None:  # fmt: skip
        self.memory = bytearray(REGISTER_SPACE + ram_size)
        self.writable = bytearray(REGISTER_SPACE)
        features = FEATURE_SEPARATE_FCS
        spaces: tuple[tuple[int, int], ...] = WRITABLE
        self.dc: DistributedClockUnit | None = None
        if clock is not None:
            self.dc = DistributedClockUnit(self.memory, clock)
            features |= FEATURE_DC | FEATURE_DC_SYNC_ENHANCED | (FEATURE_DC_64 if clock.bits == 64 else 0)
            spaces += WRITABLE_DC
        for first, last in spaces:
            self.writable[first : last + 1] = b"\x01" * (last + 1 - first)
        self._only_measures = clock is not None and not clock.bits
        for time in ONLY_IN_64_BITS if clock is not None and clock.bits == 32 else ():
            self.writable[time : time + 4] = bytes(4)
        if self._only_measures:
            first, end = SYSTEM_TIME_SPACE
            self.writable[first:end] = bytes(end - first)
        for register, content in DEFAULTS:
            self.memory[register : register + len(content)] = content
        self.memory[Register.RAM] = ram_size // 1024
        self.memory[Register.PORT_DESCRIPTOR] = port_descriptor(physics)
        self.put(Register.FEATURES, features, 2)
        self.put(Register.DL_STATUS, self._dl_status(links), 2)
        # Link-up after power-on is the first change of the DL status (ET1100, 0x0210.2).
        self.put(Register.EVENT_REQUEST, EcatEvent.DL_STATUS, 2)
        self.eeprom = EepromInterface(self.memory, self.writable, eeprom)
        self.sync_managers = tuple(SyncManager(n, self.memory, self.writable) for n in range(SM_COUNT))
        self.watchdog_ns = 0
        """Time of the process data watchdog, ns; 0: off."""
        self._load_watchdog()
        self.event = 0
        """ECAT event request AND mask, ORed into a datagram's event field."""
        self.al_control_written = False
        """True: the master wrote AL control and the device has not read it yet."""
        self.sync_managers_written = False
        self.mailbox_touched = False
        """True: the master filled or emptied a mailbox and the device has not reacted yet."""
        self.loops_written = False
        self._io_managed = False
        """True: a sync manager covers addresses below the RAM."""
        self.reset_requested = False
        """True: the master completed the reset sequence (0x0040)."""
        self._reset_progress = 0
        self.detach()
        for manager in self.sync_managers:
            manager.on_event = self._mirror_sync_managers

    def detach(self) -> None:
        """Drop all callbacks before another controller replaces this one."""
        self.on_layout: Callable[[], None] = _nothing
        """Called after a change of FMMUs or sync managers."""
        self.on_address: Callable[[], None] = _nothing
        """Called when the station address or the use of the alias may change."""
        self.on_attention: Callable[[], None] = _nothing
        """Called for changes that device or segment handle: AL control, sync managers, mailboxes, loops, reset."""
        self.on_event: Callable[[], None] = _nothing
        """Called after a change of `event`."""
        self.on_outputs: Callable[[SyncManager, int], None] = lambda manager, t: None
        """Called with the sync manager and the instant of a complete output buffer."""
        for manager in self.sync_managers:
            manager.on_event = _nothing

    def loop(self, port: int) -> int:
        """Loop setting of a port in 0x0101."""
        return self.memory[Register.DL_CONTROL + 1] >> 2 * port & 3

    def closed(self, port: int, linked: bool) -> bool:
        """Whether the loop of a port is closed: frames return there."""
        setting = self.loop(port)
        if setting == LOOP_AUTO_CLOSE and not self.get(Register.DL_STATUS, 2) & COMMUNICATION << 2 * port:
            # It closed at the loss of the link and opens only by a write to 0x0101.
            return not (linked and self.loops_written)
        return setting == LOOP_ALWAYS_CLOSED or (setting != LOOP_OPEN and not linked)

    def _dl_status(self, links: Sequence[bool]) -> int:
        status = PDI_RUNS | WATCHDOG_OK
        for port, linked in enumerate(links):
            status |= LINK << port if linked else 0
            status |= LOOP_CLOSED << 2 * port if self.closed(port, linked) else COMMUNICATION << 2 * port
        return status

    def set_links(self, links: Sequence[bool]) -> None:
        """Update the links of the four ports; count lost links."""
        before, after = self.get(Register.DL_STATUS, 2), self._dl_status(links)
        if before == after:
            return
        self.put(Register.DL_STATUS, after, 2)
        for port in PORTS:
            if before & ~after & LINK << port:
                self.count(Register.LOST_LINKS + port)
        self.raise_event(EcatEvent.DL_STATUS)

    def count(self, register: int) -> None:
        """Increment an error counter of one byte, which saturates."""
        self.memory[register] = min(self.memory[register] + 1, 0xFF)

    def get(self, register: int, size: int) -> int:
        """Return an unsigned register of `size` bytes."""
        return int.from_bytes(self.memory[register : register + size], "little")

    def put(self, register: int, value: int, size: int) -> None:
        """Set a register of `size` bytes from the device's side, without access checks or side effects."""
        self.memory[register : register + size] = value.to_bytes(size, "little")

    def answers_to(self, station: int) -> bool:
        """Whether `station` is this slave's configured station address or its enabled alias (0x0103)."""
        memory = self.memory
        if memory[0x10] | memory[0x11] << 8 == station:
            return True
        return bool(memory[0x103] & ALIAS_ENABLE) and memory[0x12] | memory[0x13] << 8 == station

    def set_al_status(self, state: int, code: int) -> None:
        """Set the AL state, with its error flag, and the AL status code, from the device's side."""
        self.put(Register.AL_STATUS, state, 2)
        self.put(Register.AL_STATUS_CODE, code, 2)
        self.raise_event(EcatEvent.AL_STATUS)

    @property
    def state(self) -> AlState:
        """AL state without the error flag."""
        return AlState(self.memory[Register.AL_STATUS] & 0x0F)

    def raise_event(self, event: int, cleared: int = 0) -> None:
        """Set some bits of the ECAT event request register, clear others."""
        self.put(Register.EVENT_REQUEST, self.get(Register.EVENT_REQUEST, 2) & ~cleared | event, 2)
        event = self.get(Register.EVENT_REQUEST, 2) & self.get(Register.EVENT_MASK, 2)
        if event != self.event:
            self.event = event
            self.on_event()

    def _mirror_sync_managers(self) -> None:
        pending = sum(EcatEvent.SYNC_MANAGER_0 << manager.index for manager in self.sync_managers if manager.pending)
        self.raise_event(pending, 0x0FF0)

    def read(self, address: int, length: int, t: int) -> bytes | None:
        """Read from the master's side; None if refused, which the working counter does not count."""
        end = address + length
        if not length or end > len(self.memory):
            return None
        if address >= REGISTER_SPACE or (self._io_managed and address >= IO_SPACE):
            return self._read_ram(address, length)
        if end > REGISTER_SPACE:
            return None
        if address < DC_SPACE[1] and end > DC_SPACE[0]:
            if self.dc is not None:
                self.dc.before_read(t)
            elif address >= DC_SPACE[0] and end <= DC_SPACE[1]:
                return None
            if address < SYSTEM_TIME_SPACE[1] and end > SYSTEM_TIME_SPACE[0] and self._only_measures:
                return None
        if address <= Register.EEPROM_CONTROL + 1 < end:
            self.eeprom.before_read(t)
        data = bytes(self.memory[address:end])
        if address < Register.AL_STATUS + 2 and end > Register.AL_STATUS:
            self.raise_event(0, EcatEvent.AL_STATUS)
        if address < Register.DL_STATUS + 2 and end > Register.DL_STATUS:
            self.raise_event(0, EcatEvent.DL_STATUS)
        return data

    def write(self, address: int, data: bytes, t: int) -> bool:
        """Write from the master's side; False if nothing is writable, which the working counter does not count."""
        end = address + len(data)
        if not data or end > len(self.memory):
            return False
        if address >= REGISTER_SPACE or (self._io_managed and address >= IO_SPACE):
            return self._write_ram(address, data, t)
        if end > REGISTER_SPACE:
            return False
        if self.al_control_written and Register.AL_CONTROL <= address < Register.AL_CONTROL + 2:
            # AL control is locked until the device has read it (ET1100, 0x0120).
            return False
        mask = self.writable[address:end]
        if 0 not in mask:
            self.memory[address:end] = data
        elif 1 not in mask:
            return False
        else:
            memory = self.memory
            for at, byte, allowed in zip(range(address, end), data, mask, strict=True):
                if allowed:
                    memory[at] = byte
        self._after_write(address, end, t)
        return True

    def _after_write(self, first: int, end: int, t: int) -> None:
        """Apply the new values of the registers `first` to `end` (excluded)."""
        memory = self.memory
        if first < Register.AL_CONTROL + 2 and end > Register.AL_CONTROL:
            self.al_control_written = True
            self.on_attention()
        elif first < Register.STATION_ADDRESS + 2:
            self.on_address()
        elif first == Register.ESC_RESET:
            self._reset(memory[first])
        elif Register.DL_CONTROL <= first < Register.DL_CONTROL + 4:
            self.on_address()
            self.loops_written = first <= Register.DL_CONTROL + 1 < end
            if self.loops_written:
                self.on_attention()
        elif Register.EVENT_MASK <= first < Register.EVENT_MASK + 2:
            self.raise_event(0)
        elif Register.RX_ERRORS <= first < Register.LOST_LINKS + 4:
            for start, behind in ERROR_COUNTERS:
                if first < behind and end > start:
                    memory[start:behind] = bytes(behind - start)  # any write clears the group
        elif Register.WATCHDOG_COUNTERS <= first < Register.WATCHDOG_COUNTERS + 2:
            memory[Register.WATCHDOG_COUNTERS : Register.WATCHDOG_COUNTERS + 2] = bytes(2)
        elif Register.WATCHDOG_DIVIDER <= first <= Register.WATCHDOG_PROCESS_DATA + 1:
            self._load_watchdog()
        elif first < Register.EEPROM_DATA + 8 and end > Register.EEPROM_CONFIG:
            if first == Register.EEPROM_CONFIG:
                self.eeprom.write_config()
            if first <= Register.EEPROM_CONTROL + 1 < end and self.writable[Register.EEPROM_CONTROL]:
                self.eeprom.write_control(t)
        elif first < Register.FMMU + FMMU_COUNT * FMMU_SIZE and end > Register.FMMU:
            self.on_layout()
        elif first < Register.SYNC_MANAGER + SM_COUNT * SM_SIZE and end > Register.SYNC_MANAGER:
            self._load_sync_managers(first, end)
        elif self.dc is not None and first < DC_SPACE[1] and end > DC_SPACE[0]:
            self.dc.wrote(first, end, t)

    def _reset(self, byte: int) -> None:
        """Advance the reset sequence; the register then shows the number of matching bytes."""
        self._reset_progress = self._reset_progress + 1 if byte == RESET_SEQUENCE[self._reset_progress] else 0
        if self._reset_progress == len(RESET_SEQUENCE):
            self._reset_progress = 0
            self.reset_requested = True
            self.on_attention()
        self.memory[Register.ESC_RESET] = self._reset_progress

    def _load_watchdog(self) -> None:
        step = (self.get(Register.WATCHDOG_DIVIDER, 2) + 2) * WATCHDOG_CLOCK_NS
        self.watchdog_ns = step * self.get(Register.WATCHDOG_PROCESS_DATA, 2)

    def _load_sync_managers(self, first: int, end: int) -> None:
        changed = False
        for manager in self.sync_managers:
            if first < manager.base + SM_SIZE and end > manager.base:
                before = (manager.start, manager.length, manager.control, manager.enabled)
                manager.load()
                changed |= before != (manager.start, manager.length, manager.control, manager.enabled)
                self.mailbox_touched |= manager.repeat_wanted
        if changed:
            self._io_managed = any(m.enabled and IO_SPACE <= m.start < REGISTER_SPACE for m in self.sync_managers)
            self.sync_managers_written = True
            self.on_layout()
        self.on_attention()

    def _read_ram(self, address: int, length: int) -> bytes | None:
        end = address + length
        data = bytearray(self.memory[address:end])
        refused = 0
        for manager in self.sync_managers:
            if not manager.enabled or address >= manager.end or end <= manager.start:
                continue
            first, last = max(address, manager.start), min(end, manager.end)
            part = manager.read(first, last - first)
            if part is None:
                refused += last - first
                data[first - address : last - address] = bytes(last - first)
                continue
            data[first - address : last - address] = part[0]
            if part[1] and manager.mailbox and not manager.process_data:
                self.mailbox_touched = True
                self.on_attention()
        return None if refused >= length else bytes(data)

    def _write_ram(self, address: int, data: bytes, t: int) -> bool:
        end = address + len(data)
        free = bytearray(b"\x01" * len(data))
        written = False
        for manager in self.sync_managers:
            if not manager.enabled or address >= manager.end or end <= manager.start:
                continue
            first, last = max(address, manager.start), min(end, manager.end)
            free[first - address : last - address] = bytes(last - first)
            complete = manager.write(first, data[first - address : last - address])
            if complete is None:
                continue
            written = True
            if complete and manager.mailbox and not manager.process_data:
                self.mailbox_touched = True
                self.on_attention()
            elif complete:
                self.on_outputs(manager, t)
        if 0 not in free:
            self.memory[address:end] = data
            return True
        if 1 in free:
            for at, (byte, open_) in enumerate(zip(data, free, strict=True), address):
                if open_:
                    self.memory[at] = byte
            return True
        return written
