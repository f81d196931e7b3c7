"""Trends of the last hour: a few figures of the platform, kept every few seconds while the panel runs."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

SAMPLE_S = 5.0
"""Interval between two samples."""
KEPT_S = 3600.0
_POINTS = 180
"""Points of a drawn line: each is the largest sample of its part of the hour."""


@dataclass(frozen=True)
class Trend:
    """One figure over time."""

    name: str
    unit: str
    samples: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=int(KEPT_S / SAMPLE_S)))
    """Instant (time.monotonic), and the largest value since the sample before."""

    def line(self, now_s: float) -> list[tuple[float, float]]:
        """Return points of a line: age as a fraction of the hour, 0 is now, and value; oldest first."""
        largest: dict[int, float] = {}
        for at_s, value in self.samples:
            part = int((now_s - at_s) / KEPT_S * _POINTS)
            largest[part] = max(value, largest.get(part, value))
        return [(part / _POINTS, value) for part, value in sorted(largest.items(), reverse=True) if part <= _POINTS]


class Trends:
    """All figures of a platform, by their subject."""

    def __init__(self) -> None:
        self.all: dict[str, Trend] = {}
        self._largest: dict[str, float] = {}
        self._names: dict[str, tuple[str, str]] = {}
        self._due_s = 0.0
        self._missed: int | None = None

    def read(self, status: Mapping[str, Any], torque_limits: Sequence[float], temperatures: Sequence[Any]) -> None:
        """Read a status; sampled every `SAMPLE_S`, however often it is called."""
        for name, unit, value in _figures(status, torque_limits, temperatures):
            self._names[name] = name, unit
            self._largest[name] = max(value, self._largest.get(name, value))
        now = time.monotonic()
        if now < self._due_s:
            return
        self._due_s = now + SAMPLE_S
        missed, before = int(status["missed"]), self._missed
        self._missed = missed
        self._names["skipped cycles"] = "skipped cycles", ""
        self._largest["skipped cycles"] = float(missed - before) if before is not None and missed >= before else 0.0
        for name, value in self._largest.items():
            self.all.setdefault(name, Trend(*self._names[name])).samples.append((now, value))
        self._largest.clear()


def _figures(
    status: Mapping[str, Any], torque_limits: Sequence[float], temperatures: Sequence[Any]
) -> Iterator[tuple[str, str, float]]:
    """Yield name, unit and value of each figure of a status."""
    for joint, torque, limit in zip(
        status["joint_names"], status["joints"]["actual_torque"], torque_limits, strict=False
    ):
        if math.isfinite(torque) and limit > 0.0:
            yield f"{joint} torque", "% of its limit", 100.0 * abs(torque) / limit
    for joint, temperature in zip(status["joint_names"], temperatures, strict=False):
        if temperature is not None:
            yield f"{joint} temperature", "°C", float(temperature)
    for name, key in (("wake-up p99", "wakeup_us"), ("exchange p99", "exchange_us"), ("compute p99", "compute_us")):
        yield name, "us", float(status[key]["p99"])
    if (clocks := status["dc"]) is not None:
        yield "clock offset", "us", abs(float(clocks["filtered_ns"])) / 1e3
