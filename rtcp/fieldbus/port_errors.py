"""Error counters of the slaves' ports, extended beyond 8 bits, and the cable that causes the errors.

Registers 0x0300 to 0x0313 (ETG.1000.4, 6.2): for each port invalid frames and receive errors, forwarded errors, lost
links. A port counts errors of its own cable as invalid frames; slaves behind it count the same frame as forwarded.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rtcp.fieldbus.bus import PORTS, PortErrors, station_of
from rtcp.fieldbus.registers import DatagramCommand, Register, RegisterPort
from rtcp.fieldbus.topology import Topology
from rtcp.ipc.events import CableEvent, DamagedFrames, LinkLost

ERROR_COUNTERS_SIZE = 0x14
"""Size of the counters of all ports, bytes."""
_FORWARDED, _LINKS = 0x08, 0x10
_OF_FRAMES, _OF_LINKS = slice(0, _FORWARDED + PORTS), slice(_LINKS, _LINKS + PORTS)
"""Counters of frames and of links, each cleared with one write; the processing unit's errors between are unused."""
_CLEAR_FROM = 128
"""Value from which a counter, which stops at 255, is cleared by a write of any value."""
REPORT_INTERVAL_S = 10.0
"""Least interval between two reports of the same error, s; the first one comes at once."""
_CALM_S = 60.0
"""Time without an error after which the next one starts a new count, s."""


def read_port_errors(data: bytes) -> PortErrors:
    """Return the counters in the registers from `Register.ERROR_COUNTERS` on."""
    rx = [max(data[2 * port], data[2 * port + 1]) for port in range(PORTS)]
    forwarded, links = (list(data[at : at + PORTS]) for at in (_FORWARDED, _LINKS))
    return PortErrors(rx, forwarded, links)


@dataclass
class _CableErrors:
    """Errors of one cable: begin, counts, time of the last report."""

    began_ns: int
    """Instant of the first error, ns of CLOCK_REALTIME."""
    reported_at: float
    last_at: float
    ends: list[int] = field(default_factory=lambda: [0, 0])
    """Errors counted by the slave before the cable, and by the one behind it."""
    reported: int = 0


class ErrorCounters:
    """Reads the counters of one slave each call, cyclically."""

    def __init__(
        self,
        port: RegisterPort,
        count: int,
        report: Callable[[CableEvent], None],
        topology: Topology | None = None,
    ) -> None:
        """Count for `count` slaves; `report` receives the events; `topology` None: a line."""
        self._topology = topology or Topology.chain(count)
        self._port = port
        self._report = report
        # Earlier errors are ignored: they may come from plugging in the cables.
        self._last = [
            port.read(station_of(at), Register.ERROR_COUNTERS, ERROR_COUNTERS_SIZE) for at in range(1, count + 1)
        ]
        self._turn = 0
        self._cables: dict[tuple[type[CableEvent], int, int], _CableErrors] = {}
        """Event class and positions at both ends of the cable -> errors."""
        self.of = [PortErrors() for _ in range(count)]
        """Counters of each slave, in the order of the cable."""

    def read_next(self) -> None:
        """Read the next slave's counters; without an answer they stay."""
        index, self._turn = self._turn, (self._turn + 1) % len(self.of)
        station = station_of(index + 1)
        counters, wkc = self._port.exchange(
            DatagramCommand.FPRD, station, Register.ERROR_COUNTERS, bytes(ERROR_COUNTERS_SIZE), tries=1
        )
        if wkc != 1:
            return
        before = self._last[index]
        if before is not None and counters != before:
            self._add(index, before, counters)
        for part in (_OF_FRAMES, _OF_LINKS):
            counts = counters[part]
            address = Register.ERROR_COUNTERS + part.start
            if max(counts) >= _CLEAR_FROM and self._port.write(station, address, bytes(len(counts))):
                counters = counters[: part.start] + bytes(len(counts)) + counters[part.stop :]
        self._last[index] = counters

    def _add(self, index: int, before: bytes, counters: bytes) -> None:
        # A counter that is lower than before was cleared meanwhile.
        new = [now - then if now >= then else now for then, now in zip(before, counters, strict=True)]
        errors, position = self.of[index], index + 1
        # A damaged frame may also count as a receive error of the port.
        counted = read_port_errors(bytes(new))
        for port in range(PORTS):
            damaged, links = counted.rx[port], counted.links[port]
            errors.rx[port] += damaged
            errors.forwarded[port] += counted.forwarded[port]
            errors.links[port] += links
            # Port 0 is towards the master, all others away from it.
            if port == 0:
                cable = self._topology.parent(position), position
            else:
                cable = position, self._topology.child_at(position, port) or 0
            if damaged:
                self._note(DamagedFrames, cable, damaged, far=port == 0)
            if links:
                self._note(LinkLost, cable, links, far=port == 0)

    def _note(self, kind: type[CableEvent], cable: tuple[int, int], count: int, *, far: bool) -> None:
        now, key = time.monotonic(), (kind, *cable)
        cable_errors = self._cables.get(key)
        if cable_errors is None or now - cable_errors.last_at > _CALM_S:
            cable_errors = self._cables[key] = _CableErrors(time.time_ns(), now - REPORT_INTERVAL_S, now)
        cable_errors.ends[far] += count
        cable_errors.last_at = now

    def report_due(self) -> None:
        """Report the errors of each cable: the first at once, then at most every 10 s their number."""
        now = time.monotonic()
        for (kind, near, far), cable_errors in self._cables.items():
            # A frame is damaged in one direction, so the ends add up; both ends count the same lost link.
            count = (sum if kind is DamagedFrames else max)(cable_errors.ends)
            if count > cable_errors.reported and now - cable_errors.reported_at >= REPORT_INTERVAL_S:
                cable_errors.reported, cable_errors.reported_at = count, now
                self._report(kind(near, far, count, cable_errors.began_ns))
