"""The EtherCAT state machine: states and requests (ETG.1000.6, 5.3)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from enum import IntEnum

from rtcp.fieldbus.registers import DEVICE_EMULATION, PATIENT_TRIES, TRIES, Register, RegisterPort
from rtcp.ipc.codes import ERROR_BIT, STATE_NAMES, refusal


class AlState(IntEnum):
    """States of the EtherCAT state machine."""

    NONE = 0
    """No answer."""
    INIT = 1
    PREOP = 2
    BOOT = 3
    SAFEOP = 4
    OP = 8


_POLL_S = 0.002


def read_al(port: RegisterPort, station: int, tries: int | None = None) -> tuple[AlState, bool, int]:
    """Return state, error indication and AL status code of a slave; state NONE where it does not answer,
    or answers none that exists.

    Args:
        port: the port to ask through.
        station: the slave's configured address.
        tries: number of frames after which a slave counts as not answering; None: the port's number.
    """
    return parse_al(port.read(station, Register.AL_STATUS, 6, tries=tries) or bytes(6), AlState.NONE)


def parse_al(data: bytes, unknown: AlState) -> tuple[AlState, bool, int]:
    """Return state, error indication and AL status code in the registers; `unknown` in the place of no such state."""
    status = int.from_bytes(data[:2], "little")
    base = status & 0x0F
    state = AlState(base) if base in STATE_NAMES else unknown
    return state, bool(status & ERROR_BIT), int.from_bytes(data[4:6], "little")


def is_emulated(port: RegisterPort, station: int) -> bool:
    """Whether a slave has no state machine of its own: its AL status is a copy of AL control, all bits."""
    configuration = port.read(station, Register.ESC_CONFIGURATION, 1)
    return configuration is not None and bool(configuration[0] & DEVICE_EMULATION)


def request_state(port: RegisterPort, stations: Iterable[int], state: AlState) -> None:
    """Request `state` of the slaves and acknowledge their errors; does not wait."""
    for station in stations:
        acknowledge = read_al(port, station)[1] and not is_emulated(port, station)
        port.write(station, Register.AL_CONTROL, (state | (ERROR_BIT if acknowledge else 0)).to_bytes(2, "little"))


def broadcast_state(port: RegisterPort, state: AlState) -> int:
    """Request `state` of all slaves and acknowledge their errors; return the working counter, -1: no frame."""
    return port.write_all(Register.AL_CONTROL, (state | ERROR_BIT).to_bytes(2, "little"))


def acknowledge(port: RegisterPort, station: int) -> AlState:
    """Acknowledge a slave's error; return its state, which does not change."""
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
        slaves: station address -> label of the slave in messages.
        state: the state that was requested.
        timeout_s: seconds to wait; an error ends the wait for its slave.

    Returns:
        A sentence for each slave that did not reach it.
    """
    deadline = time.monotonic() + timeout_s
    waiting = dict(slaves)
    refused: dict[int, str] = {}
    while waiting:
        late = time.monotonic() >= deadline
        for station, label in tuple(waiting.items()):
            # The last read decides.
            reached, error, code = read_al(port, station, PATIENT_TRIES if late else TRIES)
            if reached is state and not error:
                del waiting[station]
            elif error and not late and is_emulated(port, station):
                # It shows the acknowledge bit of a broadcast.
                port.write(station, Register.AL_CONTROL, state.to_bytes(2, "little"))
            elif error or late:
                refused[station] = refusal(label, state, reached | (ERROR_BIT if error else 0), code)
                del waiting[station]
        if waiting:
            time.sleep(_POLL_S)
    return tuple(refused[station] for station in slaves if station in refused)
