"""Percentiles of the cycle over a sliding minute, in bounded memory, and why the cycle skips ticks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

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
    """Percentiles of the samples of the last `WINDOW_S` seconds, to 0.5 us up to 4 ms; the maximum exact.

    One histogram a second: older samples leave the window a second at a time.
    """

    def __init__(self) -> None:
        self._counts = np.zeros((WINDOW_S, _BINS + 1), dtype=np.int32)
        self._sum = np.zeros(_BINS + 1, dtype=np.int64)
        """Counts of the whole window."""
        self._largest = np.zeros(WINDOW_S)
        self._second: int | None = None

    def reset(self) -> None:
        """Forget everything."""
        self._counts[:] = 0
        self._sum[:] = 0
        self._largest[:] = 0
        self._second = None

    def add(self, now_s: float, samples_us: npt.NDArray[np.float64]) -> None:
        """Add samples of shape (N,), in us, taken at about `now_s` (any monotonic clock, s)."""
        self._forget(int(now_s))
        if samples_us.size == 0:
            return
        row = int(now_s) % WINDOW_S
        bins = np.clip(samples_us / _BIN_US, 0, _BINS).astype(np.int64)
        counts = np.bincount(bins, minlength=_BINS + 1)
        self._counts[row] += counts
        self._sum += counts
        self._largest[row] = max(self._largest[row], float(samples_us.max()))

    def _forget(self, second: int) -> None:
        if self._second is None:
            self._second = second
        for passed in range(self._second + 1, min(second, self._second + WINDOW_S) + 1):
            self._sum -= self._counts[passed % WINDOW_S]
            self._counts[passed % WINDOW_S] = 0
            self._largest[passed % WINDOW_S] = 0
        self._second = max(second, self._second)

    def read(self) -> Percentiles:
        """Return the percentiles of the window."""
        cumulative = np.cumsum(self._sum)
        total = int(cumulative[-1])
        if total == 0:
            return Percentiles(0.0, 0.0, 0.0, 0.0)
        largest = float(self._largest.max())
        at = [min(float(np.searchsorted(cumulative, total * q)) * _BIN_US, largest) for q in (0.5, 0.99, 0.999)]
        return Percentiles(at[0], at[1], at[2], largest)


# -- skipped ticks ----------------------------------------------------------------------------------------------

SKIPPED_SHARE = 0.001
"""Share of skipped ticks from which on `diagnose` reports them."""
_PERIOD_STEP_US = 50
_MARGIN = 1.1
"""A suggested period is this much longer than the slow cycles."""


class Part(str, Enum):
    """A part of the cycle, in the words of `rtcp status`."""

    WAKEUP = "wake-up"
    EXCHANGE = "exchange"
    COMPUTE = "compute"


_CAUSES = {
    Part.WAKEUP: "the host wakes the loop late: isolate its CPU, use a PREEMPT_RT kernel (`rtcp doctor`)",
    Part.EXCHANGE: "frames return late: check coalescing and interrupt of the network card (`rtcp doctor`)",
    Part.COMPUTE: "the cycle computes too long: set the CPU's governor to performance (`rtcp doctor`)",
}


@dataclass(frozen=True)
class SkippedTicks:
    """Which part of the cycle makes the loop skip ticks, and what to do."""

    missed: int
    cycles: int
    period_us: float
    part: Part
    """The slowest part in the slow cycles."""
    part_us: float
    """Its time there, us."""
    suggested_period_us: int
    """Period, us, that the slow cycles fit into."""

    @property
    def share(self) -> float:
        """Skipped ticks per tick, 0 to 1."""
        return self.missed / (self.missed + self.cycles)

    @property
    def remedy(self) -> str:
        """The remedy, in a sentence."""
        return f"{_CAUSES[self.part]}, or set cycle.period_us to {self.suggested_period_us} or more"

    @property
    def message(self) -> str:
        """The problem, in a sentence."""
        skipped = f"{100 * self.share:.2g} % of the ticks are skipped (limit {100 * SKIPPED_SHARE:g} %)"
        return f"{skipped}: in slow cycles {self.part.value} takes {self.part_us:.0f} of {self.period_us:g} us"


def diagnose(
    period_us: float, cycles: int, missed: int, wakeup: Percentiles, exchange: Percentiles, compute: Percentiles
) -> SkippedTicks | None:
    """Return why the cycle skips ticks, None while it skips less than `SKIPPED_SHARE` of them.

    Args:
        period_us: the cycle.
        cycles: cycles that ran.
        missed: ticks that were skipped beside them.
        wakeup: how late the cycles woke; this and the following in us, over the same time.
        exchange: from the wake-up to the returned frame.
        compute: from the returned frame to the end of the cycle.
    """
    if missed < SKIPPED_SHARE * (cycles + missed) or missed <= 0:
        return None
    parts = {Part.WAKEUP: wakeup, Part.EXCHANGE: exchange, Part.COMPUTE: compute}
    # As many cycles are slow as skip ticks.
    slow = {part: values.p99 if missed > 0.01 * cycles else values.p999 for part, values in parts.items()}
    worst = max(slow, key=slow.__getitem__)
    # The other parts at their median: two are seldom slow in the same cycle. A wake-up must come within half a period.
    needed_us = slow[worst] + sum(values.p50 for part, values in parts.items() if part is not worst)
    needed_us = max(needed_us * _MARGIN, 2 * slow[Part.WAKEUP], period_us + 1)
    suggested = math.ceil(needed_us / _PERIOD_STEP_US) * _PERIOD_STEP_US
    return SkippedTicks(missed, cycles, period_us, worst, slow[worst], suggested)


def diagnose_records(records: npt.NDArray[np.void], period_ns: int) -> SkippedTicks | None:
    """Return `diagnose` of successive cycle records, as `rtcp.ipc.observer.Observer.since` gives them."""
    if len(records) < 2:
        return None
    times = (percentiles(records[name] / 1e3) for name in ("wakeup_ns", "exchange_ns", "compute_ns"))
    return diagnose(period_ns / 1e3, len(records), int(records["missed"][-1]) - int(records["missed"][0]), *times)
