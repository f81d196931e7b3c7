"""The way of frames between the segment's socket and its first slave, and the faults that wait on it."""

from __future__ import annotations

import heapq

from rtcp.config.faults import Fault, Noise
from rtcp.virtual.faults.troubles import MOST_AT_ONCE, TROUBLES, NoiseSource, Send, Trouble

FOR_EVER = 1 << 63
"""An instant that does not come."""
MOST_UNDER_WAY = 10_000
"""Late answers that are kept; a cable holds no more either."""
_ORDER = tuple(TROUBLES)
FRAME_FAULTS = (*_ORDER, Noise)
"""The faults that are made here."""


class FrameUndo:
    """Ends one of these faults; tells what it has done."""

    def __init__(self, frames: Frames, trouble: Trouble | NoiseSource) -> None:
        self._frames = frames
        self._trouble = trouble

    @property
    def over(self) -> bool:
        """Whether its burst has passed."""
        return self._trouble.over

    @property
    def counts(self) -> dict[str, int]:
        """How many frames it has struck, by what was done to them."""
        return dict(self._trouble.counts)

    def __call__(self, t: int) -> None:
        """End it; answers that are late already come when they are due."""
        self._frames.end(self._trouble)


class Frames:
    """The way of the frames between the socket and the segment.

    Where `active`, each frame that comes is shown to `arrives` first, and its answer goes to `answers` and not to the
    socket. What is sent later is sent by `tick`, to be called when `due` has come. Instants are ns, CLOCK_MONOTONIC.
    """

    def __init__(self, send: Send) -> None:
        self.active = False
        self.due = FOR_EVER
        self._send = send
        self._troubles: list[tuple[int, Trouble]] = []
        self._noises: list[NoiseSource] = []
        self._under_way: list[tuple[int, int, bytes]] = []
        self._number = 0

    def begin(self, fault: Fault, t: int) -> FrameUndo:
        """Let a fault begin at instant `t`."""
        trouble: Trouble | NoiseSource
        if isinstance(fault, Noise):
            trouble = NoiseSource(fault, t)
            self._noises.append(trouble)
        else:
            kind = type(fault)
            trouble = TROUBLES[kind](fault, self._later)
            self._troubles.append((_ORDER.index(kind), trouble))
            self._troubles.sort(key=lambda each: each[0])
        self._look_ahead()
        return FrameUndo(self, trouble)

    def end(self, trouble: Trouble | NoiseSource) -> None:
        """Let a fault end; what it has kept goes to the master."""
        if isinstance(trouble, NoiseSource):
            self._noises = [each for each in self._noises if each is not trouble]
        else:
            self._troubles = [each for each in self._troubles if each[1] is not trouble]
            for frame in trouble.end():
                self._send(frame)
        self._look_ahead()

    def _later(self, frame: bytes, due: int) -> None:
        if len(self._under_way) < MOST_UNDER_WAY:
            self._number += 1
            heapq.heappush(self._under_way, (due, self._number, frame))

    def _look_ahead(self) -> None:
        """Forget bursts that have passed; find what is next."""
        self._troubles = [each for each in self._troubles if not each[1].over]
        self.active = bool(self._troubles)
        due = self._under_way[0][0] if self._under_way else FOR_EVER
        for each in self._noises:
            due = min(due, each.due)
        self.due = due

    def arrives(self) -> bool:
        """Whether the frame that has come reaches the segment."""
        arrives = True
        for _, trouble in self._troubles:
            # Each is asked, so that what one fault does is the same whether there are others or not.
            if not trouble.arrives():
                arrives = False
        if not arrives:
            self._look_ahead()
        return arrives

    def answers(self, frame: bytes, t: int) -> None:
        """Send, keep or lose the answer to a frame that came at `t`."""
        passing = [frame]
        for _, trouble in self._troubles:
            passing = trouble.answer(passing, t)
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
