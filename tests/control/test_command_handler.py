"""Every command in every state: accepted, or refused with its reason; and what each command is checked for."""

from __future__ import annotations

import time
from math import inf, nan

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import (
    ApplyTorque,
    Command,
    Disable,
    Enable,
    Halt,
    Home,
    Jog,
    MoveAtVelocity,
    MoveGripper,
    MoveJoints,
    Reset,
    RunLines,
    RunTrajectory,
    SetControlMode,
    SetDriveMode,
    SetLimits,
    SetOutput,
    SetZero,
    Shutdown,
    StreamPosition,
)
from rtcp.ipc.observer import Observer
from rtcp.ipc.refusals import (
    ClockNotLocked,
    DamagedRow,
    DriveModeChanging,
    EmergencyStopPressed,
    JointOutsideRange,
    Malformed,
    NoGeometry,
    NoLease,
    NoOutputs,
    NotAtStandstill,
    NotFinite,
    NotInOp,
    NoTrajectory,
    PlanStartsElsewhere,
    PositionOutOfRange,
    Refusal,
    SpeedOutOfRange,
    UnknownOutput,
    WrongControlMode,
    WrongCount,
    WrongRowCount,
    WrongState,
)
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

from .rig import CONFIG, COUNTS, CSP, CST, CSV, PERIOD_S, SPEED, LoopRig, move_to

# Which command (x) is accepted where, written down a second time: a slip in `states` of a command shows here.
TABLE = """
                starting ready enabling holding moving stopping limit homing disabling fault emergency resetting closing
enable               .       x      .        .      .       .       .     .        .       .       .         .        .
disable              .       x      x        x      x       x       x     x        x       x       x         x        .
reset                .       .      .        .      .       .       x     .        .       x       x         .        .
set_drive_mode       .       x      .        x      .       .       .     .        .       .       .         .        .
set_control_mode     .       x      .        x      .       .       .     .        .       .       .         .        .
move_joints          .       .      .        x      x       .       .     .        .       .       .         .        .
run_trajectory       .       .      .        x      x       .       .     .        .       .       .         .        .
run_lines            .       .      .        x      x       .       .     .        .       .       .         .        .
stream_position      .       .      .        x      x       .       .     .        .       .       .         .        .
jog                  .       .      .        x      x       .       .     .        .       .       .         .        .
move_at_velocity     .       .      .        x      x       .       .     .        .       .       .         .        .
apply_torque         .       .      .        x      x       .       .     .        .       .       .         .        .
halt                 .       .      .        x      x       x       x     x        .       .       .         .        .
set_output           .       x      x        x      x       x       x     x        .       x       .         .        .
move_gripper         .       x      .        x      x       x       x     .        .       .       .         .        .
set_limits           .       x      .        x      x       .       x     .        .       x       x         .        .
set_zero             .       x      .        .      .       .       .     .        .       .       .         .        .
home                 .       .      .        x      .       .       .     .        .       .       .         .        .
shutdown             x       x      x        x      x       x       x     x        x       x       x         x        x
"""
_HEAD, *_ROWS = [line.split() for line in TABLE.strip().splitlines()]
_SHORT = {"LIMIT": "STOPPED_BY_LIMIT", "EMERGENCY": "EMERGENCY_STOP"}
COMMANDS: dict[str, Command] = {
    command.name: command
    for command in (
        Enable(), Disable(), Reset(), SetDriveMode(DriveMode.CSP), SetControlMode(ControlMode.JOINT), move_to(0.1, 0.1),
        RunTrajectory(0, 1), RunLines(0, 1), StreamPosition((0.0, 0.0), 0.0), Jog((0.0, 0.0), JogFrame.JOINTS, 0.2),
        MoveAtVelocity((0.0, 0.0), 0.2), ApplyTorque((0.0, 0.0), 0.0, 0.0, 0.2), Halt(), SetOutput(5, True),
        MoveGripper(False), SetLimits(0, 1), SetZero(0, 0.0), Home(0), Shutdown(),
    )
}  # fmt: skip
"""One of each kind, with fields that nobody could refuse."""
PAIRS = [
    (COMMANDS[row[0]], State[_SHORT.get(state.upper(), state.upper())], mark == "x")
    for row in _ROWS
    for state, mark in zip(_HEAD, row[1:], strict=True)
]
HEARTBEAT = 0x0004
"""Output 3, which is toggled each cycle."""
STATES = set(State) - {State.OFF}
"""Off is what a loop is that does not run."""
SAFER = {"disable", "halt", "shutdown"}
WITH_LEASE = [command for command in COMMANDS.values() if command.name not in SAFER]
FOR_OTHER_REASONS: dict[type[Command], tuple[type[Refusal], ...]] = {
    RunTrajectory: (DamagedRow, PlanStartsElsewhere),
    RunLines: (NoGeometry,),
    MoveAtVelocity: (WrongControlMode,),
    ApplyTorque: (WrongControlMode,),
    SetLimits: (WrongRowCount,),
    Reset: (EmergencyStopPressed,),
}
"""Commands that cannot be carried out as they are above, wherever they are accepted; tested elsewhere."""
FIRST_STATE = {"set_zero": State.READY, "enable": State.READY, "reset": State.FAULT, "set_output": State.READY,
               "halt": State.MOVING}  # fmt: skip
