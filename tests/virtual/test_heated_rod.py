from __future__ import annotations

from dataclasses import replace
from functools import cache
from random import Random
from typing import NamedTuple

import numpy as np
import pytest

from rtcp.virtual.heated_rod import Alloy, HeatedRod, convection, draw, setting_rate
from tests.samples import some

CYCLE = 500e-6
SOURCE = 0.012


class Row(NamedTuple):
    """Figures of a rod of 0.3 m at 12 V behind 12 mohm, held at 500 C; pairs are for emissivity 0.3 and 0.8."""

    diameter: float
    resistance: float
    convection: float
    hold: tuple[float, float]
    on_current: float
    duty: tuple[float, float]
    rate: float
    cold_end: tuple[float, float]
    """mm."""
    mean_below: float


TABLE = [
    Row(0.5e-3, 1.36, 64, (17, 22), 8, (0.18, 0.23), 550, (5, 5), 16),
    Row(1e-3, 0.340, 41, (24, 34), 31, (0.066, 0.092), 520, (9, 8), 27),
    Row(2e-3, 0.085, 28, (37, 55), 114, (0.03, 0.045), 430, (15, 12), 44),
    Row(3.2e-3, 0.033, 22, (50, 80), 248, (0.023, 0.036), 300, (20, 16), 58),
]
"""`duty` is the hold power over the full power, V I."""
by_diameter = pytest.mark.parametrize("row", some(TABLE), ids=lambda row: f"{row.diameter * 1e3:g}mm")
by_emissivity = pytest.mark.parametrize(("case", "emissivity"), [(0, 0.3), (1, 0.8)], ids=["bright", "oxidised"])


def rod(diameter: float = 1e-3, alloy: Alloy | None = None, ambient: float = 20.0, cells: int = 48) -> HeatedRod:
    return HeatedRod(alloy or Alloy(), diameter=diameter, length=0.3, ambient=ambient, cells=cells)


def hold(heated: HeatedRod, temperature: float, seconds: float) -> float:
    """Keep the middle at a temperature by a continuous current; return the last power, W."""
    step, power, lost = 0.02, 0.0, heated.air_energy + heated.chuck_energy
    for _ in range(round(seconds / step)):
        missing = temperature - heated.middle_temperature
        strongest = (12.0 / (heated.resistance + SOURCE)) ** 2 * heated.resistance
        power = min(strongest, max(0.0, power + missing * heated.mass * 5000.0))
        heated.step(step, (power / heated.resistance) ** 0.5)
        before, lost = lost, heated.air_energy + heated.chuck_energy
        power = (lost - before) / step
    return power


@cache
def held(diameter: float, emissivity: float) -> tuple[HeatedRod, float]:
    """Return a rod that was held at 500 C, and its power; several tests read it."""
    heated = rod(diameter, Alloy(emissivity=emissivity))
    return heated, hold(heated, 500.0, 120.0)


def cool(heated: HeatedRod, seconds: float) -> None:
    heated.step(seconds, 0.0)


@by_diameter
def test_cold_resistance_and_convection_are_those_of_the_table(row: Row) -> None:
    assert rod(row.diameter).resistance == pytest.approx(row.resistance, rel=0.01)
    assert convection(np.array([500.0]), 20.0, row.diameter)[0] == pytest.approx(row.convection, rel=0.02)


@by_diameter
def test_the_first_millisecond_heats_at_the_rate_of_the_table(row: Row) -> None:
    heated = rod(row.diameter)
    for _ in range(2):
        heated.step(CYCLE, 12.0 / (heated.resistance + SOURCE))
    assert (heated.middle_temperature - 20.0) / 1e-3 == pytest.approx(row.rate, rel=0.02)


@by_emissivity
@by_diameter
def test_holding_500_degrees_takes_power_current_and_duty_of_the_table(row: Row, case: int, emissivity: float) -> None:
    heated, power = held(row.diameter, emissivity)
    assert heated.middle_temperature == pytest.approx(500.0, abs=3.0)
    assert power == pytest.approx(row.hold[case], rel=0.03)
    current = 12.0 / (heated.resistance + SOURCE)
    assert current == pytest.approx(row.on_current, rel=0.015)
    assert power / (current**2 * heated.resistance) == pytest.approx(row.duty[case], rel=0.05)


