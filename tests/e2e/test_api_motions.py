"""The API as a ROS node or any streaming program uses it: on a real socket between real processes."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import rtcp
from rtcp.api import Arrival, AsyncRobot, Robot, State
from rtcp.ipc.runtime_directory import control_socket, segment_control
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import Platform, kill

pytestmark = pytest.mark.platform

HOME = [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]


def at(first: float) -> list[float]:
    return [first, *HOME[1:]]


@pytest.fixture
def robot(enabled: Platform) -> Iterator[Robot]:
    with rtcp.connect("a program", control_socket(enabled.directory)) as robot:
        robot.move_joints(HOME)
        yield robot


def run(shared: Platform, work: Callable[[AsyncRobot], Coroutine[Any, Any, Any]]) -> Any:
    async def connected() -> Any:
        async with rtcp.connect_async("a program", control_socket(shared.directory)) as made:
            return await work(made)

    return asyncio.run(connected())


def largest_step(feed: rtcp.Feed) -> float:
    """Return the largest change of a commanded velocity between answered cycles, as part of acceleration x cycle."""
    records, missing = feed.records()
    assert not missing
    answered = records["wkc"] == records["wkc_expected"]
    assert len(records) > 100
    period_s = feed.period_ns * 1e-9
    change = np.abs(np.diff(np.diff(records["commanded_position"], axis=0), axis=0)).max(axis=1) / period_s**2
    # The setpoints stand still in a cycle without an answer.
    whole = answered[:-2] & answered[1:-1] & answered[2:]
    most = min(joint.acceleration for joint in feed.config.joints)
    return float(change[whole].max() / most)


def test_a_motion_replaces_another_without_a_stop_and_each_ends_with_its_own_outcome(
    shared: Platform, robot: Robot
) -> None:
    robot.close()
    feed = rtcp.Feed(shared.directory)

    async def moves(arm: AsyncRobot) -> Sequence[Any]:
        first = asyncio.create_task(arm.move_joints(at(0.6)))
        await asyncio.sleep(0.7)
        second = asyncio.create_task(arm.move_joints(at(-0.2), replace=True))
        await asyncio.sleep(0.4)
        points = [{"t": 0.0, "q": at(0.3)}, {"t": 3.0, "q": at(0.2)}, {"t": 4.5, "q": at(0.3)}]
        third = asyncio.create_task(arm.run_trajectory(points, replace=True))
        return await asyncio.gather(first, second, third, return_exceptions=True)

    first, second, third = run(shared, moves)
    assert (type(first), type(second)) == (rtcp.Replaced, rtcp.Replaced)
    assert isinstance(third, Arrival)
    assert third.positions[0] == pytest.approx(0.3, abs=1e-3)
    assert largest_step(feed) <= 1.01
    feed.close()


def test_a_motion_that_would_replace_and_is_refused_leaves_the_other_as_it_is(shared: Platform, robot: Robot) -> None:
    robot.close()

    async def moves(arm: AsyncRobot) -> Any:
        first = asyncio.create_task(arm.move_joints(at(0.3)))
        await asyncio.sleep(0.4)
        with pytest.raises(rtcp.Refused) as refused:
            await arm.move_joints(at(9.0), replace=True)
        assert refused.value.reason == "position_out_of_range"
        return await first

    assert run(shared, moves).positions[0] == pytest.approx(0.3, abs=1e-3)


def test_a_program_knows_the_tool_and_waits_for_an_input_and_sets_an_output(shared: Platform, robot: Robot) -> None:
    pose = robot.fk(robot.positions)
    assert robot.pose == pytest.approx(pose, abs=2e-3)
    raised = [*pose[:2], pose[2] + 0.03, *pose[3:]]
    feed = rtcp.Feed(shared.directory)
    arrival = robot.move_joints(robot.ik(raised))
    records, _ = feed.records()
    feed.close()
    assert robot.pose == pytest.approx(raised, abs=2e-3)
    assert robot.ik(robot.fk(arrival.positions)) == pytest.approx(arrival.positions, abs=1e-6)
    # The integral of the record's tool velocity is the motion of its pose.
    speeds, steps = records["tool_vz"][1:], np.diff(records["time_ns"]) * 1e-9
    assert float(speeds @ steps) == pytest.approx(records["tool_z"][-1] - records["tool_z"][0], abs=3e-3)
    assert records["tool_z"][-1] - records["tool_z"][0] == pytest.approx(0.03, abs=2e-3)
    with pytest.raises(rtcp.Refused) as refused:
        robot.ik([9.0, *pose[1:]])
    assert refused.value.reason == "out_of_reach"

    assert not robot.io["io.12"]
    with SegmentClient(segment_control(shared.directory)) as segment, ThreadPoolExecutor(1) as program:
        other = rtcp.connect("another program", control_socket(shared.directory))
        waiting = program.submit(other.io.wait, "io.12", True, 10.0)
        time.sleep(0.1)
        assert not waiting.done()
        segment.fault({"fault": "input", "number": 12, "how": "high"})
        waiting.result(10.0)
        other.close()
    robot.io["io.5"] = True
    robot.wait_io("io.5", True, 2.0)
    assert robot.io.outputs["io.5"]
    robot.io["io.5"] = False
    with pytest.raises(rtcp.Refused) as refused:
        robot.io["state_lamp"] = True
    assert refused.value.reason == "reserved_output"


@pytest.mark.parametrize("rate_hz", [100, 1000, 2000])
def test_a_stream_of_setpoints_loses_none_and_is_followed(shared: Platform, robot: Robot, rate_hz: int) -> None:
    feed, circumference = rtcp.Feed(shared.directory), 2 * math.pi * 0.4
    with robot.open_stream() as stream:
        began = time.monotonic()
        for number in range(2 * rate_hz):
            t = number / rate_hz
            while time.monotonic() < began + t:
                time.sleep(0)
            velocity = [0.1 * circumference * math.sin(circumference * t), *[0.0] * 5]
            stream.send(at(0.1 * (1 - math.cos(circumference * t))), velocity, t=t)
        feed.ended(0.1)
        assert stream.taken == stream.sent == 2 * rate_hz
    assert largest_step(feed) <= 1.01
    feed.close()
    robot.move_joints(HOME)  # the next command waits until the arm rests, and has the lease
    robot.close()


def test_a_setpoint_that_cannot_be_followed_ends_the_stream_and_the_next_send_says_why(robot: Robot) -> None:
    with robot.open_stream() as stream:
        stream.send(HOME)
        stream.send(at(9.0))
        while stream.is_open:
            time.sleep(0.002)
        with pytest.raises(rtcp.Faulted) as ended:
            stream.send(HOME)
    assert (ended.value.reason, ended.value.fields["axis"], ended.value.fields["value"]) == (
        "setpoint_out_of_range", 0, 9.0,
    )  # fmt: skip
    with robot.open_stream() as stream:
        stream.send([math.nan, *HOME[1:]])
        while stream.is_open:
            time.sleep(0.002)
        with pytest.raises(rtcp.Faulted, match="joint1: a number of the stream's setpoint is not finite"):
            stream.send(HOME)
    wrong: list[tuple[Any, str]] = [
        ([0.0, 0.0], "q: found 2 numbers, allowed are 6: one a joint"),
        (None, "q: found None, allowed are 6 numbers: one a joint"),
        (5, "q: found 5, allowed are 6 numbers: one a joint"),
        ("x", "q: found 1 numbers"),
        ("123456", "a setpoint cannot be sent"),
        (np.array(0.5), "q: found array"),
        ([HOME] * 6, "a setpoint cannot be sent"),
        ([10**400] * 6, "a setpoint cannot be sent"),
    ]
    with robot.open_stream() as stream:
        for q, sentence in wrong:
            with pytest.raises(rtcp.Invalid, match=sentence):
                stream.send(q)
        with pytest.raises(rtcp.Invalid, match="velocity: found 5, allowed are 6 numbers"):
            stream.send(HOME, 5)  # type: ignore[arg-type]
        assert (stream.sent, stream.taken, stream.is_open) == (0, 0, True)
    with pytest.raises(rtcp.Invalid, match="the stream is closed"):
        stream.send(HOME)
    assert (stream.is_open, stream.taken) == (False, 0)
    robot.close()


def test_a_stream_that_follows_another_is_opened_when_the_arm_rests(robot: Robot) -> None:
    with robot.open_stream() as stream:
        for number in range(100):
            stream.send(at(0.4 * number / 100), [0.4, *[0.0] * 5])
            time.sleep(0.01)
    with robot.open_stream() as stream:  # the arm brakes still
        stream.send(robot.status().commanded_positions)
        assert stream.is_open
    robot.close()


def test_a_stream_ends_with_a_halt_of_anyone_and_moves_nothing_after_it(shared: Platform, robot: Robot) -> None:
    with robot.open_stream() as stream:
        stream.send(HOME)
        shared.rtcp("halt")
        with pytest.raises(rtcp.Faulted):
            stream.send(at(0.5))
    assert robot.status().commanded_positions[0] == pytest.approx(0.0, abs=1e-6)
    robot.close()


@pytest.mark.parametrize("how", ["stop", "kill"])
def test_a_stream_of_a_loop_that_has_ended_says_so_and_moves_nothing_of_the_next_platform(
    platform: Platform, how: str
) -> None:
    def begin() -> Robot:
        platform.rtcp("start", "--detach")
        platform.call("enable")
        return rtcp.connect("a program", control_socket(platform.directory))

    def refuses(stream: rtcp.Stream) -> None:
        with pytest.raises(rtcp.Faulted) as ended:
            stream.send([0.5] * 6)
        assert str(ended.value) == f"the loop (process {loop}) has ended: start the platform, then open another stream"

    platform.be_patient(2000)
    with begin() as robot:
        loop = platform.pids()["loop"]
        stream = robot.open_stream()
        stream.send([0.0] * 6)
    if how == "kill":
        kill(loop)
        refuses(stream)
    platform.rtcp("stop", check=None)
    refuses(stream)
    assert not stream.is_open
    with begin() as robot, robot.open_stream() as other:
        for _ in range(20):
            refuses(stream)
            other.send([0.0] * 6)
            time.sleep(0.02)
        stream.close()
        other.send([0.0] * 6)
        assert (stream.sent, other.sent) == (1, 21)
        assert robot.status().commanded_positions == pytest.approx([0.0] * 6, abs=1e-6)


def test_an_open_trajectory_whose_first_point_is_where_the_arm_is_goes_to_its_second(robot: Robot) -> None:
    robot.open_trajectory([{"t": 0.0, "q": HOME}, {"t": 1.0, "q": at(0.1)}])
    time.sleep(0.5)
    robot.append([{"t": 2.0, "q": at(0.2)}])
    assert robot.finish_trajectory().positions[0] == pytest.approx(0.2, abs=1e-3)


def test_points_are_appended_while_the_trajectory_runs(shared: Platform, robot: Robot) -> None:
    feed = rtcp.Feed(shared.directory)
    robot.open_trajectory([{"t": 0.5 * k, "q": at(0.2 * (1 - math.cos(0.5 * k)))} for k in (1, 2)])
    for number in range(3, 10):
        while robot.append([{"t": 0.5 * number, "q": at(0.2 * (1 - math.cos(0.5 * number)))}]).ahead_s > 0.7:
            time.sleep(0.05)
            break
        time.sleep(0.3)
    arrival = robot.finish_trajectory()
    assert arrival.positions[0] == pytest.approx(0.2 * (1 - math.cos(4.5)), abs=1e-3)
    assert largest_step(feed) <= 1.01
    feed.close()
    robot.close()


def test_a_trajectory_that_runs_out_of_points_stops_and_says_so(robot: Robot) -> None:
    robot.open_trajectory([{"t": 0.4, "q": at(0.05)}, {"t": 0.8, "q": at(0.1)}])
    while robot.status().state is State.MOVING:
        time.sleep(0.05)
    with pytest.raises(rtcp.Faulted) as ended:
        robot.append([{"t": 2.0, "q": at(0.2)}])
    assert ended.value.reason == "out_of_points"
    assert robot.status().positions[0] == pytest.approx(0.1, abs=1e-3)
    with pytest.raises(rtcp.Refused) as refused:
        robot.append([{"t": 3.0, "q": at(0.2)}])
    assert refused.value.reason == "not_open"
    robot.close()


def test_more_points_than_fit_are_refused_and_the_trajectory_goes_on(robot: Robot) -> None:
    robot.open_trajectory([{"t": 1.0, "q": at(0.05)}, {"t": 30.0, "q": at(0.1)}])
    with pytest.raises(rtcp.Refused) as refused:
        robot.append([{"t": 31.0 + k, "q": HOME} for k in range(4096)])
    assert refused.value.reason == "no_room_for_points"
    assert robot.append([{"t": 31.0, "q": at(0.1)}]).room < 4096
    robot.move_joints(HOME)  # ends it, and waits until the arm rests
    robot.close()


def test_an_open_trajectory_whose_finish_is_cancelled_stops_and_gives_its_lease_back(
    shared: Platform, robot: Robot
) -> None:
    async def begin_and_cancel(arm: AsyncRobot) -> None:
        await arm.open_trajectory([{"t": 1.0, "q": at(0.01)}, {"t": 60.0, "q": at(0.5)}])
        finish = asyncio.create_task(arm.finish_trajectory())
        await asyncio.sleep(0.5)
        finish.cancel()
        await asyncio.gather(finish, return_exceptions=True)
        while (await arm.status()).state is not State.HOLDING:
            await asyncio.sleep(0.02)
        robot.move_joints(HOME)  # of another connection, while this one is open

    run(shared, begin_and_cancel)


def test_a_trajectory_outside_its_tolerances_brakes_and_says_by_how_much(robot: Robot) -> None:
    points = [{"t": 0.0, "q": HOME}, {"t": 1.0, "q": at(0.2)}, {"t": 2.0, "q": HOME}]
    with pytest.raises(rtcp.Faulted) as ended:
        robot.run_trajectory(points, path_tolerance=[1e-5, *[0.0] * 5])
    assert ended.value.reason == "path_tolerance_violated"
    assert ended.value.fields["error"] > ended.value.fields["limit"] == 1e-5
    robot.move_joints(HOME)
    robot.run_trajectory(points, goal_tolerance=[0.01] * 6, path_tolerance=[0.5] * 6)
    with pytest.raises(rtcp.Refused, match="must be where it is"):
        robot.run_trajectory([{"t": 0.0, "q": at(0.004)}, *points[1:]])
    robot.run_trajectory([{"t": 0.0, "q": at(0.004)}, *points[1:]], start_tolerance=0.01)
    robot.close()


def test_every_record_wakes_whoever_waits_for_it(shared: Platform, robot: Robot) -> None:
    robot.close()
    feed = rtcp.Feed(shared.directory)
    numbers: list[int] = []
    while len(numbers) < 200:
        assert feed.wait(5.0)
        records, missing = feed.records()
        assert not missing
        numbers += records["number"].tolist()
    assert all(b == a + 1 for a, b in pairwise(numbers))
    assert not feed.wait(0.0)
    feed.close()


def test_limits_and_robot_status_are_typed(robot: Robot) -> None:
    status, limits = robot.status(), robot.joint_limits()
    assert [limit.name for limit in limits] == list(status.joint_names)
    assert limits[0].min < limits[0].max
    assert (status.robot.mode, status.robot.motion_possible, status.robot.in_error) == ("auto", True, False)
    robot.close()


def slow_plan() -> list[dict[str, Any]]:
    """A trajectory that takes the planner a while: three turns of 20 s."""
    w = math.tau / 20.0
    times = [0.05 * k for k in range(1201)]
    return [{"t": t, "q": at(0.2 * (1 - math.cos(w * t))), "v": [0.2 * w * math.sin(w * t), *[0.0] * 5]} for t in times]


def test_a_stop_that_comes_while_a_motion_is_planned_is_the_end_of_it(shared: Platform, robot: Robot) -> None:
    robot.close()

    async def moves(arm: AsyncRobot) -> Any:
        motion = asyncio.create_task(arm.run_trajectory(slow_plan()))
        await asyncio.sleep(0.01)
        await arm.halt()
        with pytest.raises(rtcp.Refused) as refused:
            await motion
        return refused.value.reason

    assert run(shared, moves) == "superseded"
    assert shared.status()["joints"]["commanded_position"] == pytest.approx(HOME, abs=1e-6)


def test_an_older_motion_that_is_planned_longer_does_not_replace_a_newer_one(shared: Platform, robot: Robot) -> None:
    robot.close()

    async def moves(arm: AsyncRobot) -> Any:
        older = asyncio.create_task(arm.run_trajectory(slow_plan(), replace=True))
        await asyncio.sleep(0.01)
        arrival = await arm.move_joints(at(0.1), replace=True)
        with pytest.raises(rtcp.Refused) as refused:
            await older
        return refused.value.reason, arrival.positions[0]

    assert run(shared, moves) == ("superseded", pytest.approx(0.1, abs=1e-3))
