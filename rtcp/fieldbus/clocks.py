"""Distributed clocks on the way to SAFE-OP: delays, offsets, SYNC0 (ETG.1000.4, 6.8)."""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from typing import Any

from rtcp.config.model import DeviceDescription, SlaveConfig
from rtcp.fieldbus.bus import slave_label, station_of
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import FEATURE_DC, Register, RegisterPort, Steps
from rtcp.fieldbus.system_time import RANGE_32, SystemTime
from rtcp.fieldbus.topology import PortState, Topology, port_states

_DC_SPEED_DEFAULT = b"\x00\x10"
_SYNC_DELAY_NS = 100_000_000
"""Least time from the activation to the first SYNC0, ns."""
_SETTLED_NS = 2_000
_SETTLE_S = 1.5
_UNTIL_2000_NS = 946_684_800 * 1_000_000_000
_EARLIEST_NS = 86_400 * 1_000_000_000
"""Least system time that is set, ns: a host's clock may be before 2000, and a clock of 64 bits needs to show more than
one of 32 bits can."""
_RANGE_64 = 1 << 64
_SYNC_ATTEMPTS = 4
_LONGEST_DELAY_NS = 1_000_000
"""Upper bound on a propagation delay, ns: of 200 slaves with 100 m of cable before each it is a third."""


def start_clocks(
    master: Any, port: RegisterPort, slaves: Sequence[SlaveConfig], period_ns: int
) -> tuple[SystemTime, int | None]:
    """Set the clocks and start SYNC0 where the device's file says so (`assign_activate`).

    Args:
        master: pysoem's master, its slaves in PRE-OP and mapped.
        port: the port for registers.
        slaves: the slaves of the configuration.
        period_ns: the cycle of SYNC0.

    Returns:
        The time to which they are set. The position of the reference clock, the first clock that can be set, if SOEM's
        frames do not carry its time: SOEM takes the first slave that measures delays.

    Raises:
        BusError: no clock, a clock that cannot be set (`measure_delays`, `_set_clocks`), SYNC0 in the past, or an
            activation that reads back differently.
    """
    labels = {position: slave_label(position, config.name) for position, config in enumerate(slaves, 1)}
    clocks = clocks_of(port, labels)
    synchronous = {
        position: config.device for position, config in enumerate(slaves, 1) if config.device.assign_activate
    }
    for position, device in synchronous.items():
        if position not in clocks:
            raise BusError(
                f"{labels[position]}: `assign_activate` is 0x{device.assign_activate:04X} but it has no distributed "
                "clock that can be set (registers 0x0008 and 0x0928)"
            )
    system_time = SystemTime()
    reference = min(clocks, default=0)
    is_first = not any(_measures(port, position) for position in range(1, reference))
    if is_first:
        # SOEM's frames of process data carry the time of a clock only after this. It also sets clocks, unchecked.
        master.config_dc()
    _set_clocks(port, clocks, measure_delays(port, labels, clocks), system_time)
    for position, device in synchronous.items():
        start_sync(port, station_of(position), labels[position], device, period_ns, system_time)
    return system_time, None if is_first else reference


def clocks_of(port: RegisterPort, labels: dict[int, str]) -> dict[int, str]:
    """Return those of the slaves (position: label) whose clock can be set; others at most measure delays."""
    return {
        position: label
        for position, label in labels.items()
        if _measures(port, position) and port.read(station_of(position), Register.DC_DELAY, 4) is not None
    }


def _measures(port: RegisterPort, position: int) -> bool:
    """Whether a slave has a clock, or at least measures delays."""
    features = port.read(station_of(position), Register.FEATURES, 2)
    return features is not None and bool(features[0] & FEATURE_DC)


