"""Ratio and temperature: equation 4.3, cold ends, uncertainty."""

from __future__ import annotations

from math import cosh
from random import Random
from statistics import fmean, stdev

import pytest

from rtcp.processes.shape_setting import temperature

ALLOY = temperature.Alloy(8.9e-7, 1.78e-10, 0.1)
NO_ENDS = temperature.ColdEnds(2.0, 1e-4, 0.0)


def test_the_ratio_is_that_of_equation_4_3() -> None:
    ends = temperature.ColdEnds(0.3, 0.0085, 0.0)
    scale = temperature.ratio_scale(ALLOY, ends, 22.0, 22.0)
    mean = scale.mean(1.1)
    by_equation = (8.9e-7 + 1.78e-10 * (mean - 20.0)) / (8.9e-7 + 1.78e-10 * (22.0 - 20.0))
    assert by_equation == pytest.approx(1.1)


@pytest.mark.parametrize(("end_length", "below_k"), [(0.005, 16), (0.0085, 27), (0.0135, 44), (0.018, 58)])
def test_the_mean_is_below_the_middle_by_the_fin_solution(end_length: float, below_k: float) -> None:
    """Facts: 0.3 m, rods of 0.5, 1, 2 and 3.2 mm at 500 C."""
    scale = temperature.ratio_scale(ALLOY, temperature.ColdEnds(0.3, end_length, 0.0), 20.0, 20.0)
    ratio = scale.ratio_for_middle(500.0)
    assert scale.middle(ratio) == pytest.approx(500.0)
    assert 500.0 - scale.mean(ratio) == pytest.approx(below_k, abs=1.0)


@pytest.mark.parametrize("half", [0.3, 1.0, 5.0])
def test_the_share_of_the_mean_is_the_integral_along_the_rod(half: float) -> None:
    profile = [1.0 - cosh(half * (2 * n + 1 - 1000) / 1000) / cosh(half) for n in range(1000)]
    ends = temperature.ColdEnds(1.0, 0.5 / half, 0.0)
    assert ends.mean_by_middle() == pytest.approx(fmean(profile) / (1.0 - 1.0 / cosh(half)), rel=1e-5)


def test_a_rod_that_is_much_longer_than_its_cold_ends_has_one_temperature() -> None:
    assert NO_ENDS.mean_by_middle() == pytest.approx(1.0, abs=1e-3)
    assert temperature.ColdEnds(2.0, 1e-6, 0.0).mean_by_middle() == pytest.approx(1.0, abs=1e-5)


def test_a_cold_end_is_as_long_as_conduction_and_air_make_it() -> None:
    assert temperature.cold_end_length(1e-3, 18.0, 60.0) == pytest.approx(8.66e-3, rel=1e-3)


def test_every_temperature_says_which_one_it_is() -> None:
    scale = temperature.ratio_scale(ALLOY, temperature.ColdEnds(0.3, 0.0085, 0.1), 20.0, 20.0)
    mean = temperature.mean_temperature(ALLOY, scale, 1.1, 1e-3, 1.0)
    middle = temperature.middle_temperature(temperature.ColdEnds(0.3, 0.0085, 0.1), scale, mean)
    assert (mean.place, middle.place) == (temperature.Place.MEAN, temperature.Place.MIDDLE)
    assert "in the middle (u = " in str(middle)
    assert str(temperature.Temperature(500.0, 1.0, temperature.Place.MEAN)) == "500.0 C in the mean (u = 1.0 K)"


def test_the_uncertainty_is_the_scatter_of_what_it_is_made_of() -> None:
    """Monte Carlo (GUM supplement 1) against the linear formula."""
    ends, ratio = temperature.ColdEnds(0.3, 0.0085, 0.2), 1.0975
    scale = temperature.ratio_scale(ALLOY, ends, 22.0, 22.0)
    stated = temperature.middle_temperature(ends, scale, temperature.mean_temperature(ALLOY, scale, ratio, 1e-3, 2.0))
    chance, drawn = Random(1), []
    for _ in range(20_000):
        alloy = temperature.Alloy(8.9e-7, 1.78e-10 / (1.0 + 0.1 * chance.gauss(0, 1)), 0.0)
        cold = temperature.ColdEnds(0.3, 0.0085 * (1.0 + 0.2 * chance.gauss(0, 1)), 0.0)
        initial = 22.0 + 2.0 * chance.gauss(0, 1)
        line = temperature.RatioScale(initial, alloy.resistivity(initial) / alloy.alpha, 22.0, cold.mean_by_middle())
        drawn.append(line.middle(ratio + 1e-3 * chance.gauss(0, 1)))
    assert stated.uncertainty_k == pytest.approx(stdev(drawn), rel=0.05)


def test_the_mean_of_a_very_long_rod_goes_on_where_its_series_ends() -> None:
    def mean(length: float) -> float:
        return temperature.ColdEnds(length, 1e-3, 0.0).mean_by_middle()

    # Beyond 350 end lengths to each side cosh would overflow soon.
    assert mean(0.7001) == pytest.approx(mean(0.6999), abs=1e-6)
    assert mean(2.0) == pytest.approx(0.999)
