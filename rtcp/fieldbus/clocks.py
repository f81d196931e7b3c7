"""Distributed clocks on the way to SAFE-OP: delays, offsets, SYNC0 (ETG.1000.4, 6.9)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rtcp.config.model import SlaveConfig
from rtcp.fieldbus.bus import BusError, slave_label, station_of
from rtcp.fieldbus.registers import RegisterPort

DC_ACTIVATE = 0x0981
"""Activation register: bit 0 cyclic operation, bit 1 SYNC0, bit 2 SYNC1."""
_DC_SYSTEM_TIME, _DC_START = 0x0910, 0x0990
_SYNC1 = 0x0400


def start_clocks(master: Any, port: RegisterPort, slaves: Sequence[SlaveConfig], period_ns: int) -> None:
    """Measure the delays, set the offsets and start SYNC0 where the device's file says so (`assign_activate`).

    Args:
        master: pysoem's master, its slaves in PRE-OP and mapped.
        port: the port for registers.
        slaves: the slaves of the configuration.
        period_ns: the cycle of SYNC0.

    Raises:
        BusError: no clock, SYNC0 in the past, or an activation that the slave does not keep.
    """
    clocks = master.config_dc()
    for position, config in enumerate(slaves, 1):
        word = config.device.assign_activate
        if not word:
            continue
        label = slave_label(position, config.name)
        if not clocks:
            raise BusError(f"{label}: `assign_activate` is 0x{word:04X} but no slave has a distributed clock")
        shift = round(config.device.sync0_shift_us * 1000)
        # Twice at most: a segment that was silent for long has its first SYNC0 in the past (SOEM#757).
        for _ in range(2):
            if word & _SYNC1:
                master.slaves[position - 1].dc_sync(True, period_ns, shift, 0)
            else:
                master.slaves[position - 1].dc_sync(True, period_ns, shift)
            if _first_sync_is_ahead(port, station_of(position)):
                break
        else:
            raise BusError(f"{label}: its first SYNC0 lies in the past: it would never come")
        active = port.read(station_of(position), DC_ACTIVATE, 1)
        if active is None or active[0] != word >> 8:
            shown = "nothing" if active is None else f"0x{active[0]:02X}"
            raise BusError(f"{label}: `assign_activate` 0x{word:04X} reads back from register 0x0981 as {shown}")


def _first_sync_is_ahead(port: RegisterPort, station: int) -> bool:
    now = port.read(station, _DC_SYSTEM_TIME, 4)
    start = port.read(station, _DC_START, 4)
    if now is None or start is None:
        return False
    # The low 32 bits alone: an ESC may have no more.
    ahead = int.from_bytes(start, "little") - int.from_bytes(now, "little") & 0xFFFFFFFF
    return 0 < ahead < 0x80000000
