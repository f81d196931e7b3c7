"""The virtual IRB 120 behind its virtual controller: started by one command, moved by each interface."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from urllib.request import urlopen

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.api import Robot, RtcpError
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import control_socket, irc5_control
from rtcp.virtual.request_socket import RequestClient

from .conftest import Platform

pytestmark = pytest.mark.platform
HOME = [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]


@pytest.fixture
def platform() -> Iterator[Platform]:
    made = Platform()
    made.environment["RTCP_CONFIG"] = str(default_config().parent / "abb_irb120.yaml")
    made.rtcp("start", "--detach")
    yield made
    made.end()


def operate(platform: Platform, verb: str, **keys: object) -> object:
    """Send a command to the controller."""
    with RequestClient(irc5_control(platform.directory), server="virtual IRC5") as operator:
        return operator.ask({"do": verb, **keys})


def flange_joints(platform: Platform) -> list[float]:
    """Return the controller's joint positions, degrees."""
    status = operate(platform, "status")
    assert isinstance(status, dict)
    joints: list[float] = status["units"]["ROB_1"]["position_deg"]
    return joints


def rest(platform: Platform) -> list[float]:
    """Wait until the joints rest; return their positions, degrees."""
    here = flange_joints(platform)
    while True:
        time.sleep(0.2)
        before, here = here, flange_joints(platform)
        if here == pytest.approx(before, abs=1e-3):
            return here


def test_it_is_moved_from_the_command_line_and_says_what_it_is(platform: Platform) -> None:
    shown = json.loads(platform.rtcp("status", "--json").stdout)
    assert (shown["bus_kind"], shown["slaves"], shown["dc"]) == ("egm", [], None)
    assert set(shown["drive_states"]) == {"switched on"}
    assert shown["devices"]["robot"]["mci"]["value"] == 3
    platform.rtcp("enable")
    assert "arrived" in platform.rtcp("move", "0.2", "0.1", "0", "0", "0.6", "0").stdout
    assert rest(platform)[:2] == pytest.approx([11.459, 5.730], abs=0.01)
    assert "stopped at" in platform.rtcp("jog", "z", "-0.05", "--seconds", "0.5").stdout
    assert platform.rtcp("mode", "torque", check=3).stderr.count("takes no torque") == 1
    assert "no SDO on a bus of kind egm" in platform.rtcp("sdo", "read", "1", "0x6041", check=3).stderr
    assert "has no homing here" in platform.rtcp("home", "joint_1", check=3).stderr
    assert "stopped" in platform.rtcp("stop").stdout


def test_it_is_moved_from_the_api_and_the_panel_shows_it(platform: Platform) -> None:
    from tests.panel.conftest import begun

    with Robot("a test", control_socket(platform.directory)) as robot:
        robot.enable()
        robot.move_joints(HOME)
        with robot.open_stream() as stream:
            stream.send([*HOME[:5], 0.01])
        with begun(platform) as (_, url):
            platform.until(lambda _: b"rtcp_up 1" in urlopen(f"{url}/metrics").read(), "the state at the panel")
            assert "rtcp_dc_offset" not in urlopen(f"{url}/metrics").read().decode()
        with pytest.raises(RtcpError) as refused:
            robot.sdo_read(1, 0x6041, 0)
        assert refused.value.kind == "refused"


@pytest.mark.parametrize("wire", ["zenoh", "simple-message"])
def test_it_is_moved_from_ros(platform: Platform, wire: str) -> None:
    pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed: pip install 'rtcp[zenoh]'")
    platform.call("enable")
    command = [sys.executable, "-m", "rtcp.ros.latency", wire, "3"]
    done = subprocess.run(command, env=platform.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)) == 3


