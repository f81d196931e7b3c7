"""The joystick, the toggle and the modes through the whole loop, in simulated time (bus `inprocess`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from kinematics import forward
from rtcp.config import default_config, load
from rtcp.ipc.commands import (
    Command,
    Disable,
    Enable,
    Halt,
    Home,
    Jog,
    MoveJoints,
    Reset,
    SetControlMode,
    Shutdown,
    StreamPosition,
)
from rtcp.ipc.events import Event, UnknownJoystickCode
from rtcp.ipc.refusals import WrongControlMode
from rtcp.ipc.states import ControlMode, JogFrame, State
from rtcp.launch.simulation import Simulation
from rtcp.telemetry.experiments.motions import BACKWARD, FORWARD, LEFT, NEUTRAL, PADDLE_UP

CONFIG = load(default_config())
TOGGLE = 0x100
START = (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)


class Arm:
    """A simulation in the control mode joystick, and what is seen of it."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation

    @property
    def tool(self) -> tuple[float, float, float]:
        assert CONFIG.arm is not None
        return forward(CONFIG.arm, self.simulation.loop.arm.state.commanded).position

    def joystick(self, code: int, seconds: float, *, toggle: bool = True) -> None:
        box = self.simulation.box
        assert box is not None
        box.inputs = box.inputs & ~0x1FF | code | (TOGGLE if toggle else 0)
        self.simulation.run(seconds)

    @property
    def kinds(self) -> list[type[Event]]:
        return [type(record.event) for record in self.simulation.events]


@pytest.fixture
def arm() -> Iterator[Arm]:
    config = replace(CONFIG, control_mode="joystick", cycle=replace(CONFIG.cycle, period_us=2000.0))
    with Simulation(config, seed=3, positions=START) as simulation:
        assert simulation.until(lambda: simulation.state is State.READY, 5.0)
        simulation.run(0.1)
        simulation.acquire()
        assert simulation.send(Enable()).refusal is None
        assert simulation.until(lambda: simulation.state is State.HOLDING, 5.0)
        simulation.run(0.1)
        yield Arm(simulation)


def test_a_motion_lasts_for_as_long_as_the_joystick_is_held(arm: Arm) -> None:
    before = arm.tool
    arm.joystick(BACKWARD, 0.8)
    assert arm.simulation.state is State.MOVING
    arm.joystick(NEUTRAL, 0.6)
    assert arm.simulation.state is State.HOLDING
    after = arm.tool
    assert after[0] < before[0] - 0.03
    assert after[1:] == pytest.approx(before[1:], abs=1e-4)
    arm.joystick(NEUTRAL, 0.5)
    assert arm.tool == after


def test_two_directions_at_once_go_diagonally(arm: Arm) -> None:
    before = arm.tool
    arm.joystick(BACKWARD & LEFT, 0.8)
    arm.joystick(NEUTRAL, 0.6)
    way = [b - a for a, b in zip(before, arm.tool, strict=True)]
    assert way[0] < -0.03
    assert way[1] == pytest.approx(-way[0], rel=0.05)
    assert way[2] == pytest.approx(0.0, abs=1e-4)


def test_a_joystick_that_is_deflected_when_the_arm_is_enabled_does_nothing_until_neutral(arm: Arm) -> None:
    simulation = arm.simulation
    simulation.send(Disable())
    assert simulation.until(lambda: simulation.state is State.READY, 5.0)
    arm.joystick(BACKWARD, 0.2)
    simulation.send(Enable())
    assert simulation.until(lambda: simulation.state is State.HOLDING, 5.0)
    before = arm.tool
    arm.joystick(BACKWARD, 1.0)
    assert arm.tool == before
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(BACKWARD, 0.5)
    assert simulation.state is State.MOVING


def test_a_byte_that_is_no_code_stops_the_motion_until_neutral(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.5)
    arm.joystick(FORWARD & BACKWARD, 1.0)
    assert arm.simulation.state is State.HOLDING
    assert UnknownJoystickCode in arm.kinds
    rest = arm.tool
    arm.joystick(BACKWARD, 0.5)
    assert arm.tool == rest
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(BACKWARD, 0.5)
    assert arm.simulation.state is State.MOVING


def test_the_toggle_gives_the_joystick_to_the_chair_and_the_arm_holds_still(arm: Arm) -> None:
    arm.joystick(BACKWARD, 0.5)
    arm.joystick(BACKWARD, 1.0, toggle=False)
    assert arm.simulation.state is State.HOLDING
    rest = arm.tool
    arm.joystick(FORWARD, 1.0, toggle=False)
    assert arm.tool == rest
    # Given back while it is deflected: it counts from its neutral position on.
    arm.joystick(FORWARD, 0.5)
    assert arm.tool == rest
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(FORWARD, 0.5)
    assert arm.tool[0] > rest[0] + 0.01


