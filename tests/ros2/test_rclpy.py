"""The node on rclpy and the node over DDS without ROS, each in front of a client on rclpy: Fast DDS, services, actions.

`make test-ros` runs these tests where the wheels of ROS 2 can be installed, in a network namespace of their own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed: make test-ros has it in an environment of its own")

import rclpy
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from rtcp.api import RtcpError
from rtcp.ros import ros2_dds, ros2_rclpy
from rtcp.ros.ros2_node import IN, LATCHED, OUT, SERVICES, Commands, Publications
from rtcp.ros.ros2_rclpy import class_of, make
from rtcp.ros.ros2_types import FOLLOW, TRIGGER, WITH_TEXT, type_hash
from rtcp.ros.state import ChannelSample, Diagnostics, RobotStatus
from tests.e2e.conftest import Platform
from tests.ros.test_commands import ARM_HEATER, HEAT_ROD, HERE, NAMES, FakeArm
from tests.waiting import HANG_S, until

from .node import CONFIG, OPTIONS, SAMPLE, arrive, commanded, outputs

POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


def duration(seconds: float) -> Any:
    return make("builtin_interfaces/msg/Duration", sec=int(seconds), nanosec=round(seconds % 1 * 1e9))


def trajectory(names: Any = NAMES, start: Any = HERE, end: Any = (0.0, 0.0, 0.0), seconds: float = 1.0) -> Any:
    points = [make(POINT, positions=start), make(POINT, positions=end, time_from_start=duration(seconds))]
    return make(TRAJECTORY, joint_names=list(names), points=points)


class Client:
    """A node of a client, in a context of its own."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._ended = Future()
        self._spinning = threading.Thread(
            target=self._executor.spin_until_future_complete, args=[self._ended], daemon=True
        )
        self._spinning.start()

    def close(self) -> None:
        self._ended.set_result(None)
        self._spinning.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def subscribe(self, topic: str, kind: str) -> list[Any]:
        received: list[Any] = []
        is_latched = topic in LATCHED
        durability = DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=1 if is_latched else 10, durability=durability)
        self.node.create_subscription(class_of(kind), topic, received.append, qos)
        return received

    def call(self, service: str, kind: str = "", **fields: Any) -> Any:
        kind = kind or SERVICES[service]
        client = self.node.create_client(class_of(kind), service)
        assert client.wait_for_service(timeout_sec=HANG_S)
        return client.call(make(f"{kind}_Request", **fields))

    def goal(self, path: Any, on_feedback: Any = None, **fields: Any) -> Any:
        """Send a goal and return its handle, once it is accepted."""
        client = ActionClient(self.node, class_of(FOLLOW), "joint_trajectory_action")
        assert client.wait_for_server(timeout_sec=HANG_S)
        goal = make(f"{FOLLOW}_Goal", trajectory=path, **fields)
        handle = self.answer(lambda: client.send_goal_async(goal, feedback_callback=on_feedback))
        assert handle.accepted
        return handle

    def answer(self, ask: Callable[[], Any]) -> Any:
        """Return the answer to a request of an action: `ask` returns its future.

        It runs on the executor. On another thread it may note the number of its request after the answer has come, and
        an ActionClient drops an answer whose number it does not know.
        """
        asked = self._executor.create_task(ask)
        until(lambda: asked.done() and asked.result().done(), "the answer")
        return asked.result().result()

    def status_of(self, goal: Any, received: list[Any]) -> int:
        """Return the status of a goal as published; subscribes with the first call."""
        if not received:
            received.append(self.subscribe("joint_trajectory_action/_action/status", "action_msgs/msg/GoalStatusArray"))
        latest = received[0][-1].status_list if received[0] else []
        return next((each.status for each in latest if each.goal_info.goal_id == goal.goal_id), 0)

    def result(self, goal: Any) -> Any:
        return self.answer(goal.get_result_async)

    def cancel(self, goal: Any) -> Any:
        return self.answer(goal.cancel_goal_async)

    def set_parameter(self, node: str, name: str, value: float) -> Any:
        parameters = AsyncParameterClient(self.node, node)
        assert parameters.wait_for_services(timeout_sec=HANG_S)
        answer = parameters.set_parameters([Parameter(name, value=value)])
        until(answer.done, "the parameter")
        return answer.result().results[0]


