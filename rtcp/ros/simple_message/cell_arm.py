"""All arms of the running cell as one arm for the server: joints in the order of the cell's file, moved in step."""

from __future__ import annotations

import asyncio
import bisect
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import rtcp
from rtcp.api import RtcpError
from rtcp.api.cell import find_cell
from rtcp.fieldbus.simple_message.messages import Joints, Status
from rtcp.ros.group import GroupRobot, GroupStream, merged
from rtcp.ros.simple_message.arm import ArmState, Point
from rtcp.ros.simple_message.robot_arm import NAME, as_json, state_of

_RECONNECT_S = 1.0
_CHECK_S = 0.1
"""Interval between two checks of the connections, s."""
_SETPOINT_S = 0.01
"""Interval between two setpoints of a streamed trajectory, s."""


class CellArm:
    """An `Arm`: connections to all arms of a cell, tried again once a second; `run` has to run as a task.

    Args:
        directory: the runtime directory that holds those of the arms; None: that of the environment.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._directory = directory
        self._robot: GroupRobot | None = None
        self._feeds: list[rtcp.Feed] = []
        self._have_velocity: list[bool] = []
        self._states: list[ArmState | None] = []

    async def run(self) -> None:
        """Keep the connections until cancelled; their end stops the motions commanded over them."""
        while True:
            try:
                await self._follow()
            except RtcpError:
                pass  # `state` is None then
            await asyncio.sleep(_RECONNECT_S)

    async def _follow(self) -> None:
        feeds: list[rtcp.Feed] = []
        try:
            feeds.extend(rtcp.Feed(arm.directory) for arm in find_cell(directory=self._directory).arms)
            async with GroupRobot(NAME, self._directory) as robot:
                self._have_velocity = [feed.config.measures("velocity") for feed in feeds]
                self._robot, self._feeds, self._states = robot, feeds, [None] * len(feeds)
                while robot.is_open and not any(feed.ended(0.0) for feed in feeds):
                    await asyncio.sleep(_CHECK_S)
        finally:
            self._robot, self._feeds, self._have_velocity, self._states = None, [], [], []
            for feed in feeds:
                feed.close()

    @property
    def state(self) -> ArmState | None:
        """The newest cycle records of all arms as one; as old as the oldest of them."""
        is_held = self.is_held_by_others
        for number, (feed, has_velocity) in enumerate(zip(self._feeds, self._have_velocity, strict=True)):
            records, _ = feed.records()
            if len(records):
                self._states[number] = state_of(feed, records[-1], has_velocity, is_held)
        states = [state for state in self._states if state is not None]
        if not states or len(states) < len(self._states):
            return None

        def joined(of_arm: Callable[[ArmState], Joints]) -> Joints:
            rows = [of_arm(state) for state in states]
            return tuple(number for row in rows for number in row) if all(rows) else ()

        return ArmState(
            stamp_ns=min(state.stamp_ns for state in states),
            positions=joined(lambda state: state.positions),
            velocities=joined(lambda state: state.velocities),
            commanded=joined(lambda state: state.commanded),
            status=Status(**merged([state.status for state in states])),
        )

    @property
    def is_held_by_others(self) -> bool:
        """Whether another commander holds the lease of an arm."""
        return any(feed.holder not in ("", NAME) for feed in self._feeds)

    @property
    def _connected(self) -> GroupRobot:
        if self._robot is None:
            raise RtcpError("not running", "the cell is not there: start it with `rtcp cell start`")
        return self._robot

    async def run_trajectory(self, points: Sequence[Point]) -> None:
        """Run a trajectory in step, which replaces the present motion."""
        await self._connected.run_trajectory(as_json(points))

    async def move_joints(self, positions: Joints) -> None:
        """Move in step to joint positions, rad, which replaces the present motion."""
        await self._connected.move_joints(positions)

    async def open_trajectory(self, points: Sequence[Point]) -> CellTrajectory:
        """Begin a trajectory with an open end, which replaces the present motion."""
        robot = self._connected
        start = (await robot.at_rest()).commanded_positions
        return CellTrajectory(await robot.open_stream(), start, points)

    async def halt(self) -> None:
        """Stop along the path."""
        await self._stop(GroupRobot.halt)

    async def disable(self) -> None:
        """Remove the torque of all arms."""
        await self._stop(GroupRobot.disable)

    async def _stop(self, stop: Callable[[GroupRobot], Awaitable[object]]) -> None:
        if self._robot is not None:
            await stop(self._robot)
            return
        async with GroupRobot(NAME, self._directory) as robot:
            await stop(robot)


class CellTrajectory:
    """The open trajectory of a `CellArm`: setpoints of its points, interpolated, in a stream of all arms in step.

    Args:
        stream: the open stream.
        start: positions where the joints are commanded, rad.
        points: its first points, with rising times.
    """

    def __init__(self, stream: GroupStream, start: Joints, points: Sequence[Point]) -> None:
        still = tuple(0.0 for _ in start)
        self._stream = stream
        self._points = [Point(0.0, start, still)]
        self._finished = False
        self._extend(points)
        self._playing = asyncio.ensure_future(self._play())

    def _extend(self, points: Sequence[Point]) -> None:
        self._points += [point for point in points if point.time > self._points[-1].time]

    async def append(self, points: Sequence[Point]) -> None:
        """Append points; raises RtcpError if the trajectory has ended."""
        if self._playing.done():
            raise RtcpError("refused", "the trajectory has ended: its arms are at rest", "not_open")
        self._extend(points)

    async def finish(self) -> None:
        """Come to rest at the last point; return then."""
        self._finished = True
        await asyncio.wait({self._playing})

    async def wait(self) -> None:
        """Return when the arms rest at the last point, or have run out of points; raises RtcpError otherwise."""
        try:
            await asyncio.shield(self._playing)
        finally:
            self._playing.cancel()
            self._stream.close()

    async def _play(self) -> None:
        began = time.monotonic()
        while True:
            elapsed = time.monotonic() - began
            self._stream.send(*self._at(elapsed))
            if elapsed >= self._points[-1].time:
                self._stream.close()
                return
            await asyncio.sleep(_SETPOINT_S)

    def _at(self, elapsed: float) -> tuple[Joints, Joints]:
        """Return positions and velocities at a time, s: a cubic between points with velocities, else a line."""
        index = bisect.bisect_right(self._points, elapsed, key=lambda point: point.time)
        if index == len(self._points):
            last = self._points[-1]
            return last.positions, tuple(0.0 for _ in last.positions)
        before, after = self._points[index - 1], self._points[index]
        span = after.time - before.time
        share = (elapsed - before.time) / span
        slopes = tuple((b - a) / span for a, b in zip(before.positions, after.positions, strict=True))
        starts, ends = before.velocities or slopes, after.velocities or slopes
        positions, velocities = [], []
        for a, slope, v, w in zip(before.positions, slopes, starts, ends, strict=True):
            curve, bend = v - slope, v + w - 2.0 * slope
            positions.append(a + span * share * (slope + (1.0 - share) * (curve - share * bend)))
            velocities.append(slope + curve * (1.0 - 2.0 * share) - bend * share * (2.0 - 3.0 * share))
        return tuple(positions), tuple(velocities)
