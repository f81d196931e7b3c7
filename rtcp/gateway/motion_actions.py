"""Motions that have an end: joint moves, poses, straight lines, files. Planned and checked whole before they begin."""

from __future__ import annotations

import asyncio
import bisect
import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import Pose, times
from rtcp.config.model import ArmConfig, ConfigError, Point, Stop
from rtcp.gateway.command_channel import IN_MOTION, Caller, CommandChannel, Json
from rtcp.gateway.tolerances import Tolerances, Tracking, Violation
from rtcp.ipc.commands import (
    Command,
    ExtendTrajectory,
    Guide,
    Halt,
    MotionCommand,
    MoveJoints,
    RunInStep,
    RunLines,
    RunTrajectory,
)
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import Arrived, PermissionWithdrawn
from rtcp.ipc.layout import PLAN_ROWS, PlanTooLong
from rtcp.ipc.names import Names
from rtcp.ipc.refusals import (
    NoLease,
    NoRoomForPoints,
    NotOpen,
    NoTrajectory,
    PositionOutOfRange,
    Refusal,
    SpeedOutOfRange,
    WrongState,
)
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
_LARGEST = 100.0
"""m or rad of a pose: further away is no arm, and the remainder of larger angles would be noise of the number."""
_SAME_RAD, _SAME_PLANNED_RAD = 1e-6, 1e-4
"""Distance of the commanded end from the goal: of a move below what a drive counts, of a plan as the loop sums up."""
_SETTLED_RAD, _SETTLE_S = 5e-4, 3.0
_TIMEOUT_S = 20.0
LONGEST_OPEN_S = 86_400.0
"""Longest open trajectory."""
_LOOK_S, _AHEAD_S = 0.01, 0.05
"""How often an open trajectory is looked at; and how long before its last row the arm is brought to rest there."""
_GONE = (NotOpen.name, NoLease.name, WrongState.name)
"""What the loop refuses more points with once the trajectory has ended."""
_KEPT_ROWS = 3
"""Rows of the plan area beside those ahead: the one that the arm comes from, one for a point that waits, one more."""
_GUIDED_S = 3700.0
"""Longer than an arm may be guided."""
_UNPLANNED_S = 600.0
"""Longest motion of a package's own command."""


