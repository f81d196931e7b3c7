"""The heater: heat is off in the cycle of a cause, and only a command turns it on."""

from __future__ import annotations

import math
import pickle
import random
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import product

import pytest

from rtcp.ipc.commands import Command
from rtcp.ipc.refusals import Refusal
from rtcp.ipc.states import State
from rtcp.processes import ProcessSetup, Signal
from rtcp.processes.shape_setting import messages
from rtcp.processes.shape_setting.interlocks import Mode, Row
from rtcp.processes.shape_setting.process import ShapeSetting
from tests.processes.shape_setting.rig import CONFIG, CONFIRMED, PERIOD_S, PROFILE, Rig

MODES = (Mode.MANUAL, Mode.AUTO)


def events(rig: Rig, kind: type) -> list[object]:
    return [event for event in rig.context.events if isinstance(event, kind)]


# -- a heating ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_a_profile_heats_holds_cools_and_opens_the_relay(mode: Mode) -> None:
    rig = Rig()
    rig.heat(mode)
    hottest = 0.0
    while rig.heater.state is not messages.HeaterState.DONE and rig.context.cycle < 20_000:
        rig.cycle()
        hottest = max(hottest, rig.celsius)
    assert hottest == pytest.approx(500.0, abs=20.0)
    assert isinstance(rig.context.events[-1], messages.ShapeSet)
    assert not rig.relay
    assert not rig.gate
    assert rig.celsius == pytest.approx(400.0, abs=30.0)


def test_a_hold_and_its_energy_count_the_time_of_skipped_ticks() -> None:
    rig = Rig()
    rig.heat(state=messages.HeaterState.HOLDING, hold_s=1.0)
    cycles, energy = 0, rig.heater.energy
    while rig.heater.state is messages.HeaterState.HOLDING:
        rig.context.now_ns += 500_000
        rig.cycle()
        energy += rig.get("voltage") * rig.get("current") * 2 * PERIOD_S
        cycles += 1
    assert cycles == pytest.approx(1000, abs=20)
    assert rig.heater.energy == pytest.approx(energy, rel=1e-6)


@pytest.mark.parametrize(("ohm", "joule_by_kelvin"), [(1.36, 0.19), (0.34, 0.75), (0.033, 7.8)])
def test_one_setting_holds_rods_of_all_diameters(ohm: float, joule_by_kelvin: float) -> None:
    rig = Rig(resistance=ohm, heat_capacity=joule_by_kelvin)
    rig.heat(state=messages.HeaterState.HOLDING, hold_s=2.0, ramp_k_s=100.0, max_current=300.0)
    rig.cycle(2000)
    for _ in range(10):
        rig.cycle(100)
        assert rig.celsius == pytest.approx(500.0, abs=8.0)


def test_the_initial_resistance_is_a_mean_of_pulses_with_its_uncertainty() -> None:
    rig = Rig()
    rig.arm()
    assert rig.send(CONFIRMED) is None
    rig.until(messages.HeaterState.ARMED)
    (measured,) = events(rig, messages.ResistanceMeasured)
    assert isinstance(measured, messages.ResistanceMeasured)
    assert measured.pulses == CONFIG.pulses
    assert measured.resistance == pytest.approx(0.34, rel=1e-3)
    assert 0.0 < measured.uncertainty < 1e-3 * measured.resistance
    assert not rig.gate
    assert rig.relay


def test_a_record_has_a_number_for_every_field() -> None:
    rig = Rig()
    rig.heat()
    values: list[float] = [0.0] * (3 + len(rig.heater.fields()))
    rig.heater.publish(values, 3)
    record = dict(zip((field.name for field in rig.heater.fields()), values[3:], strict=True))
    assert (record["state"], record["busy"], record["relay"], record["cause"]) == (4, 1, 1, 31)
    assert record["initial_resistance"] == pytest.approx(0.34, rel=1e-2)
    assert record["middle_temperature"] == pytest.approx(rig.celsius, abs=15.0)


def record(rig: Rig) -> dict[str, float]:
    values: list[float] = [0.0] * len(rig.heater.fields())
    rig.heater.publish(values, 0)
    return dict(zip((field.name for field in rig.heater.fields()), values, strict=True))


def test_a_record_has_what_is_measured_beside_what_is_commanded() -> None:
    rig = Rig()
    rig.heat()
    rig.forced.update(relay_closed=1.0, gate_sense=1.0, current=30.0)
    rig.send(messages.StopHeating())
    rig.cycle()
    values = record(rig)
    assert (values["gate"], values["relay"]) == (0, 0)
    assert (values["relay_closed"], values["gate_sense"], values["current"], values["inputs_alive"]) == (1, 1, 30.0, 1)
    rig.context.good = False
    rig.cycle()
    assert not record(rig)["inputs_alive"]


