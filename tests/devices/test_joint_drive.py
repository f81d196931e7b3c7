"""The drive of a joint behind a robot controller: states, references and the ramp of a quick stop."""

from __future__ import annotations

import math
import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.config import default_config, load
from rtcp.devices.drive import CSP, CST, CSV, TargetState, drive_of
from rtcp.devices.joint_drive import FOLLOW, STAND, STOP, JointDrive
from rtcp.ipc.states import DriveState, Missing

CONFIG = load(default_config().parent / "abb_irb120.yaml")
JOINT = CONFIG.joints[0]
PERIOD_S = CONFIG.cycle.period_us * 1e-6
LIMIT = JOINT.velocity
ENABLED = DriveState.OPERATION_ENABLED


def made(zero: float = 0.0) -> JointDrive:
    _, drive = drive_of(CONFIG, JOINT, zero)
    assert isinstance(drive, JointDrive)
    return drive


def read(drive: JointDrive, position: float, state: DriveState = ENABLED, missing: Missing = Missing.NOTHING) -> None:
    drive.decode(struct.pack("<dBBd", position, state, missing, 0.0))


def sent(drive: JointDrive) -> tuple[float, float, int]:
    position, speed, command = struct.unpack("<ddB", drive.encode())
    return position, speed, command


def enabled(position: float = 0.5, zero: float = 0.0) -> JointDrive:
    drive = made(zero)
    read(drive, position)
    assert not drive.advance(TargetState.ENABLED)
    sent(drive)
    read(drive, position)
    assert drive.advance(TargetState.ENABLED)
    return drive


def test_without_a_command_a_drive_that_could_be_enabled_is_switched_on() -> None:
    drive = made()
    read(drive, 0.5)
    assert drive.state is DriveState.SWITCHED_ON
    assert sent(drive) == (0.5, 0.0, STAND)


@pytest.mark.parametrize("state", [state for state in DriveState if state is not ENABLED])
def test_what_keeps_a_drive_from_following_is_shown(state: DriveState) -> None:
    drive = enabled()
    read(drive, 0.5, state, Missing.MOTORS)
    assert (drive.state, drive.missing) == (state, Missing.MOTORS)
    assert not drive.advance(TargetState.ENABLED)


def test_with_a_position_goes_the_speed_that_leads_to_it_and_0_where_it_stands() -> None:
    drive = enabled()
    drive.target_position = 0.5 + 0.5 * LIMIT * PERIOD_S
    assert sent(drive) == (drive.target_position, pytest.approx(0.5 * LIMIT), FOLLOW)
    read(drive, 0.5)
    assert sent(drive) == (drive.target_position, 0.0, FOLLOW)


def test_a_speed_is_never_above_the_limit() -> None:
    drive = enabled()
    for target, speed in ((0.9, LIMIT), (0.1, -LIMIT)):
        drive.target_position = target
        read(drive, 0.5)
        assert sent(drive)[1] == speed


def test_the_position_reference_does_not_step_when_the_mode_changes() -> None:
    drive = enabled()
    drive.mode, drive.target_velocity, drive.target_position = CSV, 0.3, 0.502
    read(drive, 0.49)  # behind its setpoint
    assert sent(drive) == (0.502, pytest.approx(0.002 / PERIOD_S), FOLLOW)  # the setpoint's own, whatever the mode
    read(drive, 0.49)
    drive.mode = CSP
    assert sent(drive) == (0.502, 0.0, FOLLOW)


@pytest.mark.parametrize("target", [math.nan, math.inf, -math.inf])
def test_a_target_that_is_no_number_leaves_the_last(target: float) -> None:
    drive = enabled()
    drive.target_position = target
    assert sent(drive) == (0.5, 0.0, FOLLOW)


def test_a_quick_stop_is_a_ramp_at_the_joints_acceleration() -> None:
    drive = enabled()
    drive.target_position = 0.5 + 0.5 * PERIOD_S
    _, before, _ = sent(drive)
    speeds = []
    for _ in range(round(0.5 / JOINT.acceleration / PERIOD_S) + 2):
        read(drive, 0.5)
        drive.advance(TargetState.QUICK_STOPPED)
        speeds.append(sent(drive)[1])
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    assert before == pytest.approx(0.5)
    assert speeds[0] == pytest.approx(0.5 - JOINT.acceleration * PERIOD_S)
    assert all(a - b <= JOINT.acceleration * PERIOD_S + 1e-12 for a, b in pairwise(speeds))
    assert speeds[-1] == 0.0
    assert drive.advance(TargetState.DISABLED) is False
    read(drive, 0.5)
    assert drive.advance(TargetState.DISABLED)
    assert sent(drive)[2] == STAND


