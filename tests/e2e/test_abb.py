"""The virtual IRB 120 behind its virtual controller: started by one command, moved by each interface.

tests/faults/test_egm_matrix.py: the controller stops or falls silent, the loop is killed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.api import Robot
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import control_socket, irc5_control
from rtcp.panel.live import Live
from rtcp.panel.metrics import exposition
from rtcp.virtual.request_socket import RequestClient
from tests.leftovers import Leftovers
from tests.waiting import until

from .conftest import Platform

pytestmark = pytest.mark.platform
HOME = [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]


@pytest.fixture(scope="module")
def irb(leftovers: Leftovers) -> Iterator[Platform]:
    made = Platform()
    leftovers.shared.add(str(made.directory))
    made.environment["RTCP_CONFIG"] = str(default_config().parent / "abb_irb120.yaml")
    made.rtcp("start", "--detach")
    yield made
    made.end()
    leftovers.shared.discard(str(made.directory))


def flange_joints(platform: Platform) -> list[float]:
    """Return the controller's joint positions, degrees."""
    with RequestClient(irc5_control(platform.directory), server="virtual IRC5") as operator:
        joints: list[float] = operator.ask({"do": "status"})["units"]["ROB_1"]["position_deg"]
    return joints


def test_it_is_moved_from_the_command_line_and_the_api_and_says_what_it_is(irb: Platform) -> None:
    shown = json.loads(irb.rtcp("status", "--json").stdout)
    assert (shown["bus_kind"], shown["slaves"], shown["dc"]) == ("egm", [], None)
    assert shown["devices"]["robot"]["mci"]["value"] == 3
    irb.call("enable")
    assert "arrived" in irb.rtcp("move", "0.2", "0.1", "0", "0", "0.6", "0").stdout
    arrived = pytest.approx([11.459, 5.730, 0.0, 0.0, 34.377, 0.0], abs=0.01)
    until(lambda: flange_joints(irb) == arrived, "the controller's arm at the target")
    assert "no SDO on a bus of kind egm" in irb.rtcp("sdo", "read", "1", "0x6041", check=3).stderr
    assert "has no homing here" in irb.rtcp("home", "joint_1", check=3).stderr
    with Robot("a test", control_socket(irb.directory)) as robot:
        robot.move_joints(HOME)
        robot.jog([0.0, 0.0, -0.05, 0.0, 0.0, 0.0], hold_s=0.1)
        with robot.open_stream() as stream:
            stream.send([*HOME[:5], 0.01])
        shown = robot.status()
    assert "rtcp_dc_offset" not in exposition(cast(Live, SimpleNamespace(status=shown, pages={}))).decode()


@pytest.mark.long("test_the_latency_of_each_wire_is_measured_in_the_frames")
@pytest.mark.parametrize("wire", ["zenoh", "simple-message"])
def test_it_is_moved_from_ros(irb: Platform, wire: str) -> None:
    pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed: pip install 'rtcp[zenoh]'")
    irb.call("enable")
    command = [sys.executable, "-m", "rtcp.ros.latency", wire, "3"]
    done = subprocess.run(command, env=irb.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)) == 3


@pytest.mark.long("test_the_external_joint_is_the_third")
def test_seven_axes_are_moved_the_external_one_third(platform: Platform) -> None:
    config = default_config().parent
    unit = (config / "irc5.yaml").read_text().replace("arm: abb_irb120 ", f"arm: {config}/abb_irb120.yaml ")
    unit = unit.replace("[0, -30, 20, 0, 30, 0] ", "[0, -30, 20, 0, 30, 0, 0] ")
    external = "    external_joint: {min: -100, max: 100, velocity: 100}\n    robotware"
    (platform.directory / "irc5.yaml").write_text(unit.replace("    robotware", external))
    arm, _, _ = (config / "abb_irb120.yaml").read_text().partition("kinematics:")
    rail = "  - {name: rail, position: {min: -1.5, max: 1.5}, velocity: 1.0, acceleration: 2.0, jerk: 20.0}\n"
    file = platform.directory / "seven.yaml"
    arm = arm.replace("rest_pose: [0, 0, 0, ", "rest_pose: [0, 0, 0, 0, ")
    file.write_text(arm.replace("  - {name: joint_3,", f"{rail}  - {{name: joint_3,"))
    platform.environment["RTCP_CONFIG"] = str(file)
    platform.rtcp("start", "--detach")
    platform.rtcp("enable")
    platform.rtcp("move", "0.1", "0.1", "0.3", "0.1", "0.1", "0.6", "0.1")
    arrived = pytest.approx([5.73, 5.73, 5.73, 5.73, 34.38, 5.73, 17.19], abs=0.02)
    until(lambda: flange_joints(platform) == arrived, "the controller's arm at the target")
