"""Every command in every state: taken, or refused with the right words; and what each command is checked for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from math import inf, nan

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.machine import ALLOWED, WITHOUT_LEASE, Command, Refusal, State
from rtcp.ipc.observer import Observer

from .bench import CONFIG, COUNTS, CSP, CST, CSV, PERIOD_S, SPEED, Bench, move_numbers

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
    Command.MOTION: [1],
    Command.TRAJECTORY: [0, 1],
    Command.LINE: [0, 1],
    Command.STREAM: [0.0] * 12,
    Command.JOG: [*([0.0] * 10), 2, 0.2],
    Command.VELOCITY: [*([0.0] * 11), 0.2],
    Command.TORQUE: [*([0.0] * 11), 0.2],
    Command.GRIPPER: [0],
    Command.LIMITS: [0, 1],
    Command.ZERO: [0, 0.0],
    Command.HOME: [0],
    Command.MODE: [CSP],
    Command.MOVE: move_numbers(0.1, 0.1),
    Command.OUTPUT: [5, 1],
}
"""Numbers that nobody could refuse."""
WITH_LEASE = sorted(set(Command) - {Command.DISABLE, Command.STOP, Command.SHUTDOWN})
FOR_OTHER_REASONS = {
    Command.TRAJECTORY: (Refusal.BAD_PLAN, Refusal.PLAN_START),
    Command.LINE: (Refusal.NO_GEOMETRY,),
    Command.VELOCITY: (Refusal.OTHER_MOTION,),
    Command.TORQUE: (Refusal.OTHER_MOTION,),
    Command.LIMITS: (Refusal.LIMITS_WRONG,),
    Command.RESET: (Refusal.PRESSED,),
}
"""Commands whose numbers above cannot be carried out wherever they are taken; told in their own tests."""
FIRST_STATE = {
    Command.MOTION: State.HOLDING, Command.TRAJECTORY: State.HOLDING, Command.LINE: State.HOLDING,
    Command.STREAM: State.HOLDING, Command.JOG: State.HOLDING, Command.VELOCITY: State.HOLDING,
    Command.TORQUE: State.HOLDING, Command.GRIPPER: State.HOLDING, Command.LIMITS: State.HOLDING,
    Command.ZERO: State.READY, Command.HOME: State.HOLDING,
    Command.ENABLE: State.READY, Command.RESET: State.FAULT, Command.MODE: State.HOLDING, Command.MOVE: State.HOLDING,
    Command.OUTPUT: State.READY, Command.DISABLE: State.HOLDING, Command.STOP: State.MOVING,
    Command.SHUTDOWN: State.HOLDING,
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
    bench: Bench, command: Command, state: State, taken: bool
) -> None:
    bench.bring_to(state)
    answer = bench.order(command, NUMBERS.get(command, ()))
    if taken:
        # What is taken in this state may still be refused for what it asks.
        assert answer.refusal in (Refusal.NONE, *FOR_OTHER_REASONS.get(command, ()))
    else:
        assert (answer.refusal, answer.axis, answer.value) == (Refusal.NOT_IN_THIS_STATE, state, command)


@pytest.mark.parametrize(
    ("command", "state"), [pair[:2] for pair in PAIRS if not pair[2]], ids=lambda value: value.name.lower()
)
def test_a_command_that_does_not_fit_the_state_is_told_with_those_it_fits(
    bench: Bench, command: Command, state: State
) -> None:
    bench.bring_to(state)
    said = bench.refused(bench.order(command, NUMBERS.get(command, ())))
    head, _, fits = said.partition("; it is while: ")
    assert head == f"{command.name.lower()} is not possible while {TABLE_OF_WORDS[state]}"
    fits, _, hint = fits.partition("; ")
    assert fits.split(", ") == sorted(TABLE_OF_WORDS[s] for c, s, taken in PAIRS if taken and c is command)
    if (Command.RESET, state, True) in PAIRS:
        assert hint == "`rtcp reset` first"
    elif state is State.READY and (command, State.HOLDING, True) in PAIRS:
        assert hint == "`rtcp enable` first"
    elif command is Command.ZERO and (Command.DISABLE, state, True) in PAIRS:
        assert hint == "`rtcp disable` first"
    else:
        assert hint == ""


# Starting, enabling, moving and the like end by themselves: only states that last are looked at.
@pytest.mark.parametrize("state", [State.READY, State.HOLDING, State.FAULT], ids=lambda state: state.name.lower())
def test_a_refused_command_changes_no_state(bench: Bench, state: State) -> None:
    bench.bring_to(state)
    for command in (command for command, other, taken in PAIRS if other is state and not taken):
        bench.order(command, NUMBERS.get(command, ()))
        bench.run(0.02)
        assert bench.state is state


@pytest.mark.parametrize(
    ("command", "state"),
    [
        (Command.ENABLE, State.ENABLING), (Command.DISABLE, State.DISABLING), (Command.RESET, State.RESETTING),
        (Command.MODE, State.HOLDING), (Command.MOVE, State.MOVING), (Command.STOP, State.STOPPING),
        (Command.OUTPUT, State.READY), (Command.SHUTDOWN, State.CLOSING),
    ],
    ids=lambda value: value.name.lower(),
)  # fmt: skip
def test_a_command_leads_to_its_state(bench: Bench, command: Command, state: State) -> None:
    bench.slaves_come_back = False
    # Disabling and closing pass too quickly from standstill to be seen.
    begins = State.MOVING if command in (Command.DISABLE, Command.SHUTDOWN) else FIRST_STATE[command]
    bench.bring_to(begins)
    bench.do(command, NUMBERS.get(command, ()))
    assert bench.state is state


# -- the lease ------------------------------------------------------------------------------------------------------


def test_only_what_makes_the_arm_safer_needs_no_lease() -> None:
    assert set(WITH_LEASE) == set(Command) - WITHOUT_LEASE


@pytest.mark.parametrize("command", WITH_LEASE, ids=lambda command: command.name.lower())
@pytest.mark.parametrize("lease", [0, 12345], ids=["without", "of another"])
def test_a_command_without_its_lease_is_refused(bench: Bench, command: Command, lease: int) -> None:
    bench.bring_to(FIRST_STATE[command])
    answer = bench.order(command, NUMBERS.get(command, ()), lease=lease)
    assert answer.refusal == Refusal.NO_LEASE
    assert bench.state is FIRST_STATE[command]


@pytest.mark.parametrize("command", WITH_LEASE, ids=lambda command: command.name.lower())
def test_a_command_with_a_lease_that_has_run_out_is_refused(bench: Bench, command: Command) -> None:
    bench.bring_to(FIRST_STATE[command])
    bench.observer.release(bench.lease)
    bench.lease = bench.observer.acquire("one who falls silent", 0.001)
    time.sleep(0.002)
    assert bench.order(command, NUMBERS.get(command, ())).refusal == Refusal.NO_LEASE


@pytest.mark.parametrize("command", sorted(WITHOUT_LEASE), ids=lambda command: command.name.lower())
def test_a_command_that_makes_the_arm_safer_is_taken_from_anyone(bench: Bench, command: Command) -> None:
    bench.bring_to(State.MOVING)
    assert bench.order(command, lease=0).refusal == Refusal.NONE
    assert bench.state is not State.MOVING


def test_a_commander_without_lease_is_told_that_nothing_was_moved(bench: Bench) -> None:
    bench.bring_to(State.HOLDING)
    assert "nothing was moved" in bench.refused(bench.order(Command.MOVE, move_numbers(0.1, 0.1), lease=0))


# -- moves ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        (move_numbers(0.0, 2.5),
         "joint2: target 2.5 rad is outside its range -2 to 2 rad (joints[1].position in assistive_arm.yaml)"),
        (move_numbers(-3.2, 0.0),
         "joint1: target -3.2 rad is outside its range -3.1 to 3.1 rad (joints[0].position in assistive_arm.yaml)"),
        (move_numbers(0.0, nan), "joint2: target nan is not a finite number"),
        (move_numbers(-inf, 0.0), "joint1: target -inf is not a finite number"),
        (move_numbers(0.1, 0.1, speed=0.6),
         "speed 0.6 rad/s is not allowed: more than 0 and at most 0.5 rad/s (joints[].velocity in assistive_arm.yaml)"),
        (move_numbers(0.1, 0.1, speed=0.0),
         "speed 0 rad/s is not allowed: more than 0 and at most 0.5 rad/s (joints[].velocity in assistive_arm.yaml)"),
        (move_numbers(0.1, 0.1, speed=nan),
         "speed nan rad/s is not allowed: more than 0 and at most 0.5 rad/s (joints[].velocity in assistive_arm.yaml)"),
        (move_numbers(1.0, 1.0, speed=0.001),
         "no trajectory of at most 600 s was found to that target at 0.001 rad/s: "
         "choose a higher speed or a nearer target"),
    ],
    ids=["above", "below", "nan", "infinite", "fast", "no speed", "nan speed", "slow"],
)  # fmt: skip
def test_a_move_that_cannot_be_made_is_refused_with_value_limit_and_key(
    bench: Bench, numbers: list[float], says: str
) -> None:
    bench.hold()
    assert bench.refused(bench.order(Command.MOVE, numbers)) == says
    assert bench.state is State.HOLDING


def test_a_refused_move_moves_nothing(bench: Bench) -> None:
    bench.hold()
    before = bench.log[-1].drives
    bench.order(Command.MOVE, move_numbers(0.1, 2.5))
    bench.run(0.1)
    assert {cycle.drives[0].target for cycle in bench.log[-100:]} == {before[0].target}


def test_a_refused_move_leaves_the_one_under_way_as_it_was(bench: Bench) -> None:
    bench.hold()
    bench.move(0.1, 0.1)
    bench.run(0.1)
    bench.order(Command.MOVE, move_numbers(0.3, 2.5))
    bench.until(State.HOLDING)
    bench.run(0.1)
    assert [drive.position for drive in bench.arm.drives] == pytest.approx([0.1, 0.1], abs=1e-3)


def test_a_move_in_motion_takes_over_without_a_jump(bench: Bench) -> None:
    bench.set_in_motion()
    bench.move(-0.1, 0.3)
    bench.until(State.HOLDING)
    bench.run(0.1)
    assert bench.longest_step(0) <= CONFIG.joints[0].velocity * PERIOD_S * COUNTS + 1
    assert [drive.position for drive in bench.arm.drives] == pytest.approx([-0.1, 0.3], abs=1e-3)


def test_the_edge_of_a_range_is_inside_it(bench: Bench) -> None:
    bench.hold()
    assert bench.order(Command.MOVE, move_numbers(3.1, -2.0, speed=SPEED)).refusal == Refusal.NONE


# -- enabling -------------------------------------------------------------------------------------------------------


def test_nothing_is_enabled_while_a_slave_is_not_in_op(bench: Bench) -> None:
    bench.start().service.all_op = False
    said = bench.refused(bench.order(Command.ENABLE))
    assert said == "not all slaves are in OP: see `rtcp status`, then `rtcp reset`"
    assert bench.state is State.READY


def test_nothing_is_enabled_while_the_clock_is_not_followed(bench: Bench) -> None:
    bench.start().discipline.locked = False
    said = bench.refused(bench.order(Command.ENABLE))
    assert said == "the cycle does not follow the reference clock yet (`rtcp status`, clocks)"
    assert bench.state is State.READY


def test_a_joint_that_turns_is_not_enabled(bench: Bench) -> None:
    bench.start()
    turning = bench.models[1].mechanics
    turning.holding_torque, turning.external_torque = 0.0, 10.0
    bench.run(0.1)
    answer = bench.order(Command.ENABLE)
    speed = bench.arm.drives[1].velocity
    assert answer.refusal == Refusal.NOT_STILL
    assert bench.refused(answer) == f"joint2 turns at {speed:.6g} rad/s: it is enabled at standstill only"
    assert bench.state is State.READY


@pytest.mark.parametrize("position", [2.1, -2.1])
def test_a_joint_that_stands_outside_its_range_is_not_enabled(bench: Bench, position: float) -> None:
    bench.models[1].mechanics.position = position
    bench.start()
    said = bench.refused(bench.order(Command.ENABLE))
    assert said == (
        f"joint2 stands at {position} rad, outside its range -2 to 2 rad "
        "(joints[1].position in assistive_arm.yaml): it is not enabled there"
    )
    assert bench.state is State.READY


# -- modes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "shown"), [(1, "1"), (8.5, "8.5"), (0, "0"), (nan, "nan")])
def test_a_mode_that_the_cycle_does_not_use_is_refused(bench: Bench, mode: float, shown: str) -> None:
    bench.hold()
    said = bench.refused(bench.order(Command.MODE, [mode]))
    assert said == f"mode {shown} is not one of csp (8), csv (9), cst (10)"
    assert bench.log[-1].drives[0].mode == CSP


@pytest.mark.parametrize("command", [Command.MODE, Command.MOVE], ids=lambda command: command.name.lower())
def test_while_the_drives_change_their_mode_neither_a_move_nor_another_mode_is_taken(
    bench: Bench, command: Command
) -> None:
    bench.hold()
    bench.data.deaf[1, 0x6060] = {CSV: CSP}
    bench.do(Command.MODE, [CSV])
    answer = bench.order(command, NUMBERS[command])
    assert answer.refusal == Refusal.SWITCHING
    assert bench.refused(answer) == "the drives are changing their mode: try again when they show it"
    bench.data.deaf.clear()
    bench.run(0.01)
    assert bench.order(command, NUMBERS[command]).refusal == Refusal.NONE


def test_a_mode_that_is_chosen_while_ready_is_held_in_after_the_next_enable(bench: Bench) -> None:
    bench.start()
    bench.do(Command.MODE, [CST])
    bench.enable()
    bench.run(0.05)
    assert [said.mode_display for said in bench.log[-1].drives] == [CST, CST]


# -- outputs, and what is no command --------------------------------------------------------------------------------


def test_an_output_reaches_the_terminal(bench: Bench) -> None:
    bench.start()
    for number, value in ((5, 1), (16, 1), (5, 0)):
        bench.do(Command.OUTPUT, [number, value])
    bench.run(0.005)
    assert bench.data.devices[0].outputs & ~HEARTBEAT == 0x8000


@pytest.mark.parametrize(("number", "shown"), [(0, "0"), (17, "17"), (1.5, "1.5"), (-1, "-1"), (nan, "nan")])
def test_an_output_that_does_not_exist_is_refused(bench: Bench, number: float, shown: str) -> None:
    bench.start()
    said = bench.refused(bench.order(Command.OUTPUT, [number, 1]))
    assert said == f"output {shown} does not exist: 1 to 16"
    bench.run(0.005)
    assert bench.data.devices[0].outputs & ~HEARTBEAT == 0


def test_without_an_io_box_there_are_no_outputs(bench_board: tuple[Blackboard, Observer]) -> None:
    bench = Bench(*bench_board, with_box=False)
    try:
        answer = bench.start().order(Command.OUTPUT, [1, 1])
    finally:
        bench.observer.release(bench.lease)
    assert bench.refused(answer) == "no IO box is configured (slaves in assistive_arm.yaml)"


def test_outputs_stay_as_they_are_in_a_fault(bench: Bench) -> None:
    bench.hold()
    bench.do(Command.OUTPUT, [6, 1])
    bench.service.lost_slave = 3
    bench.run(0.1)
    assert (bench.state, bench.data.devices[0].outputs & ~HEARTBEAT) == (State.FAULT, 0x0020)


@pytest.mark.parametrize("kind", [0, 99, 4_000_000_000])
def test_a_command_of_another_version_is_refused_with_its_number(bench: Bench, kind: int) -> None:
    bench.start()
    answer = bench.order(kind)
    assert answer.refusal == Refusal.UNKNOWN
    assert bench.refused(answer) == f"command {kind:.6g} is unknown to this loop"


def test_at_most_one_command_is_taken_a_cycle(bench: Bench) -> None:
    bench.hold()
    first = bench.observer.command(bench.lease, Command.MOVE, move_numbers(0.1, 0.1))
    second = bench.observer.command(bench.lease, Command.STOP)
    bench.cycle()
    assert bench.observer.answer(first) is not None
    assert bench.state is State.MOVING
    bench.cycle()
    assert bench.observer.answer(second) is not None
    assert bench.state is State.STOPPING


@pytest.mark.parametrize("value", [0.5, 2.0, float("nan")])
def test_an_output_is_switched_by_0_or_1_alone(bench: Bench, value: float) -> None:
    said = bench.start().refused(bench.order(Command.OUTPUT, [1, value]))
    assert "output 1: found" in said
    assert "allowed is 0 or 1" in said