@pytest.mark.parametrize("cool_c", [300.0, 24.0])
def test_a_rod_is_not_measured_before_its_time_to_cool_since_the_heat_is_over(cool_c: float) -> None:
    # Of this rod the heat balance knows that it needs longer.
    rig = Rig(replace(CONFIG, rod_cooling_s=5.0))
    rig.loss = 1.0
    rig.heat(state=messages.HeaterState.COOLING, target_c=350.0, cool_c=cool_c)
    began = rig.context.cycle
    rig.until(messages.HeaterState.DONE)
    cooled_s = (rig.context.cycle - began) * PERIOD_S
    assert record(rig)["rod_hot_s"] == pytest.approx(5.0 - cooled_s, abs=0.01)
    rig.cycle(20)
    rig.arm()
    assert isinstance(rig.send(CONFIRMED), messages.RodStillHot)
    rig.cycle(round((5.0 - cooled_s) / PERIOD_S))
    assert rig.send(CONFIRMED) is None


def test_after_a_complete_heating_the_time_to_cool_is_that_of_the_rod() -> None:
    assert CONFIG.rod_cooling_s == 600.0
    rig = Rig()
    rig.heat(state=messages.HeaterState.DONE, target_c=350.0, cool_c=340.0, tolerance=0.0)
    hot_s = record(rig)["rod_hot_s"]
    assert 60.0 < hot_s < 200.0
    rig.celsius = 20.0
    rig.heater._since_heat_s += hot_s - 0.2
    rig.cycle(20)
    rig.arm()
    assert isinstance(rig.send(CONFIRMED), messages.RodStillHot)
    rig.cycle(400)
    assert record(rig)["rod_hot_s"] == 0.0
    assert rig.send(CONFIRMED) is None


def test_who_confirms_that_a_rod_is_cold_does_not_wait() -> None:
    rig = Rig()
    rig.heater._since_heat_s = 0.0
    rig.arm()
    assert isinstance(rig.send(CONFIRMED), messages.RodStillHot)
    assert rig.send(replace(CONFIRMED, is_cold=True)) is None
    rig.until(messages.HeaterState.ARMED)
    # The same rod is measured again without a wait.
    assert record(rig)["rod_hot_s"] == 0.0
    assert rig.send(CONFIRMED) is None


def test_after_a_start_a_rod_is_not_measured_before_its_time_to_cool() -> None:
    rig = Rig(replace(CONFIG, rod_cooling_s=1.0))
    rig.heater._since_heat_s = 0.0
    rig.arm()
    assert isinstance(rig.send(CONFIRMED), messages.RodStillHot)
    rig.cycle(2000)
    assert rig.send(CONFIRMED) is None


def test_after_a_start_or_an_early_end_the_longest_time_to_cool_is_that_of_the_rod() -> None:
    rig = Rig()
    rig.heater._since_heat_s = 0.0
    assert record(rig)["rod_hot_s"] == 600.0  # nothing is known of the rod
    assert rig.send(PROFILE) is None
    hot_s = record(rig)["rod_hot_s"]
    assert hot_s == rig.heater.balance.longest_cooling_s
    assert 100.0 < hot_s < 400.0
    rig.arm()
    assert isinstance(rig.send(CONFIRMED), messages.RodStillHot)
    rig.heater._since_heat_s = hot_s
    assert rig.send(CONFIRMED) is None
    rig = Rig()
    rig.heat()
    rig.send(messages.StopHeating())
    rig.cycle(40)
    assert record(rig)["rod_hot_s"] == pytest.approx(rig.heater.balance.longest_cooling_s, abs=0.1)
    # The profile of a thinner rod says nothing of the one that was heated.
    assert rig.send(replace(PROFILE, heat_capacity=0.1)) is None
    assert record(rig)["rod_hot_s"] > 100.0


def test_a_current_that_nobody_commands_keeps_the_rod_hot() -> None:
    rig = Rig(replace(CONFIG, rod_cooling_s=1.0))
    rig.permit(Mode.AUTO)
    rig.forced["current"] = 30.0
    rig.cycle(4000)
    assert record(rig)["rod_hot_s"] == pytest.approx(1.0, abs=0.01)
    rig.forced["current"] = 0.0
    rig.cycle(4000)
    assert record(rig)["rod_hot_s"] == 0.0


def test_a_contact_that_shows_a_rod_colder_than_the_room_does_not_end_the_cooling() -> None:
    rig = Rig()
    rig.heat(state=messages.HeaterState.COOLING)
    rig.initial *= 0.86
    rig.cycle(400)
    assert rig.heater.state is not messages.HeaterState.DONE


def test_a_hold_that_does_not_fit_beside_its_ramp_is_refused() -> None:
    rig = Rig(replace(CONFIG, longest_s=10.0))
    assert rig.send(replace(PROFILE, hold_s=7.0)) is None
    refusal = rig.send(replace(PROFILE, hold_s=7.7))
    assert isinstance(refusal, messages.ProfileNumberOutOfRange)
    assert (refusal.value, refusal.greatest) == pytest.approx((7.7, 7.6))


