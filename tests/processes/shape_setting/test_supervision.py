"""Each row of the interlocks by the inputs of single cycles: when it is true, its value and its limit."""

from __future__ import annotations

from math import isnan, nan
from typing import Any

import pytest

from rtcp.ipc.states import State
from rtcp.motion.step_group import Partner
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.heat_balance import HeatBalance
from rtcp.processes.shape_setting.interlocks import Row
from rtcp.processes.shape_setting.resistance import ResistanceMeter
from rtcp.processes.shape_setting.supervision import Inputs, Supervision
from rtcp.processes.shape_setting.temperature import RatioScale
from tests.processes.shape_setting.rig import LEASE, PERIOD_S, Context
from tests.processes.shape_setting.test_interlocks import FAULT_FREE

CONFIG = ShapeSettingConfig(
    "shape_setting", "heater", discrepancy_s=0.005, relay_close_s=0.004, relay_open_s=0.002, gate_cycles=6,
    lost_cycles=3, stale_cycles=5, gradient_s=0.005,
)  # fmt: skip
INITIAL = 0.4


class Cycles:
    """A supervision with inputs that permit heat; each cycle converts anew and counts its instant."""

    def __init__(self) -> None:
        self.arms = [Partner(6), Partner(6)]
        for arm in self.arms:
            arm.state, arm.motion_allowed = State.HOLDING, True
        self.balance = HeatBalance()
        self.supervision = Supervision(CONFIG, PERIOD_S, self.arms, self.balance)
        self.inputs, self.context = Inputs(), Context()
        self.meter = ResistanceMeter(PERIOD_S, CONFIG.short_resistance, CONFIG.open_resistance)
        self.lease, self.relay, self.gate, self.initial = LEASE, False, False, INITIAL
        self.set(key_auto=True, button_a=True, button_b=True, circuit_a=True, circuit_b=True, fuse_ok=True)
        self.set(chassis_voltage=5.0, battery_voltage=12.5, sample=0.0, alive=0.0)

    def set(self, **inputs: Any) -> None:
        for name, value in inputs.items():
            setattr(self.inputs, name, value)

    def cycle(self, cycles: int = 1, *, converts: bool = True, is_alive: bool = True) -> int:
        for _ in range(cycles):
            self.context.now_ns += 500_000
            self.inputs.sample += converts
            self.inputs.alive += is_alive
            for arm in self.arms:
                arm.time_ns = self.context.now_ns
            holds = self.judge()
        return holds

    def judge(self) -> int:
        return self.supervision.update(
            self.inputs, self.meter, self.initial, self.context, self.lease, self.relay, self.gate  # type: ignore[arg-type]
        )  # fmt: skip

    def measure(self, resistance: float) -> int:
        """A cycle with a conversion of this resistance."""
        self.meter.update(resistance * 10.0, 10.0, self.inputs.sample + 1.0, True)
        return self.cycle()

    def shown(self, row: Row) -> tuple[float, float]:
        return self.supervision.values[row], self.supervision.limits[row]


def is_true(holds: int, row: Row) -> bool:
    return bool(holds >> row & 1)


def test_inputs_that_permit_heat_make_the_rows_of_permission_true_and_no_other() -> None:
    cycles = Cycles()
    assert cycles.cycle(20) == FAULT_FREE
    assert cycles.supervision.holds == FAULT_FREE


@pytest.mark.parametrize(
    ("row", "inputs"),
    [(Row.KEY, {"key_auto": False}), (Row.BUTTON, {"button_a": False}), (Row.BUTTON, {"button_b": False}),
     (Row.ROBOT_CIRCUIT, {"circuit_a": False}), (Row.ROBOT_CIRCUIT, {"circuit_b": False}),
     (Row.FUSE, {"fuse_ok": False})],
)  # fmt: skip
def test_an_input_that_is_missing_takes_its_own_permission_at_once(row: Row, inputs: dict[str, bool]) -> None:
    cycles = Cycles()
    cycles.cycle()
    cycles.set(**inputs)
    assert cycles.cycle() == FAULT_FREE & ~(1 << row)


@pytest.mark.parametrize("state", State)
def test_the_platform_is_enabled_while_it_holds_or_moves(state: State) -> None:
    cycles = Cycles()
    cycles.context.state = state
    assert is_true(cycles.cycle(), Row.PLATFORM) is (state in (State.HOLDING, State.MOVING))


