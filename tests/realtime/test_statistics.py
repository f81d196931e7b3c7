"""Percentiles over a sliding minute; which part of the cycle makes it skip ticks."""

from __future__ import annotations

import numpy as np
import pytest

from rtcp.realtime.statistics import Part, Percentiles, SlidingPercentiles, diagnose, diagnose_records, percentiles


def test_the_percentiles_of_the_window_are_those_of_its_samples() -> None:
    samples = np.random.default_rng(1).exponential(40.0, 20_000)
    figure = SlidingPercentiles()
    for part, second in zip(np.split(samples, 20), range(100, 120), strict=True):
        figure.add(second, part)
    window, exact = figure.read(), percentiles(samples)
    assert abs(window.p50 - exact.p50) <= 1.0
    assert abs(window.p99 - exact.p99) <= 1.5
    assert abs(window.p999 - exact.p999) <= 6.0
    assert window.max == exact.max


def test_what_is_older_than_a_minute_is_forgotten() -> None:
    figure = SlidingPercentiles()
    figure.add(0.0, np.array([3000.0]))
    figure.add(59.0, np.array([10.0]))
    assert figure.read().max == 3000.0
    figure.add(60.5, np.array([20.0]))
    assert figure.read().max == 20.0
    figure.add(1000.0, np.array([30.0]))
    assert figure.read() == percentiles(np.array([30.0]))


def test_samples_beyond_the_histogram_keep_their_maximum() -> None:
    figure = SlidingPercentiles()
    figure.add(5.0, np.array([1.0, 123_456.0]))
    assert figure.read().max == 123_456.0


def test_nothing_counted_is_zero() -> None:
    assert SlidingPercentiles().read() == percentiles(np.array([]))


QUICK = Percentiles(p50=20.0, p99=30.0, p999=40.0, max=50.0)
SLOW_TAIL = Percentiles(p50=20.0, p99=60.0, p999=620.0, max=9000.0)


@pytest.mark.parametrize(("part", "suggested_us"), [(Part.WAKEUP, 1250), (Part.EXCHANGE, 750), (Part.COMPUTE, 750)])
def test_the_part_with_the_slowest_tail_is_the_cause_and_the_suggested_period_holds_it(
    part: Part, suggested_us: int
) -> None:
    times = {part_of_cycle: SLOW_TAIL if part_of_cycle is part else QUICK for part_of_cycle in Part}
    diagnosis = diagnose(500.0, 997, 3, times[Part.WAKEUP], times[Part.EXCHANGE], times[Part.COMPUTE])
    assert diagnosis is not None
    assert (diagnosis.part, diagnosis.part_us, diagnosis.suggested_period_us) == (part, 620.0, suggested_us)
    assert diagnosis.share == 0.003
    assert (
        diagnosis.message
        == f"0.3 % of the ticks are skipped (limit 0.1 %): in slow cycles {part.value} takes 620 of 500 us"
    )
    assert f"set cycle.period_us to {suggested_us} or more" in diagnosis.remedy


def test_where_more_than_a_hundredth_is_skipped_the_slow_cycles_are_the_last_hundredth() -> None:
    diagnosis = diagnose(500.0, 900, 100, QUICK, Percentiles(20.0, 600.0, 700.0, 800.0), QUICK)
    assert diagnosis is not None
    assert (diagnosis.part, diagnosis.part_us) == (Part.EXCHANGE, 600.0)


@pytest.mark.parametrize(("cycles", "missed"), [(0, 0), (10_000, 0), (10_000, 9)])
def test_a_cycle_that_skips_less_than_a_thousandth_has_no_diagnosis(cycles: int, missed: int) -> None:
    assert diagnose(500.0, cycles, missed, SLOW_TAIL, SLOW_TAIL, SLOW_TAIL) is None


def test_records_are_diagnosed_by_the_ticks_skipped_among_them() -> None:
    names = ("missed", "wakeup_ns", "exchange_ns", "compute_ns")
    records = np.zeros(1000, dtype=[(name, "<i8") for name in names])
    records["missed"] = 70  # before
    records["missed"][500:] = 74
    records["exchange_ns"] = 60_000
    records["compute_ns"][::100] = 900_000
    diagnosis = diagnose_records(records, 500_000)
    assert diagnosis is not None
    assert (diagnosis.missed, diagnosis.cycles, diagnosis.part, diagnosis.part_us) == (4, 1000, Part.COMPUTE, 900.0)
    assert diagnose_records(records[:500], 500_000) is None
    assert diagnose_records(records[:1], 500_000) is None
