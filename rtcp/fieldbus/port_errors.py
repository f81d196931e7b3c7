"""Error counters of the slaves' ports, added up beyond their 8 bits, and the cable that they point at.

Registers 0x0300 to 0x0313 (ETG.1000.4, 6.2): for each port invalid frames and receive errors, errors forwarded, lost
links. What a port counts as its own came in over that port's cable; slaves behind it count the same frame as forwarded.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rtcp.fieldbus.bus import PORTS, PortErrors, slave_label, station_of
from rtcp.fieldbus.registers import DatagramCommand, Register, RegisterPort
from rtcp.fieldbus.topology import Topology

ERROR_COUNTERS_SIZE = 0x14
"""Bytes of the counters of all ports."""
_FORWARDED, _LINKS = 0x08, 0x10
_OF_FRAMES, _OF_LINKS = slice(0, _FORWARDED + PORTS), slice(_LINKS, _LINKS + PORTS)
"""Cleared with one write each; the errors of the processing unit between them belong to no cable."""
_CLEAR_FROM = 128
"""Counters stop at 255; from here on they are set to 0, which a write of any value does."""
_REPORT_INTERVAL_S = 10.0
_CALM_S = 60.0
"""After this time without an error the next one starts a new count, s."""


def read_port_errors(data: bytes) -> PortErrors:
    """Return the counters in the registers from `Register.ERROR_COUNTERS` on."""
    rx = [max(data[2 * port], data[2 * port + 1]) for port in range(PORTS)]
    forwarded, links = (list(data[at : at + PORTS]) for at in (_FORWARDED, _LINKS))
    return PortErrors(rx, forwarded, links)


@dataclass(frozen=True)
class _Cable:
    """A cable, by the positions of what is at its ends; 0: the master."""

    near: int
    far: int | None
    """None: what was there is not part of the configuration."""


@dataclass
class _CableErrors:
    """What enters at one cable: since when, how often, when it was reported."""

    began: str
    reported_at: float
    last_at: float
    near: int = 0
    """Counted by the slave before the cable."""
    far: int = 0
    """Counted by the slave behind it."""
    reported: int = 0


class ErrorCounters:
    """Reads one slave's counters a call, the slaves in turn."""

    def __init__(
        self,
        port: RegisterPort,
        names: Sequence[str],
        report: Callable[[str], None],
        topology: Topology | None = None,
    ) -> None:
        """Take the slaves in the order of the cable; `report` receives the messages; without `topology`: a chain."""
        self._topology = topology or Topology.chain(len(names))
        self._port = port
        self._names = names
        self._report = report
        # What was counted before is of no cable that is in use now: plugs were put in.
        self._last = [
            port.read(station_of(at), Register.ERROR_COUNTERS, ERROR_COUNTERS_SIZE) for at in range(1, len(names) + 1)
        ]
        self._turn = 0
        self._cables: dict[tuple[str, _Cable], _CableErrors] = {}
        self.of = [PortErrors() for _ in names]
        """By slave, in the order of the cable."""

    def read_next(self) -> None:
        """Read the next slave's counters; a slave that does not answer keeps what it had."""
        index, self._turn = self._turn, (self._turn + 1) % len(self._names)
        station = station_of(index + 1)
        found, wkc = self._port.exchange(
            DatagramCommand.FPRD, station, Register.ERROR_COUNTERS, bytes(ERROR_COUNTERS_SIZE), tries=1
        )
        if wkc != 1:
            return
        before = self._last[index]
        if before is not None and found != before:
            self._add(index, before, found)
        for part in (_OF_FRAMES, _OF_LINKS):
            shown = found[part]
            address = Register.ERROR_COUNTERS + part.start
            if max(shown) >= _CLEAR_FROM and self._port.write(station, address, bytes(len(shown))):
                found = found[: part.start] + bytes(len(shown)) + found[part.stop :]
        self._last[index] = found

    def _add(self, index: int, before: bytes, found: bytes) -> None:
        # A counter that shows less than before was set to 0 meanwhile.
        new = [now - then if now >= then else now for then, now in zip(before, found, strict=True)]
        errors, position = self.of[index], index + 1
        # A damaged frame may count as a receive error of the port, too.
        counted = read_port_errors(bytes(new))
        for port in range(PORTS):
            damaged, links = counted.rx[port], counted.links[port]
            errors.rx[port] += damaged
            errors.forwarded[port] += counted.forwarded[port]
            errors.links[port] += links
            # Port 0 looks towards the master, any other away from it.
            if port == 0:
                cable = _Cable(self._topology.parent(position), position)
            else:
                cable = _Cable(position, self._topology.child_at(position, port))
            if damaged:
                self._note("errors", cable, damaged, far=port == 0)
            if links:
                self._note("link", cable, links, far=port == 0)

    def _note(self, kind: str, cable: _Cable, count: int, *, far: bool) -> None:
        now = time.monotonic()
        cable_errors = self._cables.get((kind, cable))
        if cable_errors is None or now - cable_errors.last_at > _CALM_S:
            cable_errors = self._cables[kind, cable] = _CableErrors(
                time.strftime("%H:%M:%S"), now - _REPORT_INTERVAL_S, now
            )
        if far:
            cable_errors.far += count
        else:
            cable_errors.near += count
        cable_errors.last_at = now

    def report_due(self) -> None:
        """Say what enters where: at once when it begins, then at most every 10 s with the number."""
        now = time.monotonic()
        for (kind, cable), cable_errors in self._cables.items():
            # A frame is damaged on its way out or on its way back; a link that is lost is lost for both ends.
            count = (
                cable_errors.near + cable_errors.far if kind == "errors" else max(cable_errors.near, cable_errors.far)
            )
            if count > cable_errors.reported and now - cable_errors.reported_at >= _REPORT_INTERVAL_S:
                cable_errors.reported, cable_errors.reported_at = count, now
                self._report(self._sentence(kind, cable, count, cable_errors.began))

    def _sentence(self, kind: str, cable: _Cable, count: int, began: str) -> str:
        before = "the master" if cable.near == 0 else slave_label(cable.near, self._names[cable.near - 1])
        if cable.far is not None:
            between = f"between {before} and {slave_label(cable.far, self._names[cable.far - 1])}"
        else:
            between = f"behind {before}"
        if kind == "errors":
            frames = "1 damaged frame" if count == 1 else f"{count} damaged frames"
            return f"errors enter {between}: {frames} since {began}; check that cable and its plugs"
        times = "once" if count == 1 else f"{count} times"
        return f"the link {between} was lost {times} since {began}; check that cable, its plugs and the supply"
