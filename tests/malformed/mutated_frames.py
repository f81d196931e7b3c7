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
"""Mutated frames between two starts of a sane master."""
_WRITES = frozenset((2, 3, 5, 6, 8, 9, 11, 12, 13, 14))
_CONTROLWORDS = (6, 7, 15, 15, 15)
_WARM = 0.3
"""Share of the frames after which memory no longer grows."""


@dataclass
class Outcome:
    """Results of mutated frames."""

    name: str
    frames: int = 0
    seconds: float = 0.0
    starts: int = 0
    """Successful sane start-ups afterwards."""
    kinds: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    objects: int = 0
    """Growth of Python objects after the warm-up."""
    kilobytes: int = 0
    """Growth of the resident memory after the warm-up, kB."""


def resident_kb() -> int:
    """The memory of this process, kB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * (os.sysconf("SC_PAGE_SIZE") // 1024)


class Memory:
    """Growth of the memory after the warm-up."""

    def __init__(self) -> None:
        gc.collect()
        self._objects, self._kb = len(gc.get_objects()), resident_kb()

    def report(self, outcome: Outcome) -> None:
        gc.collect()
        outcome.objects = len(gc.get_objects()) - self._objects
        outcome.kilobytes = resident_kb() - self._kb


def run(count: int, seed: int) -> Outcome:
    """Send a segment `count` mutated frames; a failure names the frame."""
    outcome = Outcome("segment")
    random, corpus, line = Random(seed), frames(), Line()
    began = time.monotonic()
    memory: Memory | None = None
    while outcome.frames < count and len(outcome.failures) < 10:
        if memory is None and outcome.frames >= _WARM * count:
            memory = Memory()
        try:
            line.start(random.choice(STATES))
            outcome.starts += 1
        except Exception:
            outcome.failures.append(f"the start-up after {outcome.frames} frames:\n{traceback.format_exc()}")
            line = Line()
            continue
        _mutate(line, random, corpus, outcome, min(TURN, count - outcome.frames))
    try:
        line.start(OP)
        outcome.starts += 1
    except Exception:
        outcome.failures.append(f"the last start-up:\n{traceback.format_exc()}")
    outcome.seconds = time.monotonic() - began
    if memory is not None:
        memory.report(outcome)
    return outcome


def _mutate(line: Line, random: Random, corpus: list[bytes], outcome: Outcome, count: int) -> None:
    for _ in range(count):
        frame = bytes(mutated(random.choice(corpus), random))
        outcome.frames += 1
        before = line.targets()
        try:
            answer = line.give(frame, random.choice((1_000, 50_000, 100_000, 1_000_000)))
            if random.random() < 0.2:
                line.exchange(random.choice(_CONTROLWORDS), random.randrange(-20_000, 20_000))
                before = []
        except Exception:
            outcome.failures.append(f"{frame.hex()}:\n{traceback.format_exc()}")
            return
        outcome.kinds["answered" if answer is not None else "not answered"] += 1
        if answer is not None and len(answer) != len(frame):
            outcome.failures.append(f"{frame.hex()}: came back with {len(answer)} bytes")
        if before and line.targets() != before and not writes(frame):
            outcome.failures.append(f"{frame.hex()}: writes nothing and changed outputs")


def writes(frame: bytes) -> bool:
    """Whether the frame has a well-formed datagram that may write."""
    return any(frame[at] in _WRITES for at, _ in places(frame))
