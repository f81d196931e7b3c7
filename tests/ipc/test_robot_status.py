"""RobotStatus: what each state of the machine, each flag and each fault means for who commands the arm."""

from __future__ import annotations

import pytest

from rtcp.ipc.events import EmergencyStopActivated
from rtcp.ipc.robot_status import RobotStatus
from rtcp.ipc.schema import FLAG_EMERGENCY_STOP, FLAG_ENABLED, FLAG_MOTION_ALLOWED, FLAG_SWITCHING
from rtcp.ipc.states import ControlMode, State

ALLOWED = FLAG_ENABLED | FLAG_MOTION_ALLOWED


def shown(
    state: State, flags: int = ALLOWED, mode: int = ControlMode.JOINT, fault: int = 0, limit: int = 0
) -> RobotStatus:
    record = {"state": state, "flags": flags, "control_mode": mode, "fault": fault, "limit": limit}
    return RobotStatus.of_record(record)


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


@pytest.mark.parametrize("mode", ControlMode)
def test_only_the_joystick_makes_the_mode_manual(mode: ControlMode) -> None:
    assert (shown(State.HOLDING, mode=mode).mode == "manual") is (mode is ControlMode.JOYSTICK)


def test_an_error_code_is_the_number_of_the_event() -> None:
    assert shown(State.FAULT, fault=5).error_code == 5
    assert shown(State.STOPPED_BY_LIMIT, limit=107).error_code == 107
    assert shown(State.HOLDING).error_code == 0


def test_a_pressed_emergency_stop_is_an_error_in_every_state() -> None:
    status = shown(State.READY, FLAG_EMERGENCY_STOP)
    assert (status.e_stopped, status.in_error, status.error_code) == (True, True, EmergencyStopActivated.number)


def test_an_arm_whose_loop_has_ended_is_in_error_and_takes_no_motion() -> None:
    status = RobotStatus.lost(ControlMode.JOINT)
    assert (status.in_error, status.motion_possible, status.drives_powered) == (True, False, False)
    assert status.error_code != 0