def test_the_limits_of_current_and_power_hold_the_target() -> None:
    rig = Rig()
    rig.heat(max_current=5.0)
    rig.cycle(400)
    assert rig.heater.control.target == 5.0
    rig = Rig()
    rig.heat(max_power=30.0)
    rig.cycle(400)
    assert rig.heater.control.target * rig.heater.meter.voltage == pytest.approx(30.0)


def test_a_rod_that_does_not_get_hot_ends_the_heating_after_its_longest_time() -> None:
    rig = Rig(replace(CONFIG, longest_s=3.0))
    rig.heat(max_power=10.0)
    rig.until(messages.HeaterState.READY)
    assert events(rig, messages.TargetNotReached)
    assert not rig.gate
    assert not rig.relay


def test_an_armed_heater_that_nobody_uses_opens_its_relay() -> None:
    assert CONFIG.armed_s == 30.0
    rig = Rig(replace(CONFIG, armed_s=0.5))
    rig.arm()
    rig.cycle(950)
    assert rig.relay
    rig.cycle(60)
    assert not rig.relay
    assert events(rig, messages.ArmedTooLong)


def test_lamps_show_powered_and_armed() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    assert (rig.get("lamp_green"), rig.get("lamp_yellow")) == (1.0, 0.0)
    rig.arm()
    assert (rig.get("lamp_green"), rig.get("lamp_yellow")) == (1.0, 1.0)
    rig.context.state = State.FAULT
    rig.cycle()
    assert (rig.get("lamp_green"), rig.get("lamp_yellow")) == (1.0, 0.0)


def test_arming_lasts_until_the_mirror_contact_shows_a_closed_relay() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    assert rig.send(messages.ArmHeater()) is None
    while record(rig)["busy"]:
        assert not rig.heater.inputs.relay_closed
        rig.cycle()
    assert rig.heater.inputs.relay_closed
    assert rig.send(CONFIRMED) is None


def test_arming_ends_where_the_relay_does_not_close() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    rig.forced["relay_closed"] = 0.0
    assert rig.send(messages.ArmHeater()) is None
    assert record(rig)["busy"]
    rig.until(messages.HeaterState.TRIPPED)
    assert not record(rig)["busy"]


WHOLE = messages.HeatRod(True, messages.RodPhase.AUSTENITE)


def test_one_command_arms_measures_and_heats_and_is_busy_throughout() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    assert rig.send(replace(PROFILE, heat_capacity=rig.capacity, convected=rig.loss * 480.0)) is None
    assert rig.send(WHOLE) is None
    states: list[messages.HeaterState] = []
    while record(rig)["busy"]:
        if not states or states[-1] is not rig.heater.state:
            states.append(rig.heater.state)
        rig.cycle()
    names = [state.name for state in states]
    assert names == ["ARMED", "MEASURING", "HEATING", "HOLDING", "COOLING"]
    assert rig.heater.state is messages.HeaterState.DONE


@pytest.mark.parametrize("state", [messages.HeaterState.ARMED, messages.HeaterState.MEASURING])
def test_the_end_of_the_commanders_lease_ends_one_command_in_each_of_its_steps(state: messages.HeaterState) -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    assert rig.send(PROFILE) is None
    assert rig.send(WHOLE) is None
    rig.until(state)
    rig.context.commander = False
    rig.cycle()
    assert not rig.relay
    rig.context.commander = True
    rig.cycle(100)
    assert not rig.relay
    assert not rig.gate


def test_a_resistance_that_no_rod_has_ends_one_command_with_the_relay_open() -> None:
    rig = Rig(resistance=4.5)
    rig.permit(Mode.AUTO)
    assert rig.send(messages.SetTargetRatio(1.09)) is None
    assert rig.send(WHOLE) is None
    rig.until(messages.HeaterState.READY)
    (rejected,) = events(rig, messages.RodRejected)
    assert isinstance(rejected, messages.RodRejected)
    assert rejected.diameter_mm < 0.3
    assert not rig.relay
    rig.cycle(20)
    rig.arm()
    assert rig.send(CONFIRMED) is None
    rig.until(messages.HeaterState.ARMED)
    assert isinstance(refused(rig, messages.StartHeating()), messages.RodUnfit)


@pytest.mark.parametrize(
    "values",
    [
        {"target_ratio": 1.0}, {"target_ratio": math.nan}, {"hold_s": CONFIG.longest_s}, {"hold_s": -1.0},
        {"length": 0.6}, {"length": 0.01}, {"initial_c": 71.0},
    ],
)  # fmt: skip
def test_a_number_beside_the_ratio_out_of_range_is_refused_by_its_name(values: dict[str, float]) -> None:
    refusal = refused(Rig(), messages.SetTargetRatio(**({"target_ratio": 1.09} | values)))
    assert isinstance(refusal, messages.RatioNumberOutOfRange)
    assert [refusal.quantity.name.lower()] == list(values)
    assert [key.name.lower() for key in messages.RatioKey] == [
        entry.name for entry in fields(messages.SetTargetRatio(1.09))
    ]


# -- refusals ----------------------------------------------------------------------------------------------------------


