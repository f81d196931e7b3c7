"""Motions that have an end: joint moves, poses, straight lines, files. Planned and checked whole before they begin."""

from __future__ import annotations

import asyncio
import bisect
import contextlib
import dataclasses
import math
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from annotated_types import Ge

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import Pose, times
from rtcp.config.model import ArmConfig, ConfigError, Point, Stop
from rtcp.gateway.command_channel import IN_MOTION, Caller, CommandChannel, Json
from rtcp.gateway.method import Frame, Numbers, check_count, index_of, method
from rtcp.gateway.tolerances import Tolerances, Tracking, Violation
from rtcp.ipc import commands, refusals
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import Arrived, PermissionWithdrawn, Stopped
from rtcp.ipc.layout import PLAN_ROWS, PlanTooLong
from rtcp.ipc.names import Names
from rtcp.ipc.states import ControlMode, JogFrame, State
from rtcp.motion.guards.zones import ITSELF, Zones
from rtcp.motion.joint_motion import LONGEST_S
from rtcp.motion.limits import Limits
from rtcp.motion.planning import preview
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.plan import COLUMNS, KIND, LINE, MOST_LINES, Plan, PlanRefused
from rtcp.motion.planning.trajectories import OpenPlan, plan_trajectory

T = TypeVar("T")
_COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
_JOINTS = ": one a joint, rad"
_LARGEST = 100.0
"""Largest coordinate of a pose, m or rad: beyond any arm, and larger angles lose their precision."""
_REST_S = 3.0
_TIMEOUT_S = 20.0
_REPORT_S = 0.5
"""Interval between progress reports of a long plan, s."""
GOAL_TIME_S = 3.0
"""Default of `goal_time_s`: largest delay of an arm with tolerances at its goal, s."""
LONGEST_OPEN_S = 86_400.0
"""Longest open trajectory, s."""
_POLL_S, _AHEAD_S = 0.01, 0.05
"""Interval of checks of an open trajectory, s; time before its last row at which a rest there is planned, s."""
_GONE = (refusals.NotOpen.name, refusals.NoLease.name, refusals.WrongState.name)
"""Refusals of more points once the trajectory has ended."""
_KEPT_ROWS = 3
"""Rows of the plan area that no new point may fill: the last one passed, one for a waiting point, one spare."""
_GUIDED_S = 3700.0
"""Timeout of hand guiding, s: beyond its longest duration."""
_UNPLANNED_S = 600.0
"""Longest motion by a command of a package outside, s."""


