"""Two IO boxes on the in-process bus: every function works on the box that its key `box` names."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.config import load
from rtcp.ipc.commands import MoveGripper, MoveJoints, SetControlMode, SetOutput
from rtcp.ipc.events import EmergencyStopActivated, GripperOpens, PermissionWithdrawn
from rtcp.ipc.refusals import ReservedOutput, UnknownBox
from rtcp.ipc.states import ControlMode, State
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models import DiewuIoBox
from tests.two_boxes import SWITCH, two_boxes

STATE_LAMP, MOTION_LAMP, HEARTBEAT, GRIPPER = (1 << bit for bit in range(4))
"""Outputs of `desk`."""
FORWARD, MODE_DOWN, TOGGLE, STOP = 0, 5, 8, 9
"""Channels of `io`, from 0: a direction and a paddle of the joystick, active low; toggle; emergency stop, closed."""
SOMEWHERE = (0.0, -0.5, 1.8, 0.0, 1.2, 0.0)


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[Simulation]:
    """Enabled, the enabling switch pressed."""
    with Simulation(load(two_boxes(tmp_path)), follow_clock=False) as made:
        desk(made).set_input(SWITCH - 1, True)
        made.hold()
        yield made


def io(arm: Simulation) -> DiewuIoBox:
    device = arm.bus.slaves[0].device
    assert isinstance(device, DiewuIoBox)
    return device


def desk(arm: Simulation) -> DiewuIoBox:
    device = arm.bus.slaves[-1].device
    assert isinstance(device, DiewuIoBox)
    return device


def move(arm: Simulation) -> None:
    arm.do(MoveJoints((0.5, *SOMEWHERE[1:]), speed=0.3, synchronized=True))
    arm.run(0.3)
    assert arm.state is State.MOVING


def lose_desk(arm: Simulation) -> None:
    """Cut the cable before the last slave."""
    arm.bus.segment.topology.cut(len(arm.bus.slaves) - 1)
    arm.bus.segment.rewire()


def test_lamps_and_gripper_are_switched_at_the_box_that_they_name(arm: Simulation) -> None:
    arm.run(0.01)
    assert desk(arm).outputs & ~HEARTBEAT == STATE_LAMP
    move(arm)
    assert desk(arm).outputs & ~HEARTBEAT == STATE_LAMP | MOTION_LAMP
    arm.do(MoveGripper(open=False))
    arm.run(0.01)
    assert desk(arm).outputs & GRIPPER
    assert io(arm).outputs == 0


def test_an_output_of_either_box_is_switched_and_both_are_in_the_record(arm: Simulation) -> None:
    arm.do(SetOutput(1, True, 0))
    arm.do(SetOutput(16, True, 1))
    arm.run(0.01)
    assert io(arm).outputs == 1
    assert desk(arm).outputs & ~HEARTBEAT == 1 << 15 | STATE_LAMP
    (record,) = arm.observer.latest()
    assert record["io_outputs"] == 1
    assert int(record["desk_outputs"]) & ~HEARTBEAT == 1 << 15 | STATE_LAMP
    assert record["io_inputs"] == 0x033F
    assert record["desk_inputs"] == 1 << SWITCH - 1


def test_a_number_has_a_function_at_its_own_box_alone(arm: Simulation) -> None:
    assert arm.send(SetOutput(4, True, 1)).refusal == ReservedOutput(4)
    arm.do(SetOutput(4, True, 0))
    assert arm.send(SetOutput(4, True, 2)).refusal == UnknownBox(3, 2)


def test_the_enabling_switch_at_the_second_box_stops_the_arm_and_the_same_input_of_the_first_does_not(
    arm: Simulation,
) -> None:
    move(arm)
    io(arm).set_input(SWITCH - 1, False)
    arm.run(0.05)
    assert arm.state is State.MOVING
    desk(arm).set_input(SWITCH - 1, False)
    arm.bring_to(State.HOLDING, 1.0)
    assert PermissionWithdrawn() in [record.event for record in arm.events]


def test_the_joystick_at_the_first_box_jogs_the_arm(arm: Simulation) -> None:
    arm.do(SetControlMode(ControlMode.JOYSTICK))
    arm.run(0.1)
    io(arm).set_input(FORWARD, False)
    arm.bring_to(State.MOVING, 0.5)
    io(arm).set_input(FORWARD, True)
    arm.bring_to(State.HOLDING, 2.0)


@pytest.mark.parametrize("without", ["enabling switch", "toggle"])
@pytest.mark.parametrize("modes_down", [0, 1], ids=["tool", "gripper"])
def test_without_enabling_switch_or_toggle_the_joystick_neither_moves_the_arm_nor_grips_and_begins_with_neutral(
    arm: Simulation, modes_down: int, without: str
) -> None:
    arm.do(SetControlMode(ControlMode.JOYSTICK))
    for _ in range(modes_down):
        for level in (False, True):
            io(arm).set_input(MODE_DOWN, level)
            arm.run(0.05)
    q, begun = list(arm.loop.arm.state.commanded), len(arm.events)
    box, channel = (desk(arm), SWITCH - 1) if without == "enabling switch" else (io(arm), TOGGLE)
    states: set[State] = set()
    arm.on_frame = lambda frame: states.add(arm.state)

    def shown(pressed: bool, level: bool) -> None:
        box.set_input(channel, pressed)
        arm.run(0.05)
        io(arm).set_input(FORWARD, level)
        arm.run(0.05)

    shown(pressed=False, level=True)
    shown(pressed=False, level=False)
    shown(pressed=True, level=False)
    assert states == {State.HOLDING}
    assert list(arm.loop.arm.state.commanded) == q
    assert GripperOpens() not in [record.event for record in arm.events[begun:]]
    shown(pressed=True, level=True)
    shown(pressed=True, level=False)
    assert [record.event for record in arm.events[begun:]].count(GripperOpens()) == modes_down
    assert (State.MOVING in states) is (modes_down == 0)


def test_an_emergency_stop_pressed_while_the_other_box_is_lost_still_stops_the_arm(arm: Simulation) -> None:
    move(arm)
    lose_desk(arm)
    io(arm).set_input(STOP, False)
    arm.run(0.012)
    assert arm.state is State.EMERGENCY_STOP, "before the missing frames become a fault of their own"
    assert any(isinstance(record.event, EmergencyStopActivated) for record in arm.events)


def test_the_outputs_of_the_box_that_is_lost_are_cleared_and_the_others_stay(arm: Simulation) -> None:
    arm.do(MoveGripper(open=False))
    arm.do(SetOutput(5, True, 0))
    lose_desk(arm)
    arm.bring_to(State.FAULT, 2.0)
    arm.run(0.2)
    assert io(arm).outputs == 1 << 4
    assert not int.from_bytes(arm.data.outputs[-1], "little") & GRIPPER
