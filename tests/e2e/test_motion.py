"""Motion commands of the command line on a whole platform, and what ends them: signals, a killed client, the button."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from kinematics.forward import forward
from rtcp.config import default_config, load
from rtcp.ipc.client import ControlClient
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from tests.e2e.conftest import Platform, kill
from tests.waiting import until

pytestmark = pytest.mark.platform

BENT = [0.0, 0.2, 1.57, 0.0, 0.4, 0.0]
NUMBERS = [f"{q:g}" for q in BENT]
MODEL = load(default_config()).models[0]
RPY = [f"{angle:.6f}" for angle in forward(MODEL, BENT).rpy]


@pytest.fixture
def bent(enabled: Platform) -> Iterator[Platform]:
    """The shared platform, enabled, with the arm bent away from all limits; restored afterwards."""
    enabled.call("mode", name="joint")
    enabled.call("move_joints", q=BENT)
    yield enabled
    enabled.until(lambda status: status["state"] in ("holding", "stopped_by_limit"), "rest")
    enabled.call("reset")
    enabled.call("mode", name="joint")


def tool(status: dict[str, Any]) -> list[float]:
    """Commanded position of the tool, m."""
    return list(forward(MODEL, status["joints"]["commanded_position"]).position)


def far(first: list[float], second: list[float]) -> float:
    return max(abs(a - b) for a, b in zip(first, second, strict=True))


def test_the_tool_moves_to_a_pose_on_a_line_and_a_step_along_its_axis(bent: Platform) -> None:
    x, y, z = tool(bent.status())
    pose = [f"{number:.5f}" for number in (x, y + 0.06, z)]
    assert "arrived, largest error" in bent.rtcp("move", "--pose", *pose, *RPY, "--line", "--speed", "0.1").stdout
    assert far(tool(bent.status()), [x, y + 0.06, z]) < 1e-4
    before = forward(MODEL, bent.status()["joints"]["commanded_position"])
    bent.rtcp("step", "z", "-20mm", "--tool")
    shift = np.subtract(tool(bent.status()), before.position)
    assert shift == pytest.approx(-0.02 * np.array(before.rotation[2::3]), abs=1e-5)
    status = bent.status()["joints"]["commanded_position"]
    bent.rtcp("step", "joint2", "1deg")
    after = bent.status()["joints"]["commanded_position"]
    assert np.subtract(after, status) == pytest.approx([0, np.pi / 180, 0, 0, 0, 0], abs=1e-6)
    assert "3kg" in bent.rtcp("step", "z", "3kg", check=2).stderr
    assert "150 is not allowed" in bent.rtcp("speed", "150", check=2).stderr
    # Half a circle through a place beside its ends.
    x, y, z = tool(bent.status())
    rpy = [f"{angle:.6f}" for angle in forward(MODEL, after).rpy]
    ends = [f"{number:.5f}" for number in (x, y + 0.03, z + 0.03, x, y + 0.06, z)]
    bent.rtcp("arc", *ends[3:], *rpy, "--via", *ends[:3], "--speed", "0.1")
    assert far(tool(bent.status()), [x, y + 0.06, z]) < 1e-4
    bent.rtcp("move", "--rest-pose")
    rest_pose = load(default_config()).rest_pose
    assert far(bent.status()["joints"]["commanded_position"], list(rest_pose)) < 1e-4
    bent.rtcp("speed", "50")
    bent.rtcp("disable")
    assert bent.status()["speed_override"] == 0.5
    bent.rtcp("speed", "100")
    bent.rtcp("enable")


def jog(platform: Platform) -> subprocess.Popen[str]:
    """Jog the first joint; return when it has moved. On a slow host the jog may have ended for want of a renewal."""
    jogging = platform.background("jog", "joint1", "0.2", "--seconds", "30")
    platform.until(lambda status: status["joints"]["commanded_position"][0] > 1e-3, "motion")
    return jogging


def test_ctrl_c_stops_a_line_on_its_way(bent: Platform) -> None:
    x, y, z = tool(bent.status())
    moving = bent.background(
        "move", "--pose", f"{x:.5f}", f"{y + 0.3:.5f}", f"{z:.5f}", *RPY, "--line", "--speed", "0.03"
    )
    bent.until(lambda status: tool(status)[1] > y + 0.03, "motion")
    moving.send_signal(signal.SIGINT)
    _, trouble = moving.communicate()
    assert moving.returncode == 130
    assert "controlled stop" in trouble
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    at = tool(status)
    assert y + 0.03 < at[1] < y + 0.25
    # Braked along the line, not off it.
    assert far([at[0], at[2]], [x, z]) < 1e-4


def test_a_jogger_that_is_killed_leaves_an_arm_at_rest(bent: Platform) -> None:
    jogging = jog(bent)
    jogging.kill()
    jogging.communicate()
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    assert status["lease"]["holder"] in ("", None)
    again = bent.status()["joints"]["commanded_position"]
    assert again == status["joints"]["commanded_position"]


def test_a_jogger_that_was_suspended_does_not_move_the_arm_again(bent: Platform) -> None:
    jogging = jog(bent)
    jogging.send_signal(signal.SIGSTOP)
    rest = bent.until(lambda status: status["state"] == "holding", "rest")["joints"]["commanded_position"]
    jogging.send_signal(signal.SIGCONT)
    _, trouble = jogging.communicate()
    assert jogging.returncode == 5
    assert "stays stopped" in trouble
    assert bent.status()["joints"]["commanded_position"] == rest


def test_ctrl_z_stops_a_move_on_its_way(bent: Platform) -> None:
    moving = bent.background("move", "0.9", *NUMBERS[1:], "--speed", "0.1")
    bent.until_moving()
    moving.send_signal(signal.SIGTSTP)
    _, trouble = moving.communicate()
    assert moving.returncode == 148
    assert "ended, not suspended" in trouble
    status = bent.until(lambda status: status["state"] == "holding", "rest")
    assert status["joints"]["commanded_position"][0] < 0.6


def test_an_emergency_stop_by_the_virtual_button_ends_a_move(bent: Platform) -> None:
    moving = bent.background("move", "0.9", *NUMBERS[1:], "--speed", "0.05")
    bent.until_moving()
    bent.rtcp("joystick", "estop", "--seconds", "0.3")
    _, trouble = moving.communicate()
    assert moving.returncode == 5
    assert "emergency stop" in trouble
    status = bent.until(lambda status: not status["robot"]["drives_powered"], "torque off")
    assert status["state"] == "emergency_stop"
    bent.call("reset")
    bent.call("enable")


def test_the_joystick_moves_the_arm_and_the_box_itself_releases_it_when_the_gateway_is_killed(bent: Platform) -> None:
    observer = Observer(blackboard_file(bent.directory))

    def shows(byte: int) -> bool:
        latest = observer.latest()
        return latest is not None and int(latest[0]["io_inputs"]) & 0xFF == byte

    with ControlClient("a test", control_socket(bent.directory)) as client:
        client.call("mode", {"name": "joystick"})
        client.call("joystick", {"byte": 63})
        start = tool(client.call("status"))

        def is_ahead() -> bool:
            client.call("joystick", {"byte": 61, "hold_s": 1.0})
            return tool(client.call("status"))[0] < start[0] - 0.03

        until(is_ahead, "a motion forward")
        kill(bent.pids()["gateway"])
    until(lambda: shows(63), "a neutral joystick")
    observer.close()
    bent.rtcp("start", "--detach")
    bent.until(lambda status: status["state"] == "holding", "rest")
