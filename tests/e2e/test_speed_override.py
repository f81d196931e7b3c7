"""The speed override on a real socket between real processes: motions slow down and speed up."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import rtcp
from rtcp.api import Robot, State
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

HERE = [0.0, -0.2, 2.0, 0.0, 1.0, 0.0]
THERE = [0.9, *HERE[1:]]


@pytest.fixture
def robot(enabled: Platform) -> Iterator[Robot]:
    with rtcp.connect("who moves", control_socket(enabled.directory)) as robot:
        robot.set_speed_override(1.0)
        robot.move_joints(HERE)
        yield robot
    with rtcp.connect("who cleans up", control_socket(enabled.directory)) as robot:
        robot.set_speed_override(1.0)


def circle(robot: Robot) -> Any:
    assert robot.pose is not None
    x, y, z, *rpy = robot.pose
    return robot.move_arc([x, y + 0.1, z - 0.1], [x, y, z - 0.2, *rpy], 6.283, 0.2)


@pytest.mark.parametrize(
    "motion",
    [
        pytest.param(lambda robot: robot.move_joints(THERE, 0.3), id="joints"),
        pytest.param(lambda robot: robot.run_trajectory([{"t": 0.0, "q": HERE}, {"t": 4.0, "q": THERE}]), id="points"),
        pytest.param(lambda robot: robot.move_by([0.0, 0.2, 0.0, 0.0, 0.0, 0.0], speed=0.06), id="line"),
        pytest.param(circle, id="circle"),
    ],
)
def test_a_motion_under_way_slows_down_and_speeds_up_again(
    shared: Platform, robot: Robot, motion: Callable[[Robot], Any]
) -> None:
    feed = rtcp.Feed(shared.directory)
    with rtcp.connect("who slows", control_socket(shared.directory)) as other, ThreadPoolExecutor(1) as pool:
        going = pool.submit(motion, robot)
        # The first path that a gateway plans loads scipy.
        end = time.monotonic() + 20.0
        while other.state is not State.MOVING:
            assert time.monotonic() < end
        time.sleep(1.0)
        other.set_speed_override(0.1)
        time.sleep(1.5)
        assert not going.done()
        with pytest.raises(rtcp.Refused, match="who moves"):
            other.set_speed_override(0.2)
        status = other.status()
        assert status.speed_override == other.speed_override == pytest.approx(0.1)
        other.halt()
        with pytest.raises(rtcp.RtcpError):
            going.result()
        # Nobody holds the lease now.
        other.set_speed_override(1.0)
        robot.move_joints(HERE)
        records, missing = feed.records()
    assert not missing
    period_s = feed.period_ns * 1e-9
    feed.close()
    answered = records["wkc"] == records["wkc_expected"]
    speed = np.abs(np.diff(records["sent_position"], axis=0)).max(axis=1) / period_s
    slow = (records["speed_override"][1:] < 0.2) & answered[1:] & answered[:-1]
    first = int(np.argmax(slow))
    before, after = speed[max(first - 200, 0) : first], speed[slow][len(speed[slow]) // 2 :]
    assert np.median(after) < 0.25 * np.median(before)
    change = np.abs(np.diff(np.diff(records["sent_position"], axis=0), axis=0)).max(axis=1) / period_s**2
    whole = answered[:-2] & answered[1:-1] & answered[2:]
    assert change[whole].max() <= 1.02 * min(joint.acceleration for joint in feed.config.joints)


def test_the_command_line_shows_and_sets_it(enabled: Platform, robot: Robot) -> None:
    assert "100" in enabled.rtcp("speed").stdout
    enabled.rtcp("speed", "30")
    assert "30" in enabled.rtcp("speed").stdout
    assert "30" in enabled.rtcp("status").stdout
    began = time.monotonic()
    arrival = robot.move_joints([0.3, *HERE[1:]], 0.3)
    assert time.monotonic() - began > 2.5
    assert arrival.positions[0] == pytest.approx(0.3, abs=1e-3)
    robot.halt()
    robot.disable()
    robot.enable()
    assert robot.speed_override == pytest.approx(0.3)
    for wrong in ("0", "101", "nan", "fast"):
        enabled.rtcp("speed", wrong, check=2)
        assert robot.speed_override == pytest.approx(0.3)
    with pytest.raises(rtcp.Invalid, match=r"from 0\.01 to 1"):
        robot.set_speed_override(0.0)


def test_a_circle_is_paused_by_another_client_and_goes_on(shared: Platform, robot: Robot) -> None:
    with rtcp.connect("who pauses", control_socket(shared.directory)) as other, ThreadPoolExecutor(1) as pool:
        with pytest.raises(rtcp.Refused):
            other.pause()
        going = pool.submit(circle, robot)
        end = time.monotonic() + 20.0
        while other.state is not State.MOVING:
            assert time.monotonic() < end
        time.sleep(1.0)
        other.pause()
        time.sleep(1.0)
        paused = other.status()
        time.sleep(1.0)
        later = other.status()
        assert later.sent_positions == paused.sent_positions
        assert (later.state, later.speed_override) == (State.MOVING, 0.0)
        assert later.message == "paused: the motion rests on its path"
        with rtcp.connect("who looks on", control_socket(shared.directory)) as third:
            with pytest.raises(rtcp.Refused, match="who paused the motion") as refused:
                third.resume()
            assert refused.value.reason == "paused_by_another"
            third.pause()
            with pytest.raises(rtcp.Refused, match="another who paused the motion"):
                third.resume()
        assert other.status().sent_positions == paused.sent_positions
        other.resume()
        going.result()
        status = other.status()
    assert status.speed_override == 1.0
    assert status.positions == pytest.approx(HERE, abs=2e-3)


def test_who_paused_a_motion_that_has_ended_does_not_resume_the_next_one(shared: Platform, robot: Robot) -> None:
    socket = control_socket(shared.directory)
    with rtcp.connect("before", socket) as before, rtcp.connect("now", socket) as now, ThreadPoolExecutor(1) as pool:
        for pauser in (before, now):
            going = pool.submit(circle, robot)
            shared.until_moving(0.0)
            pauser.pause()
            shared.until(lambda status: status["speed_override"] == 0.0, "the pause")
            if pauser is before:
                before.halt()
                with pytest.raises(rtcp.RtcpError):
                    going.result()
                robot.move_joints(HERE)
        with pytest.raises(rtcp.Refused, match="another who paused the motion"):
            before.resume()
        now.resume()
        going.result()


def test_the_arm_moves_home(robot: Robot) -> None:
    robot.move_home()
    assert robot.positions == pytest.approx([0.0, 0.3, 1.5708, 0.0, 0.5, 0.0], abs=2e-3)
