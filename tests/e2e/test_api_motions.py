"""The API as a ROS node or any streaming program uses it: on a real socket between real processes."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import rtcp
from rtcp.api import Arrival, AsyncRobot, Robot, State
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import Platform
from tests.waiting import HANG_S, until

pytestmark = pytest.mark.platform

HOME = [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]


def at(first: float) -> list[float]:
    return [first, *HOME[1:]]


@pytest.fixture
def robot(enabled: Platform) -> Iterator[Robot]:
    with rtcp.connect("a program", control_socket(enabled.directory)) as robot:
        robot.move_joints(HOME)
        yield robot


@pytest.fixture
def other(enabled: Platform) -> Iterator[Robot]:
    with rtcp.connect("another program", control_socket(enabled.directory)) as robot:
        yield robot
        robot.set_speed_override(1.0)


def run(shared: Platform, work: Callable[[AsyncRobot], Coroutine[Any, Any, Any]]) -> Any:
    async def connected() -> Any:
        async with rtcp.connect_async("a program", control_socket(shared.directory)) as made:
            return await work(made)

    return asyncio.run(connected())


async def passes(arm: AsyncRobot, position: float) -> None:
    """Wait until the first joint is beyond a position, rad."""
    while (await arm.positions())[0] < position:
        await asyncio.sleep(0.02)


def largest_acceleration(feed: rtcp.Feed, signal: str = "commanded_position") -> float:
    """Return the largest change of a commanded velocity between answered cycles, as part of acceleration x cycle."""
    records, missing = feed.records()
    assert not missing
    answered = records["wkc"] == records["wkc_expected"]
    assert len(records) > 100
    period_s = feed.period_ns * 1e-9
    change = np.abs(np.diff(np.diff(records[signal], axis=0), axis=0)).max(axis=1) / period_s**2
    # The setpoints stand still in a cycle without an answer.
    whole = answered[:-2] & answered[1:-1] & answered[2:]
    most = min(joint.acceleration for joint in feed.config.joints)
    return float(change[whole].max() / most)


# -- motions ---------------------------------------------------------------------------------------------------------


def test_a_motion_replaces_another_without_a_stop_and_each_ends_with_its_own_outcome(
    shared: Platform, robot: Robot
) -> None:
    robot.close()
    feed = rtcp.Feed(shared.directory)

    async def moves(arm: AsyncRobot) -> Sequence[Any]:
        first = asyncio.create_task(arm.move_joints(at(0.6)))
        await passes(arm, 0.05)
        second = asyncio.create_task(arm.move_joints(at(-0.2), replace=True))
        await asyncio.wait([first])
        points = [{"t": 0.0, "q": at(0.2)}, {"t": 2.0, "q": at(0.15)}, {"t": 3.0, "q": at(0.2)}]
        third = asyncio.create_task(arm.run_trajectory(points, replace=True))
        return await asyncio.gather(first, second, third, return_exceptions=True)

    first, second, third = run(shared, moves)
    assert (type(first), type(second)) == (rtcp.Replaced, rtcp.Replaced)
    assert isinstance(third, Arrival)
    assert third.positions[0] == pytest.approx(0.2, abs=1e-3)
    assert largest_acceleration(feed) <= 1.01
    feed.close()


def slow_plan() -> list[dict[str, Any]]:
    """A trajectory that takes the planner a while: three turns of 20 s."""
    w = math.tau / 20.0
    times = [0.05 * k for k in range(1201)]
    return [{"t": t, "q": at(0.2 * (1 - math.cos(w * t))), "v": [0.2 * w * math.sin(w * t), *[0.0] * 5]} for t in times]


def test_a_stop_and_a_newer_motion_that_come_while_a_motion_is_planned_are_the_end_of_it(
    shared: Platform, robot: Robot
) -> None:
    robot.close()

    async def refused(motion: asyncio.Task[Any]) -> str:
        with pytest.raises(rtcp.Refused) as refused:
            await motion
        return refused.value.reason

    async def stops(arm: AsyncRobot) -> str:
        motion = asyncio.create_task(arm.run_trajectory(slow_plan()))
        await asyncio.sleep(0.01)
        await arm.halt()
        return await refused(motion)

    async def moves(arm: AsyncRobot) -> tuple[str, float]:
        older = asyncio.create_task(arm.run_trajectory(slow_plan(), replace=True))
        await asyncio.sleep(0.01)
        arrival = await arm.move_joints(at(0.1), replace=True)
        return await refused(older), arrival.positions[0]

    assert run(shared, stops) == "superseded"
    assert shared.status()["joints"]["commanded_position"] == pytest.approx(HOME, abs=1e-6)
    assert run(shared, moves) == ("superseded", pytest.approx(0.1, abs=1e-3))


def test_a_trajectory_outside_its_tolerances_brakes_and_says_by_how_much(robot: Robot) -> None:
    points = [{"t": 0.0, "q": HOME}, {"t": 1.0, "q": at(0.1)}, {"t": 2.0, "q": HOME}]
    with pytest.raises(rtcp.Faulted) as ended:
        robot.run_trajectory(points, path_tolerance=[1e-5, *[0.0] * 5])
    assert ended.value.reason == "path_tolerance_violated"
    assert ended.value.fields["error"] > ended.value.fields["limit"] == 1e-5
    robot.move_joints(HOME)
    with pytest.raises(rtcp.Refused, match="must be where it is"):
        robot.run_trajectory([{"t": 0.0, "q": at(0.004)}, *points[1:]])
    robot.run_trajectory(
        [{"t": 0.0, "q": at(0.004)}, *points[1:]],
        goal_tolerance=[0.01] * 6,
        path_tolerance=[0.5] * 6,
        start_tolerance=0.01,
    )


def test_points_are_appended_while_the_trajectory_runs_and_it_stops_where_it_has_no_more(
    shared: Platform, robot: Robot
) -> None:
    feed = rtcp.Feed(shared.directory)
    # The first points take so long that a slow host appends the others in time.
    robot.open_trajectory([{"t": 4.0, "q": at(0.1)}, {"t": 5.0, "q": at(0.15)}])
    robot.append([{"t": 5.5, "q": at(0.2)}])
    robot.append([{"t": 6.0, "q": at(0.25)}, {"t": 7.0, "q": at(0.3)}])
    assert robot.finish_trajectory().positions[0] == pytest.approx(0.3, abs=1e-3)
    assert largest_acceleration(feed) <= 1.01
    feed.close()

    robot.open_trajectory([{"t": 1.0, "q": at(0.31)}, {"t": 30.0, "q": at(0.35)}])
    with pytest.raises(rtcp.Refused) as refused:
        robot.append([{"t": 31.0 + k, "q": HOME} for k in range(4096)])
    assert refused.value.reason == "no_room_for_points"
    robot.move_joints(at(0.3))  # ends it, and waits until the arm rests
    robot.open_trajectory([{"t": 0.4, "q": at(0.35)}, {"t": 0.8, "q": at(0.4)}])
    until(lambda: robot.status().state is State.HOLDING, "rest")
    with pytest.raises(rtcp.Faulted) as ended:
        robot.append([{"t": 2.0, "q": at(0.2)}])
    assert ended.value.reason == "out_of_points"
    assert 0.34 < robot.status().positions[0] < 0.401
    with pytest.raises(rtcp.Refused) as refused:
        robot.append([{"t": 3.0, "q": at(0.2)}])
    assert refused.value.reason == "not_open"


def test_whoever_waits_gets_every_record(shared: Platform) -> None:
    feed = rtcp.Feed(shared.directory)
    numbers: list[int] = []
    while len(numbers) < 200:
        assert feed.wait(HANG_S)
        numbers += feed.records()[0]["number"].tolist()
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    feed.close()


# -- streams ---------------------------------------------------------------------------------------------------------


def test_a_stream_of_setpoints_loses_none_and_is_followed(shared: Platform, robot: Robot) -> None:
    feed, rate_hz = rtcp.Feed(shared.directory), 500
    w = math.tau * 0.5
    with robot.open_stream() as stream:
        began = time.monotonic()
        for number in range(2 * rate_hz):
            t = number / rate_hz
            time.sleep(max(began + t - time.monotonic(), 0.0))
            stream.send(at(0.1 * (1 - math.cos(w * t))), [0.1 * w * math.sin(w * t), *[0.0] * 5], t=t)
        until(lambda: stream.taken == stream.sent, "the last setpoint")
        assert stream.sent == 2 * rate_hz
    assert largest_acceleration(feed) <= 1.01
    feed.close()


def test_a_stream_ends_with_a_setpoint_that_cannot_be_followed_or_a_halt_and_the_next_send_says_why(
    robot: Robot, other: Robot
) -> None:
    def why(stream: rtcp.Stream) -> rtcp.Faulted:
        until(lambda: not stream.is_open, "the end of the stream")
        with pytest.raises(rtcp.Faulted) as ended:
            stream.send(at(0.5))
        return ended.value

    with robot.open_stream() as stream:
        stream.send(HOME)
        stream.send(at(9.0))
        ended = why(stream)
    assert (ended.reason, ended.fields["axis"], ended.fields["value"]) == ("setpoint_out_of_range", 0, 9.0)
    with robot.open_stream() as stream:
        stream.send([math.nan, *HOME[1:]])
        assert "joint1: a number of the stream's setpoint is not finite" in str(why(stream))
    with robot.open_stream() as stream:
        stream.send(HOME)
        other.halt()
        why(stream)
    assert robot.status().commanded_positions == pytest.approx(HOME, abs=1e-6)

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


# -- another client slows and pauses ---------------------------------------------------------------------------------


@contextlib.contextmanager
def under_way(other: Robot, motion: Callable[..., Any], *arguments: Any, **options: Any) -> Iterator[Future[Any]]:
    """Run a motion in a thread, from when the arm moves on; another client halts it where the test fails."""
    with ThreadPoolExecutor(1) as pool:
        going = pool.submit(motion, *arguments, **options)
        try:
            until(lambda: other.state is State.MOVING, "motion")
            yield going
        except BaseException:
            other.halt()
            raise


def circle(robot: Robot) -> Any:
    assert robot.pose is not None
    x, y, z, *rpy = robot.pose
    return robot.move_arc([x, y + 0.05, z - 0.05], [x, y, z - 0.1, *rpy], math.tau, 0.15)


def test_a_line_under_way_slows_down_for_another_client_who_cannot_speed_it_up(
    shared: Platform, robot: Robot, other: Robot
) -> None:
    feed = rtcp.Feed(shared.directory)
    with under_way(other, robot.move_by, [0.0, 0.2, 0.0, 0.0, 0.0, 0.0], speed=0.06) as going:
        until(lambda: abs(other.status().velocities[0]) > 0.05, "full speed")
        other.set_speed_override(0.1)
        with pytest.raises(rtcp.Refused, match="a program"):
            other.set_speed_override(0.2)
        until(lambda: float(np.linalg.norm((other.status().tool_velocity or (1.0,))[:3])) < 0.01, "the lower speed")
        assert other.speed_override == pytest.approx(0.1)
        other.halt()
        with pytest.raises(rtcp.RtcpError):
            going.result()
        # Nobody holds the lease now.
        other.set_speed_override(1.0)
    assert largest_acceleration(feed, "sent_position") <= 1.02
    feed.close()


def test_a_motion_that_another_client_paused_goes_on_when_all_who_paused_it_resume(
    shared: Platform, robot: Robot, other: Robot
) -> None:
    with pytest.raises(rtcp.Refused):
        other.pause()
    with rtcp.connect("third", control_socket(shared.directory)) as third:
        with under_way(other, circle, robot) as going:
            third.pause()
            third.halt()
            with pytest.raises(rtcp.RtcpError):
                going.result()
        robot.move_joints(HOME)
        with under_way(other, circle, robot) as going:
            other.pause()
            shared.pass_cycles(250)
            paused = other.status()
            shared.pass_cycles(100)
            later = other.status()
            assert later.sent_positions == paused.sent_positions
            assert (later.state, later.message) == (State.MOVING, "paused: the motion rests on its path")
            # Who paused a motion that has ended does not resume the next one.
            with pytest.raises(rtcp.Refused, match="who paused the motion") as refused:
                third.resume()
            assert refused.value.reason == "paused_by_another"
            third.pause()
            with pytest.raises(rtcp.Refused, match="another who paused the motion"):
                third.resume()
            assert other.status().sent_positions == paused.sent_positions
            other.resume()
            going.result()
    assert other.status().speed_override == 1.0
    assert robot.positions == pytest.approx(HOME, abs=2e-3)
