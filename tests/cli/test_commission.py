"""`rtcp commission`: no motion without a yes, and a record of what was found."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from rtcp.cli.output import ExitCode
from rtcp.config.loader import load
from rtcp.ipc.session import Session

GIVEN = {"encoder_calibrated": True, "electrical_offset": 3.3749, "clear": True, "direction": True}


@pytest.fixture
def drives(platform: Any, directory: Path, arm: Path) -> Any:
    """A platform whose drives are disabled, of the arm in the test's own folder."""
    Session(load(arm), "virtual", "ecat0", 0, time.monotonic_ns()).write(directory)
    platform.status["state"] = "ready"
    platform.missed = {}

    def move_by(asked: dict[str, Any]) -> dict[str, Any]:
        joints = platform.status["joints"]
        turned = enumerate(zip(joints["actual_position"], asked["offset"], strict=True))
        position = [q + platform.missed.get(joint, offset) for joint, (q, offset) in turned]
        platform.status["joints"] = joints | {"actual_position": position}
        return {"positions": position, "error": 0.0004}

    numbers = {"min": -3.0, "max": 2.0, "velocity": 0.5, "acceleration": 2.0, "jerk": 20.0, "torque": 49.0}
    limits = {key: [number] * 6 for key, number in numbers.items()}
    platform.answers |= {
        "move_by": move_by,
        "limits": {"joint_names": platform.status["joint_names"], "limits": limits},
    }
    return platform


@pytest.fixture
def answers(tmp_path: Path) -> Callable[..., str]:
    def write(joint: str = "joint2", **changes: Any) -> str:
        file = tmp_path / "answers.yaml"
        file.write_text(yaml.safe_dump({joint: {**GIVEN, **changes}}))
        return str(file)

    return write


def record_of(arm: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(arm.with_suffix(".commissioning.yaml").read_text())
    return found


def test_one_joint_turns_and_turns_back_and_the_record_has_what_was_found(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], arm: Path
) -> None:
    ended = rtcp("commission", "joint2", "--answers", answers())
    assert (ended.code, ended.err) == (0, "")
    turns = [(asked["offset"], asked["frame"], asked["speed"]) for asked in drives.asked("move_by")]
    there = [0.0, 0.02, 0.0, 0.0, 0.0, 0.0]
    assert turns == [(there, "joints", 0.05), ([-angle for angle in there], "joints", 0.05)]
    moved = [method for method in drives.methods if method in ("enable", "move_by", "disable")]
    assert moved == ["enable", "move_by", "move_by", "disable"]
    entry = record_of(arm)["joints"]["joint2"]
    found = {"slave": "drive2", "bus": "virtual", "electrical_offset": 3.3749, "start": -0.2, "torque": -2.0}
    assert entry.items() >= (found | {"encoder_calibrated": True, "angle": 0.02, "passed": True}).items()
    assert (entry["moved"], entry["returned"]) == (pytest.approx(0.02), pytest.approx(0.0))


@pytest.mark.parametrize(
    ("missed", "sentence"),
    [
        ({1: 0.0}, "joint2 was to turn by +0.02 rad, but turned by +0.0000 rad"),
        ({1: -0.02}, "joint2 was to turn by +0.02 rad, but turned by -0.0200 rad"),
        ({1: 0.05}, "joint2 was to turn by +0.02 rad, but turned by +0.0500 rad"),
        ({3: 0.006}, "joint2 was to turn alone, but so did joint4"),
    ],
    ids=["it did not move", "the other way", "too far", "another joint moved"],
)
def test_a_joint_that_did_not_move_as_commanded_has_not_passed(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], arm: Path, missed: Any, sentence: str
) -> None:
    drives.missed |= missed
    ended = rtcp("commission", "joint2", "--answers", answers())
    assert ended.code == ExitCode.FAULT
    assert sentence in ended.trouble
    assert "disable" in drives.methods
    assert record_of(arm)["joints"]["joint2"]["passed"] is False


