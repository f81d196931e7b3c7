"""The drive's state machine, its stops, its faults and its options."""

import pytest

from rtcp.virtual.device import create, models
from rtcp.virtual.models.cia402 import DriveState, DriveStateMachine
from rtcp.virtual.objects import SdoAbort
from tests.virtual.models.conftest import Bench, Maker


def turning(drive: Maker) -> Bench:
    """Return a drive in CSV whose joint turns at 1 rad/s."""
    bench = drive().enabled(9)
    bench[0x60FF] = 10000
    bench.run(0.5)
    return bench


TRANSITIONS = [
    (DriveState.SWITCH_ON_DISABLED, 0x06, 2, DriveState.READY_TO_SWITCH_ON),
    (DriveState.READY_TO_SWITCH_ON, 0x07, 3, DriveState.SWITCHED_ON),
    (DriveState.READY_TO_SWITCH_ON, 0x0F, 3, DriveState.SWITCHED_ON),
    (DriveState.SWITCHED_ON, 0x0F, 4, DriveState.OPERATION_ENABLED),
    (DriveState.OPERATION_ENABLED, 0x07, 5, DriveState.SWITCHED_ON),
    (DriveState.SWITCHED_ON, 0x06, 6, DriveState.READY_TO_SWITCH_ON),
    (DriveState.READY_TO_SWITCH_ON, 0x00, 7, DriveState.SWITCH_ON_DISABLED),
    (DriveState.READY_TO_SWITCH_ON, 0x02, 7, DriveState.SWITCH_ON_DISABLED),
    (DriveState.OPERATION_ENABLED, 0x06, 8, DriveState.READY_TO_SWITCH_ON),
    (DriveState.OPERATION_ENABLED, 0x00, 9, DriveState.SWITCH_ON_DISABLED),
    (DriveState.SWITCHED_ON, 0x00, 10, DriveState.SWITCH_ON_DISABLED),
    (DriveState.SWITCHED_ON, 0x02, 10, DriveState.SWITCH_ON_DISABLED),
    (DriveState.OPERATION_ENABLED, 0x02, 11, DriveState.QUICK_STOP_ACTIVE),
    (DriveState.OPERATION_ENABLED, 0x0B, 11, DriveState.QUICK_STOP_ACTIVE),
    (DriveState.QUICK_STOP_ACTIVE, 0x00, 12, DriveState.SWITCH_ON_DISABLED),
    (DriveState.FAULT, 0x80, 15, DriveState.SWITCH_ON_DISABLED),
    (DriveState.QUICK_STOP_ACTIVE, 0x0F, 16, DriveState.OPERATION_ENABLED),
]
REFUSED = [
    (DriveState.NOT_READY_TO_SWITCH_ON, 0x06),
    (DriveState.SWITCH_ON_DISABLED, 0x07),
    (DriveState.SWITCH_ON_DISABLED, 0x0F),
    (DriveState.SWITCH_ON_DISABLED, 0x00),
    (DriveState.READY_TO_SWITCH_ON, 0x06),
    (DriveState.SWITCHED_ON, 0x07),
    (DriveState.OPERATION_ENABLED, 0x0F),
    (DriveState.OPERATION_ENABLED, 0x8F),
    (DriveState.QUICK_STOP_ACTIVE, 0x06),
    (DriveState.QUICK_STOP_ACTIVE, 0x02),
    (DriveState.FAULT_REACTION_ACTIVE, 0x80),
    (DriveState.FAULT, 0x06),
    (DriveState.FAULT, 0x0F),
    (DriveState.FAULT, 0x00),
]


@pytest.mark.parametrize(("before", "controlword", "number", "after"), TRANSITIONS)
def test_a_controlword_walks_the_transition_of_the_standard(
    before: DriveState, controlword: int, number: int, after: DriveState
) -> None:
    machine = DriveStateMachine()
    machine.state = before
    assert machine.request(controlword) == (number, after)


@pytest.mark.parametrize(("before", "controlword"), REFUSED)
def test_a_controlword_out_of_place_asks_for_nothing(before: DriveState, controlword: int) -> None:
    machine = DriveStateMachine()
    machine.request(controlword & 0x80)
    machine.state = before
    assert machine.request(controlword) is None