def refused(rig: Rig, command: Command) -> Refusal:
    refusal = rig.send(command)
    assert refusal is not None
    rig.cycle()
    assert not rig.gate
    return refusal


def test_heat_needs_its_steps_in_their_order() -> None:
    rig = Rig()
    rig.cycle()
    assert refused(rig, messages.ArmHeater()) == messages.HeatForbidden(Row.KEY, Mode.OFF)
    rig.permit(Mode.MANUAL)
    assert refused(rig, messages.StartHeating()) == messages.WrongHeaterState(
        messages.HeaterState.READY, messages.HeaterState.ARMED
    )
    rig.arm(Mode.MANUAL)
    assert refused(rig, messages.ArmHeater()) == messages.WrongHeaterState(
        messages.HeaterState.ARMED, messages.HeaterState.READY
    )
    assert refused(rig, messages.StartHeating()) == messages.NoHeatProfile()
    assert refused(rig, WHOLE) == messages.NoHeatProfile()
    assert rig.send(PROFILE) is None
    assert refused(rig, messages.StartHeating()) == messages.ResistanceNotMeasured()


@pytest.mark.parametrize(
    "command",
    [
        messages.MeasureResistance(False, messages.RodPhase.AUSTENITE),
        messages.MeasureResistance(True, messages.RodPhase.MARTENSITE),
        messages.MeasureResistance(True, messages.RodPhase.UNKNOWN),
    ],
)
def test_a_rod_that_is_bent_or_of_another_phase_is_not_measured(command: messages.MeasureResistance) -> None:
    rig = Rig()
    rig.arm()
    assert refused(rig, command) == messages.RodNotConfirmed(command.phase)
    rig.send(messages.StopHeating())
    rig.send(PROFILE)
    whole = messages.HeatRod(command.straight_and_unloaded, command.phase)
    assert refused(rig, whole) == messages.RodNotConfirmed(command.phase)
    assert not rig.relay


def test_pulses_wait_for_the_relay() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    assert rig.send(messages.ArmHeater()) is None
    assert rig.send(CONFIRMED) == messages.HeatForbidden(Row.RELAY_FEEDBACK, Mode.AUTO)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("target_c", 601.0), ("target_c", math.nan), ("target_c", math.inf), ("kelvin_per_ratio", 1e308),
        ("kelvin_per_ratio", 0.0), ("max_current", -1.0), ("max_current", 301.0), ("max_power", 1e-300),
        ("hold_s", -1.0), ("hold_s", CONFIG.longest_s + 1.0), ("initial_c", -4000.0), ("chuck_c", 1e308),
        ("cool_c", 401.0), ("mean_by_middle", 1.5), ("mean_by_middle", 1e-300), ("ramp_k_s", 1e308),
        ("uncertainty_k", -1.0), ("heat_capacity", 0.0), ("convected", math.nan), ("radiated", -1.0),
        ("tolerance", 0.4),
    ],
)  # fmt: skip
def test_a_number_of_a_profile_out_of_range_is_refused_by_its_name(key: str, value: float) -> None:
    refusal = refused(Rig(), replace(PROFILE, **{key: value}))
    assert isinstance(refusal, messages.ProfileNumberOutOfRange)
    assert refusal.quantity.name.lower() == key
    assert not refusal.least <= refusal.value <= refusal.greatest


def test_chucks_as_hot_as_the_target_are_refused() -> None:
    refusal = refused(Rig(), replace(PROFILE, chuck_c=150.0, target_c=150.0, cool_c=100.0))
    assert refusal == messages.ProfileNumberOutOfRange(messages.ProfileKey.CHUCK_C, 150.0, -20.0, 150.0)


def test_a_heater_may_narrow_the_target() -> None:
    refusal = refused(Rig(replace(CONFIG, greatest_target_c=400.0)), PROFILE)
    assert refusal == messages.ProfileNumberOutOfRange(messages.ProfileKey.TARGET_C, 500.0, 50.0, 400.0)


@pytest.mark.parametrize("wrong", [{"cool_c": 20.0}, {"target_c": 400.0}, {"initial_c": 200.0, "cool_c": 100.0}])
def test_a_profile_cools_to_between_its_initial_temperature_and_its_target(wrong: dict[str, float]) -> None:
    assert isinstance(refused(Rig(), replace(PROFILE, **wrong)), messages.CoolingOutOfRange)


def test_the_ranges_are_those_of_all_numbers_of_a_profile() -> None:
    assert [key.name.lower() for key in messages.PROFILE_RANGES] == [entry.name for entry in fields(PROFILE)]


def test_a_weak_battery_is_refused() -> None:
    rig = Rig()
    rig.set(battery_voltage=11.0)
    rig.permit(Mode.AUTO)
    assert refused(rig, messages.ArmHeater()) == messages.BatteryLow(11.0, CONFIG.least_battery_voltage)
    rig.cycle(5)
    assert not rig.relay