def measure_delays(port: RegisterPort, labels: dict[int, str], clocks: dict[int, str]) -> dict[int, int]:
    """Measure the propagation delays from the reference clock and write them; return them by position, ns.

    One broadcast latches in each slave when its frame passed each port (ETG.1000.4, 6.8). Every frame is checked:
    SOEM's own measurement takes a time of another slave where a frame got lost (`benchmarks/delays.py`).

    Args:
        port: the port for registers.
        labels: all slaves, by position.
        clocks: what `clocks_of` returned.

    Raises:
        BusError: a slave stopped answering, or times that no cable gives.
    """
    if not clocks:
        return {}
    status = [_read(port, position, Register.DL_STATUS, 2, label) for position, label in labels.items()]
    ports = [port_states(register) for register in status]
    measuring = [position for position in labels if position in clocks or _measures(port, position)]
    if (latched := port.write_all(Register.DC_PORT_RECEIVE_TIMES, bytes(4))) < len(measuring):
        raise BusError(f"{latched} of {len(measuring)} slaves latched the times that give the propagation delays")
    passages = {position: _passages(port, position, labels[position], ports[position - 1]) for position in measuring}
    tree = Topology.of(ports)
    branches: dict[tuple[int, int], list[int]] = {}
    for position in measuring:
        parent, child = tree.parent(position), position
        while parent and parent not in passages:
            parent, child = tree.parent(parent), parent
        number = sum(tree.parent(other) == parent for other in range(1, child + 1))
        branches.setdefault((parent, number), []).append(position)
    arrivals: dict[int, int] = {}
    for (parent, number), members in branches.items():
        if not parent:
            # Nothing measures the way to them.
            arrivals.update(dict.fromkeys(members, 0))
            continue
        if number >= len(passages[parent]):
            raise BusError(
                f"{labels[parent]}: {len(passages[parent]) - 1} of its ports lead to slaves, but {number} branches "
                "were found (register 0x0110)"
            )
        out, back = passages[parent][number - 1 : number + 1]
        # The cables between them take the rest; a frame takes as long there as back.
        cables = back - out - sum(passages[member][-1] for member in members)
        for count, member in enumerate(members, 1):
            arrivals[member] = arrivals[parent] + out + count * cables // (len(members) + 1)
            out += passages[member][-1]
    reference = arrivals[min(clocks)]
    delays = {position: arrivals[position] - reference for position in clocks}
    for position, delay in delays.items():
        if abs(delay) > _LONGEST_DELAY_NS:
            raise BusError(
                f"{clocks[position]}: its propagation delay (register 0x0928) would be {delay} ns by the times at the "
                f"ports (register 0x0900), allowed are {_LONGEST_DELAY_NS} ns"
            )
        port.put(station_of(position), Register.DC_DELAY, delay.to_bytes(4, "little", signed=True), clocks[position])
    return delays


def _passages(port: RegisterPort, position: int, label: str, ports: Sequence[PortState]) -> list[int]:
    """Return after which times the latching frame was at each open port, in its order: 0 at its arrival, ns."""
    content = _read(port, position, Register.DC_PORT_RECEIVE_TIMES, 16, label)
    times = [content >> 32 * number & RANGE_32 - 1 for number, state in enumerate(ports) if state is PortState.OPEN]
    # The times wrap, and a cable may be plugged into any port: from the arrival on the last one is nearest.
    around = [sorted((time - first) % RANGE_32 for time in times) for first in times]
    return min(around, key=lambda passages: passages[-1], default=[0])


def _set_clocks(port: RegisterPort, clocks: dict[int, str], delays: dict[int, int], system_time: SystemTime) -> None:
    """Set all clocks to the host's time since 2000: one broadcast latches their local times (ETG.1000.4, 6.8).

    SOEM has done so already, in frames that nobody checks. Raises BusError: a slave stopped answering.
    """
    if not clocks:
        return
    if port.write_all(Register.DC_PORT_RECEIVE_TIMES, bytes(4)) < 1:
        raise BusError("no slave latched its local time while the clocks were set")
    latched = max(time.time_ns() - _UNTIL_2000_NS, _EARLIEST_NS)
    system_time.offset_ns = latched - time.monotonic_ns()
    for position, label in clocks.items():
        own = _read(port, position, Register.DC_RECEIVE_TIME, 8, label)
        _write_time(port, station_of(position), Register.DC_OFFSET, latched + delays[position] - own, label)