class Ros(Client):
    """The node under test in front of a fake arm, and a client."""

    def __init__(self, open_wire: Any, commands: Commands, domain: int) -> None:
        self._opened = contextlib.ExitStack()
        options = dataclasses.replace(OPTIONS, domain=domain)
        wire = self._opened.enter_context(open_wire(options, commands, threading.Event()))
        self.publications = Publications(wire, "arm", lambda: None)
        super().__init__(domain)

    def end_node(self) -> None:
        self._opened.close()

    def close(self) -> None:
        self.end_node()
        super().close()


_DOMAINS = itertools.count(1)


@pytest.fixture
def domain() -> int:
    """A domain of its own for each test.

    Fast DDS gives the participants of a process the identities of those that have ended. One that still knows the older
    one does not find the topics and services of the newer one, now and then.
    """
    return next(_DOMAINS)


@pytest.fixture
def ros(commands: Commands, domain: int) -> Iterator[Ros]:
    """The node on rclpy."""
    made = Ros(ros2_rclpy.open_wire, commands, domain)
    yield made
    made.close()


@pytest.fixture(params=["rclpy", "dds"])
def each_wire(request: pytest.FixtureRequest, commands: Commands, domain: int) -> Iterator[Ros]:
    """The node on rclpy, and the node on Cyclone DDS without ROS."""
    made = Ros(ros2_rclpy.open_wire if request.param == "rclpy" else ros2_dds.open_wire, commands, domain)
    yield made
    made.close()


def test_every_topic_is_published(each_wire: Ros) -> None:
    publications = each_wire.publications
    received = {topic: each_wire.subscribe(topic, kind) for topic, kind in OUT.items()}

    def publish() -> bool:
        publications.connected(CONFIG)
        publications.joints(tuple("abcdef"), SAMPLE)
        publications.status(RobotStatus(1, error_code=3, speed_override=0.5))
        publications.diagnostics(Diagnostics(1, 2, "fault"))
        publications.channels(ChannelSample(1, {"valves": {"current": 12.5}}))
        publications.processes({"heater": Diagnostics(1, 0, "armed", (("busy", "1"),))})
        return all(received.values())

    until(publish, "each topic")
    assert list(received["joint_states"][0].position) == list(SAMPLE.position)
    assert list(received["robot_status"][0].error_codes) == [3]
    assert received["speed_override_state"][0].data == 0.5
    assert received["diagnostics"][0].status[0].level == b"\2"
    assert list(received["gpio_controller/gpio_states"][0].interface_values[0].values) == [12.5]
    assert received["processes"][0].status[0].message == "armed"


def test_each_publisher_announces_the_hash_that_rosidl_has_for_its_type(each_wire: Ros) -> None:
    for topic, kind in OUT.items():

        def endpoints(topic: str = topic) -> Any:
            return each_wire.node.get_publishers_info_by_topic(topic)

        (endpoint,) = until(endpoints, topic)
        _, _, digest = type_hash(kind).partition("_")
        assert (endpoint.topic_type, bytes(endpoint.topic_type_hash.value).hex()) == (kind, digest)


def test_a_late_subscriber_receives_the_robot_description(each_wire: Ros) -> None:
    each_wire.publications.connected(CONFIG)
    received = each_wire.subscribe("robot_description", OUT["robot_description"])
    until(lambda: received, "the description")
    assert received[0].data.startswith("<?xml")
    assert received[0].data.endswith("</robot>\n")


@pytest.mark.parametrize("quality", ["RELIABLE", "BEST_EFFORT"])
@pytest.mark.parametrize("topic", IN)
def test_commands_reach_the_arm(each_wire: Ros, arm: FakeArm, topic: str, quality: str) -> None:
    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy[quality])
    publisher = each_wire.node.create_publisher(class_of(IN[topic]), topic, qos)
    path = trajectory()
    message, expected = {
        "joint_command": (path.points[0], HERE),
        "speed_override": (make(IN["speed_override"], data=0.5), 0.5),
        "gpio_controller/commands": (outputs({"valves": {"current": 12.5}}, make), 12.5),
    }.get(topic, (path, [list(HERE), [0.0, 0.0, 0.0]]))

    def publish() -> list[Any]:
        publisher.publish(message)
        return commanded(arm, topic)

    assert until(publish, "the command")[0][1] == expected


def test_bytes_that_are_no_message_are_dropped_and_the_next_message_is_taken(each_wire: Ros, arm: FakeArm) -> None:
    publisher = each_wire.node.create_publisher(class_of(TRAJECTORY), "joint_path_command", 10)

    def publish() -> list[Any]:
        publisher.publish(b"\x00\x01\x00\x00\xff\xff\xff\xff")
        publisher.publish(trajectory())
        return arm.calls

    assert until(publish, "the command")[0][1] == [list(HERE), [0.0, 0.0, 0.0]]


