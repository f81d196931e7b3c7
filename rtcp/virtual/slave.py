"""A virtual slave: controller, firmware and its place on the wire."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtcp.virtual.al_state import (
    HELD,
    INPUTS,
    MAILBOX_IN,
    MAILBOX_OUT,
    OUTPUTS,
    AlStatusCode,
    SyncMonitor,
    first_failure,
    judge,
    mapped_image,
)
from rtcp.virtual.device import DeviceModel, SlaveFaults
from rtcp.virtual.distributed_clock import Clock
from rtcp.virtual.esc import CONTROL_ECAT_EVENT, Esc, SyncManager
from rtcp.virtual.mailbox import MailboxService
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage, SyncManagerLayout
from rtcp.virtual.protocol import ERROR_FLAG, STATE_MASK, AlState, Register
from rtcp.virtual.sii import build_sii

OP_TIMEOUT = 1_000_000_000
"""How long, in ns, a slave asked for OP waits in SAFE-OP for its first outputs and SYNC0 before it refuses."""
LONGEST_STEP = 2_000_000
"""Longest time in ns that a device is let pass in one step."""
MOST_STEPS = 20
"""Steps made up for after the process was stopped; what is older than these is dropped."""


class Application:
    """One slave's firmware. Everything it does happens in `attend`, `watch`, `pulse` and `advance`.

    Instants are ns of the host's monotonic clock.
    """

    def __init__(self, esc: Esc, device: DeviceModel, faults: SlaveFaults, t: int) -> None:
        self.esc = esc
        self.device = device
        self._faults = faults
        self._mailbox: MailboxService | None = None
        self._rx = self._tx = PdoImage(())
        self._latched = b""
        self._fed: int | None = None
        self._received = False
        self._op_wanted_at: int | None = None
        self._error = False
        self._stepped_at = t
        self.outputs_watch: Callable[[memoryview, int], None] | None = None
        """Called with the outputs and their arrival in OP."""
        self.sync = SyncMonitor(esc, device)
        self.state = AlState.INIT
        esc.on_outputs = self.outputs_written
        for index in (MAILBOX_OUT, MAILBOX_IN, OUTPUTS, INPUTS):
            esc.sync_managers[index].lock(True)

    @property
    def by_sync0(self) -> bool:
        """Whether the device is stepped by SYNC0 now."""
        return self.state >= AlState.SAFE_OP and self.sync.active

    # What the master did

    def attend(self, t: int) -> None:
        """Look at what the master wrote or read: AL control, sync managers, mailboxes."""
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
        """A buffer of outputs was completed by a frame that arrived at `t`."""
        if manager.index != OUTPUTS:
            return
        self._received = True
        self.sync.outputs_came()
        if self.outputs_watch is not None and self.state == AlState.OP:
            self.outputs_watch(manager.buffer, t)
        if manager.watchdog_trigger:
            if self._fed is None:
                self.esc.memory[Register.WATCHDOG_STATUS] |= 0x01
            self._fed = t
        self._try_op(t)

    def _control(self, request: int, t: int) -> None:
        wanted = request & STATE_MASK
        if self._error:
            # Until it is acknowledged an error keeps the slave where it is, but for INIT (ETG.1000.6, 6.4.1.4).
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

    def _enter(self, wanted: AlState) -> None:
        """Start or stop what lies between the present state and `wanted`."""
        before, self.state = self.state, wanted
        if before == AlState.OP and wanted < AlState.OP:
            self.device.set_outputs_valid(False)
        if before >= AlState.SAFE_OP > wanted:
            self._lock_process_data(True)
            self.sync.stop()
        if before >= AlState.PRE_OP > wanted:
            # With it go messages, transfers and counters.
            self._mailbox = None
            self._lock(True, MAILBOX_OUT, MAILBOX_IN)
        if before < AlState.PRE_OP <= wanted:
            self._lock(False, MAILBOX_OUT, MAILBOX_IN)
            managers = self.esc.sync_managers
            out, in_ = managers[MAILBOX_OUT], managers[MAILBOX_IN]
            self._mailbox = MailboxService(self.device, out, in_, self._faults)
        if before < AlState.SAFE_OP <= wanted:
            self._start_process_data()

    def _start_process_data(self) -> None:
        self._rx = mapped_image(self.device, RX_ASSIGN) or PdoImage(())
        self._tx = mapped_image(self.device, TX_ASSIGN) or PdoImage(())
        self._received = False
        self._fed = None
        self.esc.memory[Register.WATCHDOG_STATUS] |= 0x01
        self.sync.configure()
        self._lock_process_data(False)
        self._tx.pack(self.esc.sync_managers[INPUTS].buffer)

    def _lock_process_data(self, locked: bool) -> None:
        self._lock(locked, OUTPUTS, INPUTS)

    def _lock(self, locked: bool, *indices: int) -> None:
        for index in indices:
            self.esc.sync_managers[index].lock(locked)
        self.esc.on_layout()

    def _report(self, code: int) -> None:
        self.esc.set_al_status(self.state | (ERROR_FLAG if self._error else 0), code)

    def _refuse(self, code: int) -> None:
        self._error = True
        self._report(code)

    def fall(self, state: AlState, code: int) -> None:
        """Leave the state on an error of one's own; the working counter shows it, for the outputs are closed."""
        self._op_wanted_at = None
        self._enter(state)
        if state == AlState.SAFE_OP:
            self._lock(True, OUTPUTS if self._rx.byte_length else INPUTS)
            # What the master sent before does not count any more.
            self._received = False
        self._refuse(code)

    def _recheck(self) -> None:
        for checks, fallback in HELD[self.state]:
            code = first_failure(checks, self.esc, self.device)
            if code:
                self.fall(fallback, code)
                return

    def _try_op(self, t: int) -> None:
        """Go to OP as soon as outputs and SYNC0 are there; give up after a while."""
        asked = self._op_wanted_at
        if asked is None or self._faults.hangs:
            return
        have_outputs = self._received or not self._rx.byte_length
        have_sync = self.sync.running or not self.sync.active
        if have_outputs and have_sync:
            self._op_wanted_at = None
            self._latched = bytes(self.esc.sync_managers[OUTPUTS].buffer)
            self.sync.start()
            self.state = AlState.OP
            self.device.set_outputs_valid(True)
            self._report(AlStatusCode.NO_ERROR)
        elif t - asked > OP_TIMEOUT:
            self._op_wanted_at = None
            self._refuse(AlStatusCode.NO_SYNC if have_outputs else AlStatusCode.SYNC_MANAGER_WATCHDOG)

    # What time does

    def watch(self, t: int) -> None:
        """Look after watchdog, SYNC0 and a pending request for OP; called at least every millisecond."""
        esc = self.esc
        fed = self._fed
        if fed is not None and 0 < esc.watchdog_ns < t - fed:
            self._fed = None
            self._received = False
            esc.memory[Register.WATCHDOG_STATUS] &= 0xFE
            count = esc.memory[Register.WATCHDOG_COUNTERS]
            esc.memory[Register.WATCHDOG_COUNTERS] = min(count + 1, 0xFF)
            if self.state == AlState.OP:
                self.fall(AlState.SAFE_OP, AlStatusCode.SYNC_MANAGER_WATCHDOG)
        if self.state == AlState.OP and self.sync.active and not self.sync.running:
            self.fall(AlState.SAFE_OP, AlStatusCode.FATAL_SYNC_ERROR)
        if self._op_wanted_at is not None:
            self._try_op(t)

    def pulse(self, on_time: bool) -> None:
        """SYNC0 has come: take over the outputs. `on_time` tells that this process was not late in noticing it."""
        self._latched = bytes(self.esc.sync_managers[OUTPUTS].buffer)
        if self.state == AlState.OP and self.sync.pulse(on_time):
            self.fall(AlState.SAFE_OP, AlStatusCode.SYNC_ERROR)

    def latch(self) -> None:
        """Take over the outputs without SYNC0: the frame that brought them has passed."""
        self._latched = bytes(self.esc.sync_managers[OUTPUTS].buffer)

    def due(self, t: int, interval: int) -> bool:
        """Whether the device was last stepped `interval` ns before `t` or earlier."""
        return t - self._stepped_at >= interval

    def advance(self, t: int) -> None:
        """Let the device's time pass up to `t`: outputs in (in OP), steps, inputs out (from SAFE-OP on)."""
        passed = t - self._stepped_at
        self._stepped_at = max(t, self._stepped_at)
        if self.state == AlState.OP:
            if len(self._latched) == self._rx.byte_length:  # the master may have changed the sync manager just now
                self._rx.unpack(self._latched)
            outputs = self.esc.sync_managers[OUTPUTS]
            if outputs.control & CONTROL_ECAT_EVENT:
                outputs.exchanged()
        step = self.device.step
        for _ in range(MOST_STEPS):
            if passed <= 0:
                break
            part = min(passed, LONGEST_STEP)
            step(part * 1e-9)
            passed -= part
        if self.state >= AlState.SAFE_OP:
            inputs = self.esc.sync_managers[INPUTS]
            if inputs.length == self._tx.byte_length:
                self._tx.pack(inputs.buffer)
            if inputs.control & CONTROL_ECAT_EVENT:
                inputs.exchanged()
        mailbox = self._mailbox
        if mailbox is not None and mailbox.pending(t):
            mailbox.serve(self.state, t)


