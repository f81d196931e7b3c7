"""The node's messages and its action, without a wire, on a fake arm."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'rtcp[zenoh]'")

from kinematics.forward import forward
from rtcp.fieldbus.simple_message.messages import RobotMode, TriState
from rtcp.ros.processes import ProcessService
from rtcp.ros.ros2_action import ActionServer
from rtcp.ros.ros2_node import ACTION_TOPICS, OUT, Commands, Publications
from rtcp.ros.ros2_types import CANCEL, FOLLOW, encode, make
from rtcp.ros.state import ChannelSample, Diagnostics, RobotStatus
from tests.ros.test_commands import FakeArm
from tests.waiting import until

from .node import CONFIG, SAMPLE, arrive, trajectory

JOINTS = tuple("abcdef")


class Kept:
    """A wire that keeps the last message of each topic; each can be encoded."""

    make = staticmethod(make)
    topics = tuple(OUT)

    def __init__(self) -> None:
        self.messages: dict[str, Any] = {}
        self.feedback: list[Any] = []

    def publish(self, topic: str, message: Any) -> None:
        encode({**OUT, **ACTION_TOPICS}[topic], message)
        self.messages[topic] = message

    def publish_feedback(self, feedback: Any) -> None:
        self.feedback.append(feedback)

    def serve(self, service: ProcessService) -> None:
        raise NotImplementedError


@pytest.fixture
def wire() -> Kept:
    return Kept()


@pytest.fixture
def publications(wire: Kept) -> Publications:
    return Publications(wire, "arm", lambda: None)


def test_every_topic_is_published(wire: Kept, publications: Publications) -> None:
    publications.connected(CONFIG)
    publications.joints(JOINTS, SAMPLE)
    publications.status(RobotStatus(1, RobotMode.AUTO, error_code=7, speed_override=0.5))
    publications.diagnostics(Diagnostics(1, 2, "fault", (("state", "fault"),)))
    publications.channels(ChannelSample(1, {"valves": {"current": 12.5, "open": 1.0}, "io": {"part": 0.0}}))
    publications.processes({"heater": Diagnostics(2_000_000_003, 0, "armed", (("busy", "1"),))})
    assert wire.messages.keys() == OUT.keys()
    shown = wire.messages["gpio_controller/gpio_states"]
    assert shown.interface_groups == ["valves", "io"]
    assert [interface_value.values.tolist() for interface_value in shown.interface_values] == [[12.5, 1.0], [0.0]]
    assert shown.interface_values[0].interface_names == ["current", "open"]
    status = wire.messages["robot_status"]
    assert (status.mode.val, status.e_stopped.val, status.error_codes.tolist()) == (2, -1, [7])
    [entry] = wire.messages["diagnostics"].status
    assert (entry.level, entry.name, entry.values[0].value) == (2, "arm: robot", "fault")
    processes = wire.messages["processes"]
    assert (processes.header.stamp.sec, processes.header.stamp.nanosec) == (2, 3)
    [heater] = processes.status
    assert (heater.level, heater.name, heater.message, heater.values[0].key) == (0, "heater", "armed", "busy")
    feedback = wire.messages["feedback_states"]
    assert feedback.desired.positions.tolist() == pytest.approx([0.15] * 6)
    assert feedback.error.positions.tolist() == pytest.approx([0.05] * 6)
    assert wire.feedback == [feedback]


def test_the_transforms_lead_from_base_to_tool(wire: Kept, publications: Publications) -> None:
    publications.connected(CONFIG)
    publications.joints(JOINTS, SAMPLE)
    transforms = wire.messages["tf"].transforms
    links = ["base_link", *(f"link{number}" for number in range(1, 7)), "tool0"]
    assert [(transform.header.frame_id, transform.child_frame_id) for transform in transforms] == list(pairwise(links))
    total = np.eye(4)
    for transform in transforms:
        moved, q = transform.transform.translation, transform.transform.rotation
        w, v = q.w, np.array([q.x, q.y, q.z])
        cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        step = np.eye(4)
        step[:3, :3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        step[:3, 3] = moved.x, moved.y, moved.z
        total = total @ step
    assert CONFIG.arm is not None
    tool = forward(CONFIG.arm, SAMPLE.position)
    assert total[:3, 3] == pytest.approx(tool.position)
    assert total[:3, :3].ravel() == pytest.approx(tool.rotation, abs=1e-6)


def test_without_a_geometry_there_are_neither_transforms_nor_a_description(
    wire: Kept, publications: Publications
) -> None:
    publications.joints(JOINTS, SAMPLE)
    assert wire.messages.keys() == {"joint_states", "feedback_states"}


def test_a_status_in_error_ends_the_automatic_enabling(wire: Kept) -> None:
    noted: list[bool] = []
    publications = Publications(wire, "arm", lambda: noted.append(True))
    publications.status(RobotStatus(1))
    assert noted == []
    publications.status(RobotStatus(1, in_error=TriState.TRUE))
    assert noted == [True]


# -- the action -----------------------------------------------------------------------------------------------------


class Action:
    """Requests to the action's server, answered on its loop."""

    def __init__(self, commands: Commands, wire: Kept) -> None:
        self._commands = commands
        self.server = ActionServer(commands, make, wire.publish)

    def call(self, service: str, kind: str, **fields: Any) -> Any:
        request = make(f"{kind}_Request", **fields)
        response = self._commands.submit(self.server.respond(f"action/{service}", request)).result()
        encode(f"{kind}_Response", response)
        return response

    def send(self, number: int) -> bool:
        goal = make(f"{FOLLOW}_Goal", trajectory=trajectory())
        answer = self.call("send_goal", f"{FOLLOW}_SendGoal", goal_id=uuid(number), goal=goal)
        return bool(answer.accepted)

    def cancel(self, number: int = 0, stamp_s: int = 0) -> tuple[int, int]:
        stamp = make("builtin_interfaces/msg/Time", sec=stamp_s)
        info = make("action_msgs/msg/GoalInfo", goal_id=uuid(number), stamp=stamp)
        answer = self.call("cancel_goal", CANCEL, goal_info=info)
        return answer.return_code, len(answer.goals_canceling)

    def result(self, number: int) -> Any:
        return self.call("get_result", f"{FOLLOW}_GetResult", goal_id=uuid(number))