class Planner:
    """Plans motions of one arm with one tool under the limits in force.

    Every method raises RtcpError: `refused` if this arm cannot do it, `invalid` if no arm could.

    Args:
        config: the arm.
        limits: in force; others change them.
        tool: number of the tool.
    """

    def __init__(self, config: ArmConfig, limits: Limits, tool: int = 0) -> None:
        self._config = config
        self.limits = limits
        self.tool = tool
        self._arm = config.models[tool] if config.models else None
        self._zones = None if self._arm is None else Zones(self._arm, limits, config.cartesian.clearance)

    def _model(self) -> ArmModel:
        """Return the geometry with the limits in force."""
        arm = self._arm
        if arm is None:
            file = self._config.source
            message = f"the geometry of the arm is unknown: the key kinematics is missing in {file}"
            raise RtcpError("refused", message, "no_geometry")
        limits = zip(self.limits.low, self.limits.high, self.limits.velocity, strict=True)
        return dataclasses.replace(arm, limits=tuple(JointLimit(*three) for three in limits))

    def _zone_at(self, q: Sequence[float]) -> str | None:
        if self._zones is None or self._arm is None:
            return None
        distance, box = self._zones.distance(frames(self._arm, q))
        if distance >= 0.0:
            return None
        if box >= ITSELF:
            first, second = map(Names(self._config).link, self._zones.links(box))
            return f"a collision with itself ({first} and {second})"
        if cone := Names(self._config).cone(box):
            return f"an orientation outside the cone {cone}"
        boxes = self._config.cartesian.keep_out
        return f"the keep-out box {boxes[box].name}" if 0 <= box < len(boxes) else "the space outside the Cartesian box"

    def joints_at(self, pose: Sequence[float], q_now: Sequence[float]) -> list[float]:
        """Return the joint positions, rad, nearest to `q_now` that bring the tool to `pose` (m, rad)."""
        _require_pose(pose, "pose")
        solution = InverseKinematics(self._model()).solve_near(Pose.from_xyzrpy(*pose), q_now)
        message, fields = f"the pose cannot be reached: {solution.reason}", {"distance": solution.out_of_reach}
        if solution.q is None and solution.limited >= 0:
            joint = self._config.joints[solution.limited].name
            raise RtcpError("refused", message, "joint_limited", {"axis": solution.limited, "joint": joint})
        if solution.q is None:
            raise RtcpError("refused", message, "out_of_reach", fields)
        if box := self._zone_at(solution.q):
            message = f"the pose cannot be reached: the arm would be in {box}"
            raise RtcpError("refused", message, "in_box", {"box": box})
        return list(solution.q)

    def moved_by(self, q: Sequence[float], offset: Sequence[float], frame: JogFrame) -> Pose:
        """Return the tool's pose at `q`, rad, moved and turned along the axes of the base or of the tool (m, rad)."""
        here, moved = forward(self._model(), q), Pose.from_xyzrpy(*offset)
        if frame is JogFrame.TOOL:
            return here @ moved
        x, y, z = (a + b for a, b in zip(here.position, moved.position, strict=True))
        return Pose((x, y, z), times(moved.rotation, here.rotation))

    def pose_at(self, q: Sequence[float]) -> list[float]:
        """Return the pose of the tool, x y z, m, rx ry rz, rad, at joint positions, rad, even outside the limits."""
        pose = forward(self._model(), q)
        return [*pose.position, *pose.rpy]

    def path(self, stops: Sequence[Stop], q_now: Sequence[float], speed: float | None) -> Plan:
        """Return the plan of a path from `q_now` to each stop in turn, its lines and arcs at most at `speed`, m/s.

        Straight lines with a rest at each stop become rows for `RunLines`, other paths a trajectory.
        """
        for at, stop in enumerate(stops):
            if stop.pose is not None:
                _require_pose(stop.pose, f"poses[{at}]")
        model, cartesian = self._model(), self._config.cartesian
        plain = all(stop.via is None and not stop.by_joints and not stop.blend for stop in stops)
        try:
            if plain:
                if len(stops) > MOST_LINES:
                    count = f"the path has {len(stops)} lines with a rest after each, allowed are {MOST_LINES}"
                    raise PlanRefused(f"{count}; with blends it is one motion")
                plan = plan_lines(model, self.limits, cartesian, q_now, stops, speed=speed, zone_at=self._zone_at)
            else:
                from rtcp.motion.planning.path import plan_path  # here: scipy loads slowly, and few need it

                plan = plan_path(model, self.limits, cartesian, q_now, stops, speed=speed, zone_at=self._zone_at)
            return dataclasses.replace(plan, tool=self.tool)
        except PlanRefused as refused:
            raise RtcpError("refused", str(refused), type(refused).__name__) from None

    def trajectory(
        self, points: Sequence[Point], q_now: Sequence[float], moving: bool = False, start_tolerance: float = 0.0
    ) -> Plan:
        """Return the plan of a trajectory from `q_now`; `moving`: with the arm in motion."""
        names = [joint.name for joint in self._config.joints]
        try:
            plan = plan_trajectory(
                points, self.limits, q_now, names=names, zone_at=self._zone_at, moving=moving,
                start_tolerance=start_tolerance,
            )  # fmt: skip
            return dataclasses.replace(plan, tool=self.tool)
        except PlanRefused as refused:
            raise RtcpError("refused", str(refused), type(refused).__name__) from None

    def open_plan(self, q_now: Sequence[float], moving: bool) -> OpenPlan:
        """Return the plan of an open trajectory from `q_now`; `moving`: with the arm in motion."""
        names = [joint.name for joint in self._config.joints]
        return OpenPlan(self.limits, q_now, names=names, zone_at=self._zone_at, moving=moving)

    def joint_move(
        self, q: Sequence[float], q_now: Sequence[float], speed: float | None, synchronized: bool
    ) -> tuple[preview.JointPath, float] | refusals.Refusal:
        """Return the path of a joint move and its duration, s; or the loop's refusal.

        Raises:
            RtcpError: `refused`: its path leads through a box, where a guard would stop it.
        """
        low, high, fastest = self.limits.low, self.limits.high, max(self.limits.velocity)
        if speed is not None and not 0.0 < speed <= fastest:
            return refusals.SpeedOutOfRange(speed, fastest)
        for axis, wanted in enumerate(q):
            if not low[axis] <= wanted <= high[axis]:
                return refusals.PositionOutOfRange(axis, wanted, high[axis] if wanted > high[axis] else low[axis])
        planned = preview.joint_move(self.limits, q_now, q, fastest if speed is None else speed, synchronized)
        if planned is None:
            return refusals.NoTrajectory(fastest if speed is None else speed, LONGEST_S)
        for at, row in enumerate(planned[0]):
            if box := self._zone_at(row):
                where = "at its end" if row == planned[0][-1] else f"after {planned[1] * at / len(planned[0]):.1f} s"
                raise RtcpError("refused", f"the move leads through {box} ({where}): choose another target or way")
        return planned

    def joint_path(self, plan: Plan, q_now: Sequence[float]) -> preview.JointPath:
        """Return the joint positions along a plan, rad."""
        return preview.planned(plan, q_now, self._arm)

    @staticmethod
    def read(path: str) -> tuple[tuple[Point, ...], tuple[Stop, ...], float | None]:
        """Return trajectory, path and speed of a motion file."""
        from rtcp.config.motion_file import read_motion

        if not Path(path).is_absolute():
            raise RtcpError("invalid", f'file: found the text "{path}", allowed is an absolute path')
        try:
            motion = read_motion(Path(path))
        except ConfigError as error:
            raise RtcpError("invalid", str(error)) from None
        return motion.trajectory, motion.path, motion.speed


