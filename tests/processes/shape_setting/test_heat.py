"""Two thermometers, resistance and heat balance, against the true temperature of the virtual rod.

The rod, its circuit and their faults are those of `rtcp.virtual`, which share no code with the process.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import pytest

from benchmarks.shape_setting import ROOT, Heater
from rtcp.ipc.events import Event
from rtcp.processes.shape_setting import messages
from rtcp.processes.shape_setting.heat_balance import HeatBalance
from rtcp.processes.shape_setting.heat_profile import HeatProfile, Limits, heat_command
from rtcp.processes.shape_setting.interlocks import Mode, Row
from rtcp.processes.shape_setting.messages import HeaterState
from rtcp.processes.shape_setting.profile import read_profile
from rtcp.virtual.heated_rod import Alloy, HeatedRod
from rtcp.virtual.heater_circuit import CircuitFault, SensePoint
from tests.processes.shape_setting.rig import CONFIRMED, PERIOD_S

SHIPPED = read_profile(ROOT / "config" / "shape_setting" / "nitinol.yaml")
FAST = replace(SHIPPED, ramp_k_s=100.0, limits=Limits(current=20.0, power=150.0), cool_c=400.0)
"""The shipped rod, sooner at its target."""
OVER_TARGET_K = 40.0
_RAMP_S = (SHIPPED.target_c - SHIPPED.initial_c) / SHIPPED.ramp_k_s

Gain = Callable[[float], float]
"""Reading by its true value, over the time since a state was reached, s."""


def steady(_: float) -> float:
    return 1.0


def changes(by: float, passing_s: float) -> Gain:
    """A reading that becomes wrong by a share, evenly over a time."""
    return lambda time_s: 1.0 + by * min(time_s / passing_s, 1.0)


@dataclass
class Heating:
    """A heating of a virtual rod by a profile."""

    profile: HeatProfile = SHIPPED
    alloy: Alloy = field(default_factory=Alloy)
    diameter: float = SHIPPED.thermal.diameter
    ambient: float = SHIPPED.chuck_c
    voltage: Gain = steady
    current: Gain = steady
    since: HeaterState = HeaterState.HEATING
    """State from which on the readings change."""

    def __post_init__(self) -> None:
        self.rod = HeatedRod(self.alloy, diameter=self.diameter, length=self.profile.ends.length, ambient=self.ambient)
        self.heater = Heater(self.rod, SensePoint.ROD, seed=1)
        self._data = self.heater.circuit.data

    def _read_by_gains(self, time_s: float) -> None:
        gains = {"voltage_gain": self.voltage(time_s), "current_gain": self.current(time_s)}
        self.heater.circuit.data = replace(self._data, **gains)

    def run(self) -> None:
        """Arm, measure and heat, until the heater is idle."""
        heater = self.heater
        self._read_by_gains(0.0)
        heater.permit(Mode.AUTO)
        assert heater.send(messages.ArmHeater()) is None
        heater.cycle(60)
        assert heater.send(CONFIRMED) is None
        heater.until(HeaterState.ARMED)
        assert heater.send(heat_command(self.profile)) is None
        assert heater.send(messages.StartHeating()) is None
        cycles = 0
        while heater.heater.state in (HeaterState.HEATING, HeaterState.HOLDING, HeaterState.COOLING):
            heater.cycle()
            if heater.heater.state >= self.since:
                cycles += 1
                self._read_by_gains(cycles * PERIOD_S)
        # What remains of the heat still comes.
        heater.cycle(200)
        heater.pass_rest()

    @property
    def hottest_c(self) -> float:
        """Highest true temperature of any place of the rod, C."""
        return float(self.rod.highest_temperature.max())

    def reported(self, kind: type[Event]) -> list[Event]:
        return [event for event in self.heater.context.events if isinstance(event, kind)]


def with_alpha(factor: float) -> HeatProfile:
    return replace(SHIPPED, alloy=replace(SHIPPED.alloy, alpha=SHIPPED.alloy.alpha * factor))


STORES_MUCH: dict[str, object] = {"diameter": 1.01e-3, "alloy": Alloy(specific_heat=510.0, emissivity=0.53)}
STORES_LITTLE: dict[str, object] = {"diameter": 0.99e-3, "alloy": Alloy(specific_heat=490.0, emissivity=0.47)}


# -- one thermometer is wrong ------------------------------------------------------------------------------------------

IN_HOLD: dict[str, object] = {"profile": FAST, "since": HeaterState.HOLDING}
IMPLAUSIBLE: dict[str, dict[str, object]] = {
    "coefficient of the profile 1.4 times too large": {"profile": with_alpha(1.4)},
    "coefficient of the profile 2.2 times too large": {"profile": with_alpha(2.2)},
    "coefficient of the profile 1.4 times too small": {"profile": with_alpha(1 / 1.4)},
    "coefficient of the profile 2.2 times too small": {"profile": with_alpha(1 / 2.2)},
    "voltage 3 % low from the heating on": {"voltage": changes(-0.03, 1e-3)},
    "voltage 3 % low over the ramp": {"voltage": changes(-0.03, _RAMP_S)},
    "voltage 6 % low over the ramp": {"voltage": changes(-0.06, _RAMP_S)},
    "current 3 % high over the ramp": {"current": changes(0.03, _RAMP_S)},
    "voltage 6 % low at once in the hold": {"voltage": changes(-0.06, 1e-3)} | IN_HOLD,
}
EXCESS: dict[str, dict[str, object]] = {
    "coefficient of the profile 1.1 times too large": {"profile": with_alpha(1.1)},
    "voltage 3 % low over 5 s of the hold": {"voltage": changes(-0.03, 5.0)} | IN_HOLD,
    "voltage 6 % low over 5 s of the hold": {"voltage": changes(-0.06, 5.0)} | IN_HOLD,
    "current 3 % high over 5 s of the hold": {"current": changes(0.03, 5.0)} | IN_HOLD,
    "voltage 6 % low over 5 s of the hold of a rod that stores and loses little": {"voltage": changes(-0.06, 5.0)}
    | IN_HOLD
    | STORES_LITTLE,
}


def trip(wrong: dict[str, object], row: Row) -> float:
    """Heat with a wrong thermometer, which a row has to notice; return the highest true temperature, C."""
    heating = Heating(**wrong)  # type: ignore[arg-type]
    heating.run()
    (tripped,) = heating.reported(messages.HeaterTripped)
    assert isinstance(tripped, messages.HeaterTripped)
    assert tripped.row is row
    assert not heating.heater.relay
    return heating.hottest_c


@pytest.mark.parametrize("wrong", IMPLAUSIBLE.values(), ids=IMPLAUSIBLE)
def test_a_temperature_that_the_power_does_not_allow_trips_before_the_rod_is_at_its_target(
    wrong: dict[str, object],
) -> None:
    assert trip(wrong, Row.IMPLAUSIBLE_TEMPERATURE) < SHIPPED.target_c


@pytest.mark.parametrize("wrong", EXCESS.values(), ids=EXCESS)
def test_a_thermometer_that_shows_some_kelvin_too_little_trips_before_the_rod_exceeds_its_target_by_40_k(
    wrong: dict[str, object],
) -> None:
    assert trip(wrong, Row.EXCESS_HEAT) < SHIPPED.target_c + OVER_TARGET_K


@pytest.mark.parametrize(
    "gains", [{"voltage": lambda _: 0.97}, {"voltage": lambda _: 0.94}, {"current": lambda _: 1.03}],
    ids=["voltage 3 % low", "voltage 6 % low", "current 3 % high"],
)  # fmt: skip
def test_a_reading_that_was_wrong_before_the_measurement_does_not_make_the_rod_too_hot(gains: dict[str, Gain]) -> None:
    heating = Heating(replace(FAST, hold_s=5.0), **gains)  # type: ignore[arg-type]
    heating.run()
    assert heating.hottest_c < SHIPPED.target_c + OVER_TARGET_K


# -- both are right within their tolerance -----------------------------------------------------------------------------


def in_room(celsius: float) -> HeatProfile:
    return replace(SHIPPED, initial_c=celsius, chuck_c=celsius)


RIGHT: dict[str, dict[str, object]] = {
    "the shipped rod": {},
    "a rod that stores and loses much, in a room of 10 C": {"profile": in_room(10.0), "ambient": 10.0} | STORES_MUCH,
    "a rod that stores and loses little, in a room of 35 C": {"profile": in_room(35.0), "ambient": 35.0}
    | STORES_LITTLE,
    "a room of 10 C that the profile does not state": {"ambient": 10.0},
    "a room of 35 C that the profile does not state": {"ambient": 35.0},
}


def hold(right: dict[str, object]) -> None:
    heating = Heating(**right)  # type: ignore[arg-type]
    heating.run()
    assert not heating.reported(messages.HeaterTripped)
    assert heating.heater.heater.state is HeaterState.DONE
    assert len(heating.reported(messages.ShapeSet)) == 1
    assert not heating.reported(messages.RodHotAgain)
    assert heating.rod.middle_temperature == pytest.approx(heating.profile.cool_c, abs=35.0)
    # Rooms that the profile does not state are worth 13 K, ends that are not cold yet 15 K.
    assert heating.hottest_c == pytest.approx(SHIPPED.target_c, abs=30.0)


@pytest.mark.parametrize("right", RIGHT.values(), ids=RIGHT)
def test_correct_readings_never_trip_while_the_rod_is_heated_and_cools(right: dict[str, object]) -> None:
    profile = right.get("profile", SHIPPED)
    assert isinstance(profile, HeatProfile)
    short = replace(profile, ramp_k_s=FAST.ramp_k_s, limits=FAST.limits, hold_s=2.0, cool_c=350.0)
    hold(right | {"profile": short})


@pytest.mark.long("test_correct_readings_never_trip_while_the_rod_is_heated_and_cools")
@pytest.mark.parametrize("right", RIGHT.values(), ids=RIGHT)
def test_correct_readings_never_trip_in_the_whole_shipped_profile(right: dict[str, object]) -> None:
    hold(right)


# -- after the cooling -------------------------------------------------------------------------------------------------


def test_a_rod_that_becomes_hot_again_after_its_cooling_is_reported_once() -> None:
    heating = Heating(replace(SHIPPED, target_c=150.0, ramp_k_s=50.0, hold_s=0.5, cool_c=100.0))
    heating.run()
    heater = heating.heater
    assert heater.heater.state is HeaterState.DONE
    heater.cycle(2000)
    assert not heating.reported(messages.RodHotAgain)
    heater.circuit.inject(CircuitFault.GATE_STUCK_ON)
    heater.circuit.inject(CircuitFault.RELAY_WELDED)
    heater.cycle(400)
    (hot,) = heating.reported(messages.RodHotAgain)
    assert isinstance(hot, messages.RodHotAgain)
    assert hot.cool_c == 100.0
    assert 130.0 < hot.middle_c < 140.0
    heating.heater.pass_rest()
    assert heating.rod.middle_temperature > 130.0
    assert not heater.relay
    assert not heater.gate


# -- the balance -------------------------------------------------------------------------------------------------------


def balance(tolerance: float) -> HeatBalance:
    made = HeatBalance()
    made.set_rod(20.0, 20.0, 500.0, 0.75, 20.0, 8.0, tolerance)
    return made


def test_the_power_that_holds_the_target_leads_to_it() -> None:
    at_target = balance(0.0)
    for _ in range(100_000):
        at_target.update(28.0, 1e-3)
    assert (at_target.least_c, at_target.most_c) == pytest.approx((500.0, 500.0), abs=0.1)


def test_at_first_the_rise_is_the_energy_by_the_heat_capacity_within_the_tolerance() -> None:
    cold = balance(0.1)
    cold.update(75.0, 0.1)
    assert (cold.least_c, cold.most_c) == pytest.approx((29.0, 31.0))
    cold.begin()
    assert (cold.least_c, cold.most_c) == (20.0, 20.0)


@pytest.mark.parametrize("power", [float("nan"), float("inf")])
def test_a_power_that_is_no_number_does_not_remain_in_the_balance(power: float) -> None:
    kept = balance(0.1)
    kept.update(power, 0.1)
    assert (kept.least_c, kept.most_c) == (20.0, 20.0)


def test_a_rod_that_was_preheated_cools_to_the_air_and_not_below() -> None:
    preheated = HeatBalance()
    preheated.set_rod(60.0, 20.0, 500.0, 0.75, 20.0, 8.0, 0.05)
    for _ in range(1000):
        preheated.update(0.0, 1.0)
    assert preheated.most_c == pytest.approx(20.0, abs=1.0)
    assert preheated.least_c >= 20.0


def test_without_a_profile_there_is_no_balance() -> None:
    nothing = HeatBalance()
    nothing.update(100.0, 1.0)
    assert not nothing.is_known
    assert nothing.most_k == 0.0


@pytest.mark.parametrize(
    ("diameter", "rise_k", "longest_s"),
    [
        (0.5e-3, 60.0, 60.0), (1e-3, 60.0, 120.0), (3.2e-3, 60.0, 620.0),
        (0.5e-3, 1290.0, 65.0), (1e-3, 1290.0, 190.0), (2e-3, 1290.0, 520.0),
    ],
)  # fmt: skip
def test_a_rod_is_cold_by_the_time_that_the_balance_states_which_its_diameter_decides(
    diameter: float, rise_k: float, longest_s: float
) -> None:
    profile = HeatProfile(target_c=510.0).of_rod(0.3, diameter)
    command = heat_command(profile)
    known = HeatBalance()
    known.set_rod(
        command.initial_c, command.chuck_c, command.target_c, command.heat_capacity, command.convected,
        command.radiated, command.tolerance,
    )  # fmt: skip
    known.most_k = rise_k
    time_s = known.time_to_cold()
    assert 0.2 * longest_s < time_s < longest_s
    if rise_k > 1000.0:  # the melting point
        assert time_s == known.longest_cooling_s
    rod = HeatedRod(Alloy(), diameter=diameter, length=0.3, ambient=20.0)
    rod._enthalpy += rod.alloy.specific_heat * rise_k
    rod._transform()
    for _ in range(round(10 * time_s)):
        rod.step(0.1, 0.0)
    assert 20.0 < rod.middle_temperature < 23.0
    known.most_k = min(rise_k, 500.0)  # a step of 0.1 s of a hotter thin rod would not be stable
    # A step of the balance itself, with all of the radiation, is a little faster.
    for _ in range(round(10 * time_s)):
        known.update(0.0, 0.1)
    assert 0.2 < known.most_k < 3.5


def test_losses_at_the_target_are_those_of_the_virtual_rod() -> None:
    command = heat_command(SHIPPED)
    rod = HeatedRod(Alloy(), diameter=SHIPPED.thermal.diameter, length=SHIPPED.ends.length, ambient=SHIPPED.chuck_c)
    rod._enthalpy[:] = rod.alloy.specific_heat * SHIPPED.target_c
    rod._transform()
    rod._update()
    assert command.convected + command.radiated == pytest.approx(rod._air_power, rel=0.02)
    assert command.heat_capacity == pytest.approx(rod.mass * rod.alloy.specific_heat, rel=0.01)


# -- the ratio alone ---------------------------------------------------------------------------------------------------


class RatioHeating(Heating):
    """A heating by the ratio alone, which is the same number for rods of all diameters; one command does all steps."""

    def run(self) -> None:
        heater = self.heater
        heater.permit(Mode.AUTO)
        wanted = messages.SetTargetRatio(1.09, hold_s=2.0, length=self.profile.ends.length)
        assert heater.send(wanted) is None
        assert heater.send(messages.HeatRod(True, messages.RodPhase.AUSTENITE)) is None
        heater.until(HeaterState.HEATING)
        self.resistance = heater.heater.initial.value
        heater.until(HeaterState.HOLDING, cycles=60_000)
        heater.until(HeaterState.COOLING)
        self.ratio = self.rod.resistance / self.resistance


@pytest.mark.parametrize(("diameter", "length"), [(0.5e-3, 0.2), (1e-3, 0.3), (2e-3, 0.25), (3.2e-3, 0.3)])
def test_rods_of_other_dimensions_need_no_input_but_the_ratio(diameter: float, length: float) -> None:
    ends = replace(SHIPPED.ends, length=length)
    heating = RatioHeating(replace(SHIPPED, ends=ends), diameter=diameter, ambient=20.0)
    heating.run()
    (sized,) = heating.reported(messages.RodSized)
    assert isinstance(sized, messages.RodSized)
    assert sized.diameter_mm == pytest.approx(1e3 * diameter, rel=0.01)
    assert heating.ratio == pytest.approx(1.09, abs=0.003)
    assert not heating.reported(messages.HeaterTripped)
    assert heating.hottest_c < sized.target_c + OVER_TARGET_K


@pytest.mark.parametrize("length", [0.15, 0.3])
def test_a_length_that_is_not_the_rods_trips_before_the_rod_is_too_hot(length: float) -> None:
    heating = RatioHeating(replace(SHIPPED, ends=replace(SHIPPED.ends, length=0.22)), ambient=20.0)
    heating.heater.permit(Mode.AUTO)
    assert heating.heater.send(messages.SetTargetRatio(1.09, length=length)) is None
    assert heating.heater.send(messages.HeatRod(True, messages.RodPhase.AUSTENITE)) is None
    heating.heater.until(HeaterState.TRIPPED, cycles=60_000)
    assert heating.hottest_c < SHIPPED.target_c