def test_the_key_at_off_forgets_the_initial_resistance() -> None:
    rig = Rig()
    rig.heat()
    rig.key(Mode.OFF)
    rig.cycle(20)
    rig.arm()
    assert refused(rig, messages.StartHeating()) == messages.ResistanceNotMeasured()


# -- heat off, for every row -------------------------------------------------------------------------------------------

Cause = Callable[[Rig], None]


def force(**inputs: float) -> Cause:
    return lambda rig: rig.forced.update({key: float(value) for key, value in inputs.items()})


def lose_cycle(rig: Rig) -> None:
    rig.context.good = False


def silence(arm: str) -> Cause:
    def stop_records(rig: Rig) -> None:
        rig.arms_follow = False
        rig.partners[arm].time_ns -= 20_000_000

    return stop_records


def stop_arm(rig: Rig) -> None:
    rig.partners["left"].emergency_stop = True


def disengage_arm(rig: Rig) -> None:
    rig.partners["left"].state = State.READY


def let_arm(state: State) -> Cause:
    def change(rig: Rig) -> None:
        rig.partners["right"].state = state

    return change


def release_enabling_device(rig: Rig) -> None:
    rig.partners["left"].motion_allowed = False


def leave_commander(rig: Rig) -> None:
    rig.context.commander = False


def fault_platform(rig: Rig) -> None:
    rig.context.state = State.FAULT


def put_in_energy(rig: Rig) -> None:
    rig.heater.balance.most_k = rig.heater.balance.least_k = 520.0


def freeze(key: str) -> Cause:
    return lambda rig: rig.forced.update({key: rig.get(key)})


CAUSES: list[tuple[Row, Mode, int, Cause]] = [
    (Row.KEY, Mode.AUTO, 1, force(key_auto=0)),
    (Row.KEY, Mode.AUTO, 1, force(key_auto=0, key_manual=1, button_a=1, button_b=1)),
    (Row.KEY, Mode.MANUAL, 1, force(key_auto=1)),
    (Row.BUTTON, Mode.MANUAL, 1, force(button_a=0, button_b=0)),
    (Row.BUTTON, Mode.MANUAL, 1, force(button_a=0)),
    (Row.BUTTON, Mode.MANUAL, 1, force(button_b=0)),
    (Row.ROBOT_CIRCUIT, Mode.AUTO, 1, force(circuit_a=0)),
    (Row.ROBOT_CIRCUIT, Mode.AUTO, 1, force(circuit_b=0)),
    (Row.ARMS_PERMITTED, Mode.AUTO, 1, release_enabling_device),
    (Row.ARMS_ENGAGED, Mode.AUTO, 1, disengage_arm),
    (Row.ARMS_ENGAGED, Mode.AUTO, 1, let_arm(State.MOVING)),
    (Row.ARMS_ENGAGED, Mode.AUTO, 1, let_arm(State.STOPPING)),
    (Row.ARMS_ENGAGED, Mode.AUTO, 1, stop_arm),
    (Row.PLATFORM, Mode.MANUAL, 1, fault_platform),
    (Row.COMMANDER, Mode.MANUAL, 1, leave_commander),
    (Row.ARM_LOST, Mode.AUTO, 1, silence("left")),
    (Row.ARM_LOST, Mode.AUTO, 1, silence("right")),
    (Row.RELAY_FEEDBACK, Mode.AUTO, 1, force(relay_closed=0)),
    (Row.FUSE, Mode.AUTO, 1, force(fuse_ok=0)),
    (Row.OVER_CURRENT, Mode.AUTO, 1, force(current=300.0)),
    (Row.OVER_CURRENT, Mode.AUTO, 1, force(current=float("nan"))),
    (Row.OVER_VOLTAGE, Mode.AUTO, 1, force(voltage=16.0)),
    (Row.OVER_VOLTAGE, Mode.AUTO, 1, force(battery_voltage=16.0)),
    (Row.OPEN_CIRCUIT, Mode.AUTO, 1, force(gate_sense=1, current=0.0, voltage=12.0)),
    (Row.SHORT_CIRCUIT, Mode.AUTO, 1, force(gate_sense=1, current=200.0, voltage=0.1)),
    (Row.IMPLAUSIBLE_TEMPERATURE, Mode.AUTO, 1, force(gate_sense=1, current=12.0, voltage=12.0)),
    (Row.EXCESS_HEAT, Mode.AUTO, 1, put_in_energy),
    (Row.INSULATION, Mode.AUTO, 1, force(chassis_voltage=0.0)),
    (Row.INSULATION, Mode.AUTO, 1, force(chassis_voltage=-5.0)),
    (Row.INSULATION, Mode.AUTO, 1, force(chassis_voltage=12.0)),
    (Row.LOST_CYCLE, Mode.AUTO, 1, lose_cycle),
    (Row.STALE_INPUT, Mode.AUTO, CONFIG.stale_cycles, freeze("sample")),
    (Row.STALE_INPUT, Mode.AUTO, CONFIG.stale_cycles, freeze("alive")),
]


