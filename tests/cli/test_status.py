"""`rtcp status`."""

from __future__ import annotations

import json
import os
import signal
import socket
import time
from collections.abc import Callable
from typing import Any

import pytest

from rtcp.ipc.session import Processes, identify


def test_status_shows_state_joints_slaves_times_and_clocks(platform: Any, rtcp: Callable[..., Any]) -> None:
    ended = rtcp("status")
    assert ended.code == 0
    for text in (
        "HOLDING", "csp on virtual", "every 500 us", "123 456 cycles, 2 missed", "enabled: the arm holds",
        "joint6", "-1.2346", "+3.0000", "drive6", "105.5", "working counter 21 of 21", "locked, offset -3.2 us",
        "filtered +0.4 us", "0000 0000 0011 1111", "1000 0000 0000 0001", "FIFO 80, memory locked, CPU 1", "loop 11",
    ):  # fmt: skip
        assert text in ended.out


def test_status_shows_the_pose_and_the_speeds_of_the_tool_where_the_geometry_is_known(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    line = "+0.1000 -0.2000 +0.9000 m, +0.0000 +0.5000 -1.0000 rad, 0.050 m/s, 0.200 rad/s"
    assert line in " ".join(rtcp("status").out.split())
    platform.status["tool"] = None
    result = rtcp("status")
    assert (result.code, " m/s" in result.out) == (0, False)


def test_status_fits_eighty_columns_without_colour_in_a_pipe(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.status["message"] = "a long sentence about what went wrong with the drive of joint 3 " * 3
    platform.status["realtime"]["notes"] = ["SCHED_FIFO is refused to this user: allow it by rtprio in limits.conf"] * 2
    ended = rtcp("status")
    assert "\x1b" not in ended.out
    assert max(len(line) for line in ended.out.splitlines()) <= 80


def test_square_brackets_in_a_message_are_shown_as_they_are(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.status["message"] = "slaves[3].device is [red]wrong[/red]"
    assert "slaves[3].device is [red]wrong[/red]" in rtcp("status").out


def test_the_json_is_the_platforms_own_answer_on_one_line(platform: Any, rtcp: Callable[..., Any]) -> None:
    ended = rtcp("status", "--json")
    assert ended.code == 0
    assert ended.out.count("\n") == 1
    assert json.loads(ended.out) == platform.status


def test_without_a_platform_status_says_so_and_exits_with_4(rtcp: Callable[..., Any]) -> None:
    ended = rtcp("status", "--json")
    assert ended.code == 4
    assert ended.out == ""
    assert "no platform is running" in ended.trouble
    assert "rtcp start" in ended.trouble


def test_status_watch_in_json_prints_an_object_a_line_until_ctrl_c(
    platform: Any, rtcp_process: Callable[..., Any]
) -> None:
    watching = rtcp_process("status", "--json", "--watch")
    lines = [watching.stdout.readline() for _ in range(3)]
    watching.send_signal(signal.SIGINT)
    _, trouble = watching.communicate()
    assert all(json.loads(line) == platform.status for line in lines)
    assert (watching.returncode, trouble) == (0, "")


def test_status_watch_ends_with_4_when_the_platform_ends(
    platform: Any, rtcp_process: Callable[..., Any], wait_until: Callable[..., None]
) -> None:
    watching = rtcp_process("status", "--watch")
    wait_until(lambda: len(platform.asked("status")) > 0)
    platform.end()
    _, trouble = watching.communicate()
    assert watching.returncode == 4
    assert "the platform has ended" in trouble


@pytest.mark.parametrize("arguments", [("status", "--json", "--watch"), ("status", "--watch"), ("status",)])
def test_a_reader_that_goes_away_ends_the_command_quietly(
    platform: Any, rtcp_process: Callable[..., Any], arguments: tuple[str, ...]
) -> None:
    process = rtcp_process(*arguments)
    process.stdout.close()
    trouble = process.stderr.read()
    assert (process.wait(), trouble) == (0, "")


def test_the_robot_status_and_the_states_are_reported_in_words(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.status |= {
        "state": "stopped_by_limit",
        "control_mode": "joystick",
        "joystick": {"mode": "Z-yaw", "controls_arm": False},
        "robot": {"mode": "manual", "e_stopped": True, "drives_powered": True, "motion_possible": False,
                  "in_motion": False, "in_error": True, "error_code": 107},
    }  # fmt: skip
    output = " ".join(rtcp("status").out.split())
    assert "STOPPED BY LIMIT joystick, csp on virtual" in output
    assert "robot manual, drives powered, no motion possible, not in motion, emergency stop, error 107" in output


def test_the_joysticks_mode_is_shown_in_every_control_mode_where_there_is_a_joystick(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    for mode in ("joint", "joystick"):
        platform.status |= {"control_mode": mode, "joystick": {"mode": "Z-yaw", "controls_arm": False}}
        assert "joystick Z-yaw, controls the chair" in " ".join(rtcp("status").out.split())
    platform.status |= {"control_mode": "joint", "joystick": None}
    assert "joystick" not in rtcp("status").out


def test_the_last_messages_are_shown_with_their_local_time(
    platform: Any, rtcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "UTC-2")
    time.tzset()
    try:
        platform.status["messages"] = [f"message [{n}]" for n in range(7)]
        platform.status["message_times"] = [f"2026-11-21T14:37:2{n}.873+00:00" for n in range(7)]
        lines = rtcp("status").out.splitlines()
    finally:
        monkeypatch.undo()
        time.tzset()
    assert lines[-5:] == [f"16:37:2{n}.873  message [{n}]" for n in (2, 3, 4, 5, 6)]


def test_status_watch_goes_on_when_only_the_gateway_was_replaced(
    platform: Any, rtcp_process: Callable[..., Any], wait_until: Callable[..., None]
) -> None:
    watching = rtcp_process("status", "--json", "--watch")
    assert watching.stdout.readline()
    for connection in list(platform.connections):
        connection.shutdown(socket.SHUT_RDWR)
    for _ in range(5):
        assert json.loads(watching.stdout.readline()) == platform.status
    watching.send_signal(signal.SIGINT)
    assert (watching.communicate()[1], watching.returncode) == ("", 0)


def test_status_watch_that_cannot_connect_again_to_a_loop_that_lives_says_why(
    platform: Any, rtcp_process: Callable[..., Any]
) -> None:
    watching = rtcp_process("status", "--json", "--watch")
    assert watching.stdout.readline()
    # A loop of this user's, whose gateway can neither be reached nor replaced: the session is missing.
    Processes(loop=identify(os.getpid())).write(platform.path.parent)
    platform.end()
    _, trouble = watching.communicate()
    assert "the platform has ended" not in trouble
    assert "session." in trouble
    assert watching.returncode == 4


def test_the_commanded_positions_are_shown_where_other_positions_were_sent(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    assert "commanded" not in rtcp("status").out
    platform.status["joints"]["sent_position"] = [0.05, *platform.status["joints"]["sent_position"][1:]]
    output = rtcp("status").out
    assert "commanded" in output
    assert next(line for line in output.splitlines() if "joint1" in line).split()[-2:] == ["+0.0500", "+0.1000"]
    assert max(len(line) for line in output.splitlines()) <= 80


def test_cycles_without_an_answer_are_counted_over_the_last_second(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.status["last_second"] = {"cycles": 2000, "unanswered": 12, "incomplete": 3, "tracked": 1988}
    output = " ".join(rtcp("status").out.split())
    assert "working counter 21 of 21, 12 of 2000 cycles unanswered, 3 of 2000 cycles incomplete" in output
    assert "clocks locked in 1988 of 2000 cycles, offset -3.2 us, filtered +0.4 us" in output


def test_what_the_host_refuses_is_one_line_that_names_the_doctor(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.status["realtime"]["notes"] = ["a long complaint about the host " * 4] * 3
    platform.status["skipped_ticks"] = {
        "share": 0.031, "part": "wake-up", "message": "a long sentence " * 6, "remedy": "a long remedy " * 6,
    }  # fmt: skip
    before, _, line = rtcp("status").out.partition("host ")
    platform.status["realtime"]["notes"], platform.status["skipped_ticks"] = [], None
    assert "host" not in (healthy := rtcp("status").out)
    assert line.splitlines()[0].strip() == "3 settings refused, 3.1 % of the ticks skipped: see `rtcp doctor`"
    assert (before + line).count("\n") == healthy.count("\n") + 1


@pytest.mark.parametrize("lost", [0, 3])
@pytest.mark.parametrize("sent", [0.1, 0.05])
def test_no_heading_and_no_name_is_cut(platform: Any, rtcp: Callable[..., Any], lost: int, sent: float) -> None:
    platform.status["joint_names"] = [f"shoulder_pan_joint_{n}" for n in range(1, 7)]
    platform.status["joints"]["sent_position"] = [sent, *platform.status["joints"]["sent_position"][1:]]
    for slave in platform.status["slaves"]:
        slave |= {"state": "SAFE-OP + ERROR", "lost": lost, "errors": {"rx": [255] * 4, "links": [lost] * 4}}
    words = rtcp("status").out.split()
    assert "…" not in "".join(words)
    for word in ("position", "velocity", "torque", "target", "slave", "state", "lost/err/links", "drive6", "io"):
        assert word in words


@pytest.mark.parametrize("actual", [-1, 0])
def test_without_an_answer_the_clocks_are_not_followed_and_no_counter_is_made_up(
    platform: Any, rtcp: Callable[..., Any], actual: int
) -> None:
    platform.status["wkc"]["actual"] = actual
    output = rtcp("status").out
    assert "no answer in the last second, 21 expected" in output
    assert "working counter" not in output
    assert "not tracked: no answer" in output
    assert "offset" not in output


def test_what_the_joints_last_said_is_marked_as_old_where_they_are_not_heard(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    platform.status["lost_s"] = 1.5
    assert "last received 1.5 s ago" in rtcp("status").out
    platform.status["lost_s"] = 0.0
    assert "last received" not in rtcp("status").out