class _Open:
    """An open trajectory under way: its plan, the slot of its rows, and the motion that ends with it."""

    def __init__(self, plan: OpenPlan, lease: int, slot: int) -> None:
        self.plan, self.lease, self.slot = plan, lease, slot
        self.motion: asyncio.Task[Json] | None = None
        self.lock = asyncio.Lock()
        self.ends = False


class MotionActions:
    """Moves the arm on behalf of the clients; every method raises RtcpError.

    Args:
        channel: to the loop.
        planners: one for each tool.
    """

    def __init__(self, channel: CommandChannel, planners: Sequence[Planner]) -> None:
        self._channel = channel
        self._planners = planners
        self._count = len(channel.config.joints)
        self.goal: Sequence[float] | None = None
        """Goal of the motion under way, rad; None: no motion, or one without a goal."""
        self._motion: object = None
        """The motion that the loop accepted last."""
        self._open: dict[int, _Open] = {}
        """Open trajectories by connection; one that has ended stays until it is reported to its connection."""

    @property
    def _planner(self) -> Planner:
        """Planner of the tool in use."""
        return self._planners[self._channel.tool()]

    @method()
    async def move_joints(
        self,
        caller: Caller,
        q: Numbers,
        speed: float | None = None,
        synchronized: bool = True,
        replace: bool = False,
    ) -> Json:
        """Move to joint positions, rad, at most at `speed`, rad/s. Returns `positions` and the largest `error`, rad.

        With `replace` it waits for no other request of its connection: it takes over from a motion of that connection
        without a stop, which ends with the error kind `replaced`.
        """
        check_count("q", q, self._count, _JOINTS)
        async with self._channel.lease(caller) as lease:
            return await self._move(lease, q, speed, synchronized, self._says_accepted(caller))

    def _says_accepted(self, caller: Caller) -> Callable[[], None]:
        """Return a function that reports acceptance by the loop; progress before may be of a replaced motion."""
        return lambda: caller.report({**self._channel.progress(), "accepted": True})

    @method()
    async def move_to_rest_pose(self, caller: Caller, speed: float | None = None) -> Json:
        """Move the joints to `rest_pose` of the arm's file; `speed` and result as of `move_joints`."""
        config = self._channel.config
        if config.rest_pose is None:
            raise RtcpError("refused", f"the key rest_pose is missing in {config.source}", "no_rest_pose")
        return await self.move_joints(caller, config.rest_pose, speed)

    @method()
    async def move_pose(self, caller: Caller, pose: Numbers, speed: float | None = None, line: bool = False) -> Json:
        """Move the tool to x y z, m, rx ry rz, rad, by the joints or on a `line`; `speed` in rad/s or m/s."""
        if line or self._channel.control_mode is ControlMode.CARTESIAN:
            return await self._run_path(caller, [Stop(pose)], speed)
        async with self._channel.lease(caller) as lease:
            q = await asyncio.to_thread(self._planner.joints_at, pose, self.plan_start())
            return await self._move(lease, q, speed, True)

    @method()
    async def move_line(
        self,
        caller: Caller,
        poses: tuple[Numbers, ...],
        speed: float | None = None,
        blend: Annotated[float, Ge(0)] = 0.0,
    ) -> Json:
        """Move the tool on straight lines through poses, m and rad, at `speed`, m/s; corners rounded within `blend`, m.

        Returns as `move_joints`, and `duration_s`, `length_m`, and `slowed`, the fraction of the speed that the joints
        allowed.
        """
        return await self._run_path(caller, [Stop(pose, blend=blend) for pose in poses], speed)

    @method()
    async def move_arc(
        self,
        caller: Caller,
        via: Numbers,
        pose: Numbers,
        angle: float | None = None,
        speed: float | None = None,
    ) -> Json:
        """Move the tool on the arc through `via`, x y z, m, to a pose, m and rad, at `speed`, m/s.

        Returns as `move_line`. With `angle`, rad, it travels so far on the circle through the three places, and keeps
        its orientation.
        """
        check_count("via", via, 3, ": x y z, m")
        return await self._run_path(caller, [Stop(pose, speed=speed, via=via, angle=angle)], None)

    @method()
    async def move_by(self, caller: Caller, offset: Numbers, frame: Frame = "base", speed: float | None = None) -> Json:
        """Move by an offset: the tool on a line, m and rad along and about the axes of `frame`, or the joints, rad."""
        here = self.plan_start()
        check_count("offset", offset, len(here) if frame == "joints" else len(_COORDINATES))
        if frame == "joints":
            return await self.move_joints(caller, tuple(a + b for a, b in zip(here, offset, strict=True)), speed)
        _require_pose(offset, "offset")
        for name, angle in zip(_COORDINATES[3:], offset[3:], strict=True):
            if not abs(angle) < math.pi:
                text = (
                    f"offset.{name}: found {angle:g} rad, allowed is less than half a turn: a line takes the short way"
                )
                raise RtcpError("invalid", text)
        planner = self._planner
        goal = planner.moved_by(here, offset, JogFrame[frame.upper()])
        return await self._run_path(caller, [Stop((*goal.position, *goal.rpy))], speed, planner=planner)

    @method()
    async def run(self, caller: Caller, file: str, approach: bool = False) -> Json:
        """Run a motion file (`docs/motion.md`), an absolute path. `approach`: the joints first move to its start."""
        # In a thread, like all planning: leases are renewed meanwhile.
        points, stops, speed = await asyncio.to_thread(self._planner.read, file)
        if not (stops or points):
            text = f"{file} holds a program, which steps of a client run: `rtcp run` or `rtcp.Program`"
            raise RtcpError("refused", text, "program")
        if stops:
            return await self._run_path(caller, stops, speed, approach)
        return await self.run_trajectory(caller, points, approach)

    @method()
    async def run_trajectory(
        self,
        caller: Caller,
        points: tuple[Point, ...],
        approach: bool = False,
        replace: bool = False,
        start_tolerance: Annotated[float, Ge(0)] = 0.0,
        path_tolerance: Numbers = (),
        goal_tolerance: Numbers = (),
        goal_time_s: Annotated[float, Ge(0)] | None = None,
    ) -> Json:
        """Run a trajectory through points: time `t`, s, positions `q`, rad, and if given `v` and `a`.

        A trajectory that begins at time 0 within `start_tolerance`, rad, of where the arm is commanded begins there. If
        every `t` is 0, the joints move at the speeds `v`, else at their limits, as fast as accelerations allow.

        Tolerances, rad, one a joint, 0: none: `path_tolerance` of the measured from the commanded position on the way,
        `goal_tolerance` at the end, at most `goal_time_s` later than planned. Where one is not kept the arm brakes on
        its path; reason `path_tolerance_violated` or `goal_tolerance_violated`, with `axis`, `error` and `limit`.

        With `replace` as `move_joints`; if the arm moves, a first point at time 0 is left out, and the others are
        delayed if the arm needs longer to the next one than its time.
        """
        tolerances = None
        if path_tolerance or goal_tolerance or goal_time_s is not None:
            tolerances = Tolerances(
                self._tolerance("path_tolerance", path_tolerance),
                self._tolerance("goal_tolerance", goal_tolerance),
                GOAL_TIME_S if goal_time_s is None else goal_time_s,
            )
        async with self._channel.lease(caller) as lease:
            moving = self._channel.state is State.MOVING and not approach
            begin = self._joints(points[0].q) if approach and points else self.plan_start()
            # Before the approach: a refused trajectory must move nothing.
            plan = await asyncio.to_thread(self._planner.trajectory, points, begin, moving, start_tolerance)
            slot = self._write(plan)
            if approach:
                await self._move(lease, begin, None, True)
            try:
                accepted = self._says_accepted(caller)
                return await self._run_plan(
                    lease, commands.RunTrajectory, plan, slot, "the trajectory", tolerances, accepted
                )
            except Violation as violation:
                await self._brake()
                raise violation.error from None

    def _tolerance(self, name: str, numbers: Numbers) -> Numbers:
        if numbers:
            check_count(name, numbers, self._count)
        return tuple(number if number > 0.0 else math.inf for number in numbers) or (math.inf,) * self._count

    async def run_in_step(
        self,
        caller: Caller,
        points: Sequence[Point],
        motion: int,
        partners: int,
        start_ns: int,
        brakes: Sequence[float],
        brake_step_s: float,
    ) -> Json:
        """Run a trajectory from `start_ns` on, in step with partners, a bit each (`RunInStep`)."""
        async with self._channel.lease(caller) as lease:
            plan = await asyncio.to_thread(self._planner.trajectory, points, self.plan_start())
            table = tuple(tuple(brakes[at : at + COLUMNS]) for at in range(0, len(brakes), COLUMNS))
            slot = self._write(dataclasses.replace(plan, rows=plan.rows + table))
            command = commands.RunInStep(
                slot, len(plan.rows), motion, partners, start_ns, len(brakes), brake_step_s, plan.tool
            )
            name = "the motion in step"
            arrival = self._arrival(lambda: plan.end, name)
            timeout_s = _TIMEOUT_S + 2 * plan.duration_s
            result = await self._run(lease, command, timeout_s, name, arrival, plan.end, self._says_accepted(caller))
            return result | {"duration_s": plan.duration_s, "length_m": plan.length_m, "slowed": plan.slowed}

    async def _brake(self) -> None:
        """Stop along the path and wait until the arm holds."""
        channel = self._channel
        rest = channel.reaching(State.HOLDING, IN_MOTION, "the stop", channel.observer.last_event)
        with contextlib.suppress(RtcpError):
            await channel.run(0, commands.Halt(), rest, _REST_S, "the stop")

    # -- trajectories that are open at their end -----------------------------------------------------------------------

    @method()
    async def open_trajectory(self, caller: Caller, points: tuple[Point, ...], replace: bool = False) -> Json:
        """Begin a trajectory that is open at its end; returns as `append` when it is accepted.

        Points with positions only get velocities that pass no point; the last one waits for the next, or the arm comes
        to rest at it. One that comes to its last point without more is stopped, with the event `out_of_points`.
        """
        accepted: asyncio.Future[_Open] = asyncio.get_running_loop().create_future()
        task = asyncio.create_task(self._run_open(caller, points, accepted))
        task.add_done_callback(lambda task: task.cancelled() or task.exception())  # its result may never be read
        either: list[asyncio.Future[Any]] = [task, accepted]
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            task.cancel()  # the client could not reach it, and it would keep the lease
            raise
        if not accepted.done():
            task.result()  # raises its error
        opened = accepted.result()
        opened.motion = task
        self._open[caller.connection] = opened
        return self._buffered(opened)

    async def _run_open(self, caller: Caller, points: Sequence[Point], accepted: asyncio.Future[_Open]) -> Json:
        channel = self._channel
        async with channel.lease(dataclasses.replace(caller, report=lambda progress: None)) as lease:
            moving = channel.state is State.MOVING
            planner = self._planner
            plan = planner.open_plan(self.plan_start(), moving)
            rows = await asyncio.to_thread(_append, plan, points)
            if plan.waits and plan.times[-1] < _AHEAD_S:
                # No further point could arrive in time to give the last one a velocity.
                rows += await asyncio.to_thread(_append, plan, (), True)
            opened = _Open(plan, lease, channel.observer.write_plan(rows))
            resting: asyncio.Task[None] | None = None

            def begun() -> None:
                nonlocal resting
                accepted.set_result(opened)
                resting = asyncio.create_task(self._rest_in_time(opened))

            command = commands.RunTrajectory(opened.slot, len(rows), open=True, tool=planner.tool)
            arrival = self._arrival(lambda: plan.end, "the trajectory")
            try:
                return await self._run(lease, command, LONGEST_OPEN_S, "the trajectory", arrival, begun=begun)
            finally:
                if resting is not None:
                    resting.cancel()

    @method(streams=True)
    async def append(self, caller: Caller, points: tuple[Point, ...]) -> Json:
        """Append points to the open trajectory. Returns `room`, points that fit, and `ahead_s`, time to the end."""
        opened = self._opened(caller)
        try:
            await self._extend(opened, points)
        except RtcpError as error:
            if error.reason in _GONE and opened.motion is not None:
                # It ended while the points were checked: the answer is its reason.
                await asyncio.wait([opened.motion], timeout=_REST_S)
                self._opened(caller)
            raise
        return self._buffered(opened)

    @method(streams=True)
    async def finish_trajectory(self, caller: Caller) -> Json:
        """End the open trajectory at its last point, at rest; returns as `move_joints` when the arm is there."""
        opened = self._opened(caller)
        opened.ends = True
        await self._extend(opened, (), rest=True, ends=True)
        assert opened.motion is not None
        try:
            return await opened.motion  # cancelled, it ends the motion too
        finally:
            self._open.pop(caller.connection, None)

    async def end_connection(self, connection: int) -> bool:
        """End the open trajectory of a connection; return whether there was one that moved the arm."""
        opened = self._open.pop(connection, None)
        if opened is None or opened.motion is None:
            return False
        moves = not opened.motion.done()
        opened.motion.cancel()
        await asyncio.gather(opened.motion, return_exceptions=True)
        return moves

    def _opened(self, caller: Caller) -> _Open:
        opened = self._open.get(caller.connection)
        if opened is None or opened.motion is None:
            raise self._channel.error("refused", refusals.NotOpen())
        if opened.motion.done():
            del self._open[caller.connection]
            opened.motion.result()  # raises its error
            raise self._channel.error("refused", refusals.NotOpen())
        return opened

    async def _extend(self, opened: _Open, points: Sequence[Point], rest: bool = False, ends: bool = False) -> None:
        async with opened.lock:
            plan, first = opened.plan, len(opened.plan.times)
            if len(points) > self._room(plan):
                most = PLAN_ROWS - _KEPT_ROWS
                raise self._channel.error(
                    "refused", refusals.NoRoomForPoints(most - self._room(plan) + len(points), most)
                )
            rows = await asyncio.to_thread(_append, plan, points, rest)
            self._channel.observer.extend_plan(opened.slot, first, rows)
            # Also without rows: the loop decides whether the trajectory has ended.
            await self._channel.accept(opened.lease, commands.ExtendTrajectory(len(plan.times), ends))

    async def _rest_in_time(self, opened: _Open) -> None:
        """Plan a rest at the last point if the next is not in time to give it a velocity."""
        while not opened.ends:
            await asyncio.sleep(_POLL_S)
            if opened.plan.waits and self._channel.remaining_s() < _AHEAD_S:
                with contextlib.suppress(RtcpError):
                    await self._extend(opened, (), rest=True)

    def _buffered(self, opened: _Open) -> Json:
        return {"room": self._room(opened.plan), "ahead_s": self._channel.remaining_s()}

    def _room(self, plan: OpenPlan) -> int:
        """Return the number of points that fit beside the rows ahead of the arm."""
        passed = bisect.bisect_left(plan.times, plan.times[-1] - self._channel.remaining_s())
        return PLAN_ROWS - _KEPT_ROWS - len(plan.times) + passed

    @method()
    async def run_path(
        self, caller: Caller, stops: tuple[Stop, ...], speed: float | None = None, approach: bool = False
    ) -> Json:
        """Run a path to stops: each a `pose` or the joints `q` that have it, and if given its `speed`, m/s.

        On a straight line, on the arc through `via`, x y z, m, or, if `by_joints`, by the joints; it rests there, or
        rounds the corner within `blend`, m: the keys of `path` in `docs/motion.md`. Returns as `move_line`.
        """
        return await self._run_path(caller, stops, speed, approach)

    async def _run_path(
        self,
        caller: Caller,
        stops: Sequence[Stop],
        speed: float | None,
        approach: bool = False,
        planner: Planner | None = None,
    ) -> Json:
        """Run a path whose poses are those of the tool of `planner`; None: of the tool in use."""
        async with self._channel.lease(caller) as lease:
            planner = planner or self._planner
            if approach and stops:
                first = stops[0]
                q = (
                    self._joints(first.q)
                    if first.q is not None
                    else await asyncio.to_thread(planner.joints_at, first.pose or (), self.plan_start())
                )
                arrival = await self._move(lease, q, None, True)
                stops = stops[1:]
                if not stops:
                    return arrival
            plan = await asyncio.to_thread(planner.path, stops, self.plan_start(), speed)
            kind = commands.RunLines if plan.rows[0][KIND] == LINE else commands.RunTrajectory
            return await self._run_plan(lease, kind, plan, self._write(plan), "the path")

    @method(at_once=True)
    async def preview(
        self,
        caller: Caller,
        q: Numbers | None = None,
        pose: Numbers | None = None,
        file: str | None = None,
        speed: float | None = None,
        line: bool = False,
        synchronized: bool = True,
        approach: bool = False,
        stops: tuple[Stop, ...] = (),
        start: Numbers | None = None,
        tool: str | None = None,
    ) -> Json:
        """Plan a motion as `move_joints`, `move_pose`, `run` or `run_path` would, and move nothing.

        It begins where the arm is commanded, or, of a path, at the joint positions `start`, rad; with `tool` it is
        planned as if that tool were in use.
        Returns `path`, configurations along it, rad, `duration_s`, and of lines `length_m` and `slowed`; refused as
        the motion would be, or if its path leads through a box.
        """
        if (q is not None) + (pose is not None) + (file is not None) + bool(stops) != 1:
            raise RtcpError("invalid", "found none or several of q, pose, file and stops, allowed is one of them")
        here = self.plan_start()
        if start is not None:
            check_count("start", start, self._count)
            here = list(start) if stops else here
        names = self._channel.config.tool_names
        planner = self._planner if tool is None else self._planners[index_of("tool", tool, names)]
        if file is not None:
            return await self._with_progress(caller, self._preview_file(planner, file, approach))
        if pose is not None and (line or self._channel.control_mode is ControlMode.CARTESIAN):
            stops = (Stop(pose),)
        elif pose is not None:
            q = tuple(await asyncio.to_thread(planner.joints_at, pose, here))
        if q is not None:
            return await self._preview_move(planner, q, speed, synchronized)
        return await self._with_progress(caller, self._preview_plan(planner, stops, (), here, speed))

    async def _with_progress(self, caller: Caller, work: Coroutine[Any, Any, Json]) -> Json:
        """Carry out long work that moves nothing, and report progress: its caller sees that the platform lives."""
        task = asyncio.ensure_future(work)
        try:
            while not (await asyncio.wait({task}, timeout=_REPORT_S))[0]:
                caller.report(self._channel.progress())
            return task.result()
        finally:
            task.cancel()

    async def _preview_move(
        self, planner: Planner, q: Sequence[float], speed: float | None, synchronized: bool
    ) -> Json:
        check_count("q", q, self._count, _JOINTS)
        planned = await asyncio.to_thread(planner.joint_move, q, self.plan_start(), speed, synchronized)
        if isinstance(planned, refusals.Refusal):
            raise self._channel.error("refused", planned)
        path, duration_s = planned
        return {"path": path, "duration_s": duration_s, "length_m": None, "slowed": None}

    @staticmethod
    async def _preview_plan(
        planner: Planner, stops: Sequence[Stop], points: Sequence[Point], here: Sequence[float], speed: float | None
    ) -> Json:
        """Return the joint positions along a path, or a trajectory, from `here`, rad."""

        def plan() -> tuple[Plan, preview.JointPath]:
            planned = planner.path(stops, here, speed) if stops else planner.trajectory(points, here)
            return planned, planner.joint_path(planned, here)

        planned, path = await asyncio.to_thread(plan)
        return {"path": path, "duration_s": planned.duration_s, "length_m": planned.length_m, "slowed": planned.slowed}

    async def _preview_file(self, planner: Planner, file: str, approach: bool) -> Json:
        """Return the joint positions along a motion file; with `approach` it begins at its first point."""
        points, stops, speed = await asyncio.to_thread(planner.read, file)
        if not (stops or points):
            raise RtcpError("refused", f"{file} holds a program: `rtcp run --dry` plans it", "program")
        if not approach:
            return await self._preview_plan(planner, stops, points, self.plan_start(), speed)
        first = points[0].q if points else stops[0].q
        if first is None:
            first = tuple(await asyncio.to_thread(planner.joints_at, stops[0].pose or (), self.plan_start()))
        start = await self._preview_move(planner, first, None, True)
        if not (points or stops[1:]):
            return start
        rest = await self._preview_plan(planner, stops[1:], points, first, speed)
        return rest | {"path": start["path"] + rest["path"], "duration_s": start["duration_s"] + rest["duration_s"]}

    async def run_command(self, caller: Caller, command: commands.MotionCommand) -> Json:
        """Send a motion command that needs no planning here; return when the arm holds again."""

        def position() -> Json:
            return {"positions": self._channel.joints("actual_position")}

        async with self._channel.lease(caller) as lease:
            return await self._run(lease, command, _UNPLANNED_S, command.name, position)

    async def guide(self, caller: Caller, duration_s: float) -> Json:
        """Let the arm be guided by hand; return when it holds again, and why: `done`, `halted`, or `released`."""
        channel = self._channel
        since = channel.observer.last_event

        def ended() -> Json:
            done = any(isinstance(record.event, Arrived) for record in channel.events(since))
            return {"ended": "done" if done else "halted", "positions": channel.joints("actual_position")}

        async with channel.lease(caller) as lease:
            try:
                return await self._run(lease, commands.Guide(duration_s), _GUIDED_S, "guiding", ended)
            except RtcpError as error:
                if error.reason != PermissionWithdrawn.name:
                    raise
                return {"ended": "released", "positions": channel.joints("actual_position")}

    @method(at_once=True)
    async def fk(self, caller: Caller, q: Numbers) -> Json:
        """Return the `pose` of the tool, x y z, m, rx ry rz, rad, at joint positions, rad."""
        check_count("q", q, self._count, _JOINTS)
        return {"pose": self._planner.pose_at(q)}

    @method(at_once=True)
    async def ik(self, caller: Caller, pose: Numbers, near: Numbers | None = None) -> Json:
        """Return the joint positions `q`, rad, nearest to `near` or to where the arm is, that bring the tool to `pose`.

        Refused with reason `out_of_reach` (`distance`, m), `joint_limited` (`axis`, `joint`), `in_box` (`box`), or
        `no_geometry`.
        """
        if near is not None:
            check_count("near", near, self._count, _JOINTS)
        start = self.plan_start() if near is None else near
        return {"q": await asyncio.to_thread(self._planner.joints_at, pose, start)}

    def _joints(self, q: Sequence[float]) -> Sequence[float]:
        if len(q) != self._count:
            raise RtcpError("invalid", f"the first point has {len(q)} joint positions, the arm has {self._count}")
        return q

    def plan_start(self) -> list[float]:
        """Return the joint positions at the begin of a plan, rad."""
        # In other states the loop refuses the motion: then any begin will do.
        is_commanded = self._channel.state in (State.HOLDING, State.MOVING)
        return self._channel.joints("commanded_position" if is_commanded else "actual_position")

    async def _move(
        self,
        lease: int,
        q: Sequence[float],
        speed: float | None,
        synchronized: bool,
        begun: Callable[[], None] | None = None,
    ) -> Json:
        velocities = self._planner.limits.velocity
        slowest = min(velocities)
        if speed is not None and speed > 0.0:
            slowest = min(slowest, speed)
        command = commands.MoveJoints(tuple(q), max(velocities) if speed is None else speed, synchronized)
        # Four turns at that speed: only a machine that hangs takes longer.
        timeout_s = _TIMEOUT_S + 4 * math.tau / slowest
        arrived = self._arrival(lambda: q, "the move")
        return await self._run(lease, command, timeout_s, "the move", arrived, q, begun)

    def _write(self, plan: Plan) -> int:
        try:
            return self._channel.observer.write_plan(plan.rows)
        except PlanTooLong as error:
            raise RtcpError("refused", str(error)) from None

    async def _run_plan(
        self,
        lease: int,
        command: type[commands.RunTrajectory] | type[commands.RunLines],
        plan: Plan,
        slot: int,
        name: str,
        tolerances: Tolerances | None = None,
        begun: Callable[[], None] | None = None,
    ) -> Json:
        tracking = None
        if tolerances is not None:
            tracking = Tracking(self._channel, tolerances, plan.duration_s, plan.end)
        arrival = self._arrival(lambda: plan.end, name, tracking)
        timeout_s = _TIMEOUT_S + 2 * plan.duration_s
        watch = None if tracking is None else tracking.check
        sent = command(slot, len(plan.rows), tool=plan.tool)
        result = await self._run(lease, sent, timeout_s, name, arrival, plan.end, begun, watch)
        return result | {"duration_s": plan.duration_s, "length_m": plan.length_m, "slowed": plan.slowed}

    async def _run(
        self,
        lease: int,
        command: commands.Command,
        timeout_s: float,
        name: str,
        arrived: Callable[[], T | None],
        goal: Sequence[float] | None = None,
        begun: Callable[[], None] | None = None,
        watch: Callable[[], None] | None = None,
    ) -> T:
        """Send a command and return the value of `arrived` when the arm holds again.

        `begun` is called when it is accepted, `watch` repeatedly from then on; it may raise.
        """
        channel = self._channel
        since = channel.observer.last_event
        at_rest = channel.reaching(State.HOLDING, IN_MOTION, name, since)
        began = rested = False
        motion = object()

        def outcome() -> T | None:
            nonlocal began, rested
            if not began:  # after the loop has accepted it
                began, self._motion, self.goal = True, motion, goal
                if begun is not None:
                    begun()
            if self._motion is not motion:
                raise RtcpError("replaced", f"{name} was replaced by another motion")
            if watch is not None:
                watch()
            if not rested:
                if at_rest() is None:
                    return None
                if ended := channel.early_end(since):
                    raise channel.ended(ended, f"{name} ended before it arrived")
                rested = True
            return arrived()

        try:
            # The timeout grows as the speed override slows the motion down.
            return await channel.run(lease, command, outcome, timeout_s, name, channel.speed_override)
        except asyncio.CancelledError:
            if self._motion is motion and channel.is_shared(lease):
                await channel.accept(0, commands.Halt())  # the lease, whose end would stop it, continues
            raise
        finally:
            if self._motion is motion:
                self.goal = None

    def _arrival(
        self, end: Callable[[], Sequence[float]], name: str, tracking: Tracking | None = None
    ) -> Callable[[], Json | None]:
        """Return an outcome for a motion that begins now: the position of the arm, which has arrived at `end`.

        The motion has failed unless it ended with the event `Arrived`: a halt may come when the setpoints are at the
        end and the joints are not.
        """
        channel = self._channel
        since = channel.observer.last_event

        def poll() -> Json | None:
            ends = [entry.event for entry in channel.events(since) if isinstance(entry.event, Arrived | Stopped)]
            if not ends or not isinstance(ends[-1], Arrived):
                raise channel.ended(ends[-1] if ends else None, f"{name} ended before it arrived")
            positions = channel.joints("actual_position")
            if tracking is not None and not tracking.arrived(positions):
                return None  # `Tracking.check` ends it
            return {"positions": positions, "error": max(abs(a - b) for a, b in zip(positions, end(), strict=True))}

        return poll


def _append(plan: OpenPlan, points: Sequence[Point], rest: bool = False) -> list[tuple[float, ...]]:
    try:
        return plan.append(points, rest)
    except PlanRefused as refused:
        raise RtcpError("refused", str(refused), type(refused).__name__) from None


def _require_pose(pose: Sequence[float], key: str) -> None:
    check_count(key, pose, len(_COORDINATES), ": X Y Z (m) RX RY RZ (rad)")
    for name, number in zip(_COORDINATES, pose, strict=True):
        if not abs(number) <= _LARGEST:
            unit = "rad" if name.startswith("r") else "m"
            allowed = f"{-_LARGEST:g} to {_LARGEST:g} {unit}"
            raise RtcpError("invalid", f"{key}.{name}: found {number:g} {unit}, allowed is {allowed}")
