"""Execution of ROS commands: without ROS types, on asyncio, over the public API.

One motion runs at a time, and a new one replaces it. A refused command raises RtcpError with the reason, which the
layer of ROS 1 or ROS 2 returns to the caller and logs.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import shlex
import threading
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, cast

from rtcp.api import Arrival, AsyncRobot, Progress, Replaced, RtcpError, State, Status, Stream
from rtcp.api.robot import command_fields
from rtcp.config.model import MOST_POINTS
from rtcp.ros.held_up import HeldUp
from rtcp.ros.processes import ProcessService

Numbers = Sequence[float]
_NEEDS_RESET = (State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT)
_PAUSE_S = 1.0
"""Pause after which a joint_command begins a new stream with new times."""
_REPEAT_S = 0.1
"""Interval of repeated targets: the platform ends a stream after 0.2 s without one."""
_POLL_S = 0.05
_ARRIVED_RAD = 1e-6
"""Largest distance of a joint from its target on arrival."""
_RAN_OUT = ("out_of_points", "not_open")
"""Ends of an open trajectory that came to rest at its last point."""
_LATEST_S = 0.5
"""Upper bound on the age of a trajectory's stamp, s."""
_LONGEST_WAIT_S = 60.0
"""Longest wait for the stamp of a trajectory, s."""
MOST_WAITING = 100
"""Most messages of a topic that wait to be carried out."""
START_RAD = 0.01
"""Largest distance of a trajectory's first point from the commanded position; MoveIt allows as much."""
GOAL_RAD = 0.01
"""Default goal tolerance, that of the reference client; during the motion the platform supervises the drives."""


@dataclass(frozen=True)
class TrajectoryPoint:
    """trajectory_msgs/JointTrajectoryPoint; rad, rad/s, rad/s^2, a number for each joint; empty: not specified."""

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
    """Instant of time 0 of the points, s since 1970; 0: at once."""


@dataclass(frozen=True)
class Tolerance:
    """control_msgs/JointTolerance: rad, rad/s, rad/s^2; 0: the robot's default, -1: none."""

    name: str
    position: float = 0.0
    velocity: float = 0.0
    acceleration: float = 0.0


class FollowCode(IntEnum):
    """Error code of a FollowJointTrajectory (control_msgs)."""

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
    "not_settled": FollowCode.GOAL_TOLERANCE_VIOLATED,
    "goal_time_exceeded": FollowCode.GOAL_TOLERANCE_VIOLATED,
}
"""Reason of an RtcpError -> code; any other reason is an invalid goal if the motion had not begun."""


CANCELLED = FollowCode.INVALID_GOAL, "cancelled: the arm brakes"
"""Code and message of a goal that its client cancelled. The action has no code of its own for a goal that was cancelled
or replaced; with SUCCESSFUL a client that looks at the code alone would take it for an arrival."""


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of a FollowJointTrajectory goal; `goal_time_s`: 0 is the robot's default."""

    path: Sequence[Tolerance] = ()
    goal: Sequence[Tolerance] = ()
    goal_time_s: float = 0.0


Connect = Callable[[], contextlib.AbstractAsyncContextManager[AsyncRobot]]


@dataclass(frozen=True)
class CommandOptions:
    """Options of the commands."""

    enables: bool = False
    """Whether a motion enables the drives; not after an emergency stop, a fault, or robot_disable."""
    allows_partial: bool = False
    """Whether joints that a trajectory does not name hold their position."""
    buffer_s: float = 0.0
    """Delay of joint_command, executed as a trajectory through the points, s; 0: each replaces the last."""
    most_points: int = 0
    """Number of points that are kept of a longer trajectory, evenly and with both ends; 0: it is refused."""


