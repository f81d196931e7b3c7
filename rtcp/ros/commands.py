"""What becomes of a ROS command: without ROS types, on asyncio, over the public API.

One motion is under way at a time, and a new one replaces it. What is refused raises RtcpError with the reason, which
the skin gives to the caller and writes into the log.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol, TypeVar

from rtcp.api import Arrival, Progress, RtcpError, State, Status
from rtcp.config.model import MOST_POINTS

T = TypeVar("T")
Numbers = Sequence[float]
_NEEDS_RESET = (State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT)
_LATE_S = 1.0
"""After such a pause a joint_command begins a new stream, whose times begin anew."""


@dataclass(frozen=True)
class TrajectoryPoint:
    """trajectory_msgs/JointTrajectoryPoint; rad, rad/s, rad/s^2, one number a joint; what is empty is not given."""

    time_s: float
    positions: Numbers
    velocities: Numbers = ()
    accelerations: Numbers = ()


@dataclass(frozen=True)
class Trajectory:
    """trajectory_msgs/JointTrajectory."""

    joint_names: Sequence[str]
    points: Sequence[TrajectoryPoint]
    begin_s: float = 0.0
    """When time 0 of the points is, s since 1970; 0: at once."""


@dataclass(frozen=True)
class Tolerance:
    """control_msgs/JointTolerance: rad, rad/s, rad/s^2; 0: the robot's default, -1: none."""

    name: str
    position: float = 0.0
    velocity: float = 0.0
    acceleration: float = 0.0


class FollowCode(IntEnum):
    """How a FollowJointTrajectory ended (control_msgs)."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


_CODES = {
    "unknown_joint": FollowCode.INVALID_JOINTS,
    "missing_joint": FollowCode.INVALID_JOINTS,
    "old_stamp": FollowCode.OLD_HEADER_TIMESTAMP,
    "path_tolerance_violated": FollowCode.PATH_TOLERANCE_VIOLATED,
    "goal_tolerance_violated": FollowCode.GOAL_TOLERANCE_VIOLATED,
    "goal_time_exceeded": FollowCode.GOAL_TOLERANCE_VIOLATED,
}
"""By the reason of an RtcpError; any other is an invalid goal where nothing had begun."""


@dataclass(frozen=True)
class Tolerances:
    """What a FollowJointTrajectory goal allows; `goal_time_s`: 0 is the robot's default."""

    path: Sequence[Tolerance] = ()
    goal: Sequence[Tolerance] = ()
    goal_time_s: float = 0.0


NO_TOLERANCES = Tolerances()


class Arm(Protocol):
    """What the commands need of a connected robot; each raises RtcpError."""

    @property
    def is_open(self) -> bool:
        """Whether the connection stands."""

    async def status(self) -> Status:
        """Return the status."""

    async def enable(self) -> None:
        """Enable the drives."""

    async def disable(self) -> Any:
        """Disable them."""

    async def reset(self) -> State:
        """Leave a fault or an emergency stop."""

    async def halt(self) -> None:
        """Stop every motion; return when the arm holds."""

    async def move_joints(self, q: Numbers, progress: Callable[[Progress], None]) -> Arrival:
        """Move there, in place of what is under way."""

    async def run_trajectory(
        self, points: Sequence[dict[str, Any]], tolerances: Tolerances, progress: Callable[[Progress], None]
    ) -> Arrival:
        """Run points `t`, `q`, `v`, `a`, in place of what is under way; cancelled, it brakes on the path."""


Connect = Callable[[], contextlib.AbstractAsyncContextManager[Arm]]


@dataclass(frozen=True)
class CommandOptions:
    """How the commands are taken."""

    enables: bool = False
    """A motion enables the drives; not after an emergency stop, a fault, or robot_disable."""
    allows_partial: bool = False
    """Joints that a trajectory does not name hold their position."""


