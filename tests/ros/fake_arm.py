"""A fake arm that records its calls; a motion lasts until the test ends it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rtcp.api import RtcpError
from rtcp.fieldbus.simple_message.messages import Joints, RobotMode, Status, TriState
from rtcp.ros.simple_message.arm import ArmState, Point

HOME = (0.0, 0.25, 1.5, 0.0, 0.5, 0.0)
READY = Status(TriState.TRUE, TriState.FALSE, 0, TriState.FALSE, TriState.FALSE, RobotMode.AUTO, TriState.TRUE)


class FakeTrajectory:
    def __init__(self, arm: FakeArm, ends: asyncio.Future[None]) -> None:
        self._arm, self.ends = arm, ends

    async def append(self, points: Sequence[Point]) -> None:
        self._arm.refuse_or_keep("append", *points)
        if self.ends.done():
            raise RtcpError("refused", "the trajectory has ended")

    async def finish(self) -> None:
        self._arm.refuse_or_keep("finish")

    async def wait(self) -> None:
        await self._arm.moving(self.ends)


class FakeArm:
    """`calls` has the name and the arguments of each call, and "cancelled" for a cancelled task."""

    def __init__(self, positions: Joints = HOME) -> None:
        self.state: ArmState | None = ArmState(1, positions, (0.0,) * len(positions), positions, READY)
        self.calls: list[tuple[Any, ...]] = []
        self.called = asyncio.Event()
        self.refuses: dict[str, RtcpError] = {}
        """Errors by the name of the call that they refuse."""
        self.motion: asyncio.Future[None] | None = None
        self.is_held_by_others = False
        self.stopped = asyncio.Event()
        """Set at the end of a stop."""
        self.stopped.set()

    def set_status(self, **fields: Any) -> None:
        assert self.state is not None
        self.state = replace(self.state, stamp_ns=self.state.stamp_ns + 1, status=replace(self.state.status, **fields))

    def refuse_or_keep(self, name: str, *arguments: Any) -> None:
        self.calls.append((name, *arguments))
        self.called.set()
        if name in self.refuses:
            raise self.refuses[name]

    async def moving(self, ends: asyncio.Future[None]) -> None:
        try:
            await asyncio.shield(ends)
        except asyncio.CancelledError:
            self.calls.append(("cancelled",))
            raise

    def begin(self, name: str, *arguments: Any) -> asyncio.Future[None]:
        self.refuse_or_keep(name, *arguments)
        if self.motion is not None and not self.motion.done():
            self.motion.set_result(None)  # the new motion takes its place
        self.motion = asyncio.get_running_loop().create_future()
        return self.motion

    async def run_trajectory(self, points: Sequence[Point]) -> None:
        await self.moving(self.begin("run_trajectory", *points))

    async def open_trajectory(self, points: Sequence[Point]) -> FakeTrajectory:
        return FakeTrajectory(self, self.begin("open_trajectory", *points))

    async def move_joints(self, positions: Joints) -> None:
        await self.moving(self.begin("move_joints", positions))

    async def halt(self) -> None:
        self.refuse_or_keep("halt")
        await self.stopped.wait()

    async def disable(self) -> None:
        self.refuse_or_keep("disable")
        self.set_status(drives_powered=TriState.FALSE)

    @property
    def names(self) -> list[str]:
        return [call[0] for call in self.calls]

    def arrive(self) -> None:
        assert self.motion is not None
        self.motion.set_result(None)

    def fail(self, error: RtcpError) -> None:
        assert self.motion is not None
        self.motion.set_exception(error)

    async def until(self, *names: str) -> None:
        """Wait until these calls are the last ones; a task is cancelled before or after its stop."""
        while [name for name in self.names if name != "cancelled"][-len(names) :] != list(names):
            self.called.clear()
            await self.called.wait()