def test_the_drive_shows_every_state_of_the_way_up_and_down(drive: Maker) -> None:
    bench = drive(started=False)
    bench.run(0.01)
    assert bench.state == "not ready"
    bench.run(0.1)
    assert bench.state == "disabled"
    path = [(6, "ready"), (7, "switched on"), (15, "enabled"), (7, "switched on"), (6, "ready"), (0, "disabled")]
    for controlword, state in path:
        bench.control(controlword)
        bench.run(0.01)
        assert bench.state == state


def test_one_controlword_may_walk_switched_on_on_its_way_to_enabled(drive: Maker) -> None:
    bench = drive()
    assert bench.control(0x06) == "ready"
    assert [bench.control(0x0F) for _ in range(2)] == ["switched on", "enabled"]


def test_the_voltage_and_remote_bits_show_the_supply_and_the_bus(drive: Maker) -> None:
    bench = drive()
    assert bench.bit(4)
    assert bench.bit(9)
    bench.drive.set_outputs_valid(False)
    bench.run(0.01)
    assert bench.bit(4)
    assert not bench.bit(9)


def test_a_controlword_counts_only_while_outputs_are_valid(drive: Maker) -> None:
    bench = drive()
    bench.drive.set_outputs_valid(False)
    assert bench.control(0x06) == "disabled"
    bench.drive.set_outputs_valid(True)
    assert bench.control(0x06) == "ready"


def test_a_fault_is_reset_by_the_rising_edge_of_bit_7_only(drive: Maker) -> None:
    bench = drive()
    bench[0x6040] = 0x80
    bench.run(0.01)
    bench.drive.inject_fault(0x8611)
    bench.run(0.01)
    assert bench.state == "fault"
    bench.run(0.1)
    assert bench.state == "fault"
    assert bench.control(0x00) == "fault"
    assert bench.control(0x80) == "disabled"
    assert bench[0x603F] == 0
    assert bench[0x1001] == 0
    assert [e.error_code for e in bench.drive.emergencies] == [0x8611, 0]


def test_holding_bit_7_lets_no_other_command_through(drive: Maker) -> None:
    bench = drive()
    bench.control(0x80)
    assert bench.control(0x86) == "disabled"
    assert bench.control(0x06) == "ready"


@pytest.mark.parametrize("option", [0, 1, 2, 5, 6])
def test_a_quick_stop_ends_as_its_option_says(drive: Maker, option: int) -> None:
    bench = turning(drive)
    bench[0x605A] = option
    assert bench.velocity == pytest.approx(1.0, abs=0.02)
    bench.control(0x02)
    took = bench.until(lambda: abs(bench.velocity) < 0.005, 1.0)
    bench.run(0.3)
    expected = {0: 0.1, 1: 0.25, 2: 0.1, 5: 0.25, 6: 0.1}[option]
    assert took == pytest.approx(expected, abs=0.08)
    if option >= 5:
        assert bench.state == "quick stop"
        assert bench.drive.powered
        assert bench.bit(10)
        assert not bench.bit(5)
        bench[0x60FF] = 0
        assert bench.control(0x0F) == "enabled"
    else:
        assert bench.state == "disabled"
        assert not bench.drive.powered


@pytest.mark.parametrize("mode", [1, 3, 6, 8, 9, 10])
def test_a_quick_stop_brings_every_mode_to_rest_and_holds(drive: Maker, mode: int) -> None:
    bench = drive().enabled(mode)
    bench[0x605A] = 6
    bench.set_in_motion(mode)
    bench.control(bench[0x6040] & ~0x04)
    bench.run(0.6)
    position = bench.position
    bench.run(0.3)
    assert abs(bench.position - position) < 3e-4
    assert bench.drive.powered


@pytest.mark.parametrize("mode", [1, 3, 6, 8, 9, 10])
def test_halt_stops_every_mode_and_its_release_goes_on(drive: Maker, mode: int) -> None:
    bench = drive().enabled(mode)
    bench.set_in_motion(mode)
    bench.control(bench[0x6040] | 0x100)
    bench.run(0.8)
    position = bench.position
    assert bench.state == "enabled"
    assert bench.bit(10)
    assert not bench.bit(12)
    bench.run(0.2)
    assert abs(bench.position - position) < 3e-4
    bench.control(bench[0x6040] & ~0x100)
    bench.run(0.3)
    assert abs(bench.position - position) > 0.003


