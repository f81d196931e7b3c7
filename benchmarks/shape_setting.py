"""Shape setting, virtual: `python benchmarks/shape_setting.py [--rods N] [--minutes M] [--shapes N] [--seed S]`

Rods: drawn at random and heated by the process `ShapeSetting` with cycles of 500 us, on its signals; behind them are
the circuit and the rod of `rtcp.virtual`, without bus and slaves. One thing after another is made wrong. Printed is the
error of the temperature in the middle; a rod whose heat an interlock ended is counted by its row.
Shapes: a rod is held in a random shape, heated by a profile and released; printed is its error against that shape.
Both print tables in Markdown.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, root

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rtcp.ipc.states import State
from rtcp.processes.rod import Form, Kinetics, Rod, release, sample_equilibrium, set_fraction
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.heat_balance import ThermalProperties
from rtcp.processes.shape_setting.heat_profile import HeatProfile, Limits, heat_command
from rtcp.processes.shape_setting.interlocks import Mode, Row
from rtcp.processes.shape_setting.messages import ArmHeater, HeaterState, StartHeating
from rtcp.processes.shape_setting.profile import read_profile
from rtcp.processes.shape_setting.temperature import Alloy, ColdEnds, cold_end_length
from rtcp.virtual.heated_rod import HeatedRod, convection, draw, radiation
from rtcp.virtual.heater_circuit import FULL_SCALE, Circuit, SensePoint
from tests.processes.shape_setting.rig import CONFIRMED, LATENCY, PERIOD_S, Rig

Floats = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[1]
TARGET_C = 510.0
_ROOM_C = 20.0
_RAMP_K_S, _HOLD_S, _WINDOW_S = 300.0, 2.0, 0.5
"""The error is that of the last part of the hold."""
_LONGEST_S = 30.0
_OPEN_RELAY_CYCLES = 60
_COARSE_S = 0.005
"""Step of a rod without the process, s: the rod's own longest."""
_ENDS_AT_S = (2.0, 8.0, 30.0)
_EVERY = 4
"""Every fourth rod is held until its cold ends are steady."""
_SAMPLE_S = 0.25
GILBERT_WEBSTER_K = 10.0
"""Mean absolute error of Gilbert and Webster, RA-L 1(1), 2016, of real wires."""


# -- rods --------------------------------------------------------------------------------------------------------------


class Heater(Rig):
    """The process on its signals, with circuit and rod of `rtcp.virtual` behind them."""

    def __init__(self, rod: HeatedRod, sense_point: SensePoint, seed: int) -> None:
        super().__init__(ShapeSettingConfig("shape_setting", "heater"))
        self.rod = rod
        self.circuit = Circuit(sense_point=sense_point, seed=seed)
        self.gates = [False] * LATENCY
        self.rest_s = 0.0
        self.counter = 0

    def hardware(self) -> None:
        """Let a cycle pass in circuit and rod, and show it; without a current the rod passes several at once."""
        circuit, rod, config, values = self.circuit, self.rod, self.config, self.values
        self.gates.append(self.gate)
        gate = self.gates.pop(0)
        current = circuit.step(PERIOD_S, gate, self.relay, rod.resistance)
        if current:
            self.pass_rest()
            rod.step(PERIOD_S, current)
        else:
            self.rest_s += PERIOD_S
            if self.rest_s >= _COARSE_S:
                self.pass_rest()
        self.counter = self.counter + 1 & 0xFFFF
        values[config.voltage] = circuit.voltage_count * circuit.data.voltage_range / FULL_SCALE
        values[config.current] = circuit.current_count * circuit.data.current_range / FULL_SCALE
        values[config.gate_sense] = float(gate or circuit.current > 0.0)
        values[config.relay_closed] = float(circuit.relay_closed)
        values[config.fuse_ok] = float(circuit.fuse_intact)
        values[config.battery_voltage] = circuit.battery_voltage
        values[config.sample] = values[config.alive] = float(self.counter)

    def pass_rest(self) -> None:
        """Let the time pass in the rod that passed without a current."""
        if self.rest_s:
            self.rod.step(self.rest_s, 0.0)
            self.rest_s = 0.0


