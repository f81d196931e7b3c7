"""The EtherCAT state machine as tables, and the supervision of SYNC0.

States and transitions: ETG.1000.6, 6.4.1; AL status codes: ETG.1000.6, table 11; sync error counter: ETG.1020, 21.2.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from itertools import pairwise
from typing import Final

from rtcp.virtual.device import DeviceModel
from rtcp.virtual.esc import Esc, SyncManager
from rtcp.virtual.protocol import REGISTER_SPACE, AlState, Register

MINIMUM_CYCLE = (0x1C32, 5)


class AlStatusCode(IntEnum):
    """AL status codes of these slaves."""

    NO_ERROR = 0x0000
    INVALID_STATE_CHANGE = 0x0011
    UNKNOWN_STATE = 0x0012
    BOOTSTRAP_NOT_SUPPORTED = 0x0013
    INVALID_MAILBOX_BOOT = 0x0015
    INVALID_MAILBOX_PREOP = 0x0016
    INVALID_SYNC_MANAGERS = 0x0017
    SYNC_ERROR = 0x001A
    SYNC_MANAGER_WATCHDOG = 0x001B
    INVALID_OUTPUTS = 0x001D
    INVALID_INPUTS = 0x001E
    INVALID_WATCHDOG = 0x001F
    INVALID_INPUT_MAPPING = 0x0024
    INVALID_OUTPUT_MAPPING = 0x0025
    FATAL_SYNC_ERROR = 0x002C
    NO_SYNC = 0x002D
    INVALID_DC_SYNC = 0x0030
    INVALID_SYNC0_CYCLE = 0x0035


def _in_ram(manager: SyncManager, size: int, esc: Esc) -> bool:
    return manager.start >= REGISTER_SPACE and manager.start + size <= len(esc.memory)


def check_mailboxes(esc: Esc, device: DeviceModel) -> bool:
    """Both sync managers of a mailbox must be in mailbox mode, long enough and separate."""
    if device.roles.mailboxes is None:
        return True
    out, in_ = (esc.sync_managers[index] for index in device.roles.mailboxes)
    return (
        all(
            m.enabled and m.mailbox and m.length >= device.smallest_mailbox and _in_ram(m, m.length, esc)
            for m in (out, in_)
        )
        and out.master_writes
        and not in_.master_writes
        and (device.shares_memory or out.end <= in_.start or in_.end <= out.start)
    )


def _fits(esc: Esc, device: DeviceModel, index: int, master_writes: bool) -> bool:
    """Whether a sync manager has its device's address and mode and the length of its PDOs; if empty, it is unused."""
    manager, own, image = esc.sync_managers[index], device.sync_managers[index], device.image(index)
    if image is None or not image.byte_length:
        return image is not None and not manager.enabled
    return (
        manager.enabled
        and manager.master_writes == master_writes
        and manager.buffers == own.buffers
        and manager.length == image.byte_length
        and (_in_ram(manager, manager.buffers * manager.length, esc) or manager.start == own.start)
    )


def check_outputs(esc: Esc, device: DeviceModel) -> bool:
    """Each output sync manager must be a buffer that the master writes, with the length of its RxPDOs."""
    return all(_fits(esc, device, index, True) for index in device.roles.outputs)


def check_inputs(esc: Esc, device: DeviceModel) -> bool:
    """Each input sync manager must be a buffer that the master reads, with the length of its TxPDOs."""
    return all(_fits(esc, device, index, False) for index in device.roles.inputs)


def check_areas(esc: Esc, device: DeviceModel) -> bool:
    """Sync managers must not overlap; a buffered one occupies three times its length."""
    areas = sorted((m.start, m.start + m.length * m.buffers) for m in esc.sync_managers if m.enabled)
    return device.shares_memory or all(first[1] <= second[0] for first, second in pairwise(areas))


def check_watchdog(esc: Esc, device: DeviceModel) -> bool:
    """A watchdog with a trigger and a time must have a divider."""
    triggered = any(esc.sync_managers[index].watchdog_trigger for index in device.roles.outputs)
    wanted = triggered and esc.get(Register.WATCHDOG_PROCESS_DATA, 2)
    return not wanted or bool(esc.get(Register.WATCHDOG_DIVIDER, 2))