"""A state in which each command is accepted and changes something; `HOLDING` for all others."""


def first_state(command: Command) -> State:
    return FIRST_STATE.get(command.name, State.HOLDING)


def name_of(value: object) -> str:
    return getattr(value, "name", "").lower()


# -- every command in every state -----------------------------------------------------------------------------------


def test_the_table_has_every_command_and_every_state() -> None:
    own = {kind.name for kind in Command.kinds if kind.__module__ == "rtcp.ipc.commands"}
    assert {(command.name, state) for command, state, _ in PAIRS} == {(name, state) for name in own for state in STATES}


def test_each_command_names_the_states_of_the_table() -> None:
    for command in COMMANDS.values():
        assert command.states == {state for other, state, accepted in PAIRS if other is command and accepted}


@pytest.mark.parametrize(("command", "state", "accepted"), PAIRS, ids=name_of)
def test_a_command_is_accepted_or_refused_as_the_table_says(
    rig: LoopRig, command: Command, state: State, accepted: bool
) -> None:
    rig.bring_to(state)
    refusal = rig.send(command).refusal
    if accepted:
        # A state may accept a command that is refused for what it asks.
        assert refusal is None or isinstance(refusal, FOR_OTHER_REASONS.get(type(command), ()))
        return
    assert refusal == WrongState(command.number, state)
    message, _, accepting = rig.names.message(refusal).partition(", only in: ")
    assert message == f"{command.name} is not accepted in state {state.words}"
    accepting, _, hint = accepting.partition("; ")
    assert accepting.split(", ") == sorted(one.words for one in command.states)
    if state in Reset.states:
        assert hint == "`rtcp reset` first"
    elif state is State.READY and State.HOLDING in command.states:
        assert hint == "`rtcp enable` first"
    else:
        assert hint == ("`rtcp disable` first" if command.name == "set_zero" else "")


@pytest.mark.parametrize("state", sorted(STATES - {State.STARTING, State.RESETTING, State.CLOSING}), ids=name_of)
def test_what_is_refused_changes_nothing(rig: LoopRig, state: State) -> None:
    if state in (State.ENABLING, State.STOPPING, State.DISABLING):
        # States that end by themselves.
        return
    rig.bring_to(state)
    for command in (command for command, other, accepted in PAIRS if other is state and not accepted):
        rig.send(command)
        rig.run(0.02)
        assert rig.state is state


@pytest.mark.parametrize(
    ("name", "state"),
    [
        ("enable", State.ENABLING), ("disable", State.DISABLING), ("reset", State.RESETTING),
        ("set_drive_mode", State.HOLDING), ("move_joints", State.MOVING), ("halt", State.STOPPING),
        ("set_output", State.READY), ("shutdown", State.CLOSING),
    ],
)  # fmt: skip
def test_a_command_leads_to_its_state(rig: LoopRig, name: str, state: State) -> None:
    rig.slaves_come_back = False
    # Disabling and closing pass too quickly from standstill to be seen.
    rig.bring_to(State.MOVING if name in ("disable", "shutdown") else first_state(COMMANDS[name]))
    rig.do(COMMANDS[name])
    assert rig.state is state


# -- the lease ------------------------------------------------------------------------------------------------------


