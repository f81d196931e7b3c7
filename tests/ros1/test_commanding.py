"""Commands of ROS clients to a real platform: topics, services, the action."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from rtcp.api import Feed
from tests.e2e.conftest import Platform

from .conftest import Ros, begin_node, command, is_at, until

pytestmark = pytest.mark.platform
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
    commanded.until(lambda status: not status["lease"]["holder"], "the end of the last stream's lease")
    commanded.restore()
    commanded.call("enable")
    return commanded


def path(arm: Platform, goal: list[float], seconds: float = 2.0, here: list[float] | None = None) -> dict[str, Any]:
    """Return a trajectory from 0, or `here`, to a goal."""
    points = [{"t": 0.0, "q": here or [0.0] * 6}, {"t": seconds, "q": goal}]
    return {"names": arm.status()["joint_names"], "points": points}


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
    feed = Feed(arm.directory)
    arm.until_moving(0.01)
    assert command(ros, "service", **path(arm, THERE)) == {"code": 1}
    until(lambda: is_at(arm, THERE), "the end of the second trajectory")
    records, _ = feed.records()
    feed.close()
    # Without a stop: it moves in every cycle.
    whole = records[records["wkc"] == records["wkc_expected"]]
    change = np.abs(np.diff(whole["commanded_position"], axis=0)).max(axis=1)
    moves = np.flatnonzero(change > 1e-6)
    assert change[moves[0] : moves[-1]].min() > 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"names": ["a", "b", "c", "d", "e", "f"]}, "joint 'a' is unknown"),
        ({"points": [{"t": 0.0, "q": [0.0] * 6}, {"t": 0.001, "q": THERE}]}, ""),
        ({"points": [{"t": 0.0, "q": [0.0] * 6}, {"t": 2.0, "q": [9.0, 0, 0, 0, 0, 0]}]}, "point 2"),
        ({"points": [{"t": 2.0, "q": THERE}, {"t": 1.0, "q": THERE}]}, "times must rise"),
        ({"points": [{"t": 1.0, "q": [float("nan")] * 6}]}, ""),
        ({"points": [{"t": 1.0, "q": [0.0] * 5}]}, "5 positions"),
        ({"points": [{"t": 1.0, "q": [0.0] * 13}]}, "13 positions"),
        ({"names": [f"joint{number}" for number in range(1, 14)]}, "joint 'joint7' is unknown"),
        ({"points": [{"t": 1.0, "q": [0.0] * 6}], "times": 100_000}, "100000 points"),
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


@pytest.mark.parametrize(
    ("q", "words"),
    [
        ([float("nan")] * 6, "not finite"),
        ([0.1] * 5, "found 5 positions"),
        ([0.1] * 13, "found 13 positions"),
        ([9.0] * 6, "outside its range"),
    ],
)
def test_a_joint_command_that_is_refused_is_logged_with_the_reason_and_nothing_moves(
    ros: Ros, arm: Platform, q: list[float], words: str
) -> None:
    before = ros.logs().count(words)
    command(ros, "point", t=0.0, q=q)
    until(lambda: ros.logs().count(words) > before, "the reason in the log")
    until(lambda: stays_at_rest(arm), "rest at 0")


def test_a_published_trajectory_that_is_refused_is_logged_with_the_reason(ros: Ros, arm: Platform) -> None:
    command(ros, "path", **path(arm, [9.0, 0, 0, 0, 0, 0]))
    until(lambda: "joint_path_command: point 2" in ros.logs(), "the reason in the log")
    assert stays_at_rest(arm)


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


def test_a_goal_whose_path_tolerance_is_not_kept_is_aborted_with_its_code(ros: Ros, arm: Platform) -> None:
    tolerances = [{"name": "joint1", "position": 1e-9}, {"name": "joint2", "position": -1}]
    ended = command(ros, "follow", **path(arm, THERE), path_tolerance=tolerances)
    assert (ended["state"], ended["code"]) == (ABORTED, -4)
    assert "joint1 was" in ended["text"]
    arm.until(lambda status: status["state"] == "holding", "rest")


def test_a_goal_inside_its_tolerances_succeeds(ros: Ros, arm: Platform) -> None:
    every = [{"name": name, "position": 0.5} for name in arm.status()["joint_names"]]
    ended = command(ros, "follow", **path(arm, THERE), path_tolerance=every, goal_tolerance=every)
    assert (ended["state"], ended["code"]) == (SUCCEEDED, 0)


def test_a_new_goal_preempts_the_one_under_way(ros: Ros, arm: Platform) -> None:
    first = ros.begin_client("follow", **path(arm, [value * 2 for value in THERE], 20.0))
    try:
        arm.until_moving(0.005)
        ended = command(ros, "follow", **path(arm, THERE))
        said, _ = first.communicate()
    finally:
        first.kill()
    assert (ended["state"], ended["code"]) == (SUCCEEDED, 0)
    assert json.loads(said.partition("answer ")[2])["state"] == PREEMPTED


def test_a_goal_with_unknown_joints_is_rejected_with_code_and_reason(ros: Ros, arm: Platform) -> None:
    ended = command(ros, "follow", **path(arm, THERE) | {"names": ["a", "b", "c", "d", "e", "f"]})
    assert (ended["state"], ended["code"]) == (REJECTED, -2)
    assert "joint 'a' is unknown" in ended["text"]
    assert stays_at_rest(arm)


def test_a_goal_that_is_cancelled_ends_and_the_arm_holds_on_the_way(ros: Ros, arm: Platform) -> None:
    ended = command(ros, "follow", **path(arm, THERE, 20.0), cancel_s=6.0)
    assert ended["state"] == PREEMPTED
    rest = arm.until(lambda status: status["state"] == "holding", "rest")["joints"]["actual_position"]
    assert 0.0 < rest[0] < THERE[0] - 0.01
    # On the path: all joints are at the same fraction.
    assert [have / want for have, want in zip(rest, THERE, strict=True) if want] == pytest.approx(
        [rest[0] / THERE[0]] * 5, abs=0.02
    )


def test_a_goal_during_which_the_platform_dies_ends(ros: Ros, arm: Platform) -> None:
    goal = ros.begin_client("follow", **path(arm, THERE, 30.0))
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
