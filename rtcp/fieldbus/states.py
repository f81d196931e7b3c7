"""The AL state machine over a RegisterPort: usable beside the cycle (ETG.1000.6, 5.3; registers ETG.1000.4, 6.1)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping

from rtcp.fieldbus.alstatus import ERROR_BIT, AlState, refusal
from rtcp.fieldbus.registers import PATIENT_TRIES, TRIES, RegisterPort

AL_CONTROL = 0x0120
AL_STATUS = 0x0130
"""AL status (2 bytes), two bytes of nothing, AL status code (2 bytes)."""
_POLL_S = 0.002


def read_al(port: RegisterPort, station: int, tries: int | None = None) -> tuple[AlState, bool, int]:
    """Return state, error indication and AL status code of a slave; state NONE where it does not answer.

    Args:
        port: the port to ask through.
        station: the slave's configured address.
        tries: frames that may be lost before it counts as one that does not answer; None: as many as the port's.
    """
    data = port.read(station, AL_STATUS, 6, tries=tries)
    if data is None:
        return AlState.NONE, False, 0
    status = int.from_bytes(data[:2], "little")
    base = status & 0x0F
    state = AlState(base) if base in AlState._value2member_map_ else AlState.NONE
    return state, bool(status & ERROR_BIT), int.from_bytes(data[4:6], "little")


def request_state(port: RegisterPort, stations: Iterable[int], state: AlState) -> None:
    """Request `state` of the slaves; an error that one of them shows is acknowledged with it. Nothing is waited for."""
    for station in stations:
        error = read_al(port, station)[1]
        port.write(station, AL_CONTROL, (state | (ERROR_BIT if error else 0)).to_bytes(2, "little"))


def broadcast_state(port: RegisterPort, state: AlState) -> int:
    """Request `state` of all slaves at once and acknowledge their errors; return how many took it, -1: no frame."""
    return port.write_all(AL_CONTROL, (state | ERROR_BIT).to_bytes(2, "little"))


def acknowledge(port: RegisterPort, station: int) -> AlState:
    """Acknowledge a slave's error; it stays in the state that it is in, which is returned."""
    state = read_al(port, station)[0]
    if state is not AlState.NONE:
        port.write(station, AL_CONTROL, (state | ERROR_BIT).to_bytes(2, "little"))
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
            elif error or late:
                refused[station] = refusal(label, state, found | (ERROR_BIT if error else 0), code)
                del waiting[station]
        if waiting:
            time.sleep(_POLL_S)
    return tuple(refused[station] for station in slaves if station in refused)