def test_only_what_makes_the_arm_safer_needs_no_lease() -> None:
    assert {command.name for command in COMMANDS.values() if not command.needs_lease} == SAFER


@pytest.mark.parametrize("command", WITH_LEASE, ids=name_of)
@pytest.mark.parametrize("lease", [0, 12345], ids=["without", "of another"])
def test_a_command_without_its_lease_is_refused(rig: LoopRig, command: Command, lease: int) -> None:
    rig.bring_to(first_state(command))
    answer = rig.send(command, lease=lease)
    assert isinstance(answer.refusal, NoLease)
    assert rig.state is first_state(command)


@pytest.mark.parametrize("command", WITH_LEASE, ids=name_of)
def test_a_command_with_a_lease_that_has_run_out_is_refused(rig: LoopRig, command: Command) -> None:
    rig.bring_to(first_state(command))
    rig.observer.release(rig.lease)
    rig.lease = rig.observer.acquire("one who falls silent", 0.001)
    time.sleep(0.002)
    assert isinstance(rig.send(command).refusal, NoLease)


@pytest.mark.parametrize("name", sorted(SAFER))
def test_a_command_that_makes_the_arm_safer_is_accepted_from_anyone(rig: LoopRig, name: str) -> None:
    rig.bring_to(State.MOVING)
    assert rig.send(COMMANDS[name], lease=0).refusal is None
    assert rig.state is not State.MOVING


# -- moves ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "refusal"),
    [
        (move_to(0.0, 2.5), PositionOutOfRange(1, 2.5, 2.0)),
        (move_to(-3.2, 0.0), PositionOutOfRange(0, -3.2, -3.1)),
        (move_to(-inf, 0.0), NotFinite(0, -inf)),
        (move_to(0.1, 0.1, 0.1), WrongCount(3, 2)),
        (move_to(0.1, 0.1, speed=0.6), SpeedOutOfRange(0.6, 0.5)),
        (move_to(0.1, 0.1, speed=0.0), SpeedOutOfRange(0.0, 0.5)),
        (move_to(1.0, 1.0, speed=0.001), NoTrajectory(0.001, 600.0)),
    ],
    ids=name_of,
)
def test_a_move_that_cannot_be_made_is_refused_with_value_and_limit(
    rig: LoopRig, command: MoveJoints, refusal: Refusal
) -> None:
    rig.hold()
    assert rig.send(command).refusal == refusal
    assert rig.state is State.HOLDING


@pytest.mark.parametrize(
    ("command", "kind"), [(move_to(0.0, nan), NotFinite), (move_to(0.1, 0.1, speed=nan), SpeedOutOfRange)]
)
def test_a_move_with_a_number_that_is_none_is_refused(rig: LoopRig, command: MoveJoints, kind: type[Refusal]) -> None:
    rig.hold()
    assert isinstance(rig.send(command).refusal, kind)
    assert rig.state is State.HOLDING


def test_a_refused_move_moves_nothing(rig: LoopRig) -> None:
    rig.hold()
    before = rig.log[-1].drives
    rig.send(move_to(0.1, 2.5))
    rig.run(0.1)
    assert {cycle.drives[0].target for cycle in rig.log[-100:]} == {before[0].target}


def test_a_refused_move_leaves_the_one_under_way_as_it_was(rig: LoopRig) -> None:
    rig.hold()
    rig.move(0.1, 0.1)
    rig.run(0.1)
    rig.send(move_to(0.3, 2.5))
    rig.until(State.HOLDING)
    rig.run(0.1)
    assert [drive.position for drive in rig.arm.drives] == pytest.approx([0.1, 0.1], abs=1e-3)