class Planner:
    """Makes plans for one arm with one tool under the limits in force.

    Every method raises RtcpError: `refused` for what this arm cannot do, `invalid` for what no arm could.

    Args:
        config: the arm.
        limits: in force now; changed elsewhere.
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
        boxes = self._config.cartesian.keep_out
        return f"the keep-out box {boxes[box].name}" if 0 <= box < len(boxes) else "the space outside the Cartesian box"

    def joints_at(self, pose: Sequence[float], q_now: Sequence[float]) -> list[float]:
        """Return the joint positions, rad, nearest to `q_now` that bring the tool to `pose` (m, rad)."""
        _require_pose(pose, "pose")
        found = InverseKinematics(self._model()).solve_near(Pose.from_xyzrpy(*pose), q_now)
        message, fields = f"the pose cannot be reached: {found.reason}", {"distance": found.out_of_reach}
        if found.q is None and found.limited >= 0:
            joint = self._config.joints[found.limited].name
            raise RtcpError("refused", message, "joint_limited", {"axis": found.limited, "joint": joint})
        if found.q is None:
            raise RtcpError("refused", message, "out_of_reach", fields)
        if box := self._zone_at(found.q):
            message = f"the pose cannot be reached: the arm would be in {box}"
            raise RtcpError("refused", message, "in_box", {"box": box})
        return list(found.q)

    def moved_by(self, q: Sequence[float], offset: Sequence[float], frame: JogFrame) -> Pose:
        """Return the tool's pose at `q`, rad, moved and turned along the axes of the base or of the tool (m, rad)."""
        here, moved = forward(self._model(), q), Pose.from_xyzrpy(*offset)
        if frame is JogFrame.TOOL:
            return here @ moved
        x, y, z = (a + b for a, b in zip(here.position, moved.position, strict=True))
        return Pose((x, y, z), times(moved.rotation, here.rotation))

    def pose_at(self, q: Sequence[float]) -> list[float]:
        """Return the pose of the tool, x y z, m, rx ry rz, rad, at joint positions, rad, inside the limits or not."""
        pose = forward(self._model(), q)
        return [*pose.position, *pose.rpy]

    def path(self, stops: Sequence[Stop], q_now: Sequence[float], speed: float | None) -> Plan:
        """Return the plan of a path from `q_now` to each stop in turn, its lines and arcs at most at `speed`, m/s.

        Straight lines with a rest at each stop are rows for `RunLines`, anything else is a trajectory.
        """
        for at, stop in enumerate(stops):
            if stop.pose is not None:
                _require_pose(stop.pose, f"poses[{at}]")
        model, cartesian = self._model(), self._config.cartesian
        plain = all(stop.via is None and not stop.by_joints and not stop.blend for stop in stops)
        try:
            if plain:
                if len(stops) > MOST_LINES:
                    found = f"the path has {len(stops)} lines with a rest after each, allowed are {MOST_LINES}"
                    raise PlanRefused(f"{found}; with blends it is one motion")
                plan = plan_lines(model, self.limits, cartesian, q_now, stops, speed=speed, zone_at=self._zone_at)
            else:
                from rtcp.motion.planning.path import plan_path  # here: scipy loads slowly, and few need it

                plan = plan_path(model, self.limits, cartesian, q_now, stops, speed=speed, zone_at=self._zone_at)
            return dataclasses.replace(plan, tool=self.tool)
        except PlanRefused as refused:
            raise RtcpError("refused", str(refused), type(refused).__name__) from None

    def trajectory(self, points: Sequence[Point], q_now: Sequence[float], moving: bool = False) -> Plan:
        """Return the plan of a trajectory that begins at `q_now`; or, `moving`, on the way there."""
        names = [joint.name for joint in self._config.joints]
        try:
            plan = plan_trajectory(points, self.limits, q_now, names=names, zone_at=self._zone_at, moving=moving)
            return dataclasses.replace(plan, tool=self.tool)
        except PlanRefused as refused:
            raise RtcpError("refused", str(refused), type(refused).__name__) from None

    def open_plan(self, q_now: Sequence[float], moving: bool) -> OpenPlan:
        """Return the plan of an open trajectory that begins at `q_now`; or, `moving`, on the way there."""
        names = [joint.name for joint in self._config.joints]
        return OpenPlan(self.limits, q_now, names=names, zone_at=self._zone_at, moving=moving)

    def joint_move(
        self, q: Sequence[float], q_now: Sequence[float], speed: float | None, synchronized: bool
    ) -> tuple[preview.JointPath, float] | Refusal:
        """Return the way of a joint move and its duration, s; or what the loop would refuse it with.

        Raises:
            RtcpError: `refused`: its way leads through a box, where a guard would stop it.
        """
        low, high, fastest = self.limits.low, self.limits.high, max(self.limits.velocity)
        if speed is not None and not 0.0 < speed <= fastest:
            return SpeedOutOfRange(speed, fastest)
        for axis, wanted in enumerate(q):
            if not low[axis] <= wanted <= high[axis]:
                return PositionOutOfRange(axis, wanted, high[axis] if wanted > high[axis] else low[axis])
        found = preview.joint_move(self.limits, q_now, q, fastest if speed is None else speed, synchronized)
        if found is None:
            return NoTrajectory(fastest if speed is None else speed, LONGEST_S)
        for at, row in enumerate(found[0]):
            if box := self._zone_at(row):
                where = "at its end" if row == found[0][-1] else f"after {found[1] * at / len(found[0]):.1f} s"
                raise RtcpError("refused", f"the move leads through {box} ({where}): choose another target or way")
        return found

    def way(self, plan: Plan, q_now: Sequence[float]) -> preview.JointPath:
        """Return the joints along a plan."""
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
        self.turn = asyncio.Lock()
        self.ends = False


