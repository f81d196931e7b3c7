"""The arms of a cell, commanded from asyncio: as `Cell`, but an arm that does not run does not affect the others."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, TypeVar

from rtcp.api.async_robot import AsyncRobot
from rtcp.api.cell import StepPlan, most_telling
from rtcp.api.results import Arrival, result
from rtcp.config.cell import CellConfig
from rtcp.ipc.runtime_directory import control_socket

T = TypeVar("T")


class AsyncCell:
    """The arms of a cell. Every command connects anew, to all arms at once; cancelling it ends its motions.

    Args:
        config: the cell.
        name: of this commander, shown to others that are refused; empty: this process.

    Raises:
        RtcpError: by every command when all arms have answered: the first cause, with the arm's name.
    """

    def __init__(self, config: CellConfig, name: str = "") -> None:
        self.config = config
        self._name = name

    async def enable(self) -> None:
        """Enable all arms; where one cannot be enabled, disable those that this call has enabled."""
        outcomes = await self.attempt(self._all(AsyncRobot.enable))
        enabled = [name for name, outcome in outcomes.items() if not isinstance(outcome, BaseException)]
        if len(enabled) < len(outcomes):
            await self.attempt(dict.fromkeys(enabled, AsyncRobot.disable))
        _results(outcomes)

    async def disable(self) -> None:
        """Stop all arms and remove their torque. Needs no lease."""
        _results(await self.attempt(self._all(AsyncRobot.disable)))

    async def halt(self) -> dict[str, BaseException]:
        """Stop every motion of every arm, whoever began it; return the errors by arm. Needs no lease."""
        outcomes = await self.attempt(self._all(AsyncRobot.halt))
        return {name: outcome for name, outcome in outcomes.items() if outcome is not None}

    async def reset(self) -> None:
        """Leave the faults of all arms."""
        _results(await self.attempt(self._all(AsyncRobot.reset)))

    async def move_joints(self, q: Mapping[str, Sequence[float]], speed: float | None = None) -> dict[str, Arrival]:
        """Move joints of several arms in step; arguments as of `Cell.move_joints`."""
        targets = [{"arm": name, "q": list(joints)} for name, joints in q.items()]
        first, asked_ns = self.config.arms[0].name, time.monotonic_ns()
        planned = await self.attempt({first: lambda robot: robot.command("plan_in_step", targets=targets, speed=speed)})
        plan, motion = StepPlan.from_json(_results(planned)[first], asked_ns), time.monotonic_ns()

        def runner(name: str) -> Callable[[AsyncRobot], Awaitable[dict[str, Any]]]:
            return lambda robot: robot.command("run_in_step", **plan.fields_of(name, motion))

        outcomes = await self.attempt({name: runner(name) for name in plan.arms})
        return {name: result(Arrival, answer) for name, answer in _results(outcomes).items()}

    async def attempt(self, calls: Mapping[str, Callable[[AsyncRobot], Awaitable[T]]]) -> dict[str, T | BaseException]:
        """Call a method of each named arm, all at once; return each result or exception."""

        async def attempt(name: str, call: Callable[[AsyncRobot], Awaitable[T]]) -> T:
            async with AsyncRobot(self._name, control_socket(self.config.member(name).directory)) as robot:
                return await call(robot)

        outcomes = await asyncio.gather(*(attempt(*item) for item in calls.items()), return_exceptions=True)
        return dict(zip(calls, outcomes, strict=True))

    def _all(self, call: Callable[[AsyncRobot], Awaitable[T]]) -> dict[str, Callable[[AsyncRobot], Awaitable[T]]]:
        return {member.name: call for member in self.config.members}


def _results(outcomes: Mapping[str, T | BaseException]) -> dict[str, T]:
    """Return the results; raise the most telling error."""
    if failed := {name: outcome for name, outcome in outcomes.items() if isinstance(outcome, BaseException)}:
        raise most_telling(failed)
    return {name: outcome for name, outcome in outcomes.items() if not isinstance(outcome, BaseException)}
