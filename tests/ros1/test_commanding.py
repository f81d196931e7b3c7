"""Commands of ROS clients to a real platform: topics, services, the action."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import Platform

from .conftest import Ros, begin_node, until

pytestmark = pytest.mark.alone
CLIENT = Path(__file__).parent / "client.py"
THERE = [0.2, -0.1, 0.1, 0.0, 0.1, 0.3]
SUCCEEDED, PREEMPTED, ABORTED, REJECTED = 3, 2, 4, 5
"""actionlib_msgs/GoalStatus."""


@pytest.fixture(scope="module")
def commanded(ros: Ros, platform: Platform) -> Iterator[Platform]:
    """A platform with a node in front of it."""
    node = begin_node(ros, platform)
    yield platform
    ros.stop(node)


@pytest.fixture
def arm(commanded: Platform) -> Platform:
    """The same, enabled, at rest at 0."""
    commanded.call("halt") if commanded.status()["state"] == "moving" else None
    commanded.restore()
    commanded.call("enable")
    return commanded


def command(ros: Ros, kind: str, **given: Any) -> dict[str, Any]:
    said = ros.run(sys.executable, CLIENT, kind, json.dumps(given)).stdout
    (line,) = (line for line in said.splitlines() if line.startswith("answer "))
    answer: dict[str, Any] = json.loads(line.removeprefix("answer "))
    return answer


def path(arm: Platform, goal: list[float], seconds: float = 2.0, here: list[float] | None = None) -> dict[str, Any]:
    """Return a trajectory from 0, or `here`, to a goal."""
    points = [{"t": 0.0, "q": here or [0.0] * 6}, {"t": seconds, "q": goal}]
    return {"names": arm.status()["joint_names"], "points": points}


def is_at(arm: Platform, goal: list[float]) -> bool:
    status = arm.status()
    return bool(status["state"] == "holding" and status["joints"]["actual_position"] == pytest.approx(goal, abs=2e-3))


def stays_at_rest(arm: Platform) -> bool:
    """Whether no motion has begun since the arm was enabled."""
    return is_at(arm, [0.0] * 6) and "moving" not in arm.status()["state"]


def test_a_published_trajectory_is_executed(ros: Ros, arm: Platform) -> None:
    command(ros, "path", **path(arm, THERE))
    until(lambda: is_at(arm, THERE), "the end of the trajectory")


def test_the_service_answers_when_the_trajectory_runs(ros: Ros, arm: Platform) -> None:
    assert command(ros, "service", **path(arm, THERE, 5.0)) == {"code": 1}
    assert arm.status()["state"] in ("moving", "holding")
    until(lambda: is_at(arm, THERE), "the end of the trajectory")


def test_joints_in_another_order_go_where_they_belong(ros: Ros, arm: Platform) -> None:
    given = path(arm, THERE[::-1])
    given["names"].reverse()
    assert command(ros, "service", **given) == {"code": 1}
    until(lambda: is_at(arm, THERE), "the end of the trajectory")


def test_a_new_trajectory_takes_the_place_of_the_one_under_way(ros: Ros, arm: Platform) -> None:
    far = [value * 2 for value in THERE]
    assert command(ros, "service", **path(arm, far, 20.0)) == {"code": 1}
    assert command(ros, "service", **path(arm, THERE)) == {"code": 1}
    until(lambda: is_at(arm, THERE), "the end of the second trajectory")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"names": ["a", "b", "c", "d", "e", "f"]}, "joint 'a' is unknown"),
        ({"points": [{"t": 0.0, "q": [0.0] * 6}, {"t": 0.001, "q": THERE}]}, ""),
        ({"points": [{"t": 0.0, "q": [0.0] * 6}, {"t": 2.0, "q": [9.0, 0, 0, 0, 0, 0]}]}, "point 2"),
        ({"points": [{"t": 2.0, "q": THERE}, {"t": 1.0, "q": THERE}]}, "times must rise"),
        ({"points": [{"t": 1.0, "q": [float("nan")] * 6}]}, ""),
        ({"points": [{"t": 1.0, "q": [0.0] * 5}]}, "5 positions"),
    ],
)
def test_a_trajectory_that_is_refused_is_answered_with_the_reason_and_nothing_moves(
    ros: Ros, arm: Platform, change: dict[str, Any], words: str
) -> None:
    since = arm.last_event()
    answer = command(ros, "service", **path(arm, THERE) | change)
    assert words in answer["error"]
    assert "cannot process" in answer["error"]
    assert "error processing" not in answer["error"]
    assert stays_at_rest(arm)
    assert arm.events(since) == []


def test_a_second_commander_is_refused_with_the_name_of_the_first(ros: Ros, arm: Platform) -> None:
    moving = arm.background("move", "0.5", "0", "0", "0", "0", "0", "--speed", "0.02")
    arm.until(lambda status: status["state"] == "moving", "motion")
    answer = command(ros, "service", **path(arm, THERE))
    assert "commanded by" in answer["error"]
    assert moving.poll() is None


def test_stop_motion_stops_and_a_new_motion_goes_on(ros: Ros, arm: Platform) -> None:
    assert command(ros, "service", **path(arm, THERE, 20.0)) == {"code": 1}
    assert command(ros, "stop_motion") == {"code": 1}
    status = arm.status()
    assert status["state"] == "holding"
    assert status["joints"]["actual_position"] != pytest.approx(THERE, abs=1e-2)
    here = status["joints"]["commanded_position"]
    assert command(ros, "service", **path(arm, THERE, 3.0, here)) == {"code": 1}
    until(lambda: is_at(arm, THERE), "the end of the new trajectory")


def test_a_joint_command_moves_the_arm_there(ros: Ros, arm: Platform) -> None:
    command(ros, "point", t=0.0, q=THERE)
    until(lambda: is_at(arm, THERE), "the point")


def test_the_drives_are_enabled_and_disabled_by_their_services(ros: Ros, arm: Platform) -> None:
    assert command(ros, "robot_disable") == {"success": True, "message": "the drives are disabled"}
    assert arm.status()["state"] == "ready"
    refused = command(ros, "service", **path(arm, THERE))
    assert "error" in refused
    assert command(ros, "robot_enable") == {"success": True, "message": "the drives are enabled"}
    assert arm.status()["state"] == "holding"


def test_a_goal_of_the_action_ends_with_its_result(ros: Ros, arm: Platform) -> None:
    ended = command(ros, "follow", **path(arm, THERE))
    assert (ended["state"], ended["code"]) == (SUCCEEDED, 0)
    assert is_at(arm, THERE)


def test_a_goal_with_unknown_joints_is_rejected_with_code_and_reason(ros: Ros, arm: Platform) -> None:
    ended = command(ros, "follow", **path(arm, THERE) | {"names": ["a", "b", "c", "d", "e", "f"]})
    assert (ended["state"], ended["code"]) == (REJECTED, -2)
    assert "joint 'a' is unknown" in ended["text"]
    assert stays_at_rest(arm)


def test_a_goal_that_is_cancelled_ends_and_the_arm_holds_on_the_way(ros: Ros, arm: Platform) -> None:
    ended = command(ros, "follow", **path(arm, THERE, 20.0), cancel_s=0.5)
    assert ended["state"] == PREEMPTED
    rest = arm.until(lambda status: status["state"] == "holding", "rest")["joints"]["actual_position"]
    assert 0.0 < rest[0] < THERE[0] - 0.01
    # On the path: all joints have come equally far.
    assert [have / want for have, want in zip(rest, THERE, strict=True) if want] == pytest.approx(
        [rest[0] / THERE[0]] * 5, abs=0.02
    )


def test_a_goal_during_which_the_platform_dies_ends(ros: Ros, arm: Platform) -> None:
    goal = subprocess.Popen(
        ros.enter(sys.executable, CLIENT, "follow", json.dumps(path(arm, THERE, 30.0))),
        env=ros.environment, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        arm.until(lambda status: status["state"] == "moving", "motion")
        arm.rtcp("stop")
        said, _ = goal.communicate()
    finally:
        goal.kill()
    assert json.loads(said.partition("answer ")[2])["state"] == ABORTED
    arm.rtcp("start", "--detach")
    # The node finds the new platform; nothing moves by itself.
    assert command(ros, "robot_enable")["success"]
    assert arm.status()["state"] == "holding"
