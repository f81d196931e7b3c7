"""The effect of heat on a held rod, and its shape after its release."""

from __future__ import annotations

import numpy as np
import pytest

from rtcp.ipc.errors import Invalid
from rtcp.processes.rod import Kinetics, Rod, integrate, relax, release, set_fraction
from rtcp.processes.rod.set_shape import aligned_error

ROD = Rod(0.3, 1e-3)
HELD = integrate(ROD, [0.5, 1.0, 3.0, -10.0, 4.0, 2.0])


def test_half_a_minute_at_500_degrees_sets_95_percent() -> None:
    fraction = set_fraction([0.0, 30.0], np.full((61, 2), 500.0))
    assert fraction == pytest.approx(np.full(61, 0.95), abs=2e-3)


def test_a_cold_rod_keeps_its_shape() -> None:
    assert set_fraction([0.0, 3600.0], np.full((61, 2), 100.0)).max() < 1e-3


def test_heat_in_two_parts_sets_as_much_as_in_one() -> None:
    t = np.linspace(0.0, 60.0, 61)
    temperatures = 300.0 + 200.0 * np.sin(t / 20.0)[None, :] * np.ones((61, 1))
    whole = set_fraction(t, temperatures)
    halves = [set_fraction(t[:31], temperatures[:, :31]), set_fraction(t[30:], temperatures[:, 30:])]
    assert 1.0 - (1.0 - halves[0]) * (1.0 - halves[1]) == pytest.approx(whole)


def test_a_higher_temperature_sets_faster() -> None:
    assert np.all(np.diff(Kinetics().rate([300.0, 400.0, 500.0, 600.0])) > 0.0)


def test_a_rod_that_was_set_whole_keeps_the_held_shape() -> None:
    released = release(HELD, np.ones(61))
    assert released.error.max() < 1e-4
    assert (released.straight_start, released.straight_end) == (0.0, 0.0)


def test_a_rod_that_was_not_set_springs_back_straight() -> None:
    released = release(HELD, np.zeros(61))
    assert released.shape.end.position == pytest.approx((0.3, 0.0, 0.0))
    assert (released.straight_start, released.straight_end) == (0.3, 0.3)


def test_the_ends_that_stay_straight_are_said() -> None:
    fraction = np.ones(61)
    fraction[:5], fraction[-4:] = 0.1, 0.4
    released = release(HELD, fraction)
    assert released.straight_start == pytest.approx(0.025)
    assert released.straight_end == pytest.approx(0.020)
    assert released.error.max() > 1e-3


def test_an_error_is_that_after_the_best_alignment() -> None:
    turned = HELD.p @ HELD.rotations[30] + [0.1, 0.2, 0.3]
    assert aligned_error(turned, HELD.p).max() < 1e-12
    assert aligned_error(turned + np.eye(61, 3), HELD.p).max() > 0.1


def test_a_second_setting_begins_from_the_first() -> None:
    once = relax(HELD, np.full(61, 0.5))
    again = integrate(ROD, HELD.a, once)
    assert relax(again, np.zeros(61)) == pytest.approx(once)
    assert relax(again, np.ones(61)) == pytest.approx(again.u)


def test_strain_is_counted_from_the_set_shape() -> None:
    released = release(HELD, np.ones(61)).shape
    assert released.largest_strain < 1e-12 < HELD.largest_strain


@pytest.mark.parametrize("fraction", [np.ones(60), np.full(61, 1.1), np.full(61, np.nan)])
def test_a_fraction_that_cannot_be_is_refused(fraction: np.ndarray) -> None:
    with pytest.raises(Invalid):
        relax(HELD, fraction)


def test_times_that_do_not_rise_are_refused() -> None:
    with pytest.raises(Invalid):
        set_fraction([0.0, 0.0], np.full((61, 2), 500.0))
