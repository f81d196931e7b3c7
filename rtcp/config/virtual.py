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
_LONGEST_WATCHDOG_MS = 6000.0


def widen(config: ArmConfig) -> ArmConfig:
    """Return the configuration with `bus.virtual_patience` applied: only where its bus is `virtual`.

    Multiplied are `bus.lost_cycles` and `watchdog_ms` of every device. The sync error counter limit among its start-up
    SDOs (0x10F1:02, ETG.1020) becomes 0, which switches that check off: a missed SYNC0 counts 3 and one that is met
    takes 1 away, so that a host which loses a quarter of its ticks for long exceeds any limit in the end.
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
        sdo=tuple(map(_sdo, device.sdo)),
    )


def _sdo(entry: StartupSdo) -> StartupSdo:
    return replace(entry, value=0.0) if (entry.index, entry.sub_index) == _SYNC_ERROR_LIMIT else entry
