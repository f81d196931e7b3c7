"""Percentiles over a sliding minute."""

from __future__ import annotations

import numpy as np

from rtcp.realtime.statistics import SlidingPercentiles, percentiles


def test_the_percentiles_of_the_window_are_those_of_its_samples() -> None:
    samples = np.random.default_rng(1).exponential(40.0, 20_000)
    figure = SlidingPercentiles()
    for part, second in zip(np.split(samples, 20), range(100, 120), strict=True):
        figure.add(second, part)
    found, exact = figure.read(), percentiles(samples)
    assert abs(found.p50 - exact.p50) <= 1.0
    assert abs(found.p99 - exact.p99) <= 1.5
    assert abs(found.p999 - exact.p999) <= 6.0
    assert found.max == exact.max


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
