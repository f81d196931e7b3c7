"""Commands of ROS clients to a real platform: topics, services, the action.

What each of them checks and refuses, one by one: tests/ros/test_commands.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from rtcp.api import Feed
from tests.e2e.conftest import Platform
from tests.waiting import until

from .conftest import Client, Ros, begin_node, is_at

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


def test_trajectories_of_topic_and_service_are_executed_replaced_and_stopped(client: Client, arm: Platform) -> None:
    client.command("path", **path(arm, THERE))
    until(lambda: is_at(arm, THERE), "the end of the published trajectory")
    back = path(arm, [0.0] * 6, 2.0, THERE[::-1])
    back["names"].reverse()
    assert client.command("service", **back) == {"code": 1}
    until(lambda: is_at(arm, [0.0] * 6), "the end of the trajectory with the joints in another order")
    feed = Feed(arm.directory)
    assert client.command("service", **path(arm, [value * 2 for value in THERE], 20.0)) == {"code": 1}
    arm.until_moving(0.01)
    assert client.command("service", **path(arm, THERE)) == {"code": 1}
    until(lambda: is_at(arm, THERE), "the end of the trajectory that replaces another")
    records, _ = feed.records()
    feed.close()
    # Without a stop: it moves in every cycle.
    whole = records[records["wkc"] == records["wkc_expected"]]
    change = np.abs(np.diff(whole["commanded_position"], axis=0)).max(axis=1)
    moving = np.flatnonzero(change > 1e-6)
    assert change[moving[0] : moving[-1]].min() > 0.0
    assert client.command("service", **path(arm, [0.0] * 6, 20.0, THERE)) == {"code": 1}
    assert client.command("stop_motion") == {"code": 1}
    assert client.command("robot_stop") == {"success": True, "message": "the arm holds"}
    status = arm.status()
    assert status["state"] == "holding"
    here = status["joints"]["commanded_position"]
    assert here != pytest.approx([0.0] * 6, abs=1e-2)
    assert client.command("service", **path(arm, THERE, 2.0, here)) == {"code": 1}
    until(lambda: is_at(arm, THERE), "the end of the trajectory after the stop")
    client.command("point", t=0.0, q=[0.0] * 6)
    until(lambda: is_at(arm, [0.0] * 6), "the point")


def _is_logged(ros: Ros, words: str) -> bool:
    return words in ros.logs()


def test_what_is_refused_has_its_reason_in_the_answer_or_the_log_and_moves_nothing(
    ros: Ros, client: Client, arm: Platform
) -> None:
    since = arm.last_event()
    for change, words in (
        ({"names": ["a", "b", "c", "d", "e", "f"]}, "joint 'a' is unknown"),
        ({"points": [{"t": 0.0, "q": [0.0] * 6}, {"t": 2.0, "q": [9.0, 0, 0, 0, 0, 0]}]}, "point 2"),
        ({"points": [{"t": 1.0, "q": [float("nan")] * 6}]}, ""),
        ({"points": [{"t": 1.0, "q": [0.0] * 6}], "times": 100_000}, "100000 points"),
    ):
        assert client.command("service", **path(arm, THERE) | change) == {"code": -1}
        until(partial(_is_logged, ros, words), f"{words} in the log")
    client.command("point", t=0.0, q=[9.0] * 6)
    until(lambda: "outside its range" in ros.logs(), "the reason of the point in the log")
    client.command("path", **path(arm, [9.0, 0, 0, 0, 0, 0]))
    until(lambda: "joint_path_command: point 2" in ros.logs(), "the reason of the trajectory in the log")
    until(lambda: stays_at_rest(arm), "rest at 0")
    assert "moving" not in arm.events(since)
    assert client.command("robot_disable") == {"success": True, "message": "the drives are disabled"}
    assert arm.status()["state"] == "ready"
    assert client.command("service", **path(arm, THERE)) == {"code": -1}
    assert client.command("robot_enable") == {"success": True, "message": "the drives are enabled"}
    assert arm.status()["state"] == "holding"
    moving = arm.background("move", "0.5", "0", "0", "0", "0", "0", "--speed", "0.02")
    arm.until(lambda status: status["state"] == "moving", "motion")
    assert client.command("service", **path(arm, THERE)) == {"code": -1}
    until(lambda: "commanded by" in ros.logs(), "the reason in the log")
    assert moving.poll() is None
    arm.end_commands()


def test_goals_of_the_action_end_with_their_results(ros: Ros, client: Client, arm: Platform) -> None:
    unknown = client.command("follow", **path(arm, THERE) | {"names": ["a", "b", "c", "d", "e", "f"]})
    assert (unknown["state"], unknown["code"]) == (REJECTED, -2)
    assert "joint 'a' is unknown" in unknown["text"]
    until(lambda: stays_at_rest(arm), "rest at 0")
    every = [{"name": name, "position": 0.5} for name in arm.status()["joint_names"]]
    other = Client(ros)
    try:
        other.begin("follow", **path(arm, [value * 2 for value in THERE], 20.0))
        arm.until_moving(0.005)
        ended = client.command("follow", **path(arm, THERE), path_tolerance=every, goal_tolerance=every)
        assert (ended["state"], ended["code"]) == (SUCCEEDED, 0)
        assert is_at(arm, THERE)
        replaced = other.result()
        assert (replaced["state"], replaced["code"], replaced["text"]) == (
            PREEMPTED,
            -1,
            "the trajectory was replaced by another motion",
        )
    finally:
        other.end()
    tolerances = [{"name": "joint1", "position": 1e-9}, {"name": "joint2", "position": -1}]
    violated = client.command("follow", **path(arm, [0.0] * 6, 2.0, THERE), path_tolerance=tolerances)
    assert (violated["state"], violated["code"]) == (ABORTED, -4)
    assert "joint1 was" in violated["text"]
    here = arm.until(lambda status: status["state"] == "holding", "rest")["joints"]["commanded_position"]
    far = [value + 0.3 for value in here]
    cancelled = client.command("follow", **path(arm, far, 20.0, here), cancels=True)
    assert (cancelled["state"], cancelled["code"]) == (PREEMPTED, -1)
    rest = arm.until(lambda status: status["state"] == "holding", "rest")["joints"]["actual_position"]
    # On the path: all joints have moved equally far.
    moved = [after - before for before, after in zip(here, rest, strict=True)]
    assert 0.0 < moved[0] < 0.29
    assert moved == pytest.approx([moved[0]] * 6, abs=2e-3)
