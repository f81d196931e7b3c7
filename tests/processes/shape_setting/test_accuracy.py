"""Two rods and a shape of `benchmarks/shape_setting.py`, which has the figures of a hundred."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.shape_setting import (
    CONDITIONS,
    ROOT,
    TARGET_C,
    draw_rod,
    end_length,
    run_rods,
    run_shape,
    steady_factor,
)
from rtcp.processes.rod import Form
from rtcp.processes.shape_setting.profile import read_profile
from rtcp.processes.shape_setting.temperature import ColdEnds

EXACT = CONDITIONS[0]


def test_an_exact_calibration_holds_the_middle_within_gilbert_and_websters_error_once_the_ends_are_steady() -> None:
    series = run_rods([EXACT], range(2), 1)[EXACT.name]
    assert len(series.middle) == 2, series.trips
    assert max(series.steady) < 5.0
    # Until then the ends are warmer than the correction takes them to be, and the middle is colder.
    assert max(series.middle) < 40.0


def test_a_slope_that_is_wrong_shows_in_the_middle() -> None:
    # Of this rod the slope is too small by 8 %: the middle is too cold, so no interlock ends the heat.
    series = run_rods([replace(EXACT, alpha=0.05)], [2], 1)[EXACT.name]
    assert max(series.steady) > 10.0


def test_a_rod_of_martensite_confirmed_as_austenite_is_not_heated_to_its_target() -> None:
    condition = replace(EXACT, martensite=1.0)
    series = run_rods([condition], range(2), 1)[condition.name]
    assert sum(series.trips.values()) + sum(error > 100.0 for error in series.steady) == 2


def test_the_end_length_by_truth_has_the_rise_of_the_mean_by_that_of_the_middle() -> None:
    rod = draw_rod(1, 0)
    factor = steady_factor(rod)
    assert 0.8 < factor < 1.0
    assert ColdEnds(rod.length, end_length(rod.length, factor), 0.0).mean_by_middle() == pytest.approx(factor)


def test_a_heated_shape_is_kept_but_for_its_ends() -> None:
    profile = read_profile(ROOT / "config" / "shape_setting" / "nitinol.yaml")
    assert profile.target_c == TARGET_C
    shape = run_shape(3, 1, replace(profile, hold_s=20.0, cool_c=400.0))
    assert (shape.form, shape.diameter) == (Form.ARC, 1e-3)
    assert shape.middle_fraction > 0.6
    assert 0.01 < shape.straight_start < 0.05
    assert shape.straight_start == pytest.approx(shape.straight_end, abs=0.006)
    assert 0.0 < shape.rms < shape.largest < 0.03
    assert np.isfinite(shape.kinetics_rms)