def test_services_answer_with_the_reason(ros: Ros, arm: FakeArm, caplog: pytest.LogCaptureFixture) -> None:
    answer = ros.call("robot_enable")
    assert (answer.success, answer.message) == (True, "the drives are enabled")
    assert ros.call("joint_path_command", trajectory=trajectory()).code.val == 1
    assert ros.call("joint_path_command", trajectory=trajectory(("a", "b", "z"))).code.val == -1
    assert "joint 'z' is unknown" in caplog.text
    assert ros.call("stop_motion").code.val == 1
    assert arm.calls[-1] == "halt"


def test_a_limit_that_is_set_as_a_parameter_is_in_force_or_keeps_its_value_with_the_reason(
    ros: Ros, arm: FakeArm
) -> None:
    assert ros.set_parameter("arm", "limits.cup.angle", 0.4).successful
    assert ros.set_parameter("arm", "other", 1.0).successful
    arm.refusal = RtcpError("refused", "only narrowed")
    answer = ros.set_parameter("arm", "limits.cup.angle", 2.0)
    assert (answer.successful, "only narrowed" in answer.reason) == (False, True)
    assert arm.calls == [("set_limits", {"cup.angle": 0.4})]


def test_a_goal_has_feedback_and_a_result(ros: Ros, arm: FakeArm, commands: Commands) -> None:
    received: list[Any] = []
    goal = ros.goal(trajectory(), received.append)

    def publish() -> list[Any]:
        ros.publications.joints(tuple("abcdef"), SAMPLE)
        return received

    until(publish, "feedback")
    assert list(received[0].feedback.error.positions) == pytest.approx([0.05] * 6)
    until(lambda: arm.calls, "the motion")
    arrive(arm, commands)
    answer = ros.result(goal)
    assert (answer.status, answer.result.error_code) == (4, 0)


def test_commands_of_processes_are_services_whatever_their_fields(ros: Ros, arm: FakeArm) -> None:
    for _ in range(2):  # of a platform that was started again
        ros.publications.serve([ARM_HEATER, HEAT_ROD])
    answer = ros.call("heater/arm_heater", TRIGGER)
    assert (answer.success, answer.message) == (True, "heater is armed")
    assert ros.call("heater/heat_rod", WITH_TEXT, load_namespace="phase=austenite").success
    assert arm.calls == [("arm_heater", {}), ("heat_rod", {"phase": "austenite"})]
    answer = ros.call("heater/heat_rod", WITH_TEXT, load_namespace="now")
    assert not answer.success
    assert "'now' is not a field" in answer.message


def test_a_cancelled_goal_brakes_and_ends_as_cancelled(ros: Ros, arm: FakeArm) -> None:
    goal = ros.goal(trajectory())
    until(lambda: arm.calls, "the motion")
    assert len(ros.cancel(goal).goals_canceling) == 1
    answer = ros.result(goal)
    assert (answer.status, answer.result.error_code) == (5, -1)
    until(lambda: arm.calls[-1] == "brake", "the braking")


def test_a_node_that_ends_brakes_the_arm_and_aborts_its_goal(ros: Ros, arm: FakeArm) -> None:
    goal = ros.goal(trajectory())
    until(lambda: arm.calls, "the motion")
    received: list[Any] = []
    until(lambda: ros.status_of(goal, received) == 2, "the status of the goal")
    ros.end_node()
    until(lambda: arm.calls[-1] == "brake", "the braking")
    until(lambda: ros.status_of(goal, received) == 6, "the end of the goal")


def test_a_refused_goal_ends_with_the_reason(ros: Ros, arm: FakeArm) -> None:
    answer = ros.result(ros.goal(trajectory(("a", "b", "z"))))
    assert (answer.status, answer.result.error_code) == (6, -2)
    assert "'z' is unknown" in answer.result.error_string


@pytest.fixture
def without_industrial_msgs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("industrial_msgs.msg", "industrial_msgs.srv"):
        monkeypatch.setitem(sys.modules, name, None)


