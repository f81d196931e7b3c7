"""A virtual slave: controller, firmware and its place on the wire."""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.virtual.application import Application
from rtcp.virtual.clock import Clock
from rtcp.virtual.device import Device
from rtcp.virtual.esc import Esc
from rtcp.virtual.pdo import SyncManagerLayout
from rtcp.virtual.sii import build_sii

FIRST_LOCAL_TIME = 1_000_000_000
"""Slave n shows n times this at the start, as if powered one second after its neighbour: no clocks agree by chance."""


class Slave:
    """A controller with its firmware and its place on the wire: `delay` ns after the master's port."""

    __slots__ = ("application", "clock", "delay", "esc", "queued_until")

    def __init__(self, esc: Esc, application: Application, clock: Clock | None, delay: int) -> None:
        self.esc = esc
        self.application = application
        self.clock = clock
        self.delay = delay
        self.queued_until: int | None = None
        """Instant up to which the device is to be stepped; None while it does not wait for that."""


def make_slaves(devices: Sequence[Device], drifts_ppm: Sequence[float], delays: Sequence[int],
                aliases: Sequence[int], t: int) -> list[Slave]:  # fmt: skip
    """Give every device a controller, in the order of the wire; `delays` are ns from the master and must not fall."""
    slaves = []
    for position, (device, drift, delay, alias) in enumerate(zip(devices, drifts_ppm, delays, aliases, strict=True)):
        clock = Clock(drift, FIRST_LOCAL_TIME * (position + 1), t) if device.supports_dc else None
        last = position + 1 == len(devices)
        # A frame comes back to a slave after the way to the end of the chain and back.
        turnaround = None if last else 2 * (delays[-1] - delay)
        esc = Esc(build_sii(device, SyncManagerLayout(), alias), clock, turnaround)
        slaves.append(Slave(esc, Application(esc, device, t), clock, delay))
    return slaves