@by_emissivity
@by_diameter
def test_cold_ends_are_up_to_30_percent_shorter_than_those_of_a_fin_with_constant_loss(
    row: Row, case: int, emissivity: float
) -> None:
    """The table takes the loss coefficient at 500 C for the whole fin; near 500 C the loss rises faster than that."""
    heated, _ = held(row.diameter, emissivity)
    half = len(heated.positions) // 2
    missing = heated.middle_temperature - heated.temperature[:half]
    cold_end = float(np.interp(-480.0 / np.e, -missing, heated.positions[:half])) * 1e3
    assert 0.7 * row.cold_end[case] < cold_end < 1.05 * row.cold_end[case]
    # The table's mean belongs to the middle of the two emissivities.
    assert 0.7 * row.mean_below < heated.middle_temperature - heated.mean_temperature < 1.0 * row.mean_below


def test_three_times_as_many_cells_show_the_same_rod() -> None:
    coarse, fine = rod(), rod(cells=144)
    powers = hold(coarse, 500.0, 60.0), hold(fine, 500.0, 60.0)
    assert powers[0] == pytest.approx(powers[1], rel=1e-3)
    assert coarse.mean_temperature == pytest.approx(fine.mean_temperature, abs=0.3)


@pytest.mark.parametrize("martensite", [80e-8, 102e-8])
def test_heat_made_is_heat_stored_and_lost(martensite: float) -> None:
    heated = rod(alloy=Alloy(resistivity_martensite=martensite), ambient=-60.0)
    before = heated.stored_energy
    for cycle in range(4000):
        heated.step(CYCLE, 20.0 if cycle % 8 < 3 else 0.0)
    lost = heated.air_energy + heated.chuck_energy
    assert heated.joule_energy > 90.0
    assert lost > 3.0
    assert heated.stored_energy - before + lost == pytest.approx(heated.joule_energy, rel=1e-9)


def test_a_long_step_is_as_good_as_many_short_ones() -> None:
    long, short = rod(), rod()
    long.step(1.0, 8.0)
    for _ in range(2000):
        short.step(CYCLE, 8.0)
    assert long.temperature == pytest.approx(short.temperature, abs=0.5)


def test_the_ratio_of_resistances_gives_the_mean_temperature() -> None:
    heated = rod()
    initial = heated.resistance
    hold(heated, 500.0, 30.0)
    assert (heated.resistance / initial - 1.0) / 2e-4 + 20.0 == pytest.approx(heated.mean_temperature, abs=0.5)


@pytest.mark.parametrize(("martensite", "sign"), [(80e-8, -1), (102e-8, 1)])
def test_martensite_changes_the_initial_resistance_either_way(martensite: float, sign: int) -> None:
    alloy = Alloy(resistivity_martensite=martensite)
    change = rod(alloy=alloy, ambient=-80.0).resistance / rod(alloy=alloy, ambient=-40.0).resistance - 1.0
    assert 0.07 < sign * change < 0.20


def test_the_phase_runs_round_a_hysteresis_loop() -> None:
    heated = rod(ambient=-80.0)
    middle = len(heated.positions) // 2
    assert heated.martensite[middle] == 1.0
    loop: list[tuple[float, float]] = []
    for current in (3.0, 0.0):
        for _ in range(12000):
            heated.step(0.02, current)
            loop.append((heated.temperature[middle], heated.martensite[middle]))
    assert loop[11999][0] > -12.0
    assert heated.martensite[middle] == 1.0
    heating, cooling = np.array(loop[:12000]), np.array(loop[12000:])
    for branch, start, finish in ((heating, -27.0, -12.0), (cooling, -64.0, -49.0)):
        assert branch[branch[:, 0] < start - 0.1, 1] == pytest.approx(1.0)
        assert branch[branch[:, 0] > finish + 0.1, 1] == pytest.approx(0.0)
    # Both branches fall by half in the middle of their range.
    assert np.interp(-0.5, -heating[:, 1], heating[:, 0]) == pytest.approx(-19.5, abs=0.5)
    assert np.interp(0.5, cooling[:, 1], cooling[:, 0]) == pytest.approx(-56.5, abs=0.5)


def test_latent_heat_delays_the_rod() -> None:
    warm = {}
    for latent in (12e3, 24e3):
        heated = rod(alloy=Alloy(latent_heat=latent), ambient=-80.0)
        heated.step(0.4, 25.0)
        warm[latent] = heated.middle_temperature
        assert heated.martensite[24] == 0.0
    assert warm[12e3] - warm[24e3] == pytest.approx(12e3 / 500.0, abs=2.0)