@pytest.mark.parametrize(
    ("row", "mode", "cycles", "cause"), CAUSES, ids=[f"{row.name}-{n}" for n, (row, *_) in enumerate(CAUSES)]
)
def test_heat_is_off_in_the_cycle_of_the_cause_and_stays_off_when_it_is_gone(
    row: Row, mode: Mode, cycles: int, cause: Cause
) -> None:
    rig = Rig()
    rig.heat(mode)
    assert rig.gate
    cause(rig)
    rig.cycle(cycles)
    assert not rig.gate
    assert not rig.relay
    assert rig.heater.interlocks.cause is row
    reported = events(rig, messages.HeatEnded) + events(rig, messages.HeaterTripped)
    assert [event.row for event in reported] == [row]  # type: ignore[attr-defined]
    rig.forced.clear()
    rig.context.good, rig.context.commander, rig.context.state = True, True, State.HOLDING
    rig.arms_follow = True
    for arm in rig.partners.values():
        arm.state, arm.emergency_stop, arm.motion_allowed = State.HOLDING, False, True
    rig.permit(mode)
    for _ in range(50):
        rig.cycle()
        assert not rig.gate
        assert not rig.relay


def test_a_step_of_the_resistance_is_too_steep_at_once() -> None:
    rig = Rig()
    rig.heat()
    rig.cycle(400)
    while not rig.heater.meter.fresh:
        rig.cycle()
    rig.forced.update(gate_sense=1.0, current=30.0, voltage=30.0 * rig.heater.meter.resistance * 1.02)
    rig.cycle()
    assert rig.heater.interlocks.latched & 1 << Row.STEEP_GRADIENT
    assert not rig.gate
    assert not rig.relay


@pytest.mark.parametrize(
    ("mode", "channel", "row"),
    [
        (Mode.MANUAL, "button_a", Row.BUTTON_DISCREPANCY),
        (Mode.AUTO, "circuit_b", Row.CIRCUIT_DISCREPANCY),
    ],
)
def test_channels_that_differ_forbid_heat_for_longer_than_the_discrepancy_time(
    mode: Mode, channel: str, row: Row
) -> None:
    rig = Rig()
    rig.arm(mode)
    rig.forced[channel] = 0.0
    rig.cycle()
    assert not rig.relay
    assert not rig.heater.supervision.holds >> row & 1
    rig.cycle(round(CONFIG.discrepancy_s / PERIOD_S))
    assert rig.heater.supervision.holds >> row & 1


def test_a_gate_that_stays_on_trips_within_its_cycles() -> None:
    rig = Rig()
    rig.heat(state=messages.HeaterState.COOLING, target_c=100.0, cool_c=60.0)
    rig.cycle(20)
    rig.forced.update(gate_sense=1.0, current=30.0, voltage=30.0 * rig.resistance)
    rig.cycle(CONFIG.gate_cycles + 1)
    assert rig.heater.interlocks.latched & 1 << Row.GATE_FEEDBACK
    assert not rig.relay


@pytest.mark.parametrize("state", [messages.HeaterState.ARMED, messages.HeaterState.COOLING])
def test_a_current_with_the_gate_off_trips_as_the_gate_does(state: messages.HeaterState) -> None:
    rig = Rig()
    if state is messages.HeaterState.ARMED:
        rig.arm()
    else:
        rig.heat(state=state)
    rig.forced["current"] = 0.4
    rig.cycle(CONFIG.gate_cycles + 2)
    assert rig.relay
    rig.forced["current"] = -1.0
    rig.cycle(CONFIG.gate_cycles + 2)
    assert rig.heater.interlocks.latched == 1 << Row.GATE_FEEDBACK
    assert not rig.relay


def test_a_ratio_that_falls_in_a_pause_faster_than_a_rod_cools_is_too_steep() -> None:
    rig = Rig(replace(CONFIG, cooling_interval_s=0.5))
    rig.heat(state=messages.HeaterState.COOLING)
    rig.cycle(1500)
    assert rig.relay
    rig.initial *= 0.88
    rig.cycle(1100)
    assert rig.heater.interlocks.latched & 1 << Row.STEEP_GRADIENT
    assert not rig.relay


def test_a_gate_that_never_comes_on_trips_within_its_cycles() -> None:
    rig = Rig()
    rig.arm()
    rig.forced["gate_sense"] = 0.0
    assert rig.send(CONFIRMED) is None
    rig.cycle(CONFIG.gate_cycles + 2)
    assert rig.heater.interlocks.latched == 1 << Row.GATE_FEEDBACK
    assert not rig.gate
    assert not rig.relay


def test_a_relay_that_does_not_close_trips_after_its_time() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    rig.forced["relay_closed"] = 0.0
    assert rig.send(messages.ArmHeater()) is None
    rig.cycle(9)
    assert rig.relay
    rig.cycle(3)
    assert not rig.relay
    assert rig.heater.interlocks.latched == 1 << Row.RELAY_FEEDBACK


