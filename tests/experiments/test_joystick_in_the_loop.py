"""The joystick, the toggle and the modes through the whole loop, in simulated time (bus `inprocess`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from kinematics import forward
from rtcp.config import default_config, load
from rtcp.config.model import AnalogStickConfig, StickAxisConfig
from rtcp.config.segment import SegmentConfig, SegmentSlave, load_segment
from rtcp.devices import Cia402Drive
from rtcp.ipc import commands
from rtcp.ipc.events import (
    Event,
    GripperCloses,
    GripperOpens,
    JoystickModeChanged,
    JoystickOutOfRange,
    UnknownJoystickCode,
)
from rtcp.ipc.refusals import WrongControlMode
from rtcp.ipc.states import ControlMode, JogFrame, State
from rtcp.telemetry.experiments.picks import BACKWARD, FORWARD, LEFT, NEUTRAL, PADDLE_UP
from rtcp.testing import Simulation
from rtcp.virtual.models.diewu import DiewuIoBox

CONFIG = load(default_config())
TOGGLE = 0x100
START = (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)


class Arm(Simulation):
    """An arm in control mode joystick."""

    @property
    def tool(self) -> tuple[float, float, float]:
        assert CONFIG.arm is not None
        return forward(CONFIG.arm, self.loop.arm.state.commanded).position

    def joystick(self, code: int, seconds: float, *, toggle: bool = True) -> None:
        box = self.box
        assert box is not None
        box.inputs = box.inputs & ~0x1FF | code | (TOGGLE if toggle else 0)
        self.run(seconds)

    @property
    def kinds(self) -> list[type[Event]]:
        return [type(record.event) for record in self.events]


@pytest.fixture
def arm() -> Iterator[Arm]:
    config = replace(CONFIG, control_mode="joystick", cycle=replace(CONFIG.cycle, period_us=2000.0))
    with Arm(config, seed=3, positions=START) as made:
        made.hold()
        made.run(0.1)
        yield made


def test_a_motion_lasts_for_as_long_as_the_joystick_is_held(arm: Arm) -> None:
    before = arm.tool
    arm.joystick(BACKWARD, 0.8)
    assert arm.state is State.MOVING
    arm.joystick(NEUTRAL, 0.6)
    assert arm.state is State.HOLDING
    after = arm.tool
    assert after[0] < before[0] - 0.03
    assert after[1:] == pytest.approx(before[1:], abs=1e-4)
    arm.joystick(NEUTRAL, 0.5)
    assert arm.tool == after


def test_two_directions_at_once_go_diagonally(arm: Arm) -> None:
    before = arm.tool
    arm.joystick(BACKWARD & LEFT, 0.8)
    arm.joystick(NEUTRAL, 0.6)
    shift = [b - a for a, b in zip(before, arm.tool, strict=True)]
    assert shift[0] < -0.03
    assert shift[1] == pytest.approx(-shift[0], rel=0.05)
    assert shift[2] == pytest.approx(0.0, abs=1e-4)


def test_a_joystick_that_is_deflected_when_the_arm_is_enabled_does_nothing_until_neutral(arm: Arm) -> None:
    arm.send(commands.Disable())
    arm.bring_to(State.READY)
    arm.joystick(BACKWARD, 0.2)
    arm.hold()
    before = arm.tool
    arm.joystick(BACKWARD, 1.0)
    assert arm.tool == before
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(BACKWARD, 0.5)
    assert arm.state is State.MOVING


def test_a_byte_that_is_no_code_stops_the_motion_until_neutral(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.5)
    arm.joystick(FORWARD & BACKWARD, 1.0)
    assert arm.state is State.HOLDING
    assert UnknownJoystickCode in arm.kinds
    rest = arm.tool
    arm.joystick(BACKWARD, 0.5)
    assert arm.tool == rest
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(BACKWARD, 0.5)
    assert arm.state is State.MOVING


def test_the_toggle_gives_the_joystick_to_the_chair_and_the_arm_holds_still(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.5)
    arm.joystick(BACKWARD, 1.0, toggle=False)
    assert arm.state is State.HOLDING
    rest = arm.tool
    arm.joystick(FORWARD, 1.0, toggle=False)
    assert arm.tool == rest
    # Returned to the arm while deflected: the joystick counts only after its neutral position.
    arm.joystick(FORWARD, 0.5)
    assert arm.tool == rest
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(FORWARD, 0.5)
    assert arm.tool[0] > rest[0] + 0.01


def test_a_paddle_changes_the_mode_when_it_is_released(arm: Arm) -> None:
    operator = arm.loop.operator
    arm.joystick(PADDLE_UP, 0.3)
    assert operator.joystick_mode == 0
    arm.joystick(NEUTRAL, 0.1)
    assert operator.joystick_mode == 1
    before = arm.tool
    arm.joystick(BACKWARD, 0.6)
    arm.joystick(NEUTRAL, 0.5)
    assert arm.tool[2] > before[2] + 0.02


@pytest.mark.parametrize(
    "between",
    [
        [commands.SetControlMode(ControlMode.JOINT), commands.SetControlMode(ControlMode.JOYSTICK)],
        [commands.SetControlMode(ControlMode.JOYSTICK)],
        [commands.Disable()],
    ],
    ids=["from another mode", "again", "enabled anew"],
)
def test_the_joystick_begins_with_x_y_where_its_last_mode_was_the_gripper(
    arm: Arm, between: list[commands.Command]
) -> None:
    for _ in range(3):
        arm.joystick(PADDLE_UP, 0.1)
        arm.joystick(NEUTRAL, 0.1)
    assert arm.loop.operator.joystick_mode == 3
    for command in between:
        arm.do(command)
    if arm.state is not State.HOLDING:
        arm.hold()
    before = arm.tool
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(BACKWARD, 0.5)
    assert JoystickModeChanged(0) in [record.event for record in arm.events]
    assert not {GripperOpens, GripperCloses} & set(arm.kinds)
    assert arm.tool[0] < before[0] - 0.01


@pytest.mark.parametrize(
    "command", [commands.MoveJoints(START, 0.2, True), commands.StreamPosition(START, 0.2)], ids=["move", "stream"]
)
def test_under_the_joystick_nobody_else_moves_the_arm(arm: Arm, command: commands.Command) -> None:
    assert isinstance(arm.send(command).refusal, WrongControlMode)
    assert arm.state is State.HOLDING


def test_the_joystick_moves_nothing_in_another_motion_mode(arm: Arm) -> None:
    arm.joystick(NEUTRAL, 0.1)
    arm.do(commands.SetControlMode(ControlMode.JOINT))
    before = arm.tool
    arm.joystick(BACKWARD, 1.0)
    assert arm.tool == before


def test_the_emergency_stop_ends_a_jog_without_a_jump(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.6)
    assert arm.box is not None
    arm.box.inputs &= ~0x200
    arm.run(1.5)
    assert arm.state is State.EMERGENCY_STOP
    assert max(map(abs, arm.loop.arm.state.actual_velocity)) < 0.01
    assert arm.loop.joints.first_with_torque() == -1
    arm.run(0.2)
    assert {slave.state.name for slave in arm.bus.read_states()} == {"PREOP"}


def test_a_halt_stops_a_held_joystick_until_it_has_been_neutral(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.5)
    arm.do(commands.Halt())
    arm.run(2.0)
    assert arm.state is State.HOLDING
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(BACKWARD, 0.3)
    assert arm.state is State.MOVING


@pytest.mark.parametrize(
    "command",
    [commands.Jog((0.02, 0.0, 0.0, 0.0, 0.0, 0.0), JogFrame.BASE, 0.5), commands.Home(0)],
    ids=["jog", "home"],
)
def test_no_command_takes_the_arm_away_from_the_joystick(arm: Arm, command: commands.Command) -> None:
    assert arm.send(command).refusal is not None
    arm.joystick(BACKWARD, 0.3)
    assert arm.send(command).refusal is not None
    arm.joystick(NEUTRAL, 0.6)
    assert arm.state is State.HOLDING


def test_the_emergency_stop_is_met_while_the_loop_closes(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.6)
    arm.send(commands.Shutdown())
    assert arm.box is not None
    arm.box.inputs &= ~0x200
    arm.run(0.05)
    assert {drive.controlword for drive in arm.loop.arm.drives if isinstance(drive, Cia402Drive)} == {0x0002}
    assert arm.until(lambda: arm.done, 5.0)
    assert arm.loop.joints.first_with_torque() == -1


def test_the_joystick_moves_the_arm_again_after_a_fault_that_came_while_it_did(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.5)
    assert arm.state is State.MOVING
    arm.models[1].inject_fault(0x8611)
    arm.bring_to(State.FAULT, 1.0)
    arm.joystick(NEUTRAL, 1.0)
    arm.do(commands.Reset())
    arm.hold()
    arm.joystick(NEUTRAL, 0.2)
    before = arm.tool
    arm.joystick(BACKWARD, 0.5)
    assert arm.state is State.MOVING
    assert arm.tool[0] < before[0] - 0.01


REST, FULL = 0x8000, 0x5000
"""Counts of the stick's channels at rest, and from there to the full inclination."""