class Inbox:
    """Carries out the messages of topics on an event loop, from any thread; refusals are logged.

    Args:
        loop: of the commander.
        log: receives a sentence.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, log: Callable[[str], None]) -> None:
        self._loop, self._log = loop, log
        self._lock = threading.Lock()
        self._waiting: dict[str, int] = {}
        """Messages that are not carried out yet, by topic."""
        self._dropping: set[str] = set()
        """Topics of which messages are dropped; logged."""

    def put(self, topic: str, command: Coroutine[Any, Any, None]) -> None:
        """Carry out a message; of a flood, those beyond `MOST_WAITING` are dropped."""
        with self._lock:
            waiting = self._waiting.get(topic, 0)
            if waiting >= MOST_WAITING:
                command.close()
                if topic not in self._dropping:
                    self._dropping.add(topic)
                    self._log(f"{topic}: {MOST_WAITING} messages wait, further ones are dropped")
                return
            self._waiting[topic] = waiting + 1
        asyncio.run_coroutine_threadsafe(self._carry_out(topic, command), self._loop)

    async def _carry_out(self, topic: str, command: Coroutine[Any, Any, None]) -> None:
        try:
            await command
        except Exception as error:  # also programming errors, which would be lost otherwise
            self._log(f"{topic}: {error}")
        finally:
            with self._lock:
                self._waiting[topic] -= 1
                if not self._waiting[topic]:
                    self._dropping.discard(topic)


class Commander:
    """Executes ROS commands.

    Args:
        connect: connects to the platform; after a loss again with the next command.
        options: options of the commands.
        log: receives a sentence on the outcome of a motion that no caller waits for.
    """

    def __init__(self, connect: Connect, options: CommandOptions, log: Callable[[str], None]) -> None:
        self._connect, self._options, self._log = connect, options, log
        self._robot: AsyncRobot | None = None
        self._status: Status | None = None
        """Last status of this connection."""
        self._closing = contextlib.AsyncExitStack()
        self._connecting = asyncio.Lock()
        self._motions: set[asyncio.Task[Arrival]] = set()
        self._requests = self._barrier = 0
        """Number of requested trajectories, stops and streams; requests before the barrier are cancelled."""
        self._disabled = 0
        """Number of robot_disable calls: each aborts an enabling in progress."""
        self._may_enable = True
        self._points = _Points(self, options.buffer_s, log)
        self._held_up = HeldUp(self._was_held_up)
        self._polling = asyncio.get_running_loop().create_task(self._poll())

    @property
    def is_moving(self) -> bool:
        """Whether a motion requested here is in progress."""
        return bool(self._motions) or self._points.are_followed

    async def close(self) -> None:
        """Close the connection: its motion comes to a controlled stop."""
        self._polling.cancel()
        self._points.end()
        self._robot = None
        await self._closing.aclose()

    def note_stop(self) -> None:
        """Record an emergency stop or a fault: from now on only `enable` enables the drives."""
        self._may_enable = False
        self._bar()

    def _bar(self) -> None:
        """Cancel requests that have not begun."""
        self._requests = self._barrier = self._requests + 1

    def _require_newest(self, number: int, robot: AsyncRobot) -> None:
        if number < self._barrier or not robot.is_open:
            raise refusal("superseded", "another command, a stop or the end of the platform came before it began")

    async def _poll(self) -> None:
        while True:
            self._held_up.check()
            await asyncio.sleep(_POLL_S)

    def _was_held_up(self, gap_s: float) -> None:
        self._bar()
        self._points.end()
        self._log(f"this node did not run for {gap_s:.1f} s: commands of that time are refused")

    def is_timely(self) -> bool:
        """Whether a command received now is not delayed by a stall of this process."""
        return self._held_up.is_timely()

    def _require_timely(self) -> None:
        if not self.is_timely():
            raise refusal("held_up", "the command waited while this node did not run: send it again")

    # -- motions ------------------------------------------------------------------------------------------------------

    async def begin_trajectory(self, trajectory: Trajectory) -> None:
        """joint_path_command: begin a trajectory, which replaces the present motion; return when it is accepted.

        A trajectory without points stops the motion.
        """
        if not trajectory.points:
            await self.stop()
            return
        accepted = asyncio.Event()
        motion = await self._begin(trajectory, None, accepted.set)
        waiting = asyncio.ensure_future(accepted.wait())
        await asyncio.wait({motion, waiting}, return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        if motion.done():
            await motion
        else:
            motion.add_done_callback(self._report)

    async def follow(
        self, trajectory: Trajectory, tolerances: Tolerances, accepted: Callable[[], None]
    ) -> tuple[FollowCode, str]:
        """FollowJointTrajectory: run it; return its code and message. When cancelled, the arm brakes on its path.

        Args:
            trajectory: with at least one point.
            tolerances: tolerances of the goal.
            accepted: called when the goal is accepted.

        Raises:
            RtcpError: it ended early, for a reason without a code.
        """
        has_begun = False

        def begun() -> None:
            nonlocal has_begun
            has_begun = True
            accepted()

        try:
            arrival = await (await self._begin(trajectory, tolerances, begun))
        except RtcpError as error:
            code = _CODES.get(error.reason, None if has_begun else FollowCode.INVALID_GOAL)
            if code is None:
                raise
            return code, error.message
        return FollowCode.SUCCESSFUL, f"there, largest error {arrival.error:.6f} rad"

    async def command_point(self, point: TrajectoryPoint, sender: str = "") -> None:
        """joint_command: move the joints, base to tool, to a point, which replaces the present motion; at any rate.

        A point whose time does not follow that of the last one is dropped, unless that one came over a second ago.
        While the arm follows one sender, points of another one are refused; the first refusal has the names of both.

        Args:
            point: the point.
            sender: name of its publisher; empty: unknown, and not distinguished.
        """
        await self._points.take(point, sender)

    async def command_joints(self, trajectory: Trajectory) -> None:
        """joint_trajectory: one point, as MoveIt Servo sends it, is a `joint_command`; more are a trajectory."""
        if len(trajectory.points) != 1:
            await self.begin_trajectory(trajectory)
            return
        status = self._points.status or await (await self.connected()).status()
        (ordered,) = points_of(trajectory, status, self._options.allows_partial, self._points.target)
        time_s = trajectory.begin_s + ordered["t"] if trajectory.begin_s else 0.0
        await self._points.take(TrajectoryPoint(time_s, ordered["q"], ordered.get("v", ()), ordered.get("a", ())))

    async def stop(self) -> str:
        """stop_motion, robot_stop: stop any motion, also one that waits for its stamp; return when the arm holds."""
        self._bar()
        self._points.end()
        robot = await self.connected()
        await robot.halt()
        return "the arm holds"

    # -- drives -------------------------------------------------------------------------------------------------------

    async def enable(self) -> str:
        """robot_enable: leave a fault or an emergency stop, enable the drives; return a sentence."""
        self._require_timely()
        before, robot = self._disabled, await self.connected()
        if (await robot.status()).state in _NEEDS_RESET:
            former = await robot.reset()
            if former is State.STOPPED_BY_LIMIT:
                return "the arm holds again"
        state = (await robot.status()).state
        if self._disabled != before:
            raise refusal("superseded", "robot_disable was called meanwhile")
        if state is not State.HOLDING:
            await robot.enable()
        self._may_enable = True
        return "the drives are enabled"

    async def set_speed_override(self, fraction: float) -> None:
        """speed_override: scale the speed of the present and all later motions."""
        await (await self.connected()).set_speed_override(fraction)

    async def set_limits(self, changes: Mapping[str, float]) -> None:
        """Narrow limits, all or none, by the keys of `rtcp limits set`."""
        self._require_timely()
        await (await self.connected()).set_limits(changes)

    async def set_outputs(self, values: Iterable[tuple[str, str, float]]) -> None:
        """Set outputs (slave, name, value), in this order, up to the first refusal."""
        self._require_timely()
        robot = await self.connected()
        for slave, name, value in values:
            await robot.set_output(f"{slave}.{name}", float(value))

    async def command_process(self, service: ProcessService, text: str = "") -> str:
        """Send a command to a process; return a sentence when it is carried out, of a lasting one when it has ended.

        Args:
            service: names the command.
            text: its fields, as on the command line: `phase=austenite is_cold=true`.
        """
        if service.needs_lease:  # else it only makes the process safer
            self._require_timely()
        try:
            fields = command_fields(shlex.split(text))
        except ValueError as error:
            raise refusal("no_field", str(error)) from None
        robot = await self.connected()
        if service.member:
            robot = await cast(Any, robot).member(service.member)  # a `rtcp.ros.group.GroupRobot`
        await robot.command(service.command, **fields)
        state = (await robot.status()).raw["processes"][service.process]["state"]
        return f"{service.process} is {state}" if state else "done"

    async def disable(self) -> str:
        """robot_disable: stop the arm and remove the torque; return a sentence."""
        self._may_enable = False
        self._disabled += 1
        self._bar()
        self._points.end()
        robot = await self.connected()
        await robot.disable()
        return "the drives are disabled"

    # -- execution ----------------------------------------------------------------------------------------------------

    async def _begin(
        self, trajectory: Trajectory, tolerances: Tolerances | None, accepted: Callable[[], None]
    ) -> asyncio.Task[Arrival]:
        self._require_timely()
        self._requests = number = self._requests + 1
        if not trajectory.points:
            raise refusal("no_points", "the trajectory has no points")
        robot = await self.connected()
        status = await self._known()
        trajectory = downsampled(trajectory, self._options.most_points)
        points = points_of(trajectory, status, self._options.allows_partial)
        limits = {} if tolerances is None else tolerances_of(tolerances, status.joint_names)
        wait_s = trajectory.begin_s - time.time() if trajectory.begin_s > 0.0 else 0.0
        if wait_s < -_LATEST_S:
            raise refusal("old_stamp", f"its stamp is {-wait_s:.3f} s old, at most {_LATEST_S:g} s are allowed")
        if wait_s > _LONGEST_WAIT_S:
            message = f"its stamp is {wait_s:.0f} s ahead, allowed are {_LONGEST_WAIT_S:g} s: compare the clocks"
            raise refusal("far_stamp", message)
        self._require_newest(number, robot)
        self._barrier = number
        await asyncio.sleep(max(wait_s, 0.0))
        self._require_newest(number, robot)
        status = await self.enabled()
        if len(trajectory.joint_names) < len(status.joint_names):
            if status.state is State.MOVING:
                raise refusal("moving", "joints that are not named hold only where the arm rests")
            points = points_of(trajectory, status, self._options.allows_partial)

        def report(progress: Progress) -> None:
            if progress.accepted:
                accepted()

        async def run() -> Arrival:
            self._require_newest(number, robot)
            self._points.end()
            return await robot.run_trajectory(
                points, progress=report, replace=True, start_tolerance=START_RAD, **limits
            )

        motion = asyncio.ensure_future(run())
        self._motions.add(motion)
        motion.add_done_callback(self._motions.discard)
        return motion

    async def end_motions(self) -> None:
        """Stop the present trajectory on its path; one that waits for its stamp does not begin."""
        self._bar()
        if self._motions:
            await (await self.connected()).halt()
            await asyncio.gather(*self._motions, return_exceptions=True)

    async def _known(self) -> Status:
        """Return a status, which may be old, for the names of the joints."""
        robot = await self.connected()
        if self._status is None:
            self._status = await robot.status()
        return self._status

    async def enabled(self) -> Status:
        """Enable the drives where requested and allowed; return a status, which may be old."""
        robot = await self.connected()
        if not (self._options.enables or self._options.allows_partial):
            return await self._known()  # saves a request before a motion
        status = self._status = await robot.status()
        if status.state is State.READY and self._options.enables:
            if not self._may_enable:
                message = "the drives were disabled by a stop or by robot_disable: call robot_enable"
                raise refusal("needs_enable", message)
            await robot.enable()
            status = await robot.status()
        return status

    async def connected(self) -> AsyncRobot:
        """Return the connection to the platform; connect again where it was lost."""
        async with self._connecting:
            if self._robot is None or not self._robot.is_open:
                await self._closing.aclose()  # the lost connection
                self._robot, self._status = await self._closing.enter_async_context(self._connect()), None
            return self._robot

    def _report(self, motion: asyncio.Task[Arrival]) -> None:
        error = None if motion.cancelled() else motion.exception()
        if error is not None and not isinstance(error, Replaced):
            self._log(str(error))


class _Points:
    """joint_command: a setpoint of a stream, or, buffered, a point of an open trajectory.

    A stream that was ended by a stop, a trajectory or a target out of range stays ended until its sender pauses for
    `_PAUSE_S`: continued sending does not restart the arm.
    """

    def __init__(self, commander: Commander, buffer_s: float, log: Callable[[str], None]) -> None:
        self._commander, self._buffer_s, self._log = commander, buffer_s, log
        self._lock = asyncio.Lock()
        self._stream: Stream | None = None
        self._attending: asyncio.Task[None] | None = None
        self.status: Status | None = None
        """Status of the robot at the begin of the stream; None: no stream."""
        self._has_ended = False
        self._sender = ""
        """Publisher of the points that the arm follows; empty: unknown."""
        self._refused: set[str] = set()
        """Other publishers whose refusal is logged."""
        self._newest: TrajectoryPoint | None = None
        self._last_s = 0.0
        """Time of the last point on its sender's clock, s."""
        self._is_dropping = False
        """Whether points are being dropped because their times do not rise; logged once."""
        self._came_s = self._before_s = -math.inf
        """Arrival of the last point and of the one before, s."""
        self._sent_s = 0.0
        self._anchor_s: float | None = None
        """Local clock minus the sender's, s; None: determined with the next point."""
        self._began_s = 0.0
        """Time 0 of the open trajectory, local clock, s."""

    @property
    def are_followed(self) -> bool:
        """Whether the arm follows the points."""
        lasts_s = self._buffer_s + _PAUSE_S if self._buffer_s else math.inf
        return self.status is not None and time.monotonic() - self._came_s < lasts_s

    @property
    def target(self) -> Numbers | None:
        """Newest target while the arm follows the points, rad."""
        return self._newest.positions if self.status is not None and self._newest is not None else None

    def end(self) -> None:
        """End the stream: something else moves or stops the arm."""
        self._has_ended = True
        self._close()

    def _close(self) -> None:
        if self._attending is not None:
            self._attending.cancel()
        if self._stream is not None:
            self._stream.close()
        self._stream = self.status = self._attending = None

    async def take(self, point: TrajectoryPoint, sender: str = "") -> None:
        """Send a point to the platform; of points that arrive while the stream is being opened only the last is sent.

        Raises:
            RtcpError: the point or the stream is refused.
        """
        now = time.monotonic()
        if not self._commander.is_timely():
            self._came_s = now  # the pause before a new stream counts from here
            return
        is_first = now - self._came_s > _PAUSE_S
        if is_first:
            self._sender = sender
            self._refused.clear()
        elif sender and self._sender and sender != self._sender:
            if sender in self._refused:
                return  # logged once
            self._refused.add(sender)
            message = f"the arm follows {self._sender}: points of {sender} are refused until that one pauses for 1 s"
            raise refusal("other_publisher", message)
        self._before_s, self._came_s = self._came_s, now
        if is_first:
            self._has_ended, self._anchor_s = False, None
        elif self._has_ended:
            return
        if point.time_s > 0.0 and not is_first and point.time_s <= self._last_s:
            if self._is_dropping:
                return  # logged once
            self._is_dropping = True
            message = f"its time {point.time_s:g} s is not after {self._last_s:g} s: dropped"
            raise refusal("point_in_the_past", message)
        self._last_s, self._is_dropping = point.time_s, False
        for field_name, values in vars(point).items():
            if field_name != "time_s" and not all(map(math.isfinite, values)):
                joint = [*map(math.isfinite, values)].index(False) + 1
                raise refusal("not_finite", f"{field_name} of joint {joint} is not finite: the point is dropped")
        self._newest = point
        try:
            if self._buffer_s:
                async with self._lock:
                    if not self._has_ended:
                        await self._append(point)
            elif self._stream is not None:
                await self._send(self._stream, point)
            elif not self._lock.locked():  # else the task that opens the stream sends the newest
                async with self._lock:
                    await self._open()
        except RtcpError:
            self.end()
            raise

    def _stamp(self, point: TrajectoryPoint) -> float:
        """Return the instant of a point on the local clock: the sender's times are better than the arrival times."""
        if self._anchor_s is None:
            self._anchor_s = time.monotonic() - point.time_s
        return time.monotonic() if point.time_s == 0.0 else self._anchor_s + point.time_s

    # -- as a stream --------------------------------------------------------------------------------------------------

    async def _open(self) -> None:
        status = await self._commander.enabled()
        joints = len(status.joint_names)
        if self._newest is not None and len(self._newest.positions) != joints:
            message = f"found {len(self._newest.positions)} positions, allowed are {joints}: dropped"
            raise refusal("wrong_count", message)
        self.status = status
        await self._commander.end_motions()
        robot = await self._commander.connected()
        stream = await robot.open_stream()
        if self._newest is None or self._has_ended:
            stream.close()
            return
        self._stream = stream
        if self._attending is None or self._attending.done():
            self._attending = asyncio.create_task(self._attend(robot))
        await self._send(stream, self._newest)

    async def _send(self, stream: Stream, point: TrajectoryPoint, rests: bool = False) -> None:
        # At a low rate the arm has to rest at a target: the duration of its speed is unknown.
        has_speed = point.velocities and self._came_s - self._before_s < _REPEAT_S and not rests
        velocity = (0.0,) * len(point.positions) if rests else point.velocities if has_speed else None
        stamp = None if rests else self._stamp(point)
        self._sent_s = time.monotonic()
        try:
            stream.send(point.positions, velocity, (has_speed and point.accelerations) or None, stamp)
        except RtcpError as error:
            if error.reason != "stream_ended":
                raise
            # No stop, but a stall of this process: continue as after a pause.
            self._log("joint_command: no setpoint reached the platform for 0.2 s: the stream is opened again")
            stream.close()
            self._stream = self._anchor_s = None
            if not self._lock.locked():
                async with self._lock:
                    await self._open()

    async def _attend(self, robot: AsyncRobot) -> None:
        """Keep the stream open until the arm is at its last point."""
        while (stream := self._stream) is not None and (point := self._newest) is not None:
            await asyncio.sleep(_POLL_S)
            if time.monotonic() - self._sent_s < _REPEAT_S:
                continue
            try:
                if time.monotonic() - self._came_s > _PAUSE_S:
                    commanded = (await robot.status()).commanded_positions
                    if max(abs(a - b) for a, b in zip(commanded, point.positions, strict=True)) < _ARRIVED_RAD:
                        self._close()
                        return
                if self._newest is not point or self._stream is not stream:
                    continue  # a newer point came meanwhile
                self._anchor_s = None
                await self._send(stream, point, rests=True)
            except RtcpError as error:
                self._log(f"joint_command: {error}")
                self._attending = None
                self.end()

    # -- buffered -----------------------------------------------------------------------------------------------------

    async def _append(self, point: TrajectoryPoint) -> None:
        robot = await self._commander.connected()
        row: dict[str, Any] = {"q": list(point.positions)}
        if point.velocities:
            row["v"] = list(point.velocities)
            if point.accelerations:
                row["a"] = list(point.accelerations)
        if self.status is not None:
            try:
                await robot.append([row | {"t": self._stamp(point) - self._began_s}])
            except RtcpError as error:
                if self._has_ended:
                    return
                if error.reason not in _RAN_OUT:
                    raise
                self.status = self._anchor_s = None
        if self.status is None:
            status = await self._commander.enabled()
            if self._has_ended:
                return
            self.status = status
            self._began_s = self._stamp(point) - self._buffer_s
            await robot.open_trajectory([row | {"t": self._buffer_s}], replace=True)