@dataclass(frozen=True)
class Condition:
    """What is wrong in a series; standard uncertainties are of normal distributions."""

    name: str
    alpha: float = 0.0
    """Relative standard uncertainty of the profile's alpha."""
    ends: float = 0.0
    """Relative standard uncertainty of the profile's end length."""
    room_k: float = 0.0
    """Standard uncertainty of the profile's initial temperature, K."""
    sense_point: SensePoint = SensePoint.ROD
    contact_change: float = 0.0
    """Change of each contact between the initial resistance and the heat, ohm."""
    martensite: float = 0.0
    """Share of martensite in the rod at its initial resistance, where the operator confirms austenite."""


CONDITIONS = (
    Condition("nothing"),
    Condition("alpha, 10 %", alpha=0.1),
    Condition("voltage tapped at the lugs", sense_point=SensePoint.LUG),
    Condition("the same, each contact 0.25 mohm less when hot", sense_point=SensePoint.LUG, contact_change=-0.25e-3),
    Condition("rod tapped, each contact 0.25 mohm less when hot", contact_change=-0.25e-3),
    Condition("10 % martensite at the measurement", martensite=0.1),
    Condition("all martensite at the measurement", martensite=1.0),
    Condition("alpha 10 %, end length 15 %, room 1 K", alpha=0.1, ends=0.15, room_k=1.0),
)


@dataclass
class Series:
    """Errors of the rods of a condition, K."""

    middle: list[float] = field(default_factory=list)
    """Of the middle, in the last part of the hold."""
    steady: list[float] = field(default_factory=list)
    """Of the middle that the same mean makes once the ends are steady."""
    stated: list[float] = field(default_factory=list)
    """Signed error of `steady` by the standard uncertainty that the process states."""
    trips: Counter[str] = field(default_factory=Counter)
    """Rods by the row of the interlocks that ended their heat."""
    hottest_c: float = 0.0
    """Highest temperature of any place of any rod, C."""


def run_rods(conditions: Sequence[Condition], numbers: Iterable[int], seed: int) -> dict[str, Series]:
    """Heat rods, drawn by seed and number, under each of the conditions."""
    series = {condition.name: Series() for condition in conditions}
    for number in numbers:
        factor = steady_factor(draw_rod(seed, number))
        for condition in conditions:
            wrong = Random(f"{seed} {number} {condition.name}")
            rod = with_martensite(draw_rod(seed, number), condition.martensite)
            heat_rod(condition, rod, factor, wrong, number, series[condition.name])
    return series


def draw_rod(seed: int, number: int) -> HeatedRod:
    """Draw a rod: the same for all conditions."""
    return draw(Random(f"{seed} {number}"))


def with_martensite(rod: HeatedRod, share: float) -> HeatedRod:
    """Return a rod that has this share of martensite at room temperature, by another Af."""
    if not share:
        return rod
    start = _ROOM_C + 20.0 * share
    alloy = replace(
        rod.alloy, martensite_start=start, martensite_finish=start - 20.0, austenite_start=start + 10.0,
        austenite_finish=start + 25.0,
    )  # fmt: skip
    return HeatedRod(alloy, diameter=rod.diameter, length=rod.length)


def heat_rod(condition: Condition, rod: HeatedRod, factor: float, wrong: Random, number: int, series: Series) -> None:
    """Heat a rod through the process and add its errors to the series."""
    heater = Heater(rod, condition.sense_point, number)
    profile = profile_of(rod, factor, condition, wrong)
    _heat(heater, profile, condition.contact_change)
    errors = []
    while heater.heater.state is HeaterState.HOLDING:
        heater.cycle()
        if heater.heater._hold_s >= _HOLD_S - _WINDOW_S and heater.counter % 20 == 0:
            heater.pass_rest()
            steady = _ROOM_C + (rod.mean_temperature - _ROOM_C) / factor
            errors.append((rod.middle_temperature - TARGET_C, steady - TARGET_C))
    series.hottest_c = max(series.hottest_c, float(rod.highest_temperature.max()))
    if heater.heater.state is not HeaterState.COOLING:
        cause = heater.heater.interlocks.cause
        series.trips["target not reached" if cause is Row.NONE else cause.name.lower().replace("_", " ")] += 1
        return
    middle, steady = np.array(errors).T
    series.middle.append(float(np.abs(middle).mean()))
    series.steady.append(float(np.abs(steady).mean()))
    series.stated.append(float(steady.mean()) / heater.heater.uncertainty_k)


