"""`rtcp device try`: no motion without a free shaft, the drive ends disabled, and the wrong number is named."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from rtcp.cli.bench import Cause, diagnose
from rtcp.cli.output import ExitCode
from rtcp.config.loader import load
from rtcp.config.scaling import DriveScaling
from rtcp.ipc.session import Session

Rtcp = Callable[..., Any]
GEARED = DriveScaling(encoder_increments=524288, gear_ratio=100)
BARE = DriveScaling(encoder_increments=65536)


@pytest.mark.parametrize(
    ("reported", "seen", "scaling", "causes", "words"),
    [
        (1.0, 1.0, GEARED, [], ""),
        (1.02, 1.2, GEARED, [], ""),
        (1.0, -1.0, GEARED, [Cause.SIGN], "external_gear_ratio"),
        (1.0, 100.0, GEARED, [Cause.GEAR], "`gear_ratio` is 1"),
        (1.0, -0.01 / 0.05, DriveScaling(65536, 5), [Cause.SIGN, Cause.GEAR], "1 / `gear_ratio`"),
        (1.0, 0.125, BARE, [Cause.GEAR], "a gear of about 8:1"),
        (1.0, 4.0, GEARED, [Cause.ENCODER], "about 131072 fits"),
        (1.0, 6.5, GEARED, [Cause.SCALING], "6.5 times too large"),
        (1.0, 6.5, None, [Cause.SCALING], "multiply the factors"),
        (1.0, 0.0, GEARED, [Cause.GEAR], "coupling"),
        (0.0, 1.0, GEARED, [Cause.ENCODER], "not that of this shaft's encoder"),
        (0.0, 0.0, GEARED, [Cause.NO_MOTION], "brake"),
        (-1.0, -1.0, GEARED, [Cause.ENCODER], "against the motor's sense"),
        (2.0, 2.0, GEARED, [Cause.ENCODER], "counts in another unit"),
        (2.0, 1.0, GEARED, [Cause.ENCODER], "counts in another unit"),
        (-2.0, 1.0, GEARED, [Cause.ENCODER], "against the motor's sense"),
    ],
)  # fmt: skip
def test_the_number_that_is_wrong_is_named(
    reported: float, seen: float, scaling: DriveScaling | None, causes: list[Cause], words: str
) -> None:
    for turned in (1.0, -1.0):  # a joint near its upper end turns the other way first
        found = diagnose(turned, turned * reported, turned * seen, scaling)
        assert [entry.cause for entry in found] == causes
        assert words in " ".join(entry.remedy for entry in found)


def test_a_motion_that_a_fault_ended_early_is_judged_by_what_was_turned_until_then() -> None:
    # 1 degree was commanded; the supervision of the speed stopped a shaft without the gear of the file.
    (gear,) = diagnose(1.0, 0.026, 1.3, DriveScaling(131072, 50), ended_early=True)
    assert gear.cause is Cause.GEAR
    assert diagnose(1.0, 0.4, 0.4, GEARED, ended_early=True) == []
    (too_little,) = diagnose(1.0, 0.026, 0.0, GEARED, ended_early=True)
    assert too_little.cause is Cause.NO_MOTION


@pytest.fixture
def bench(platform: Any, directory: Path, arm: Path) -> Any:
    """A platform of one joint, whose drive is disabled; `turns` is what it reports for each radian commanded."""
    Session(load(arm.with_name("one_actuator.yaml")), "virtual", "ecat0", 0, time.monotonic_ns()).write(directory)
    platform.status |= {"state": "ready", "joint_names": ["joint1"], "drive_states": ["switch on disabled"]}
    platform.status["joints"] = {key: [0.0] for key in platform.status["joints"]}
    platform.turns = 1.0

    def move_by(asked: dict[str, Any]) -> dict[str, Any]:
        (before,) = platform.status["joints"]["actual_position"]
        position = [before + platform.turns * asked["offset"][0]]
        platform.status["joints"] = platform.status["joints"] | {"actual_position": position}
        return {"positions": position, "error": 0.0}

    numbers = {"min": -3.0, "max": 2.0, "velocity": 0.5, "acceleration": 2.0, "jerk": 20.0, "torque": 49.0}
    limits = {key: [number] for key, number in numbers.items()}
    platform.answers |= {"move_by": move_by, "limits": {"joint_names": ["joint1"], "limits": limits}}
    return platform


@pytest.fixture
def answers(tmp_path: Path) -> Callable[..., str]:
    def write(**given: Any) -> str:
        file = tmp_path / "answers.yaml"
        file.write_text(yaml.safe_dump({"drive1": {"free_shaft": True, "seen_deg": 1.0, **given}}))
        return str(file)

    return write


def test_a_sound_axis_turns_a_degree_and_back_and_ends_disabled(
    bench: Any, rtcp: Rtcp, answers: Callable[..., str]
) -> None:
    ended = rtcp("device", "try", "drive1", "--axis", "1", "--answers", answers())
    assert (ended.code, ended.err) == (0, "")
    assert "commanded, reported and seen motion agree" in ended.out
    degree = math.radians(1.0)
    turns = [(asked["offset"][0], asked["speed"]) for asked in bench.asked("move_by")]
    assert turns == [(pytest.approx(degree), degree), (pytest.approx(-degree), degree)]
    assert [name for name in bench.methods if name in ("enable", "move_by", "disable")] == [
        "enable", "move_by", "move_by", "disable",
    ]  # fmt: skip


def test_a_shaft_that_was_seen_to_turn_wrongly_is_a_fault_with_its_cause(
    bench: Any, rtcp: Rtcp, answers: Callable[..., str]
) -> None:
    ended = rtcp("device", "try", "drive1", "--answers", answers(seen_deg=-1.0))
    assert ended.code == ExitCode.FAULT
    assert "sign: the shaft turned the other way" in ended.out
    assert "drive1 did not turn as commanded: sign" in ended.trouble


@pytest.mark.parametrize(
    ("given", "code"),
    [({"free_shaft": False}, 3), ({"free_shaft": "yes"}, 2), ({"free_shaft": None}, 2)],
)
def test_without_a_free_shaft_nothing_is_enabled(
    bench: Any, rtcp: Rtcp, answers: Callable[..., str], given: dict[str, Any], code: int
) -> None:
    assert rtcp("device", "try", "drive1", "--answers", answers(**given)).code == code
    assert not {"enable", "move_by"} & set(bench.methods)


def test_on_a_network_interface_a_file_does_not_say_that_the_shaft_is_free(
    bench: Any, rtcp_process: Callable[..., Any], answers: Callable[..., str]
) -> None:
    bench.status["bus"] = "eth0"
    command = rtcp_process("device", "try", "drive1", "--answers", answers())
    shown, trouble = command.communicate()
    assert "Is the shaft free" in shown
    assert "standard input has ended at a question: a person answers it at a terminal" in trouble
    assert not {"enable", "move_by"} & set(bench.methods)


def test_an_arm_of_several_joints_and_an_axis_that_moves_none_are_refused(
    bench: Any, rtcp: Rtcp, answers: Callable[..., str], directory: Path, arm: Path
) -> None:
    ended = rtcp("device", "try", "drive1", "--axis", "2", "--answers", answers())
    assert (ended.code, "is moved by drive1, axis 2: found are drive1 --axis 1" in ended.trouble) == (2, True)
    Session(load(arm), "virtual", "ecat0", 0, time.monotonic_ns()).write(directory)
    ended = rtcp("device", "try", "drive1", "--answers", answers())
    assert ended.code == ExitCode.REFUSED
    assert "further drives, which would get torque too: joint2, joint3" in ended.trouble
    assert not {"enable", "move_by"} & set(bench.methods)


def test_a_motion_that_ends_in_a_fault_is_diagnosed_and_the_drive_disabled(
    bench: Any, rtcp: Rtcp, answers: Callable[..., str]
) -> None:
    bench.refusals["move_by"] = ("fault", "drive1 reports following-error")
    ended = rtcp("device", "try", "drive1", "--answers", answers())
    assert ended.code == ExitCode.FAULT
    assert "the motion ended with: drive1 reports following-error" in ended.out
    assert "encoder: the shaft turned, and the drive reports none of it" in ended.out
    assert "disable" in bench.methods


def test_a_drive_that_cannot_be_disabled_afterwards_is_a_fault(
    bench: Any, rtcp: Rtcp, answers: Callable[..., str]
) -> None:
    bench.refusals["disable"] = ("timeout", "no answer")
    ended = rtcp("device", "try", "drive1", "--answers", answers())
    assert ended.code == ExitCode.FAULT
    assert "the drive may still have torque, it could not be disabled: no answer" in ended.trouble


def test_ctrl_c_stops_and_disables(bench: Any, rtcp_process: Callable[..., Any], answers: Callable[..., str]) -> None:
    moving, ended = threading.Event(), threading.Event()

    def move_by(asked: dict[str, Any]) -> dict[str, Any]:
        moving.set()
        ended.wait()
        return {"positions": [0.0], "error": 0.0}

    bench.answers["move_by"] = move_by
    command = rtcp_process("device", "try", "drive1", "--answers", answers())
    moving.wait()
    command.send_signal(signal.SIGINT)
    ended.set()
    _, trouble = command.communicate()
    assert command.returncode == ExitCode.INTERRUPTED
    assert "interrupted: the shaft comes to a stop, and the drive is disabled" in trouble
    assert bench.methods.count("move_by") == 1
    assert "disable" in bench.methods