def uuid(number: int) -> Any:
    return make("unique_identifier_msgs/msg/UUID", uuid=number.to_bytes(16, "big"))


@pytest.fixture
def action(commands: Commands, wire: Kept) -> Action:
    return Action(commands, wire)


def states(wire: Kept) -> list[int]:
    return [goal.status for goal in wire.messages["joint_trajectory_action/_action/status"].status_list]


def test_the_status_of_a_goal_is_published_with_each_change(
    action: Action, wire: Kept, arm: FakeArm, commands: Commands
) -> None:
    assert action.send(1)
    assert states(wire) == [2]
    until(lambda: arm.calls, "the motion")
    arrive(arm, commands)
    assert action.result(1).status == 4
    assert states(wire) == [4]


def test_the_same_goal_again_is_rejected(action: Action, arm: FakeArm) -> None:
    assert action.send(1)
    assert not action.send(1)


def test_a_goal_that_is_cancelled_before_it_begins_has_a_result(action: Action, commands: Commands) -> None:
    async def at_once() -> Any:
        goal = make(f"{FOLLOW}_SendGoal_Request", goal_id=uuid(1), goal=make(f"{FOLLOW}_Goal", trajectory=trajectory()))
        await action.server.respond("action/send_goal", goal)
        return await action.server.respond("action/cancel_goal", make(f"{CANCEL}_Request"))

    assert len(commands.submit(at_once()).result().goals_canceling) == 1
    assert action.result(1).status == 5


def test_goals_are_cancelled_by_id_by_stamp_or_all(action: Action) -> None:
    action.send(1)
    assert action.cancel(number=2) == (2, 0)
    assert action.cancel(stamp_s=1) == (0, 0)
    assert action.cancel(number=1) == (0, 1)
    answer = action.result(1)
    assert (answer.status, answer.result.error_code) == (5, -1)
    assert answer.result.error_string == "cancelled: the arm brakes"
    assert action.cancel(number=1) == (3, 0)
    action.send(2)
    assert action.cancel() == (0, 1)
    action.send(3)
    assert action.cancel(stamp_s=2**31 - 1) == (0, 1)


def test_a_goal_that_another_replaces_is_aborted_with_the_reason(action: Action, arm: FakeArm) -> None:
    action.send(1)
    until(lambda: arm.calls, "the motion")
    action.send(2)
    answer = action.result(1)
    assert (answer.status, answer.result.error_string) == (6, "the motion was replaced")


def test_results_of_many_goals_are_forgotten_and_unknown_ones_have_no_state(
    action: Action, arm: FakeArm, wire: Kept
) -> None:
    for number in range(1, 41):
        action.send(number)
        action.cancel(number=number)
        action.result(number)
    assert len(states(wire)) <= 17
    assert action.result(1).status == 0
    assert action.result(40).status == 5
