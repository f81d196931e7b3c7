"""Motion commands on a whole platform: real processes, the virtual segment, the control socket and the command line."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from kinematics.forward import forward
from rtcp.config import default_config, load
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import Refused
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from tests.e2e.conftest import FULL_CIA402, Platform, kill

pytestmark = pytest.mark.platform

PERIOD_US = 1000
"""A cycle that a loaded host keeps."""

BENT = [0.0, 0.2, 1.57, 0.0, 0.4, 0.0]
NUMBERS = [f"{q:g}" for q in BENT]


@pytest.fixture
def bent(enabled: Platform) -> Iterator[Platform]:
    """The shared platform, enabled, with the arm bent away from all limits; restored afterwards."""
    enabled.call("mode", name="joint")
    enabled.call("move_joints", q=BENT)
    yield enabled
    enabled.until(lambda status: status["state"] in ("holding", "stopped_by_limit"), "rest")
    enabled.call("reset")
    enabled.call("mode", name="joint")


@pytest.fixture
def client(bent: Platform) -> Iterator[ControlClient]:
    with ControlClient("a test", control_socket(bent.directory)) as made:
        yield made


def tool(status: dict[str, Any]) -> list[float]:
    """Commanded position of the tool, m."""
    model = load(default_config()).arm
    assert model is not None
    return list(forward(model, status["joints"]["commanded_position"]).position)


def far(first: list[float], second: list[float]) -> float:
    return max(abs(a - b) for a, b in zip(first, second, strict=True))


def test_a_pose_is_reached_on_a_line_and_by_the_joints(bent: Platform) -> None:
    x, y, z = tool(bent.status())
    for options in (("--line", "--speed", "0.1"), ()):
        y += 0.06
        pose = [f"{number:.5f}" for number in (x, y, z)]
        model = load(default_config()).arm
        assert model is not None
        rpy = [f"{number:.6f}" for number in forward(model, BENT).rpy]
        done = bent.rtcp("move", "--pose", *pose, *rpy, *options)
        assert "arrived, largest error" in done.stdout
        assert far(tool(bent.status()), [x, y, z]) < 1e-4


def test_a_pose_out_of_reach_is_refused_with_the_reason_and_nothing_moves(bent: Platform) -> None:
    before = bent.status()["joints"]["commanded_position"]
    for options in ((), ("--line",)):
        done = bent.rtcp("move", "--pose", "-2", "0", "0.6", "0", "0", "0", *options, check=3)
        assert "out of reach" in done.stderr
    assert bent.status()["joints"]["commanded_position"] == before


def test_a_trajectory_file_is_run_with_progress(bent: Platform, tmp_path: Path) -> None:
    file = tmp_path / "motion.yaml"
    there = [0.3, *BENT[1:]]
    file.write_text(f"trajectory:\n  - {{t: 0, q: {BENT}}}\n  - {{t: 2, q: {there}}}\n  - {{t: 4, q: {BENT}}}\n")
    done = bent.rtcp("run", str(file))
    assert "moving:" in done.stdout
    assert far(bent.status()["joints"]["commanded_position"], BENT) < 1e-6


def test_ctrl_c_stops_a_line_on_its_way(bent: Platform) -> None:
    x, y, z = tool(bent.status())
    model = load(default_config()).arm
    assert model is not None
    rpy = [f"{number:.6f}" for number in forward(model, BENT).rpy]
    moving = bent.background(
        "move", "--pose", f"{x:.5f}", f"{y + 0.3:.5f}", f"{z:.5f}", *rpy, "--line", "--speed", "0.03"
    )
    bent.until(lambda status: tool(status)[1] > y + 0.03, "motion")
    moving.send_signal(signal.SIGINT)
    _, trouble = moving.communicate(timeout=20)
    assert moving.returncode == 130
    assert "controlled stop" in trouble
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    at = tool(status)
    assert y + 0.03 < at[1] < y + 0.25
    # Braked along the line, not off it.
    assert far([at[0], at[2]], [x, z]) < 1e-4


def test_a_jog_moves_along_its_axis_and_comes_to_rest(bent: Platform) -> None:
    before = tool(bent.status())
    bent.rtcp("jog", "y", "0.05", "--seconds", "1")
    after = tool(bent.status())
    assert bent.status()["state"] == "holding"
    # At most 0.05 m; less by the cycles that a shared host lost in that second.
    assert 0.005 < after[1] - before[1] < 0.08
    assert far([after[0], after[2]], [before[0], before[2]]) < 1e-3


def test_a_jogger_that_is_killed_leaves_an_arm_at_rest(bent: Platform) -> None:
    jogging = bent.background("jog", "joint1", "0.2", "--seconds", "30")
    bent.until_moving()
    jogging.kill()
    jogging.communicate()
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    assert status["lease"]["holder"] in ("", None)
    again = bent.status()["joints"]["commanded_position"]
    assert again == status["joints"]["commanded_position"]


def test_a_jogger_that_was_suspended_does_not_move_the_arm_again(bent: Platform) -> None:
    jogging = bent.background("jog", "joint1", "0.2", "--seconds", "30")
    bent.until_moving()
    jogging.send_signal(signal.SIGSTOP)
    rest = bent.until(lambda status: status["state"] == "holding", "rest")["joints"]["commanded_position"]
    jogging.send_signal(signal.SIGCONT)
    _, trouble = jogging.communicate(timeout=20)
    assert jogging.returncode == 5
    assert "stays stopped" in trouble
    assert bent.status()["joints"]["commanded_position"] == rest


def test_ctrl_z_stops_a_move_on_its_way(bent: Platform) -> None:
    moving = bent.background("move", "0.9", *NUMBERS[1:], "--speed", "0.1")
    bent.until_moving()
    moving.send_signal(signal.SIGTSTP)
    _, trouble = moving.communicate(timeout=20)
    assert moving.returncode == 148
    assert "ended, not suspended" in trouble
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    assert status["joints"]["commanded_position"][0] < 0.6


def test_an_object_that_does_not_come_is_a_timeout_and_one_that_is_refused_a_refusal(bent: Platform) -> None:
    bent.rtcp("segment", "fault", "sdo_late", "slave=2", "ms=3000")
    try:
        bent.rtcp("sdo", "read", "drive1", "0x6041", "--type", "uint16", check=5)
    finally:
        bent.rtcp("segment", "clear")
    bent.rtcp("sdo", "read", "drive2", "0x5FFF", "--type", "uint16", check=3)


def test_a_second_jogger_is_refused_with_the_firsts_name(bent: Platform, client: ControlClient) -> None:
    client.call("jog", {"velocity": [0, 0.02, 0, 0, 0, 0], "frame": "base", "hold_s": 0.5})
    with (
        ControlClient("another", control_socket(bent.directory)) as other,
        pytest.raises(Refused) as raised,
    ):
        other.call("jog", {"velocity": [0, -0.02, 0, 0, 0, 0], "frame": "base"})
    assert (raised.value.reason, raised.value.fields["holder"]) == ("lease_held", "a test")


def test_a_stream_is_followed_and_its_end_stops_the_arm(bent: Platform, client: ControlClient) -> None:
    q = list(BENT)
    for _ in range(50):
        q[0] += 0.004
        client.call("stream_position", {"q": q, "stamp_s": time.monotonic()})
        time.sleep(0.02)
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    assert abs(status["joints"]["commanded_position"][0] - q[0]) < 0.03


@FULL_CIA402
def test_joint_speeds_move_in_mode_velocity_only(bent: Platform, client: ControlClient) -> None:
    with pytest.raises(Refused) as refused:
        client.call("move_at_velocity", {"velocity": [0.1, 0, 0, 0, 0, 0]})
    assert refused.value.reason == "wrong_control_mode"
    client.call("mode", {"name": "velocity"})
    start = client.call("status")["joints"]["commanded_position"][0]
    for _ in range(20):
        client.call("move_at_velocity", {"velocity": [0.1, 0, 0, 0, 0, 0]})
        time.sleep(0.05)
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    assert status["drive_mode"] == "csv"
    assert 0.05 < status["joints"]["commanded_position"][0] - start < 0.25


@FULL_CIA402
def test_a_stiffness_in_mode_torque_holds_the_arm_where_it_is(bent: Platform, client: ControlClient) -> None:
    client.call("mode", {"name": "torque"})
    start = client.call("status")["joints"]["actual_position"]
    for _ in range(20):
        client.call("apply_torque", {"torque": [0] * 6, "stiffness": 1.0, "damping": 1.0})
        time.sleep(0.05)
    assert far(client.call("status")["joints"]["actual_position"], start) < 0.01


def test_the_joystick_moves_the_arm_and_silence_releases_it(bent: Platform, client: ControlClient) -> None:
    client.call("mode", {"name": "joystick"})
    client.call("joystick", {"byte": 63})
    start = tool(client.call("status"))
    until = time.monotonic() + 1.5
    while time.monotonic() < until:
        client.call("joystick", {"byte": 61})
        time.sleep(0.1)
    moved = client.call("status")
    assert moved["state"] == "moving"
    assert tool(moved)[0] < start[0] - 0.03
    status = bent.until(lambda status: status["state"] == "holding", "rest after the last word")
    assert status["devices"]["io"]["inputs"]["value"] & 0xFF == 63


def test_the_command_joystick_returns_when_the_arm_rests(bent: Platform) -> None:
    bent.rtcp("mode", "joystick")
    bent.rtcp("joystick", "forward", "--seconds", "0.5")
    assert bent.call("mode", name="joint") == {"mode": "joint"}


def test_an_emergency_stop_by_the_virtual_button_ends_a_move(bent: Platform) -> None:
    moving = bent.background("move", "0.9", *NUMBERS[1:], "--speed", "0.05")
    bent.until_moving()
    bent.rtcp("joystick", "estop", "--seconds", "0.3")
    _, trouble = moving.communicate(timeout=20)
    assert moving.returncode == 5
    assert "emergency stop" in trouble
    status = bent.until(lambda status: not status["robot"]["drives_powered"], "torque off")
    assert status["state"] == "emergency_stop"
    bent.call("reset")
    bent.call("enable")


def test_limits_are_narrowed_shown_and_kept_to(bent: Platform) -> None:
    bent.rtcp("limits", "set", "joint1.max", "0.5")
    try:
        assert json.loads(bent.rtcp("limits", "show", "--json").stdout)["limits"]["max"][0] == 0.5
        done = bent.rtcp("move", "0.6", *NUMBERS[1:], check=3)
        assert "joint1" in done.stderr
        done = bent.rtcp("limits", "set", "joint1.max", "-0.5", check=3)
        assert "joint1" in done.stderr
        assert "nothing was changed" in done.stderr
        done = bent.rtcp("limits", "set", "joint1.max", "9", check=2)
        assert "joint1.max: found 9, allowed is -3.1 to 3.1" in done.stderr
    finally:
        bent.rtcp("limits", "set", "joint1.max", "3.1")


def test_the_gripper_switches_its_output(bent: Platform) -> None:
    def closed(status: dict[str, Any]) -> bool:
        return bool(status["devices"]["io"]["outputs"]["value"] >> 3 & 1)

    bent.call("move_gripper", open=False)
    bent.until(closed, "gripper to close")
    bent.call("move_gripper", open=True)
    bent.until(lambda status: not closed(status), "gripper to open")


@FULL_CIA402
def test_a_joint_is_homed_and_holds_again(bent: Platform) -> None:
    bent.call("home", joint="joint6")
    assert bent.status()["state"] == "holding"


def test_a_joystick_is_released_by_the_box_itself_when_the_gateway_is_killed(running: Platform) -> None:
    observer = Observer(blackboard_file(running.directory))

    def shows(byte: int) -> bool:
        latest = observer.latest()
        return latest is not None and int(latest[0]["io_inputs"]) & 0xFF == byte

    with ControlClient("a test", control_socket(running.directory)) as client:
        client.call("joystick", {"byte": 62, "hold_s": 1.0})
        wait_for(lambda: shows(62))
        kill(running.pids()["gateway"])
    wait_for(lambda: shows(63))
    observer.close()


def wait_for(met: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not met():
        assert time.monotonic() < end
        time.sleep(0.005)
