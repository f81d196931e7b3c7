"""Every cycle record of a while, taken from the blackboard beside the running loop, without touching it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtcp.ipc.observer import Observer

Array = npt.NDArray[np.float64]

_FOLLOW_S = 0.2
"""The ring holds 16 s at 500 us."""


@dataclass
class Recording:
    """Cycle records, oldest first.

    period_s: the cycle. lost: records that were overwritten before they were read.
    """

    period_s: float
    parts: list[npt.NDArray[np.void]] = field(default_factory=list)
    lost: int = 0

    def column(self, name: str) -> Array:
        """Return a field of the records, shape (cycles,) or (cycles, joints), as floats; SI units."""
        if not self.parts:
            return np.empty(0)
        return np.concatenate([part[name] for part in self.parts]).astype(np.float64)

    @property
    def seconds(self) -> Array:
        """Time of each record since the first, by the cycles that were done, shape (cycles,), s."""
        cycles = self.column("cycle")
        return (cycles - cycles[0]) * self.period_s if len(cycles) else cycles


@contextmanager
def recording(blackboard: Path) -> Iterator[Recording]:
    """Record every cycle for as long as the context lasts.

    Raises:
        BlackboardError: there is no blackboard there.
    """
    observer = Observer(blackboard)
    made = Recording(observer.period_ns * 1e-9)
    done = threading.Event()
    at = observer.head

    def follow() -> None:
        nonlocal at
        last = False
        while not last:
            last = done.wait(_FOLLOW_S)
            records, lost = observer.since(at)
            made.lost += lost
            if len(records):
                at = int(records[-1]["number"])
                made.parts.append(records)

    thread = threading.Thread(target=follow, name="recording", daemon=True)
    thread.start()
    try:
        yield made
    finally:
        done.set()
        thread.join()
        observer.close()
