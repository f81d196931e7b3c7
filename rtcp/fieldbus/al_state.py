"""The EtherCAT state machine: states, AL status codes in words, requests (ETG.1000.6, 5.3; codes: ETG.1020)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from enum import IntEnum

from rtcp.fieldbus.registers import DEVICE_EMULATION, PATIENT_TRIES, TRIES, Register, RegisterPort

ERROR_BIT = 0x10
"""Error indication in AL status, acknowledge in AL control (ETG.1000.6, 5.3.1 and 5.3.2)."""


class AlState(IntEnum):
    """States of the EtherCAT state machine."""

    NONE = 0
    """No answer."""
    INIT = 1
    PREOP = 2
    BOOT = 3
    SAFEOP = 4
    OP = 8


STATE_NAMES = {
    AlState.NONE: "no answer",
    AlState.INIT: "INIT",
    AlState.PREOP: "PRE-OP",
    AlState.BOOT: "BOOT",
    AlState.SAFEOP: "SAFE-OP",
    AlState.OP: "OP",
}

# code: (meaning, what to do about it; empty where the meaning says it all)
AL_STATUS_CODES: dict[int, tuple[str, str]] = {
    0x0000: ("no error", ""),
    0x0001: ("unspecified error", "look at the device's own diagnosis"),
    0x0002: ("no memory", "map fewer objects"),
    0x0003: ("invalid device setup", "check its modules and its wiring"),
    0x0004: ("invalid revision", "compare its firmware with its description"),
    0x0006: ("SII and firmware do not match", "write the EEPROM that belongs to this firmware"),
    0x0007: ("firmware update not successful", "update its firmware again"),
    0x000E: ("licence error", "the device lacks a licence of its maker"),
    0x0011: ("invalid requested state change", "go through the states one by one"),
    0x0012: ("unknown requested state", ""),
    0x0013: ("bootstrap not supported", ""),
    0x0014: ("no valid firmware", "update its firmware"),
    0x0015: ("invalid mailbox configuration for BOOT", "compare SM0 and SM1 with its EEPROM"),
    0x0016: ("invalid mailbox configuration for PRE-OP", "compare SM0 and SM1 with its EEPROM"),
    0x0017: ("invalid sync manager configuration", "compare SM2 and SM3 with its PDO mapping"),
    0x0018: ("no valid inputs available", "the device cannot give input data yet"),
    0x0019: ("no valid outputs", "process data must arrive before OP is requested"),
    0x001A: ("synchronization error", "frames miss their SYNC0 window: check the cycle's jitter and `send_phase`"),
    0x001B: ("sync manager watchdog", "no process data came for longer than `watchdog_ms`"),
    0x001C: ("invalid sync manager types", ""),
    0x001D: ("invalid output configuration", "the length of SM2 differs from the assigned RxPDOs: check `rpdo`"),
    0x001E: ("invalid input configuration", "the length of SM3 differs from the assigned TxPDOs: check `tpdo`"),
    0x001F: ("invalid watchdog configuration", "check `watchdog_ms`"),
    0x0020: ("slave needs cold start", "switch it off and on"),
    0x0021: ("slave needs INIT", "request INIT first"),
    0x0022: ("slave needs PRE-OP", "request PRE-OP first"),
    0x0023: ("slave needs SAFE-OP", "request SAFE-OP first"),
    0x0024: ("invalid input mapping", "check `tpdo`"),
    0x0025: ("invalid output mapping", "check `rpdo`"),
    0x0026: ("inconsistent settings", "check `rpdo`, `tpdo` and `sdo` against its manual"),
    0x0027: ("free run not supported", "set `assign_activate` as in its ESI file"),
    0x0028: ("synchronization not supported", "set `assign_activate` to 0"),
    0x0029: ("free run needs three-buffer mode", ""),
    0x002A: ("background watchdog", "look at the device's own diagnosis"),
    0x002B: ("no valid inputs and outputs", ""),
    0x002C: ("fatal SYNC error: no SYNC0 was seen", "check `assign_activate` and distributed clocks"),
    0x002D: ("no SYNC error: SYNC0 was never seen", "check `assign_activate` and distributed clocks"),
    0x002E: ("cycle time too small", "choose a longer `period_us`"),
    0x0030: ("invalid DC SYNC configuration", "check `assign_activate` and `period_us`"),
    0x0031: ("invalid DC latch configuration", ""),
    0x0032: ("PLL error: the device cannot follow the master's clock", "check the cycle's jitter"),
    0x0033: ("DC SYNC IO error", "check the cycle's jitter"),
    0x0034: ("DC SYNC timeout: too many SYNC events were missed", "check the cycle's jitter"),
    0x0035: ("invalid DC SYNC cycle time", "check `period_us`"),
    0x0036: ("invalid DC SYNC0 cycle time", "check `period_us`"),
    0x0037: ("invalid DC SYNC1 cycle time", "check `assign_activate`"),
    0x0041: ("AoE mailbox error", ""),
    0x0042: ("EoE mailbox error", ""),
    0x0043: ("CoE mailbox error", ""),
    0x0044: ("FoE mailbox error", ""),
    0x0045: ("SoE mailbox error", ""),
    0x004F: ("VoE mailbox error", ""),
    0x0050: ("EEPROM no access", "the master must hand the EEPROM over to the device"),
    0x0051: ("EEPROM error", "check the device's EEPROM"),
    0x0052: ("external hardware is not ready", "check the device's supply"),
    0x0060: ("slave restarted locally", ""),
    0x0061: ("device identification value updated", ""),
    0x0070: ("detected module list does not match the configured one", ""),
    0x00F0: ("application controller available", ""),
}  # fmt: skip


def state_name(state: int) -> str:
    """Return the state in words; the error indication is named: `SAFE-OP + ERROR`."""
    base = state & 0x0F
    name = STATE_NAMES[AlState(base)] if base in AlState._value2member_map_ else f"unknown state {base}"
    return f"{name} + ERROR" if state & ERROR_BIT else name


def code_meaning(code: int) -> str:
    """Return what an AL status code means."""
    if code in AL_STATUS_CODES:
        return AL_STATUS_CODES[code][0]
    return "specific to the maker" if code >= 0x8000 else "not in ETG.1020"


def code_remedy(code: int) -> str:
    """Return what can be done about an AL status code; empty where nothing is known."""
    return AL_STATUS_CODES.get(code, ("", ""))[1]


def refusal(slave: str, requested: int, found: int, code: int) -> str:
    """Return the message for a slave that did not reach a requested state.

    Args:
        slave: the slave as `bus.slave_label` names it.
        requested: AL state that was requested.
        found: AL state that it is in, error indication included.
        code: its AL status code; 0 where it gave none.
    """
    if not found & 0x0F:
        return f"{slave} did not reach {state_name(requested)}: it does not answer; check its cable and its supply"
    said = f"AL status code 0x{code:04X}: {code_meaning(code)}" if code else "it gave no reason (AL status code 0)"
    remedy = code_remedy(code)
    return f"{slave} did not reach {state_name(requested)}: it is in {state_name(found)}; {said}" + (
        f"; {remedy}" if remedy else ""
    )


_POLL_S = 0.002


def read_al(port: RegisterPort, station: int, tries: int | None = None) -> tuple[AlState, bool, int]:
    """Return state, error indication and AL status code of a slave; state NONE where it does not answer.

    Args:
        port: the port to ask through.
        station: the slave's configured address.
        tries: frames that may be lost before it counts as one that does not answer; None: as many as the port's.
    """
    data = port.read(station, Register.AL_STATUS, 6, tries=tries)
    if data is None:
        return AlState.NONE, False, 0
    status = int.from_bytes(data[:2], "little")
    base = status & 0x0F
    state = AlState(base) if base in AlState._value2member_map_ else AlState.NONE
    return state, bool(status & ERROR_BIT), int.from_bytes(data[4:6], "little")


def is_emulated(port: RegisterPort, station: int) -> bool:
    """Whether a slave has no state machine of its own: AL status shows what AL control was set to, all bits of it."""
    configuration = port.read(station, Register.ESC_CONFIGURATION, 1)
    return configuration is not None and bool(configuration[0] & DEVICE_EMULATION)


def request_state(port: RegisterPort, stations: Iterable[int], state: AlState) -> None:
    """Request `state` of the slaves; an error that one of them shows is acknowledged with it. Nothing is waited for."""
    for station in stations:
        acknowledge = read_al(port, station)[1] and not is_emulated(port, station)
        port.write(station, Register.AL_CONTROL, (state | (ERROR_BIT if acknowledge else 0)).to_bytes(2, "little"))


def broadcast_state(port: RegisterPort, state: AlState) -> int:
    """Request `state` of all slaves at once and acknowledge their errors; return how many took it, -1: no frame."""
    return port.write_all(Register.AL_CONTROL, (state | ERROR_BIT).to_bytes(2, "little"))


def acknowledge(port: RegisterPort, station: int) -> AlState:
    """Acknowledge a slave's error; it stays in the state that it is in, which is returned."""
    state = read_al(port, station)[0]
    if state is not AlState.NONE:
        word = state if is_emulated(port, station) else state | ERROR_BIT
        port.write(station, Register.AL_CONTROL, word.to_bytes(2, "little"))
    return state