@pytest.mark.parametrize(("lease", "held", "holds"), [(LEASE, True, 1), (LEASE, False, 0), (0, False, 1), (3, True, 0)])
def test_who_commanded_holds_the_lease_or_nobody_did(lease: int, held: bool, holds: bool) -> None:
    cycles = Cycles()
    cycles.lease, cycles.context.commander = lease, held
    assert is_true(cycles.cycle(), Row.COMMANDER) is bool(holds)


@pytest.mark.parametrize("arm", [0, 1])
def test_each_arm_has_to_be_permitted_to_hold_and_to_be_heard_from(arm: int) -> None:
    cycles = Cycles()
    partner = cycles.arms[arm]
    partner.motion_allowed = False
    assert cycles.cycle() == FAULT_FREE & ~(1 << Row.ARMS_PERMITTED)
    partner.motion_allowed, partner.state = True, State.MOVING
    assert cycles.cycle() == FAULT_FREE & ~(1 << Row.ARMS_ENGAGED)
    partner.state, partner.emergency_stop = State.HOLDING, True
    assert cycles.cycle() == FAULT_FREE & ~(1 << Row.ARMS_ENGAGED)
    partner.emergency_stop = False
    partner.time_ns -= 10_000_000
    assert cycles.judge() == FAULT_FREE
    partner.time_ns -= 1_000_000
    assert cycles.judge() == FAULT_FREE | 1 << Row.ARM_LOST
    assert cycles.shown(Row.ARM_LOST) == (pytest.approx(0.011), 0.01)


@pytest.mark.parametrize(
    ("row", "inputs"),
    [(Row.KEY_DISCREPANCY, {"key_manual": True}), (Row.BUTTON_DISCREPANCY, {"button_b": False}),
     (Row.CIRCUIT_DISCREPANCY, {"circuit_a": False})],
)  # fmt: skip
def test_channels_may_differ_for_their_time(row: Row, inputs: dict[str, bool]) -> None:
    cycles = Cycles()
    cycles.cycle()
    cycles.set(**inputs)
    assert not is_true(cycles.cycle(10), row)
    assert is_true(cycles.cycle(), row)
    assert cycles.shown(row) == (pytest.approx(0.0055), 0.005)


def test_the_relay_has_its_own_times_to_close_and_to_open() -> None:
    cycles = Cycles()
    cycles.cycle()
    cycles.relay = True
    assert cycles.cycle(8) == FAULT_FREE
    assert cycles.shown(Row.RELAY_FEEDBACK) == (pytest.approx(0.004), 0.004)
    assert cycles.cycle() == FAULT_FREE | 1 << Row.RELAY_FEEDBACK
    cycles.set(relay_closed=True)
    assert cycles.cycle() == FAULT_FREE
    cycles.relay = False
    assert cycles.cycle(4) == FAULT_FREE
    assert cycles.cycle() == FAULT_FREE | 1 << Row.RELAY_FEEDBACK


@pytest.mark.parametrize("is_on", [True, False])
def test_the_gate_has_its_cycles_to_follow(is_on: bool) -> None:
    cycles = Cycles()
    cycles.gate = not is_on
    cycles.set(gate_sense=not is_on)
    cycles.cycle(20)
    cycles.gate = is_on
    assert cycles.cycle(6) == FAULT_FREE
    assert cycles.cycle() == FAULT_FREE | 1 << Row.GATE_FEEDBACK
    assert cycles.shown(Row.GATE_FEEDBACK) == (pytest.approx(7 * PERIOD_S), 6 * PERIOD_S)


@pytest.mark.parametrize("current", [0.51, -0.51, nan])
def test_a_current_with_the_gate_off_counts_after_the_gates_cycles_with_its_own_limit(current: float) -> None:
    cycles = Cycles()
    cycles.gate = True
    cycles.set(gate_sense=True, current=100.0 if isnan(current) else current)
    cycles.cycle(10)
    cycles.gate = False
    cycles.set(gate_sense=False, current=current)
    # No number is also too much current.
    fault = 1 << Row.OVER_CURRENT if isnan(current) else 0
    assert cycles.cycle(6) == FAULT_FREE | fault
    assert cycles.cycle() == FAULT_FREE | 1 << Row.GATE_FEEDBACK | fault
    assert cycles.shown(Row.GATE_FEEDBACK) == (pytest.approx(abs(current), nan_ok=True), 0.5)
    cycles.set(current=0.5)
    assert cycles.cycle() == FAULT_FREE