def _write_time(port: RegisterPort, station: int, register: Register, time_ns: int, label: str) -> None:
    """Write a time; a clock of 32 bits takes its low half. Raises BusError: not even that was taken."""
    port.put(station, register, (time_ns % _RANGE_64).to_bytes(8, "little"), label)


def _read(
    port: RegisterPort, position: int, register: Register, length: int, label: str, *, signed: bool = False
) -> int:
    content = port.read(station_of(position), register, length)
    if content is None:
        raise BusError(f"{label} stopped answering while the clocks were set")
    return int.from_bytes(content, "little", signed=signed)


def take_over_time(
    port: RegisterPort,
    station: int,
    label: str,
    delay: bytes,
    others: Sequence[int],
    system_time: SystemTime,
    *,
    always: bool,
) -> None:
    """Set the clock of one slave by that of another: one broadcast latches the local times of both (ETG.1000.4, 6.8).

    Args:
        port: the port for registers.
        station: address of the slave whose clock is set; SYNC0 is off.
        label: the slave in messages.
        delay: its propagation delay from the reference clock, content of register 0x0928.
        others: the other slaves with a clock, the reference first; the first one that answers is used.
        system_time: extends the other's time; without another clock it is the time that is set.
        always: set the clock even if it already shows the reference's time.

    Raises:
        BusError: it stopped answering, or no slave took the broadcast.
    """
    if not always:
        difference = port.read(station, Register.DC_DIFFERENCE, 4)
        if difference is not None and _difference(difference) < _SETTLED_NS:
            return
    # Otherwise the two registers below would hold times of two different frames.
    if port.write_all(Register.DC_PORT_RECEIVE_TIMES, bytes(4)) < 1:
        raise BusError(f"{label}: the local times could not be latched while its clock was set")
    latched_ns = time.monotonic_ns()
    # Without another clock this is the time that is set.
    time_then = latched_ns + (system_time.offset_ns or 0)
    own = port.read(station, Register.DC_RECEIVE_TIME, 8)
    if own is None:
        raise BusError(f"{label} stopped answering while its clock was set")
    for neighbour in others:
        theirs = [port.read(station_of(neighbour), at, 8) for at in (Register.DC_RECEIVE_TIME, Register.DC_OFFSET)]
        their_delay = port.read(station_of(neighbour), Register.DC_DELAY, 4)
        if None not in theirs and their_delay is not None:
            shown = sum(int.from_bytes(part or b"", "little") for part in theirs) % RANGE_32
            time_then = system_time.extended(shown, latched_ns)
            time_then += int.from_bytes(delay, "little", signed=True)
            time_then -= int.from_bytes(their_delay, "little", signed=True)
            break
    port.put(station, Register.DC_DELAY, delay, label)
    _write_time(port, station, Register.DC_OFFSET, time_then - int.from_bytes(own, "little"), label)


def forget_drift(port: RegisterPort, station: int, label: str) -> None:
    """Reset a slave's drift compensation: it may have followed a stopped reference clock."""
    port.put(station, Register.DC_SPEED, _DC_SPEED_DEFAULT, label)


def settle_clock(port: RegisterPort, station: int, label: str) -> Steps[None]:
    """Wait until drift compensation has settled a slave's clock; raises BusError after `_SETTLE_S`."""
    until = time.monotonic() + _SETTLE_S
    while True:
        difference = port.read(station, Register.DC_DIFFERENCE, 4)
        if difference is not None and _difference(difference) < _SETTLED_NS:
            return
        if time.monotonic() >= until:
            text = "nothing" if difference is None else f"{_difference(difference) / 1000:g} us"
            raise BusError(
                f"{label}: its clock is not within {_SETTLED_NS / 1000:g} us of the reference clock's after "
                f"{_SETTLE_S:g} s (register 0x092C shows {text}); it is set anew"
            )
        yield


def _difference(register: bytes) -> int:
    # Sign and magnitude (ETG.1000.4, table 60).
    return int.from_bytes(register, "little") & 0x7FFF_FFFF