def test_a_welded_relay_latches_after_the_heat_and_is_never_started_again_before_its_reset() -> None:
    rig = Rig()
    rig.heat()
    rig.forced["relay_closed"] = 1.0
    assert rig.send(messages.StopHeating()) is None
    rig.cycle(12)
    assert rig.heater.state is messages.HeaterState.TRIPPED
    assert refused(rig, messages.ArmHeater()) == messages.TripLatched(Row.RELAY_FEEDBACK)
    assert refused(rig, messages.ResetTrips()) == messages.CauseRemains(Row.RELAY_FEEDBACK)
    rig.forced.clear()
    rig.cycle(10)
    assert refused(rig, messages.ArmHeater()) == messages.TripLatched(Row.RELAY_FEEDBACK)
    assert rig.send(messages.ResetTrips()) is None
    rig.cycle(20)
    assert rig.heater.state is messages.HeaterState.READY
    assert not rig.relay
    rig.arm()


def test_a_cause_that_was_there_before_the_inputs_went_missing_is_not_reset() -> None:
    rig = Rig()
    rig.forced["chassis_voltage"] = 0.0
    rig.cycle()
    rig.context.good = False
    rig.cycle()
    assert rig.send(messages.ResetTrips()) == messages.CauseRemains(Row.INSULATION)


def test_an_open_relay_is_needed_before_the_next_start() -> None:
    rig = Rig()
    rig.arm()
    assert rig.send(messages.StopHeating()) is None
    rig.cycle()
    assert rig.get("relay_closed")
    assert refused(rig, messages.ArmHeater()) == messages.HeatForbidden(Row.RELAY_FEEDBACK, Mode.AUTO)
    rig.cycle(10)
    assert rig.send(messages.ArmHeater()) is None


def test_the_gate_is_off_where_the_mirror_contact_opens_within_the_relays_time() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    assert rig.send(messages.ArmHeater()) is None
    while not rig.get("relay_closed"):
        rig.cycle()
    assert rig.send(CONFIRMED) is None
    rig.cycle()
    assert rig.gate
    rig.forced["relay_closed"] = 0.0
    rig.cycle()
    assert not rig.gate


def test_no_decision_for_the_gate_leaves_while_the_relay_is_not_commanded() -> None:
    rig = Rig()
    rig.permit(Mode.AUTO)
    rig.forced["relay_closed"] = 1.0
    rig.heater.gate = True
    rig.cycle()
    assert not rig.gate


def test_inputs_count_from_the_first_cycle_after_the_start() -> None:
    rig = Rig()
    rig.context.state = State.STARTING
    rig.set(key_auto=1, key_manual=1)
    rig.cycle(200)
    assert rig.heater.interlocks.latched == 0
    assert refused(rig, messages.ArmHeater()) == messages.HeatForbidden(Row.KEY, Mode.OFF)


def test_a_key_at_both_positions_latches() -> None:
    rig = Rig()
    rig.set(key_auto=1, key_manual=1)
    rig.cycle(102)
    assert rig.heater.interlocks.latched == 1 << Row.KEY_DISCREPANCY


@pytest.mark.parametrize("mode", MODES)
def test_stop_turns_heat_off_at_once_and_needs_no_lease(mode: Mode) -> None:
    rig = Rig()
    rig.heat(mode)
    assert not messages.StopHeating.needs_lease
    assert rig.send(messages.StopHeating()) is None
    assert not rig.gate
    assert not rig.relay
    rig.cycle(30)
    assert events(rig, messages.HeatStopped)
    assert not rig.gate
    assert not rig.relay


def test_safe_turns_heat_off_at_once_until_the_next_start() -> None:
    rig = Rig()
    rig.heat()
    rig.heater.safe()
    assert not rig.gate
    assert not rig.relay
    rig.cycle(30)
    assert not rig.gate
    assert not rig.relay
    assert rig.heater.state is messages.HeaterState.READY


def test_an_arm_that_the_cell_does_not_have_forbids_auto_and_not_manual() -> None:
    rig = Rig(replace(CONFIG, arms=()))
    signals = {name: Signal(rig.values, name) for name in rig.values}
    rig.heater = ShapeSetting(CONFIG, ProcessSetup(PERIOD_S, signals, {}))
    rig.permit(Mode.AUTO)
    assert isinstance(refused(rig, messages.ArmHeater()), messages.HeatForbidden)
    rig.arm(Mode.MANUAL)


# -- all states of the inputs, and random sequences of them ------------------------------------------------------------

LEVELS = ("key_auto", "key_manual", "button_a", "button_b", "circuit_a", "circuit_b", "relay_closed", "fuse_ok")
OTHERS = ("permitted", "engaged", "recent", "good", "platform", "commander")


def may_heat(mode: Mode, is_true: dict[str, bool]) -> bool:
    """The rules for heat that is on, written independently of the table."""
    always = ("relay_closed", "fuse_ok", "good", "platform", "commander")
    if not all(is_true[name] for name in always) or is_true["key_auto"] == is_true["key_manual"]:
        return False
    if mode is Mode.MANUAL:
        return is_true["key_manual"] and is_true["button_a"] and is_true["button_b"]
    robot = is_true["circuit_a"] and is_true["circuit_b"]
    return is_true["key_auto"] and robot and is_true["permitted"] and is_true["engaged"] and is_true["recent"]


