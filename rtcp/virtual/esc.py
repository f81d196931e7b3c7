"""A slave controller: its memory as the master and as the device see it (ETG.1000.4, clause 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtcp.virtual.clock import Clock
from rtcp.virtual.distributed_clock import DistributedClockUnit
from rtcp.virtual.eeprom import EepromInterface
from rtcp.virtual.registers import (
    DC_SPACE,
    DEFAULTS,
    FEATURE_DC,
    FEATURE_DC_64,
    FEATURE_DC_SYNC_ENHANCED,
    FEATURE_SEPARATE_FCS,
    FMMU_COUNT,
    FMMU_SIZE,
    RAM_SIZE,
    REGISTER_SPACE,
    SM_COUNT,
    SM_SIZE,
    WRITABLE,
    WRITABLE_DC,
    EcatEvent,
    Register,
    State,
)
from rtcp.virtual.syncmanager import SyncManager

MEMORY_SIZE = REGISTER_SPACE + RAM_SIZE
ALIAS_ENABLE = 0x01
"""Bit of 0x0103 that lets the alias serve as station address."""
LINK = 0x0010
"""Bit of the DL status for a physical link at port 0; that of port n is n places further up."""
LOOP_CLOSED = 0x0100
COMMUNICATION = 0x0200
"""Bits of the DL status for port 0: the frame turns round there, or goes on; those of port n are 2n further up."""
PORTS_2_3_CLOSED = 0x5000
PDI_RUNS = 0x0001
WATCHDOG_OK = 0x0002
WATCHDOG_CLOCK_NS = 40
"""The watchdog divider counts periods of 25 MHz (ETG.1000.4, table 50)."""


def _nothing() -> None:
    return


def _dl_status(links: Sequence[bool]) -> int:
    status = PDI_RUNS | WATCHDOG_OK | PORTS_2_3_CLOSED
    for port, linked in enumerate(links):
        status |= LINK << port | COMMUNICATION << 2 * port if linked else LOOP_CLOSED << 2 * port
    return status


class Esc:
    """The memory of one slave controller, read and written by address.

    `turnaround` is the time in ns that a frame takes from this slave to the end of the chain and back; None for the
    last slave. `clock` is None for a slave without distributed clocks. Instants `t` are those of the frame's arrival at
    this slave, in ns of the host's monotonic clock. `links` tells of ports 0 and 1 whether they have a link.
    """

    def __init__(
        self, eeprom: bytes, clock: Clock | None, turnaround: int | None, links: tuple[bool, bool]
    ) -> None:  # fmt: skip
        self.memory = bytearray(MEMORY_SIZE)
        self.writable = bytearray(REGISTER_SPACE)
        features = FEATURE_SEPARATE_FCS
        spaces: tuple[tuple[int, int], ...] = WRITABLE
        self.dc: DistributedClockUnit | None = None
        if clock is not None:
            self.dc = DistributedClockUnit(self.memory, clock, turnaround)
            features |= FEATURE_DC | FEATURE_DC_64 | FEATURE_DC_SYNC_ENHANCED
            spaces += WRITABLE_DC
        for first, last in spaces:
            self.writable[first : last + 1] = b"\x01" * (last + 1 - first)
        for register, content in DEFAULTS:
            self.memory[register : register + len(content)] = content
        self.put(Register.FEATURES, features, 2)
        self.put(Register.DL_STATUS, _dl_status(links), 2)
        self.eeprom = EepromInterface(self.memory, self.writable, eeprom)
        self.sync_managers = tuple(SyncManager(n, self.memory, self.writable) for n in range(SM_COUNT))
        self.watchdog_ns = 0
        """Time of the process data watchdog in ns; 0: off."""
        self._load_watchdog()
        self.event = 0
        """ECAT event request and mask, as it is ORed into a datagram's event field."""
        self.al_control_written = False
        """The master wrote AL control; the device has not looked yet."""
        self.sync_managers_written = False
        self.mailbox_touched = False
        """A mailbox was filled or emptied; the device has not looked yet."""
        self.on_layout: Callable[[], None] = _nothing
        """Called when FMMUs or sync managers have changed."""
        self.on_address: Callable[[], None] = _nothing
        """Called when the station address or the use of the alias may have changed."""
        self.on_attention: Callable[[], None] = _nothing
        """Called when the device has to look: AL control, sync managers or mailboxes."""
        self.on_event: Callable[[], None] = _nothing
        """Called when `event` has changed."""
        self.on_outputs: Callable[[SyncManager, int], None] = lambda manager, t: None
        """Called with the sync manager and the instant when a buffer of outputs is complete."""

    def detach(self) -> None:
        """Call nobody any more: the supply has gone, another takes this one's place."""
        self.on_layout = self.on_address = self.on_attention = self.on_event = _nothing
        self.on_outputs = lambda manager, t: None

    def set_links(self, *links: bool) -> None:
        """Show which of the ports 0 and 1 have a link now; one that has lost it counts that."""
        before, after = self.get(Register.DL_STATUS, 2), _dl_status(links)
        if before == after:
            return
        self.put(Register.DL_STATUS, after, 2)
        for port in range(len(links)):
            if before & ~after & LINK << port:
                self.count(Register.LOST_LINKS + port)
        self.raise_event(EcatEvent.DL_STATUS)

    def count(self, register: int) -> None:
        """Count an error in a register of one byte, which stops at its end."""
        self.memory[register] = min(self.memory[register] + 1, 0xFF)

    def get(self, register: int, size: int) -> int:
        """An unsigned register of `size` bytes."""
        return int.from_bytes(self.memory[register : register + size], "little")

    def put(self, register: int, value: int, size: int) -> None:
        """Set a register of `size` bytes, from the device's side: no access rights, no side effects."""
        self.memory[register : register + size] = value.to_bytes(size, "little")

    def answers_to(self, station: int) -> bool:
        """Whether `station` is this slave's configured station address, or its alias while that is enabled (0x0103)."""
        memory = self.memory
        if memory[0x10] | memory[0x11] << 8 == station:
            return True
        return bool(memory[0x103] & ALIAS_ENABLE) and memory[0x12] | memory[0x13] << 8 == station

    def set_al_status(self, state: int, code: int) -> None:
        """The device reports its AL state (with the error flag, if any) and AL status code."""
        self.put(Register.AL_STATUS, state, 2)
        self.put(Register.AL_STATUS_CODE, code, 2)
        self.raise_event(EcatEvent.AL_STATUS)

    @property
    def state(self) -> State:
        """The AL state that the device reports."""
        return State(self.memory[Register.AL_STATUS] & 0x0F)

    def raise_event(self, event: int) -> None:
        """Set bits of the ECAT event request register."""
        self.put(Register.EVENT_REQUEST, self.get(Register.EVENT_REQUEST, 2) | event, 2)
        self._refresh_event()

    def _clear_event(self, event: int) -> None:
        self.put(Register.EVENT_REQUEST, self.get(Register.EVENT_REQUEST, 2) & ~event, 2)
        self._refresh_event()

    def _refresh_event(self) -> None:
        event = self.get(Register.EVENT_REQUEST, 2) & self.get(Register.EVENT_MASK, 2)
        if event != self.event:
            self.event = event
            self.on_event()

    def read(self, address: int, length: int, t: int) -> bytes | None:
        """The master reads; None where the access is refused, and the working counter does not count it."""
        end = address + length
        if not length or end > MEMORY_SIZE:
            return None
        if address >= REGISTER_SPACE:
            return self._read_ram(address, length)
        if end > REGISTER_SPACE:
            return None
        if self.dc is not None and address < DC_SPACE[1] and end > DC_SPACE[0]:
            self.dc.before_read(t)
        if address <= Register.EEPROM_CONTROL + 1 < end:
            self.eeprom.before_read(t)
        data = bytes(self.memory[address:end])
        if address < Register.AL_STATUS + 2 and end > Register.AL_STATUS:
            self._clear_event(EcatEvent.AL_STATUS)
        if address < Register.DL_STATUS + 2 and end > Register.DL_STATUS:
            self._clear_event(EcatEvent.DL_STATUS)
        return data

    def write(self, address: int, data: bytes, t: int) -> bool:
        """The master writes; False where nothing could be written, and the working counter does not count it."""
        end = address + len(data)
        if not data or end > MEMORY_SIZE:
            return False
        if address >= REGISTER_SPACE:
            return self._write_ram(address, data, t)
        if end > REGISTER_SPACE:
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
        """Let the units behind the registers from `first` up to `end` act on their new values."""
        memory = self.memory
        if first < 0x0122 and end > Register.AL_CONTROL:
            self.al_control_written = True
            self.on_attention()
        elif first < 0x0012 or Register.DL_CONTROL <= first < 0x0104:
            self.on_address()
        elif Register.EVENT_MASK <= first < 0x0202:
            self._refresh_event()
        elif Register.RX_ERRORS <= first < 0x0314:
            memory[Register.RX_ERRORS : 0x0314] = bytes(0x14)  # a write of any value clears the counters
        elif Register.WATCHDOG_COUNTERS <= first < 0x0444:
            memory[Register.WATCHDOG_COUNTERS : 0x0444] = bytes(2)
        elif Register.WATCHDOG_DIVIDER <= first <= Register.WATCHDOG_PROCESS_DATA + 1:
            self._load_watchdog()
        elif first < 0x0510 and end > Register.EEPROM_CONFIG:
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

    def _load_watchdog(self) -> None:
        step = (self.get(Register.WATCHDOG_DIVIDER, 2) + 2) * WATCHDOG_CLOCK_NS
        self.watchdog_ns = step * self.get(Register.WATCHDOG_PROCESS_DATA, 2)

    def _load_sync_managers(self, first: int, end: int) -> None:
        settings = []
        for manager in self.sync_managers:
            if first < manager.base + SM_SIZE and end > manager.base:
                before = (manager.start, manager.length, manager.control, manager.enabled)
                manager.load()
                settings.append(before != (manager.start, manager.length, manager.control, manager.enabled))
                self.mailbox_touched |= manager.repeat_wanted
        if any(settings):
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
            if part[1] and manager.mailbox:
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
            if complete and manager.mailbox:
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
