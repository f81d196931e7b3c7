"""The launch files of `config/ros`, in real ROS 1."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from rtcp.config.find import default_config
from tests.waiting import HANG_S, until

from .conftest import Ros

LAUNCH = Path(__file__).parents[2] / "config/ros"
ENVIRONMENT = {
    "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    "ROS_PACKAGE_PATH": f"{LAUNCH}:/usr/share",
}


@pytest.mark.platform
def test_a_launch_file_starts_the_platform_on_a_controller_the_node_and_the_transforms_of_the_whole_arm(
    ros: Ros,
) -> None:
    """As ROS-Industrial names it, with the controller's address: a virtual IRC5 that runs by itself."""
    file = default_config().with_name("irc5_rapid.yaml")
    controller = ros.background(sys.executable, "-m", "rtcp.cli", "irc5", "--config", file)
    until(lambda: "Ctrl-C ends it" in ros.logs(), "the virtual IRC5")
    config = default_config().with_name("abb_irb120_rapid.yaml")
    arguments = ("robot_ip:=127.0.0.1", f"platform:=--config {config}", f"arm:=--arm {config}", "options:=--rate 50")
    launch = ros.background("/usr/bin/roslaunch", "rtcp", "robot_interface_streaming.launch", *arguments, **ENVIRONMENT)
    try:
        # The joints' transforms come only where the joint states of the node reach the publisher of the URDF's links.
        echo = ["/usr/bin/rostopic", "echo", "-n", "1", "--filter", "len(m.transforms) == 6", "/tf"]
        transforms = ros.run("timeout", str(HANG_S), *echo).stdout
        description = ros.run("/usr/bin/rosparam", "get", "/robot_description").stdout
        address = ros.run("/usr/bin/rosparam", "get", "/robot_ip_address").stdout
        bus = ros.run(sys.executable, "-m", "rtcp.cli", "status", "--json").stdout
    finally:
        ros.stop(launch)
        ros.stop(controller)
    assert re.findall(r'child_frame_id: "(\w+)"', transforms) == [f"link{number}" for number in range(1, 7)]
    assert "<collision>" in description
    assert address.strip() == "127.0.0.1"
    assert '"127.0.0.1"' in bus


@pytest.mark.parametrize("address", ["", "10.0.0.2"])
def test_the_platform_that_is_started_has_the_controller_at_the_parameter(tmp_path: Path, address: str) -> None:
    """The script that roslaunch starts, with stand-ins for `rosparam` and `rtcp`."""
    asked = f"echo {address}" if address else "exit 1"
    for name, text in {
        "rosparam": f'[ "$*" = "get robot_ip_address" ] && {asked}',
        "rtcp": 'printf "%s\\n" "$@"',
    }.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    started = subprocess.run(
        [LAUNCH / "platform", "--config", "my arm.yaml", "__name:=rtcp_platform", "__log:=/tmp/a log"],
        env={"PATH": f"{tmp_path}:/usr/bin:/bin"}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    given = ["--controller", address] if address else []
    assert started.stdout.splitlines() == ["start", *given, "--config", "my arm.yaml"]


@pytest.mark.skipif(shutil.which("roslaunch") is None, reason="roslaunch is not installed: make test-ros installs it")
@pytest.mark.parametrize(
    ("kind", "arguments", "starts"),
    [
        ("streaming", (), False),
        ("download", ("robot_ip:=10.0.0.2", "use_bswap:=true"), True),
        ("download", ("robot_ip:=10.0.0.2", "start:=false"), False),
        ("streaming", ("start:=true", "platform:=--bus eth0"), True),
    ],
)
def test_the_launch_files_of_the_convention_start_the_platform_where_that_is_asked_for(
    kind: str, arguments: tuple[str, ...], starts: bool
) -> None:
    done = subprocess.run(
        ["roslaunch", "--nodes", "rtcp", f"robot_interface_{kind}.launch", *arguments],
        env={**os.environ, **ENVIRONMENT}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert ("/rtcp_platform" in done.stdout.split()) == starts
    assert {"/rtcp", "/robot_state_publisher"} <= set(done.stdout.split())


def test_the_rviz_configuration_shows_frames_that_are_published() -> None:
    text = (LAUNCH / "arm.rviz").read_text()
    assert re.findall(r"(?:Fixed|Reference) Frame: (\S+)", text) == ["tool0_controller", "base_link"]
    for file in LAUNCH.glob("*.launch"):
        ET.parse(file)
