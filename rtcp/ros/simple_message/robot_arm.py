"""The arm of the running platform, through the public API."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any

import rtcp
from rtcp.fieldbus.simple_message.messages import Joints, Status, TriState
from rtcp.ros.simple_message.arm import ArmState, Point
from rtcp.ros.state import robot_status

NAME = "Simple Message"
"""Name of the server as a commander."""
_RECONNECT_S = 1.0
_CHECK_S = 0.1
"""Interval between two checks of the connection, s."""
_POLL_S = 0.05
"""Interval between two checks whether a trajectory has ended, s."""
_OVER = ("out_of_points", "not_open")
"""Reasons with which an open trajectory ends at its last point."""


class RobotArm:
    """An `Arm`: a connection to the platform, tried again once a second; `run` has to run as a task."""

    def __init__(self) -> None:
        self._robot: rtcp.AsyncRobot | None = None
        self._feed: rtcp.Feed | None = None
        self._state: ArmState | None = None
        self._has_velocity = False
        self._motions = 0
        """Number of begun motions; the newest one has ended all earlier ones."""

    async def run(self) -> None:
        """Keep the connection until cancelled; its end stops the motion commanded over it."""
        while True:
            try:
                await self._follow()
            except rtcp.RtcpError:
                pass  # `state` is None then
            await asyncio.sleep(_RECONNECT_S)

    async def _follow(self) -> None:
        feed = rtcp.Feed()
        try:
            async with rtcp.connect_async(NAME) as robot:
                self._robot, self._feed, self._has_velocity = robot, feed, feed.config.measures("velocity")
                while robot.is_open and not feed.ended(0.0):
                    await asyncio.sleep(_CHECK_S)
        finally:
            self._robot = self._feed = self._state = None
            feed.close()

    @property
    def state(self) -> ArmState | None:
        """The newest cycle record."""
        if self._feed is not None:
            records, _ = self._feed.records()
            if len(records):
                self._state = state_of(self._feed, records[-1], self._has_velocity, self.is_held_by_others)
        return self._state

    @property
    def is_held_by_others(self) -> bool:
        """Whether another commander holds the lease."""
        return self._feed is not None and self._feed.holder not in ("", NAME)

    @property
    def _connected(self) -> rtcp.AsyncRobot:
        if self._robot is None:
            raise rtcp.RtcpError("not running", "the platform is not there: start it with `rtcp start`")
        return self._robot

    async def run_trajectory(self, points: Sequence[Point]) -> None:
        """Run a trajectory, which replaces the present motion."""
        await self._moved(self._connected.run_trajectory(as_json(points), replace=True))

    async def move_joints(self, positions: Joints) -> None:
        """Move to joint positions, rad, which replaces the present motion."""
        await self._moved(self._connected.move_joints(positions, replace=True))

    async def _moved(self, motion: Awaitable[object]) -> None:
        self._motions += 1
        try:
            await motion
        except rtcp.Replaced:
            pass

    async def open_trajectory(self, points: Sequence[Point]) -> RobotTrajectory:
        """Begin a trajectory with an open end, which replaces the present motion."""
        self._motions += 1
        trajectory = RobotTrajectory(self, self._connected, self._motions)
        await self._connected.open_trajectory(as_json(points), replace=True)
        return trajectory

    async def halt(self) -> None:
        """Stop along the path."""
        await self._stop(rtcp.AsyncRobot.halt)

    async def disable(self) -> None:
        """Remove the torque."""
        await self._stop(rtcp.AsyncRobot.disable)

    async def _stop(self, stop: Callable[[rtcp.AsyncRobot], Awaitable[object]]) -> None:
        if self._robot is not None:
            await stop(self._robot)
            return
        async with rtcp.connect_async(NAME) as robot:
            await stop(robot)

    def is_newest(self, motion: int) -> bool:
        """Whether no motion was begun after this one."""
        return self._motions == motion


class RobotTrajectory:
    """The open trajectory of a `RobotArm`."""

    def __init__(self, arm: RobotArm, robot: rtcp.AsyncRobot, motion: int) -> None:
        self._arm, self._robot, self._motion = arm, robot, motion

    async def append(self, points: Sequence[Point]) -> None:
        """Append points."""
        await self._robot.append(as_json(points))

    async def finish(self) -> None:
        """Come to rest at the last point; return then."""
        await self._robot.finish_trajectory()

    async def wait(self) -> None:
        """Return when the arm has come to rest at the last point; raises RtcpError if the motion ended otherwise."""
        while self._arm.is_newest(self._motion):
            await asyncio.sleep(_POLL_S)
            state = self._arm.state
            if state is not None and state.status.in_motion is TriState.TRUE:
                continue
            try:
                await self._robot.append([])  # its refusal has the reason of the end
            except rtcp.RtcpError as error:
                if error.reason in _OVER or isinstance(error, rtcp.Replaced):
                    return
                raise


def as_json(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Return points as commands of the API take them."""
    rows: list[dict[str, Any]] = []
    for time, positions, velocities, accelerations in points:
        optional = {"v": velocities, "a": accelerations}
        rows.append({"t": time, "q": positions, **{key: value for key, value in optional.items() if value}})
    return rows


def state_of(feed: rtcp.Feed, record: Mapping[str, Any], has_velocity: bool, is_held_by_others: bool) -> ArmState:
    """Return the state of an arm by a cycle record of its feed."""
    status = robot_status(record, int(record["lost"]) * feed.period_ns, int(record["time_ns"]), is_held_by_others)
    return ArmState(
        stamp_ns=status.stamp_ns,
        positions=tuple(map(float, record["actual_position"])),
        velocities=tuple(map(float, record["actual_velocity"])) if has_velocity else (),
        commanded=tuple(map(float, record["commanded_position"])),
        status=Status(
            drives_powered=status.drives_powered,
            e_stopped=status.e_stopped,
            error_code=status.error_code,
            in_error=status.in_error,
            in_motion=status.in_motion,
            mode=status.mode,
            motion_possible=status.motion_possible,
        ),
    )