def test_a_move_in_motion_takes_over_without_a_jump(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.move(-0.1, 0.3)
    rig.until(State.HOLDING)
    rig.run(0.1)
    assert rig.longest_step(0) <= CONFIG.joints[0].velocity * PERIOD_S * COUNTS + 1
    assert [drive.position for drive in rig.arm.drives] == pytest.approx([-0.1, 0.3], abs=1e-3)


def test_the_edge_of_a_range_is_inside_it(rig: LoopRig) -> None:
    rig.hold()
    assert rig.send(move_to(3.1, -2.0, speed=SPEED)).refusal is None


# -- enabling -------------------------------------------------------------------------------------------------------


def test_nothing_is_enabled_while_a_slave_is_not_in_op(rig: LoopRig) -> None:
    rig.start().service.all_op = False
    assert rig.send(Enable()).refusal == NotInOp()
    assert rig.state is State.READY


def test_nothing_is_enabled_while_the_clock_is_not_followed(rig: LoopRig) -> None:
    rig.start().discipline.locked = False
    assert rig.send(Enable()).refusal == ClockNotLocked()
    assert rig.state is State.READY


def test_a_joint_that_turns_is_not_enabled(rig: LoopRig) -> None:
    rig.start()
    turning = rig.models[1].mechanics
    turning.holding_torque, turning.external_torque = 0.0, 10.0
    rig.run(0.1)
    refusal = rig.send(Enable()).refusal
    assert refusal == NotAtStandstill(1, rig.arm.drives[1].velocity)
    assert rig.state is State.READY


@pytest.mark.parametrize("position", [2.1, -2.1])
def test_a_joint_that_stands_outside_its_range_is_not_enabled(rig: LoopRig, position: float) -> None:
    rig.models[1].mechanics.position = position
    rig.start()
    assert rig.send(Enable()).refusal == JointOutsideRange(1, position)
    assert rig.state is State.READY


# -- modes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["set_drive_mode", "move_joints"])
def test_while_the_drives_change_their_mode_neither_a_move_nor_another_mode_is_accepted(
    rig: LoopRig, name: str
) -> None:
    rig.hold()
    rig.data.deaf[1, 0x6060] = {CSV: CSP}
    rig.do(SetDriveMode(DriveMode(CSV)))
    assert rig.send(COMMANDS[name]).refusal == DriveModeChanging()
    rig.data.deaf.clear()
    rig.run(0.01)
    assert rig.send(COMMANDS[name]).refusal is None


def test_a_mode_that_is_chosen_while_ready_is_held_in_after_the_next_enable(rig: LoopRig) -> None:
    rig.start()
    rig.do(SetDriveMode(DriveMode(CST)))
    rig.enable()
    rig.run(0.05)
    assert [said.mode_display for said in rig.log[-1].drives] == [CST, CST]


# -- outputs, and what is no command --------------------------------------------------------------------------------


def test_an_output_reaches_the_terminal(rig: LoopRig) -> None:
    rig.start()
    for number, value in ((5, True), (16, True), (5, False)):
        rig.do(SetOutput(number, value))
    rig.run(0.005)
    assert rig.data.devices[0].outputs & ~HEARTBEAT == 0x8000


@pytest.mark.parametrize("number", [0, 17, -1])
def test_an_output_that_does_not_exist_is_refused(rig: LoopRig, number: int) -> None:
    rig.start()
    assert rig.send(SetOutput(number, True)).refusal == UnknownOutput(number, 16)
    rig.run(0.005)
    assert rig.data.devices[0].outputs & ~HEARTBEAT == 0


def test_without_an_io_box_there_are_no_outputs(rig_board: tuple[Blackboard, Observer]) -> None:
    rig = LoopRig(*rig_board, with_box=False)
    try:
        refusal = rig.start().send(SetOutput(1, True)).refusal
    finally:
        rig.observer.release(rig.lease)
    assert refusal == NoOutputs()


def test_outputs_stay_as_they_are_in_a_fault(rig: LoopRig) -> None:
    rig.hold()
    rig.do(SetOutput(6, True))
    rig.service.lost_slave = 3
    rig.run(0.1)
    assert (rig.state, rig.data.devices[0].outputs & ~HEARTBEAT) == (State.FAULT, 0x0020)


class Unknown(Command):
    """A command that no handler knows."""

    states = frozenset(State)


def test_a_command_without_a_handler_is_refused_with_its_number(rig: LoopRig) -> None:
    rig.start()
    assert rig.send(Unknown()).refusal == Malformed(Unknown.number)


def test_at_most_one_command_is_taken_a_cycle(rig: LoopRig) -> None:
    rig.hold()
    first = rig.observer.command(rig.lease, move_to(0.1, 0.1))
    second = rig.observer.command(rig.lease, Halt())
    rig.cycle()
    assert rig.observer.answer(first) is not None
    assert rig.state is State.MOVING
    rig.cycle()
    assert rig.observer.answer(second) is not None
    assert rig.state is State.STOPPING
