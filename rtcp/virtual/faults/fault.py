"""Base classes of the faults of the virtual segment, and the path of the frames through them.

A kind of fault is a dataclass; its fields are the keys of the fault.

Another package can add a kind by a subclass of `DeviceFault` and an entry point of the group `rtcp.faults`.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, fields
from random import Random
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, TypeVar

from annotated_types import Ge, Gt, Le

from rtcp.config.findings import Finding
from rtcp.virtual.request_socket import RequestRefused
from rtcp.virtual.segment import Segment
from rtcp.virtual.slave import Slave

Position = Annotated[int, Ge(1), Le(255)]
"""Position of a slave on the cable, from 1."""
Cable = Annotated[int, Ge(0), Le(254)]
"""The cable behind this slave; 0: between the master and slave 1."""
Port = Annotated[int, Ge(1), Le(3)]
"""Port of that slave at which the cable begins."""
Rate = Annotated[float, Gt(0), Le(1)]
Burst = Annotated[int, Ge(1), Le(100_000)]
Seed = Annotated[int, Ge(0), Le(0xFFFFFFFF)]
End = Callable[[int], None]
"""Ends a fault at an instant, ns."""
FOR_EVER = 1 << 63
"""An instant that is never reached."""
MOST_UNDER_WAY = 10_000
"""Upper bound on delayed answers."""
MOST_AT_ONCE = 16
"""Upper bound on frames sent per tick, so that frames of the master come in between."""

Send = Callable[[bytes], object]

_T = TypeVar("_T")


class FaultRefused(RequestRefused):
    """The fault is impossible on this segment; the message is a sentence."""


class Fault:
    """Base of the kinds of faults. A kind is a dataclass; users see the first line of its docstring."""

    name: ClassVar[str]
    """Name in commands and scripts."""
    once: ClassVar[bool] = False
    """True: a single event, without duration; cannot be cleared."""
    once_unless_it_lasts: ClassVar[bool] = False
    """True: a single event unless a duration is given."""
    counts: Mapping[str, int] = MappingProxyType({})
    """Number of affected frames by kind of effect."""

    @property
    def over(self) -> bool:
        """Whether it has ended by itself."""
        return False

    @classmethod
    def key_fields(cls: Any) -> list[Field[Any]]:
        """Return the fields of the kind: its own, then the common ones."""
        return sorted(fields(cls), key=lambda entry: bool(entry.kw_only))

    def mistakes(self) -> Sequence[Finding]:
        """Return the mistakes in combinations of its keys, each valid by itself."""
        return ()

    def prepare(self, t: int) -> None:
        """Initialize the state of a run that begins at instant `t`; called before `start`."""

    def start(self, segment: Segment, frames: Frames, t: int) -> End | None:
        """Begin at instant `t`; return the function that ends it, or None.

        Raises:
            FaultRefused: the fault is impossible on this segment.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class SlaveFault(Fault):
    """Base of the faults of one slave."""

    slave: Position

    def start(self, segment: Segment, frames: Frames, t: int) -> End | None:
        """Begin in the slave."""
        return self.begin(slave_at(segment, self.slave), t)

    def begin(self, slave: Slave, t: int) -> End | None:
        """Begin in `slave`, as `start`."""
        raise NotImplementedError