@pytest.mark.parametrize(("controlword", "option"), [(0x07, 0x605C), (0x06, 0x605B)])
def test_disabling_ramps_down_first_where_the_option_says_so(drive: Maker, controlword: int, option: int) -> None:
    bench = turning(drive)
    bench[option] = 1
    assert bench.control(controlword) == "enabled"
    took = bench.until(lambda: bench.state != "enabled", 1.0)
    assert took == pytest.approx(0.25, abs=0.05)
    assert abs(bench.velocity) < 0.01
    assert bench.state == {0x07: "switched on", 0x06: "ready"}[controlword]


def test_enabling_again_during_the_ramp_goes_on(drive: Maker) -> None:
    bench = turning(drive)
    bench.control(0x07)
    bench.run(0.1)
    assert bench.control(0x0F) == "enabled"
    bench.run(0.5)
    assert bench.velocity == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("index", "value"), [(0x605A, 3), (0x605A, 8), (0x605D, 0), (0x605E, 4), (0x6098, 1)])
def test_an_option_code_outside_the_subset_is_refused(drive: Maker, index: int, value: int) -> None:
    bench = drive()
    with pytest.raises(SdoAbort) as refused:
        bench.write(index, 0, value.to_bytes(1 if index == 0x6098 else 2, "little"))
    assert refused.value.code == 0x06090030


def test_an_unsupported_mode_keeps_the_old_one(drive: Maker) -> None:
    bench = drive().enabled(9)
    bench[0x6060] = 4
    bench.run(0.01)
    assert bench[0x6061] == 9
    assert bench[0x6502] & 1 << 3 == 0


# Faults


@pytest.mark.parametrize("push", [90.0, -90.0])
def test_a_joint_that_is_pushed_away_faults_with_a_following_error(drive: Maker, push: float) -> None:
    bench = drive().enabled(8)
    bench.drive.mechanics.external_torque = push
    bench.until(lambda: bench.bit(13), 2.0)
    assert bench.bit(11)
    bench.expect_fault(0x8611, 0x20)


def test_a_following_error_shorter_than_its_time_out_is_no_fault(drive: Maker) -> None:
    bench = drive().enabled(8)
    bench[0x6066] = 1000
    bench.drive.mechanics.external_torque = 90.0
    bench.until(lambda: bench.bit(13), 2.0)
    bench.drive.mechanics.external_torque = 0.0
    bench.run(1.5)
    assert bench.state == "enabled"
    assert not bench.bit(13)


def test_over_speed_in_torque_mode_faults(drive: Maker) -> None:
    bench = drive(initial_position=-10.0).enabled(10)
    bench[0x6071] = 500000
    fastest = bench.largest(0.8, lambda: bench.velocity)
    assert 10.0 < fastest < 10.2
    bench.expect_fault(0x8400, 0x20)


def test_the_start_stop_torque_for_seconds_faults_with_over_current(drive: Maker) -> None:
    bench = drive("orh40").enabled(10)
    bench.drive.mechanics.coulomb = 100.0
    bench[0x6071] = 190000
    took = bench.until(lambda: bench.state in ("fault", "fault reaction"), 5.0)
    assert took == pytest.approx(2.0, abs=0.05)
    assert not bench.drive.powered
    bench.expect_fault(0x2310, 0x02)


def test_the_overload_integrator_warns_before_it_trips(drive: Maker) -> None:
    bench = drive("orh40").enabled(10)
    bench.drive.mechanics.coulomb = 100.0
    bench[0x6071] = 190000
    bench.run(1.5)
    assert not bench.bit(7)
    bench.run(0.2)
    assert bench.bit(7)
    assert bench.state == "enabled"
    assert 800 < bench[0x2000, 3] < 1000


def test_the_average_load_torque_never_overloads(drive: Maker) -> None:
    bench = drive("orh40").enabled(10)
    bench.drive.mechanics.coulomb = 100.0
    bench[0x6071] = 76000
    bench.dt = 0.004
    bench.run(20.0)
    assert bench.state == "enabled"
    assert bench[0x2000, 3] == 0


def test_heat_warns_and_then_locks_the_drive_until_it_has_cooled(drive: Maker) -> None:
    bench = drive().enabled(8)
    bench.drive.condition.temperature = 82.0
    bench.run(0.02)
    assert bench.bit(7)
    bench.drive.condition.temperature = 91.0
    bench.expect_fault(0x4310, 0x08)
    assert bench.control(0x80) == "fault"
    bench.control(0x00)
    bench.drive.condition.temperature = 60.0
    assert bench.control(0x80) == "disabled"


