"""The launch file of `config/ros`, in real ROS 1."""

from __future__ import annotations

import os
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.e2e.conftest import Platform
from tests.waiting import HANG_S

from .conftest import Ros

LAUNCH = Path(__file__).parents[2] / "config/ros"


@pytest.mark.platform
def test_the_launch_file_starts_the_node_and_the_transforms_of_the_whole_arm(ros: Ros, platform: Platform) -> None:
    environment = {name: value for name, value in platform.environment.items() if name.startswith("RTCP_")}
    environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment["ROS_PACKAGE_PATH"] = f"{LAUNCH}:/usr/share"
    launch = ros.background("/usr/bin/roslaunch", "rtcp", "arm.launch", "options:=--rate 50", **environment)
    try:
        # The joints' transforms come only where the joint states of the node reach the publisher of the URDF's links.
        echo = ["/usr/bin/rostopic", "echo", "-n", "1", "--filter", "len(m.transforms) == 6", "/tf"]
        transforms = ros.run("timeout", str(HANG_S), *echo).stdout
        description = ros.run("/usr/bin/rosparam", "get", "/robot_description").stdout
    finally:
        ros.stop(launch)
    assert re.findall(r'child_frame_id: "(\w+)"', transforms) == [f"link{number}" for number in range(1, 7)]
    assert "<collision>" in description


def test_the_rviz_configuration_shows_frames_that_are_published() -> None:
    text = (LAUNCH / "arm.rviz").read_text()
    assert re.findall(r"(?:Fixed|Reference) Frame: (\S+)", text) == ["tool0_controller", "base_link"]
    for file in LAUNCH.glob("*.launch"):
        ET.parse(file)