def test_bending_beyond_the_plateau_makes_martensite_and_heat_takes_it_away() -> None:
    heated = rod()
    curvature = np.zeros((48, 3))
    curvature[:, 1] = 2 * 0.007 / 1e-3
    heated.bend(curvature)
    heated.step(CYCLE, 0.0)
    assert not heated.martensite.any()
    curvature[:, 1] = 2 * 0.03 / 1e-3
    heated.bend(curvature)
    heated.step(CYCLE, 0.0)
    straight = rod().resistance
    assert heated.strain == pytest.approx(0.03)
    assert 0.1 < heated.martensite[24] < 0.5
    assert heated.resistance > 1.01 * straight
    hold(heated, 450.0, 10.0)
    assert heated.martensite[24] == 0.0


def test_a_straightened_rod_gives_its_stress_induced_martensite_back() -> None:
    heated = rod()
    curvature = np.zeros((48, 3))
    curvature[:, 2] = 60.0
    heated.bend(curvature)
    heated.step(CYCLE, 0.0)
    heated.bend(0.0 * curvature)
    heated.step(CYCLE, 0.0)
    assert not heated.martensite.any()


def bent_and_held(temperature: float, seconds: float) -> HeatedRod:
    heated = rod()
    curvature = np.zeros((48, 3))
    curvature[:, 1] = 20.0
    heated.bend(curvature)
    hold(heated, temperature, seconds)
    cool(heated, 30.0)
    return heated


def test_half_a_minute_at_525_degrees_sets_the_shape_but_for_the_cold_ends() -> None:
    heated = bent_and_held(527.0, 33.0)
    assert heated.set_fraction[24] > 0.93
    # A cold end is 7.5 mm long here. Fast heating is uniform at first: the ends are hot for some seconds.
    assert not heated.set_fraction[heated.positions < 4e-3].any()
    assert heated.set_fraction[heated.positions < 7.5e-3].max() < 0.1
    assert heated.set_fraction[12:36].min() > 0.5
    assert not heated.structure_lost.any()
    heated.release()
    assert heated.shape[24, 1] == pytest.approx(20.0 * 0.95, abs=0.6)
    assert not heated.shape[heated.positions < 4e-3].any()
    assert not heated.strain.any()


def test_no_shape_is_set_below_450_degrees() -> None:
    heated = bent_and_held(440.0, 60.0)
    assert not heated.set_shape.any()


def test_a_shape_is_set_faster_the_hotter_the_rod() -> None:
    rates = setting_rate(np.array([449.0, 500.0, 525.0, 550.0]))
    assert rates == pytest.approx([0.0, 1 / 20, 1 / 10, 1 / 5], rel=0.1)


def test_a_cell_that_was_over_600_degrees_stays_marked() -> None:
    heated = rod()
    hold(heated, 620.0, 5.0)
    cool(heated, 60.0)
    assert heated.middle_temperature < 60.0
    assert heated.structure_lost[24]
    assert not heated.structure_lost[0]


def test_a_rod_left_on_melts_and_stays_open() -> None:
    heated = rod()
    for _ in range(8000):
        if heated.resistance != np.inf:
            heated.step(CYCLE, 12.0 / (heated.resistance + SOURCE))
    assert heated.resistance == np.inf
    cool(heated, 1.0)
    assert heated.resistance == np.inf


def test_drawn_rods_repeat_with_the_seed_and_stay_in_the_ranges() -> None:
    random = Random(3)
    rods = [draw(random) for _ in range(200)]
    assert draw(Random(3)).alloy == rods[0].alloy
    diameters, lengths = [rod.diameter for rod in rods], [rod.length for rod in rods]
    assert 0.5e-3 <= min(diameters) < 0.6e-3
    assert 3.1e-3 < max(diameters) <= 3.2e-3
    assert 0.2 <= min(lengths) < 0.21
    assert 0.39 < max(lengths) <= 0.4
    jumps = {rod.alloy.resistivity_martensite > rod.alloy.resistivity_austenite for rod in rods}
    assert jumps == {False, True}
    for rod in rods[:20]:
        rod.step(2.0, (60.0 / rod.resistance) ** 0.5)
        assert np.isfinite(rod.temperature).all()


def test_an_alloy_whose_loop_does_not_close_is_refused() -> None:
    with pytest.raises(ValueError, match="Mf < Ms < Af"):
        replace(Alloy(), martensite_start=0.0)
