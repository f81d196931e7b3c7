"""Motions that have an end: joint moves, poses, straight lines, files. Each returns when the arm is there."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Sequence
from typing import Any

from rtcp.config.model import Point, Stop
from rtcp.gateway.carrier import MOVING, Carrier, CommandFailed, Progress
from rtcp.gateway.planner import Planner
from rtcp.ipc.codes import MotionMode
from rtcp.ipc.layout import COMMAND_NUMBERS
from rtcp.ipc.machine import Command, State
from rtcp.ipc.plans import PlanTooLong
from rtcp.motion.planning.plan import Plan

_SAME_RAD, _SAME_PLANNED_RAD = 1e-9, 1e-4
"""How near the commanded end is to what was asked for: of a move exactly, of a plan as the loop's own sums have it."""
_SETTLED_RAD, _SETTLE_S = 5e-4, 3.0
_PATIENCE_S = 20.0


class Travel:
    """Brings the arm somewhere on behalf of the control socket's clients.

    Args:
        carrier: the way to the loop.
        planner: makes the plans.
    """

    def __init__(self, carrier: Carrier, planner: Planner) -> None:
        self._carrier = carrier
        self._planner = planner
        self._config = carrier.config

    async def move(
        self, client: str, q: Sequence[float], speed: float | None, each: bool, progress: Progress
    ) -> dict[str, Any]:
        """Move to joint positions `q` (rad), all arriving together or, with `each`, each joint at its best."""
        joints = self._config.joints
        if len(q) != len(joints):
            raise CommandFailed("invalid", f"{len(q)} joint positions were given, the arm has {len(joints)} joints")
        async with self._carrier.lease(client) as lease:
            await self._move(lease, q, speed, each, progress)
        return await self._arrival(q, _SAME_RAD)

    async def move_pose(
        self, client: str, pose: Sequence[float], speed: float | None, line: bool, progress: Progress
    ) -> dict[str, Any]:
        """Move the tool to `pose` (m, rad): on a straight line where `line` or the mode says so, else by the joints.

        `speed`: of the line m/s, of the joints rad/s.
        """
        line = line or self._motion() is MotionMode.CARTESIAN
        if line:
            return await self.lines(client, [Stop(tuple(pose))], speed, progress)
        async with self._carrier.lease(client) as lease:
            here = self._commanded()
            q = await asyncio.to_thread(self._planner.joints_at, pose, here)
            await self._move(lease, q, speed, False, progress)
        return await self._arrival(q, _SAME_RAD)

    async def lines(
        self, client: str, stops: Sequence[Stop], speed: float | None, progress: Progress
    ) -> dict[str, Any]:  # fmt: skip
        """Move the tool on straight lines (m/s) to each stop in turn."""
        async with self._carrier.lease(client) as lease:
            plan = await asyncio.to_thread(self._planner.lines, stops, self._commanded(), speed)
            await self._carry_out(lease, Command.LINE, plan, "the path", progress)
        return await self._arrival(plan.end, _SAME_PLANNED_RAD) | _told(plan)

    async def run(self, client: str, file: str, approach: bool, progress: Progress) -> dict[str, Any]:
        """Carry out a motion file; with `approach` the arm first moves to where the motion begins."""
        # In threads, as all planning: leases are renewed meanwhile.
        points, stops, speed = await asyncio.to_thread(self._planner.read, file)
        return await self.follow(client, points, stops or None, speed, approach, progress)

    async def follow(
        self,
        client: str,
        points: Sequence[Point],
        stops: Sequence[Stop] | None,
        speed: float | None,
        approach: bool,
        progress: Progress,
    ) -> dict[str, Any]:
        """Carry out the path to `stops` (`speed`: m/s) or, where they are None, the trajectory through `points`."""
        async with self._carrier.lease(client) as lease:
            if approach and (points or stops):
                first = await self._beginning(points, stops or ())
                await self._move(lease, first, None, False, progress)
                if stops is not None:
                    stops = stops[1:]
                    if not stops:
                        return await self._arrival(first, _SAME_RAD)
            if stops is None:
                plan = await asyncio.to_thread(self._planner.trajectory, points, self._commanded())
                await self._carry_out(lease, Command.TRAJECTORY, plan, "the trajectory", progress)
            else:
                plan = await asyncio.to_thread(self._planner.lines, stops, self._commanded(), speed)
                await self._carry_out(lease, Command.LINE, plan, "the path", progress)
        return await self._arrival(plan.end, _SAME_PLANNED_RAD) | _told(plan)

    async def _beginning(self, points: Sequence[Point], stops: Sequence[Stop]) -> Sequence[float]:
        first = stops[0].q if stops else points[0].q
        count = len(self._config.joints)
        if first is None:
            return await asyncio.to_thread(self._planner.joints_at, stops[0].pose or (), self._commanded())
        if len(first) != count:
            raise CommandFailed("invalid", f"the first point has {len(first)} joint positions, the arm has {count}")
        return first

    async def _move(
        self, lease: int, q: Sequence[float], speed: float | None, each: bool, progress: Progress
    ) -> None:  # fmt: skip
        velocities = self._planner.limits.velocity
        rest = [0.0] * (COMMAND_NUMBERS - 2 - len(q))
        numbers = [*q, *rest, each, max(velocities) if speed is None else speed]
        slowest = min(velocities)
        if speed is not None and math.isfinite(speed) and speed > 0.0:
            slowest = min(slowest, speed)
        # Twice round at that speed and some more: only a machine that hangs takes longer.
        await self._until_there(
            lease, Command.MOVE, numbers, _PATIENCE_S + 4 * math.tau / slowest, "the move", progress
        )  # fmt: skip

    async def _carry_out(self, lease: int, command: Command, plan: Plan, what: str, progress: Progress) -> None:
        try:
            slot = self._carrier.observer.write_plan(plan.rows)
        except PlanTooLong as error:
            raise CommandFailed("refused", str(error)) from None
        numbers = [slot, len(plan.rows)]
        await self._until_there(lease, command, numbers, _PATIENCE_S + 2 * plan.duration_s, what, progress)

    async def _until_there(
        self, lease: int, command: Command, numbers: Sequence[float], patience_s: float, what: str, progress: Progress
    ) -> None:
        event = self._carrier.last_event()
        await self._carrier.give(lease, command, numbers)
        await self._carrier.until(State.HOLDING, MOVING, patience_s, what, progress, since=event)
        if ended := self._carrier.ended_since(event):
            raise CommandFailed("fault", f"{what} ended before it arrived: {self._carrier.sentence(ended)}")

    def _commanded(self) -> list[float]:
        if self._carrier.picture.state() is not State.HOLDING:
            # What is refused anyway is refused by the loop, in its words: the plan only has to begin somewhere.
            return self._carrier.joints("position")[: len(self._config.joints)]
        return self._carrier.joints("target")[: len(self._config.joints)]

    def _motion(self) -> MotionMode | None:
        latest = self._carrier.observer.latest()
        found = 0 if latest is None else int(latest[0]["motion"])
        return MotionMode(found) if found in tuple(MotionMode) else None

    async def _arrival(self, q: Sequence[float], same_rad: float) -> dict[str, Any]:
        """Return where the arm is, once the following error between that and what was asked for has died away."""
        count = len(self._config.joints)
        target = self._carrier.joints("target")[:count]
        if max(abs(a - b) for a, b in zip(target, q, strict=True)) > same_rad:
            raise CommandFailed("fault", f"the move ended before it arrived: {self._carrier.last_sentence()}")
        until = time.monotonic() + _SETTLE_S
        while True:
            position = self._carrier.joints("position")[:count]
            error = max(abs(a - b) for a, b in zip(position, q, strict=True))
            if error <= _SETTLED_RAD or time.monotonic() >= until:
                return {"q": position, "error": error}
            await asyncio.sleep(0.02)


def _told(plan: Plan) -> dict[str, Any]:
    return {"duration_s": plan.duration_s, "length_m": plan.length_m, "slowed": plan.slowed}