def downsampled(trajectory: Trajectory, most: int) -> Trajectory:
    """Return a trajectory of at most `most` of its points, evenly chosen, with both ends; 0: all."""
    last = len(trajectory.points) - 1
    if not 2 <= most <= last:
        return trajectory
    return replace(trajectory, points=[trajectory.points[round(k * last / (most - 1))] for k in range(most)])


def points_of(
    trajectory: Trajectory, status: Status, allows_partial: bool = False, hold_at: Numbers | None = None
) -> list[dict[str, Any]]:
    """Return the points in the robot's order of joints, for `Robot.run_trajectory`, which checks their limits.

    `hold_at`: positions of joints that are not named, rad; None: the commanded ones.

    Raises:
        RtcpError: `refused`; reasons too_many_points, unknown_joint, missing_joint, wrong_count, not_finite.
    """
    if len(trajectory.points) > MOST_POINTS:
        raise refusal(
            "too_many_points", f"the trajectory has {len(trajectory.points)} points, at most {MOST_POINTS} are allowed"
        )
    given_names, names = list(trajectory.joint_names), status.joint_names
    if unknown := [name for name in given_names if name not in names or given_names.count(name) > 1]:
        raise refusal(
            "unknown_joint", f"joint {unknown[0]!r} is unknown or named twice: the robot has {', '.join(names)}"
        )
    if (missing := [name for name in names if name not in given_names]) and not (allows_partial and given_names):
        raise refusal("missing_joint", f"joint {missing[0]!r} is missing: name all of {', '.join(names)}")
    place = [given_names.index(name) if name in given_names else None for name in names]

    def ordered(number: int, field_name: str, values: Numbers, defaults: Numbers) -> list[float]:
        if len(values) != len(given_names):
            message = f"point {number} has {len(values)} {field_name}, its trajectory names {len(given_names)} joints"
            raise refusal("wrong_count", message)
        for joint, value in zip(given_names, values, strict=True):
            if not math.isfinite(value):
                message = f"point {number}: {field_name} of {joint} has {value}, a finite number is needed"
                raise refusal("not_finite", message)
        return [default if at is None else float(values[at]) for at, default in zip(place, defaults, strict=True)]

    holds, rests = status.commanded_positions if hold_at is None else hold_at, [0.0] * len(names)
    has_velocities = all(point.velocities for point in trajectory.points)
    has_accelerations = has_velocities and all(point.accelerations for point in trajectory.points)
    points = []
    for number, point in enumerate(trajectory.points, 1):
        row: dict[str, Any] = {"t": point.time_s, "q": ordered(number, "positions", point.positions, holds)}
        if has_velocities:
            row["v"] = ordered(number, "velocities", point.velocities, rests)
        if has_accelerations:
            row["a"] = ordered(number, "accelerations", point.accelerations, rests)
        points.append(row)
    return points