def test_a_paddle_changes_the_mode_when_it_is_released(arm: Arm) -> None:
    operator = arm.simulation.loop.operator
    arm.joystick(PADDLE_UP, 0.3)
    assert operator.joystick_mode == 0
    arm.joystick(NEUTRAL, 0.1)
    assert operator.joystick_mode == 1
    before = arm.tool
    arm.joystick(BACKWARD, 0.6)
    arm.joystick(NEUTRAL, 0.5)
    assert arm.tool[2] > before[2] + 0.02


@pytest.mark.parametrize("command", [MoveJoints(START, 0.2, True), StreamPosition(START, 0.2)], ids=["move", "stream"])
def test_under_the_joystick_nobody_else_moves_the_arm(arm: Arm, command: Command) -> None:
    assert isinstance(arm.simulation.send(command).refusal, WrongControlMode)
    assert arm.simulation.state is State.HOLDING


def test_the_joystick_moves_nothing_in_another_motion_mode(arm: Arm) -> None:
    arm.joystick(NEUTRAL, 0.1)
    assert arm.simulation.send(SetControlMode(ControlMode.JOINT)).refusal is None
    before = arm.tool
    arm.joystick(BACKWARD, 1.0)
    assert arm.tool == before


def test_the_emergency_stop_ends_a_jog_without_a_jump(arm: Arm) -> None:
    simulation = arm.simulation
    arm.joystick(BACKWARD, 0.6)
    assert simulation.box is not None
    simulation.box.inputs &= ~0x200
    simulation.run(1.5)
    assert simulation.state is State.EMERGENCY_STOP
    assert max(map(abs, simulation.loop.arm.state.actual_velocity)) < 0.01
    assert simulation.loop.joints.first_with_torque() == -1
    simulation.run(0.2)
    assert {slave.state.name for slave in simulation.bus.read_states()} == {"PREOP"}


def test_a_halt_stops_a_held_joystick_until_it_has_been_neutral(arm: Arm) -> None:
    simulation = arm.simulation
    arm.joystick(BACKWARD, 0.5)
    assert simulation.send(Halt()).refusal is None
    simulation.run(2.0)
    assert simulation.state is State.HOLDING
    arm.joystick(NEUTRAL, 0.1)
    arm.joystick(BACKWARD, 0.3)
    assert simulation.state is State.MOVING


@pytest.mark.parametrize(
    "command", [Jog((0.02, 0.0, 0.0, 0.0, 0.0, 0.0), JogFrame.BASE, 0.5), Home(0)], ids=["jog", "home"]
)
def test_no_command_takes_the_arm_away_from_the_joystick(arm: Arm, command: Command) -> None:
    assert arm.simulation.send(command).refusal is not None
    arm.joystick(BACKWARD, 0.3)
    assert arm.simulation.send(command).refusal is not None
    arm.joystick(NEUTRAL, 0.6)
    assert arm.simulation.state is State.HOLDING


def test_the_emergency_stop_is_met_while_the_loop_closes(arm: Arm) -> None:
    simulation = arm.simulation
    arm.joystick(BACKWARD, 0.6)
    simulation.send(Shutdown())
    assert simulation.box is not None
    simulation.box.inputs &= ~0x200
    simulation.run(0.05)
    assert {drive.controlword for drive in simulation.loop.arm.drives} == {0x0002}
    assert simulation.until(lambda: simulation.done, 5.0)
    assert simulation.loop.joints.first_with_torque() == -1


def test_the_joystick_moves_the_arm_again_after_a_fault_that_came_while_it_did(arm: Arm) -> None:
    simulation = arm.simulation
    arm.joystick(BACKWARD, 0.5)
    assert simulation.state is State.MOVING
    simulation.models[1].inject_fault(0x8611)
    assert simulation.until(lambda: simulation.state is State.FAULT, 1.0)
    arm.joystick(NEUTRAL, 1.0)
    assert simulation.send(Reset()).refusal is None
    assert simulation.until(lambda: simulation.state is State.READY, 5.0)
    assert simulation.send(Enable()).refusal is None
    assert simulation.until(lambda: simulation.state is State.HOLDING, 5.0)
    arm.joystick(NEUTRAL, 0.2)
    before = arm.tool
    arm.joystick(BACKWARD, 0.5)
    assert simulation.state is State.MOVING
    assert arm.tool[0] < before[0] - 0.01
