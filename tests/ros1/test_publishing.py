"""`rtcp ros` on a real platform, seen by rospy in the same namespace."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from kinematics.forward import forward
from rtcp.api import Feed
from rtcp.ipc.session import read_session
from rtcp.motion.planning.interpolation import rotation
from tests.e2e.conftest import Platform, kill

from .conftest import PATIENCE_S, Ros, begin_node, until

pytestmark = pytest.mark.platform
LISTENER = Path(__file__).parent / "listener.py"


class Listener:
    """A process of rospy that writes the messages it receives (`listener.py`)."""

    def __init__(self, ros: Ros) -> None:
        self._ros = ros
        self._file = ros.directory / "heard.jsonl"
        self._file.unlink(missing_ok=True)
        self.process = ros.background(sys.executable, LISTENER, self._file)
        until(self._file.exists, "the listener")

    def heard(self, topic: str) -> list[dict[str, Any]]:
        """Return the messages on a topic, oldest first."""
        lines = self._file.read_text().splitlines(keepends=True)
        messages = [json.loads(line) for line in lines if line.endswith("\n")]
        return [message for message in messages if message["topic"] == topic]

    def until(self, topic: str, met: Callable[[dict[str, Any]], bool], since: int = 0) -> dict[str, Any]:
        """Return the first message after the first `since` that is as wanted."""
        link_message: Any = until(
            lambda: next((message for message in self.heard(topic)[since:] if met(message)), None), f"{topic} as wanted"
        )
        return dict(link_message)


@pytest.fixture
def node(ros: Ros, platform: Platform) -> Iterator[subprocess.Popen[str]]:
    begun = begin_node(ros, platform)
    yield begun
    ros.stop(begun)


@pytest.fixture
def listener(ros: Ros, node: subprocess.Popen[str]) -> Iterator[Listener]:
    made = Listener(ros)
    yield made
    ros.stop(made.process)


def test_joint_states_and_feedback_are_the_samples_of_the_platform(platform: Platform, listener: Listener) -> None:
    feed = Feed(platform.directory)
    names = [joint.name for joint in feed.config.joints]
    listener.until("joint_states", lambda message: True)
    records, _ = feed.records()
    feed.close()
    later = listener.until("joint_states", lambda message: message["monotonic_ns"] > int(records["time_ns"][-1]))
    assert later["name"] == names
    assert later["position"] == pytest.approx(records["actual_position"][-1].tolist(), abs=1e-3)
    assert len(later["velocity"]) == len(later["effort"]) == len(names)
    feedback = listener.until("feedback_states", lambda message: message["stamp_ns"] == later["stamp_ns"])
    assert feedback["actual"] == later["position"]
    assert feedback["error"] == pytest.approx(
        [want - have for want, have in zip(feedback["desired"], feedback["actual"], strict=True)]
    )
    assert feedback["accelerations"] == []


def test_stamps_are_instants_of_cycles_that_grow_and_are_never_said_twice(
    platform: Platform, listener: Listener
) -> None:
    feed = Feed(platform.directory)
    until(lambda: len(listener.heard("joint_states")) > 100, "100 joint states")
    records, missing = feed.records()
    feed.close()
    assert missing == 0
    cycles = records["time_ns"]
    stamps = [message["stamp_ns"] - message["ahead_ns"] for message in listener.heard("joint_states")]
    # 0.2 ms: two processes read the offset of the two clocks.
    assert stamps == sorted(set(stamps))
    within = [stamp for stamp in stamps if cycles[0] < stamp < cycles[-1]]
    assert len(within) > 50
    assert max(int(abs(cycles - stamp).min()) for stamp in within) < 200_000


def test_the_rate_is_the_one_asked_for(ros: Ros, platform: Platform) -> None:
    node = begin_node(ros, platform, "--rate", "50")
    listener = Listener(ros)
    try:
        until(lambda: len(listener.heard("joint_states")) > 100, "100 joint states")
        stamps = [message["stamp_ns"] for message in listener.heard("joint_states")]
        steps = sorted(after - before for before, after in pairwise(stamps))
        # By the stamps, which a busy host does not move: most of them are 20 ms apart, a cycle of 2 ms more or less.
        assert abs(steps[len(steps) // 2] - 20_000_000) <= 2_000_000
    finally:
        ros.stop(listener.process)
        ros.stop(node)


def test_robot_status_follows_the_machine(platform: Platform, listener: Listener) -> None:
    ready = listener.until("robot_status", lambda message: message["drives_powered"] == 0)
    assert (ready["mode"], ready["motion_possible"], ready["in_error"], ready["e_stopped"]) == (2, 0, 0, 0)
    platform.call("enable")
    listener.until("robot_status", lambda message: (message["drives_powered"], message["motion_possible"]) == (1, 1))
    since = len(listener.heard("robot_status"))
    platform.call("move_joints", q=[0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    moving = listener.until("robot_status", lambda message: message["in_motion"] == 1, since)
    listener.until(
        "robot_status", lambda message: message["in_motion"] == 0 and message["stamp_ns"] > moving["stamp_ns"]
    )
    platform.call("disable")
    listener.until("robot_status", lambda message: message["drives_powered"] == 0, since)


def description(ros: Ros) -> str:
    return ros.run("/usr/bin/rosparam", "get", "/robot_description", check=False).stdout


def test_a_robot_description_that_somebody_set_stays(ros: Ros, platform: Platform) -> None:
    ros.run("/usr/bin/rosparam", "set", "/robot_description", "my own")
    node, listener = begin_node(ros, platform), Listener(ros)
    try:
        listener.until("joint_states", lambda message: True)
        assert description(ros).strip() == "my own"
    finally:
        ros.stop(listener.process)
        ros.stop(node)
        ros.run("/usr/bin/rosparam", "delete", "/robot_description")


def test_robot_state_publisher_makes_the_transforms_of_the_arm_from_it(
    ros: Ros, node: subprocess.Popen[str], listener: Listener
) -> None:
    listener.until("joint_states", lambda message: True)
    assert "<robot" in description(ros)
    publisher = ros.background("/usr/lib/robot_state_publisher/robot_state_publisher")
    try:
        # Ours has one transform, theirs the six of the joints.
        echo = ["/usr/bin/rostopic", "echo", "-n", "1", "--filter", "len(m.transforms) == 6", "/tf"]
        transforms = ros.run("timeout", str(PATIENCE_S), *echo).stdout
    finally:
        ros.stop(publisher)
    children = re.findall(r'child_frame_id: "(\w+)"', transforms)
    assert children == ["link1", "link2", "link3", "link4", "link5", "link6"]


@pytest.mark.parametrize("options", [(), ("--tf",)], ids=["tool", "links too"])
def test_the_frame_of_the_tool_is_that_of_the_joints_with_the_same_stamp(
    ros: Ros, platform: Platform, options: tuple[str, ...]
) -> None:
    node, listener = begin_node(ros, platform, *options), Listener(ros)
    try:
        frame = listener.until("/tf", lambda message: message["child"] == "tool0_controller")
        joints = listener.until("joint_states", lambda message: message["stamp_ns"] == frame["stamp_ns"])
    finally:
        ros.stop(listener.process)
        ros.stop(node)
    arm = read_session(platform.directory).config.arm
    assert arm is not None
    pose = forward(arm, joints["position"])
    assert frame["parent"] == "base_link"
    assert frame["at"] == pytest.approx(pose.position)
    assert rotation(frame["turn"]) == pytest.approx(pose.rotation)
    children = {message["child"] for message in listener.heard("/tf")}
    links = {f"link{number}" for number in range(1, 7)} | {"tool0"} if options else set()
    assert children == links | {"tool0_controller"}


def test_rostopic_hz_and_rosbag_take_the_topics(ros: Ros, listener: Listener) -> None:
    listener.until("joint_states", lambda message: True)
    bag = ros.directory / "joints.bag"
    ros.run("/usr/bin/rosbag", "record", "-l", "20", "-O", bag, "/joint_states")
    assert re.search(r"messages:\s+20\n", ros.run("/usr/bin/rosbag", "info", bag).stdout)
    hz = ros.run("timeout", "--signal=INT", "8", "/usr/bin/rostopic", "hz", "/joint_states", check=False).stdout
    assert "average rate: " in hz


def test_after_the_end_of_the_platform_no_joints_come_until_it_is_back(platform: Platform, listener: Listener) -> None:
    listener.until("robot_status", lambda message: message["in_motion"] == 0)
    kill(platform.pids()["loop"])
    gone = listener.until("robot_status", lambda message: message["in_motion"] == -1)
    known = ("mode", "e_stopped", "drives_powered", "motion_possible", "in_motion", "in_error", "error_code")
    assert [gone[name] for name in known] == [-1, -1, -1, 0, -1, -1, 0]
    entry = listener.until("diagnostics", lambda message: message["values"].get("connected") == "false")
    assert entry["level"] == 3
    assert "has ended" in entry["text"]
    joints = len(listener.heard("joint_states"))
    statuses = len(listener.heard("robot_status"))
    until(lambda: len(listener.heard("robot_status")) > statuses + 10, "statuses without a platform")
    assert len(listener.heard("joint_states")) == joints
    platform.rtcp("stop", check=None)
    platform.rtcp("start", "--detach")
    listener.until("joint_states", lambda message: True, joints)
    listener.until("robot_status", lambda message: message["in_motion"] == 0, statuses)


def test_after_the_return_of_a_killed_roscore_everything_is_there_again(
    ros: Ros, node: subprocess.Popen[str], listener: Listener
) -> None:
    listener.until("joint_states", lambda message: True)
    ros.kill_core()
    try:
        # Connections continue without a master.
        before = len(listener.heard("joint_states"))
        until(lambda: len(listener.heard("joint_states")) > before + 10, "joint states without a master")
    finally:
        ros.start_core()
    topics = {"/joint_states", "/feedback_states", "/robot_status", "/diagnostics", "/tf", "/joint_command"}
    until(lambda: topics <= set(ros.run("/usr/bin/rostopic", "list").stdout.split()), "the topics")
    assert "/rtcp" in ros.run("/usr/bin/rosnode", "list").stdout.split()
    until(lambda: "<robot" in description(ros), "robot_description")
    assert node.poll() is None  # the same process: a supervisor sees no end
    late = Listener(ros)
    try:
        late.until("joint_states", lambda message: True)
        late.until("robot_status", lambda message: message["mode"] == 2)
    finally:
        ros.stop(late.process)


def test_a_node_that_was_killed_is_replaced_by_the_next_one(
    ros: Ros, platform: Platform, node: subprocess.Popen[str], listener: Listener
) -> None:
    listener.until("joint_states", lambda message: True)
    ros.stop(node, signal.SIGKILL)
    joints = len(listener.heard("joint_states"))
    another = begin_node(ros, platform)
    try:
        listener.until("joint_states", lambda message: True, joints)
    finally:
        ros.stop(another)


def test_a_node_that_is_ended_leaves_the_master_without_its_name(ros: Ros, node: subprocess.Popen[str]) -> None:
    until(lambda: "/rtcp" in ros.run("/usr/bin/rosnode", "list").stdout.split(), "the node")
    node.send_signal(signal.SIGTERM)
    assert node.wait(PATIENCE_S) == 0
    assert "/rtcp" not in ros.run("/usr/bin/rosnode", "list").stdout.split()


def test_without_a_master_a_node_publishes_a_platform_that_comes_and_ends(ros: Ros, platform: Platform) -> None:
    platform.rtcp("stop", check=None)
    node = begin_node(ros, platform)
    listener = Listener(ros)
    try:
        listener.until("robot_status", lambda message: message["in_motion"] == -1)
        ros.kill_core()
        try:
            # The topics of the platform's channels cannot be registered before there is a master.
            platform.rtcp("start", "--detach")
            until(lambda: len(listener.heard("joint_states")) > 100, "joint states")
            node.send_signal(signal.SIGTERM)
            assert node.wait(PATIENCE_S) == 0
        finally:
            ros.start_core()
    finally:
        ros.stop(listener.process)
        ros.stop(node)


def test_a_word_that_is_no_remapping_is_refused(ros_on_the_path: None, platform: Platform) -> None:
    assert platform.rtcp("ros", "joint_states", check=2).stderr == (
        "rtcp: joint_states is no remapping: write NAME:=VALUE\n"
    )
