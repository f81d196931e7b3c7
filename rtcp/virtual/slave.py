"""A virtual slave: controller, firmware and its place on the wire."""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.virtual.application import Application
from rtcp.virtual.clock import Clock
from rtcp.virtual.device import Device
from rtcp.virtual.esc import Esc
from rtcp.virtual.pdo import SyncManagerLayout
from rtcp.virtual.sii import build_sii
from rtcp.virtual.slave_faults import SlaveFaults

FIRST_LOCAL_TIME = 1_000_000_000
"""Slave n shows n times this at the start, as if powered one second after its neighbour: no clocks agree by chance."""


class Slave:
    """A controller with its firmware and its place on the wire: `delay` ns after the master's port."""

    __slots__ = ("_drift_ppm", "application", "clock", "delay", "device", "esc", "faults", "queued_until")

    def __init__(self, device: Device, eeprom: bytes, drift_ppm: float, start: int, delay: int, turnaround: int | None,
                 t: int) -> None:  # fmt: skip
        """Power on at instant `t`, the clock showing `start` ns; `turnaround`: see `Esc`."""
        self.device = device
        self.delay = delay
        self.faults = SlaveFaults()
        self._drift_ppm = drift_ppm
        self.clock: Clock | None = Clock(drift_ppm, start, t) if device.supports_dc else None
        self.esc = Esc(eeprom, self.clock, turnaround, (True, turnaround is not None))
        self.application = Application(self.esc, device, self.faults, t)
        self.queued_until: int | None = None
        """Instant up to which the device is to be stepped; None while it does not wait for that."""

    def power_off(self, t: int) -> None:
        """The supply goes: the device stops, nothing that controller and firmware held is left."""
        self.device.power_off()
        self._restart(t)

    def power_on(self, t: int) -> None:
        """The supply comes back: all is as at power-on, but for what the EEPROM has kept."""
        self.device.power_on()
        self._restart(t)

    def _restart(self, t: int) -> None:
        self.clock = Clock(self._drift_ppm + self.faults.drift_ppm, 0, t) if self.device.supports_dc else None
        # The collector of garbage is off in a segment's process: no ring of references may be left.
        self.esc.detach()
        self.esc = Esc(bytes(self.esc.eeprom.image), self.clock, None, (False, False))
        if self.esc.dc is not None and self.faults.sync0_losses:
            self.esc.dc.sync0.suspend()
        self.application = Application(self.esc, self.device, self.faults, t)


def make_slaves(devices: Sequence[Device], drifts_ppm: Sequence[float], delays: Sequence[int],
                aliases: Sequence[int], t: int) -> list[Slave]:  # fmt: skip
    """Give every device a controller, in the order of the wire; `delays` are ns from the master and must not fall."""
    slaves = []
    for position, (device, drift, delay, alias) in enumerate(zip(devices, drifts_ppm, delays, aliases, strict=True)):
        last = position + 1 == len(devices)
        # A frame comes back to a slave after the way to the end of the chain and back.
        turnaround = None if last else 2 * (delays[-1] - delay)
        eeprom = build_sii(device, SyncManagerLayout(), alias)
        slaves.append(Slave(device, eeprom, drift, FIRST_LOCAL_TIME * (position + 1), delay, turnaround, t))
    return slaves
