"""`rtcp enable`, `disable`, `reset`, `mode`, `output`, `gripper`, `zero`, `home`, `move`, `run`."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.api import Progress, Refused
from rtcp.cli.output import ExitCode, progress
from rtcp.ipc.commands import Command, Disable, Halt
from rtcp.ipc.runtime_directory import blackboard_file
from tests.gateway.fake_loop import RunningLoop

HOME = ("0", "0", "0", "0", "0", "0")


@pytest.mark.parametrize("verb", ["enable", "disable", "reset", "halt"])
def test_a_plain_verb_is_passed_on_and_answered_with_a_sentence(
    platform: Any, rtcp: Callable[..., Any], verb: str
) -> None:
    ended = rtcp(verb)
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.strip()
    assert platform.asked(verb) == [{}]


@pytest.mark.parametrize("kind", [Halt, Disable])
def test_a_stop_reaches_the_loop_where_no_gateway_can_be_reached(
    rtcp: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type[Command]
) -> None:
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path))
    loop = RunningLoop(blackboard_file(tmp_path))
    try:
        ended = rtcp(kind.name)
        assert ended.code == ExitCode.NOT_RUNNING
        assert "the loop has taken it" in ended.err
        assert loop.kinds == [kind]
    finally:
        loop.end()
        blackboard_file(tmp_path).unlink()


def test_a_drive_whose_torque_is_not_looked_at_is_named_when_the_others_are_disabled(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    assert rtcp("disable").out == "disabled: the drives are without torque\n"
    platform.answers["disable"] = {"unconfirmed": ["finger (drive7)"]}
    words = "disabled: the drives are without torque; also disabled, but not observed in the cycle: finger (drive7)\n"
    assert rtcp("disable").out == words


def test_who_disables_an_arm_behind_its_controller_is_told_who_holds_it(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    platform.status["lacks"] = {"power": "only people at the robot controller switch its motors on"}
    assert rtcp("disable").out == "disabled: the arm stands, held by its robot controller with the motors on\n"


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ("holding", "nothing to reset: the arm is enabled and holds\n"),
        ("fault", "no fault is left; next: `rtcp enable`\n"),
        ("stopped_by_limit", "the arm holds and accepts commands again\n"),
    ],
)
def test_a_reset_says_whether_the_arm_is_to_be_enabled_next(
    platform: Any, rtcp: Callable[..., Any], state: str, words: str
) -> None:
    platform.answers["reset"] = {"from": state}
    assert rtcp("reset").out.endswith(words)


@pytest.mark.parametrize(
    ("kind", "code"), [("invalid", 2), ("refused", 3), ("fault", 5), ("timeout", 5), ("internal", 1)]
)
def test_each_kind_of_error_has_its_exit_code(platform: Any, rtcp: Callable[..., Any], kind: str, code: int) -> None:
    platform.refusals["enable"] = (kind, "drive3 stays in SWITCH ON DISABLED")
    ended = rtcp("enable")
    assert (ended.code, ended.out) == (code, "")
    assert ended.err == "rtcp: drive3 stays in SWITCH ON DISABLED\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ("enable",),
        ("disable",),
        ("reset",),
        ("halt",),
        ("mode", "csp"),
        ("move", *HOME),
        ("move", "--pose", *HOME),
        ("jog", "x", "0.1", "--seconds", "1"),
        ("joystick", "forward"),
        ("limits", "show"),
        ("limits", "set", "joint1.max", "1"),
        ("output", "3", "on"),
        ("io",),
        ("gripper", "open"),
        ("zero", "joint1"),
        ("home", "1"),
        ("stop",),
    ],
)
def test_without_a_platform_every_command_exits_with_4(rtcp: Callable[..., Any], arguments: tuple[str, ...]) -> None:
    ended = rtcp(*arguments)
    assert ended.code == 4
    assert "no platform is running" in ended.trouble


def test_the_mode_is_sent_in_lower_case(platform: Any, rtcp: Callable[..., Any]) -> None:
    assert rtcp("mode", "CSV").code == 0
    assert platform.asked("mode") == [{"name": "csv"}]


@pytest.mark.parametrize(
    ("arguments", "allowed"), [(("output", "3", "maybe"), "on or off"), (("gripper", "half"), "open or close")]
)
def test_an_unknown_word_is_refused_with_the_known_ones(
    platform: Any, rtcp: Callable[..., Any], arguments: tuple[str, ...], allowed: str
) -> None:
    ended = rtcp(*arguments)
    assert (ended.code, platform.requests) == (2, [])
    assert allowed in ended.trouble


def test_an_output_is_switched_by_number(platform: Any, rtcp: Callable[..., Any]) -> None:
    assert rtcp("output", "3", "on").code == 0
    assert rtcp("output", "4", "OFF", "--box", "desk").code == 0
    assert platform.asked("set_output") == [
        {"output": 3, "value": True, "box": None},
        {"output": 4, "value": False, "box": "desk"},
    ]


@pytest.mark.parametrize(
    ("word", "answer", "text"),
    [
        ("OPEN", {}, "gripper output set to open"),
        ("close", {"position": 0.0, "holds": False}, "the gripper is closed: it rests at 0.0000 rad"),
        ("open", {"position": 1.4, "holds": False}, "the gripper is open: it rests at 1.4000 rad"),
        ("close", {"position": 0.48656, "holds": True}, "the gripper rests at 0.4866 rad: it holds an object"),
    ],
    ids=["on an output", "closed", "open", "holding"],
)
def test_it_is_shown_where_a_gripper_with_a_drive_has_come_to_rest(
    platform: Any, rtcp: Callable[..., Any], word: str, answer: dict[str, Any], text: str
) -> None:
    platform.answers["move_gripper"] = answer
    ended = rtcp("gripper", word)
    assert (ended.code, ended.out) == (0, f"{text}\n")
    assert platform.asked("move_gripper") == [{"open": word.lower() == "open"}]


@pytest.mark.parametrize("joint", ["joint2", "2"])
def test_a_joint_is_zeroed_by_its_name_or_its_number(platform: Any, rtcp: Callable[..., Any], joint: str) -> None:
    platform.answers["zero"] = {"joint": "joint2", "offset": 0.25, "before": 0.0, "file": "/state/zero.yaml"}
    ended = rtcp("zero", joint, "--at", "-0.5")
    assert ended.code == 0
    assert platform.asked("zero") == [{"joint": joint, "at": -0.5}]
    assert "0.250000 rad" in ended.out
    assert "/state/zero.yaml" in ended.out


SWITCH = {
    "joint": "joint6",
    "method": 17,
    "text": "turns to a switch",
    "declares_present": False,
    "home_offset": 0.25,
    "unit": "rad",
}
PRESENT = {**SWITCH, "method": 37, "text": "does not move", "declares_present": True}


def test_homing_says_what_the_drive_will_do_and_reports_where_it_stands(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    platform.answers |= {"homing_method": SWITCH, "home": {"joint": "joint6", "position": 0.5}}
    ended = rtcp("home", "6")
    assert (ended.code, ended.out) == (
        0,
        "the drive of joint6 turns to a switch, by method 17 (0x6098); there it counts 0.25 rad (0x607C)\n"
        "joint6 is homed and stands at 0.500000 rad\n",
    )


@pytest.mark.parametrize(
    ("arguments", "answer", "homed"), [((), "n\n", False), ((), "", False), ((), "y\n", True), (("--yes",), "", True)]
)
def test_homing_asks_before_the_present_position_becomes_the_home(
    platform: Any, rtcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], answer: str,
    homed: bool,
) -> None:  # fmt: skip
    monkeypatch.setattr(sys, "stdin", io.StringIO(answer))
    platform.answers |= {"homing_method": PRESENT, "home": {"joint": "joint6", "position": 0.25}}
    ended = rtcp("home", "joint6", *arguments)
    assert bool(platform.asked("home")) is (ended.code == 0) is homed
    assert ("Is joint6 where its drive shall count 0.25 rad?" in ended.out + ended.trouble) is not bool(arguments)


# -- move -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "speed"),
    [
        (("0", "-0.5", "1.57", "-.5", "-1e-1", "-2"), None),
        (("--", "0", "-0.5", "1.57", "-.5", "-1e-1", "-2"), None),
        (("0", "-0.5", "1.57", "-.5", "-1e-1", "-2", "--speed", "0.2"), 0.2),
        (("--speed=0.2", "--", "0", "-0.5", "1.57", "-.5", "-1e-1", "-2"), 0.2),
        (("0", "-0.5", "--speed", "0.2", "1.57", "-.5", "-1e-1", "-2"), 0.2),
    ],
)
def test_negative_numbers_are_taken_as_they_are_written(
    platform: Any, rtcp: Callable[..., Any], arguments: tuple[str, ...], speed: float | None
) -> None:
    assert rtcp("move", *arguments).code == 0
    assert platform.asked("move_joints") == [
        {"q": [0.0, -0.5, 1.57, -0.5, -0.1, -2.0], "speed": speed, "synchronized": True, "replace": False}
    ]


def test_a_move_prints_its_progress_and_the_largest_error(platform: Any, rtcp: Callable[..., Any]) -> None:
    ended = rtcp("move", *HOME)
    assert "moving:  50%" in ended.out
    assert ended.out.splitlines()[-1] == "arrived, largest error 0.000420 rad"


@pytest.mark.parametrize("help_option", ["-h", "--help"])
def test_help_is_help_among_the_numbers_too(rtcp: Callable[..., Any], help_option: str) -> None:
    ended = rtcp("move", "0", "-0.5", help_option)
    assert ended.code == 0
    assert "--speed" in ended.out


@pytest.mark.parametrize(
    ("number", "code", "text"),
    [
        (signal.SIGINT, 130, "interrupted"),
        (signal.SIGTERM, 143, "interrupted"),
        (signal.SIGHUP, 129, "interrupted"),
        (signal.SIGTSTP, 148, "ended, not suspended"),
        (signal.SIGTTIN, 149, "ended, not suspended"),
        (signal.SIGTTOU, 150, "ended, not suspended"),
    ],
)
def test_an_interrupted_move_closes_its_connection_and_says_that_the_arm_stops(
    platform: Any,
    rtcp_process: Callable[..., Any],
    wait_until: Callable[..., None],
    number: signal.Signals,
    code: int,
    text: str,
) -> None:
    platform.move_steps, platform.step_s = 10_000, 0.01
    moving = rtcp_process("move", *HOME)
    assert "moving" in moving.stdout.readline()
    moving.send_signal(number)
    _, trouble = moving.communicate()
    assert moving.returncode == code
    assert trouble == f"rtcp: {text}: the connection is closed, the arm comes to a controlled stop\n"
    wait_until(platform.left_while_moving.is_set)


def test_a_platform_that_ends_during_a_move_is_a_fault(platform: Any, rtcp_process: Callable[..., Any]) -> None:
    platform.move_steps, platform.step_s = 10_000, 0.01
    moving = rtcp_process("move", *HOME)
    assert platform.moving.wait(20)
    platform.end()
    _, trouble = moving.communicate()
    assert moving.returncode == 5
    assert "closed the connection" in trouble


def test_a_move_goes_on_when_the_reader_of_its_lines_goes_away(platform: Any, rtcp_process: Callable[..., Any]) -> None:
    platform.move_steps = 20
    moving = rtcp_process("move", *HOME)
    moving.stdout.close()
    trouble = moving.stderr.read()
    assert (moving.wait(), trouble) == (0, "")
    assert not platform.left_while_moving.is_set()


def test_on_a_terminal_a_move_draws_a_bar(platform: Any, rtcp_process: Callable[..., Any]) -> None:
    mine, its = pty.openpty()
    moving = rtcp_process("move", *HOME, stdout=its, env={**os.environ, "TERM": "xterm", "COLUMNS": "80"})
    os.close(its)
    output = b""
    try:
        while chunk := os.read(mine, 4096):
            output += chunk
    except OSError:
        pass  # EIO: the terminal's last writer has gone
    os.close(mine)
    assert moving.wait() == 0
    assert "━".encode() in output
    assert b"arrived, largest error" in output


@pytest.mark.parametrize("terminal", [False, True])
def test_while_a_motion_is_planned_and_may_be_refused_no_progress_is_shown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    with contextlib.suppress(Refused), progress() as show_progress:
        show_progress(Progress(fraction=0.0, remaining_s=0.0))
        raise Refused("refused", "outside its range")
    assert capsys.readouterr().out == ""
    with progress() as show_progress:
        show_progress(Progress(fraction=0.0, remaining_s=1.5))
    assert "moving" in capsys.readouterr().out


# -- poses and files ------------------------------------------------------------------------------------------------

POSE = ("-0.4", "-.1", "0.8", "pi/2", "-pi/4", "0")


@pytest.mark.parametrize(
    ("options", "line", "speed"),
    [((), False, None), (("--line",), True, None), (("--line", "--speed", "0.1"), True, 0.1)],
)
def test_a_pose_is_passed_on_with_fractions_of_pi_as_numbers(
    platform: Any, rtcp: Callable[..., Any], options: tuple[str, ...], line: bool, speed: float | None
) -> None:
    assert rtcp("move", "--pose", *POSE, *options).code == 0
    (request,) = platform.asked("move_pose")
    assert request["pose"] == pytest.approx([-0.4, -0.1, 0.8, 1.5707963, -0.7853982, 0.0])
    assert (request["line"], request["speed"]) == (line, speed)


def at_joint_3(value: str) -> tuple[str, ...]:
    return ("move", "0", "0", value, "0", "0", "0")


WRONG = {
    **{
        f"joint 3 at {value}": (at_joint_3(value), f"joint 3: {value} is not finite")
        for value in ("nan", "inf", "-inf", "-nan", "-INF", "1e999")
    },
    **{
        f"joint {joint}, not the only one": (("move", "0", "zero", "0", "nan", "-0.5x", "0"), f"joint {joint}: ")
        for joint in (2, 4, 5)
    },
    **{
        f"option {option}": (("move", *HOME, option, "0.1"), "--speed") for option in ("--sped", "--sped=0.1", "--spee")
    },
    "a short option": (("move", *HOME, "-s", "0.1"), "-s"),
    **{f"speed {speed}": (("move", *HOME, "--speed", speed), "--speed") for speed in ("0", "-1", "nan", "inf", "fast")},
    "five numbers": (("move", "--pose", *POSE[:5]), "5 numbers for a pose of 6: give X Y Z RX RY RZ"),
    "a length as a fraction of pi": (("move", "--pose", "pi", *POSE[1:]), "x: 'pi' is not a number (m)"),
    "an angle that is not finite": (("move", "--pose", *POSE[:5], "inf"), "rz: inf is not finite"),
    "a line without a pose": (("move", "--line", *HOME), "--line is for a pose"),
    "each joint at its best for a pose": (
        ("move", "--unsynchronized", "--pose", *POSE),
        "--unsynchronized is for joint positions",
    ),
    "a misspelt option": (("move", "--pose", *POSE, "--lin"), "did you mean --line?"),
    "a speed of a line": (("move", "--pose", *POSE, "--line", "--speed", "0"), "--speed 0 is not allowed: a finite"),
}


@pytest.mark.parametrize(("arguments", "sentence"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_argument_of_a_move_is_refused_by_name(
    platform: Any, rtcp: Callable[..., Any], arguments: tuple[str, ...], sentence: str
) -> None:
    ended = rtcp(*arguments)
    assert (ended.code, platform.requests) == (2, [])
    assert sentence in ended.trouble


def test_each_joint_at_its_best_is_passed_on(platform: Any, rtcp: Callable[..., Any]) -> None:
    assert rtcp("move", *HOME, "--unsynchronized").code == 0
    assert platform.asked("move_joints")[0]["synchronized"] is False


def test_a_file_is_named_by_its_whole_path(
    platform: Any, rtcp: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "t.csv").write_text("t,q1,q2,q3,q4,q5,q6\n1,0,0,0,0,0,0\n")
    monkeypatch.chdir(tmp_path)
    ended = rtcp("run", "t.csv", "--approach")
    assert ended.code == 0
    assert "moving:  50%" in ended.out
    assert platform.asked("run") == [{"file": str(tmp_path / "t.csv"), "approach": True}]


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("t.csv", "t,q1\n1,0\n1,0\n", "t: found 1 after 1; times must rise"),
        ("t.csv", "t,q1\n1,nan\n", "t.csv:2: q1: found nan, allowed is a finite number"),
        ("t.yaml", "way: []\n", "way"),
        ("t.txt", "", "allowed are .yaml, .yml and .csv"),
    ],
)
def test_a_mistake_in_a_file_is_reported_without_a_platform(
    rtcp: Callable[..., Any], tmp_path: Path, name: str, text: str, sentence: str
) -> None:
    (tmp_path / name).write_text(text)
    ended = rtcp("run", str(tmp_path / name))
    assert ended.code == 2
    assert sentence in ended.trouble


def test_the_end_of_a_path_shows_its_length_and_whether_joints_slowed_it(
    platform: Any, rtcp: Callable[..., Any]
) -> None:  # fmt: skip
    platform.answers["move_pose"] = {
        "positions": [],
        "error": 0.0001,
        "length_m": 0.2,
        "duration_s": 4.25,
        "slowed": 0.5,
    }
    ended = rtcp("move", "--pose", *POSE, "--line")
    line = "arrived, largest error 0.000100 rad, 0.200 m, in 4.2 s, slowed to 50% of its speed by the joints' limits\n"
    assert ended.out == line
