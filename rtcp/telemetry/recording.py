"""Cycle records: recorded from the blackboard beside the running loop, and the steps of the targets in them."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rtcp.ipc.layout import FLAG_ENABLED
from rtcp.ipc.observer import Observer

Array = npt.NDArray[np.float64]

_READ_INTERVAL_S = 0.2
"""The ring holds 12 s or more of cycles."""


@dataclass
class Recording:
    """Cycle records, oldest first."""

    period_s: float
    """Cycle, s."""
    parts: list[npt.NDArray[np.void]] = field(default_factory=list)
    lost: int = 0
    """Records that were overwritten before they were read."""

    def column(self, name: str) -> Array:
        """Return a field of the records, shape (cycles,) or (cycles, joints), as floats; SI units."""
        if not self.parts:
            return np.empty(0)
        return np.concatenate([part[name] for part in self.parts]).astype(np.float64)

    @property
    def seconds(self) -> Array:
        """Time of each record since the first, by its cycle number, shape (cycles,), s."""
        cycles = self.column("cycle")
        return (cycles - cycles[0]) * self.period_s if len(cycles) else cycles


@contextmanager
def recording(blackboard: Path) -> Iterator[Recording]:
    """Record every cycle while inside.

    Raises:
        BlackboardError: there is no blackboard at this path.
    """
    observer = Observer(blackboard)
    made = Recording(observer.period_ns * 1e-9)
    done = threading.Event()
    at = observer.head

    def read() -> None:
        nonlocal at
        last = False
        while not last:
            last = done.wait(_READ_INTERVAL_S)
            records, lost = observer.since(at)
            made.lost += lost
            if len(records):
                at = int(records[-1]["number"])
                made.parts.append(records)

    thread = threading.Thread(target=read, name="recording", daemon=True)
    thread.start()
    try:
        yield made
    finally:
        done.set()
        thread.join()
        observer.close()


def target_steps(
    records: Mapping[str, npt.NDArray[Any]] | npt.NDArray[np.void],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return the steps of the targets between consecutive cycles with enabled drives.

    Without enabled drives a target only repeats the position.

    Returns:
        The index of each step's second cycle, shape (n,), and its size for each joint, shape (n, joints), rad.
    """
    numbers = records["number"].astype(np.int64)
    enabled = (records["flags"] & FLAG_ENABLED) != 0
    pairs = np.flatnonzero((np.diff(numbers) == 1) & enabled[1:] & enabled[:-1])
    targets = records["sent_position"]
    return pairs + 1, np.abs(targets[pairs + 1] - targets[pairs])