def tolerances_of(tolerances: Tolerances, names: Sequence[str]) -> dict[str, Any]:
    """Return the tolerances for `Robot.run_trajectory`: a number for each joint, rad, 0: none.

    Raises:
        RtcpError: `refused`; reasons unknown_joint, unsupported_tolerance.
    """

    def numbers(tolerances: Sequence[Tolerance], default: float) -> list[float]:
        values = dict.fromkeys(names, default)
        for joint in tolerances:
            if joint.name not in values:
                raise refusal(
                    "unknown_joint", f"a tolerance names joint {joint.name!r}: the robot has {', '.join(names)}"
                )
            if joint.velocity > 0.0 or joint.acceleration > 0.0:
                message = f"the tolerance of {joint.name} has a velocity or acceleration: only positions are supervised"
                raise refusal("unsupported_tolerance", message)
            if not math.isfinite(joint.position):
                raise refusal("not_finite", f"the tolerance of {joint.name} is {joint.position}: a number is needed")
            if joint.position:
                values[joint.name] = max(joint.position, 0.0)
        return list(values.values())

    return {
        "path_tolerance": numbers(tolerances.path, 0.0),
        "goal_tolerance": numbers(tolerances.goal, GOAL_RAD),
        "goal_time_s": tolerances.goal_time_s or None,
    }


def refusal(reason: str, message: str) -> RtcpError:
    """Return the error of a command that this module refuses."""
    return RtcpError("refused", message, reason)
