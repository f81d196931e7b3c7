"""What a fault of the virtual segment is, and the way of the frames that faults act on.

A kind is one dataclass, whose fields are the keys of the fault.

A package outside adds a kind by a subclass of `DeviceFault` and an entry point of the group `rtcp.faults`.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, fields
from random import Random
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, TypeVar

from annotated_types import Ge, Gt, Le

from rtcp.config.document import Finding
from rtcp.virtual.request_socket import RequestRefused
from rtcp.virtual.segment import Segment
from rtcp.virtual.slave import Slave

Position = Annotated[int, Ge(1), Le(255)]
"""A slave: they count from 1, as on the cable; 0 is the master."""
Cable = Annotated[int, Ge(0), Le(254)]
"""The cable behind this slave; 0: between the master and slave 1."""
Port = Annotated[int, Ge(1), Le(3)]
"""The port of that slave at which the cable begins."""
Rate = Annotated[float, Gt(0), Le(1)]
Burst = Annotated[int, Ge(1), Le(100_000)]
Seed = Annotated[int, Ge(0), Le(0xFFFFFFFF)]
End = Callable[[int], None]
"""Ends a fault at an instant, ns."""
FOR_EVER = 1 << 63
"""An instant that does not come."""
MOST_UNDER_WAY = 10_000
"""Late answers that are kept; a cable holds no more either."""
MOST_AT_ONCE = 16
"""Frames that are sent in one look at what is due: those of the master come in between."""

Send = Callable[[bytes], object]

_T = TypeVar("_T")


class FaultRefused(RequestRefused):
    """This segment cannot have this fault: a sentence."""


class Fault:
    """Base of the kinds of faults. A kind is a dataclass; the first line of its docstring is shown to users."""

    name: ClassVar[str]
    """What commands and scripts call it."""
    once: ClassVar[bool] = False
    """Whether it happens and is over: it does not last and cannot be cleared."""
    once_unless_it_lasts: ClassVar[bool] = False
    """Whether it is a single occurrence where no duration is given."""
    counts: Mapping[str, int] = MappingProxyType({})
    """What it has done to frames."""

    @property
    def over(self) -> bool:
        """Whether it has passed by itself."""
        return False

    @classmethod
    def key_fields(cls: Any) -> list[Field[Any]]:
        """Return the fields of the kind: its own, then those that it shares with other kinds."""
        return sorted(fields(cls), key=lambda each: bool(each.kw_only))

    def mistakes(self) -> Sequence[Finding]:
        """Return what is wrong between its keys, each of which is as allowed."""
        return ()

    def prepare(self, t: int) -> None:
        """Make the state of a run that begins at instant `t`, called before `start`."""

    def start(self, segment: Segment, frames: Frames, t: int) -> End | None:
        """Let it begin at instant `t`; return what ends it, None where nothing does.

        Raises:
            FaultRefused: the segment cannot have this fault.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class SlaveFault(Fault):
    """Base of the faults of one slave."""

    slave: Position

    def start(self, segment: Segment, frames: Frames, t: int) -> End | None:
        """Let it begin in the slave."""
        return self.begin(slave_at(segment, self.slave), t)

    def begin(self, slave: Slave, t: int) -> End | None:
        """Let it begin in `slave`, as `start`."""
        raise NotImplementedError