def wait_for_state(
    port: RegisterPort, slaves: Mapping[int, str], state: AlState, timeout_s: float
) -> tuple[str, ...]:  # fmt: skip
    """Wait until every slave is in `state` without an error.

    Args:
        port: the port to ask through.
        slaves: station address -> how sentences name the slave.
        state: the state that was requested.
        timeout_s: seconds to wait; a slave that shows an error is not waited for any longer.

    Returns:
        A sentence for each slave that did not get there; none where all did.
    """
    deadline = time.monotonic() + timeout_s
    waiting = dict(slaves)
    refused: dict[int, str] = {}
    while waiting:
        late = time.monotonic() >= deadline
        for station, label in tuple(waiting.items()):
            # The last look is the one that the slave is judged by.
            found, error, code = read_al(port, station, PATIENT_TRIES if late else TRIES)
            if found is state and not error:
                del waiting[station]
            elif error and not late and is_emulated(port, station):
                # It shows the acknowledgement of a broadcast.
                port.write(station, Register.AL_CONTROL, state.to_bytes(2, "little"))
            elif error or late:
                refused[station] = refusal(label, state, found | (ERROR_BIT if error else 0), code)
                del waiting[station]
        if waiting:
            time.sleep(_POLL_S)
    return tuple(refused[station] for station in slaves if station in refused)
