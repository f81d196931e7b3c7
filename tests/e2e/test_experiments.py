"""The experiments of the thesis that move the arm (facts, "The experiments to hold the platform against"), on the bus
`virtual`: real frames between real processes. Time is counted in cycles: a host that takes cycles away stretches it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rtcp.runtime.observer import Observer
from rtcp.runtime.paths import blackboard_file
from tests.e2e.conftest import Platform

Array = npt.NDArray[np.float64]


@dataclass
class Recording:
    """Cycle records of a motion: shape (cycles,) of the blackboard's record type."""

    records: list[npt.NDArray[np.void]] = field(default_factory=list)
    lost: int = 0
    period_s: float = 0.0

    def column(self, name: str) -> Array:
        return np.concatenate([part[name] for part in self.records]).astype(float)


@contextmanager
def recording(platform: Platform) -> Iterator[Recording]:
    """Record every cycle meanwhile."""
    observer = Observer(blackboard_file(platform.directory))
    made = Recording(period_s=observer.period_ns * 1e-9)
    done = threading.Event()
    at = observer.head

    def follow() -> None:
        nonlocal at
        last = False
        while not last:
            last = done.wait(0.2)
            records, lost = observer.since(at)
            if len(records):
                at = int(records[-1]["number"])
                made.records.append(records)
                made.lost += lost

    thread = threading.Thread(target=follow)
    thread.start()
    try:
        yield made
    finally:
        done.set()
        thread.join()
        observer.close()


def test_a_step_of_1_35_rad_settles_within_7_5_s_at_0_2_rad_s(enabled: Platform) -> None:
    start = enabled.status()["joints"]["position"]
    target = [start[0] + (1.35 if start[0] < 0.5 else -1.35), *start[1:]]
    with recording(enabled) as made:
        enabled.rtcp("move", *(f"{q:.6f}" for q in target), "--speed", "0.2")
    assert made.lost == 0
    commanded, actual = made.column("target")[:, 0], made.column("position")[:, 0]
    moving = np.flatnonzero(np.abs(np.diff(commanded)) > 0)
    begun = moving[0]
    away = np.flatnonzero(np.abs(actual - target[0]) > 0.0007)
    settled_s = (away[-1] + 1 - begun) * made.period_s
    assert abs(commanded[-1] - commanded[begun]) > 1.34
    assert settled_s <= 7.5
    assert abs(actual[-1] - target[0]) < 0.0007