def test_the_motion_keeps_to_the_limits_in_force(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str]
) -> None:
    limits = drives.answers["limits"]["limits"]
    limits["max"][1], limits["velocity"][1] = 1.4, 0.03
    drives.status["joints"]["actual_position"] = [0.0, 1.39, 0.0, 0.0, 0.0, 0.0]
    assert rtcp("commission", "joint2", "--answers", answers()).code == 0
    turns = [(asked["offset"][1], asked["speed"]) for asked in drives.asked("move_by")]
    assert turns == [(-0.02, 0.03), (0.02, 0.03)]


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"encoder_calibrated": False}, ExitCode.REFUSED),
        ({"clear": False}, ExitCode.REFUSED),
        ({"clear": "yes"}, ExitCode.USAGE),
        ({"electrical_offset": 337.49}, ExitCode.USAGE),
        ({"electrical_offset": float("nan")}, ExitCode.USAGE),
    ],
)
def test_an_answer_that_is_not_yes_moves_nothing(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], arm: Path, changes: Any, code: int
) -> None:
    ended = rtcp("commission", "joint2", "--answers", answers(**changes))
    assert ended.code == code
    assert not {"enable", "move_by"} & set(drives.methods)
    assert record_of(arm)["joints"]["joint2"]["passed"] is False


def test_on_a_network_interface_a_file_does_not_say_that_nobody_is_in_reach(
    drives: Any, rtcp_process: Callable[..., Any], answers: Callable[..., str]
) -> None:
    drives.status["bus"] = "eth0"
    command = rtcp_process("commission", "joint2", "--answers", answers())
    shown, trouble = command.communicate()
    assert "Is nobody in reach" in shown
    assert "standard input has ended at a question: a person answers it at a terminal" in trouble
    assert command.returncode == ExitCode.USAGE
    assert not {"enable", "move_by"} & set(drives.methods)


def test_a_joint_that_turned_the_wrong_way_has_not_passed(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], arm: Path
) -> None:
    ended = rtcp("commission", "joint2", "--answers", answers(direction=False))
    assert ended.code == ExitCode.FAULT
    assert drives.methods[-1] != "move_by"
    assert record_of(arm)["joints"]["joint2"]["passed"] is False


def test_a_motion_that_fails_disables_the_drives(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], arm: Path
) -> None:
    drives.refusals["move_by"] = ("fault", "drive2 reports over-current")
    assert rtcp("commission", "joint2", "--answers", answers()).code == ExitCode.FAULT
    assert drives.methods[-1] == "disable"
    assert record_of(arm)["joints"]["joint2"]["passed"] is False


def test_an_enabled_arm_is_not_commissioned_and_a_joint_that_passed_stays_so(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], arm: Path
) -> None:
    assert rtcp("commission", "joint2", "--answers", answers()).code == 0
    drives.status["state"] = "holding"
    assert rtcp("commission", "joint2", "--answers", answers()).code == ExitCode.REFUSED
    assert record_of(arm)["joints"]["joint2"]["passed"] is True


def test_without_a_name_the_joints_that_have_not_passed_follow(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str]
) -> None:
    assert rtcp("commission", "joint1", "--answers", answers("joint1")).code == 0
    ended = rtcp("commission", "--answers", answers())
    assert "joint1 has passed already" in ended.out
    assert "joint2 has passed" in ended.out
    assert "joint3.encoder_calibrated is missing" in ended.err


def test_the_record_of_another_arm_is_not_overwritten(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], arm: Path
) -> None:
    file = arm.with_suffix(".commissioning.yaml")
    file.write_text("arm: other-arm\njoints: {}\n")
    assert rtcp("commission", "--answers", answers()).code == ExitCode.USAGE
    assert file.read_text().startswith("arm: other-arm")
    assert "enable" not in drives.methods


def test_a_place_where_no_record_can_be_written_is_noticed_before_anything_moves(
    drives: Any, rtcp: Callable[..., Any], answers: Callable[..., str], tmp_path: Path
) -> None:
    out = str(tmp_path / "missing" / "record.yaml")
    ended = rtcp("commission", "joint2", "--answers", answers(), "--out", out)
    assert ended.code == ExitCode.USAGE
    assert "enable" not in drives.methods
