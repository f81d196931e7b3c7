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

_DC_SPEED_DEFAULT = b"\x00\x10"
_SYNC_DELAY_NS = 100_000_000
"""Least time from the activation to the first SYNC0, ns."""
_SETTLED_NS = 2_000
_SETTLE_S = 1.5
_UNTIL_2000_NS = 946_684_800 * 1_000_000_000
_SYNC_ATTEMPTS = 4
_SAME_DELAY_NS = 100
"""More than two measurements of one delay differ by, less than the delay of a slave's neighbour does."""
_NOT_MEASURED = 0x7FFF_FFFF
"""Content of a delay's register until SOEM has written it: that frame may get lost too."""
_MEASUREMENTS = 20


def start_clocks(master: Any, port: RegisterPort, slaves: Sequence[SlaveConfig], period_ns: int) -> None:
    """Set the clocks and start SYNC0 where the device's file says so (`assign_activate`).

    Args:
        master: pysoem's master, its slaves in PRE-OP and mapped.
        port: the port for registers.
        slaves: the slaves of the configuration.
        period_ns: the cycle of SYNC0.

    Raises:
        BusError: no clock, SYNC0 in the past, or an activation that reads back differently.
    """
    labels = [slave_label(position, config.name) for position, config in enumerate(slaves, 1)]
    clocks = set_clocks(master, port, labels)
    for position, (label, config) in enumerate(zip(labels, slaves, strict=True), 1):
        word = config.device.assign_activate
        if not word:
            continue
        if not clocks:
            raise BusError(f"{label}: `assign_activate` is 0x{word:04X} but no slave has a distributed clock")
        start_sync(port, station_of(position), label, config.device, period_ns)


def set_clocks(master: Any, port: RegisterPort, labels: Sequence[str]) -> bool:
    """Measure the propagation delays and set all clocks by the first; return whether there is one.

    SOEM measures, and does not notice a frame that was lost: the slave then gets the times of the one before it. So a
    delay counts once it was found twice; delays and offsets are then written with frames that are checked.

    Args:
        master: pysoem's master, its slaves in PRE-OP.
        port: the port for registers.
        labels: the slaves in messages, in the order of the cable.

    Raises:
        BusError: a slave stopped answering, or its delay was another one each time.
    """
    clocks = [
        position
        for position, label in enumerate(labels, 1)
        if _read(port, position, Register.FEATURES, 2, label) & FEATURE_DC
    ]
    if not clocks:
        return False
    reference, *others = clocks
    measured: dict[int, list[int]] = {position: [] for position in others}
    delays: dict[int, int] = {}
    for _ in range(_MEASUREMENTS):
        missing = [position for position in others if position not in delays]
        for position in missing:
            marker = _NOT_MEASURED.to_bytes(4, "little")
            port.put(station_of(position), Register.DC_DELAY, marker, labels[position - 1])
        # Once at least: with it SOEM adds the reference's time to the cycle's frame.
        master.config_dc()
        for position in missing:
            delay = _read(port, position, Register.DC_DELAY, 4, labels[position - 1])
            if delay == _NOT_MEASURED:
                continue
            if any(abs(delay - before) <= _SAME_DELAY_NS for before in measured[position]):
                delays[position] = delay
            measured[position].append(delay)
        if len(delays) == len(others):
            break
    else:
        position = missing[0]
        found = ", ".join(map(str, measured[position])) or "nothing"
        raise BusError(
            f"{labels[position - 1]}: {_MEASUREMENTS} measurements of its propagation delay (register 0x0928) do not "
            f"agree, two have to be within {_SAME_DELAY_NS} ns; found, in ns: {found}"
        )
    # SOEM leaves the reference's alone; a slave that has moved along the cable still has its delay from before.
    port.put(station_of(reference), Register.DC_DELAY, bytes(4), labels[reference - 1])
    for position in others:
        delay_register = delays[position].to_bytes(4, "little")
        take_over_time(port, station_of(position), labels[position - 1], delay_register, [reference], always=True)
    return True


def _read(port: RegisterPort, position: int, register: Register, length: int, label: str) -> int:
    content = port.read(station_of(position), register, length)
    if content is None:
        raise BusError(f"{label} stopped answering while the clocks were set")
    return int.from_bytes(content, "little")


def take_over_time(
    port: RegisterPort, station: int, label: str, delay: bytes, others: Sequence[int], *, always: bool
) -> None:
    """Set the clock of one slave by that of another: one broadcast latches the local times of both (ETG.1000.4, 6.8).

    Args:
        port: the port for registers.
        station: address of the slave whose clock is set; SYNC0 is off.
        label: the slave in messages.
        delay: its propagation delay from the reference clock, content of register 0x0928.
        others: the other slaves with a clock, the reference first; the first one that answers is used.
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
    own = port.read(station, Register.DC_RECEIVE_TIME, 8)
    if own is None:
        raise BusError(f"{label} stopped answering while its clock was set")
    # Without another clock: the host's time, as SOEM does, ns since 2000.
    time_then = time.time_ns() - _UNTIL_2000_NS
    for neighbour in others:
        theirs = [port.read(station_of(neighbour), at, 8) for at in (Register.DC_RECEIVE_TIME, Register.DC_OFFSET)]
        their_delay = port.read(station_of(neighbour), Register.DC_DELAY, 4)
        if None not in theirs and their_delay is not None:
            time_then = sum(int.from_bytes(part or b"", "little") for part in theirs)
            time_then += int.from_bytes(delay, "little") - int.from_bytes(their_delay, "little")
            break
    offset = time_then - int.from_bytes(own, "little") & (1 << 64) - 1
    port.put(station, Register.DC_DELAY, delay, label)
    port.put(station, Register.DC_OFFSET, offset.to_bytes(8, "little"), label)


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


def start_sync(port: RegisterPort, station: int, label: str, device: DeviceDescription, period_ns: int) -> None:
    """Start SYNC0 of one slave on the grid of the others: multiples of its cycle, shifted by `sync0_shift_us`.

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
        now = port.read(station, Register.DC_SYSTEM_TIME, 8)
        if now is None:
            raise BusError(f"{label} stopped answering while its SYNC0 was started")
        begin = (int.from_bytes(now, "little") + _SYNC_DELAY_NS) // grid * grid + grid + shift
        port.put(station, Register.DC_START, begin.to_bytes(8, "little"), label)
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
