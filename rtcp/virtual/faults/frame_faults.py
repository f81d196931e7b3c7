"""What each fault of frames does to those that pass: loses, delays, doubles, swaps, garbles them, or adds its own."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from types import MappingProxyType
from typing import Any, Protocol

from rtcp.config.faults import Delay, Duplicate, Fault, Garble, Loss, Noise, Reorder
from rtcp.virtual.faults import noise
from rtcp.virtual.faults.selector import FrameSelector

MOST_AT_ONCE = 16
"""Frames that are sent in one look at what is due: those of the master come in between."""
LONGEST_BEHIND = 20_000_000
"""Noise that is late by more than this many ns, because the process was stopped, is left out."""

Send = Callable[[bytes], object]
Later = Callable[[bytes, int], None]
"""Takes a frame and the instant at which it is to be sent."""


class FrameFault(Protocol):
    """A fault at work on the frames that pass."""

    counts: dict[str, int]

    @property
    def over(self) -> bool:
        """Whether it has passed by itself."""

    def arrives(self) -> bool:
        """Whether the frame that has come reaches the segment; called once a frame."""

    def answer(self, frames: list[bytes], t: int) -> list[bytes]:
        """Return what goes back to the master now, in this order, of `frames` that came to the segment at `t`."""

    def end(self) -> list[bytes]:
        """Return the frames that it has kept."""


class _Losing:
    """Half of what is lost never reaches the slaves, the other half is lost on its way back."""

    def __init__(self, fault: Loss, later: Later) -> None:
        self._strikes = FrameSelector(fault)
        self._behind = False
        self.counts = {"lost_before": 0, "lost_behind": 0}

    @property
    def over(self) -> bool:
        return self._strikes.passed and not self._behind

    def arrives(self) -> bool:
        self._behind = False
        if not self._strikes.next():
            return True
        self._behind = self._strikes.random.random() < 0.5
        if not self._behind:
            self.counts["lost_before"] += 1
        return self._behind

    def answer(self, frames: list[bytes], t: int) -> list[bytes]:
        if not self._behind:
            return frames
        self._behind = False
        self.counts["lost_behind"] += 1
        return []

    def end(self) -> list[bytes]:
        return []


class _OnAnswers:
    """What the faults that strike answers alone have in common."""

    NAME = ""

    def __init__(self, fault: Any, later: Later) -> None:
        self._fault = fault
        self._strikes = FrameSelector(fault)
        self._later = later
        self.counts = {self.NAME: 0}

    @property
    def over(self) -> bool:
        return self._strikes.passed

    def arrives(self) -> bool:
        return True

    def answer(self, frames: list[bytes], t: int) -> list[bytes]:
        passing: list[bytes] = []
        for frame in frames:
            if self._strikes.next():
                self.counts[self.NAME] += 1
                passing += self._strike(frame, t)
            else:
                passing.append(frame)
        return passing

    def _strike(self, frame: bytes, t: int) -> list[bytes]:
        raise NotImplementedError

    def end(self) -> list[bytes]:
        return []


class _Garbling(_OnAnswers):
    NAME = "garbled"

    def _strike(self, frame: bytes, t: int) -> list[bytes]:
        turned = bytearray(frame)
        count = 8 * len(frame)
        for bit in self._strikes.random.sample(range(count), min(self._fault.bits, count)):
            turned[bit >> 3] ^= 1 << (bit & 7)
        return [bytes(turned)]


class _Duplicating(_OnAnswers):
    NAME = "duplicated"

    def _strike(self, frame: bytes, t: int) -> list[bytes]:
        return [frame, frame]


class _Delaying(_OnAnswers):
    NAME = "delayed"

    def _strike(self, frame: bytes, t: int) -> list[bytes]:
        self._later(frame, t + round(self._fault.ms * 1e6))
        return []


class _Reordering(_OnAnswers):
    """Keeps one answer until the next one has gone."""

    NAME = "reordered"

    def __init__(self, fault: Reorder, later: Later) -> None:
        super().__init__(fault, later)
        self._kept: bytes | None = None

    @property
    def over(self) -> bool:
        return self._strikes.passed and self._kept is None

    def answer(self, frames: list[bytes], t: int) -> list[bytes]:
        passing: list[bytes] = []
        for frame in frames:
            if self._kept is not None:
                passing += [frame, self._kept]
                self._kept = None
            elif self._strikes.next():
                self.counts[self.NAME] += 1
                self._kept = frame
            else:
                passing.append(frame)
        return passing

    def end(self) -> list[bytes]:
        kept, self._kept = self._kept, None
        return [] if kept is None else [kept]


class NoiseSource:
    """Frames that come by themselves, at a rate."""

    over = False

    def __init__(self, fault: Noise, t: int) -> None:
        self._random = Random(fault.seed)
        self._protocol = fault.protocol
        self._period = max(1, round(1e9 / fault.rate_hz))
        self.due = t + self._period
        self.counts = {"sent": 0}

    def tick(self, now: int, send: Send) -> None:
        """Send what is due."""
        if now - self.due > LONGEST_BEHIND:
            self.due = now
        for _ in range(MOST_AT_ONCE):
            if self.due > now:
                break
            self.due += self._period
            send(noise.make(self._protocol, self._random))
            self.counts["sent"] += 1


FRAME_FAULT_KINDS: MappingProxyType[type[Fault], Callable[[Any, Later], FrameFault]] = MappingProxyType({
    Loss: _Losing, Garble: _Garbling, Reorder: _Reordering, Duplicate: _Duplicating, Delay: _Delaying,
})  # fmt: skip
"""What each fault does, in the order in which an answer meets them."""