def sync_cycles(device: DeviceDescription, period_ns: int) -> tuple[int, int]:
    """Return the contents of registers 0x09A0 and 0x09A4: cycle of SYNC0, and time from it to SYNC1, ns.

    If that time is a cycle of SYNC0 or more, SYNC1 comes only after it, not with every SYNC0 (ETG.1000.4, 6.8.5).
    """
    sync0 = _cycle(device.sync0_factor, device.sync0_cycle_us, period_ns, period_ns)
    # In ETG.2000 SYNC1's cycle counts from the SYNC0 at which it occurs; in the register from the next one.
    sync1 = _cycle(device.sync1_factor, device.sync1_cycle_us, sync0, period_ns)
    return sync0, max(sync1 - sync0, 0) + round(device.sync1_shift_us * 1000)


def _cycle(factor: int, cycle_us: float, multiple_of_ns: int, part_of_ns: int) -> int:
    if factor > 0:
        return factor * multiple_of_ns
    return part_of_ns // -factor if factor else round(cycle_us * 1000)


def start_sync(
    port: RegisterPort, station: int, label: str, device: DeviceDescription, period_ns: int, system_time: SystemTime
) -> None:
    """Start SYNC0 of one slave on the grid of the others: multiples of its cycle, shifted by `sync0_shift_us`.

    The grid is that of the system time: 2^32 ns are no multiple of a cycle, so a clock of 32 bits does not show it.

    Raises:
        BusError: its first SYNC0 lies in the past, or the activation reads back differently.
    """
    shift = round(device.sync0_shift_us * 1000)
    sync0, after = sync_cycles(device, period_ns)
    grid = max(sync0, period_ns)
    cycles = struct.pack("<II", sync0, after)
    activation = device.assign_activate.to_bytes(2, "little")
    for _ in range(_SYNC_ATTEMPTS):
        port.put(station, Register.DC_CYCLIC_UNIT, bytes(2), label)
        shown = port.read(station, Register.DC_SYSTEM_TIME, 4)
        if shown is None:
            raise BusError(f"{label} stopped answering while its SYNC0 was started")
        now = system_time.extended(int.from_bytes(shown, "little"), time.monotonic_ns())
        begin = (now + _SYNC_DELAY_NS) // grid * grid + grid + shift
        _write_time(port, station, Register.DC_START, begin, label)
        port.put(station, Register.DC_SYNC0_CYCLE, cycles, label)
        if port.read(station, Register.DC_SYNC0_CYCLE, len(cycles)) != cycles:
            kept = f"SYNC0, {sync0 / 1000:g} us, and SYNC1, {after / 1000:g} us after it (registers 0x09A0 and 0x09A4)"
            raise BusError(f"{label}: it does not keep the cycle of {kept}")
        # The whole word at once, as IgH does: its low byte assigns latches and sync unit to master or device.
        port.put(station, Register.DC_CYCLIC_UNIT, activation, label)
        # A SYNC0 whose time has passed at the activation never comes (SOEM#757); lost frames may have delayed that.
        if first_sync_is_ahead(port, station):
            break
    else:
        raise BusError(f"{label}: its first SYNC0 lies in the past: it would never come")
    active = port.read(station, Register.DC_CYCLIC_UNIT, 2)
    if active != activation:
        text = "nothing" if active is None else f"0x{int.from_bytes(active, 'little'):04X}"
        raise BusError(
            f"{label}: `assign_activate` 0x{device.assign_activate:04X} reads back from register 0x0980 as {text}"
        )


def first_sync_is_ahead(port: RegisterPort, station: int) -> bool:
    """Whether the next SYNC0 of the slave is still to come."""
    now = port.read(station, Register.DC_SYSTEM_TIME, 4)
    start = port.read(station, Register.DC_START, 4)
    if now is None or start is None:
        return False
    # Only the low 32 bits: an ESC may have no more.
    ahead = int.from_bytes(start, "little") - int.from_bytes(now, "little") & 0xFFFFFFFF
    return 0 < ahead < 0x80000000