def test_a_supply_above_60_v_takes_the_torque_at_once(drive: Maker) -> None:
    bench = turning(drive)
    bench.drive.condition.bus_voltage = 61.0
    bench.until(lambda: bench[0x603F] != 0, 0.1)
    assert not bench.drive.powered
    bench.expect_fault(0x3210, 0x04)


def test_a_supply_that_breaks_down_faults(drive: Maker) -> None:
    bench = drive().enabled(8)
    bench.drive.condition.bus_voltage = 12.0
    bench.expect_fault(0x3220, 0x04)


def test_a_position_beyond_the_encoder_faults_and_cannot_be_reset_there(drive: Maker) -> None:
    bench = drive(started=False, initial_position=12.6)
    bench.expect_fault(0x8612, 0x20)
    assert bench.control(0x80) == "fault"


def test_outputs_lost_while_enabled_ramp_down_and_fault(drive: Maker) -> None:
    bench = turning(drive)
    bench.drive.set_outputs_valid(False)
    bench.run(0.05)
    assert bench.state == "fault reaction"
    assert bench.velocity == pytest.approx(0.5, abs=0.1)
    bench.expect_fault(0x8130, 0x10)
    assert abs(bench.velocity) < 0.01


def test_outputs_lost_while_disabled_are_no_fault(drive: Maker) -> None:
    bench = drive()
    bench.control(0x06)
    bench.drive.set_outputs_valid(False)
    bench.run(0.01)
    assert bench.state == "disabled"
    assert not bench.drive.emergencies


@pytest.mark.parametrize(("option", "expected"), [(0, 0.05), (1, 0.25), (2, 0.1)])
def test_the_fault_reaction_is_the_one_chosen(drive: Maker, option: int, expected: float) -> None:
    bench = turning(drive)
    bench[0x605E] = option
    bench.drive.inject_fault(0x7121)
    took = bench.until(lambda: abs(bench.velocity) < 0.005, 1.0)
    assert took == pytest.approx(expected, abs=0.06)
    bench.expect_fault(0x7121, 0x20)


def test_a_code_that_is_no_error_cannot_be_injected(drive: Maker) -> None:
    with pytest.raises(ValueError, match="0x1000 to 0xFFFF"):
        drive().drive.inject_fault(0)


def test_the_error_history_keeps_the_newest_first_and_is_cleared_by_zero(drive: Maker) -> None:
    bench = drive()
    for code in (0x8611, 0x4310):
        bench.drive.inject_fault(code)
        bench.run(0.01)
        bench.control(0x80)
        bench.control(0x00)
    assert [bench[0x1003, place] for place in range(4)] == [2, 0x4310, 0x8611, 0]
    bench.write(0x1003, 0, b"\x00")
    assert (bench[0x1003], bench[0x1003, 1]) == (0, 0)


def test_a_joint_under_gravity_stays_on_its_brake_with_the_power_off(drive: Maker) -> None:
    bench = drive(load_mass_moment=4.0, initial_position=1.5)
    bench.run(1.0)
    assert bench.position == pytest.approx(1.5, abs=2e-4)


@pytest.mark.parametrize(("phase", "direction"), [(0.0, 1), (3.14159265, -1)])
def test_a_loose_joint_falls_from_upright_and_swings_back_when_it_hangs(
    drive: Maker, phase: float, direction: int
) -> None:
    bench = drive(load_mass_moment=4.0, gravity_phase=phase, initial_position=0.3).enabled(10)
    bench.run(0.3)
    assert (bench.position - 0.3) * direction > 0.05


# Options and objects


def test_every_model_can_be_created_and_stepped_without_a_socket() -> None:
    for model in models():
        device = create(model, serial=7)
        device.step(0.001)
        assert device.identity.serial == 7


@pytest.mark.parametrize(
    ("model", "options", "words"),
    [
        ("cubemars-orh80", {}, "cubemars-orh70"),
        ("cubemars-orh70", {"inertia": 1.0}, "load_inertia"),
        ("cubemars-orh70", {"friction": -1.0}, "0 to 50"),
        ("cubemars-orh70", {"friction": "much"}, "a number"),
        ("cubemars-orh70", {"serial": 1.5}, "a whole number"),
        ("diewu-io", {"friction": 1.0}, "counter_rate"),
    ],
)
def test_a_model_or_option_that_is_not_allowed_is_refused_with_what_is(
    model: str, options: dict[str, object], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        create(model, **options)
