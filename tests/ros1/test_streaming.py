"""Streams of points at any rate, from a ROS client to the frames: the commanded position has no step."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.api import Feed
from rtcp.telemetry.experiments.latency import fit_sine, read_log
from tests.e2e.conftest import Platform
from tests.e2e.wire import COUNTS_PER_RAD, outputs
from tests.waiting import until

from .conftest import Client, Ros, begin_node, is_at

pytestmark = pytest.mark.platform
RADIUS_RAD, PERIOD_S = 0.1, 4.0
LONG = pytest.mark.long("test_a_stream_at_any_rate_is_followed_without_a_step[250-True]")


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


def stream(ros: Ros, client: Client, arm: Platform, **given: Any) -> Any:
    """Stream; assert that no cycle has a step and that the frames have the records' targets; return the records.

    Where the host has held up the node or the client for too long, the platform has ended the stream: it is repeated.
    """
    asked = {"topic": "joint_command", "velocities": True, "radius": RADIUS_RAD, "period_s": PERIOD_S, **given}
    frames = arm.directory / "frames"
    taken: list[Any] = []

    def ended() -> bool:
        records, missing = feed.records()
        assert not missing
        taken.append(records)
        return client.has_answered()

    def arrived() -> bool:
        ended()
        return is_at(arm, last) or refused()

    def refused() -> bool:
        return ros.logs().count("did not run") > refusals or "setpoint_out_of_order" in arm.events(since)

    while True:
        refusals, since = ros.logs().count("did not run"), arm.last_event()
        taken.clear()
        with contextlib.closing(Feed(arm.directory)) as feed:
            with arm.capture(frames):
                client.begin("stream", **asked)
                until(ended, "the end of the stream")
                last: list[float] = client.result()["last"]
                until(arrived, "the last target")
            if not refused():
                break
        arm.until(lambda status: not status["lease"]["holder"], "the end of the stream's lease")
        arm.restore()
        arm.call("enable")
    records = np.concatenate(taken)
    sent = np.rint(records["sent_position"] * COUNTS_PER_RAD).astype(int).tolist()
    assert changes(frames_of(frames)) == changes(sent)
    assert largest_step(records, feed) <= 1.01
    return records


@pytest.mark.parametrize(
    ("rate_hz", "has_velocities"),
    [(250, True), *(pytest.param(*case, marks=LONG) for case in ((250, False), (1, True), (30, False), (1000, True)))],
)
def test_a_stream_at_any_rate_is_followed_without_a_step(
    ros: Ros, client: Client, arm: Platform, rate_hz: int, has_velocities: bool
) -> None:
    count = max(4, round(0.875 * PERIOD_S * rate_hz))
    records = stream(ros, client, arm, rate_hz=rate_hz, count=count, velocities=has_velocities)
    assert records["commanded_position"][:, 0].max() == pytest.approx(2 * RADIUS_RAD, abs=0.02)


@pytest.mark.long("test_points_that_wait_in_a_buffered_stream_open_no_trajectory_after_a_stop")
@pytest.mark.parametrize("arm", [("--buffer", "2")], indirect=True, ids=["buffered"])
@pytest.mark.parametrize("rate_hz", [1, 30])
def test_a_buffered_stream_is_executed_that_much_later_without_a_stop_between_its_points(
    ros: Ros, client: Client, arm: Platform, rate_hz: int
) -> None:
    records = stream(ros, client, arm, rate_hz=rate_hz, count=5 * rate_hz, period_s=12.0)
    whole = records[records["wkc"] == records["wkc_expected"]]
    change = np.abs(np.diff(whole["commanded_position"][:, 0]))
    moves = np.flatnonzero(change > change.max() / 5)
    assert change[moves[0] : moves[-1]].min() > 0.0


def test_a_joint_trajectory_as_of_moveit_servo_is_followed_without_a_step(
    ros: Ros, client: Client, arm: Platform
) -> None:
    names = arm.status()["joint_names"]
    records = stream(ros, client, arm, topic="joint_trajectory", rate_hz=30, count=105, names=names)
    assert records["commanded_position"][:, 0].max() == pytest.approx(2 * RADIUS_RAD, abs=0.02)


def test_whoever_goes_on_streaming_after_stop_motion_moves_nothing(ros: Ros, client: Client, arm: Platform) -> None:
    other = Client(ros)
    try:
        while True:  # until a stream moves the arm that the host did not hold up
            client.begin(
                "stream", topic="joint_command", velocities=True, radius=0.3, period_s=20.0, rate_hz=50, count=500
            )
            until(lambda: client.has_answered() or arm.status()["state"] == "moving", "motion")
            if not client.has_answered():
                break
            client.result()
        assert other.command("stop_motion") == {"code": 1}
        rest = arm.status()["joints"]["commanded_position"]
        assert not client.has_answered()
        client.result()
        assert arm.status()["joints"]["commanded_position"] == rest
        # Its next stream begins anew, after a pause.
        goal = [0.05, *[0.0] * 5]
        until(lambda: other.command("point", t=0.0, q=goal) == {} and is_at(arm, goal), "the point", 2.0)
    finally:
        other.end()


@pytest.mark.long("test_the_latency_of_each_wire_is_measured_in_the_frames[simple-message]")
def test_the_latency_of_topic_and_service_is_measured_in_the_frames_and_a_sine_is_logged_from_the_topics(
    ros_on_the_path: None, platform: Platform, tmp_path: Path
) -> None:
    platform.until(lambda status: not status["lease"]["holder"], "the end of the last stream's lease")
    platform.restore()
    platform.call("enable")
    command = [sys.executable, "-m", "rtcp.ros.ros1_latency", "probe", "10"]
    done = subprocess.run(command, env=platform.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert sorted(report) == ["service", "topic"]
    # At least the cycle that takes the command; how many of the ten are measured, and the rest, depends on the host.
    assert all(seconds and min(seconds) > 0.0 for seconds in report.values()), report
    platform.until(lambda status: not status["lease"]["holder"], "the end of the node's lease")
    command[3:] = ["sine", str(tmp_path), "30", "0.05", "2", "3"]
    done = subprocess.run(command, env=platform.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 0.0 < time.monotonic() - float(done.stdout) < 3600.0
    name = platform.status()["joint_names"][0]
    logged = {topic: read_log(tmp_path / f"{topic}.csv", name) for topic in ("joint_command", "joint_states")}
    assert min(t[0] for t, _ in logged.values()) == 0.0
    sines = {topic: fit_sine(t[t > 2.0], q[t > 2.0], 2.0, 4.0) for topic, (t, q) in logged.items()}
    assert sines["joint_command"].amplitude == pytest.approx(0.05, rel=0.2)
    assert sines["joint_states"].amplitude == pytest.approx(0.05, rel=0.3)
