"""The heater on its virtual slaves: circuit and rod are those of `rtcp.virtual`, which share no code with it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.config import load
from rtcp.control.processes import ProcessPart
from rtcp.ipc.commands import Disable, Halt
from rtcp.ipc.states import State
from rtcp.processes.shape_setting import messages
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.heat_profile import HeatProfile, Limits, heat_command
from rtcp.processes.shape_setting.interlocks import TABLE, Mode, Row, Rule
from rtcp.processes.shape_setting.process import ShapeSetting
from rtcp.processes.shape_setting.profile import read_profile
from rtcp.testing.simulation import Simulation
from rtcp.virtual.heated_rod import HeatedRod
from rtcp.virtual.heater_circuit import CircuitFault
from rtcp.virtual.models.shape_setter import ShapeSetterBox, ShapeSetterMeter

ROOT = Path(__file__).parents[3]
AUTO, MANUAL = 0x31, 0x0E
KEY_OFF, CIRCUIT_OPEN, ONE_CHANNEL = 0x30, 0x01, 0x11


def short_profile() -> HeatProfile:
    profile = read_profile(ROOT / "config" / "shape_setting" / "nitinol.yaml")
    limits = Limits(current=20.0, power=150.0)
    return replace(profile, hold_s=0.3, ramp_k_s=300.0, initial_c=20.0, chuck_c=20.0, cool_c=400.0, limits=limits)


class Platform(Simulation):
    """The platform of config/heater.yaml, with an arm that holds beside it; `keys` of the process.

    `arm_follows`: whether the arm's record is of every cycle.
    """

    def __init__(self, **keys: Any) -> None:
        config = load(ROOT / "config" / "heater.yaml")
        (heater,) = config.processes
        assert isinstance(heater, ShapeSettingConfig)
        # With the tolerances of a real robot, not those of a busy host.
        process = ShapeSettingConfig(heater.kind, heater.name, arms=("left",), **({"rod_cooling_s": 0.0} | keys))
        super().__init__(replace(config, processes=(process,)))
        self.control = next(s.device for s in self.bus.slaves if isinstance(s.device, ShapeSetterBox))
        part = next(part for part in self.loop.parts if isinstance(part, ProcessPart))
        assert isinstance(part.process, ShapeSetting)
        self.process = part.process
        (self.arm,) = self.process.supervision._arms
        self.arm.state, self.arm.motion_allowed = State.HOLDING, True
        self.arm_follows = True

    def cycle(self) -> None:
        if self.arm_follows:
            self.arm.time_ns = self.due_ns
        super().cycle()

    def field(self, name: str) -> float:
        record = self.observer.latest()
        assert record is not None
        return float(record[f"heater_{name}"][0])

    def reaches(self, state: messages.HeaterState, seconds: float) -> bool:
        return self.until(lambda: self.field("state") == state, seconds)

    def heat(self, mode: Mode = Mode.AUTO) -> None:
        self.control.contacts = AUTO if mode is Mode.AUTO else MANUAL
        for _ in range(4):
            self.cycle()
        self.do(messages.ArmHeater())
        assert self.until(lambda: self.control.circuit.relay_closed, 0.1)
        for _ in range(4):
            self.cycle()
        self.do(messages.MeasureResistance(True, messages.RodPhase.AUSTENITE))
        assert self.reaches(messages.HeaterState.ARMED, 2.0)
        self.do(heat_command(short_profile()))
        self.do(messages.StartHeating())
        assert self.until(lambda: self.control.gate, 0.5)


@contextlib.contextmanager
def enabled(**keys: Any) -> Iterator[Platform]:
    with Platform(**keys) as made:
        made.hold()
        yield made


@pytest.fixture
def platform() -> Iterator[Platform]:
    with enabled() as platform:
        yield platform


def test_the_middle_of_the_virtual_rod_gets_its_temperature(platform: Platform) -> None:
    platform.heat()
    assert platform.reaches(messages.HeaterState.HOLDING, 5.0)
    assert platform.reaches(messages.HeaterState.COOLING, 2.0)
    rod = platform.control.rod
    mean = float(np.average(rod.temperature, weights=rod.cell_lengths))
    assert platform.field("mean_temperature") == pytest.approx(mean, abs=3.0)
    # The cold ends have not reached the steady state of the fin by then.
    assert rod.middle_temperature == pytest.approx(510.0, abs=25.0)
    assert platform.reaches(messages.HeaterState.DONE, 20.0)
    for _ in range(2):
        platform.cycle()
    assert not platform.control.relay


# -- heat off, for every row of the table ------------------------------------------------------------------------------

Cause = Callable[[Platform], None]


def contacts(levels: int) -> Cause:
    return lambda platform: setattr(platform.control, "contacts", levels)


def defect(fault: CircuitFault) -> Cause:
    return lambda platform: platform.control.circuit.inject(fault)


def freeze(kind: type[ShapeSetterBox | ShapeSetterMeter]) -> Cause:
    def freeze_inputs(platform: Platform) -> None:
        next(s.device for s in platform.bus.slaves if isinstance(s.device, kind)).freezes += 1

    return freeze_inputs


def change_arm(**fields: Any) -> Cause:
    def change(platform: Platform) -> None:
        for key, value in fields.items():
            setattr(platform.arm, key, value)

    return change


def silence_arm(platform: Platform) -> None:
    platform.arm_follows = False


def lose_answers(cycles: int) -> Cause:
    return lambda platform: platform.data.lose(cycles, heard=True)


def drop_relay(platform: Platform) -> None:
    platform.control.circuit.relay_closed = False


def overcharge(platform: Platform) -> None:
    circuit = platform.control.circuit
    circuit.data = replace(circuit.data, open_voltage=16.5)


def put_in_energy(platform: Platform) -> None:
    platform.process.balance.most_k = 600.0


def change_rod(platform: Platform) -> None:
    rod = platform.control.rod
    platform.control.rod = HeatedRod(rod.alloy, diameter=0.85 * rod.diameter, length=rod.length)


CAUSES: list[tuple[Row, Mode, str, Cause]] = [
    (Row.KEY, Mode.AUTO, "key at Off", contacts(KEY_OFF)),
    (Row.KEY, Mode.AUTO, "key to Manual with the button held", contacts(MANUAL)),
    (Row.KEY, Mode.MANUAL, "key to Auto with the circuit closed", contacts(AUTO)),
    (Row.BUTTON, Mode.MANUAL, "button released", contacts(MANUAL & ~0x0C)),
    (Row.BUTTON, Mode.MANUAL, "one channel of the button", contacts(MANUAL & ~0x04)),
    (Row.ROBOT_CIRCUIT, Mode.AUTO, "circuit open", contacts(CIRCUIT_OPEN)),
    (Row.ROBOT_CIRCUIT, Mode.AUTO, "one channel of the circuit", contacts(ONE_CHANNEL)),
    (Row.ARMS_PERMITTED, Mode.AUTO, "enabling device released in Hand mode", change_arm(motion_allowed=False)),
    (Row.ARMS_ENGAGED, Mode.AUTO, "arm without torque", change_arm(state=State.READY)),
    (Row.ARMS_ENGAGED, Mode.AUTO, "arm in fault", change_arm(state=State.FAULT)),
    (Row.ARMS_ENGAGED, Mode.AUTO, "emergency stop of the arm", change_arm(emergency_stop=True)),
    (Row.PLATFORM, Mode.AUTO, "platform in fault", lose_answers(1000)),
    (Row.COMMANDER, Mode.MANUAL, "lease not renewed", Simulation.fall_silent),
    (Row.KEY_DISCREPANCY, Mode.AUTO, "key at both positions", contacts(AUTO | MANUAL)),
    (Row.BUTTON_DISCREPANCY, Mode.MANUAL, "one channel of the button for long", contacts(MANUAL & ~0x08)),
    (Row.CIRCUIT_DISCREPANCY, Mode.AUTO, "one channel of the circuit for long", contacts(ONE_CHANNEL)),
    (Row.ARM_LOST, Mode.AUTO, "arm silent", silence_arm),
    (Row.RELAY_FEEDBACK, Mode.AUTO, "relay drops out", drop_relay),
    (Row.GATE_FEEDBACK, Mode.AUTO, "gate stuck on", defect(CircuitFault.GATE_STUCK_ON)),
    (Row.FUSE, Mode.AUTO, "fuse blown", defect(CircuitFault.FUSE_BLOWN)),
    (Row.OVER_CURRENT, Mode.AUTO, "rod shorted", defect(CircuitFault.ROD_SHORTED)),
    (Row.OVER_VOLTAGE, Mode.AUTO, "battery of too high a voltage", overcharge),
    (Row.OPEN_CIRCUIT, Mode.AUTO, "power wire broken", defect(CircuitFault.POWER_WIRE_BROKEN)),
    (Row.SHORT_CIRCUIT, Mode.AUTO, "sense wire broken", defect(CircuitFault.SENSE_WIRE_BROKEN)),
    (Row.IMPLAUSIBLE_TEMPERATURE, Mode.AUTO, "another rod", change_rod),
    (Row.STEEP_GRADIENT, Mode.AUTO, "current with an offset", defect(CircuitFault.CURRENT_OFFSET)),
    (Row.INSULATION, Mode.AUTO, "insulation broken", defect(CircuitFault.INSULATION_BROKEN)),
    (Row.LOST_CYCLE, Mode.AUTO, "an answer lost", lose_answers(1)),
    (Row.STALE_INPUT, Mode.AUTO, "box hangs", freeze(ShapeSetterBox)),
    (Row.STALE_INPUT, Mode.AUTO, "meter hangs", freeze(ShapeSetterMeter)),
    (Row.EXCESS_HEAT, Mode.AUTO, "more energy than the rod can have lost", put_in_energy),
]
ENDED_BEFORE = {
    Row.KEY_DISCREPANCY: Row.KEY,
    Row.BUTTON_DISCREPANCY: Row.BUTTON,
    Row.CIRCUIT_DISCREPANCY: Row.ROBOT_CIRCUIT,
    # A reading that jumps is also a temperature that the power does not allow: the first row is named.
    Row.STEEP_GRADIENT: Row.IMPLAUSIBLE_TEMPERATURE,
    # A platform in fault has called `safe` already.
    Row.PLATFORM: Row.NONE,
}
"""Rows before which heat is already off, and what turned it off."""


@pytest.mark.parametrize("rule", TABLE, ids=lambda rule: rule.row.name.lower())
def test_each_row_of_the_table_has_a_cause_on_the_virtual_slaves(rule: Rule) -> None:
    assert any(row is rule.row for row, *_ in CAUSES)


@pytest.mark.parametrize(
    ("row", "mode", "cause"), [(r, m, c) for r, m, _, c in CAUSES], ids=[w for _, _, w, _ in CAUSES]
)
def test_the_virtual_gate_is_off_two_cycles_after_the_cause_was_seen(row: Row, mode: Mode, cause: Cause) -> None:
    # A fault of the platform comes after some lost cycles, which are a row of their own.
    with enabled(lost_cycles=1000 if row is Row.PLATFORM else 1) as platform:
        platform.heat(mode)
        cause(platform)
        for _ in range(3000):
            platform.cycle()
            if not platform.process.interlocks.closed:
                break
        for _ in range(2):
            platform.cycle()
        assert not platform.control.gate
        assert not platform.control.relay
        assert platform.process.interlocks.cause is ENDED_BEFORE.get(row, row)
        if row in ENDED_BEFORE:
            interlocks, holds = platform.process.interlocks, platform.process.supervision
            assert platform.until(lambda: bool(interlocks.forbids(holds.holds) >> row & 1), 0.2)
        for _ in range(100):
            platform.cycle()
            assert not platform.control.gate
            assert not platform.control.relay


@pytest.mark.parametrize("command", [messages.StopHeating(), Halt(), Disable()], ids=lambda command: command.name)
def test_stop_halt_and_disable_turn_the_virtual_gate_off_within_two_cycles(
    platform: Platform, command: messages.StopHeating | Halt | Disable
) -> None:
    platform.heat()
    platform.do(command)
    for _ in range(2):
        platform.cycle()
    assert not platform.control.gate
    assert not platform.control.relay


def test_the_green_lamp_stays_on_in_a_fault_of_the_platform() -> None:
    with enabled(lost_cycles=1000) as platform:
        assert platform.until(lambda: bool(platform.control.lamp_green), 0.1)
        lose_answers(1000)(platform)
        assert platform.until(lambda: platform.loop.machine.state is State.FAULT, 5.0)
        for _ in range(100):
            platform.cycle()
            assert platform.control.lamp_green


def test_a_gate_that_sticks_is_cut_off_by_the_relay(platform: Platform) -> None:
    platform.heat()
    platform.control.circuit.inject(CircuitFault.GATE_STUCK_ON)
    assert platform.reaches(messages.HeaterState.TRIPPED, 1.0)
    assert platform.field("cause") in (Row.GATE_FEEDBACK, Row.STEEP_GRADIENT)
    assert platform.until(lambda: platform.control.circuit.current == 0.0, 0.05)
