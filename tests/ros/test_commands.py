"""What becomes of a ROS command, on an arm of the test's own: no ROS, no platform."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rtcp.api import Arrival, Progress, RtcpError, State, Status
from rtcp.config.model import MOST_POINTS
from rtcp.ros.commands import (
    NO_TOLERANCES,
    Commander,
    CommandOptions,
    FollowCode,
    Tolerance,
    Tolerances,
    Trajectory,
    TrajectoryPoint,
    points_of,
)

NAMES = ("a", "b", "c")
HERE = (0.1, 0.2, 0.3)
STATUS = cast(Status, SimpleNamespace(joint_names=NAMES, commanded_positions=HERE, state=State.HOLDING))
PATH = Trajectory(NAMES, [TrajectoryPoint(0.0, HERE), TrajectoryPoint(1.0, (0, 0, 0))])


class FakeArm:
    """Moves until the next motion, a halt or `arrive`; `refusal`: what it refuses everything with."""

    def __init__(self) -> None:
        self.state = State.HOLDING
        self.calls: list[Any] = []
        self.refusal: RtcpError | None = None
        self.connections = self.closed = 0
        self.is_open = True
        self._motion: asyncio.Future[Arrival] | None = None

    @contextlib.asynccontextmanager
    async def connect(self) -> AsyncIterator[FakeArm]:
        self.connections += 1
        self.is_open = True
        yield self
        self.closed += 1

    async def status(self) -> Status:
        self._check()
        return cast(Status, SimpleNamespace(joint_names=NAMES, commanded_positions=HERE, state=self.state))

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

    async def move_joints(self, q: Sequence[float], progress: Callable[[Progress], None]) -> Arrival:
        return await self._move(("move", tuple(q)), progress)

    async def run_trajectory(
        self, points: Sequence[dict[str, Any]], tolerances: Tolerances, progress: Callable[[Progress], None]
    ) -> Arrival:
        return await self._move(("run", [point["q"] for point in points], tolerances), progress)

    async def _move(self, call: Any, progress: Callable[[Progress], None]) -> Arrival:
        self._check()
        self.end(RtcpError("fault", "the motion was replaced"))
        self.calls.append(call)
        self._motion = asyncio.get_running_loop().create_future()
        progress(Progress(0.0, 1.0))
        try:
            return await self._motion
        except asyncio.CancelledError:
            self.calls.append("brake")
            raise

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


def carry_out(arm: FakeArm, test: Callable[[Commander], Coroutine[Any, Any, None]], **options: bool) -> list[str]:
    """Run a coroutine with a commander; return what was logged."""
    logged: list[str] = []

    async def run() -> None:
        commander = Commander(cast(Any, arm.connect), CommandOptions(**options), logged.append)
        await test(commander)
        await asyncio.sleep(0)

    asyncio.run(run())
    return logged


def reason_of(trajectory: Trajectory, allows_partial: bool = False) -> str:
    with pytest.raises(RtcpError) as refused:
        points_of(trajectory, STATUS, allows_partial)
    assert refused.value.kind == "refused"
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
    assert arm.calls == [("run", [list(HERE), [0, 0, 0]], NO_TOLERANCES)]


def test_a_new_trajectory_replaces_the_one_under_way_whose_outcome_is_logged(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(PATH)
        await commander.begin_trajectory(PATH)
        arm.end()
        await asyncio.sleep(0.01)

    assert carry_out(arm, test) == ["the motion was replaced"]
    assert len(arm.calls) == 2


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
    begin = time.time() + 0.2

    async def test(commander: Commander) -> None:
        await commander.begin_trajectory(Trajectory(NAMES, PATH.points, begin))
        assert time.time() >= begin
        arm.end()

    carry_out(arm, test)


def test_a_trajectory_that_was_over_before_it_came_is_refused(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        with pytest.raises(RtcpError) as refused:
            await commander.begin_trajectory(Trajectory(NAMES, PATH.points, time.time() - 10.0))
        assert refused.value.reason == "old_stamp"

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


def test_a_goal_is_accepted_once_and_ends_with_its_code(arm: FakeArm) -> None:
    accepted: list[bool] = []

    async def test(commander: Commander) -> None:
        following = asyncio.create_task(commander.follow(PATH, NO_TOLERANCES, lambda: accepted.append(True)))
        await asyncio.sleep(0.01)
        arm.end()
        assert (await following)[0] is FollowCode.SUCCESSFUL

    carry_out(arm, test)
    assert accepted == [True]


def test_the_tolerances_of_a_goal_reach_the_arm(arm: FakeArm) -> None:
    wanted = Tolerances([Tolerance("a", 0.1)], [Tolerance("b", -1)], 0.5)

    async def test(commander: Commander) -> None:
        following = asyncio.create_task(commander.follow(PATH, wanted, lambda: None))
        await asyncio.sleep(0.01)
        arm.end()
        await following

    carry_out(arm, test)
    assert arm.calls[0][2] == wanted


@pytest.mark.parametrize(
    ("reason", "code"),
    [
        ("path_tolerance_violated", FollowCode.PATH_TOLERANCE_VIOLATED),
        ("goal_tolerance_violated", FollowCode.GOAL_TOLERANCE_VIOLATED),
        ("goal_time_exceeded", FollowCode.GOAL_TOLERANCE_VIOLATED),
    ],
)
def test_a_violated_tolerance_has_its_code_and_says_why(arm: FakeArm, reason: str, code: FollowCode) -> None:
    async def test(commander: Commander) -> None:
        following = asyncio.create_task(commander.follow(PATH, NO_TOLERANCES, lambda: None))
        await asyncio.sleep(0.01)
        arm.end(RtcpError("fault", "joint a was 0.2 rad beside the path", reason))
        assert await following == (code, "joint a was 0.2 rad beside the path")

    carry_out(arm, test)


def test_a_goal_that_is_refused_is_invalid_and_one_that_is_stopped_raises(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        unknown = Trajectory(("a", "b", "z"), PATH.points)
        assert (await commander.follow(unknown, NO_TOLERANCES, lambda: None))[0] is FollowCode.INVALID_JOINTS
        arm.refusal = RtcpError("refused", "too fast")
        assert await commander.follow(PATH, NO_TOLERANCES, lambda: None) == (FollowCode.INVALID_GOAL, "too fast")
        arm.refusal = None
        following = asyncio.create_task(commander.follow(PATH, NO_TOLERANCES, lambda: None))
        await asyncio.sleep(0.01)
        await commander.stop()
        with pytest.raises(RtcpError, match="was stopped"):
            await following

    carry_out(arm, test)


def test_a_goal_that_is_cancelled_brakes(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        following = asyncio.create_task(commander.follow(PATH, NO_TOLERANCES, lambda: None))
        await asyncio.sleep(0.01)
        following.cancel()
        with pytest.raises(asyncio.CancelledError):
            await following

    carry_out(arm, test)
    assert arm.calls[-1] == "brake"


# -- points one by one ----------------------------------------------------------------------------------------------


def test_each_joint_command_replaces_the_one_before(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        for number in (1, 2, 3):
            await commander.command_point(TrajectoryPoint(0.0, (number, 0, 0)))
        arm.end()

    carry_out(arm, test)
    assert arm.calls == [("move", (number, 0, 0)) for number in (1, 2, 3)]


def test_a_joint_command_from_the_past_is_dropped(arm: FakeArm) -> None:
    async def test(commander: Commander) -> None:
        await commander.command_point(TrajectoryPoint(2.0, HERE))
        with pytest.raises(RtcpError) as refused:
            await commander.command_point(TrajectoryPoint(1.5, HERE))
        assert refused.value.reason == "point_in_the_past"
        await commander.command_point(TrajectoryPoint(2.5, HERE))
        arm.end()

    carry_out(arm, test)
    assert len(arm.calls) == 2


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
        with pytest.raises(RtcpError) as refused:
            await commander.begin_trajectory(PATH)
        assert refused.value.reason == "needs_enable"
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
