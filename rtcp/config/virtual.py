"""The limits on lost process data, widened for the virtual bus.

Master and virtual slaves are processes of one host: where it takes the CPU away for 30 ms, as shared and virtual
machines do, both stand still, and a limit that suits a cable would end every second run. On a network interface
nothing is widened.
"""

from __future__ import annotations

from dataclasses import replace

from rtcp.config.model import ArmConfig, DeviceDescription, StartupSdo

VIRTUAL = "virtual"
"""Name of the bus that is a segment in software."""

_SYNC_ERROR_LIMIT = (0x10F1, 2)
_LARGEST = 0xFFFF
_LONGEST_WATCHDOG_MS = 6000.0


def widen(config: ArmConfig) -> ArmConfig:
    """Return the configuration with `bus.virtual_patience` applied: only where its bus is `virtual`.

    Multiplied are `bus.lost_cycles`, `watchdog_ms` of every device and, among its start-up SDOs, the sync error counter
    limit (0x10F1:02, ETG.1020); a limit of 0, which switches that check off, stays 0.
    """
    patience = config.bus.virtual_patience
    if config.bus.interface != VIRTUAL or patience == 1:
        return config
    return replace(
        config,
        bus=replace(config.bus, lost_cycles=round(config.bus.lost_cycles * patience)),
        slaves=tuple(replace(slave, device=_device(slave.device, patience)) for slave in config.slaves),
    )


def _device(device: DeviceDescription, patience: float) -> DeviceDescription:
    return replace(
        device,
        watchdog_ms=min(device.watchdog_ms * patience, _LONGEST_WATCHDOG_MS),
        sdo=tuple(_sdo(entry, patience) for entry in device.sdo),
    )


def _sdo(entry: StartupSdo, patience: float) -> StartupSdo:
    if (entry.index, entry.sub_index) != _SYNC_ERROR_LIMIT:
        return entry
    return replace(entry, value=float(min(round(entry.value * patience), _LARGEST)))
