"""The node on rclpy: on a stand-in of our own, and on rclpy itself where that is installed."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'rtcp[zenoh]'")

from rtcp.ros.ros2_node import IN, OUT, Commands, Publications
from rtcp.ros.ros2_types import FOLLOW
from rtcp.ros.state import ChannelSample, Diagnostics, RobotStatus
from tests.ros.test_commands import HERE, NAMES, FakeArm
from tests.waiting import until

from . import rclpy_stand_in
from .node import CONFIG, OPTIONS, SAMPLE, arrive, commanded, outputs

TIMEOUT_S = 100.0


class Ros:
    """The node under test, and a node of a client."""

    def __init__(self, commands: Commands) -> None:
        self.skin = importlib.import_module("rtcp.ros.ros2_rclpy")
        self._opened = self.skin.open_wire(OPTIONS, commands, threading.Event())
        self.wire = self._opened.__enter__()
        self.publications = Publications(self.wire, "arm", lambda: None)
        import rclpy
        from rclpy.executors import MultiThreadedExecutor

        self.node = rclpy.create_node("client")
        self._executor = MultiThreadedExecutor(4)
        self._executor.add_node(self.node)
        threading.Thread(target=self._executor.spin, daemon=True).start()

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._opened.__exit__(None, None, None)

    def make(self, name: str, **fields: Any) -> Any:
        return self.skin.make(name, **fields)

    def subscribe(self, topic: str, kind: str) -> list[Any]:
        received: list[Any] = []
        self.node.create_subscription(self.skin.class_of(kind), topic, received.append, self.skin._qos(topic))
        return received

    def call(self, service: str, kind: str, **fields: Any) -> Any:
        client = self.node.create_client(self.skin.class_of(kind), service)
        assert client.wait_for_service(timeout_sec=TIMEOUT_S)
        return client.call(self.make(f"{kind}_Request", **fields))

    def trajectory(self, names: Any = NAMES) -> Any:
        kind = "trajectory_msgs/msg/JointTrajectoryPoint"
        later = self.make("builtin_interfaces/msg/Duration", sec=1)
        points = [self.make(kind, positions=HERE), self.make(kind, positions=(0.0, 0.0, 0.0), time_from_start=later)]
        return self.make("trajectory_msgs/msg/JointTrajectory", joint_names=list(names), points=points)

    def goal(self, on_feedback: Any = None, names: Any = NAMES) -> Any:
        from rclpy.action import ActionClient

        client = ActionClient(self.node, self.skin.class_of(FOLLOW), "joint_trajectory_action")
        assert client.wait_for_server(timeout_sec=TIMEOUT_S)
        goal = self.make(f"{FOLLOW}_Goal", trajectory=self.trajectory(names))
        sent = client.send_goal_async(goal, feedback_callback=on_feedback)
        until(sent.done, "the goal")
        return sent.result()


@pytest.fixture(params=["rclpy", "stand-in"])
def ros(request: pytest.FixtureRequest, commands: Commands, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    if request.param == "stand-in":
        for name, module in rclpy_stand_in.modules().items():
            monkeypatch.setitem(sys.modules, name, module)
    elif importlib.util.find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed: source a ROS 2 environment, in its Python")
    monkeypatch.delitem(sys.modules, "rtcp.ros.ros2_rclpy", raising=False)
    made = Ros(commands)
    yield made
    made.close()
    sys.modules.pop("rtcp.ros.ros2_rclpy", None)


def test_every_topic_is_published(ros: Ros) -> None:
    received = {topic: ros.subscribe(topic, kind) for topic, kind in OUT.items()}

    def publish() -> bool:
        ros.publications.connected(CONFIG)
        ros.publications.joints(tuple("abcdef"), SAMPLE)
        ros.publications.status(RobotStatus(1, error_code=3, speed_override=0.5))
        ros.publications.diagnostics(Diagnostics(1, 2, "fault"))
        ros.publications.channels(ChannelSample(1, {"valves": {"current": 12.5}}))
        return all(received.values())

    until(publish, "each topic")
    assert list(received["joint_states"][0].position) == list(SAMPLE.position)
    assert list(received["robot_status"][0].error_codes) == [3]
    assert received["speed_override_state"][0].data == 0.5
    assert received["diagnostics"][0].status[0].level == b"\2"
    assert list(received["gpio_controller/gpio_states"][0].interface_values[0].values) == [12.5]


def test_a_late_subscriber_receives_the_robot_description(ros: Ros) -> None:
    ros.publications.connected(CONFIG)
    received = ros.subscribe("robot_description", OUT["robot_description"])
    until(lambda: received, "the description")
    assert received[0].data.startswith("<?xml")


@pytest.mark.parametrize("quality", ["RELIABLE", "BEST_EFFORT"])
@pytest.mark.parametrize("topic", IN)
def test_commands_reach_the_arm(ros: Ros, arm: FakeArm, topic: str, quality: str) -> None:
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy[quality])
    publisher = ros.node.create_publisher(ros.skin.class_of(IN[topic]), topic, qos)
    trajectory = ros.trajectory()
    message, expected = {
        "joint_command": (trajectory.points[0], HERE),
        "speed_override": (ros.make(IN["speed_override"], data=0.5), 0.5),
        "gpio_controller/commands": (outputs({"valves": {"current": 12.5}}, ros.make), 12.5),
    }.get(topic, (trajectory, [list(HERE), [0.0, 0.0, 0.0]]))

    def publish() -> list[Any]:
        publisher.publish(message)
        return commanded(arm, topic)

    assert until(publish, "the command")[0][1] == expected


def test_services_answer_with_the_reason(ros: Ros, arm: FakeArm, caplog: pytest.LogCaptureFixture) -> None:
    answer = ros.call("robot_enable", "std_srvs/srv/Trigger")
    assert (answer.success, answer.message) == (True, "the drives are enabled")
    path = "industrial_msgs/srv/CmdJointTrajectory"
    assert ros.call("joint_path_command", path, trajectory=ros.trajectory()).code.val == 1
    assert ros.call("joint_path_command", path, trajectory=ros.trajectory(("a", "b", "z"))).code.val == -1
    assert "joint 'z' is unknown" in caplog.text


def test_a_goal_has_feedback_and_a_result(ros: Ros, arm: FakeArm, commands: Commands) -> None:
    received: list[Any] = []
    goal = ros.goal(received.append)
    assert goal.accepted

    def publish() -> list[Any]:
        ros.publications.joints(tuple("abcdef"), SAMPLE)
        return received

    until(publish, "feedback")
    assert list(received[0].feedback.error.positions) == pytest.approx([0.05] * 6)
    until(lambda: arm.calls, "the motion")
    arrive(arm, commands)
    answer = goal.get_result()
    assert (answer.status, answer.result.error_code) == (4, 0)


def test_a_cancelled_goal_brakes_and_ends_as_cancelled(ros: Ros, arm: FakeArm) -> None:
    goal = ros.goal()
    until(lambda: arm.calls, "the motion")
    assert len(goal.cancel_goal().goals_canceling) == 1
    assert goal.get_result().status == 5
    until(lambda: arm.calls[-1] == "brake", "the braking")


def test_a_refused_goal_ends_with_the_reason(ros: Ros, arm: FakeArm) -> None:
    answer = ros.goal(names=("a", "b", "z")).get_result()
    assert (answer.status, answer.result.error_code) == (6, -2)
    assert "'z' is unknown" in answer.result.error_string


def test_what_has_no_messages_here_is_left_out(
    commands: Commands, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name, module in rclpy_stand_in.modules().items():
        monkeypatch.setitem(sys.modules, name, None if name.startswith("industrial_msgs") else module)
    monkeypatch.delitem(sys.modules, "rtcp.ros.ros2_rclpy", raising=False)
    ros = Ros(commands)
    ros.publications.status(RobotStatus(1))
    ros.publications.joints(tuple("abcdef"), SAMPLE)
    assert "robot_status is left out" in caplog.text
    assert rclpy_stand_in.SERVICES.keys() == {"robot_enable", "robot_disable"}
    ros.close()
    sys.modules.pop("rtcp.ros.ros2_rclpy", None)
