"""Mutated frames at the segment, in all states, among sane ones; then a start-up that must succeed."""

from __future__ import annotations

import gc
import os
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from tests.malformed.corpus import frames
from tests.malformed.line import INIT, OP, PRE_OP, SAFE_OP, Line
from tests.malformed.mutate import mutated, places

STATES = (INIT, PRE_OP, SAFE_OP, OP, OP)
TURN = 500
"""Mutated frames until a sane master starts anew."""
_WRITES = frozenset((2, 3, 5, 6, 8, 9, 11, 12, 13, 14))
_CONTROLWORDS = (6, 7, 15, 15, 15)
_WARM = 0.3
"""After this share of the frames everything that is kept is there."""


@dataclass
class Found:
    """What came of mutated frames."""

    name: str
    frames: int = 0
    seconds: float = 0.0
    starts: int = 0
    """How often a sane start-up succeeded afterwards."""
    kinds: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    objects: int = 0
    """Python objects more at the end than when all was warm."""
    kilobytes: int = 0
    """Resident memory more at the end than when all was warm."""


def resident_kb() -> int:
    """The memory of this process, kB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * (os.sysconf("SC_PAGE_SIZE") // 1024)


class Memory:
    """What is kept more than when all was warm."""

    def __init__(self) -> None:
        gc.collect()
        self._objects, self._kb = len(gc.get_objects()), resident_kb()

    def report(self, found: Found) -> None:
        gc.collect()
        found.objects = len(gc.get_objects()) - self._objects
        found.kilobytes = resident_kb() - self._kb


def run(count: int, seed: int) -> Found:
    """Give a segment `count` mutated frames; a failure names the frame."""
    found = Found("segment")
    random, corpus, line = Random(seed), frames(), Line()
    began = time.monotonic()
    memory: Memory | None = None
    while found.frames < count and len(found.failures) < 10:
        if memory is None and found.frames >= _WARM * count:
            memory = Memory()
        try:
            line.start(random.choice(STATES))
            found.starts += 1
        except Exception:
            found.failures.append(f"the start-up after {found.frames} frames:\n{traceback.format_exc()}")
            line = Line()
            continue
        _turn(line, random, corpus, found, min(TURN, count - found.frames))
    try:
        line.start(OP)
        found.starts += 1
    except Exception:
        found.failures.append(f"the last start-up:\n{traceback.format_exc()}")
    found.seconds = time.monotonic() - began
    if memory is not None:
        memory.report(found)
    return found


def _turn(line: Line, random: Random, corpus: list[bytes], found: Found, count: int) -> None:
    for _ in range(count):
        frame = bytes(mutated(random.choice(corpus), random))
        found.frames += 1
        before = line.targets()
        try:
            answer = line.give(frame, random.choice((1_000, 50_000, 100_000, 1_000_000)))
            if random.random() < 0.2:
                line.exchange(random.choice(_CONTROLWORDS), random.randrange(-20_000, 20_000))
                before = []
        except Exception:
            found.failures.append(f"{frame.hex()}:\n{traceback.format_exc()}")
            return
        found.kinds["answered" if answer is not None else "not answered"] += 1
        if answer is not None and len(answer) != len(frame):
            found.failures.append(f"{frame.hex()}: came back with {len(answer)} bytes")
        if before and line.targets() != before and not writes(frame):
            found.failures.append(f"{frame.hex()}: writes nothing and changed outputs")


def writes(frame: bytes) -> bool:
    """Whether a well-formed datagram in it may write."""
    return any(frame[at] in _WRITES for at, _ in places(frame))