class Commander:
    """Carries out what ROS asks for.

    Args:
        connect: connects to the platform; a connection that is lost is made anew with the next command.
        options: how commands are taken.
        log: takes the outcome of a motion that nobody waits for, a sentence.
    """

    def __init__(self, connect: Connect, options: CommandOptions, log: Callable[[str], None]) -> None:
        self._connect, self._options, self._log = connect, options, log
        self._arm: Arm | None = None
        self._closing = contextlib.AsyncExitStack()
        self._connecting = asyncio.Lock()
        self._motions: set[asyncio.Task[Arrival]] = set()
        self._may_enable = True
        self._next: Numbers | None = None
        """Newest joint_command, not yet sent."""
        self._sending: asyncio.Task[None] | None = None
        self._last_point_s, self._last_point_at = 0.0, 0.0

    @property
    def is_moving(self) -> bool:
        """Whether something that was asked for here is under way."""
        return bool(self._motions)

    async def close(self) -> None:
        """Close the connection: what it moves comes to a controlled stop."""
        self._arm = None
        await self._closing.aclose()

    def note_stop(self) -> None:
        """An emergency stop or a fault was seen: only `enable` enables after it."""
        self._may_enable = False

    # -- motions ------------------------------------------------------------------------------------------------------

    async def begin_trajectory(self, trajectory: Trajectory) -> None:
        """joint_path_command: begin it, in place of what is under way; return when it moves or is over.

        A trajectory without points stops the motion.
        """
        if not trajectory.points:
            await self.stop()
            return
        moves = asyncio.Event()
        await self._leave_moving(await self._begin(trajectory, NO_TOLERANCES, moves.set), moves)

    async def follow(
        self, trajectory: Trajectory, tolerances: Tolerances, moves: Callable[[], None]
    ) -> tuple[FollowCode, str]:
        """FollowJointTrajectory: run it and return how it ended. Cancelled, the arm brakes on the path.

        Args:
            trajectory: with at least one point.
            tolerances: what the goal allows.
            moves: called when it has been accepted.

        Raises:
            RtcpError: it was begun and ended before its end, for a reason that no code says.
        """
        has_begun = False

        def begun() -> None:
            nonlocal has_begun
            if not has_begun:
                has_begun = True
                moves()

        try:
            arrival = await (await self._begin(trajectory, tolerances, begun))
        except RtcpError as error:
            code = _CODES.get(error.reason, None if has_begun else FollowCode.INVALID_GOAL)
            if code is None:
                raise
            return code, error.message
        return FollowCode.SUCCESSFUL, f"there, largest error {arrival.error:.6f} rad"

    async def command_point(self, point: TrajectoryPoint) -> None:
        """joint_command: move there in place of what is under way; of points that come faster only the newest counts.

        A point with a time that is not after the one before is dropped, unless a second has passed since.
        """
        now = time.monotonic()
        is_new = now - self._last_point_at > _LATE_S
        self._last_point_at = now
        if point.time_s > 0.0 and not is_new and point.time_s <= self._last_point_s:
            raise _refusal(
                "point_in_the_past",
                f"joint_command: its time {point.time_s:g} s is not after {self._last_point_s:g} s: dropped",
            )
        self._last_point_s = point.time_s
        if not point.positions:
            raise _refusal("no_positions", "joint_command: it has no positions: give one a joint, rad")
        self._next = tuple(point.positions)
        if self._sending is None or self._sending.done():
            self._sending = asyncio.create_task(self._send_points())
        await self._sending

    async def _send_points(self) -> None:
        await self._enabled()
        while (q := self._next) is not None:
            self._next = None
            arm = await self._connected()
            moves = asyncio.Event()
            motion = self._keep(asyncio.ensure_future(arm.move_joints(q, _once_moving(moves.set))))
            await self._leave_moving(motion, moves)

    async def stop(self) -> None:
        """stop_motion: stop whatever moves; return when the arm holds."""
        self._next = None
        arm = await self._connected()
        await arm.halt()

    # -- drives -------------------------------------------------------------------------------------------------------

    async def enable(self) -> str:
        """robot_enable: leave a fault or an emergency stop, enable the drives; return a sentence."""
        arm = await self._connected()
        if (await arm.status()).state in _NEEDS_RESET:
            left = await arm.reset()
            if left is State.STOPPED_BY_LIMIT:
                return "the arm holds again"
        if (await arm.status()).state is not State.HOLDING:
            await arm.enable()
        self._may_enable = True
        return "the drives are enabled"

    async def disable(self) -> str:
        """robot_disable: stop, remove the torque; return a sentence."""
        self._may_enable = False
        arm = await self._connected()
        await arm.disable()
        return "the drives are disabled"

    # -- the way there ------------------------------------------------------------------------------------------------

    async def _begin(
        self, trajectory: Trajectory, tolerances: Tolerances, moves: Callable[[], None]
    ) -> asyncio.Task[Arrival]:
        status = await self._enabled()
        points = points_of(trajectory, status, self._options.allows_partial)
        if trajectory.begin_s > 0.0:
            wait_s = trajectory.begin_s - time.time()
            if wait_s + trajectory.points[-1].time_s < 0.0:
                raise _refusal("old_stamp", f"the trajectory ended {-wait_s:.3f} s ago by its stamp: send it in time")
            await asyncio.sleep(max(wait_s, 0.0))

        arm = await self._connected()
        return self._keep(asyncio.ensure_future(arm.run_trajectory(points, tolerances, _once_moving(moves))))

    async def _enabled(self) -> Status:
        """Return the status, the drives enabled where that is asked for and allowed."""
        arm = await self._connected()
        status = await arm.status()
        if status.state is State.READY and self._options.enables:
            if not self._may_enable:
                message = "the drives were disabled by a stop or by robot_disable: call robot_enable"
                raise _refusal("needs_enable", message)
            await arm.enable()
            status = await arm.status()
        return status

    async def _leave_moving(self, motion: asyncio.Task[Arrival], moves: asyncio.Event) -> None:
        """Return when it moves, and have its outcome logged; raise what it is refused with."""
        waiting = asyncio.ensure_future(moves.wait())
        await asyncio.wait({motion, waiting}, return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        if motion.done():
            await motion
        else:
            motion.add_done_callback(self._report)

    def _keep(self, motion: asyncio.Task[Arrival]) -> asyncio.Task[Arrival]:
        self._motions.add(motion)
        motion.add_done_callback(self._motions.discard)
        return motion

    def _report(self, motion: asyncio.Task[Arrival]) -> None:
        if not motion.cancelled() and (error := motion.exception()) is not None:
            self._log(str(error))

    async def _connected(self) -> Arm:
        async with self._connecting:
            if self._arm is None or not self._arm.is_open:
                await self._closing.aclose()  # a connection that was lost
                self._arm = await self._closing.enter_async_context(self._connect())
            return self._arm


def _once_moving(moves: Callable[[], None]) -> Callable[[Progress], None]:
    """Return a report of progress that calls `moves` while the motion is under way: it was not refused."""
    return lambda progress: moves() if progress.remaining_s > 0.0 else None


def points_of(trajectory: Trajectory, status: Status, allows_partial: bool = False) -> list[dict[str, Any]]:
    """Return the points in the robot's order of joints, as `Robot.run_trajectory` takes them; it checks the values.

    Raises:
        RtcpError: `refused`; reasons too_many_points, unknown_joint, missing_joint, wrong_count.
    """
    if len(trajectory.points) > MOST_POINTS:
        raise _refusal(
            "too_many_points", f"the trajectory has {len(trajectory.points)} points, at most {MOST_POINTS} are allowed"
        )
    given, names = list(trajectory.joint_names), status.joint_names
    if unknown := [name for name in given if name not in names or given.count(name) > 1]:
        raise _refusal(
            "unknown_joint", f"joint {unknown[0]!r} is unknown or named twice: the robot has {', '.join(names)}"
        )
    if (missing := [name for name in names if name not in given]) and not (allows_partial and given):
        raise _refusal("missing_joint", f"joint {missing[0]!r} is missing: name all of {', '.join(names)}")
    place = [given.index(name) if name in given else None for name in names]

    def ordered(number: int, what: str, values: Numbers, others: Numbers) -> list[float]:
        if len(values) != len(given):
            message = f"point {number} has {len(values)} {what}, its trajectory names {len(given)} joints"
            raise _refusal("wrong_count", message)
        return [other if at is None else float(values[at]) for at, other in zip(place, others, strict=True)]

    holds, rests = status.commanded_positions, [0.0] * len(names)
    has_velocities = all(point.velocities for point in trajectory.points)
    has_accelerations = has_velocities and all(point.accelerations for point in trajectory.points)
    points = []
    for number, point in enumerate(trajectory.points, 1):
        made: dict[str, Any] = {"t": point.time_s, "q": ordered(number, "positions", point.positions, holds)}
        if has_velocities:
            made["v"] = ordered(number, "velocities", point.velocities, rests)
        if has_accelerations:
            made["a"] = ordered(number, "accelerations", point.accelerations, rests)
        points.append(made)
    return points


def _refusal(reason: str, message: str) -> RtcpError:
    return RtcpError("refused", message, reason)


class StoppingArm:
    """`Arm` on today's API, which cannot replace a motion or observe tolerances: what is under way is stopped first.

    Args:
        robot: a connected `rtcp.AsyncRobot`.
    """

    def __init__(self, robot: Any) -> None:
        self._robot = robot
        self.status, self.enable, self.disable = robot.status, robot.enable, robot.disable
        self.reset, self.halt = robot.reset, robot.halt
        self._under_way = 0

    @property
    def is_open(self) -> bool:
        """See `Arm`."""
        return bool(self._robot.is_open)

    async def move_joints(self, q: Numbers, progress: Callable[[Progress], None]) -> Arrival:
        """See `Arm`."""
        async with self._alone():
            arrival: Arrival = await self._robot.move_joints(q, progress=progress)
            return arrival

    async def run_trajectory(
        self, points: Sequence[dict[str, Any]], tolerances: Tolerances, progress: Callable[[Progress], None]
    ) -> Arrival:
        """See `Arm`; a path or goal tolerance that is given is refused."""
        if tolerances != NO_TOLERANCES:
            raise _refusal("tolerances", "tolerances are not supported yet: leave them empty")
        async with self._alone() as has_stopped:
            # It stands where the stop ended, and not at the first point any more.
            arrival: Arrival = await self._robot.run_trajectory(points, approach=has_stopped, progress=progress)
            return arrival

    @contextlib.asynccontextmanager
    async def _alone(self) -> AsyncIterator[bool]:
        has_stopped = self._under_way > 0
        self._under_way += 1
        try:
            if has_stopped:
                await self._robot.halt()
            yield has_stopped
        finally:
            self._under_way -= 1
