"""The IO box leaves OP: its outputs switch off, and stay off when it comes back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from rtcp.config.model import GripperConfig
from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.codes import ERROR_BIT
from rtcp.ipc.commands import MoveGripper, Reset, SetOutput
from rtcp.ipc.states import State

from .rig import CONFIG, LoopRig

GRIPPER, BY_HAND = 4, 5
"""Numbers of outputs."""
BOTH = 1 << GRIPPER - 1 | 1 << BY_HAND - 1
WITH_GRIPPER = replace(CONFIG, gripper=GripperConfig(output=GRIPPER, closed="on"))
BOX, DRIVE = 1, 3
"""Positions of slaves."""


@pytest.fixture
def rig(new_rig: Callable[..., LoopRig]) -> LoopRig:
    """The arm holds; the gripper is closed and an output switched on."""
    made = new_rig(WITH_GRIPPER).hold()
    switch_on(made)
    return made


def switch_on(rig: LoopRig) -> None:
    rig.do(MoveGripper(False))
    rig.do(SetOutput(BY_HAND, True))
    assert on(rig) == BOTH


def on(rig: LoopRig) -> int:
    """Those of the two outputs that are sent as on."""
    return int.from_bytes(rig.data.outputs[0], "little") & BOTH


def shows(rig: LoopRig, position: int, state: int) -> None:
    """Do what the service does after it has read a slave's AL state."""
    rig.board.slave(position, state, 0)
    if state != AlState.OP:
        rig.service.lost_slave = rig.service.lost_slave or position
        rig.service.all_op = False


@pytest.mark.parametrize("state", [AlState.NONE, AlState.INIT, AlState.PREOP, AlState.SAFEOP | ERROR_BIT])
def test_a_box_that_comes_back_by_itself_is_sent_nothing_that_was_on_before(rig: LoopRig, state: int) -> None:
    shows(rig, BOX, state)
    rig.run(0.05)
    assert (rig.state, on(rig)) == (State.FAULT, 0)
    shows(rig, BOX, AlState.OP)
    rig.run(0.05)
    assert on(rig) == 0
    rig.do(Reset())
    rig.bring_to(State.READY)
    assert on(rig) == 0
    switch_on(rig)


def test_a_box_that_was_back_before_a_cycle_saw_it_away_is_sent_nothing_that_was_on_before(rig: LoopRig) -> None:
    shows(rig, BOX, AlState.SAFEOP)
    shows(rig, BOX, AlState.OP)
    rig.run(0.05)
    assert (rig.state, on(rig)) == (State.FAULT, 0)


def test_a_box_that_leaves_op_after_another_slave_loses_its_outputs_too(rig: LoopRig) -> None:
    shows(rig, DRIVE, AlState.NONE)
    rig.run(0.05)
    assert on(rig) == BOTH
    shows(rig, BOX, AlState.NONE)
    rig.run(0.05)
    assert on(rig) == 0


def test_an_output_that_is_switched_on_while_the_box_is_away_does_not_wait_for_it(rig: LoopRig) -> None:
    shows(rig, BOX, AlState.SAFEOP)
    rig.run(0.05)
    rig.do(SetOutput(BY_HAND, True))
    rig.run(0.05)
    shows(rig, BOX, AlState.OP)
    rig.run(0.05)
    assert on(rig) == 0


def test_a_box_that_is_parked_after_an_emergency_stop_comes_back_with_its_outputs_off(rig: LoopRig) -> None:
    rig.press()
    assert (rig.state, on(rig)) == (State.EMERGENCY_STOP, BOTH)
    rig.board.slave(BOX, AlState.PREOP, 0)
    rig.run(0.05)
    assert on(rig) == 0


def test_the_outputs_of_a_box_that_stays_in_op_outlast_the_fault_of_another_slave(rig: LoopRig) -> None:
    shows(rig, DRIVE, AlState.SAFEOP)
    rig.run(0.1)
    rig.do(Reset())
    rig.bring_to(State.READY)
    assert on(rig) == BOTH


def test_the_lamps_of_a_box_that_is_away_go_on_saying_what_is_so(rig: LoopRig) -> None:
    heartbeat = CONFIG.outputs.heartbeat
    assert heartbeat is not None
    shows(rig, BOX, AlState.SAFEOP)
    rig.run(0.05)
    beats = []
    for _ in range(4):
        rig.cycle()
        beats.append(int.from_bytes(rig.data.outputs[0], "little") >> heartbeat - 1 & 1)
    assert sorted(beats) == [0, 0, 1, 1]


def test_what_is_commanded_after_the_reset_counts_though_the_box_was_looked_at_before(rig: LoopRig) -> None:
    shows(rig, BOX, AlState.SAFEOP)
    rig.run(0.05)
    rig.do(Reset())
    rig.bring_to(State.READY)
    switch_on(rig)
    rig.run(0.05)
    assert on(rig) == BOTH
