"""All arms of a cell as one group of joints for ROS, over Zenoh, on a real cell; and an arm in its namespace."""

from __future__ import annotations

import signal
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from math import sin
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed: pip install 'rtcp[zenoh]'")
pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.config.cell_file import load_cell
from rtcp.ros.group import group_urdf, joint_names
from rtcp.ros.ros2_types import decode, encode, make
from rtcp.ros.ros2_zenoh import key_of, open_session
from tests.cell.running import ABB_HOME, CONFIG, Records, RunningCell, leftovers_of, shipped_cell, starts
from tests.leftovers import Leftovers
from tests.ros2.node import point
from tests.ros2.zenoh_client import JOINT_STATES, Router, call
from tests.waiting import until

NAMES = [f"{arm}_joint_{number}" for arm in ("left", "right") for number in range(1, 7)]
HOME = [*ABB_HOME, *ABB_HOME]
THERE = [0.15, 0.1, 0.0, 0.1, 0.5, 0.1, -0.15, 0.1, 0.0, 0.0, 0.5, 0.2]
POINT = "trajectory_msgs/msg/JointTrajectoryPoint"


@pytest.fixture(scope="module")
def irbs(leftovers: Leftovers) -> Iterator[RunningCell]:
    with leftovers_of(leftovers, "left", "right") as platform:
        yield RunningCell(shipped_cell(), platform)


@pytest.mark.platform
def test_twelve_joints_are_one_group(irbs: RunningCell) -> None:
    router = Router()
    node = irbs.platform.background("ros", "--zenoh", "--router", router.address, "--cell", "--name", "arm")
    received: list[Any] = []

    def joints() -> list[float]:
        """Positions of all joints in the newest message; empty where an arm is silent."""
        message = decode("sensor_msgs/msg/JointState", received[-1].payload.to_bytes())
        by_name = dict(zip(message.name, message.position.tolist(), strict=True))
        return [by_name[name] for name in NAMES] if sorted(by_name) == sorted(NAMES) else []

    with open_session(router.address) as session:
        subscriber = session.declare_subscriber(JOINT_STATES, received.append)
        assert call(session, "robot_enable", "std_srvs/srv/Trigger").success
        begin = until(lambda: joints() if received else [], "the joints of both arms")
        # The cell runs from the first test to the last; the arms start where the test before ended.
        there = HOME if begin == pytest.approx(THERE, abs=0.1) else THERE
        records = Records(irbs)
        points = [point(0.0, begin), point(5.0, there)]
        trajectory = make("trajectory_msgs/msg/JointTrajectory", joint_names=NAMES, points=points)
        answer = call(session, "joint_path_command", "industrial_msgs/srv/CmdJointTrajectory", trajectory=trajectory)
        assert answer.code.val == 1
        until(lambda: joints() == pytest.approx(there, abs=2e-3), "the end of the trajectory")
        left, right = starts(records.read()).values()
        assert abs(left - right) <= 4_200_000
        # A sine of all joints, 30 points a second.
        records = Records(irbs)
        publisher = session.declare_publisher(key_of(0, "joint_command", POINT))
        start = time.monotonic()

        def is_swept() -> bool:
            t = time.monotonic() - start
            moved = make(POINT, positions=[q + 0.08 * sin(3.0 * t) * min(t, 1.0) for q in there])
            publisher.put(encode(POINT, moved))
            time.sleep(1.0 / 30.0)
            ways = (rows["commanded_position"][:, 0] for rows in records.read().values())
            return min(float(np.ptp(path)) for path in ways) > 0.1

        until(is_swept, "a motion of the first joint of each arm by 0.1 rad")
        assert call(session, "stop_motion", "industrial_msgs/srv/StopMotion").code.val == 1
        assert call(session, "robot_disable", "std_srvs/srv/Trigger").success
        subscriber.undeclare()
    node.send_signal(signal.SIGINT)
    node.communicate()


@pytest.mark.platform
@pytest.mark.long("test_twelve_joints_are_one_group")
def test_an_arm_has_its_namespace(irbs: RunningCell) -> None:
    router = Router()
    node = irbs.platform.background("--name", "right", "ros", "--zenoh", "--router", router.address)
    received: list[Any] = []
    with open_session(router.address) as session:
        subscriber = session.declare_subscriber(
            JOINT_STATES.replace("joint_states", "right/joint_states"), received.append
        )
        until(lambda: bool(received), "joint states")
        assert decode("sensor_msgs/msg/JointState", received[-1].payload.to_bytes()).name[0] == "joint_1"
        subscriber.undeclare()
    node.send_signal(signal.SIGINT)
    node.communicate()


def test_the_urdf_has_all_arms_on_one_world() -> None:
    cell = load_cell(CONFIG / "cell.yaml")
    assert list(joint_names(cell)) == NAMES
    robot = ET.fromstring(group_urdf(cell))
    moved = [joint.get("name") for joint in robot.iter("joint") if joint.get("type") == "revolute"]
    assert moved == NAMES
    parents = {joint.find("child").get("link"): joint.find("parent").get("link") for joint in robot.iter("joint")}
    links = {link.get("name") for link in robot.iter("link")}
    assert set(parents) == links - {"world"}
    assert parents["left_base_link"] == "world"