class DeviceFault(Fault):
    """Base of the faults of device models alone, the same on a segment and on the bus `inprocess`.

    A key `slave` of type `Position` is checked against the segment's slaves.
    """

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Let it begin in one of the devices of the segment."""
        place_of(segment.slaves, getattr(self, "slave", 1))
        return self.begin([slave.device for slave in segment.slaves])

    def begin(self, devices: Sequence[Any]) -> End:
        """Let the fault begin; return what ends it, called with the instant, ns.

        Args:
            devices: the device models (`rtcp.virtual.device.DeviceModel`) in the order of the cable.

        Raises:
            FaultRefused: the segment cannot have this fault.
        """
        raise NotImplementedError


@dataclass(kw_only=True)
class StrikingFault(Fault):
    """Base of the faults that strike some frames: each with the probability `rate`, or the next `burst` of them."""

    counted: ClassVar[tuple[str, ...]]
    """Keys of `counts`; `strikes` counts the first."""
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0

    def prepare(self, t: int) -> None:
        """Begin anew: the same seed strikes the same frames."""
        self.random = Random(self.seed)
        self.counts: dict[str, int] = dict.fromkeys(self.counted, 0)
        self._left = self.burst
        self._when_passed: Callable[[], None] | None = None

    def mistakes(self) -> Sequence[Finding]:
        """Either rate or burst is to be given."""
        if (self.rate is None) != (self.burst is None):
            return ()
        return [(("rate",), "give either rate (the probability for each frame) or burst (how many frames)")]

    @property
    def over(self) -> bool:
        """Whether the burst has passed."""
        return self._left == 0

    def strikes(self) -> bool:
        """Whether the next frame is struck; it is counted."""
        struck = self._next()
        self.counts[self.counted[0]] += struck
        if struck and self._left == 0 and self._when_passed is not None:
            self._when_passed()
        return struck

    def _next(self) -> bool:
        if self._left is None:
            return self.random.random() < (self.rate or 0.0)
        if not self._left:
            return False
        self._left -= 1
        return True

    def listed(self, entries: list[_T], entry: _T) -> End:
        """Put `entry`, which calls `strikes`, on a list of the segment until the burst has passed or what ends it."""

        def leave() -> None:
            entries.remove(entry)
            # entry -> strikes -> leave -> entry is a ring, and the segment's process collects none.
            self._when_passed = None

        entries.append(entry)
        self._when_passed = leave
        return lambda _: leave()


class FrameFault(Fault):
    """Base of the faults of the frames that pass."""

    stage: ClassVar[int] = 0
    """Place among these faults: an answer meets those of a lower stage first."""
    strikes_passing: ClassVar[bool] = True
    """Whether it acts on the frames that pass."""
    due: int = FOR_EVER
    """Instant of the next call of `tick` that is needed."""

    def start(self, segment: Segment, frames: Frames, t: int) -> End:
        """Take a place on the way of the frames."""
        frames.add(self)
        return lambda _: frames.remove(self)

    def arrives(self) -> bool:
        """Whether the frame that has come reaches the segment; called once a frame."""
        return True

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Return what goes back to the master now, in this order, of `answers` to a frame that came at `t`."""
        return answers

    def tick(self, now: int, send: Send) -> None:
        """Send what is due."""

    def kept(self) -> list[bytes]:
        """Return the frames that it has kept, at its end."""
        return []


class Frames:
    """The way of the frames between the socket and the segment.

    Where `active`, each frame that comes is shown to `arrives` first, and its answer goes to `answers` and not to the
    socket. What is sent later is sent by `tick`, to be called when `due` has come. Instants are ns, CLOCK_MONOTONIC.
    """

    def __init__(self, send: Send) -> None:
        self.active = False
        self.due = FOR_EVER
        self._send = send
        self._faults: list[FrameFault] = []
        self._under_way: list[tuple[int, int, bytes]] = []
        self._number = 0

    def add(self, fault: FrameFault) -> None:
        """Let a fault act from now on."""
        self._faults.append(fault)
        self._faults.sort(key=lambda each: each.stage)
        self._look_ahead()

    def remove(self, fault: FrameFault) -> None:
        """Let a fault end; what it has kept goes to the master; answers that are late already still come when due."""
        self._faults = [each for each in self._faults if each is not fault]
        for frame in fault.kept():
            self._send(frame)
        self._look_ahead()

    def send_later(self, frame: bytes, due: int) -> None:
        """Send a frame at the instant `due`."""
        if len(self._under_way) < MOST_UNDER_WAY:
            self._number += 1
            heapq.heappush(self._under_way, (due, self._number, frame))

    def _look_ahead(self) -> None:
        """Forget bursts that have passed; find what is next."""
        self._faults = [each for each in self._faults if not each.over]
        self.active = any(each.strikes_passing for each in self._faults)
        self.due = min((each.due for each in self._faults), default=FOR_EVER)
        if self._under_way:
            self.due = min(self.due, self._under_way[0][0])

    def arrives(self) -> bool:
        """Whether the frame that has come reaches the segment."""
        arrives = True
        for fault in self._faults:
            # Each is asked, so that what one fault does is the same whether there are others or not.
            arrives = fault.arrives() and arrives
        if not arrives:
            self._look_ahead()
        return arrives

    def answers(self, frame: bytes, t: int) -> None:
        """Send, keep or lose the answer to a frame that came at `t`."""
        passing = [frame]
        for fault in self._faults:
            passing = fault.answer(passing, t, self)
        for each in passing:
            self._send(each)
        self._look_ahead()

    def tick(self, now: int) -> None:
        """Send what is due."""
        under_way = self._under_way
        for _ in range(MOST_AT_ONCE):
            if not under_way or under_way[0][0] > now:
                break
            self._send(heapq.heappop(under_way)[2])
        for each in self._faults:
            each.tick(now, self._send)
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
    """Return the number of the cable at a port of slave `after`, 0: the master's; raises FaultRefused."""
    last = len(segment.slaves)
    cable = segment.topology.cable_behind(after - 1, port) if 0 < after <= last else None if after else 0
    if cable is None:
        # Of a chain the sentence says where it has cables.
        places = [n for n in range(last) if n == 0 or segment.topology.cable_behind(n - 1, port) is not None]
        if port == 1 and places == list(range(last)):
            raise FaultRefused(
                f"there is no cable behind slave {after}: cables lie behind slaves 0 (the master) to {last - 1}"
            )
        raise FaultRefused(f"there is no cable behind slave {after} at port {port}")
    return cable
