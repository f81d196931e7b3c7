"""The EtherCAT state machine of a slave as tables: what may be asked for, what is checked, what a refusal is called.

States and transitions: ETG.1000.6, 6.4.1; AL status codes: ETG.1020, table 11.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

from rtcp.virtual.device import Device
from rtcp.virtual.distributed_clock import SYNC0
from rtcp.virtual.esc import MEMORY_SIZE, Esc
from rtcp.virtual.objects import SdoAbort
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage
from rtcp.virtual.registers import REGISTER_SPACE, Register, State
from rtcp.virtual.syncmanager import SyncManager

MAILBOX_OUT, MAILBOX_IN, OUTPUTS, INPUTS = range(4)
"""Sync managers of a slave with mailbox, by their use (ETG.1000.6, 5.6.7.4)."""
MINIMUM_MAILBOX = 34
"""Smallest mailbox of a CoE slave, in bytes: SDO information needs it (ETG.1020, 8.1)."""
BUFFERS = 3
MINIMUM_CYCLE = (0x1C32, 5)


class AlStatusCode(IntEnum):
    """AL status codes that these slaves report."""

    NO_ERROR = 0x0000
    INVALID_STATE_CHANGE = 0x0011
    UNKNOWN_STATE = 0x0012
    BOOTSTRAP_NOT_SUPPORTED = 0x0013
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


@dataclass(frozen=True)
class Parts:
    """What a check looks at."""

    esc: Esc
    device: Device


Check = Callable[[Parts], AlStatusCode]


def _in_ram(manager: SyncManager, size: int) -> bool:
    return manager.start >= REGISTER_SPACE and manager.start + size <= MEMORY_SIZE


def check_mailboxes(parts: Parts) -> AlStatusCode:
    """SM0 and SM1 must be mailboxes, out and in, long enough and apart."""
    out, in_ = parts.esc.sync_managers[MAILBOX_OUT], parts.esc.sync_managers[MAILBOX_IN]
    good = (
        all(m.enabled and m.mailbox and m.length >= MINIMUM_MAILBOX and _in_ram(m, m.length) for m in (out, in_))
        and out.master_writes
        and not in_.master_writes
        and (out.end <= in_.start or in_.end <= out.start)
    )
    return AlStatusCode.NO_ERROR if good else AlStatusCode.INVALID_MAILBOX_PREOP


def mapped_image(device: Device, assignment: int) -> PdoImage | None:
    """The process image that `assignment` (0x1C12, 0x1C13) gives; None where it maps what does not exist."""
    try:
        return PdoImage.from_assignment(device.objects, assignment)
    except (SdoAbort, ValueError):
        return None


def check_output_mapping(parts: Parts) -> AlStatusCode:
    """All that 0x1C12 maps must exist."""
    found = mapped_image(parts.device, RX_ASSIGN)
    return AlStatusCode.INVALID_OUTPUT_MAPPING if found is None else AlStatusCode.NO_ERROR


def check_input_mapping(parts: Parts) -> AlStatusCode:
    """All that 0x1C13 maps must exist."""
    found = mapped_image(parts.device, TX_ASSIGN)
    return AlStatusCode.INVALID_INPUT_MAPPING if found is None else AlStatusCode.NO_ERROR


def _fits(manager: SyncManager, length: int, master_writes: bool) -> bool:
    """Whether the sync manager is right for an image of `length` bytes; none at all needs none."""
    if not length:
        return not manager.enabled
    return (
        manager.enabled
        and not manager.mailbox
        and manager.master_writes == master_writes
        and manager.length == length
        and _in_ram(manager, BUFFERS * length)
    )


def check_outputs(parts: Parts) -> AlStatusCode:
    """SM2 must be a buffer that the master writes, as long as the RxPDOs."""
    image = mapped_image(parts.device, RX_ASSIGN)
    good = image is not None and _fits(parts.esc.sync_managers[OUTPUTS], image.byte_length, True)
    return AlStatusCode.NO_ERROR if good else AlStatusCode.INVALID_OUTPUTS


def check_inputs(parts: Parts) -> AlStatusCode:
    """SM3 must be a buffer that the master reads, as long as the TxPDOs."""
    image = mapped_image(parts.device, TX_ASSIGN)
    good = image is not None and _fits(parts.esc.sync_managers[INPUTS], image.byte_length, False)
    return AlStatusCode.NO_ERROR if good else AlStatusCode.INVALID_INPUTS


def check_areas(parts: Parts) -> AlStatusCode:
    """No two sync managers may share memory; a buffer takes its length three times."""
    areas = sorted(
        (m.start, m.start + m.length * (1 if m.mailbox else BUFFERS)) for m in parts.esc.sync_managers if m.enabled
    )
    apart = all(first[1] <= second[0] for first, second in pairwise(areas))
    return AlStatusCode.NO_ERROR if apart else AlStatusCode.INVALID_SYNC_MANAGERS


def check_watchdog(parts: Parts) -> AlStatusCode:
    """A watchdog that SM2 triggers and that has a time must have a divider to count it with."""
    esc = parts.esc
    wanted = esc.sync_managers[OUTPUTS].watchdog_trigger and esc.get(Register.WATCHDOG_PROCESS_DATA, 2)
    if wanted and not esc.get(Register.WATCHDOG_DIVIDER, 2):
        return AlStatusCode.INVALID_WATCHDOG
    return AlStatusCode.NO_ERROR


def check_sync(parts: Parts) -> AlStatusCode:
    """Where SYNC pulses are on there must be SYNC0, with a cycle that the device can keep, and it must still come."""
    dc = parts.esc.dc
    if dc is None or not dc.cyclic:
        return AlStatusCode.NO_ERROR
    if not dc.activation & SYNC0 or not dc.sync0.cycle:
        return AlStatusCode.INVALID_DC_SYNC
    objects = parts.device.objects
    minimum = objects[MINIMUM_CYCLE].value if MINIMUM_CYCLE in objects else 0
    if isinstance(minimum, int) and dc.sync0.cycle < minimum:
        return AlStatusCode.INVALID_SYNC0_CYCLE
    # Pulses left on by the last master whose time base was set anew since: they came and come no more (SOEM#60).
    if dc.sync0.lost and dc.sync0.pulses:
        return AlStatusCode.FATAL_SYNC_ERROR
    return AlStatusCode.NO_ERROR


_PROCESS_DATA: tuple[Check, ...] = (
    check_output_mapping, check_input_mapping, check_outputs, check_inputs, check_areas, check_watchdog, check_sync,
)  # fmt: skip

# Steps up, and what must hold for them. A step down is always allowed; any other pair is 0x0011.
UPWARD: dict[tuple[State, State], tuple[Check, ...]] = {
    (State.INIT, State.PRE_OP): (check_mailboxes,),
    (State.PRE_OP, State.SAFE_OP): (check_mailboxes, *_PROCESS_DATA),
    (State.SAFE_OP, State.OP): (check_sync,),
}

# What must go on to hold in a state when sync managers are written, and where the slave falls to otherwise.
HELD: dict[State, tuple[tuple[tuple[Check, ...], State], ...]] = {
    State.INIT: (),
    State.PRE_OP: (((check_mailboxes,), State.INIT),),
    State.SAFE_OP: (((check_mailboxes,), State.INIT), ((check_outputs, check_inputs, check_areas), State.PRE_OP)),
    State.OP: (((check_mailboxes,), State.INIT), ((check_outputs, check_inputs, check_areas), State.PRE_OP)),
}


def first_failure(checks: tuple[Check, ...], parts: Parts) -> AlStatusCode:
    """The code of the first check that fails, or NO_ERROR."""
    for check in checks:
        code = check(parts)
        if code:
            return code
    return AlStatusCode.NO_ERROR


def judge(state: State, wanted: int, parts: Parts) -> AlStatusCode:
    """Whether a slave in `state` may go to `wanted`, the value of AL control's low four bits."""
    if wanted not in State.__members__.values():
        return AlStatusCode.UNKNOWN_STATE
    if wanted == State.BOOTSTRAP:
        return AlStatusCode.BOOTSTRAP_NOT_SUPPORTED if state == State.INIT else AlStatusCode.INVALID_STATE_CHANGE
    if wanted <= state:
        return AlStatusCode.NO_ERROR
    checks = UPWARD.get((state, State(wanted)))
    return AlStatusCode.INVALID_STATE_CHANGE if checks is None else first_failure(checks, parts)