def check_sync0(esc: Esc, device: DeviceModel) -> bool:
    """Active SYNC pulses must include SYNC0 or the device's own alternative."""
    dc = esc.dc
    if dc is None or not dc.cyclic or esc.memory[Register.DC_ACTIVATION] in device.sync_activations:
        return True
    return dc.sync0_active and bool(dc.sync0.cycle)


def check_cycle(esc: Esc, device: DeviceModel) -> bool:
    """The SYNC0 cycle must be one that the device supports."""
    minimum = device.objects[MINIMUM_CYCLE].value if MINIMUM_CYCLE in device.objects else 0
    return esc.dc is None or not esc.dc.sync0_active or not isinstance(minimum, int) or esc.dc.sync0.cycle >= minimum


def check_pulses(esc: Esc, device: DeviceModel) -> bool:
    """A SYNC0 that has started must still be running.

    It stops if the last master left it on and the time base has since been set again (SOEM#60).
    """
    dc = esc.dc
    return dc is None or not dc.cyclic or not (dc.sync0.lost and dc.sync0.pulses)


def _mapped(device: DeviceModel, indices: tuple[int, ...]) -> bool:
    return all(device.image(index) is not None for index in indices)


Check = tuple[Callable[[Esc, DeviceModel], bool], AlStatusCode]
"""A condition, and the AL status code of its failure."""
_MAILBOXES: tuple[Check, ...] = ((check_mailboxes, AlStatusCode.INVALID_MAILBOX_PREOP),)
_BUFFERS: tuple[Check, ...] = (
    (check_outputs, AlStatusCode.INVALID_OUTPUTS),
    (check_inputs, AlStatusCode.INVALID_INPUTS),
    (check_areas, AlStatusCode.INVALID_SYNC_MANAGERS),
)
_SYNC: tuple[Check, ...] = (
    (check_sync0, AlStatusCode.INVALID_DC_SYNC),
    (check_cycle, AlStatusCode.INVALID_SYNC0_CYCLE),
    (check_pulses, AlStatusCode.FATAL_SYNC_ERROR),
)

# Conditions of the steps up. A step down is always allowed; any other pair is 0x0011.
UPWARD: dict[tuple[AlState, AlState], tuple[Check, ...]] = {
    (AlState.INIT, AlState.PRE_OP): _MAILBOXES,
    (AlState.INIT, AlState.BOOTSTRAP): ((check_mailboxes, AlStatusCode.INVALID_MAILBOX_BOOT),),
    (AlState.PRE_OP, AlState.SAFE_OP): (
        *_MAILBOXES,
        (lambda esc, device: _mapped(device, device.roles.outputs), AlStatusCode.INVALID_OUTPUT_MAPPING),
        (lambda esc, device: _mapped(device, device.roles.inputs), AlStatusCode.INVALID_INPUT_MAPPING),
        *_BUFFERS,
        (check_watchdog, AlStatusCode.INVALID_WATCHDOG),
        *_SYNC,
    ),
    (AlState.SAFE_OP, AlState.OP): _SYNC,
}

_PROCESS_DATA = ((_MAILBOXES, AlState.INIT), (_BUFFERS, AlState.PRE_OP))
# Conditions that must stay true in a state when sync managers are written, and the state after a failure.
HELD: dict[AlState, tuple[tuple[tuple[Check, ...], AlState], ...]] = {
    AlState.INIT: (),
    AlState.PRE_OP: _PROCESS_DATA[:1],
    AlState.BOOTSTRAP: _PROCESS_DATA[:1],
    AlState.SAFE_OP: _PROCESS_DATA,
    AlState.OP: _PROCESS_DATA,
}


def first_failure(checks: tuple[Check, ...], esc: Esc, device: DeviceModel) -> AlStatusCode:
    """Return the code of the first failing check, or NO_ERROR."""
    return next((code for holds, code in checks if not holds(esc, device)), AlStatusCode.NO_ERROR)


