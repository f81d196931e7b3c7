"""The IO box leaves OP: its outputs fall, and what comes back with it is not what was switched on before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from rtcp.config.model import GripperConfig
from rtcp.fieldbus.al_state import ERROR_BIT, AlState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.machine import Command, State
from rtcp.ipc.observer import Observer

from .bench import CONFIG, Bench

GRIPPER, BY_HAND = 4, 5
"""Numbers of outputs."""
BOTH = 1 << GRIPPER - 1 | 1 << BY_HAND - 1
WITH_GRIPPER = replace(CONFIG, gripper=GripperConfig(output=GRIPPER, closed="on"))
BOX, DRIVE = 1, 3
"""Positions of slaves."""


@pytest.fixture
def bench(bench_board: tuple[Blackboard, Observer]) -> Iterator[Bench]:
    """The arm holds; the gripper is closed and an output switched on."""
    made = Bench(*bench_board, config=WITH_GRIPPER).hold()
    switch_on(made)
    yield made
    bench_board[1].release(made.lease)


def switch_on(bench: Bench) -> None:
    bench.do(Command.GRIPPER, [0.0])
    bench.do(Command.OUTPUT, [BY_HAND, 1])
    assert on(bench) == BOTH


def on(bench: Bench) -> int:
    """Which of the two outputs the box is sent as on."""
    return int.from_bytes(bench.data.output(0), "little") & BOTH


def shows(bench: Bench, position: int, state: int) -> None:
    """Do what the service does when it has looked at a slave."""
    bench.board.slave(position, state, 0)
    if state != AlState.OP:
        bench.service.lost_slave = bench.service.lost_slave or position
        bench.service.all_op = False


@pytest.mark.parametrize("state", [AlState.NONE, AlState.INIT, AlState.PREOP, AlState.SAFEOP | ERROR_BIT])
def test_a_box_that_comes_back_by_itself_is_sent_nothing_that_was_on_before(bench: Bench, state: int) -> None:
    shows(bench, BOX, state)
    bench.run(0.05)
    assert (bench.state, on(bench)) == (State.FAULT, 0)
    shows(bench, BOX, AlState.OP)
    bench.run(0.05)
    assert on(bench) == 0
    bench.do(Command.RESET)
    bench.until(State.READY)
    assert on(bench) == 0
    switch_on(bench)


def test_a_box_that_was_back_before_a_cycle_saw_it_away_is_sent_nothing_that_was_on_before(bench: Bench) -> None:
    shows(bench, BOX, AlState.SAFEOP)
    shows(bench, BOX, AlState.OP)
    bench.run(0.05)
    assert (bench.state, on(bench)) == (State.FAULT, 0)


def test_a_box_that_leaves_op_after_another_slave_loses_its_outputs_too(bench: Bench) -> None:
    shows(bench, DRIVE, AlState.NONE)
    bench.run(0.05)
    assert on(bench) == BOTH
    shows(bench, BOX, AlState.NONE)
    bench.run(0.05)
    assert on(bench) == 0


def test_an_output_that_is_switched_on_while_the_box_is_away_does_not_wait_for_it(bench: Bench) -> None:
    shows(bench, BOX, AlState.SAFEOP)
    bench.run(0.05)
    bench.do(Command.OUTPUT, [BY_HAND, 1])
    bench.run(0.05)
    shows(bench, BOX, AlState.OP)
    bench.run(0.05)
    assert on(bench) == 0


def test_a_box_that_is_parked_after_an_emergency_stop_comes_back_with_its_outputs_off(bench: Bench) -> None:
    bench.press()
    assert (bench.state, on(bench)) == (State.EMERGENCY_STOP, BOTH)
    bench.board.slave(BOX, AlState.PREOP, 0)
    bench.run(0.05)
    assert on(bench) == 0


def test_the_outputs_of_a_box_that_stays_in_op_outlast_the_fault_of_another_slave(bench: Bench) -> None:
    shows(bench, DRIVE, AlState.SAFEOP)
    bench.run(0.1)
    bench.do(Command.RESET)
    bench.until(State.READY)
    assert on(bench) == BOTH


def test_the_lamps_of_a_box_that_is_away_go_on_saying_what_is_so(bench: Bench) -> None:
    heartbeat = CONFIG.outputs.heartbeat
    assert heartbeat is not None
    shows(bench, BOX, AlState.SAFEOP)
    bench.run(0.05)
    beats = []
    for _ in range(4):
        bench.cycle()
        beats.append(int.from_bytes(bench.data.output(0), "little") >> heartbeat - 1 & 1)
    assert sorted(beats) == [0, 0, 1, 1]


def test_what_is_commanded_after_the_reset_counts_though_the_box_was_looked_at_before(bench: Bench) -> None:
    shows(bench, BOX, AlState.SAFEOP)
    bench.run(0.05)
    bench.do(Command.RESET)
    bench.until(State.READY)
    switch_on(bench)
    bench.run(0.05)
    assert on(bench) == BOTH
