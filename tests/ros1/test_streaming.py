"""Streams of points at any rate, from a ROS client to the frames: the commanded position has no step."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.api import Feed
from tests.e2e.conftest import Platform
from tests.e2e.wire import COUNTS_PER_RAD, outputs

from .conftest import Ros, begin_node, command, is_at, until

pytestmark = pytest.mark.platform
RADIUS_RAD, PERIOD_S = 0.1, 4.0


@pytest.fixture(params=[()], ids=["replacing"])
def arm(ros: Ros, platform: Platform, request: pytest.FixtureRequest) -> Iterator[Platform]:
    """A platform, enabled, at rest at 0, with a node in front of it."""
    platform.restore()
    node = begin_node(ros, platform, *request.param)
    platform.call("enable")
    yield platform
    ros.stop(node)


def largest_step(records: Any, feed: Feed) -> float:
    """Return the largest change of a commanded velocity from cycle to cycle, as part of acceleration x cycle."""
    answered = records["wkc"] == records["wkc_expected"]
    change = np.abs(np.diff(np.diff(records["commanded_position"], axis=0), axis=0)) / (feed.period_ns * 1e-9) ** 2
    most = np.array([joint.acceleration for joint in feed.config.joints])
    # The setpoints stand still in a cycle without an answer.
    whole = answered[:-2] & answered[1:-1] & answered[2:]
    return float((change[whole] / most).max())


def frames_of(path: Path) -> list[list[int]]:
    """Return the target positions in each frame, counts."""
    return [[drive.position for drive in drives] for _, drives in outputs(path)]


def changes(targets: list[list[int]]) -> list[list[int]]:
    """Return each target that differs from the one before."""
    return [after for before, after in pairwise(targets) if after != before]


def stream(ros: Ros, arm: Platform, **given: Any) -> tuple[list[float], Any, float]:
    """Stream; return the last target, the records until the arm is there, and the largest step in them."""
    feed, frames = Feed(arm.directory), arm.directory / "frames"
    taken = []
    asked = {"topic": "joint_command", "velocities": True, "radius": RADIUS_RAD, "period_s": PERIOD_S, **given}

    def ended() -> bool:
        records, missing = feed.records()
        assert not missing
        taken.append(records)
        return client.poll() is not None

    with arm.capture(frames):
        client = ros.begin_client("stream", **asked)
        until(ended, "the end of the stream")
        last: list[float] = json.loads((client.communicate()[0]).partition("answer ")[2])["last"]
        until(lambda: ended() and is_at(arm, last), "the last target")
    records = np.concatenate(taken)
    sent = np.rint(records["sent_position"] * COUNTS_PER_RAD).astype(int).tolist()
    assert changes(frames_of(frames)) == changes(sent)
    step = largest_step(records, feed)
    feed.close()
    return last, records, step


@pytest.mark.parametrize("has_velocities", [True, False], ids=["velocities", "positions"])
@pytest.mark.parametrize("rate_hz", [1, 30, 250, 1000])
def test_a_stream_at_any_rate_is_followed_without_a_step(
    ros: Ros, arm: Platform, rate_hz: int, has_velocities: bool
) -> None:
    count = max(4, round(0.875 * PERIOD_S * rate_hz))
    _, records, step = stream(ros, arm, rate_hz=rate_hz, count=count, velocities=has_velocities)
    assert step <= 1.01
    assert records["commanded_position"][:, 0].max() == pytest.approx(2 * RADIUS_RAD, abs=0.02)


@pytest.mark.parametrize("arm", [("--buffer", "2")], indirect=True, ids=["buffered"])
@pytest.mark.parametrize("rate_hz", [1, 30])
def test_a_buffered_stream_is_executed_that_much_later_without_a_stop_between_its_points(
    ros: Ros, arm: Platform, rate_hz: int
) -> None:
    _, records, step = stream(ros, arm, rate_hz=rate_hz, count=5 * rate_hz, period_s=12.0)
    assert step <= 1.01
    whole = records[records["wkc"] == records["wkc_expected"]]
    change = np.abs(np.diff(whole["commanded_position"][:, 0]))
    moves = np.flatnonzero(change > change.max() / 5)
    assert change[moves[0] : moves[-1]].min() > 0.0


def test_a_joint_trajectory_as_of_moveit_servo_is_followed_without_a_step(ros: Ros, arm: Platform) -> None:
    names = arm.status()["joint_names"]
    _, records, step = stream(ros, arm, topic="joint_trajectory", rate_hz=30, count=105, names=names)
    assert step <= 1.01
    assert records["commanded_position"][:, 0].max() == pytest.approx(2 * RADIUS_RAD, abs=0.02)


def test_whoever_goes_on_streaming_after_stop_motion_moves_nothing(ros: Ros, arm: Platform) -> None:
    client = ros.begin_client(
        "stream", topic="joint_command", velocities=True, radius=RADIUS_RAD, period_s=20.0, rate_hz=50, count=400
    )
    try:
        arm.until_moving(0.01)
        assert command(ros, "stop_motion") == {"code": 1}
        rest = arm.status()["joints"]["commanded_position"]
        client.communicate()
        assert arm.status()["joints"]["commanded_position"] == rest
    finally:
        client.kill()
    # Its next stream begins anew.
    command(ros, "point", t=0.0, q=[0.05, *[0.0] * 5])
    until(lambda: is_at(arm, [0.05, *[0.0] * 5]), "the point")


def test_the_latency_of_topic_and_service_is_measured_in_the_frames(ros_on_the_path: None, platform: Platform) -> None:
    platform.until(lambda status: not status["lease"]["holder"], "the end of the last stream's lease")
    platform.restore()
    platform.call("enable")
    command = [sys.executable, "-m", "rtcp.ros.ros1_latency", "10"]
    done = subprocess.run(command, env=platform.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert sorted(report) == ["service", "topic"]
    # At least the cycle that takes the command; how many of the ten are measured, and the rest, depends on the host.
    assert all(seconds and min(seconds) > 0.0 for seconds in report.values()), report
