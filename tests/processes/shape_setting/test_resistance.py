"""Resistance from pairs of one instant with the gate on throughout, and the mean of a few pulses."""

from __future__ import annotations

from math import inf, sqrt

import pytest

from rtcp.processes.shape_setting.resistance import InitialResistance, ResistanceMeter


@pytest.fixture
def meter() -> ResistanceMeter:
    fresh = ResistanceMeter(0.0005, short=0.01, open_=5.0)
    fresh.update(10.0, 20.0, 1.0, True)
    return fresh


def test_a_pair_with_the_gate_on_is_a_resistance(meter: ResistanceMeter) -> None:
    assert (meter.resistance, meter.age_s, meter.fresh) == (0.5, 0.0, True)
    assert (meter.voltage, meter.current) == (10.0, 20.0)


@pytest.mark.parametrize(("sample", "gate_on"), [(2.0, False), (1.0, True)])
def test_without_the_gate_or_without_a_new_conversion_it_is_held_with_its_age(
    meter: ResistanceMeter, sample: float, gate_on: bool
) -> None:
    for _ in range(4):
        meter.update(1.0, 20.0, sample, gate_on)
    assert (meter.resistance, meter.fresh) == (0.5, False)
    assert meter.age_s == pytest.approx(0.002)


@pytest.mark.parametrize(
    ("voltage", "current", "shows"),
    [
        (12.0, 0.0, (True, False)),
        (12.0, 2.0, (True, False)),
        (0.1, 100.0, (False, True)),
        (12.0, float("nan"), (True, False)),
    ],
)
def test_open_and_short_circuits_are_shown_once_and_are_no_resistance(
    meter: ResistanceMeter, voltage: float, current: float, shows: tuple[bool, bool]
) -> None:
    meter.update(voltage, current, 2.0, True)
    assert (meter.is_open, meter.is_short) == shows
    assert (meter.resistance, meter.fresh) == (0.5, False)
    meter.update(voltage, current, 3.0, False)
    assert (meter.is_open, meter.is_short) == (False, False)


def test_after_the_circuit_was_opened_there_is_no_resistance_of_now(meter: ResistanceMeter) -> None:
    meter.forget()
    assert meter.age_s == inf


def test_the_uncertainty_is_that_of_the_mean_and_of_the_drift() -> None:
    initial = InitialResistance()
    initial.begin()
    for ohm in (0.339, 0.341, 0.340, 0.340):
        initial.add(ohm)
    initial.finish()
    assert initial.value == pytest.approx(0.340)
    deviation_of_mean = sqrt((1e-6 + 1e-6) / 3 / 4)
    assert initial.uncertainty == pytest.approx(sqrt(deviation_of_mean**2 + 1e-6 / 12))
    initial.begin()
    assert initial.value == 0.0