def test_an_emergency_stop_at_the_controller_is_a_fault_and_the_way_back_is_the_operators(platform: Platform) -> None:
    platform.call("enable")
    move = platform.background("move", "1.5", "0.2", "0.1", "0.2", "0.6", "0.3")
    platform.until(lambda status: status["state"] == "moving", "the motion")
    operate(platform, "stop", circuit="emergency")
    platform.until(lambda status: status["state"] == "fault", "the fault")
    _, says = move.communicate()
    assert "the drive left Operation Enabled by itself (switch on disabled)" in says
    here = rest(platform)
    platform.call("reset")
    with pytest.raises(RtcpError) as refused:
        platform.call("enable")
    assert (refused.value.reason, refused.value.fields["missing"]) == ("drive_not_ready", "motors")
    operate(platform, "release", circuit="emergency")
    operate(platform, "motors_on")
    platform.until(lambda status: set(status["drive_states"]) == {"switched on"}, "EGM again")
    assert rest(platform) == pytest.approx(here, abs=0.01)
    platform.call("enable")
    platform.call("move_joints", q=HOME)


def test_a_controller_that_falls_silent_is_a_fault_and_nothing_moves_when_it_is_back(platform: Platform) -> None:
    platform.call("enable")
    platform.background("move", "1.5", "0.2", "0.1", "0.2", "0.6", "0.3")
    platform.until(lambda status: status["state"] == "moving", "the motion")
    operate(platform, "fault", fault="silent")
    shown = platform.until(lambda status: status["state"] == "fault", "the fault")
    # Which one is found first depends on the host.
    assert "process data lost" in shown["message"] or "left Operation Enabled" in shown["message"]
    platform.until(lambda _: "41822" in str(operate(platform, "status")), "the controller's own stop")
    here = rest(platform)
    operate(platform, "clear")
    platform.until(lambda status: status["wkc"]["actual"] == 1, "messages")
    assert rest(platform) == pytest.approx(here, abs=0.01)
    platform.call("reset")
    platform.call("enable")
    platform.call("move_joints", q=HOME)


def test_a_loop_that_is_killed_in_motion_leaves_the_arm_to_the_controllers_time_out(platform: Platform) -> None:
    platform.call("enable")
    platform.background("move", "1.5", "0.2", "0.1", "0.2", "0.6", "0.3")
    platform.until(lambda status: status["joints"]["actual_velocity"][0] > 0.2, "the motion")
    os.kill(platform.pids()["loop"], signal.SIGKILL)
    stood = rest(platform)
    # 0.2 s at 1 rad/s, then the controller's ramp of 0.5 s: it comes to rest before the end of the motion.
    assert 0.0 < stood[0] < 80.0
    assert "had ended" in platform.rtcp("stop", check=5).stderr


def test_seven_axes_are_moved_the_external_one_third() -> None:
    config, platform = default_config().parent, Platform()
    try:
        unit = (config / "irc5.yaml").read_text().replace("arm: abb_irb120 ", f"arm: {config}/abb_irb120.yaml ")
        unit = unit.replace("[0, 0, 0, 0, 30, 0] ", "[0, 0, 0, 0, 30, 0, 0] ")
        external = "    external_joint: {min: -100, max: 100, velocity: 100}\n    robotware"
        (platform.directory / "irc5.yaml").write_text(unit.replace("    robotware", external))
        arm, _, _ = (config / "abb_irb120.yaml").read_text().partition("kinematics:")
        rail = "  - {name: rail, position: {min: -1.5, max: 1.5}, velocity: 1.0, acceleration: 2.0, jerk: 20.0}\n"
        file = platform.directory / "seven.yaml"
        arm = arm.replace("home: [0, 0, 0, ", "home: [0, 0, 0, 0, ")
        file.write_text(arm.replace("  - {name: joint_3,", f"{rail}  - {{name: joint_3,"))
        platform.environment["RTCP_CONFIG"] = str(file)
        platform.rtcp("start", "--detach")
        platform.rtcp("enable")
        platform.rtcp("move", "0.1", "0.1", "0.3", "0.1", "0.1", "0.6", "0.1")
        assert rest(platform) == pytest.approx([5.73, 5.73, 5.73, 5.73, 34.38, 5.73, 17.19], abs=0.02)
    finally:
        platform.end()