def test_counters_that_stand_still_are_stale_inputs() -> None:
    for counters in ({"converts": False}, {"is_alive": False}):
        cycles = Cycles()
        cycles.cycle(3)
        assert cycles.cycle(4, **counters) == FAULT_FREE
        assert cycles.cycle(1, **counters) == FAULT_FREE | 1 << Row.STALE_INPUT
        assert cycles.shown(Row.STALE_INPUT) == (pytest.approx(5 * PERIOD_S), 5 * PERIOD_S)
        assert cycles.cycle() == FAULT_FREE


@pytest.mark.parametrize(
    ("row", "inputs", "value", "limit", "is_fault"),
    [
        (Row.OVER_CURRENT, {"current": 280.0}, 280.0, 280.0, False),
        (Row.OVER_CURRENT, {"current": 280.1}, 280.1, 280.0, True),
        (Row.OVER_CURRENT, {"current": -280.1}, 280.1, 280.0, True),
        (Row.OVER_CURRENT, {"current": nan}, nan, 280.0, True),
        (Row.OVER_VOLTAGE, {"voltage": 14.9}, 14.9, 15.0, False),
        (Row.OVER_VOLTAGE, {"voltage": 15.1}, 15.1, 15.0, True),
        (Row.OVER_VOLTAGE, {"voltage": -15.1}, 15.1, 15.0, True),
        (Row.OVER_VOLTAGE, {"battery_voltage": 15.1}, 15.1, 15.0, True),
        (Row.INSULATION, {"chassis_voltage": 2.4}, 2.4, 2.5, True),
        (Row.INSULATION, {"chassis_voltage": 2.5}, 2.5, 7.5, False),
        (Row.INSULATION, {"chassis_voltage": 7.5}, 7.5, 7.5, False),
        (Row.INSULATION, {"chassis_voltage": 7.6}, 7.6, 7.5, True),
        (Row.INSULATION, {"chassis_voltage": nan}, nan, 7.5, True),
    ],
)
def test_a_value_beyond_its_limit_counts_at_once(
    row: Row, inputs: dict[str, float], value: float, limit: float, is_fault: bool
) -> None:
    cycles = Cycles()
    cycles.gate = True
    cycles.set(gate_sense=True)
    cycles.cycle()
    cycles.set(**inputs)
    assert cycles.cycle() == (FAULT_FREE ^ 1 << row if is_fault else FAULT_FREE)
    assert cycles.shown(row) == (pytest.approx(value, nan_ok=True), limit)


def test_lost_cycles_count_in_a_row_and_leave_the_other_rows_as_they_were() -> None:
    cycles = Cycles()
    cycles.set(current=281.0)
    before = cycles.cycle()
    assert is_true(before, Row.OVER_CURRENT)
    cycles.set(current=0.0)
    cycles.context.good = False
    assert cycles.cycle(2) == before
    assert cycles.cycle() == before | 1 << Row.LOST_CYCLE
    assert cycles.shown(Row.LOST_CYCLE) == (3.0, 2.0)
    cycles.context.good = True
    assert cycles.cycle() == FAULT_FREE
    cycles.context.good = False
    assert not is_true(cycles.cycle(2), Row.LOST_CYCLE)


def test_feedback_to_a_command_of_a_lost_cycle_has_its_time_from_the_next_good_one() -> None:
    cycles = Cycles()
    cycles.cycle()
    cycles.context.good, cycles.relay, cycles.gate = False, True, True
    cycles.cycle(2)
    cycles.context.good = True
    assert cycles.cycle(6) == FAULT_FREE
    assert cycles.cycle() == FAULT_FREE | 1 << Row.GATE_FEEDBACK
    assert cycles.cycle(2) == FAULT_FREE | 1 << Row.GATE_FEEDBACK | 1 << Row.RELAY_FEEDBACK