class MotionActions:
    """Moves the arm on behalf of the clients; every method raises RtcpError.

    Args:
        channel: the way to the loop.
        planners: make the plans, one with each tool.
    """

    def __init__(self, channel: CommandChannel, planners: Sequence[Planner]) -> None:
        self._channel = channel
        self._planners = planners
        self._count = len(channel.config.joints)
        self.goal: Sequence[float] | None = None
        """Joint positions to which the call under way moves, rad, until it returns; None: none, or a package's own."""
        self._motion: object = None
        """The motion that the loop accepted last."""
        self._open: dict[int, _Open] = {}
        """Open trajectories by connection; one that has ended stays until its connection is told."""

    @property
    def _planner(self) -> Planner:
        """Makes plans with the tool in use."""
        return self._planners[self._channel.tool()]

    async def move_joints(self, caller: Caller, q: Sequence[float], speed: float | None, synchronized: bool) -> Json:
        """Move to joint positions, rad; `speed`: of the fastest joint, rad/s."""
        self._require_joints(q, "q")
        async with self._channel.lease(caller) as lease:
            return await self._move(lease, q, speed, synchronized, self._says_accepted(caller))

    def _says_accepted(self, caller: Caller) -> Callable[[], None]:
        """Return what reports that the loop has accepted a motion: progress before may be of one that it replaces."""
        return lambda: caller.report({**self._channel.progress(), "accepted": True})

    async def move_pose(self, caller: Caller, pose: Sequence[float], speed: float | None, line: bool) -> Json:
        """Move the tool to a pose (m, rad): on a straight line where `line` or the control mode says so, else by the
        joints."""
        if line or self._channel.control_mode is ControlMode.CARTESIAN:
            return await self.run_path(caller, [Stop(tuple(pose))], speed, False)
        async with self._channel.lease(caller) as lease:
            q = await asyncio.to_thread(self._planner.joints_at, pose, self.plan_start())
            return await self._move(lease, q, speed, True)

    async def move_by(self, caller: Caller, offset: Sequence[float], frame: JogFrame, speed: float | None) -> Json:
        """Move by an offset from where the arm is commanded: the tool on a line, m and rad, or the joints, rad."""
        here = self.plan_start()
        count = len(here) if frame is JogFrame.JOINTS else len(_COORDINATES)
        if len(offset) != count:
            raise RtcpError("invalid", f"offset: found {len(offset)} numbers, allowed are {count}")
        if frame is JogFrame.JOINTS:
            return await self.move_joints(caller, [a + b for a, b in zip(here, offset, strict=True)], speed, True)
        _require_pose(offset, "offset")
        for name, angle in zip(_COORDINATES[3:], offset[3:], strict=True):
            if not abs(angle) < math.pi:
                text = (
                    f"offset.{name}: found {angle:g} rad, allowed is less than half a turn: a line takes the short way"
                )
                raise RtcpError("invalid", text)
        planner = self._planner
        goal = planner.moved_by(here, offset, frame)
        return await self.run_path(caller, [Stop((*goal.position, *goal.rpy))], speed, False, planner)

    async def run_file(self, caller: Caller, file: str, approach: bool) -> Json:
        """Run a motion file."""
        # In a thread, as all planning: leases are renewed meanwhile.
        points, stops, speed = await asyncio.to_thread(self._planner.read, file)
        if not (stops or points):
            text = f"{file} holds a program, which steps of a client run: `rtcp run` or `rtcp.Program`"
            raise RtcpError("refused", text, "program")
        if stops:
            return await self.run_path(caller, stops, speed, approach)
        return await self.run_trajectory(caller, points, approach)

    async def run_trajectory(
        self,
        caller: Caller,
        points: Sequence[Point],
        approach: bool,
        tolerances: Tolerances | None = None,
        start_rad: float = 0.0,
    ) -> Json:
        """Run a trajectory; with `approach` the joints first move to its first point.

        One that begins at time 0 at most `start_rad` from where the arm is commanded begins where it is.
        """
        async with self._channel.lease(caller) as lease:
            moving = self._channel.state is State.MOVING and not approach
            begin = self._joints(points[0].q) if approach and points else self.plan_start()
            at_once = not moving and points and points[0].t == 0.0 and len(points[0].q) == len(begin)
            if at_once and max(abs(a - b) for a, b in zip(points[0].q, begin, strict=True)) <= start_rad:
                points = [dataclasses.replace(points[0], q=tuple(begin)), *points[1:]]
            # Before the approach: of a trajectory that is refused nothing moves.
            plan = await asyncio.to_thread(self._planner.trajectory, points, begin, moving)
            slot = self._write(plan)
            if approach:
                await self._move(lease, begin, None, True)
            try:
                accepted = self._says_accepted(caller)
                return await self._run_plan(lease, RunTrajectory, plan, slot, "the trajectory", tolerances, accepted)
            except Violation as violation:
                await self._brake()
                raise violation.error from None

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
            command = RunInStep(slot, len(plan.rows), motion, partners, start_ns, len(brakes), brake_step_s, plan.tool)
            what = "the motion in step"
            arrival = self._arrival(plan.end, _SAME_PLANNED_RAD, what)
            timeout_s = _TIMEOUT_S + 2 * plan.duration_s
            found = await self._run(lease, command, timeout_s, what, arrival, plan.end, self._says_accepted(caller))
            return found | {"duration_s": plan.duration_s, "length_m": plan.length_m, "slowed": plan.slowed}

    async def _brake(self) -> None:
        """Stop along the path and wait until the arm holds."""
        channel = self._channel
        rest = channel.reaching(State.HOLDING, IN_MOTION, "the stop", channel.observer.last_event)
        with contextlib.suppress(RtcpError):
            await channel.run(0, Halt(), rest, _SETTLE_S, "the stop")

    # -- trajectories that are open at their end -----------------------------------------------------------------------

    async def open_trajectory(self, caller: Caller, points: Sequence[Point]) -> Json:
        """Begin a trajectory to which points are appended; return when the loop has accepted it."""
        accepted: asyncio.Future[_Open] = asyncio.get_running_loop().create_future()
        task = asyncio.create_task(self._run_open(caller, points, accepted))
        task.add_done_callback(lambda task: task.cancelled() or task.exception())  # nobody may ask how it ended
        either: list[asyncio.Future[Any]] = [task, accepted]
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            task.cancel()  # nobody would know of it, and it would keep the lease
            raise
        if not accepted.done():
            task.result()  # raises why
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
                # No point after the second could come in time to give it a velocity.
                rows += await asyncio.to_thread(_append, plan, (), True)
            opened = _Open(plan, lease, channel.observer.write_plan(rows))
            resting: asyncio.Task[None] | None = None

            arrival: Callable[[], Json | None] | None = None

            def arrived() -> Json | None:
                nonlocal arrival
                if arrival is None:  # once: where it ends is known only now, and its patience counts from now
                    arrival = self._arrival(plan.end, _SAME_PLANNED_RAD, "the trajectory")
                return arrival()

            def begun() -> None:
                nonlocal resting
                accepted.set_result(opened)
                resting = asyncio.create_task(self._rest_in_time(opened))

            command = RunTrajectory(opened.slot, len(rows), open=True, tool=planner.tool)
            try:
                return await self._run(lease, command, LONGEST_OPEN_S, "the trajectory", arrived, begun=begun)
            finally:
                if resting is not None:
                    resting.cancel()

    async def append(self, caller: Caller, points: Sequence[Point]) -> Json:
        """Append points to the open trajectory of this connection."""
        opened = self._opened(caller)
        try:
            await self._extend(opened, points)
        except RtcpError as error:
            if error.reason in _GONE and opened.motion is not None:
                # It ended while the points were looked at: why is the answer.
                await asyncio.wait([opened.motion], timeout=_SETTLE_S)
                self._opened(caller)
            raise
        return self._buffered(opened)

    async def finish_trajectory(self, caller: Caller) -> Json:
        """End the open trajectory of this connection with its last point; return when the arm is there."""
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
            raise self._channel.error("refused", NotOpen())
        if opened.motion.done():
            del self._open[caller.connection]
            opened.motion.result()  # raises why it has ended
            raise self._channel.error("refused", NotOpen())
        return opened

    async def _extend(self, opened: _Open, points: Sequence[Point], rest: bool = False, ends: bool = False) -> None:
        async with opened.turn:
            plan, first = opened.plan, len(opened.plan.times)
            if len(points) > self._room(plan):
                most = PLAN_ROWS - _KEPT_ROWS
                raise self._channel.error("refused", NoRoomForPoints(most - self._room(plan) + len(points), most))
            rows = await asyncio.to_thread(_append, plan, points, rest)
            self._channel.observer.extend_plan(opened.slot, first, rows)
            # Also without a row: the loop knows whether it has ended.
            await self._channel.accept(opened.lease, ExtendTrajectory(len(plan.times), ends))

    async def _rest_in_time(self, opened: _Open) -> None:
        """Let the arm rest at the last point where the next does not come in time to give it a velocity."""
        while not opened.ends:
            await asyncio.sleep(_LOOK_S)
            if opened.plan.waits and self._channel.ahead_s() < _AHEAD_S:
                with contextlib.suppress(RtcpError):
                    await self._extend(opened, (), rest=True)

    def _buffered(self, opened: _Open) -> Json:
        return {"room": self._room(opened.plan), "ahead_s": self._channel.ahead_s()}

    def _room(self, plan: OpenPlan) -> int:
        """Return how many points still fit beside the rows that the arm has not passed."""
        passed = bisect.bisect_left(plan.times, plan.times[-1] - self._channel.ahead_s())
        return PLAN_ROWS - _KEPT_ROWS - len(plan.times) + passed

    async def run_path(
        self,
        caller: Caller,
        stops: Sequence[Stop],
        speed: float | None,
        approach: bool,
        planner: Planner | None = None,
    ) -> Json:
        """Run a path to each stop in turn; with `approach` the joints first move to the first one.

        Its poses are those of the tool of `planner`; None: of the tool in use.
        """
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
            kind = RunLines if plan.rows[0][KIND] == LINE else RunTrajectory
            return await self._run_plan(lease, kind, plan, self._write(plan), "the path")

    def _planner_of(self, tool: int | None) -> Planner:
        return self._planner if tool is None else self._planners[tool]

    async def preview(
        self,
        q: Sequence[float] | None,
        stops: Sequence[Stop],
        points: Sequence[Point],
        speed: float | None,
        synchronized: bool,
        start: Sequence[float] | None = None,
        tool: int | None = None,
    ) -> Json:
        """Return the way of a motion to `q`, of a path, or of a trajectory, from now on, or from `start`, rad.

        It is planned with the tool of this number; None: with the one in use.
        """
        planner = self._planner_of(tool)
        here = self.plan_start() if start is None else list(start)
        if q is not None:
            self._require_joints(q, "q")
            found = await asyncio.to_thread(planner.joint_move, q, here, speed, synchronized)
            if isinstance(found, Refusal):
                raise self._channel.error("refused", found)
            path, duration_s = found
            return {"path": path, "duration_s": duration_s, "length_m": None, "slowed": None}

        def plan() -> tuple[Plan, preview.JointPath]:
            made = planner.path(stops, here, speed) if stops else planner.trajectory(points, here)
            return made, planner.way(made, here)

        made, path = await asyncio.to_thread(plan)
        return {"path": path, "duration_s": made.duration_s, "length_m": made.length_m, "slowed": made.slowed}

    async def preview_pose(
        self, pose: Sequence[float], speed: float | None, line: bool, tool: int | None = None
    ) -> Json:
        """Return the way of the tool to a pose: on a straight line, or by the joints."""
        if line or self._channel.control_mode is ControlMode.CARTESIAN:
            return await self.preview(None, [Stop(tuple(pose))], (), speed, True, tool=tool)
        q = await asyncio.to_thread(self._planner_of(tool).joints_at, pose, self.plan_start())
        return await self.preview(q, (), (), speed, True, tool=tool)

    async def preview_file(self, file: str, approach: bool, tool: int | None = None) -> Json:
        """Return the way of a motion file; with `approach` it begins at its first point."""
        planner = self._planner_of(tool)
        points, stops, speed = await asyncio.to_thread(planner.read, file)
        if not (stops or points):
            raise RtcpError("refused", f"{file} holds a program: `rtcp run --dry` plans it", "program")
        if not approach:
            return await self.preview(None, stops, points, speed, True, tool=tool)
        first = points[0].q if points else stops[0].q
        if first is None:
            first = tuple(await asyncio.to_thread(planner.joints_at, stops[0].pose or (), self.plan_start()))
        way = await self.preview(first, (), (), None, True, tool=tool)
        rest = stops[1:]

        def plan() -> tuple[Plan | None, preview.JointPath]:
            if not (points or rest):
                return None, []
            made = planner.path(rest, first, speed) if stops else planner.trajectory(points, first)
            return made, planner.way(made, first)

        made, path = await asyncio.to_thread(plan)
        if made is None:
            return way
        duration_s = way["duration_s"] + made.duration_s
        return {"path": way["path"] + path, "duration_s": duration_s, "length_m": made.length_m, "slowed": made.slowed}

    async def run_command(self, caller: Caller, command: MotionCommand) -> Json:
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
                return await self._run(lease, Guide(duration_s), _GUIDED_S, "guiding", ended)
            except RtcpError as error:
                if error.reason != PermissionWithdrawn.name:
                    raise
                return {"ended": "released", "positions": channel.joints("actual_position")}

    async def fk(self, q: Sequence[float]) -> Json:
        """Return the pose of the tool at joint positions, rad."""
        self._require_joints(q, "q")
        return {"pose": self._planner.pose_at(q)}

    async def ik(self, pose: Sequence[float], near: Sequence[float] | None) -> Json:
        """Return the joint positions nearest to `near`, or to where the arm is, that bring the tool to a pose."""
        if near is not None:
            self._require_joints(near, "near")
        start = self.plan_start() if near is None else near
        return {"q": await asyncio.to_thread(self._planner.joints_at, pose, start)}

    def _require_joints(self, q: Sequence[float], key: str) -> None:
        if len(q) != self._count:
            raise RtcpError("invalid", f"{key}: found {len(q)} numbers, allowed are {self._count}: one a joint, rad")

    def _joints(self, q: Sequence[float]) -> Sequence[float]:
        if len(q) != self._count:
            raise RtcpError("invalid", f"the first point has {len(q)} joint positions, the arm has {self._count}")
        return q

    def plan_start(self) -> list[float]:
        """Return where a plan begins, rad."""
        # What is refused anyway is refused by the loop: then the plan only has to begin somewhere.
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
        command = MoveJoints(tuple(q), max(velocities) if speed is None else speed, synchronized)
        # Twice round at that speed and some more: only a machine that hangs takes longer.
        timeout_s = _TIMEOUT_S + 4 * math.tau / slowest
        arrived = self._arrival(q, _SAME_RAD, "the move")
        return await self._run(lease, command, timeout_s, "the move", arrived, q, begun)

    def _write(self, plan: Plan) -> int:
        try:
            return self._channel.observer.write_plan(plan.rows)
        except PlanTooLong as error:
            raise RtcpError("refused", str(error)) from None

    async def _run_plan(
        self,
        lease: int,
        command: type[RunTrajectory] | type[RunLines],
        plan: Plan,
        slot: int,
        what: str,
        tolerances: Tolerances | None = None,
        begun: Callable[[], None] | None = None,
    ) -> Json:
        tracking = None
        if tolerances is not None:
            tracking = Tracking(self._channel, tolerances, plan.duration_s, plan.end)
        arrival = self._arrival(plan.end, _SAME_PLANNED_RAD, what, tracking)
        timeout_s = _TIMEOUT_S + 2 * plan.duration_s
        watch = None if tracking is None else tracking.look
        sent = command(slot, len(plan.rows), tool=plan.tool)
        found = await self._run(lease, sent, timeout_s, what, arrival, plan.end, begun, watch)
        return found | {"duration_s": plan.duration_s, "length_m": plan.length_m, "slowed": plan.slowed}

    async def _run(
        self,
        lease: int,
        command: Command,
        timeout_s: float,
        what: str,
        arrived: Callable[[], T | None],
        goal: Sequence[float] | None = None,
        begun: Callable[[], None] | None = None,
        watch: Callable[[], None] | None = None,
    ) -> T:
        """Send a command and return what `arrived` finds when the arm holds again.

        `begun` is called when it is accepted, `watch` again and again from then on; that may raise.
        """
        channel = self._channel
        since = channel.observer.last_event
        at_rest = channel.reaching(State.HOLDING, IN_MOTION, what, since)
        began = rested = False
        motion = object()

        def outcome() -> T | None:
            nonlocal began, rested
            if not began:  # only once the loop has accepted it
                began, self._motion, self.goal = True, motion, goal
                if begun is not None:
                    begun()
            if self._motion is not motion:
                raise RtcpError("replaced", f"{what} was replaced by another motion")
            if watch is not None:
                watch()
            if not rested:
                if at_rest() is None:
                    return None
                if ended := channel.early_end(since):
                    raise channel.ended(ended, f"{what} ended before it arrived")
                rested = True
            return arrived()

        try:
            # A motion that the speed override slows down has so much more time.
            return await channel.run(lease, command, outcome, timeout_s, what, channel.speed_override)
        except asyncio.CancelledError:
            if self._motion is motion and channel.is_shared(lease):
                await channel.accept(0, Halt())  # the lease does not end, with which it would stop
            raise
        finally:
            if self._motion is motion:
                self.goal = None

    def _arrival(
        self, q: Sequence[float], same_rad: float, what: str, tracking: Tracking | None = None
    ) -> Callable[[], Json | None]:
        """Return an outcome: where the arm is, once the following error has died away or is inside the tolerances."""
        channel, until = self._channel, 0.0

        def look() -> Json | None:
            nonlocal until
            if not until:
                until = time.monotonic() + _SETTLE_S
                commanded = channel.joints("commanded_position")
                if max(abs(a - b) for a, b in zip(commanded, q, strict=True)) > same_rad:
                    last = channel.events(channel.observer.last_event - 1)
                    raise channel.ended(last[-1].event if last else None, f"{what} ended before it arrived")
            positions = channel.joints("actual_position")
            error = max(abs(a - b) for a, b in zip(positions, q, strict=True))
            if tracking is not None:
                if not tracking.arrived(positions):
                    return None  # `look` ends it
            elif error > _SETTLED_RAD and time.monotonic() < until:
                return None
            return {"positions": positions, "error": error}

        return look


def _append(plan: OpenPlan, points: Sequence[Point], rest: bool = False) -> list[tuple[float, ...]]:
    try:
        return plan.append(points, rest)
    except PlanRefused as refused:
        raise RtcpError("refused", str(refused), type(refused).__name__) from None


def _require_pose(pose: Sequence[float], key: str) -> None:
    if len(pose) != len(_COORDINATES):
        raise RtcpError("invalid", f"{key}: found {len(pose)} numbers, allowed are 6: X Y Z (m) RX RY RZ (rad)")
    for name, number in zip(_COORDINATES, pose, strict=True):
        if not abs(number) <= _LARGEST:
            unit = "rad" if name.startswith("r") else "m"
            allowed = f"{-_LARGEST:g} to {_LARGEST:g} {unit}"
            raise RtcpError("invalid", f"{key}.{name}: found {number:g} {unit}, allowed is {allowed}")