FIRST_LOCAL_TIME = 1_000_000_000
"""Slave n shows n times this at the start, as if powered one second after its neighbour: no clocks agree by chance."""


class Slave:
    """A controller with its firmware and its place on the wire: `delay` ns after the master's port."""

    __slots__ = ("_drift_ppm", "application", "clock", "delay", "device", "esc", "faults", "queued_until")

    def __init__(self, device: DeviceModel, eeprom: bytes, drift_ppm: float, start: int, delay: int,
                 turnaround: int | None, t: int) -> None:  # fmt: skip
        """Power on at instant `t`, the clock showing `start` ns; `turnaround`: see `Esc`."""
        self.device = device
        self.delay = delay
        self.faults = SlaveFaults()
        self._drift_ppm = drift_ppm
        self.clock: Clock | None = Clock(drift_ppm, start, t) if device.supports_dc else None
        self.esc = Esc(eeprom, self.clock, turnaround, (True, turnaround is not None))
        self.application = Application(self.esc, device, self.faults, t)
        self.queued_until: int | None = None
        """Instant up to which the device is to be stepped; None while it does not wait for that."""

    def power_off(self, t: int) -> None:
        """The supply goes: the device stops, nothing that controller and firmware held is left."""
        self.device.power_off()
        self._restart(t)

    def power_on(self, t: int) -> None:
        """The supply comes back: all is as at power-on, but for what the EEPROM has kept."""
        self.device.power_on()
        self._restart(t)

    def _restart(self, t: int) -> None:
        self.clock = Clock(self._drift_ppm + self.faults.drift_ppm, 0, t) if self.device.supports_dc else None
        # The collector of garbage is off in a segment's process: no ring of references may be left.
        self.esc.detach()
        self.esc = Esc(bytes(self.esc.eeprom.image), self.clock, None, (False, False))
        if self.esc.dc is not None and self.faults.sync0_losses:
            self.esc.dc.sync0.suspend()
        self.application = Application(self.esc, self.device, self.faults, t)


def make_slaves(devices: Sequence[DeviceModel], drifts_ppm: Sequence[float], delays: Sequence[int],
                aliases: Sequence[int], t: int) -> list[Slave]:  # fmt: skip
    """Make a slave of every device, in the order of the wire; `delays` are ns from the master and must not fall."""
    slaves = []
    for device in devices:
        device.join(devices)
    for position, (device, drift, delay, alias) in enumerate(zip(devices, drifts_ppm, delays, aliases, strict=True)):
        last = position + 1 == len(devices)
        # A frame comes back to a slave after the way to the end of the chain and back.
        turnaround = None if last else 2 * (delays[-1] - delay)
        eeprom = build_sii(device, SyncManagerLayout(), alias)
        slaves.append(Slave(device, eeprom, drift, FIRST_LOCAL_TIME * (position + 1), delay, turnaround, t))
    return slaves
