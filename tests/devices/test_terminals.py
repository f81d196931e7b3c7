from __future__ import annotations

from typing import Literal

import pytest

from rtcp.config.model import EmergencyStopConfig, GripperConfig, InputConfig, InputsConfig, Level, OutputsConfig
from rtcp.devices.io_box import Inputs, Outputs, Switch

CYCLE = 0.0005
ALL = InputsConfig(
    arm_toggle=InputConfig(9), enabling_switch=InputConfig(11), emergency_stop=EmergencyStopConfig(10, active="low")
)


def read(switch: Switch | Inputs, levels: int, cycles: int) -> bool:
    switches = (
        [switch] if isinstance(switch, Switch) else [switch.arm_toggle, switch.enabling_switch, switch.emergency_stop]
    )
    for _ in range(cycles):
        for each in switches:
            each.read(levels)
    return switches[0].active


def test_before_the_box_has_been_heard_the_stop_is_pressed_and_nothing_is_permitted() -> None:
    inputs = Inputs(ALL, CYCLE)
    assert inputs.emergency_stop.active
    assert not inputs.enabling_switch.active
    assert not inputs.arm_toggle.active


def test_what_is_not_there_forbids_nothing() -> None:
    inputs = Inputs(InputsConfig(), CYCLE)
    for levels in (0, 0xFFFF):
        read(inputs, levels, 30)
        assert not inputs.emergency_stop.active
        assert inputs.enabling_switch.active
        assert inputs.arm_toggle.active


def test_each_switch_has_its_own_terminal_and_polarity() -> None:
    inputs = Inputs(ALL, CYCLE)
    read(inputs, 1 << 9, 30)
    assert (inputs.emergency_stop.active, inputs.enabling_switch.active, inputs.arm_toggle.active) == (0, 0, 0)
    read(inputs, 1 << 8, 30)
    assert (inputs.emergency_stop.active, inputs.enabling_switch.active, inputs.arm_toggle.active) == (1, 0, 1)
    read(inputs, 1 << 10, 30)
    assert (inputs.emergency_stop.active, inputs.enabling_switch.active, inputs.arm_toggle.active) == (1, 1, 0)


@pytest.mark.parametrize("active", ["high", "low"])
def test_a_level_counts_once_it_has_lasted_and_a_shorter_one_never(active: Level) -> None:
    on, off = (1, 0) if active == "high" else (0, 1)
    switch = Switch(InputConfig(1, active, debounce_ms=5.0), False, CYCLE)
    assert not read(switch, off, 20)
    assert not read(switch, on, 10)
    assert not read(switch, off, 20)
    assert not read(switch, on, 10)
    assert read(switch, on, 1)
    assert read(switch, off, 10)
    assert not read(switch, off, 1)


def test_without_debounce_a_level_counts_at_once() -> None:
    switch = Switch(InputConfig(1, debounce_ms=0.0), False, CYCLE)
    assert read(switch, 1, 1)
    assert not read(switch, 0, 1)


def test_lines_that_never_come_to_rest_take_the_permission_and_press_the_stop() -> None:
    inputs = Inputs(ALL, CYCLE)
    read(inputs, 1 << 10 | 1 << 9 | 1 << 8, 30)
    assert inputs.enabling_switch.active
    assert inputs.arm_toggle.active
    assert not inputs.emergency_stop.active
    for cycle in range(60):
        read(inputs, 0 if cycle & 1 else 0xFFFF, 1)
    assert not inputs.enabling_switch.active
    assert not inputs.arm_toggle.active
    assert inputs.emergency_stop.active


def test_lamps_follow_and_the_heartbeat_toggles_and_other_outputs_stay() -> None:
    outputs = Outputs(OutputsConfig(state_lamp=1, motion_lamp=2, heartbeat=3), None)
    word = 0xFF00
    word = outputs.write(word, powered=True, moving=False)
    assert word == 0xFF05
    word = outputs.write(word, powered=True, moving=True)
    assert word == 0xFF03
    word = outputs.write(word, powered=False, moving=False)
    assert word == 0xFF04


def test_without_outputs_nothing_is_written() -> None:
    outputs = Outputs(OutputsConfig(), None)
    assert outputs.write(0xA5A5, powered=True, moving=True) == 0xA5A5
    assert outputs.grip(0xA5A5, close=True) == 0xA5A5


@pytest.mark.parametrize(("closed", "of_closed", "of_open"), [("on", 0x18, 0x10), ("off", 0x10, 0x18)])
def test_the_gripper_has_the_state_that_closes_it(closed: Literal["on", "off"], of_closed: int, of_open: int) -> None:
    outputs = Outputs(OutputsConfig(), GripperConfig(output=4, closed=closed))
    for word in (0x10, 0x18):
        assert outputs.grip(word, close=True) == of_closed
        assert outputs.grip(word, close=False) == of_open
