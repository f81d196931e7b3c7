"""`rtcp ros` on a real platform, seen by rospy in the same namespace."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from kinematics.forward import forward
from rtcp.api import Feed
from rtcp.ipc.session import read_session
from rtcp.motion.planning.interpolation import rotation
from tests.e2e.conftest import Platform, kill
from tests.waiting import HANG_S, until

from .conftest import Ros, begin_node

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

    def first(self, topic: str, since: int = 0) -> dict[str, Any]:
        """Return the first message after the first `since`."""
        return self.until(topic, lambda message: True, since)


def description(ros: Ros) -> str:
    return ros.run("/usr/bin/rosparam", "get", "/robot_description", check=False).stdout


def handles(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal."""
    (caught,) = re.findall(r"SigCgt:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())
    return bool(int(caught, 16) >> (number - 1) & 1)


@pytest.mark.platform
def test_topics_show_the_platform_at_the_rate_asked_for(ros: Ros, platform: Platform) -> None:
    platform.restore()
    ros.run("/usr/bin/rosparam", "set", "/robot_description", "my own")
    node, listener, feed = begin_node(ros, platform, "--rate", "50", "--tf"), Listener(ros), Feed(platform.directory)
    try:
        until(lambda: len(listener.heard("joint_states")) > 100, "100 joint states")
        records, missing = feed.records()
        assert missing == 0
        cycles = records["time_ns"]
        later = listener.until("joint_states", lambda message: message["monotonic_ns"] > int(cycles[-1]))
        assert later["name"] == [joint.name for joint in feed.config.joints]
        assert later["position"] == pytest.approx(records["actual_position"][-1].tolist(), abs=1e-3)
        assert len(later["velocity"]) == len(later["effort"]) == len(later["name"])
        feedback = listener.until("feedback_states", lambda message: message["stamp_ns"] == later["stamp_ns"])
        assert feedback["actual"] == later["position"]
        errors = [want - have for want, have in zip(feedback["desired"], feedback["actual"], strict=True)]
        assert feedback["error"] == pytest.approx(errors)
        assert feedback["accelerations"] == []

        joints = listener.heard("joint_states")
        steps = sorted(after["stamp_ns"] - before["stamp_ns"] for before, after in pairwise(joints))
        # By the stamps, which a busy host does not move: most of them are 20 ms apart, a cycle of 4 ms more or less.
        assert abs(steps[len(steps) // 2] - 20_000_000) <= feed.period_ns
        assert steps[0] > 0
        within = [at for joint in joints if cycles[0] < (at := joint["stamp_ns"] - joint["ahead_ns"]) < cycles[-1]]
        assert len(within) > 50
        # Each stamp is the instant of a cycle. 0.2 ms: two processes read the offset of the two clocks.
        assert max(int(abs(cycles - stamp).min()) for stamp in within) < 200_000

        frame = listener.until("/tf", lambda message: message["child"] == "tool0_controller")
        of_frame = listener.until("joint_states", lambda message: message["stamp_ns"] == frame["stamp_ns"])
        arm = read_session(platform.directory).config.arm
        assert arm is not None
        pose = forward(arm, of_frame["position"])
        assert frame["parent"] == "base_link"
        assert frame["at"] == pytest.approx(pose.position)
        assert rotation(frame["turn"]) == pytest.approx(pose.rotation)
        links = {f"link{number}" for number in range(1, 7)} | {"tool0", "tool0_controller"}
        assert {message["child"] for message in listener.heard("/tf")} == links
        assert description(ros).strip() == "my own"

        ready = listener.until("robot_status", lambda message: message["drives_powered"] == 0)
        assert (ready["mode"], ready["motion_possible"], ready["in_error"], ready["e_stopped"]) == (-1, 0, 0, 0)
        platform.call("enable")
        powered = ("drives_powered", "motion_possible")
        listener.until("robot_status", lambda message: [message[name] for name in powered] == [1, 1])
        since = len(listener.heard("robot_status"))
        platform.call("move_joints", q=[0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
        moving = listener.until("robot_status", lambda message: message["in_motion"] == 1, since)
        listener.until(
            "robot_status", lambda message: message["in_motion"] == 0 and message["stamp_ns"] > moving["stamp_ns"]
        )
        platform.call("disable")
        listener.until("robot_status", lambda message: message["drives_powered"] == 0, since)

        bag = ros.directory / "joints.bag"
        ros.run("/usr/bin/rosbag", "record", "-l", "20", "-O", bag, "/joint_states")
        assert re.search(r"messages:\s+20\n", ros.run("/usr/bin/rosbag", "info", bag).stdout)
    finally:
        feed.close()
        ros.stop(listener.process)
        ros.stop(node)
        ros.run("/usr/bin/rosparam", "delete", "/robot_description")


@pytest.mark.platform
def test_after_the_loss_of_platform_and_master_everything_is_there_again(ros: Ros, platform: Platform) -> None:
    node, listener = begin_node(ros, platform), Listener(ros)
    try:
        listener.until("robot_status", lambda message: message["in_motion"] == 0)
        kill(platform.pids()["loop"])
        gone = listener.until("robot_status", lambda message: message["in_motion"] == -1)
        known = ("mode", "e_stopped", "drives_powered", "motion_possible", "in_motion", "in_error", "error_code")
        assert [gone[name] for name in known] == [-1, -1, -1, 0, -1, -1, 0]
        entry = listener.until("diagnostics", lambda message: message["values"].get("connected") == "false")
        assert entry["level"] == 3
        assert "has ended" in entry["text"]
        joints, statuses = len(listener.heard("joint_states")), len(listener.heard("robot_status"))
        until(lambda: len(listener.heard("robot_status")) > statuses + 5, "statuses without a platform")
        assert len(listener.heard("joint_states")) == joints
        ros.kill_core()
        try:
            # Connections continue without a master; the platform's channels cannot be registered before there is one.
            platform.rtcp("stop", check=None)
            platform.rtcp("start", "--detach")
            until(lambda: len(listener.heard("joint_states")) > joints + 10, "joint states without a master")
            listener.until("robot_status", lambda message: message["in_motion"] == 0, statuses)
        finally:
            ros.start_core()
        topics = {"/joint_states", "/feedback_states", "/robot_status", "/diagnostics", "/tf", "/joint_command"}
        until(lambda: topics <= set(ros.run("/usr/bin/rostopic", "list").stdout.split()), "the topics")
        assert "/rtcp" in ros.run("/usr/bin/rosnode", "list").stdout.split()
        until(lambda: "<robot" in description(ros), "robot_description")
        ros.stop(listener.process)
        listener = Listener(ros)
        listener.until("robot_status", lambda message: message["e_stopped"] == 0)
        assert node.poll() is None  # the same process: a supervisor sees no end
        node.send_signal(signal.SIGTERM)
        assert node.wait(HANG_S) == 0
        assert "/rtcp" not in ros.run("/usr/bin/rosnode", "list").stdout.split()
        ros.kill_core()
        try:
            node = begin_node(ros, platform)
            # The node waits for the master. SIGTERM ends it during this wait.
            until(lambda: handles(node.pid, signal.SIGTERM), "the start of the node")
            node.send_signal(signal.SIGTERM)
            assert node.wait(HANG_S) == 0
            node = begin_node(ros, platform)
        finally:
            ros.start_core()
        until(lambda: "/rtcp" in ros.run("/usr/bin/rosnode", "list").stdout.split(), "the node")
    finally:
        ros.stop(listener.process)
        ros.stop(node)


def test_the_name_of_a_platform_is_the_namespace_of_its_node(ros: Ros, tmp_path: Path) -> None:
    command = (sys.executable, "-m", "rtcp.cli", "--name", "left", "ros", "--name", "left_node")
    node = ros.background(*command, RTCP_RUNTIME_DIR=str(tmp_path))
    try:
        until(lambda: "/left/robot_stop" in ros.run("/usr/bin/rosservice", "list").stdout.split(), "its services")
        assert "/left/left_node" in ros.run("/usr/bin/rosnode", "list").stdout.split()
    finally:
        ros.stop(node)


def test_the_tools_of_ros_read_its_messages_and_simulated_time_without_a_clock_holds_nothing_up(
    ros: Ros, tmp_path: Path
) -> None:
    ros.run("/usr/bin/rosparam", "set", "/use_sim_time", "true")
    node = ros.background(sys.executable, "-m", "rtcp.cli", "ros", RTCP_RUNTIME_DIR=str(tmp_path))
    try:
        folder = ros.run(sys.executable, "-m", "rtcp.cli", "ros", "--messages").stdout.strip()
        echo = ("timeout", str(HANG_S), "/usr/bin/rostopic", "echo", "-n")
        shown = ros.run(*echo, "2", "/robot_status", PYTHONPATH=folder).stdout
        assert [int(value) for value in re.findall(r"val: (-?\d)", shown)] == 2 * [-1, -1, -1, 0, -1, -1]
        # The first one is latched; the others come from a timer of actionlib.
        statuses = ros.run(*echo, "3", "/joint_trajectory_action/status", PYTHONPATH=folder).stdout
        assert statuses.count("status_list") == 3
    finally:
        ros.stop(node)
        ros.run("/usr/bin/rosparam", "delete", "/use_sim_time")


def test_a_word_that_is_no_remapping_is_refused(ros_on_the_path: None) -> None:
    command = [sys.executable, "-m", "rtcp.cli", "ros", "joint_states"]
    refused = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stderr) == (
        2,
        "rtcp: joint_states is no remapping: write NAME:=VALUE\n",
    )