@pytest.mark.parametrize(
    ("resistance", "row", "limit"), [(5.1, Row.OPEN_CIRCUIT, 5.0), (0.007, Row.SHORT_CIRCUIT, 0.008)]
)
def test_an_open_and_a_short_circuit_show_the_resistance(resistance: float, row: Row, limit: float) -> None:
    cycles = Cycles()
    assert cycles.measure(resistance) == FAULT_FREE | 1 << row
    assert cycles.shown(row) == (pytest.approx(resistance), limit)


def heat(cycles: Cycles, least_k: float, most_k: float) -> None:
    """Let the power allow these rises in the middle of a rod of 20 C, whose mean rises by 0.9 of its middle."""
    cycles.balance.set_rod(20.0, 20.0, 500.0, 0.75, 24.0, 0.0, 0.05)
    cycles.balance.least_k, cycles.balance.most_k = least_k, most_k
    cycles.supervision.set_rod(RatioScale(20.0, 5000.0, 20.0, 0.9), 500.0)


@pytest.mark.parametrize(
    ("mean", "limit", "is_fault"), [(254, 255, True), (256, 365, False), (364, 365, False), (366, 365, True)]
)
def test_a_mean_temperature_that_the_power_does_not_allow_is_implausible(
    mean: float, limit: float, is_fault: bool
) -> None:
    cycles = Cycles()
    heat(cycles, 260.0 / 0.9, 320.0)
    resistance = INITIAL * (1.0 + (mean - 20.0) / 5000.0)
    fault = FAULT_FREE | 1 << Row.IMPLAUSIBLE_TEMPERATURE
    assert cycles.measure(resistance) == (fault if is_fault else FAULT_FREE)
    assert cycles.shown(Row.IMPLAUSIBLE_TEMPERATURE) == (pytest.approx(mean), pytest.approx(limit))
    cycles = Cycles()
    heat(cycles, 290.0, 320.0)
    cycles.initial = 0.0
    assert cycles.measure(resistance) == FAULT_FREE


def test_without_a_profile_no_temperature_is_implausible() -> None:
    assert Cycles().measure(2.0 * INITIAL) == FAULT_FREE


@pytest.mark.parametrize("good", [True, False])
def test_a_power_that_may_heat_the_middle_far_above_its_target_is_excess_heat(good: bool) -> None:
    cycles = Cycles()
    cycles.cycle()
    heat(cycles, 400.0, 509.9)
    cycles.context.good = good
    assert cycles.cycle() == FAULT_FREE
    heat(cycles, 400.0, 510.1)
    assert cycles.cycle() == FAULT_FREE | 1 << Row.EXCESS_HEAT
    assert cycles.shown(Row.EXCESS_HEAT) == (pytest.approx(530.1), 530.0)


def test_a_step_of_the_resistance_is_steep_at_once_and_a_slope_over_its_time() -> None:
    cycles = Cycles()
    cycles.measure(INITIAL)
    # 1 1/s over 5 ms.
    assert cycles.measure(INITIAL * 1.0049) == FAULT_FREE
    assert cycles.shown(Row.STEEP_GRADIENT) == (pytest.approx(0.98), 1.0)
    assert cycles.measure(INITIAL * 1.0051) == FAULT_FREE | 1 << Row.STEEP_GRADIENT
    cycles = Cycles()
    cycles.measure(INITIAL)
    for i in range(1, 100):  # 0.8 1/s: the time begins again at each anchor
        assert cycles.measure(INITIAL * (1.0 + 0.0004 * i)) == FAULT_FREE
    cycles.supervision.forget_gradient()
    assert cycles.measure(INITIAL * 1.2) == FAULT_FREE


def test_after_a_pause_a_fall_is_steep_where_no_rod_cools_so_fast() -> None:
    for fall, is_steep in ((0.069, False), (0.071, True)):
        cycles = Cycles()
        cycles.measure(INITIAL * 1.1)
        cycles.meter.fresh = False
        cycles.cycle(1999)
        # 0.06 1/s in 1 s, and 0.01 at once.
        assert is_true(cycles.measure(INITIAL * 1.1 * (1.0 - fall)), Row.STEEP_GRADIENT) is is_steep
        assert cycles.shown(Row.STEEP_GRADIENT) == (pytest.approx(fall), pytest.approx(0.07))
