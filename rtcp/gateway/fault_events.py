"""Which events begin a recording of the black box: the first of a fault, and what comes after a file has ended.

The division follows the events' own instants: a gateway that finds old ones divides them as the one before it did. They
are those of CLOCK_MONOTONIC: the wall clock may be set by hours just then, as on a host without a battery for it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from rtcp.ipc.codes import Code
from rtcp.ipc.observer import Event

BEFORE_S = 10.0
AFTER_S = 1.0
"""A recording's time before and after the fault's instant."""


@dataclass(frozen=True)
class Fault:
    """What has begun: by an event of the loop, or (number 0) by its silence or end."""

    time_ns: int
    """CLOCK_REALTIME, for people."""
    monotonic_ns: int
    """CLOCK_MONOTONIC: it decides."""
    what: str
    number: int = 0
    code: int = 0
    later: bool = False
    """It came while a fault was on already."""


class FaultEvents:
    """Divides events into recordings: within one fault at most one begins in 10 s.

    What comes in between is put off: the newest event of it begins a recording then, and the others are in the ten
    seconds before that.

    Args:
        faults: codes of the events that begin a fault.
        words: makes a sentence of an event.
    """

    def __init__(self, faults: Collection[int], words: Callable[[Event], str]) -> None:
        self._faults = faults
        self._words = words
        self.on = False
        """A fault is on."""
        self._later: Fault | None = None
        self._ends_ns = self._next_ns = 0
        """When the newest recording ends, and from when on another may begin; CLOCK_MONOTONIC."""

    def begun(self, events: Sequence[Event], now_ns: int) -> list[Fault]:
        """Return what begins a recording, of new events and of what was put off; `now_ns`: CLOCK_MONOTONIC."""
        found: list[Fault] = []
        for event in events:
            found += self._due(event.monotonic_ns)
            if event.code == Code.RESET:
                found += self.put_off()
                self.on = False
            elif event.code in self._faults:
                what = self._words(event)
                found += self.met(Fault(event.time_ns, event.monotonic_ns, what, event.number, event.code))
        return found + self._due(now_ns)

    def put_off(self) -> list[Fault]:
        """Return what was put off: it begins its recording now."""
        if self._later is None:
            return []
        fault, self._later = self._later, None
        self._begin(fault, max(self._next_ns, fault.monotonic_ns))
        return [fault]

    def met(self, fault: Fault) -> list[Fault]:
        """Return what a fault begins: its own recording, or that of what was put off."""
        fault = replace(fault, later=self.on)
        if not self.on:
            self.on = True
            before = self.put_off()
            self._begin(fault, fault.monotonic_ns)
            return [*before, fault]
        # A silence shows only after it has begun: no recording that began before has it.
        if fault.monotonic_ns > self._ends_ns or not fault.number:
            self._later = fault
        return self._due(fault.monotonic_ns)

    def _due(self, now_ns: int) -> list[Fault]:
        return self.put_off() if now_ns >= self._next_ns else []

    def _begin(self, fault: Fault, begun_ns: int) -> None:
        self._ends_ns = fault.monotonic_ns + round(AFTER_S * 1e9)
        self._next_ns = begun_ns + round(BEFORE_S * 1e9)
