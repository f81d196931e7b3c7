"""ROS commands on a fake arm: no ROS, no platform."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rtcp.api import Arrival, AsyncRobot, Progress, RtcpError, State, Status
from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.config.model import MOST_POINTS
from rtcp.ros import commands, held_up
from rtcp.ros.commands import (
    GOAL_RAD,
    START_RAD,
    Commander,
    CommandOptions,
    FollowCode,
    Inbox,
    Tolerance,
    Tolerances,
    Trajectory,
    TrajectoryPoint,
    points_of,
)
from rtcp.ros.group import GroupRobot
from rtcp.ros.processes import ProcessService, services_of
from rtcp.ros.simple_message.arm import Point
from rtcp.ros.simple_message.cell_arm import CellArm
from tests import simulated_time

NAMES = ("a", "b", "c")
HERE = (0.1, 0.2, 0.3)
STATUS = cast(Status, SimpleNamespace(joint_names=NAMES, commanded_positions=HERE, state=State.HOLDING))
PATH = Trajectory(NAMES, [TrajectoryPoint(0.0, HERE), TrajectoryPoint(1.0, (0, 0, 0))])

ARM_HEATER, STOP_HEATING, HEAT_ROD = (
    ProcessService("heater", "arm_heater", False),
    ProcessService("heater", "stop_heating", False, needs_lease=False),
    ProcessService("heater", "heat_rod", True),
)


class FakeStream:
    """Records what is sent; `error` is raised by the next `send`."""

    def __init__(self, arm: FakeArm) -> None:
        self._arm = arm
        self.sent: list[tuple[Any, Any, Any, Any]] = []
        self.error: RtcpError | None = None
        self.is_closed = False

    def send(self, q: Any, velocity: Any = None, acceleration: Any = None, t: Any = None) -> None:
        if self.error is not None:
            raise self.error
        self.sent.append((tuple(q), velocity, acceleration, t))
        self._arm.commanded = tuple(q)

    def close(self) -> None:
        self.is_closed = True


class FakeArm:
    """A robot that moves until the next motion, a halt or `end`; `refusal` is raised by every command."""

    def __init__(self) -> None:
        self.state = State.HOLDING
        self.commanded = HERE
        self.calls: list[Any] = []
        self.refusal: RtcpError | None = None
        self.refuse_runs: RtcpError | None = None
        self.connections = self.closed = 0
        self.is_open = True
        self.streams: list[FakeStream] = []
        self.appended: list[dict[str, Any]] = []
        self.ran_out = False
        self._motion: asyncio.Future[Arrival] | None = None

    @contextlib.asynccontextmanager
    async def connect(self) -> AsyncIterator[FakeArm]:
        self.connections += 1
        self.is_open = True
        yield self
        self.closed += 1

    async def status(self) -> Status:
        self._check()
        raw = {"processes": {"heater": {"state": "armed"}, "fan": {"state": None}}}
        status = SimpleNamespace(joint_names=NAMES, commanded_positions=self.commanded, state=self.state, raw=raw)
        return cast(Status, status)

    async def set_speed_override(self, fraction: float) -> None:
        self.calls.append(("speed_override", fraction))

    async def set_limits(self, changes: Mapping[str, float]) -> None:
        self._check()
        self.calls.append(("set_limits", dict(changes)))

    async def set_output(self, output: str, value: float) -> None:
        self._check()
        self.calls.append((output, value))

    async def command(self, name: str, **fields: Any) -> None:
        self._check()
        self.calls.append((name, fields))

    async def enable(self) -> None:
        self.calls.append("enable")
        self.state = State.HOLDING

    async def disable(self) -> None:
        self.calls.append("disable")
        self.state = State.READY

    async def reset(self) -> State:
        self.calls.append("reset")
        left, self.state = self.state, State.READY
        return left

    async def halt(self) -> None:
        self.calls.append("halt")
        self.end(RtcpError("fault", "the motion was stopped"))

    async def run_trajectory(
        self, points: Sequence[dict[str, Any]], progress: Callable[[Progress], None], replace: bool, **given: Any
    ) -> Arrival:
        assert replace
        progress(Progress(0.5, 1.0))  # of the replaced motion
        self._check()
        if self.refuse_runs is not None:
            await asyncio.sleep(0.01)
            raise self.refuse_runs
        self.end(RtcpError("replaced", "the motion was replaced"))
        self.calls.append(("run", [point["q"] for point in points], given))
        self._motion = asyncio.get_running_loop().create_future()
        progress(Progress(0.0, 1.0, accepted=True))
        try:
            return await self._motion
        except asyncio.CancelledError:
            self.calls.append("brake")
            raise

    async def open_stream(self) -> FakeStream:
        self._check()
        self.streams.append(FakeStream(self))
        return self.streams[-1]

    async def open_trajectory(self, points: Sequence[dict[str, Any]], replace: bool) -> None:
        self._check()
        self.calls.append("open")
        self.appended += points

    async def append(self, points: Sequence[dict[str, Any]]) -> None:
        if self.ran_out:
            self.ran_out = False
            raise RtcpError("fault", "no points", "out_of_points")
        self.appended += points

    def _check(self) -> None:
        if self.refusal is not None:
            raise self.refusal

    def end(self, error: RtcpError | None = None) -> None:
        if self._motion is not None and not self._motion.done():
            if error is None:
                self._motion.set_result(Arrival(HERE, 0.001))
            else:
                self._motion.set_exception(error)


@pytest.fixture
def arm() -> FakeArm:
    return FakeArm()


def carry_out(arm: FakeArm, test: Callable[[Commander], Coroutine[Any, Any, None]], **options: Any) -> list[str]:
    """Run a coroutine with a commander; return what was logged."""
    logged: list[str] = []

    async def run() -> None:
        commander = Commander(cast(Any, arm.connect), CommandOptions(**options), logged.append)
        await test(commander)
        await asyncio.sleep(0)

    simulated_time.run(run())
    return logged


def reason_of(trajectory: Trajectory, allows_partial: bool = False) -> str:
    with pytest.raises(RtcpError) as refused:
        points_of(trajectory, STATUS, allows_partial)
    assert refused.value.kind == "refused"
    return refused.value.reason


async def refusal_of(command: Awaitable[object]) -> str:
    """Return the reason for which a command is refused."""
    with pytest.raises(RtcpError) as refused:
        await command
    return refused.value.reason


# -- points ---------------------------------------------------------------------------------------------------------


def test_joints_in_any_order_are_put_into_the_robots() -> None:
    given = Trajectory(("c", "a", "b"), [TrajectoryPoint(0.5, (3, 1, 2), (6, 4, 5), (9, 7, 8))])
    assert points_of(given, STATUS) == [{"t": 0.5, "q": [1, 2, 3], "v": [4, 5, 6], "a": [7, 8, 9]}]


def test_velocities_count_only_where_every_point_has_them() -> None:
    given = Trajectory(NAMES, [TrajectoryPoint(0.0, (0, 0, 0), (1, 1, 1)), TrajectoryPoint(1.0, (1, 1, 1))])
    assert [sorted(point) for point in points_of(given, STATUS)] == [["q", "t"], ["q", "t"]]


@pytest.mark.parametrize(
    ("names", "positions", "reason"),
    [
        (("a", "b", "z"), (0, 0, 0), "unknown_joint"),
        (("a", "b", "c", "z"), (0, 0, 0, 0), "unknown_joint"),
        (("a", "b", "b"), (0, 0, 0), "unknown_joint"),
        (("a", "b"), (0, 0), "missing_joint"),
        ((), (0, 0, 0), "missing_joint"),
        (NAMES, (0, 0), "wrong_count"),
        (NAMES, (0, 0, 0, 0), "wrong_count"),
    ],
)
def test_joints_that_do_not_match_are_refused(names: Sequence[str], positions: Sequence[float], reason: str) -> None:
    assert reason_of(Trajectory(names, [TrajectoryPoint(0.0, positions)])) == reason


def test_more_points_than_the_robot_has_room_for_are_refused() -> None:
    assert reason_of(Trajectory(NAMES, [TrajectoryPoint(0.0, HERE)] * (MOST_POINTS + 1))) == "too_many_points"


@pytest.mark.parametrize(
    ("count", "most", "kept"),
    [(5, 0, [0, 1, 2, 3, 4]), (5, 5, [0, 1, 2, 3, 4]), (5, 3, [0, 2, 4]), (9, 4, [0, 3, 5, 8]), (5000, 2, [0, 4999])],
)
def test_a_longer_trajectory_is_reduced_to_the_points_asked_for_with_both_its_ends(
    arm: FakeArm, count: int, most: int, kept: list[int]
) -> None:
    path = Trajectory(NAMES, [TrajectoryPoint(float(k), (float(k), 0.0, 0.0)) for k in range(count)])

    async def begin(commander: Commander) -> None:
        await commander.begin_trajectory(path)

    carry_out(arm, begin, most_points=most)
    assert [q[0] for q in arm.calls[0][1]] == kept


def test_of_a_flood_only_so_many_messages_wait_and_the_other_topics_go_on() -> None:
    carried_out: list[str] = []
    logged: list[str] = []
    may_go_on = asyncio.Event()

    async def waits() -> None:
        await may_go_on.wait()
        carried_out.append("flood")

    async def acts() -> None:
        carried_out.append("other")
        raise RtcpError("refused", "not now")

    async def test() -> None:
        inbox = Inbox(asyncio.get_running_loop(), logged.append)
        for _ in range(5000):
            inbox.put("flood", waits())
        inbox.put("other", acts())
        while not carried_out:
            await asyncio.sleep(0)
        assert carried_out == ["other"]
        assert logged == ["flood: 100 messages wait, further ones are dropped", "other: not now"]
        may_go_on.set()
        while len(carried_out) < 101:
            await asyncio.sleep(0)
        inbox.put("flood", waits())
        while len(carried_out) < 102:
            await asyncio.sleep(0)

    asyncio.run(test())
    assert len(logged) == 2


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"positions": (0.0, math.nan, 0.0)}, "point 2: positions of b has nan, a finite number is needed"),
        ({"velocities": (0.0, 0.0, math.inf)}, "point 2: velocities of c has inf, a finite number is needed"),
        ({"accelerations": (-math.inf, 0.0, 0.0)}, "point 2: accelerations of a has -inf, a finite number is needed"),
    ],
)
def test_a_number_that_is_not_finite_is_refused_by_its_point_and_joint(fields: dict[str, Any], said: str) -> None:
    zeros = (0.0, 0.0, 0.0)
    first = TrajectoryPoint(0.0, zeros, zeros, zeros)
    with pytest.raises(RtcpError) as refused:
        points_of(Trajectory(("a", "b", "c"), [first, replace(first, time_s=1.0, **fields)]), STATUS)
    assert (refused.value.reason, refused.value.message) == ("not_finite", said)


def test_joints_that_are_not_named_hold_where_that_is_allowed() -> None:
    given = Trajectory(("b",), [TrajectoryPoint(1.0, (9,), (1,))])
    assert points_of(given, STATUS, allows_partial=True) == [{"t": 1.0, "q": [0.1, 9, 0.3], "v": [0, 1, 0]}]
    assert reason_of(Trajectory((), [TrajectoryPoint(1.0, ())]), allows_partial=True) == "missing_joint"


# -- trajectories ---------------------------------------------------------------------------------------------------


def test_a_trajectory_is_begun_and_its_end_is_not_waited_for(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(PATH)
        assert commander.is_moving
        arm.end()
        await asyncio.sleep(0.01)
        assert not commander.is_moving

    assert carry_out(arm, test) == []
    assert arm.calls == [("run", [list(HERE), [0, 0, 0]], {"start_tolerance": START_RAD})]


def test_a_new_trajectory_replaces_the_one_under_way(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(PATH)
        await commander.begin_trajectory(PATH)
        arm.end()
        await asyncio.sleep(0.01)

    assert carry_out(arm, test) == []
    assert len(arm.calls) == 2


def test_a_trajectory_that_ends_before_its_end_is_logged(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(PATH)
        await commander.stop()
        await asyncio.sleep(0.01)

    assert carry_out(arm, test) == ["the motion was stopped"]


def test_a_trajectory_that_is_refused_in_place_of_another_is_refused_to_its_caller(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(PATH)
        points = [TrajectoryPoint(0.0, HERE), TrajectoryPoint(1.0, (9, 9, 9))]
        arm.refuse_runs = RtcpError("refused", "out of range")
        with pytest.raises(RtcpError, match="out of range"):
            await commander.begin_trajectory(Trajectory(NAMES, points))
        arm.end()
        await asyncio.sleep(0.01)

    assert carry_out(arm, test) == []


def test_a_refusal_reaches_the_caller(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        arm.refusal = RtcpError("refused", "the arm is commanded by another", "lease_held")
        with pytest.raises(RtcpError, match="commanded by another"):
            await commander.begin_trajectory(PATH)
        assert not commander.is_moving

    assert carry_out(arm, test) == []


def test_an_empty_trajectory_stops_the_motion(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(PATH)
        await commander.begin_trajectory(Trajectory(NAMES, []))

    carry_out(arm, test)
    assert arm.calls[-1] == "halt"


def test_a_trajectory_begins_at_its_stamp(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        begin = time.time() + 0.2
        await commander.begin_trajectory(Trajectory(NAMES, PATH.points, begin))
        assert time.time() == pytest.approx(begin, abs=0.03)
        arm.end()

    carry_out(arm, test)


@pytest.mark.parametrize("by", ["stop", "robot_disable", "a fault", "a trajectory", "a joint_command", "its platform"])
def test_a_trajectory_that_waits_for_its_stamp_gives_way_to_what_comes_after_it(arm: FakeArm, by: str) -> None:
    async def test(commander: Commander) -> None:
        waiting = asyncio.create_task(commander.begin_trajectory(Trajectory(NAMES, PATH.points, time.time() + 0.3)))
        await asyncio.sleep(0.1)
        if by == "stop":
            await commander.stop()
        elif by == "robot_disable":
            await commander.disable()
        elif by == "a fault":
            commander.note_stop()
        elif by == "a trajectory":
            await commander.begin_trajectory(PATH)
        elif by == "a joint_command":
            await commander.command_point(point(1.0))
        else:
            arm.is_open = False
        assert await refusal_of(waiting) == "superseded"
        arm.end()

    carry_out(arm, test)
    assert sum(call[0] == "run" for call in arm.calls) == (by == "a trajectory")


def test_a_stop_that_comes_while_a_trajectory_waits_for_the_drives_is_the_end_of_it(
    arm: FakeArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm.state = State.READY
    is_enabling, may_go_on = asyncio.Event(), asyncio.Event()

    async def enable() -> None:
        is_enabling.set()
        await may_go_on.wait()
        arm.state = State.HOLDING

    monkeypatch.setattr(arm, "enable", enable)

    async def test(commander: Commander) -> None:
        beginning = asyncio.create_task(commander.begin_trajectory(PATH))
        await is_enabling.wait()
        stopping = asyncio.create_task(commander.stop())
        await asyncio.sleep(0.01)
        may_go_on.set()
        assert await refusal_of(beginning) == "superseded"
        await stopping

    carry_out(arm, test, enables=True)
    assert "run" not in [call[0] for call in arm.calls]


def test_a_trajectory_that_is_refused_enables_nothing(arm: FakeArm) -> None:
    arm.state = State.READY

    async def test(commander: Commander) -> None:
        for refused in (Trajectory(("a", "b", "z"), PATH.points), Trajectory(NAMES, PATH.points, time.time() - 2.0)):
            with pytest.raises(RtcpError):
                await commander.begin_trajectory(refused)
        code, text = await commander.follow(Trajectory(NAMES, ()), Tolerances(), lambda: None)
        assert (code, text) == (FollowCode.INVALID_GOAL, "the trajectory has no points")

    carry_out(arm, test, enables=True)
    assert arm.calls == []


def test_points_that_wait_in_a_buffered_stream_open_no_trajectory_after_a_stop(
    arm: FakeArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_go_on = asyncio.Event()
    opened = arm.open_trajectory

    async def open_trajectory(points: Sequence[dict[str, Any]], replace: bool) -> None:
        await may_go_on.wait()
        await opened(points, replace)

    monkeypatch.setattr(arm, "open_trajectory", open_trajectory)

    async def test(commander: Commander) -> None:
        sent = [asyncio.create_task(commander.command_point(point(number, 0.1 * number))) for number in (1, 2, 3)]
        await asyncio.sleep(0.05)
        stopping = asyncio.create_task(commander.stop())
        await asyncio.sleep(0.01)
        may_go_on.set()
        await asyncio.gather(*sent, stopping)

    carry_out(arm, test, buffer_s=0.5)
    assert arm.calls.count("open") == 1
    assert len(arm.appended) == 1


def test_a_new_target_is_never_followed_by_the_old_one(arm: FakeArm, monkeypatch: pytest.MonkeyPatch) -> None:
    status = arm.status

    async def test(commander: Commander) -> None:
        await commander.command_point(point(1.0))
        has_come = False

        async def slow_status() -> Status:
            nonlocal has_come
            if not has_come:
                has_come = True
                await commander.command_point(point(2.0))  # while the node checks whether the arm has arrived
            arm.commanded = HERE
            return await status()

        monkeypatch.setattr(arm, "status", slow_status)
        while not has_come:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.3)

    carry_out(arm, test)
    targets = [sent[0][0] for stream in arm.streams for sent in stream.sent]
    assert targets == sorted(targets)
    assert targets[-1] == 2.0


def test_joints_that_are_not_named_hold_at_the_newest_target_and_not_where_the_stream_began(arm: FakeArm) -> None:
    def one(name: str, q: float) -> Trajectory:
        return Trajectory((name,), (TrajectoryPoint(0.0, (q,)),))

    async def test(commander: Commander) -> None:
        await commander.command_joints(one("a", 0.5))
        await commander.command_joints(one("b", 0.7))
        arm.state = State.MOVING
        two = Trajectory(("a",), (TrajectoryPoint(1.0, (0.1,)), TrajectoryPoint(2.0, (0.2,))))
        assert await refusal_of(commander.begin_trajectory(two)) == "moving"

    carry_out(arm, test, allows_partial=True)
    assert arm.streams[0].sent[1][0][:2] == (0.5, 0.7)


@pytest.mark.parametrize(("ahead_s", "reason"), [(3600.0, "far_stamp"), (-10.0, "old_stamp")])
def test_a_trajectory_whose_stamp_is_far_ahead_or_that_was_over_before_it_came_is_refused(
    arm: FakeArm, ahead_s: float, reason: str
) -> None:
    async def test(commander: Commander) -> None:
        late = Trajectory(NAMES, PATH.points, time.time() + ahead_s)
        assert await refusal_of(commander.begin_trajectory(late)) == reason

    carry_out(arm, test)
    assert arm.calls == []


def test_after_the_end_of_the_platform_the_next_command_connects_anew(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.stop()
        arm.is_open = False
        await commander.stop()

    carry_out(arm, test)
    assert (arm.connections, arm.closed) == (2, 1)
    assert arm.calls == ["halt", "halt"]


# -- the action -----------------------------------------------------------------------------------------------------


async def begun(commander: Commander, tolerances: Tolerances | None = None) -> asyncio.Task[tuple[FollowCode, str]]:
    """Return a goal whose motion is under way."""
    following = asyncio.create_task(commander.follow(PATH, tolerances or Tolerances(), lambda: None))
    await asyncio.sleep(0.01)
    return following


def test_a_goal_is_accepted_once_and_ends_with_its_code(arm: FakeArm) -> None:
    accepted: list[bool] = []

    async def test(commander: Commander) -> None:
        following = asyncio.create_task(commander.follow(PATH, Tolerances(), lambda: accepted.append(True)))
        await asyncio.sleep(0.01)
        arm.end()
        assert (await following)[0] is FollowCode.SUCCESSFUL

    carry_out(arm, test)
    assert accepted == [True]


def test_the_tolerances_of_a_goal_reach_the_arm(arm: FakeArm) -> None:
    path, goal = [Tolerance("b", 0.1), Tolerance("c", -1)], [Tolerance("b", -1), Tolerance("c", 0.02)]

    async def test(commander: Commander) -> None:
        following = await begun(commander, Tolerances(path, goal, 0.5))
        arm.end()
        await following

    carry_out(arm, test)
    assert arm.calls[0][2] == {
        "start_tolerance": START_RAD,
        "path_tolerance": [0.0, 0.1, 0.0],  # 0: none
        "goal_tolerance": [GOAL_RAD, 0.0, 0.02],
        "goal_time_s": 0.5,
    }


@pytest.mark.parametrize(
    ("tolerance", "code", "words"),
    [
        (Tolerance("z", 0.1), FollowCode.INVALID_JOINTS, "joint 'z'"),
        (Tolerance("a", 0.1, velocity=0.1), FollowCode.INVALID_GOAL, "only positions are supervised"),
    ],
)
def test_a_tolerance_that_cannot_be_honoured_refuses_the_goal(
    arm: FakeArm, tolerance: Tolerance, code: FollowCode, words: str
) -> None:
    async def test(commander: Commander) -> None:
        ended, text = await commander.follow(PATH, Tolerances([tolerance]), lambda: None)
        assert ended is code
        assert words in text

    carry_out(arm, test)
    assert arm.calls == []


@pytest.mark.parametrize(
    ("reason", "code"),
    [
        ("path_tolerance_violated", FollowCode.PATH_TOLERANCE_VIOLATED),
        ("goal_tolerance_violated", FollowCode.GOAL_TOLERANCE_VIOLATED),
        ("not_settled", FollowCode.GOAL_TOLERANCE_VIOLATED),
    ],
)
def test_a_violated_tolerance_has_its_code_and_says_why(arm: FakeArm, reason: str, code: FollowCode) -> None:
    async def test(commander: Commander) -> None:
        following = await begun(commander)
        arm.end(RtcpError("fault", "joint a was 0.2 rad beside the path", reason))
        assert await following == (code, "joint a was 0.2 rad beside the path")

    carry_out(arm, test)


def test_a_goal_that_is_refused_is_invalid_and_one_that_is_stopped_raises(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        unknown = Trajectory(("a", "b", "z"), PATH.points)
        assert (await commander.follow(unknown, Tolerances(), lambda: None))[0] is FollowCode.INVALID_JOINTS
        arm.refusal = RtcpError("refused", "too fast")
        assert await commander.follow(PATH, Tolerances(), lambda: None) == (FollowCode.INVALID_GOAL, "too fast")
        arm.refusal = None
        following = await begun(commander)
        await commander.stop()
        with pytest.raises(RtcpError, match="was stopped"):
            await following

    carry_out(arm, test)


def test_a_goal_that_is_cancelled_brakes(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        following = await begun(commander)
        following.cancel()
        with pytest.raises(asyncio.CancelledError):
            await following

    carry_out(arm, test)
    assert arm.calls[-1] == "brake"


# -- points one by one ----------------------------------------------------------------------------------------------


def point(first: float, time_s: float = 0.0, speed: float | None = None) -> TrajectoryPoint:
    return TrajectoryPoint(time_s, (first, 0, 0), () if speed is None else (speed, 0, 0))


def test_joint_commands_are_setpoints_of_one_stream_with_their_senders_times(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        for number in (1, 2, 3):
            await commander.command_point(point(number, number * 0.004, 0.5))
        assert commander.is_moving

    assert carry_out(arm, test) == []
    (stream,) = arm.streams
    assert [sent[0][0] for sent in stream.sent] == [1, 2, 3]
    # The rate is not known with the first one.
    assert [sent[1] for sent in stream.sent] == [None, (0.5, 0, 0), (0.5, 0, 0)]
    stamps = [sent[3] for sent in stream.sent]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([0.004, 0.004])


def test_a_slow_joint_command_is_sent_again_until_the_arm_is_there_and_then_its_stream_ends(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.command_point(point(1.0, 0.0, 0.5))
        (stream,) = arm.streams
        while len(stream.sent) < 3:
            arm.commanded = HERE
            await asyncio.sleep(0.01)
        arm.commanded = (1.0, 0.0, 0.0)
        while commander.is_moving:
            await asyncio.sleep(0.01)
        assert stream.is_closed

    assert carry_out(arm, test) == []
    first, *again = arm.streams[0].sent
    assert first[:2] == ((1.0, 0, 0), None)
    # At the time of the repetition: the sender's next point anchors its clock anew.
    assert {(*sent[:2], sent[3]) for sent in again} == {((1.0, 0, 0), (0.0, 0.0, 0.0), None)}


def test_a_joint_command_from_the_past_is_dropped(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.command_point(point(1.0, 2.0))
        assert await refusal_of(commander.command_point(point(2.0, 1.5))) == "point_in_the_past"
        await commander.command_point(point(2.0, 1.6))  # said once
        await commander.command_point(point(3.0, 2.5))

    carry_out(arm, test)
    assert [sent[0][0] for sent in arm.streams[0].sent] == [1.0, 3.0]


def test_a_second_publisher_of_joint_commands_is_refused_by_name_until_the_first_pauses(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.command_point(point(1.0), "/left")
        with pytest.raises(RtcpError, match=r"^the arm follows /left: points of /right are refused"):
            await commander.command_point(point(2.0), "/right")
        await commander.command_point(point(2.0), "/right")  # said once
        await commander.command_point(point(3.0), "/left")
        assert [sent[0][0] for sent in arm.streams[0].sent] == [1.0, 3.0]
        await asyncio.sleep(1.1)
        await commander.command_point(point(4.0), "/right")
        assert arm.streams[-1].sent[-1][0][0] == 4.0

    carry_out(arm, test)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (TrajectoryPoint(0.0, (math.nan, 0, 0)), "not_finite"),
        (TrajectoryPoint(0.0, HERE, (math.inf, 0, 0)), "not_finite"),
        (TrajectoryPoint(0.0, ()), "wrong_count"),
        (TrajectoryPoint(0.0, (0.0,) * 13), "wrong_count"),
    ],
)
def test_a_joint_command_that_no_arm_could_follow_opens_no_stream(
    arm: FakeArm, given: TrajectoryPoint, reason: str
) -> None:
    async def test(commander: Commander) -> None:
        assert await refusal_of(commander.command_point(given)) == reason
        assert not commander.is_moving

    carry_out(arm, test)
    assert arm.streams == []


@pytest.mark.parametrize("by", ["stop", "robot_disable", "a trajectory", "the platform"])
def test_a_stream_that_was_ended_stays_ended_until_its_sender_pauses(
    arm: FakeArm, by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    clock = SimpleNamespace(monotonic=lambda: now, time=time.time)

    async def test(commander: Commander) -> None:
        nonlocal now
        monkeypatch.setattr(commands, "time", clock)
        monkeypatch.setattr(held_up, "HELD_UP_S", math.inf)
        await commander.command_point(point(1.0))
        if by == "stop":
            await commander.stop()
        elif by == "robot_disable":
            await commander.disable()
        elif by == "a trajectory":
            await commander.begin_trajectory(PATH)
            arm.end()
        else:
            arm.streams[0].error = RtcpError("fault", "the stream has ended: out of range")
            with pytest.raises(RtcpError, match="out of range"):
                await commander.command_point(point(2.0))
        arm.state = State.HOLDING
        for _ in range(4):
            now += 0.5
            await commander.command_point(point(3.0))
        assert (len(arm.streams), arm.streams[0].is_closed) == (1, True)
        now += 1.5
        await commander.command_point(point(4.0))
        assert len(arm.streams) == 2

    assert carry_out(arm, test) == []


def test_what_waited_while_the_node_did_not_run_moves_nothing(arm: FakeArm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_up, "HELD_UP_S", 0.3)

    async def test(commander: Commander) -> None:
        await commander.command_point(point(1.0))
        time.sleep(0.4)  # the whole process is stopped
        await commander.command_point(point(2.0))
        for command in (
            commander.begin_trajectory(PATH), commander.enable(), commander.set_outputs([("io", "3", 1)]),
            commander.command_process(ARM_HEATER),
        ):  # fmt: skip
            assert await refusal_of(command) == "held_up"
        assert await commander.command_process(STOP_HEATING)
        for _ in range(7):  # a sender that goes on
            await asyncio.sleep(0.1)
            await commander.command_point(point(3.0))
        assert len(arm.streams) == 1
        await commander.begin_trajectory(PATH)
        arm.end()

    (line,) = carry_out(arm, test)
    assert "did not run" in line
    assert {sent[0][0] for sent in arm.streams[0].sent} == {1.0}


@pytest.mark.parametrize("by", ["the next setpoint", "the repeated setpoint"])
def test_a_stream_that_ran_out_while_its_node_was_held_up_is_opened_again(arm: FakeArm, by: str) -> None:
    async def test(commander: Commander) -> None:
        await commander.command_point(point(1.0))
        arm.streams[0].error = RtcpError("fault", "the stream has ended", "stream_ended")
        arm.commanded = HERE
        if by == "the next setpoint":
            await commander.command_point(point(2.0))
        while len(arm.streams) < 2 or len(arm.streams[1].sent) < 3:  # and its points are sent
            arm.commanded = HERE
            await asyncio.sleep(0.01)

    (line,) = carry_out(arm, test)
    assert "opened again" in line
    assert arm.streams[0].is_closed
    assert {sent[0][0] for sent in arm.streams[1].sent} == {2.0 if by == "the next setpoint" else 1.0}


def test_a_joint_command_takes_the_place_of_a_trajectory(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(PATH)
        await commander.command_point(point(1.0))

    carry_out(arm, test)
    assert arm.calls[-1] == "halt"
    assert [sent[0][0] for sent in arm.streams[0].sent] == [1.0]


def test_buffered_joint_commands_are_points_of_an_open_trajectory_that_much_later(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        for number in (1, 2, 3):
            await commander.command_point(point(number, float(number)))
        arm.ran_out = True
        await commander.command_point(point(9, 9.0))

    assert carry_out(arm, test, buffer_s=2.0) == []
    assert [appended["t"] for appended in arm.appended] == pytest.approx([2.0, 3.0, 4.0, 2.0])
    assert [appended["q"][0] for appended in arm.appended] == [1, 2, 3, 9]
    assert arm.calls == ["open", "open"]


def test_a_joint_trajectory_of_one_point_is_a_joint_command_and_a_longer_one_is_executed(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        for number in (1, 2):
            given = Trajectory(NAMES[::-1], [TrajectoryPoint(0.03, (3, 2, number), (6, 5, 4))], 50.0 + number / 100)
            await commander.command_joints(given)
        await commander.command_joints(PATH)
        arm.end()

    carry_out(arm, test)
    assert [sent[:2] for sent in arm.streams[0].sent] == [((1, 2, 3), None), ((2, 2, 3), [4, 5, 6])]
    assert arm.streams[0].sent[1][3] - arm.streams[0].sent[0][3] == pytest.approx(0.01)
    assert arm.calls[-1][0] == "run"


# -- drives ---------------------------------------------------------------------------------------------------------


def test_a_motion_enables_the_drives_only_where_that_is_asked_for(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        arm.state = State.READY
        await commander.begin_trajectory(PATH)
        arm.end()

    carry_out(arm, test)
    assert arm.calls[0] != "enable"
    arm.calls.clear()
    carry_out(arm, test, enables=True)
    assert arm.calls[0] == "enable"


@pytest.mark.parametrize("stop", ["emergency stop", "robot_disable"])
def test_after_a_stop_only_robot_enable_enables(arm: FakeArm, stop: str) -> None:
    async def test(commander: Commander) -> None:
        if stop == "robot_disable":
            await commander.disable()
        else:
            commander.note_stop()
        arm.state = State.READY
        assert await refusal_of(commander.begin_trajectory(PATH)) == "needs_enable"
        await commander.enable()
        arm.state = State.READY
        await commander.begin_trajectory(PATH)
        arm.end()

    carry_out(arm, test, enables=True)
    assert [call for call in arm.calls if isinstance(call, str)][-2:] == ["enable", "enable"]


@pytest.mark.parametrize(
    ("state", "calls"),
    [
        (State.READY, ["enable"]),
        (State.HOLDING, []),
        (State.FAULT, ["reset", "enable"]),
        (State.EMERGENCY_STOP, ["reset", "enable"]),
        (State.STOPPED_BY_LIMIT, ["reset"]),
    ],
)
def test_robot_enable_leaves_a_fault_first(arm: FakeArm, state: State, calls: list[str]) -> None:
    async def test(commander: Commander) -> None:
        arm.state = state
        await commander.enable()

    carry_out(arm, test)
    assert arm.calls == calls


# -- outputs --------------------------------------------------------------------------------------------------------


def test_outputs_are_set_in_their_order_up_to_the_first_that_is_refused(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.set_outputs([("valves", "current", 12.5), ("valves", "open", 1)])
        arm.refusal = RtcpError("refused", "beyond its range", "channel_out_of_range")
        with pytest.raises(RtcpError, match="beyond its range"):
            await commander.set_outputs([("valves", "current", 99.0), ("io", "blower", 1.0)])

    carry_out(arm, test)
    assert arm.calls == [("valves.current", 12.5), ("valves.open", 1.0)]


# -- processes ------------------------------------------------------------------------------------------------------


def test_a_process_gets_its_command_with_the_fields_of_the_text_and_its_state_is_the_answer(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        assert await commander.command_process(ARM_HEATER) == "heater is armed"
        assert await commander.command_process(HEAT_ROD, "straight_and_unloaded=true  phase=austenite") == (
            "heater is armed"
        )
        assert await commander.command_process(ProcessService("fan", "run_fan", True), "kelvin=3.5 'of=a b'") == "done"

    carry_out(arm, test)
    assert arm.calls == [
        ("arm_heater", {}),
        ("heat_rod", {"straight_and_unloaded": True, "phase": "austenite"}),
        ("run_fan", {"kelvin": 3.5, "of": "a b"}),
    ]


@pytest.mark.parametrize("text", ["now", "=1", "phase='a"])
def test_a_text_that_has_no_fields_is_refused(arm: FakeArm, text: str) -> None:
    async def test(commander: Commander) -> None:
        assert await refusal_of(commander.command_process(HEAT_ROD, text)) == "no_field"

    carry_out(arm, test)
    assert arm.calls == []


def test_each_command_of_each_process_is_a_service() -> None:
    services = {service.name: service for service in services_of(load(default_config().parent / "heater.yaml"))}
    assert len(services) == 8
    assert services["heater/arm_heater"] == ARM_HEATER
    assert services["heater/stop_heating"] == STOP_HEATING
    assert services["heater/heat_rod"] == HEAT_ROD
    in_a_cell = [replace(HEAT_ROD, member=member).name for member in ("heater", "cell-2")]
    assert in_a_cell == ["heater/heat_rod", "cell_2_heater/heat_rod"]


# -- the arms of a cell as one robot ----------------------------------------------------------------------------------


class Member(AsyncRobot):
    """Connection to a platform of a cell: counts the halts, stands after one, and refuses all motions."""

    is_open = True

    def __init__(self, state: State, joints: int) -> None:
        self._shown = SimpleNamespace(state=state, commanded_positions=(0.0,) * joints)
        self.halts = 0

    async def _carry_out(self, call: Any) -> Any:
        if call.method == "halt":
            self.halts += 1
            self._shown.state = State.HOLDING
            return None
        if call.method == "status":
            return self._shown
        raise RtcpError("refused", f"no {call.method} here")


def test_a_motion_that_replaces_another_leaves_the_processes_of_the_cell_alone(tmp_path: Path) -> None:
    async def replaced(begin: Callable[[CellArm], Awaitable[object]]) -> None:
        arms, heater = {"left": Member(State.MOVING, 6), "right": Member(State.MOVING, 6)}, Member(State.HOLDING, 0)
        group, cell = GroupRobot("test", tmp_path), CellArm(tmp_path)
        group._arms, group._others = cast(Any, arms), cast(Any, {"heater": heater})
        group._processes, group._counts = {"heater": tmp_path}, {"left": 6, "right": 6}
        group._names = tuple(f"{arm}_j{i}" for arm in arms for i in range(6))
        cell._robot = group
        with pytest.raises(RtcpError, match="here"):
            await begin(cell)
        assert [arm.halts for arm in arms.values()] == [1, 1]
        assert heater.halts == 0
        await cell.halt()
        assert heater.halts == 1

    goal = (0.1,) * 12
    for begin in (
        lambda cell: cell.move_joints(goal),
        lambda cell: cell.open_trajectory([Point(1.0, goal)]),
        lambda cell: cell.run_trajectory([Point(1.0, goal)]),
    ):
        asyncio.run(replaced(begin))
