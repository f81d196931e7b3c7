"""The status: its message, and its fields when the loop is silent; the loop is fake."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kinematics.forward import forward
from kinematics.jacobian import jacobian
from rtcp.config import default_config, load
from rtcp.gateway import status_snapshot
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import (
    Arrived,
    DriveFault,
    EmergencyMessage,
    EmergencyStopActivated,
    ErrorReported,
    ErrorReset,
)
from rtcp.ipc.observer import Observer
from rtcp.ipc.schema import (
    FLAG_DC_LOCKED,
    HELD_BOX_AT,
    HELD_RANGE_AT,
    HELD_SHOULDER,
)
from rtcp.ipc.session import Processes, Session
from rtcp.ipc.states import DriveState, State
from tests.records import numbers

JOINTS = 6


class Written:
    """A blackboard that a test writes, and the snapshot of it."""

    def __init__(self, board: Blackboard, path: Path) -> None:
        self.board = board
        self.observer = Observer(path)
        self.snapshot = StatusSnapshot(self.observer, Session(load(default_config()), "virtual", "ecat0", 0, 0), {})

    def publish(self, state: State, moves: int = 0, wkc: int = 21, held: int = 0, **joints: Any) -> None:
        record = {"state": state, "moves": moves, "wkc": wkc, "wkc_expected": 21, "flags": FLAG_DC_LOCKED, "held": held}
        joints.setdefault("speed_override", 1.0)
        self.board.publish(numbers(self.board.schema, **record, time_ns=time.monotonic_ns(), **joints))

    @property
    def status(self) -> dict[str, Any]:
        self.snapshot.follow()
        return self.snapshot.status(Processes(), [0.1] * JOINTS)

    @property
    def headline(self) -> str:
        return str(self.status["message"])


@pytest.fixture
def written(board: Blackboard, path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Written]:
    monkeypatch.setattr(status_snapshot, "_SILENT_S", 1e9)  # so that a busy host does not count as a silent loop
    made = Written(board, path)
    yield made
    made.observer.close()


def test_an_emergency_stop_out_of_a_fault_replaces_the_message_of_the_fault(written: Written) -> None:
    written.publish(State.FAULT)
    written.board.event(DriveFault(2, DriveState.FAULT, 0x0218))
    assert "joint3" in written.headline
    written.publish(State.EMERGENCY_STOP)
    written.board.event(EmergencyStopActivated())
    assert written.headline.startswith("the emergency stop is pressed")


def test_an_emergency_with_error_code_0_is_listed_and_never_the_message(written: Written) -> None:
    written.publish(State.READY)
    written.board.event(ErrorReported("something to know"))
    written.board.event(ErrorReset(2, 0, 0, 0))
    assert written.headline == "something to know"
    assert written.status["messages"][1].startswith("slave 2 (drive1) sent emergency 0x0000: error reset")
    written.board.event(EmergencyMessage(2, 0x8611, 0, 0))
    assert written.headline.startswith("slave 2 (drive1) sent emergency 0x8611: following error")


def test_while_the_arm_moves_the_message_is_not_the_end_of_the_last_motion(written: Written) -> None:
    written.publish(State.MOVING, moves=1)
    written.board.event(Arrived())
    written.publish(State.HOLDING, moves=1)
    arrived = written.headline
    assert arrived == "the motion is complete"
    time.sleep(0.002)
    written.publish(State.MOVING, moves=2)
    assert written.headline == "moving"
    time.sleep(0.002)
    written.board.event(ErrorReported("said meanwhile"))
    written.publish(State.MOVING, moves=2)
    assert written.headline == "said meanwhile"
    time.sleep(0.002)
    # The next motion begins without a cycle of rest between.
    written.publish(State.MOVING, moves=3)
    assert written.headline == "moving"
    written.publish(State.MOVING, moves=3, speed_override=0.0)
    assert written.headline == "paused: the motion rests on its path"
    written.publish(State.STOPPING, moves=3)
    assert written.headline == "stopping"
    written.board.event(Arrived())
    written.publish(State.HOLDING, moves=3)
    assert written.headline == arrived


def test_a_wall_clock_that_is_set_forward_hides_no_message_of_the_motion(
    written: Written, monkeypatch: pytest.MonkeyPatch
) -> None:
    written.publish(State.MOVING, moves=1)
    time.sleep(0.002)
    written.board.event(ErrorReported("said meanwhile"))
    own = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: own() + 3600 * 10**9)
    assert written.headline == "said meanwhile"


def test_while_a_motion_is_limited_the_message_says_by_what_and_a_later_message_comes_first(written: Written) -> None:
    written.publish(State.MOVING, moves=1, held=HELD_SHOULDER << 1 | 3 << HELD_RANGE_AT)
    status = written.status
    assert list(status["limited_by"]) == ["joint3 range", "elbow"]
    assert status["message"] == "moving, limited: " + "; ".join(status["limited_by"].values())
    time.sleep(0.002)
    written.board.event(ErrorReported("said meanwhile"))
    written.publish(State.MOVING, moves=1, held=HELD_SHOULDER)
    assert written.headline == "said meanwhile"
    written.publish(State.HOLDING, moves=1, held=HELD_SHOULDER)
    assert written.status["limited_by"] == {}


def test_a_joint_that_a_guard_cuts_and_a_keep_out_box_are_named_with_their_keys(written: Written) -> None:
    written.publish(State.MOVING, held=0b10 | 2 << HELD_BOX_AT)
    limits = written.status["limited_by"]
    assert limits["joint2"] == "a guard cuts the target of joint2 (limits of joints[1] in assistive_arm.yaml)"
    assert limits["box"].endswith("from the keep-out box user (cartesian.keep_out[0] in assistive_arm.yaml)")


def test_a_silent_loop_is_reported_with_the_way_out_and_its_last_values_do_not_count(
    written: Written, monkeypatch: pytest.MonkeyPatch
) -> None:
    written.publish(State.MOVING)
    status = written.status
    assert (status["wkc"]["actual"], status["dc"]["locked"], status["goal"]) == (21, True, [0.1] * JOINTS)
    monkeypatch.setattr(status_snapshot, "_SILENT_S", -1.0)
    status = written.status
    assert "has published nothing for " in status["message"]
    assert " s; the drives' watchdog stops them" in status["message"]
    assert "`rtcp stop`, then `rtcp start`, if it stays so" in status["message"]
    assert (status["wkc"]["actual"], status["dc"]["locked"], status["goal"]) == (-1, False, None)


def test_pose_and_velocity_of_the_tool_are_those_of_the_measured_joints(written: Written) -> None:
    q, rates = [0.1, 0.3, 1.5, -0.2, 0.5, 0.4], [0.2, -0.1, 0.05, 0.3, -0.4, 1.0]
    written.publish(State.HOLDING, actual_position=q, actual_velocity=rates, commanded_position=[0.0] * JOINTS)
    tool, model = written.status["tool"], load(default_config()).arm
    assert model is not None
    for name, joints in (("pose", q), ("commanded_pose", [0.0] * JOINTS)):
        pose = forward(model, joints)
        assert tool[name] == pytest.approx([*pose.position, *pose.rpy], abs=1e-7)
    assert tool["velocity"] == pytest.approx(np.array(jacobian(model, q)) @ rates, abs=1e-7)


def test_one_lost_frame_is_one_cycle_of_the_last_second_and_not_the_platforms_state(written: Written) -> None:
    for wkc in (21, 21, 18, 21, -1):
        written.publish(State.READY, wkc=wkc)
    status = written.status
    assert status["wkc"] == {"expected": 21, "actual": 21}
    assert status["last_second"] == {"cycles": 5, "unanswered": 1, "incomplete": 1, "tracked": 4}
    written.publish(State.READY, wkc=18)
    assert written.status["wkc"]["actual"] == 18


def test_what_is_older_than_a_second_does_not_count(written: Written, monkeypatch: pytest.MonkeyPatch) -> None:
    written.publish(State.READY)
    written.publish(State.READY)
    assert written.status["last_second"]["cycles"] > 0
    monkeypatch.setattr(status_snapshot, "_SECOND_NS", 0)
    status = written.status
    assert (status["last_second"]["cycles"], status["wkc"]["actual"]) == (0, -1)