def _heat(heater: Heater, profile: HeatProfile, contact_change: float) -> None:
    """Arm, measure, heat; return when the heater holds, or when something has ended the heat."""
    heater.permit(Mode.AUTO)
    assert heater.context.state is State.HOLDING
    assert heater.send(ArmHeater()) is None
    heater.cycle(_OPEN_RELAY_CYCLES)
    assert heater.send(CONFIRMED) is None
    _run_while(heater, HeaterState.MEASURING)
    if heater.heater.state is not HeaterState.ARMED:
        return
    data = heater.circuit.data
    heater.circuit.data = replace(data, contact_resistance=data.contact_resistance + contact_change)
    assert heater.send(heat_command(profile)) is None
    assert heater.send(StartHeating()) is None
    _run_while(heater, HeaterState.HEATING)


def _run_while(heater: Heater, state: HeaterState) -> None:
    for _ in range(round(_LONGEST_S / PERIOD_S)):
        if heater.heater.state is not state:
            return
        heater.cycle()
    heater.heater.safe()


def profile_of(rod: HeatedRod, factor: float, condition: Condition, wrong: Random) -> HeatProfile:
    """Return the profile of a rod, by truth but for what is wrong."""
    alloy = rod.alloy
    alpha = alloy.resistivity_austenite * alloy.coefficient_austenite * (1.0 + wrong.gauss(0.0, condition.alpha))
    length = end_length(rod.length, factor) * (1.0 + wrong.gauss(0.0, condition.ends))
    return HeatProfile(
        Alloy(alloy.resistivity_austenite, alpha, condition.alpha),
        ColdEnds(rod.length, length, condition.ends),
        thermal_properties(rod),
        target_c=TARGET_C,
        hold_s=_HOLD_S,
        ramp_k_s=_RAMP_K_S,
        initial_c=_ROOM_C + wrong.gauss(0.0, condition.room_k),
        initial_uncertainty_k=condition.room_k,
        chuck_c=_ROOM_C,
        limits=Limits(current=300.0, power=5000.0),
    )


def thermal_properties(rod: HeatedRod) -> ThermalProperties:
    """Return heat capacity and losses of a rod, by truth; the convection is that of the target."""
    alloy, rise = rod.alloy, TARGET_C - _ROOM_C
    at_target = float(convection(np.array([TARGET_C]), _ROOM_C, rod.diameter)[0])
    at_500_k = at_target * (500.0 / rise) ** 0.2
    return ThermalProperties(rod.diameter, alloy.density * alloy.specific_heat, at_500_k, alloy.emissivity, 0.06)


