"""Every command in every state: taken, or refused with the right words; and what each command is checked for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from math import inf, nan

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import (
    ApplyTorque,
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
    DamagedRow,
    DriveModeChanging,
    EmergencyStopPressed,
    Malformed,
    NoGeometry,
    NoLease,
    NotAtStandstill,
    PlanStartsElsewhere,
    WrongControlMode,
    WrongRowCount,
    WrongState,
)
from rtcp.ipc.states import DriveMode, State

from .rig import CONFIG, COUNTS, CSP, CST, CSV, PERIOD_S, SPEED, LoopRig, move_to

# What is taken (x) where, written down a second time: a slip in the machine's own table shows here.
TABLE = """
           starting ready enabling holding moving stopping limit homing disabling fault emergency resetting closing
enable        .       x      .        .      .       .       .     .        .       .       .         .        .
disable       .       x      x        x      x       x       x     x        x       x       x         x        .
reset         .       .      .        .      .       .       x     .        .       x       x         .        .
mode          .       x      .        x      .       .       .     .        .       .       .         .        .
motion        .       x      .        x      .       .       .     .        .       .       .         .        .
move          .       .      .        x      x       .       .     .        .       .       .         .        .
trajectory    .       .      .        x      x       .       .     .        .       .       .         .        .
line          .       .      .        x      x       .       .     .        .       .       .         .        .
stream        .       .      .        x      x       .       .     .        .       .       .         .        .
jog           .       .      .        x      x       .       .     .        .       .       .         .        .
velocity      .       .      .        x      x       .       .     .        .       .       .         .        .
torque        .       .      .        x      x       .       .     .        .       .       .         .        .
stop          .       .      .        x      x       x       x     x        .       .       .         .        .
output        .       x      x        x      x       x       x     x        .       x       .         .        .
gripper       .       x      .        x      x       x       x     .        .       .       .         .        .
limits        .       x      .        x      x       .       x     .        .       x       x         .        .
zero          .       x      .        .      .       .       .     .        .       .       .         .        .
home          .       .      .        x      .       .       .     .        .       .       .         .        .
shutdown      x       x      x        x      x       x       x     x        x       x       x         x        x
"""
_HEAD, *_ROWS = [line.split() for line in TABLE.strip().splitlines()]
_SHORT = {"LIMIT": "STOPPED_BY_LIMIT", "EMERGENCY": "EMERGENCY_STOP"}
PAIRS = [
    (Command[row[0].upper()], State[_SHORT.get(state.upper(), state.upper())], mark == "x")
    for row in _ROWS
    for state, mark in zip(_HEAD, row[1:], strict=True)
]
HEARTBEAT = 0x0004
"""Output 3, which is toggled each cycle."""
STATES = set(State) - {State.OFF}
"""Off is what a loop is that does not run."""
TABLE_OF_WORDS = {state: state.name.lower().replace("_", " ") for state in STATES}
NUMBERS: dict[Command, Sequence[float]] = {
    SetControlMode: [1],
    RunTrajectory: [0, 1],
    RunLines: [0, 1],
    StreamPosition: [0.0] * 12,
    Jog: [*([0.0] * 10), 2, 0.2],
    MoveAtVelocity: [*([0.0] * 11), 0.2],
    ApplyTorque: [*([0.0] * 11), 0.2],
    MoveGripper: [0],
    SetLimits: [0, 1],
    SetZero: [0, 0.0],
    Home: [0],
    SetDriveMode: [CSP],
    MoveJoints: move_to(0.1, 0.1),
    SetOutput: [5, 1],
}
"""Numbers that nobody could refuse."""
WITH_LEASE = sorted(set(Command) - {Disable, Halt, Shutdown})
FOR_OTHER_REASONS = {
    RunTrajectory: (DamagedRow, PlanStartsElsewhere),
    RunLines: (NoGeometry,),
    MoveAtVelocity: (WrongControlMode,),
    ApplyTorque: (WrongControlMode,),
    SetLimits: (WrongRowCount,),
    Reset: (EmergencyStopPressed,),
}
"""Commands whose numbers above cannot be carried out wherever they are taken; told in their own tests."""
FIRST_STATE = {
    SetControlMode: State.HOLDING, RunTrajectory: State.HOLDING, RunLines: State.HOLDING,
    StreamPosition: State.HOLDING, Jog: State.HOLDING, MoveAtVelocity: State.HOLDING,
    ApplyTorque: State.HOLDING, MoveGripper: State.HOLDING, SetLimits: State.HOLDING,
    SetZero: State.READY, Home: State.HOLDING,
    Enable: State.READY, Reset: State.FAULT, SetDriveMode: State.HOLDING, MoveJoints: State.HOLDING,
    SetOutput: State.READY, Disable: State.HOLDING, Halt: State.MOVING,
    Shutdown: State.HOLDING,
}  # fmt: skip
"""A state in which each command is taken and changes something."""


# -- every command in every state -----------------------------------------------------------------------------------


def test_the_table_has_every_command_and_every_state() -> None:
    assert {(command, state) for command, state, _ in PAIRS} == {(c, s) for c in Command for s in STATES}
    assert len(PAIRS) == len(Command) * len(STATES)


def test_the_machines_own_table_says_the_same() -> None:
    assert {(command, state) for command, state, taken in PAIRS if taken} == {
        (command, state) for command, states in ALLOWED.items() for state in states
    }


@pytest.mark.parametrize(
    ("command", "state", "taken"), PAIRS, ids=lambda value: value.name.lower() if hasattr(value, "name") else ""
)
def test_a_command_is_taken_or_refused_as_the_table_says(
    rig: LoopRig, command: Command, state: State, taken: bool
) -> None:
    rig.bring_to(state)
    answer = rig.send(command, NUMBERS.get(command, ()))
    if taken:
        # What is taken in this state may still be refused for what it asks.
        assert answer.refusal in (None, *FOR_OTHER_REASONS.get(command, ()))
    else:
        assert (answer.refusal, answer.axis, answer.value) == (WrongState, state, command)


@pytest.mark.parametrize(
    ("command", "state"), [pair[:2] for pair in PAIRS if not pair[2]], ids=lambda value: value.name.lower()
)
def test_a_command_that_does_not_fit_the_state_is_told_with_those_it_fits(
    rig: LoopRig, command: Command, state: State
) -> None:
    rig.bring_to(state)
    said = rig.refused(rig.send(command, NUMBERS.get(command, ())))
    head, _, fits = said.partition("; it is while: ")
    assert head == f"{command.name.lower()} is not possible while {TABLE_OF_WORDS[state]}"
    fits, _, hint = fits.partition("; ")
    assert fits.split(", ") == sorted(TABLE_OF_WORDS[s] for c, s, taken in PAIRS if taken and c is command)
    if (Reset, state, True) in PAIRS:
        assert hint == "`rtcp reset` first"
    elif state is State.READY and (command, State.HOLDING, True) in PAIRS:
        assert hint == "`rtcp enable` first"
    elif command is SetZero and (Disable, state, True) in PAIRS:
        assert hint == "`rtcp disable` first"
    else:
        assert hint == ""


# Starting, enabling, moving and the like end by themselves: only states that last are looked at.
@pytest.mark.parametrize("state", [State.READY, State.HOLDING, State.FAULT], ids=lambda state: state.name.lower())
def test_a_refused_command_changes_no_state(rig: LoopRig, state: State) -> None:
    rig.bring_to(state)
    for command in (command for command, other, taken in PAIRS if other is state and not taken):
        rig.send(command, NUMBERS.get(command, ()))
        rig.run(0.02)
        assert rig.state is state


@pytest.mark.parametrize(
    ("command", "state"),
    [
        (Enable, State.ENABLING), (Disable, State.DISABLING), (Reset, State.RESETTING),
        (SetDriveMode, State.HOLDING), (MoveJoints, State.MOVING), (Halt, State.STOPPING),
        (SetOutput, State.READY), (Shutdown, State.CLOSING),
    ],
    ids=lambda value: value.name.lower(),
)  # fmt: skip
def test_a_command_leads_to_its_state(rig: LoopRig, command: Command, state: State) -> None:
    rig.slaves_come_back = False
    # Disabling and closing pass too quickly from standstill to be seen.
    begins = State.MOVING if command in (Disable, Shutdown) else FIRST_STATE[command]
    rig.bring_to(begins)
    rig.do(command, NUMBERS.get(command, ()))
    assert rig.state is state


# -- the lease ------------------------------------------------------------------------------------------------------


def test_only_what_makes_the_arm_safer_needs_no_lease() -> None:
    assert set(WITH_LEASE) == set(Command) - WITHOUT_LEASE


@pytest.mark.parametrize("command", WITH_LEASE, ids=lambda command: command.name.lower())
@pytest.mark.parametrize("lease", [0, 12345], ids=["without", "of another"])
def test_a_command_without_its_lease_is_refused(rig: LoopRig, command: Command, lease: int) -> None:
    rig.bring_to(FIRST_STATE[command])
    answer = rig.send(command, NUMBERS.get(command, ()), lease=lease)
    assert isinstance(answer.refusal, NoLease)
    assert rig.state is FIRST_STATE[command]


@pytest.mark.parametrize("command", WITH_LEASE, ids=lambda command: command.name.lower())
def test_a_command_with_a_lease_that_has_run_out_is_refused(rig: LoopRig, command: Command) -> None:
    rig.bring_to(FIRST_STATE[command])
    rig.observer.release(rig.lease)
    rig.lease = rig.observer.acquire("one who falls silent", 0.001)
    time.sleep(0.002)
    assert rig.send(command, NUMBERS.get(command, isinstance(())).refusal, NoLease)


@pytest.mark.parametrize("command", sorted(WITHOUT_LEASE), ids=lambda command: command.name.lower())
def test_a_command_that_makes_the_arm_safer_is_taken_from_anyone(rig: LoopRig, command: Command) -> None:
    rig.bring_to(State.MOVING)
    assert rig.send(command, lease=0).refusal is None
    assert rig.state is not State.MOVING


def test_a_commander_without_lease_is_told_that_nothing_was_moved(rig: LoopRig) -> None:
    rig.bring_to(State.HOLDING)
    assert "nothing was moved" in rig.refused(rig.send(move_to(0.1, 0.1), lease=0))


# -- moves ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        (move_to(0.0, 2.5),
         "joint2: target 2.5 rad is outside its range -2 to 2 rad (joints[1].position in assistive_arm.yaml)"),
        (move_to(-3.2, 0.0),
         "joint1: target -3.2 rad is outside its range -3.1 to 3.1 rad (joints[0].position in assistive_arm.yaml)"),
        (move_to(0.0, nan), "joint2: target nan is not a finite number"),
        (move_to(-inf, 0.0), "joint1: target -inf is not a finite number"),
        (move_to(0.1, 0.1, speed=0.6),
         "speed 0.6 rad/s is not allowed: more than 0 and at most 0.5 rad/s (joints[].velocity in assistive_arm.yaml)"),
        (move_to(0.1, 0.1, speed=0.0),
         "speed 0 rad/s is not allowed: more than 0 and at most 0.5 rad/s (joints[].velocity in assistive_arm.yaml)"),
        (move_to(0.1, 0.1, speed=nan),
         "speed nan rad/s is not allowed: more than 0 and at most 0.5 rad/s (joints[].velocity in assistive_arm.yaml)"),
        (move_to(1.0, 1.0, speed=0.001),
         "no trajectory of at most 600 s was found to that target at 0.001 rad/s: "
         "choose a higher speed or a nearer target"),
    ],
    ids=["above", "below", "nan", "infinite", "fast", "no speed", "nan speed", "slow"],
)  # fmt: skip
def test_a_move_that_cannot_be_made_is_refused_with_value_limit_and_key(
    rig: LoopRig, numbers: list[float], says: str
) -> None:
    rig.hold()
    assert rig.refused(rig.send(MoveJoints, numbers)) == says
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
    said = rig.refused(rig.send(Enable()))
    assert said == "not all slaves are in OP: see `rtcp status`, then `rtcp reset`"
    assert rig.state is State.READY


def test_nothing_is_enabled_while_the_clock_is_not_followed(rig: LoopRig) -> None:
    rig.start().discipline.locked = False
    said = rig.refused(rig.send(Enable()))
    assert said == "the cycle does not follow the reference clock yet (`rtcp status`, clocks)"
    assert rig.state is State.READY


def test_a_joint_that_turns_is_not_enabled(rig: LoopRig) -> None:
    rig.start()
    turning = rig.models[1].mechanics
    turning.holding_torque, turning.external_torque = 0.0, 10.0
    rig.run(0.1)
    answer = rig.send(Enable())
    speed = rig.arm.drives[1].velocity
    assert isinstance(answer.refusal, NotAtStandstill)
    assert rig.refused(answer) == f"joint2 turns at {speed:.6g} rad/s: it is enabled at standstill only"
    assert rig.state is State.READY


@pytest.mark.parametrize("position", [2.1, -2.1])
def test_a_joint_that_stands_outside_its_range_is_not_enabled(rig: LoopRig, position: float) -> None:
    rig.models[1].mechanics.position = position
    rig.start()
    said = rig.refused(rig.send(Enable()))
    assert said == (
        f"joint2 stands at {position} rad, outside its range -2 to 2 rad "
        "(joints[1].position in assistive_arm.yaml): it is not enabled there"
    )
    assert rig.state is State.READY


# -- modes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "shown"), [(1, "1"), (8.5, "8.5"), (0, "0"), (nan, "nan")])
def test_a_mode_that_the_cycle_does_not_use_is_refused(rig: LoopRig, mode: float, shown: str) -> None:
    rig.hold()
    said = rig.refused(rig.send(SetDriveMode(DriveMode(mode))))
    assert said == f"mode {shown} is not one of csp (8), csv (9), cst (10)"
    assert rig.log[-1].drives[0].mode == CSP


@pytest.mark.parametrize("command", [SetDriveMode, MoveJoints], ids=lambda command: command.name.lower())
def test_while_the_drives_change_their_mode_neither_a_move_nor_another_mode_is_taken(
    rig: LoopRig, command: Command
) -> None:
    rig.hold()
    rig.data.deaf[1, 0x6060] = {CSV: CSP}
    rig.do(SetDriveMode(DriveMode(CSV)))
    answer = rig.send(command, NUMBERS[command])
    assert isinstance(answer.refusal, DriveModeChanging)
    assert rig.refused(answer) == "the drives are changing their mode: try again when they show it"
    rig.data.deaf.clear()
    rig.run(0.01)
    assert rig.send(command, NUMBERS[command]).refusal is None


def test_a_mode_that_is_chosen_while_ready_is_held_in_after_the_next_enable(rig: LoopRig) -> None:
    rig.start()
    rig.do(SetDriveMode(DriveMode(CST)))
    rig.enable()
    rig.run(0.05)
    assert [said.mode_display for said in rig.log[-1].drives] == [CST, CST]


# -- outputs, and what is no command --------------------------------------------------------------------------------


def test_an_output_reaches_the_terminal(rig: LoopRig) -> None:
    rig.start()
    for number, value in ((5, 1), (16, 1), (5, 0)):
        rig.do(SetOutput(number, value))
    rig.run(0.005)
    assert rig.data.devices[0].outputs & ~HEARTBEAT == 0x8000


@pytest.mark.parametrize(("number", "shown"), [(0, "0"), (17, "17"), (1.5, "1.5"), (-1, "-1"), (nan, "nan")])
def test_an_output_that_does_not_exist_is_refused(rig: LoopRig, number: float, shown: str) -> None:
    rig.start()
    said = rig.refused(rig.send(SetOutput(number, True)))
    assert said == f"output {shown} does not exist: 1 to 16"
    rig.run(0.005)
    assert rig.data.devices[0].outputs & ~HEARTBEAT == 0


def test_without_an_io_box_there_are_no_outputs(rig_board: tuple[Blackboard, Observer]) -> None:
    rig = LoopRig(*rig_board, with_box=False)
    try:
        answer = rig.start().order(SetOutput(1, True))
    finally:
        rig.observer.release(rig.lease)
    assert rig.refused(answer) == "no IO box is configured (slaves in assistive_arm.yaml)"


def test_outputs_stay_as_they_are_in_a_fault(rig: LoopRig) -> None:
    rig.hold()
    rig.do(SetOutput(6, True))
    rig.service.lost_slave = 3
    rig.run(0.1)
    assert (rig.state, rig.data.devices[0].outputs & ~HEARTBEAT) == (State.FAULT, 0x0020)


@pytest.mark.parametrize("kind", [0, 99, 4_000_000_000])
def test_a_command_of_another_version_is_refused_with_its_number(rig: LoopRig, kind: int) -> None:
    rig.start()
    answer = rig.send(kind)
    assert isinstance(answer.refusal, Malformed)
    assert rig.refused(answer) == f"command {kind:.6g} is unknown to this loop"


def test_at_most_one_command_is_taken_a_cycle(rig: LoopRig) -> None:
    rig.hold()
    first = rig.observer.command(rig.lease, move_to(0.1, 0.1))
    second = rig.observer.command(rig.lease, Halt)
    rig.cycle()
    assert rig.observer.answer(first) is not None
    assert rig.state is State.MOVING
    rig.cycle()
    assert rig.observer.answer(second) is not None
    assert rig.state is State.STOPPING


@pytest.mark.parametrize("value", [0.5, 2.0, float("nan")])
def test_an_output_is_switched_by_0_or_1_alone(rig: LoopRig, value: float) -> None:
    said = rig.start().refused(rig.send(SetOutput(1, value)))
    assert "output 1: found" in said
    assert "allowed is 0 or 1" in said
