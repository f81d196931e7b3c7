"""The way of frames between the segment's socket and its first slave, and the faults that wait on it."""

from __future__ import annotations

import heapq

from rtcp.config.faults import Fault, Noise
from rtcp.virtual.faults.frame_faults import FRAME_FAULT_KINDS, MOST_AT_ONCE, FrameFault, NoiseSource, Send

FOR_EVER = 1 << 63
"""An instant that does not come."""
MOST_UNDER_WAY = 10_000
"""Late answers that are kept; a cable holds no more either."""
_ORDER = tuple(FRAME_FAULT_KINDS)
FRAME_FAULTS = (*_ORDER, Noise)
"""The faults that are made here."""


class FrameUndo:
    """Ends one of these faults; tells what it has done."""

    def __init__(self, frames: Frames, fault: FrameFault | NoiseSource) -> None:
        self._frames = frames
        self._fault = fault

    @property
    def over(self) -> bool:
        """Whether its burst has passed."""
        return self._fault.over

    @property
    def counts(self) -> dict[str, int]:
        """How many frames it has struck, by what was done to them."""
        return dict(self._fault.counts)

    def __call__(self, t: int) -> None:
        """End it; answers that are late already come when they are due."""
        self._frames.end(self._fault)


class Frames:
    """The way of the frames between the socket and the segment.

    Where `active`, each frame that comes is shown to `arrives` first, and its answer goes to `answers` and not to the
    socket. What is sent later is sent by `tick`, to be called when `due` has come. Instants are ns, CLOCK_MONOTONIC.
    """

    def __init__(self, send: Send) -> None:
        self.active = False
        self.due = FOR_EVER
        self._send = send
        self._faults: list[tuple[int, FrameFault]] = []
        self._noises: list[NoiseSource] = []
        self._under_way: list[tuple[int, int, bytes]] = []
        self._number = 0

    def begin(self, fault: Fault, t: int) -> FrameUndo:
        """Let a fault begin at instant `t`."""
        made: FrameFault | NoiseSource
        if isinstance(fault, Noise):
            made = NoiseSource(fault, t)
            self._noises.append(made)
        else:
            kind = type(fault)
            made = FRAME_FAULT_KINDS[kind](fault, self._later)
            self._faults.append((_ORDER.index(kind), made))
            self._faults.sort(key=lambda each: each[0])
        self._look_ahead()
        return FrameUndo(self, made)

    def end(self, fault: FrameFault | NoiseSource) -> None:
        """Let a fault end; what it has kept goes to the master."""
        if isinstance(fault, NoiseSource):
            self._noises = [each for each in self._noises if each is not fault]
        else:
            self._faults = [each for each in self._faults if each[1] is not fault]
            for frame in fault.end():
                self._send(frame)
        self._look_ahead()

    def _later(self, frame: bytes, due: int) -> None:
        if len(self._under_way) < MOST_UNDER_WAY:
            self._number += 1
            heapq.heappush(self._under_way, (due, self._number, frame))

    def _look_ahead(self) -> None:
        """Forget bursts that have passed; find what is next."""
        self._faults = [each for each in self._faults if not each[1].over]
        self.active = bool(self._faults)
        due = self._under_way[0][0] if self._under_way else FOR_EVER
        for each in self._noises:
            due = min(due, each.due)
        self.due = due

    def arrives(self) -> bool:
        """Whether the frame that has come reaches the segment."""
        arrives = True
        for _, fault in self._faults:
            # Each is asked, so that what one fault does is the same whether there are others or not.
            if not fault.arrives():
                arrives = False
        if not arrives:
            self._look_ahead()
        return arrives

    def answers(self, frame: bytes, t: int) -> None:
        """Send, keep or lose the answer to a frame that came at `t`."""
        passing = [frame]
        for _, fault in self._faults:
            passing = fault.answer(passing, t)
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
        for each in self._noises:
            each.tick(now, self._send)
        self._look_ahead()