def apply(rig: Rig, is_true: dict[str, bool]) -> None:
    rig.forced = {name: float(is_true[name]) for name in LEVELS if name in is_true}
    rig.context.good, rig.context.commander = is_true["good"], is_true["commander"]
    rig.context.state = State.HOLDING if is_true["platform"] else State.DISABLING
    rig.arms_follow = is_true["recent"]
    for arm in rig.partners.values():
        arm.motion_allowed = is_true["permitted"]
        arm.state = State.HOLDING if is_true["engaged"] else State.STOPPED_BY_LIMIT
        arm.time_ns = rig.context.now_ns - (0 if is_true["recent"] else 20_000_000)


@pytest.mark.interpreted
@pytest.mark.parametrize("mode", MODES)
def test_in_every_state_of_the_inputs_heat_goes_on_exactly_by_the_rules(mode: Mode) -> None:
    rig = Rig()
    rig.heat(mode)
    # Each state begins from a fresh heater.
    frozen = pickle.dumps((rig.heater, rig.context, rig.partners, rig.values, rig))
    permitted = 0
    for bits in product((False, True), repeat=len(LEVELS) + len(OTHERS)):
        is_true = dict(zip((*LEVELS, *OTHERS), bits, strict=True))
        _, _, _, _, rig = pickle.loads(frozen)
        apply(rig, is_true)
        if not is_true["good"]:
            rig.set(**rig.forced)
        rig.cycle()
        assert rig.relay == may_heat(mode, is_true), is_true
        assert rig.gate <= rig.relay
        assert rig.get("lamp_yellow") == rig.relay
        permitted += rig.relay
    assert permitted > 0


def run_random_sequences(count: int, seed: int) -> dict[str, int]:
    """Apply random inputs and commands; check after each cycle that nothing is on that was not started."""
    chance = random.Random(seed)
    rig, counts = Rig(), dict.fromkeys(("heat", "ended", "tripped"), 0)
    started = armed = False
    for _ in range(count):
        mode = chance.choice(MODES)
        is_true = dict.fromkeys((*LEVELS[:-2], "fuse_ok", *OTHERS), True)
        is_true.update(key_auto=mode is Mode.AUTO, key_manual=mode is Mode.MANUAL)
        apply(rig, is_true)
        rig.cycle(12)
        for command in (messages.StopHeating(), messages.ResetTrips(), messages.ArmHeater()):
            rig.send(command)
            rig.cycle(1 if command != messages.ArmHeater() else 12)
        armed = started = rig.relay
        if chance.random() < 0.9:
            # An initial resistance as if it had been measured: pulses take longer than all the rest.
            rig.heater.initial.value = rig.resistance
            rig.send(PROFILE)
            started = rig.send(chance.choice((messages.StartHeating(), CONFIRMED))) is None or started
        for _ in range(chance.randrange(1, 8)):
            for name in chance.sample(sorted(is_true), chance.choice((0, 0, 1, 2))):
                is_true[name] = not is_true[name]
            apply(rig, is_true)
            commands: list[Command] = [
                messages.ArmHeater(),
                messages.StartHeating(),
                CONFIRMED,
                messages.ResetTrips(),
                messages.StopHeating(),
                PROFILE,
            ]
            sent = chance.choice(commands) if chance.random() < 0.2 else None
            if sent is not None and rig.send(sent) is None:
                armed |= isinstance(sent, messages.ArmHeater)
                started |= isinstance(sent, (messages.StartHeating, messages.MeasureResistance))
            for _ in range(chance.choice((1, 1, 3, 12))):
                before = len(rig.context.events)
                rig.cycle()
                now = {**is_true, "relay_closed": rig.get("relay_closed") > 0.5}
                if rig.relay:
                    rules = may_heat(rig.heater.inputs.mode, {**now, "relay_closed": True, "commander": True})
                    assert armed
                    assert rules
                    assert not rig.heater.interlocks.latched
                if rig.gate:
                    assert started
                    assert may_heat(rig.heater.inputs.mode, now)
                    counts["heat"] += 1
                if not rig.relay:
                    armed = started = False
                for event in rig.context.events[before:]:
                    counts["ended"] += isinstance(event, messages.HeatEnded)
                    counts["tripped"] += isinstance(event, messages.HeaterTripped)
        rig.context.events.clear()
        rig.celsius = 20.0
    return counts


def test_random_sequences_of_inputs_and_commands_never_heat_outside_the_table() -> None:
    counts = run_random_sequences(3_000, seed=33)
    assert min(counts.values()) > 100, counts


@pytest.mark.long("test_random_sequences_of_inputs_and_commands_never_heat_outside_the_table")
def test_100_000_random_sequences_never_heat_outside_the_table() -> None:
    seen = run_random_sequences(100_000, seed=4)
    assert min(seen.values()) > 10_000, seen