def test_the_ramp_ends_at_the_end_of_the_range() -> None:
    end = JOINT.position.max
    drive = enabled(end - 0.001)
    drive.target_position = end - 0.001 + LIMIT * PERIOD_S / 5
    sent(drive)
    for _ in range(200):
        read(drive, end - 0.001)
        drive.advance(TargetState.QUICK_STOPPED)
        position, speed, command = sent(drive)
        assert position <= end
        # The controller would go on at a speed, so none leads out of the range.
        assert speed == 0.0 or position < end
        assert command == STOP
    assert position == end


def test_a_drive_that_does_not_follow_yet_is_enabled_where_the_joint_is_then() -> None:
    drive = made()
    read(drive, 0.5, DriveState.SWITCHED_ON, Missing.CONTROL)
    drive.advance(TargetState.ENABLED)
    sent(drive)
    read(drive, 0.8, DriveState.SWITCHED_ON, Missing.CONTROL)  # moved by the controller meanwhile
    drive.advance(TargetState.ENABLED)
    sent(drive)
    read(drive, 0.8)
    assert drive.advance(TargetState.ENABLED)
    assert sent(drive) == (0.8, 0.0, FOLLOW)


def test_after_a_session_that_began_anew_the_ramp_does_not_go_on() -> None:
    drive = enabled()
    drive.target_position = 0.5 + 0.5 * PERIOD_S
    sent(drive)
    read(drive, 0.4, DriveState.SWITCHED_ON)
    drive.advance(TargetState.QUICK_STOPPED)
    assert sent(drive) == (0.4, 0.0, STAND)


def moving(speed: float = 0.5) -> JointDrive:
    """A drive whose last reference had a speed, rad/s."""
    drive = enabled()
    drive.target_position = 0.5 + speed * PERIOD_S
    sent(drive)
    return drive


def test_what_was_not_sent_in_lost_cycles_is_no_standstill() -> None:
    drive = moving()
    last = sent(drive)
    assert last[1] == pytest.approx(0.5)
    assert [sent(drive) for _ in range(3)] == [last] * 3


def test_a_quick_stop_after_lost_cycles_begins_where_the_controller_has_gone_on_to() -> None:
    drive = moving()
    for _ in range(10):
        sent(drive)
    drive.advance(TargetState.QUICK_STOPPED)
    position, speed, command = sent(drive)
    slower = 0.5 - JOINT.acceleration * PERIOD_S
    assert (speed, command) == (pytest.approx(slower), STOP)
    assert position == pytest.approx(0.5 + (0.5 * 11 + slower) * PERIOD_S)


@pytest.mark.parametrize("goal", [TargetState.DISABLED, TargetState.TORQUE_OFF, TargetState.RESET])
def test_a_joint_that_moves_comes_to_rest_by_its_ramp_before_anything_else(goal: TargetState) -> None:
    drive = moving()
    read(drive, 0.5)
    assert not drive.advance(goal)
    assert 0.0 < sent(drive)[1] < 0.5
    for _ in range(100):
        read(drive, 0.5)
        drive.advance(goal)
        sent(drive)
    read(drive, 0.5)
    assert drive.advance(goal)
    assert sent(drive)[1:] == (0.0, STAND)


def test_a_quick_stop_outside_the_range_does_not_jump_to_its_end() -> None:
    drive = enabled(JOINT.position.max + 0.01)
    read(drive, JOINT.position.max + 0.01)
    drive.advance(TargetState.QUICK_STOPPED)
    assert sent(drive) == (pytest.approx(JOINT.position.max + 0.01), 0.0, STOP)


def test_positions_count_from_the_zero() -> None:
    drive = enabled(0.5, zero=0.2)
    assert drive.position == pytest.approx(0.3)
    assert sent(drive)[0] == pytest.approx(0.5)


def test_modes_are_positions_and_speeds() -> None:
    assert [mode for mode in (CSP, CSV, CST) if made().supports(mode)] == [CSP, CSV]


@given(st.lists(st.tuples(st.floats(), st.floats(), st.sampled_from(TargetState), st.sampled_from(DriveState),
                          st.sampled_from([CSP, CSV])), max_size=30))  # fmt: skip
def test_no_speed_is_above_the_limit_whatever_is_asked(
    steps: list[tuple[float, float, TargetState, DriveState, int]],
) -> None:
    drive = made()
    for position, speed, goal, state, mode in steps:
        read(drive, 0.1, state)
        drive.advance(goal)
        drive.mode = mode
        drive.target_position, drive.target_velocity = position, speed
        target, velocity, _ = sent(drive)
        assert abs(velocity) <= LIMIT
        assert math.isfinite(target)


def test_before_the_first_message_the_connection_is_missing() -> None:
    assert made().missing is Missing.CONNECTION