def judge(state: AlState, wanted: int, esc: Esc, device: DeviceModel) -> AlStatusCode:
    """Return the result for a slave in `state` that is asked for `wanted`, the low four bits of AL control."""
    if wanted not in AlState.__members__.values():
        return AlStatusCode.UNKNOWN_STATE
    if wanted == AlState.BOOTSTRAP and state == AlState.INIT and device.bootstrap is None:
        return AlStatusCode.BOOTSTRAP_NOT_SUPPORTED
    if wanted == state or (wanted < state and AlState.BOOTSTRAP not in (wanted, state)) or wanted == AlState.INIT:
        return AlStatusCode.NO_ERROR
    checks = UPWARD.get((state, AlState(wanted)))
    return AlStatusCode.INVALID_STATE_CHANGE if checks is None else first_failure(checks, esc, device)


MISSED: Final = 3
MET: Final = 1
"""Change of the sync error counter by a SYNC0 window: plus MISSED without outputs, minus MET with outputs."""
SYNC_TYPE, CYCLE_TIME, MISSED_COUNTER, SYNC_ERROR = 1, 2, 11, 32
TYPE_SM_EVENT, TYPE_SYNC0 = 1, 2
OUTPUT_PARAMETERS, INPUT_PARAMETERS = 0x1C32, 0x1C33


class SyncMonitor:
    """Supervises SYNC0: counts the windows between two pulses without outputs (ETG.1020, 21.2)."""

    def __init__(self, esc: Esc, device: DeviceModel) -> None:
        self._dc = esc.dc
        self._device = device
        self._buffers = 0
        self._counter = 0
        self._limit = 0
        self._missed = 0
        self.active = False
        """True: SYNC0 steps the device."""

    @property
    def running(self) -> bool:
        """Whether SYNC0 pulses have started and will continue."""
        return self._dc is not None and self._dc.sync0.pulses > 0 and self._dc.sync0.due is not None

    def configure(self) -> None:
        """Read the use of SYNC0 from the DC activation register; report it in 0x1C32 and 0x1C33."""
        sync0 = None if self._dc is None or not self._dc.sync0_active else self._dc.sync0
        self.active = sync0 is not None and self._device.uses_sync0
        cycle = 0 if sync0 is None or not self.active else sync0.cycle
        for index in (OUTPUT_PARAMETERS, INPUT_PARAMETERS):
            self._show(index, SYNC_TYPE, TYPE_SYNC0 if self.active else TYPE_SM_EVENT)
            self._show(index, CYCLE_TIME, cycle)

    def start(self) -> None:
        """Enter OP: count from zero, with the present limit (0: no limit)."""
        self._limit = self._device.sync_error_limit
        self._counter = 0
        self._buffers = 1
        self._show(OUTPUT_PARAMETERS, SYNC_ERROR, 0)

    def stop(self) -> None:
        """Stop when the slave leaves SAFE-OP."""
        self.active = False

    def outputs_arrived(self) -> None:
        """A complete buffer of outputs arrived."""
        self._buffers += 1

    def pulse(self, on_time: bool) -> bool:
        """Handle a SYNC0 pulse; return whether the error counter is above its limit.

        A pulse noticed late (the process was stopped) consumes one of the buffers received meanwhile and is no miss.
        """
        if not on_time:
            self._buffers = max(0, self._buffers - 1)
            return False
        if self._buffers:
            self._buffers = 0
            self._counter = max(0, self._counter - MET)
            return False
        self._counter += MISSED
        self._missed = (self._missed + 1) & 0xFFFF
        self._show(OUTPUT_PARAMETERS, MISSED_COUNTER, self._missed)
        exceeded = 0 < self._limit < self._counter
        if exceeded:
            self._show(OUTPUT_PARAMETERS, SYNC_ERROR, 1)
        return exceeded

    def _show(self, index: int, subindex: int, value: int) -> None:
        objects = self._device.objects
        if (index, subindex) in objects:
            objects[index, subindex].value = value
