"""The node over Zenoh against a client that has rmw_zenoh's conventions in literals of its own, through a router."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed: pip install 'rtcp[zenoh]'")

import zenoh
import zenoh.ext

from rtcp.ros.ros2_node import Commands, Publications
from rtcp.ros.ros2_types import FOLLOW, decode, encode, type_hash
from rtcp.ros.ros2_zenoh import ZenohWire, open_session
from tests.ros.test_commands import ARM_HEATER, HEAT_ROD, HERE, FakeArm
from tests.waiting import until

from .node import CONFIG, OPTIONS, SAMPLE, arrive, commanded, point, trajectory
from .zenoh_client import GID, JOINT_STATES, Goal, Router, call, tokens


@pytest.fixture
def router() -> Iterator[Router]:
    made = Router()
    yield made
    made.close()


@pytest.fixture
def session(router: Router) -> Iterator[Any]:
    with open_session(router.address) as opened:
        yield opened


@pytest.fixture
def wire(router: Router, commands: Commands) -> Iterator[ZenohWire]:
    with open_session(router.address) as opened:
        yield ZenohWire(opened, OPTIONS, commands)


@pytest.fixture
def publications(wire: ZenohWire, commands: Commands) -> Publications:
    return Publications(wire, "arm", commands.commander.note_stop)


def test_a_subscriber_receives_joint_states_with_number_and_instant(session: Any, publications: Publications) -> None:
    received: list[Any] = []
    subscriber = session.declare_subscriber(JOINT_STATES, received.append)

    def publish() -> bool:
        publications.joints(tuple("abcdef"), SAMPLE)
        return len(received) > 1

    until(publish, "joint_states")
    subscriber.undeclare()
    message = decode("sensor_msgs/msg/JointState", received[0].payload.to_bytes())
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert (message.name, message.position.tolist()) == (list("abcdef"), list(SAMPLE.position))
    first, second = (struct.unpack("<qqB16s", sample.attachment.to_bytes()) for sample in received[:2])
    assert second[0] == first[0] + 1 > 1  # each publisher counts its own messages
    assert 0 <= time.time_ns() - first[1] < 3600 * 1e9
    assert first[2:] == (16, second[3])


def test_node_topics_and_services_are_in_the_lists(session: Any, wire: ZenohWire) -> None:
    until(lambda: len(tokens(session)) >= 18, "the tokens")
    keys = tokens(session)
    [zid] = {token.split("/")[2] for token in keys}
    assert f"@ros2_lv/0/{zid}/0/0/NN/%/%/arm" in keys
    endings = {token.split("/", 5)[5] for token in keys}
    kind_and_hash = JOINT_STATES.removeprefix("0/joint_states/")
    assert f"MP/%/%/arm/%joint_states/{kind_and_hash}/::,10:,:,:,," in endings
    assert any(end.startswith("MP/%/%/arm/%robot_description/") and end.endswith("/:1:,1:,:,:,,") for end in endings)
    assert any(end.startswith("MS/%/%/arm/%joint_path_command/trajectory_msgs::msg::dds_::Joint") for end in endings)
    assert any(end.startswith("SS/%/%/arm/%robot_enable/std_srvs::srv::dds_::Trigger_/RIHS01_") for end in endings)
    action = "SS/%/%/arm/%joint_trajectory_action%_action%send_goal/control_msgs::action::dds_::FollowJointTrajectory_"
    assert any(end.startswith(action) for end in endings)
    assert len({token.split("/")[4] for token in keys}) == len(keys)


def test_a_late_subscriber_receives_the_robot_description(session: Any, publications: Publications) -> None:
    publications.connected(CONFIG)
    received: list[Any] = []
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    subscriber = zenoh.ext.declare_advanced_subscriber(
        session,
        f"0/robot_description/std_msgs::msg::dds_::String_/{type_hash('std_msgs/msg/String')}",
        received.append,
        history=history,
    )
    until(lambda: received, "the description")
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    assert decode("std_msgs/msg/String", received[0].payload.to_bytes()).data.startswith("<?xml")


@pytest.mark.parametrize("topic", ["joint_command", "joint_path_command"])
def test_commands_reach_the_arm_and_bytes_that_are_none_do_not(
    session: Any, wire: ZenohWire, arm: FakeArm, topic: str, caplog: pytest.LogCaptureFixture
) -> None:
    message, kind = (
        (point(0.0, (0.1, 0.2, 0.3)), "trajectory_msgs/msg/JointTrajectoryPoint")
        if topic == "joint_command"
        else (trajectory(), "trajectory_msgs/msg/JointTrajectory")
    )
    key = f"0/{topic}/trajectory_msgs::msg::dds_::{kind.rpartition('/')[2]}_/{type_hash(kind)}"

    def put(data: bytes) -> None:
        session.put(key, data, attachment=struct.pack("<qqB16s", 1, time.time_ns(), 16, GID))

    def log() -> bool:
        put(b"\x00\x01\x00\x00\xff\xff\xff\xff")
        return "8 bytes are no" in caplog.text

    until(log, "the log")
    assert arm.calls == []

    def command() -> list[Any]:
        put(encode(kind, message))
        return commanded(arm, topic)

    call = until(command, "the command")[0]
    assert call[1] == (HERE if topic == "joint_command" else [list(HERE), [0.0, 0.0, 0.0]])


def test_services_answer_with_the_reason(
    session: Any, wire: ZenohWire, arm: FakeArm, commands: Commands, caplog: pytest.LogCaptureFixture
) -> None:
    answer = call(session, "robot_enable", "std_srvs/srv/Trigger")
    assert (answer.success, answer.message) == (True, "the drives are enabled")
    assert (
        call(session, "joint_path_command", "industrial_msgs/srv/CmdJointTrajectory", trajectory=trajectory()).code.val
        == 1
    )
    assert call(session, "stop_motion", "industrial_msgs/srv/StopMotion").code.val == 1
    assert arm.calls[-1] == "halt"
    wrong = trajectory(names=("a", "b", "z"))
    assert (
        call(session, "joint_path_command", "industrial_msgs/srv/CmdJointTrajectory", trajectory=wrong).code.val == -1
    )
    assert "joint 'z' is unknown" in caplog.text


def test_commands_of_processes_are_services(session: Any, publications: Publications, arm: FakeArm) -> None:
    publications.serve([ARM_HEATER, HEAT_ROD])
    assert call(session, "heater/arm_heater", "std_srvs/srv/Trigger").message == "heater is armed"
    text = "straight_and_unloaded=true phase=austenite"
    assert call(session, "heater/heat_rod", "diagnostic_msgs/srv/AddDiagnostics", load_namespace=text).success
    assert arm.calls[-1] == ("heat_rod", {"straight_and_unloaded": True, "phase": "austenite"})


def test_a_goal_has_feedback_and_a_result(
    session: Any, wire: ZenohWire, publications: Publications, arm: FakeArm, commands: Commands
) -> None:
    kind = f"{FOLLOW}_FeedbackMessage"
    received: list[Any] = []
    name = "control_msgs::action::dds_::FollowJointTrajectory_FeedbackMessage_"
    key = f"0/joint_trajectory_action/_action/feedback/{name}/{type_hash(kind)}"
    subscriber = session.declare_subscriber(key, received.append)
    goal = Goal(session)
    assert goal.accepted

    def publish() -> list[Any]:
        publications.joints(tuple("abcdef"), SAMPLE)
        return received

    until(publish, "feedback")
    subscriber.undeclare()
    feedback = decode(kind, received[0].payload.to_bytes())
    assert bytes(feedback.goal_id.uuid) == bytes(goal.uuid.uuid)
    assert feedback.feedback.error.positions.tolist() == pytest.approx([0.05] * 6)
    arrive(arm, commands)
    answer = goal.result()
    assert (answer.status, answer.result.error_code) == (4, 0)
    assert answer.result.error_string.startswith("there")


def test_a_cancelled_goal_brakes_and_ends_as_cancelled(session: Any, wire: ZenohWire, arm: FakeArm) -> None:
    goal = Goal(session)
    until(lambda: arm.calls, "the motion")
    answer = goal.cancel()
    assert (answer.return_code, len(answer.goals_canceling)) == (0, 1)
    assert goal.result().status == 5
    assert arm.calls[-1] == "brake"


def test_a_refused_goal_ends_with_the_reason(session: Any, wire: ZenohWire, arm: FakeArm) -> None:
    goal = Goal(session, names=("a", "b", "z"))
    assert goal.accepted
    answer = goal.result()
    assert (answer.status, answer.result.error_code) == (6, -2)
    assert "'z' is unknown" in answer.result.error_string
    assert arm.calls == []


def test_after_the_end_of_the_router_everything_is_there_again(
    router: Router, wire: ZenohWire, publications: Publications
) -> None:
    router.close()
    router.open()
    received: list[Any] = []
    with open_session(router.address) as session:
        until(lambda: any("joint_states" in token for token in tokens(session)), "the tokens")
        subscriber = session.declare_subscriber(JOINT_STATES, received.append)

        def publish() -> list[Any]:
            publications.joints(tuple("abcdef"), SAMPLE)
            return received

        until(publish, "joint_states")
        subscriber.undeclare()
        assert call(session, "stop_motion", "industrial_msgs/srv/StopMotion").code.val == 1