class ArmWithStick(Arm):
    """An arm whose stick is on two analog channels: a second IO box plays the converter."""

    def incline(self, forward: float, seconds: float) -> None:
        converter = [slave.device for slave in self.bus.slaves if isinstance(slave.device, DiewuIoBox)][1]
        converter.inputs = round(REST + forward * FULL)
        self.run(seconds)

    @property
    def speed(self) -> float:
        """Speed of the tool along x, m/s."""
        before = self.tool[0]
        self.run(0.1)
        return (self.tool[0] - before) / 0.1


@pytest.fixture
def stick() -> Iterator[ArmWithStick]:
    converter = replace(CONFIG.slaves[0], name="adc", device=replace(CONFIG.slaves[0].device, kind="generic"))
    analog = AnalogStickConfig(StickAxisConfig("adc.inputs", REST, FULL), StickAxisConfig("adc.counter", 0.0, 1000.0))
    assert CONFIG.inputs.joystick is not None
    inputs = replace(CONFIG.inputs, joystick=replace(CONFIG.inputs.joystick, analog=analog))
    slaves = load_segment(CONFIG.source.parent / "segment.yaml").slaves
    adc = SegmentSlave("diewu-io", options={"inputs": REST})
    config = replace(
        CONFIG,
        control_mode="joystick",
        inputs=inputs,
        slaves=(*CONFIG.slaves, converter),
        cycle=replace(CONFIG.cycle, period_us=2000.0),
    )
    segment = SegmentConfig((*slaves, adc), CONFIG.source)
    with ArmWithStick(config, seed=3, positions=START, segment=segment) as made:
        made.hold()
        made.run(0.1)
        yield made


def test_the_speed_of_the_arm_follows_the_inclination_of_an_analog_stick(stick: ArmWithStick) -> None:
    stick.incline(-1.0, 0.6)
    assert stick.speed == pytest.approx(-CONFIG.jog.speed, rel=0.02)
    stick.incline(-0.55, 0.6)
    assert stick.speed == pytest.approx(-0.5 * CONFIG.jog.speed, rel=0.02)
    stick.incline(0.0, 0.6)
    assert stick.state is State.HOLDING


def test_an_analog_stick_that_is_inclined_at_the_start_or_whose_wire_was_cut_does_nothing_until_neutral(
    stick: ArmWithStick,
) -> None:
    stick.send(commands.Disable())
    stick.bring_to(State.READY)
    stick.incline(-1.0, 0.1)
    stick.hold()
    before = stick.tool
    stick.incline(-1.0, 0.5)
    assert stick.tool == before
    stick.incline(0.0, 0.1)
    stick.incline(-1.0, 0.4)
    assert stick.state is State.MOVING
    stick.incline(-1.5, 1.0)
    assert stick.state is State.HOLDING
    assert JoystickOutOfRange in stick.kinds
    rest = stick.tool
    stick.incline(-1.0, 0.5)
    assert stick.tool == rest
