"""A virtual slave: controller, firmware and its place on the wire."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Final

from rtcp.virtual.al_state import HELD, AlStatusCode, SyncMonitor, first_failure, judge
from rtcp.virtual.device import DeviceModel, SlaveFaults
from rtcp.virtual.distributed_clock import Clock
from rtcp.virtual.esc import CONTROL_ECAT_EVENT, DEVICE_EMULATION, IO_SPACE, Esc, SyncManager
from rtcp.virtual.mailbox import MailboxService
from rtcp.virtual.pdo import PdoImage, SyncManagerLayout
from rtcp.virtual.protocol import ERROR_FLAG, SM_SIZE, STATE_MASK, AlState, Register
from rtcp.virtual.sii import build_sii

_OP: Final = int(AlState.OP)
_SAFE_OP: Final = int(AlState.SAFE_OP)
"""Plain ints: comparisons of enums are too slow for every step."""
OP_TIMEOUT = 1_000_000_000
"""Upper bound on the wait in SAFE-OP for the first outputs and SYNC0 after a request for OP, ns."""
LONGEST_STEP: Final = 2_000_000
"""Upper bound on a step of a device, ns."""
MOST_STEPS: Final = 20
"""Upper bound on steps replayed after the process was stopped; older time is dropped."""
_EMPTY = PdoImage(())


class ProcessData:
    """A sync manager of process data with its image and, for outputs, the last latched buffer."""

    __slots__ = ("image", "latched", "manager", "single")

    def __init__(self, manager: SyncManager, single: bool) -> None:
        self.manager = manager
        self.single = single
        """True: a single buffer, empty after it was read; False: three buffers."""
        self.image = _EMPTY
        self.latched = b""

    def pack(self) -> None:
        """Write the inputs to the buffer; a single buffer only after it was read."""
        manager, image = self.manager, self.image
        if manager.length != image.byte_length:
            return
        if not self.single:
            image.pack(manager.buffer)
        elif not manager.full and not manager.locked and manager.length:
            packed = bytearray(image.byte_length)
            image.pack(packed)
            manager.put(bytes(packed))


class Application:
    """A slave's firmware, called by `attend`, `watch`, `pulse` and `advance`.

    Instants are ns of the host's monotonic clock.
    """

    def __init__(self, esc: Esc, device: DeviceModel, faults: SlaveFaults, t: int) -> None:
        self.esc = esc
        self.device = device
        self._faults = faults
        self._mailbox: MailboxService | None = None
        roles = device.roles
        self._mailboxes = roles.mailboxes or ()
        self._outputs, self._inputs = (
            tuple(ProcessData(esc.sync_managers[index], device.sync_managers[index].buffers == 1) for index in indices)
            for indices in (roles.outputs, roles.inputs)
        )
        self._emulated = not self._mailboxes and bool(esc.memory[Register.PDI_CONTROL + 1] & DEVICE_EMULATION)
        """True: no firmware; the controller itself follows every request (ETG.1000.4, 6.1.4)."""
        self._pulses = 0
        """SYNC0 pulses since the last SYNC1."""
        self._fed: int | None = None
        self._missing: set[int] = set()
        """Output sync managers not written yet."""
        self._awaits_outputs = False
        """Whether it has outputs, which the master has to send in each cycle."""
        self._op_wanted_at: int | None = None
        self._error = False
        self._stepped_at = t
        self.outputs_watch: Callable[[memoryview, int], None] | None = None
        """Called in OP with the outputs and their arrival."""
        self.sync = SyncMonitor(esc, device)
        self._level: int = AlState.INIT
        esc.on_outputs = self.outputs_written
        for data in self._outputs + self._inputs:
            data.manager.process_data = True
        for manager, layout in zip(esc.sync_managers, device.sync_managers, strict=False):
            if 0 < layout.start < IO_SPACE:
                manager.virtual = True
                esc.writable[manager.base : manager.base + SM_SIZE] = bytes(SM_SIZE)
        if self._emulated:
            self._lay_out()
        else:
            for index in (*self._mailboxes, *roles.outputs, *roles.inputs):
                esc.sync_managers[index].lock(True)

    @property
    def state(self) -> AlState:
        """The AL state."""
        return AlState(self._level)

    @property
    def by_sync0(self) -> bool:
        """Whether SYNC0 steps the device."""
        return self._level >= _SAFE_OP and self.sync.active

    # Actions of the master

    def attend(self, t: int) -> None:
        """React to accesses of the master: AL control, sync managers, mailboxes."""
        esc = self.esc
        if esc.sync_managers_written:
            esc.sync_managers_written = False
            self._recheck()
        if esc.al_control_written and not self._faults.hangs:
            esc.al_control_written = False
            self._control(esc.get(Register.AL_CONTROL, 2), t)
        if esc.mailbox_touched:
            esc.mailbox_touched = False
            if self._mailbox is not None:
                self._mailbox.serve(self.state, t)

    def outputs_written(self, manager: SyncManager, t: int) -> None:
        """Handle a complete output buffer from a frame that arrived at `t`."""
        if not manager.process_data:
            return
        if self._missing:
            self._missing.discard(manager.index)
        if self._outputs and manager is self._outputs[0].manager:
            self.sync.outputs_arrived()
            if self.outputs_watch is not None and self._level == _OP:
                self.outputs_watch(manager.buffer, t)
        if manager.watchdog_trigger:
            if self._fed is None:
                self.esc.memory[Register.WATCHDOG_STATUS] |= 0x01
                if self._emulated and self.state == AlState.OP:
                    self.device.set_outputs_valid(True)
            self._fed = t
        if self._op_wanted_at is not None:
            self._try_op(t)

    def _control(self, request: int, t: int) -> None:
        wanted = request & STATE_MASK
        if self._emulated:
            self._follow(request)
            return
        if self._error:
            # An unacknowledged error keeps the slave in its state, except for INIT (ETG.1000.6, 6.4.1.4).
            if not request & ERROR_FLAG and wanted != AlState.INIT:
                return
            self._error = False
            self._lock_process_data(self.state < AlState.SAFE_OP)
        self._op_wanted_at = None
        refusal = self._faults.refusal(wanted) if wanted > self.state else 0
        code = refusal or judge(self.state, wanted, self.esc, self.device)
        if code:
            self._refuse(code)
            return
        if wanted == AlState.OP and self.state == AlState.SAFE_OP:
            self._op_wanted_at = t
            self.sync.configure()
            self._report(AlStatusCode.NO_ERROR)
            self._try_op(t)
            return
        self._enter(AlState(wanted))
        self._report(AlStatusCode.NO_ERROR)

    def _follow(self, request: int) -> None:
        """Copy the request, with its acknowledge bit, to AL status without any check."""
        if request & STATE_MASK in AlState.__members__.values():
            before, after = self.state, AlState(request & STATE_MASK)
            self._level = after
            if AlState.OP in (before, after):
                self.device.set_outputs_valid(after == AlState.OP)
            self.sync.configure()
            self.device.state_changed(before, after)
        self.esc.set_al_status(request & (STATE_MASK | ERROR_FLAG), AlStatusCode.NO_ERROR)

    def _enter(self, wanted: AlState) -> None:
        """Start or stop the functions between the present state and `wanted`."""
        before = self.state
        self._level = wanted
        if before == AlState.OP and wanted < AlState.OP:
            self.device.set_outputs_valid(False)
        if before >= AlState.SAFE_OP > wanted:
            self._lock_process_data(True)
            self.sync.stop()
        if before >= AlState.PRE_OP > wanted:
            # This also drops messages, transfers and counters.
            self._mailbox = None
            self._lock(True, self._mailboxes)
        if before < AlState.PRE_OP <= wanted and self._mailboxes:
            self._lock(False, self._mailboxes)
            out, in_ = (self.esc.sync_managers[index] for index in self._mailboxes)
            self._mailbox = MailboxService(self.device, out, in_, self._faults, wanted == AlState.BOOTSTRAP)
        if before < AlState.SAFE_OP <= wanted:
            self._start_process_data()
        if before != wanted:
            self.device.state_changed(before, wanted)

    def _lay_out(self) -> None:
        for data in self._outputs + self._inputs:
            data.image = self.device.image(data.manager.index) or _EMPTY
        self._missing = {data.manager.index for data in self._outputs if data.image.byte_length}
        self._awaits_outputs = bool(self._outputs and self._outputs[0].image.byte_length)

    def _start_process_data(self) -> None:
        self._lay_out()
        self._fed = None
        self.esc.memory[Register.WATCHDOG_STATUS] |= 0x01
        self.sync.configure()
        self._lock_process_data(False)
        for data in self._inputs:
            data.pack()

    def _lock_process_data(self, locked: bool) -> None:
        roles = self.device.roles
        self._lock(locked, roles.outputs + roles.inputs)

    def _lock(self, locked: bool, indices: Sequence[int]) -> None:
        for index in indices:
            self.esc.sync_managers[index].lock(locked)
        self.esc.on_layout()

    def _report(self, code: int) -> None:
        self.esc.set_al_status(self.state | (ERROR_FLAG if self._error else 0), code)

    def _refuse(self, code: int) -> None:
        self._error = True
        self._report(code)

    def fall(self, state: AlState, code: int) -> None:
        """Leave the state on an internal error; the outputs close, which shows in the working counter."""
        self._op_wanted_at = None
        self._enter(state)
        if state == AlState.SAFE_OP:
            # Earlier outputs are void.
            self._missing = {data.manager.index for data in self._outputs if data.image.byte_length}
            self._lock(True, tuple(self._missing) or self.device.roles.inputs)
        self._refuse(code)

    def _recheck(self) -> None:
        if self._emulated:
            self._lay_out()
            return
        for checks, fallback in HELD[self.state]:
            code = first_failure(checks, self.esc, self.device)
            if code:
                self.fall(fallback, code)
                return

    def _try_op(self, t: int) -> None:
        """Go to OP once outputs and SYNC0 have arrived; refuse after OP_TIMEOUT."""
        wanted_at = self._op_wanted_at
        if wanted_at is None or self._faults.hangs:
            return
        have_outputs = not self._missing
        have_sync = self.sync.running or not self.sync.active
        if have_outputs and have_sync:
            self._op_wanted_at = None
            self.latch()
            self.sync.start()
            before = self.state
            self._level = _OP
            self.device.set_outputs_valid(True)
            self._report(AlStatusCode.NO_ERROR)
            self.device.state_changed(before, AlState.OP)
        elif t - wanted_at > OP_TIMEOUT:
            self._op_wanted_at = None
            self._refuse(AlStatusCode.NO_SYNC if have_outputs else AlStatusCode.SYNC_MANAGER_WATCHDOG)

    # Timed events

    def watch(self, t: int) -> None:
        """Check watchdog, SYNC0 and a pending request for OP; called at least every millisecond."""
        esc = self.esc
        fed = self._fed
        if fed is not None and 0 < esc.watchdog_ns < t - fed:
            self._fed = None
            esc.memory[Register.WATCHDOG_STATUS] &= 0xFE
            count = esc.memory[Register.WATCHDOG_COUNTERS]
            esc.memory[Register.WATCHDOG_COUNTERS] = min(count + 1, 0xFF)
            if self._emulated:
                # Stay in OP: the outputs are off until frames return.
                self.device.set_outputs_valid(False)
            elif self.state == AlState.OP:
                self.fall(AlState.SAFE_OP, AlStatusCode.SYNC_MANAGER_WATCHDOG)
            else:
                self._missing = {data.manager.index for data in self._outputs if data.image.byte_length}
        if self._level == _OP and self.sync.active and not self.sync.running and not self._emulated:
            self.fall(AlState.SAFE_OP, AlStatusCode.FATAL_SYNC_ERROR)
        if self._op_wanted_at is not None:
            self._try_op(t)

    def pulse(self, on_time: bool) -> None:
        """Handle SYNC0: latch the outputs. `on_time`: this process was not late.

        With several conversions a cycle SYNC1 is the cycle, and SYNC0 the conversion: frames are expected by SYNC1.
        """
        self.latch()
        self._pulses += 1
        if self.esc.dc is not None and self._pulses < self.esc.dc.sync1_pulses:
            return
        self._pulses = 0
        if self._level == _OP and self._awaits_outputs and self.sync.pulse(on_time):
            self.fall(AlState.SAFE_OP, AlStatusCode.SYNC_ERROR)

    def latch(self) -> None:
        """Latch the outputs, after their frame has passed or at SYNC0."""
        for data in self._outputs:
            if not data.single:
                data.latched = bytes(data.manager.buffer)
            elif data.manager.full:
                data.latched = data.manager.take()

    def due(self, t: int, interval: int) -> bool:
        """Whether the last step was `interval` ns before `t` or earlier."""
        return t - self._stepped_at >= interval

    def advance(self, t: int) -> None:
        """Advance the device to `t`: outputs in (in OP), steps, inputs out (from SAFE-OP)."""
        passed = t - self._stepped_at
        self._stepped_at = max(t, self._stepped_at)
        if self._level == _OP:
            for data in self._outputs:
                image = data.image
                if len(data.latched) == image.byte_length:  # the master may just have changed the sync manager
                    image.unpack(data.latched)
                if data.manager.control & CONTROL_ECAT_EVENT:
                    data.manager.exchanged()
        device = self.device
        for _ in range(MOST_STEPS):
            if passed <= 0:
                break
            part = min(passed, LONGEST_STEP)
            device.step(part * 1e-9)
            passed -= part
        if device.failure and not self._emulated:
            code, device.failure = device.failure, 0
            if self._level == _OP:
                self.fall(AlState.SAFE_OP, code)
            elif self._level == _SAFE_OP and not self._error:
                self._refuse(code)
        if self._level >= _SAFE_OP or self._emulated:
            try:
                for data in self._inputs:
                    data.pack()
                    if data.manager.control & CONTROL_ECAT_EVENT:
                        data.manager.exchanged()
            except (struct.error, ArithmeticError, TypeError, AttributeError) as error:
                # A behaviour stored a value that exceeds the object's bits.
                device.failed(error)
        mailbox = self._mailbox
        if mailbox is not None and mailbox.pending(t):
            mailbox.serve(self.state, t)


FIRST_LOCAL_TIME = 1_000_000_000
"""Initial time of slave n is n times this, ns: no clocks agree by chance."""


class Slave:
    """A controller with its firmware, at `delay` ns from the master's port."""

    __slots__ = (
        "_clock_bits",
        "_drift_ppm",
        "application",
        "clock",
        "delay",
        "device",
        "esc",
        "faults",
        "queued_until",
    )

    def __init__(self, device: DeviceModel, eeprom: bytes, drift_ppm: float, start: int, delay: int, t: int,
                 clock_bits: int = 64) -> None:  # fmt: skip
        """Power on at instant `t` with the clock at `start` ns; the segment connects it."""
        self._clock_bits = clock_bits
        self.device = device
        self.delay = delay
        self.faults = SlaveFaults()
        self._drift_ppm = drift_ppm
        self.queued_until: int | None = None
        """Instant up to which the device must be stepped; None: not queued."""
        self._start(eeprom, drift_ppm, start, t)

    def _start(self, eeprom: bytes, drift_ppm: float, start: int, t: int) -> None:
        device = self.device
        self.clock = Clock(drift_ppm, start, t, self._clock_bits) if device.supports_dc else None
        self.esc = Esc(eeprom, self.clock, physics=device.physics, ram_size=device.ram_size)
        self.application = Application(self.esc, device, self.faults, t)

    def power_off(self, t: int) -> None:
        """Power off: the device stops; controller and firmware lose their state."""
        self.device.power_off()
        self._restart(t)

    def power_on(self, t: int) -> None:
        """Power on: everything is reset but the EEPROM."""
        self.device.power_on()
        self._restart(t)

    def _restart(self, t: int) -> None:
        # The garbage collector is off in a segment's process: leave no reference cycle.
        self.esc.detach()
        self._start(bytes(self.esc.eeprom.image), self._drift_ppm + self.faults.drift_ppm, 0, t)
        if self.esc.dc is not None and self.faults.sync0_losses:
            self.esc.dc.sync0.suspend()


def make_slaves(devices: Sequence[DeviceModel], drifts_ppm: Sequence[float], delays: Sequence[int],
                aliases: Sequence[int], t: int, clock_bits: Sequence[int] = ()) -> list[Slave]:  # fmt: skip
    """Return a slave for every device, in the order of the wire; `delays` are ns from the master.

    `clock_bits` are the sizes of their clocks; left out: 64.
    """
    slaves = []
    for device in devices:
        device.join(devices)
    each = zip(devices, drifts_ppm, delays, aliases, clock_bits or [64] * len(devices), strict=True)
    for position, (device, drift, delay, alias, bits) in enumerate(each, 1):
        eeprom = device.eeprom(alias) or build_sii(device, SyncManagerLayout(), alias)
        slaves.append(Slave(device, eeprom, drift, FIRST_LOCAL_TIME * position, delay, t, bits))
    return slaves
