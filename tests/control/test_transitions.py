"""The table of states and events, and what is derived from it."""

from __future__ import annotations

from pathlib import Path

from docs.machine_page import diagram
from rtcp.control.machine import STATES
from rtcp.control.states import ReadyState, StoppedByLimitState
from rtcp.ipc.commands import Enable, Reset
from rtcp.ipc.layout import FLAG_ENABLED, FLAG_MOTION_ALLOWED
from rtcp.ipc.states import State

ROOT = Path(__file__).parents[2]
ALLOWED_TO_MOVE = FLAG_ENABLED | FLAG_MOTION_ALLOWED


def targets(state: State) -> set[State]:
    return {target for one in STATES if one.state is state for target in one.leads_to.values()}


def reached_from(start: State) -> set[State]:
    reached, left = {start}, [start]
    while left:
        for target in targets(left.pop()) - reached:
            reached.add(target)
            left.append(target)
    return reached


def test_every_state_but_off_does_something() -> None:
    assert {one.state for one in STATES} == set(State) - {State.OFF}


def test_every_state_is_reached_from_the_start_and_leads_to_the_end() -> None:
    assert reached_from(State.STARTING) == set(State)
    assert all(State.OFF in reached_from(state) for state in State)


def test_nothing_leads_from_a_fault_or_an_emergency_stop_to_motion_but_through_reset_and_enable() -> None:
    for state in (State.FAULT, State.EMERGENCY_STOP, State.RESETTING):
        assert targets(state) <= {
            State.FAULT,
            State.EMERGENCY_STOP,
            State.RESETTING,
            State.CLOSING,
            State.READY,
        }
    assert [cause for cause, target in ReadyState.leads_to.items() if target is State.ENABLING] == [Enable]


def test_a_stop_by_a_limit_is_left_by_reset_alone_where_the_arm_stays_enabled() -> None:
    assert [cause for cause, target in StoppedByLimitState.leads_to.items() if target is State.HOLDING] == [Reset]


def test_the_picture_shows_every_state() -> None:
    assert all(f"{state.name} :" in diagram() for state in State)