def steady_factor(rod: HeatedRod) -> float:
    """Return the rise of the mean by that of the middle, with the ends in their steady state at the target."""
    alloy, lengths, count = rod.alloy, rod.cell_lengths, len(rod.positions)
    surfaces = math.pi * rod.diameter * lengths
    halves = lengths / (2.0 * rod.area * alloy.conductivity_austenite)
    between = 1.0 / np.concatenate((halves[:1], halves[1:] + halves[:-1], halves[-1:]))

    def balance(unknown: Floats) -> Floats:
        temperature, power = unknown[:-1], unknown[-1]
        flux = np.diff(temperature, prepend=_ROOM_C, append=_ROOM_C) * between
        loss = convection(temperature, _ROOM_C, rod.diameter) * (temperature - _ROOM_C)
        loss += radiation(temperature, _ROOM_C, alloy.emissivity)
        made = lengths * (1.0 + alloy.coefficient_austenite * (temperature - 20.0))
        middle = 0.5 * (temperature[count // 2 - 1] + temperature[count // 2]) - TARGET_C
        return np.append(np.diff(flux) - surfaces * loss + power * made, middle)

    near = np.minimum(rod.positions, rod.length - rod.positions)
    start = _ROOM_C + (TARGET_C - _ROOM_C) * -np.expm1(-near / 0.012)
    solution = root(balance, np.append(start, 100.0))
    assert solution.success, solution.message
    return (float(solution.x[:-1] @ lengths) / rod.length - _ROOM_C) / (TARGET_C - _ROOM_C)


def end_length(length: float, factor: float) -> float:
    """Return the end length, m, of a fin whose mean rises by `factor` of its middle."""
    return float(brentq(lambda end: ColdEnds(length, end, 0.0).mean_by_middle() - factor, 1e-4, 0.1))


def end_errors(numbers: Iterable[int], seed: int) -> tuple[list[float], list[float]]:
    """Return the errors of the middle, K, with steady ends and the exact mean, of two wrong end lengths.

    The first is wrong by 15 %, the second by its formula with 18 W/m K and 1.5 times flux by rise.
    """
    drawn: list[float] = []
    formula: list[float] = []
    for number in numbers:
        rod, wrong = draw_rod(seed, number), Random(f"{seed} {number} ends")
        rise, hot = TARGET_C - _ROOM_C, np.array([TARGET_C])
        flux = convection(hot, _ROOM_C, rod.diameter) * rise + radiation(hot, _ROOM_C, rod.alloy.emissivity)
        factor = steady_factor(rod)
        by_formula = cold_end_length(rod.diameter, 18.0, 1.5 * float(flux[0]) / rise)
        for errors, end in (
            (drawn, end_length(rod.length, factor) * (1.0 + wrong.gauss(0.0, 0.15))),
            (formula, by_formula),
        ):
            errors.append(abs(rise * (ColdEnds(rod.length, end, 0.0).mean_by_middle() / factor - 1.0)))
    return drawn, formula


def hold_ends(rod: HeatedRod) -> list[float]:
    """Return the errors of the middle, K, after the times of `_ENDS_AT_S` of a hold with the exact mean."""
    wanted = _ROOM_C + steady_factor(rod) * (TARGET_C - _ROOM_C)
    power = IdealPower(rod, lambda: rod.mean_temperature)
    while rod.mean_temperature < wanted - 3.0:
        power.step(min(power.setpoint_c + _RAMP_K_S * _COARSE_S, wanted))
    errors, elapsed = [], 0.0
    for until in _ENDS_AT_S:
        while elapsed < until:
            power.step(wanted)
            elapsed += _COARSE_S
        errors.append(abs(rod.middle_temperature - TARGET_C))
    return errors


class IdealPower:
    """Holds a temperature of a rod without circuit and process: a PI on its power."""

    _GAIN, _INTEGRAL = 10.0, 10.0
    """1/s and 1/s^2, of the heat capacity."""

    def __init__(self, rod: HeatedRod, measured: Callable[[], float]) -> None:
        self._rod, self._measured = rod, measured
        self._capacity = rod.mass * rod.alloy.specific_heat
        self._integral = 0.0
        self.setpoint_c = measured()

    def step(self, setpoint_c: float) -> None:
        """Let a coarse step pass with the setpoint, C."""
        error = setpoint_c - self._measured()
        slope = (setpoint_c - self.setpoint_c) / _COARSE_S
        self.setpoint_c = setpoint_c
        self._integral += self._INTEGRAL * error * _COARSE_S
        power = max(self._capacity * (slope + self._GAIN * error + self._integral), 0.0)
        self._rod.step(_COARSE_S, math.sqrt(power / self._rod.resistance))


def print_rods(rods: int, seed: int, minutes: float) -> None:
    """Print the tables of the rods; none is begun after the time."""
    until = time.monotonic() + 60.0 * minutes
    done: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(rods):
            if time.monotonic() > until:
                return
            yield number
            done.append(number)
            print(f"{len(done)} of {rods} rods", end="\r", file=sys.stderr, flush=True)

    every = run_rods(CONDITIONS, numbers(), seed)
    print(f"{len(done)} rods; errors of the middle, K\n")
    print(
        "| wrong | held | ended by | mean | median | 90 % | mean, ends steady | median | 90 % | hottest, C | rms by u |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name, series in every.items():
        ended = ", ".join(f"{row}: {count}" for row, count in series.trips.most_common()) or "none"
        stated = f"{math.sqrt(float(np.mean(np.square(series.stated)))):.2f}" if series.stated else ""
        columns = " | ".join((*_spread(series.middle), *_spread(series.steady), f"{series.hottest_c:.0f}", stated))
        print(f"| {name} | {len(series.middle)} | {ended} | {columns} |")
    for name, errors in zip(("end length, 15 %", "end length by its formula"), end_errors(done, seed), strict=True):
        print(f"| {name} | | not run | | | | {' | '.join(_spread(errors))} | | |")
    print(f"| Gilbert and Webster, real wires | | | {GILBERT_WEBSTER_K:g} | | | | | | | |\n", flush=True)
    few = done[::_EVERY]
    errors_at = np.array([hold_ends(draw_rod(seed, number)) for number in few])
    print(f"| time at the exact mean ({len(few)} rods) | mean | median | 90 % |\n|---|---|---|---|")
    for at, column in zip(_ENDS_AT_S, errors_at.T, strict=True):
        print(f"| {at:g} s | {' | '.join(_spread(column.tolist()))} |", flush=True)
    print()


def _spread(errors: Sequence[float]) -> tuple[str, str, str]:
    """Return mean, median and 90 % of absolute errors."""
    if not errors:
        return "", "", ""
    numbers = (np.mean(errors), np.median(errors), np.quantile(errors, 0.9))
    return f"{numbers[0]:.1f}", f"{numbers[1]:.1f}", f"{numbers[2]:.1f}"


# -- shapes ------------------------------------------------------------------------------------------------------------

_DIAMETERS = (0.5e-3, 1e-3, 2e-3)
_ROD_LENGTH = 0.3
_COOL_C = 250.0
"""Below it no rate law sets anything in the time that a rod takes to cool."""


@dataclass(frozen=True)
class SetShape:
    """A shape that was set: form, rod, largest strain; errors and straight ends in m.

    kinetics_rms: the same with the rate law of `rtcp.processes.rod`, which has no least temperature.
    """

    form: Form
    diameter: float
    strain: float
    rms: float
    largest: float
    straight_start: float
    straight_end: float
    middle_fraction: float
    kinetics_rms: float


def run_shape(number: int, seed: int, profile: HeatProfile) -> SetShape:
    """Hold a random shape, heat it, release it."""
    form, diameter = tuple(Form)[number % 3], _DIAMETERS[number // 3 % 3]
    held = sample_equilibrium(Rod(_ROD_LENGTH, diameter), form, np.random.default_rng((seed, number)))
    rod = HeatedRod(draw_rod(seed, 0).alloy, diameter=diameter, length=_ROD_LENGTH)
    rod.bend(np.stack([np.interp(rod.positions, held.s, column) for column in held.u.T], axis=1))
    times, temperatures = heat_by(profile, rod)
    fraction = np.interp(held.s, rod.positions, rod.set_fraction)
    released = release(held, fraction)
    grid = np.array([np.interp(held.s, rod.positions, row) for row in temperatures]).T
    other = release(held, set_fraction(times, grid, Kinetics()))
    return SetShape(
        form, diameter, held.largest_strain, _rms(released.error), float(released.error.max()),
        released.straight_start, released.straight_end, float(fraction[len(fraction) // 2]), _rms(other.error),
    )  # fmt: skip


def heat_by(profile: HeatProfile, rod: HeatedRod) -> tuple[Floats, list[Floats]]:
    """Heat a rod by a profile with an ideal control of its middle; return times, s, and the cells' temperatures, C."""
    power = IdealPower(rod, lambda: rod.middle_temperature)
    times, temperatures, elapsed, held_s = [0.0], [rod.temperature.copy()], 0.0, 0.0
    while held_s < profile.hold_s or rod.middle_temperature > profile.cool_c:
        if held_s >= profile.hold_s:
            rod.step(_COARSE_S, 0.0)
        else:
            power.step(min(power.setpoint_c + profile.ramp_k_s * _COARSE_S, profile.target_c))
            held_s += _COARSE_S * (power.setpoint_c >= profile.target_c)
        elapsed += _COARSE_S
        if elapsed - times[-1] >= _SAMPLE_S:
            times.append(elapsed)
            temperatures.append(rod.temperature.copy())
    return np.array(times), temperatures


def _rms(errors: Floats) -> float:
    return math.sqrt(float(np.mean(errors**2)))


def print_shapes(shapes: int, seed: int) -> None:
    """Print the table of the shapes."""
    profile = replace(read_profile(ROOT / "config" / "shape_setting" / "nitinol.yaml"), cool_c=_COOL_C)
    print(
        "| form | rod, mm | largest strain | error rms, mm | largest, mm | straight ends, mm | set in the middle | rms "
        "by the planner's rate law, mm |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for number in range(shapes):
        shape = run_shape(number, seed, profile)
        print(
            f"| {shape.form.value} | {1e3 * shape.diameter:g} | {100 * shape.strain:.2f} % | {1e3 * shape.rms:.2f} | "
            f"{1e3 * shape.largest:.2f} | {1e3 * shape.straight_start:.0f} and {1e3 * shape.straight_end:.0f} | "
            f"{100 * shape.middle_fraction:.1f} % | {1e3 * shape.kinetics_rms:.2f} |",
            flush=True,
        )


def main() -> int:
    """Run both and print their tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rods", type=int, default=100)
    parser.add_argument("--shapes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0, help="no rod is begun after this time")
    given = parser.parse_args()
    if given.rods:
        print_rods(given.rods, given.seed, given.minutes)
    if given.shapes:
        print_shapes(given.shapes, given.seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
