"""The table of states and events, and what is derived from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from docs.machine_page import diagram, page
from rtcp.gateway.robot_status import robot_status
from rtcp.ipc.codes import Command, MotionMode
from rtcp.ipc.layout import FLAG_EMERGENCY_STOP, FLAG_ENABLED, FLAG_MOTION_ALLOWED, FLAG_SWITCHING
from rtcp.ipc.machine import ALLOWED, TABLE, WITHOUT_LEASE, Event, State

ROOT = Path(__file__).parents[2]
ALLOWED_TO_MOVE = FLAG_ENABLED | FLAG_MOTION_ALLOWED


def reached_from(start: State) -> set[State]:
    reached, left = {start}, [start]
    while left:
        for target in TABLE[left.pop()].left_by.values():
            if target not in reached:
                reached.add(target)
                left.append(target)
    return reached


def test_the_table_has_a_row_for_every_state() -> None:
    assert set(TABLE) == set(State)


def test_every_state_can_be_reached_from_off_and_leads_back_to_it() -> None:
    assert reached_from(State.OFF) == set(State)
    assert all(State.OFF in reached_from(state) for state in State)


def test_every_event_leads_somewhere() -> None:
    assert {event for row in TABLE.values() for event in row.left_by} == set(Event)


def test_every_command_is_taken_somewhere() -> None:
    assert all(ALLOWED[command] for command in Command)


def test_nothing_leads_from_a_fault_or_an_emergency_stop_to_motion_but_through_reset_and_enable() -> None:
    for state in (State.FAULT, State.EMERGENCY_STOP, State.RESETTING):
        assert set(TABLE[state].left_by.values()) <= {
            State.FAULT,
            State.EMERGENCY_STOP,
            State.RESETTING,
            State.CLOSING,
            State.READY,
        }
    assert {event for event, target in TABLE[State.READY].left_by.items() if target is State.ENABLING} == {Event.ENABLE}


def test_a_stop_by_a_limit_is_left_by_reset_alone_where_the_arm_stays_enabled() -> None:
    row = TABLE[State.STOPPED_BY_LIMIT]
    assert {event for event, target in row.left_by.items() if target is State.HOLDING} == {Event.RESET}


def test_whoever_has_no_lease_can_only_make_the_arm_safer() -> None:
    assert {Command.DISABLE, Command.STOP, Command.SHUTDOWN} == WITHOUT_LEASE


def test_the_page_in_the_docs_is_drawn_from_the_table() -> None:
    # `python docs/generate.py` writes it.
    assert page().strip() in (ROOT / "docs" / "machine.md").read_text()


def test_the_picture_shows_every_state() -> None:
    assert all(f"{state.name} :" in diagram() for state in State)


# -- RobotStatus ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", State)
def test_motion_is_possible_only_while_the_arm_holds_or_moves(state: State) -> None:
    found = robot_status(state, MotionMode.JOINT, ALLOWED_TO_MOVE, 0, 0)
    assert found["motion_possible"] is (state in (State.HOLDING, State.MOVING))


@pytest.mark.parametrize("flag", [FLAG_EMERGENCY_STOP, FLAG_SWITCHING])
def test_motion_is_not_possible_with_the_emergency_stop_pressed_or_while_the_drives_change_their_mode(
    flag: int,
) -> None:
    assert not robot_status(State.HOLDING, MotionMode.JOINT, ALLOWED_TO_MOVE | flag, 0, 0)["motion_possible"]


def test_motion_is_not_possible_without_the_enabling_switch() -> None:
    assert not robot_status(State.HOLDING, MotionMode.JOINT, FLAG_ENABLED, 0, 0)["motion_possible"]


def test_the_stick_makes_the_mode_manual() -> None:
    assert robot_status(State.HOLDING, MotionMode.JOYSTICK, 0, 0, 0)["mode"] == "manual"
    for mode in set(MotionMode) - {MotionMode.JOYSTICK}:
        assert robot_status(State.HOLDING, mode, 0, 0, 0)["mode"] == "auto"


def test_an_error_has_the_code_of_the_fault_or_of_the_limit() -> None:
    assert robot_status(State.FAULT, 1, 0, 5, 0)["error_code"] == 5
    assert robot_status(State.STOPPED_BY_LIMIT, 1, FLAG_ENABLED, 0, 4)["error_code"] == 104
    assert robot_status(State.HOLDING, 1, FLAG_ENABLED, 0, 0)["error_code"] == 0


def test_the_drives_are_powered_also_in_a_stop_by_a_limit() -> None:
    found = robot_status(State.STOPPED_BY_LIMIT, 1, FLAG_ENABLED, 0, 4)
    assert found["drives_powered"]
    assert found["in_error"]


@pytest.mark.parametrize("state", State)
def test_e_stopped_is_the_state_or_the_button(state: State) -> None:
    assert robot_status(state, 1, 0, 0, 0)["e_stopped"] is (state is State.EMERGENCY_STOP)
    assert robot_status(state, 1, FLAG_EMERGENCY_STOP, 0, 0)["e_stopped"]