class DeviceFault(Fault):
    """Base of the faults of device models, equal on a segment and on the bus `inprocess`.

    A key `slave` of type `Position` is checked against the segment's slaves.
    """

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Begin in one of the devices of the segment."""
        place_of(segment.slaves, getattr(self, "slave", 1))
        return self.begin([slave.device for slave in segment.slaves])

    def begin(self, devices: Sequence[Any]) -> End:
        """Begin; return the function that ends it, called with the instant, ns.

        Args:
            devices: the device models (`rtcp.virtual.device.DeviceModel`) in the order of the cable.

        Raises:
            FaultRefused: the fault is impossible on this segment.
        """
        raise NotImplementedError


@dataclass(kw_only=True)
class StrikingFault(Fault):
    """Base of the faults of some frames: each with the probability `rate`, or the next `burst` of them."""

    counted: ClassVar[tuple[str, ...]]
    """Keys of `counts`; `strikes` counts the first."""
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0

    def prepare(self, t: int) -> None:
        """Reset: the same seed affects the same frames."""
        self.random = Random(self.seed)
        self.counts: dict[str, int] = dict.fromkeys(self.counted, 0)
        self._remaining = self.burst
        self._when_passed: Callable[[], None] | None = None

    def mistakes(self) -> Sequence[Finding]:
        """Require either rate or burst."""
        if (self.rate is None) != (self.burst is None):
            return ()
        text = "give either rate (the probability for each frame) or burst (how many frames)"
        return [Finding(("rate",), "one_of_both", text=text)]

    @property
    def over(self) -> bool:
        """Whether the burst is complete."""
        return self._remaining == 0

    def strikes(self) -> bool:
        """Return whether the next frame is affected, and count it."""
        struck = self._next()
        self.counts[self.counted[0]] += struck
        if struck and self._remaining == 0 and self._when_passed is not None:
            self._when_passed()
        return struck

    def _next(self) -> bool:
        if self._remaining is None:
            return self.random.random() < (self.rate or 0.0)
        if not self._remaining:
            return False
        self._remaining -= 1
        return True

    def listed(self, entries: list[_T], entry: _T) -> End:
        """Add `entry`, which calls `strikes`, to a list of the segment until the end of the burst or the fault."""

        def leave() -> None:
            entries.remove(entry)
            # entry -> strikes -> leave -> entry is a reference cycle; the segment's process collects none.
            self._when_passed = None

        entries.append(entry)
        self._when_passed = leave
        return lambda _: leave()


class FrameFault(Fault):
    """Base of the faults of passing frames."""

    stage: ClassVar[int] = 0
    """Order among these faults: an answer passes lower stages first."""
    strikes_passing: ClassVar[bool] = True
    """Whether it affects passing frames."""
    due: int = FOR_EVER
    """Instant of the next necessary call of `tick`."""

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Join the path of the frames."""
        frames.add(self)
        return lambda _: frames.remove(self)

    def arrives(self) -> bool:
        """Return whether the received frame reaches the segment; called once per frame."""
        return True

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Return the answers to send now, in order; `answers` are those to a frame that arrived at `t`."""
        return answers

    def tick(self, now: int, send: Send) -> None:
        """Send what is due."""

    def kept(self) -> list[bytes]:
        """Return the retained frames, at its end."""
        return []


class Frames:
    """The path of the frames between the socket and the segment.

    While `active`, each received frame passes `arrives` first, and its answer goes to `answers` in place of the socket.
    `tick` sends delayed frames; call it at `due`. Instants are ns, CLOCK_MONOTONIC.
    """

    def __init__(self, send: Send) -> None:
        self.active = False
        self.due = FOR_EVER
        self._send = send
        self._faults: list[FrameFault] = []
        self._under_way: list[tuple[int, int, bytes]] = []
        self._number = 0

    def add(self, fault: FrameFault) -> None:
        """Add a fault."""
        self._faults.append(fault)
        self._faults.sort(key=lambda other: other.stage)
        self._look_ahead()

    def remove(self, fault: FrameFault) -> None:
        """Remove a fault and send its retained frames; delayed answers are still sent when due."""
        self._faults = [other for other in self._faults if other is not fault]
        for frame in fault.kept():
            self._send(frame)
        self._look_ahead()

    def send_later(self, frame: bytes, due: int) -> None:
        """Send a frame at the instant `due`."""
        if len(self._under_way) < MOST_UNDER_WAY:
            self._number += 1
            heapq.heappush(self._under_way, (due, self._number, frame))

    def _look_ahead(self) -> None:
        """Remove complete bursts; find the next due instant."""
        self._faults = [fault for fault in self._faults if not fault.over]
        self.active = any(fault.strikes_passing for fault in self._faults)
        self.due = min((fault.due for fault in self._faults), default=FOR_EVER)
        if self._under_way:
            self.due = min(self.due, self._under_way[0][0])

    def arrives(self) -> bool:
        """Return whether the received frame reaches the segment."""
        arrives = True
        for fault in self._faults:
            # Call all of them, so that a fault's effect does not depend on the others.
            arrives = fault.arrives() and arrives
        if not arrives:
            self._look_ahead()
        return arrives

    def answers(self, frame: bytes, t: int) -> None:
        """Send, retain or drop the answer to a frame that arrived at `t`."""
        passing = [frame]
        for fault in self._faults:
            passing = fault.answer(passing, t, self)
        for answer in passing:
            self._send(answer)
        self._look_ahead()

    def tick(self, now: int) -> None:
        """Send what is due."""
        under_way = self._under_way
        for _ in range(MOST_AT_ONCE):
            if not under_way or under_way[0][0] > now:
                break
            self._send(heapq.heappop(under_way)[2])
        for fault in self._faults:
            fault.tick(now, self._send)
        self._look_ahead()


def slave_at(segment: Segment, number: int) -> Slave:
    """Return the slave at a position; raises FaultRefused."""
    return segment.slaves[place_of(segment.slaves, number)]


def place_of(slaves: Sequence[object], number: int) -> int:
    """Return the index of the slave at a position; raises FaultRefused."""
    if number > len(slaves):
        raise FaultRefused(f"there is no slave {number}: the segment has slaves 1 to {len(slaves)}")
    return number - 1


def cable_of(segment: Segment, after: int, port: int = 1) -> int:
    """Return the number of the cable at a port of slave `after` (0: the master); raises FaultRefused."""
    last = len(segment.slaves)
    cable = segment.topology.cable_behind(after - 1, port) if 0 < after <= last else None if after else 0
    if cable is None:
        # For a chain the message lists its cables.
        places = [n for n in range(last) if n == 0 or segment.topology.cable_behind(n - 1, port) is not None]
        if port == 1 and places == list(range(last)):
            raise FaultRefused(
                f"there is no cable behind slave {after}: cables lie behind slaves 0 (the master) to {last - 1}"
            )
        raise FaultRefused(f"there is no cable behind slave {after} at port {port}")
    return cable
