"""RobotStatus: what each state of the machine, each flag and each fault means for who commands the arm."""

from __future__ import annotations

from typing import Any

import pytest

from rtcp.ipc.events import EmergencyStopActivated
from rtcp.ipc.robot_status import RobotStatus
from rtcp.ipc.schema import FLAG_EMERGENCY_STOP, FLAG_ENABLED, FLAG_MOTION_ALLOWED, FLAG_SWITCHING
from rtcp.ipc.states import State

ALLOWED = FLAG_ENABLED | FLAG_MOTION_ALLOWED


def shown(state: State, flags: int = ALLOWED, age_s: float = 0.0, **fields: Any) -> RobotStatus:
    record: dict[str, Any] = {
        "state": state, "flags": flags, "fault": 0, "limit": 0, "drives_powered": 1, "e_stopped": 0,
        "operating_mode": 2, "actual_velocity": (0.0,) * 6,
    }  # fmt: skip
    return RobotStatus.of_record(record | fields, age_s)


@pytest.mark.parametrize("state", State)
def test_it_follows_the_state(state: State) -> None:
    status = shown(state)
    assert status.motion_possible is (state in (State.HOLDING, State.MOVING))
    assert status.in_motion is (state in (State.MOVING, State.STOPPING, State.HOMING))
    in_error = (State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT, State.RESETTING)
    assert status.in_error is (state in in_error)
    assert status.e_stopped is (state is State.EMERGENCY_STOP)
    assert status.drives_powered


@pytest.mark.parametrize("flags", [ALLOWED | FLAG_EMERGENCY_STOP, ALLOWED | FLAG_SWITCHING, FLAG_ENABLED])
def test_motion_is_not_possible_with_stop_pressed_or_mode_changing_or_without_permission(flags: int) -> None:
    assert not shown(State.HOLDING, flags).motion_possible


def test_what_no_slave_tells_and_what_is_stale_is_unknown() -> None:
    untold = shown(State.READY, drives_powered=-1, e_stopped=-1, operating_mode=-1)
    assert (untold.drives_powered, untold.e_stopped, untold.mode) == (None, None, None)
    assert (untold.in_motion, untold.in_error) == (False, False)
    for state in (State.READY, State.HOLDING, State.FAULT):
        stale = shown(state, age_s=0.5)
        assert (stale.drives_powered, stale.e_stopped, stale.mode, stale.in_motion) == (None, None, None, None)
        assert not stale.motion_possible
    assert shown(State.EMERGENCY_STOP, age_s=0.5).e_stopped  # the machine stays there until a reset


@pytest.mark.parametrize(("key", "mode"), [(1, "manual"), (2, "auto"), (-1, None)])
def test_the_mode_is_the_position_of_the_controllers_key(key: int, mode: str | None) -> None:
    assert shown(State.HOLDING, operating_mode=key).mode == mode


def test_a_joint_that_somebody_else_moves_is_in_motion() -> None:
    assert shown(State.READY, actual_velocity=(0.0, -0.1)).in_motion
    assert not shown(State.READY, actual_velocity=(0.0, 0.001)).in_motion
    assert not shown(State.HOLDING, actual_velocity=(0.0, -0.1)).in_motion  # it settles


def test_an_error_code_is_the_number_of_the_event() -> None:
    assert shown(State.FAULT, fault=5).error_code == 5
    assert shown(State.STOPPED_BY_LIMIT, limit=107).error_code == 107
    assert shown(State.HOLDING).error_code == 0


def test_a_pressed_emergency_stop_is_an_error_in_every_state() -> None:
    status = shown(State.READY, e_stopped=1)
    assert (status.e_stopped, status.in_error, status.error_code) == (True, True, EmergencyStopActivated.number)


def test_an_arm_whose_loop_has_ended_is_in_error_and_takes_no_motion() -> None:
    status = RobotStatus.lost()
    assert (status.in_error, status.motion_possible, status.drives_powered) == (True, False, None)
    assert status.error_code != 0