def test_what_has_no_messages_here_is_left_out(
    without_industrial_msgs: None, ros: Ros, caplog: pytest.LogCaptureFixture
) -> None:
    ros.publications.status(RobotStatus(1))
    ros.publications.joints(tuple("abcdef"), SAMPLE)
    assert "robot_status is left out" in " ".join(record.getMessage() for record in caplog.get_records("setup"))
    assert ros.call("robot_enable").success

    def services() -> set[str]:
        found = dict(ros.node.get_service_names_and_types_by_node("arm", "/"))
        return found.keys() & {f"/{name}" for name in SERVICES}

    until(lambda: services() >= {"/robot_enable", "/robot_disable", "/robot_stop"}, "the services of std_srvs")
    assert len(services()) == 3


# -- a real platform ------------------------------------------------------------------------------------------------


@pytest.fixture
def served(domain: int) -> Iterator[tuple[Platform, Client]]:
    """A started platform, `rtcp ros --ros2` in front of it, and a client."""
    platform = Platform()
    platform.be_patient(2000)
    platform.environment["ROS_DOMAIN_ID"] = str(domain)
    platform.rtcp("start", "--detach")
    client = Client(domain)
    yield platform, client
    client.close()
    platform.end()


@pytest.mark.platform
def test_the_arm_is_enabled_moved_stopped_and_limited_over_rclpy(served: tuple[Platform, Client]) -> None:
    platform, client = served
    node = platform.background("ros", "--ros2", "--name", "arm")
    states = client.subscribe("joint_states", OUT["joint_states"])
    status = client.subscribe("robot_status", OUT["robot_status"])
    answer = client.call("robot_enable")
    assert answer.success, answer.message
    until(lambda: status and status[-1].motion_possible.val == 1, "a status")
    names = platform.status()["joint_names"]

    def path(end: list[float], seconds: float) -> Any:
        return trajectory(names, platform.status()["joints"]["commanded_position"], end, seconds)

    def rest() -> list[float]:
        found = platform.until(lambda status: status["state"] == "holding", "rest")
        return list(found["joints"]["commanded_position"])

    there = [0.2, 0.1, 0.0, 0.1, 0.0, 0.1]
    feedback: list[Any] = []
    ended = client.result(client.goal(path(there, 2.0), feedback.append))
    assert (ended.status, ended.result.error_code) == (4, 0), ended.result.error_string
    assert list(feedback[-1].feedback.joint_names) == names
    until(lambda: list(states[-1].position) == pytest.approx(there, abs=2e-3), "the end of the trajectory")

    cancelled = client.goal(path([0.4, *there[1:]], 20.0))
    platform.until(lambda status: status["joints"]["actual_position"][0] > 0.21, "motion")
    assert len(client.cancel(cancelled).goals_canceling) == 1
    assert client.result(cancelled).status == 5
    assert 0.2 < rest()[0] < 0.39

    replaced = client.goal(path([0.5, *there[1:]], 20.0))
    platform.until(lambda status: status["state"] == "moving", "motion")
    ended = client.result(client.goal(path(there, 3.0)))
    assert (ended.status, ended.result.error_code) == (4, 0), ended.result.error_string
    assert client.result(replaced).status == 6
    assert rest() == pytest.approx(there, abs=1e-3)

    tolerance = make("control_msgs/msg/JointTolerance", name=names[0], position=1e-9)
    violated = client.result(client.goal(path([0.0] * 6, 2.0), path_tolerance=[tolerance]))
    assert (violated.status, violated.result.error_code) == (6, -4)
    assert f"{names[0]} was" in violated.result.error_string
    assert rest()[0] > 0.01

    assert client.set_parameter("arm", f"limits.{names[0]}.max", 0.3).successful
    refused = client.result(client.goal(path([0.35, 0.0, 0.0, 0.0, 0.0, 0.0], 5.0)))
    assert refused.status == 6
    assert "0.3" in refused.result.error_string
    widened = client.set_parameter("arm", f"limits.{names[0]}.max", 4.0)
    assert (widened.successful, "3.1" in widened.reason) == (False, True), widened.reason
    assert client.call("robot_disable").success
    until(lambda: status[-1].drives_powered.val == 0, "the end of the torque")

    assert client.call("robot_enable").success
    client.goal(path([0.0] * 6, 20.0))
    platform.until(lambda status: status["state"] == "moving", "motion")
    node.send_signal(signal.SIGINT)
    _, log = node.communicate()
    assert (node.returncode, "Traceback" in log) == (0, False), log
    rest_after = platform.until(lambda status: status["state"] in ("holding", "ready"), "the end of the motion")
    assert rest_after["joints"]["commanded_position"][0] > 0.05
