"""Percentiles of the cycle over a sliding minute, in bounded memory.

One histogram a second, sixty of them: what is older than the window falls out a second at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

WINDOW_S = 60
_BIN_US = 0.5
_BINS = 8000


@dataclass(frozen=True)
class Percentiles:
    """Median, 99th and 99.9th percentile and maximum, in us; zero where nothing was counted."""

    p50: float
    p99: float
    p999: float
    max: float

    def as_json(self) -> dict[str, float]:
        """Return the figures by name, rounded to 0.1 us."""
        return {
            "p50": round(self.p50, 1),
            "p99": round(self.p99, 1),
            "p999": round(self.p999, 1),
            "max": round(self.max, 1),
        }


def percentiles(samples_us: npt.NDArray[np.float64]) -> Percentiles:
    """Return the percentiles of an array of shape (N,), in us."""
    if samples_us.size == 0:
        return Percentiles(0.0, 0.0, 0.0, 0.0)
    p50, p99, p999 = np.percentile(samples_us, (50, 99, 99.9))
    return Percentiles(float(p50), float(p99), float(p999), float(samples_us.max()))


class SlidingPercentiles:
    """Percentiles of the samples of the last `WINDOW_S` seconds, to 0.5 us up to 4 ms; the maximum exact."""

    def __init__(self) -> None:
        self._counts = np.zeros((WINDOW_S, _BINS + 1), dtype=np.int64)
        self._largest = np.zeros(WINDOW_S)
        self._second: int | None = None

    def reset(self) -> None:
        """Forget everything."""
        self._counts[:] = 0
        self._largest[:] = 0
        self._second = None

    def add(self, now_s: float, samples_us: npt.NDArray[np.float64]) -> None:
        """Add samples of shape (N,), in us, taken at about `now_s` (any monotonic clock, s)."""
        self._forget(int(now_s))
        if samples_us.size == 0:
            return
        row = int(now_s) % WINDOW_S
        bins = np.clip(samples_us / _BIN_US, 0, _BINS).astype(np.int64)
        self._counts[row] += np.bincount(bins, minlength=_BINS + 1)
        self._largest[row] = max(self._largest[row], float(samples_us.max()))

    def _forget(self, second: int) -> None:
        if self._second is None:
            self._second = second
        for passed in range(self._second + 1, min(second, self._second + WINDOW_S) + 1):
            self._counts[passed % WINDOW_S] = 0
            self._largest[passed % WINDOW_S] = 0
        self._second = max(second, self._second)

    def read(self) -> Percentiles:
        """Return the percentiles of the window."""
        counts = self._counts.sum(axis=0)
        total = int(counts.sum())
        if total == 0:
            return Percentiles(0.0, 0.0, 0.0, 0.0)
        cumulative = np.cumsum(counts)
        largest = float(self._largest.max())
        at = [min(float(np.searchsorted(cumulative, total * q)) * _BIN_US, largest) for q in (0.5, 0.99, 0.999)]
        return Percentiles(at[0], at[1], at[2], largest)
