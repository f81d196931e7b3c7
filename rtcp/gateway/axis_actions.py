"""Motions of external axes: each ends by itself, with a stop, or with the lease of the connection that began it."""

from __future__ import annotations

import asyncio
import math
from typing import Annotated

from annotated_types import Gt, Le

from rtcp.gateway.command_channel import BROKEN, Caller, CommandChannel, Json, Lease
from rtcp.gateway.machine_actions import MachineActions
from rtcp.gateway.method import HOLD_S, index_of, left, method
from rtcp.ipc.commands import LONGEST_RUN_S, Command, HomeAxis, MoveAxis, RunAxis, StopAxis
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import AxisAtRest, AxisFailed, Homed, HomedElsewhere, HomingFailed
from rtcp.ipc.schema import identifier

_ENDS = (AxisAtRest, AxisFailed, Homed, HomedElsewhere, HomingFailed)


def _endless() -> RtcpError:
    raise AssertionError("the loop limits the time of each motion")


class AxisActions:
    """Carries out the motions of external axes; every method raises RtcpError.

    Args:
        channel: to the loop.
        machine: reads the home offsets of the drives.
    """

    def __init__(self, channel: CommandChannel, machine: MachineActions) -> None:
        self._channel = channel
        self._machine = machine
        self._axes = channel.config.external_axes
        self._first = channel.config.first_external
        self._runs: dict[int, _Run] = {}
        """The lease of the axes that run, by connection."""

    @method()
    async def move_axis(
        self, caller: Caller, axis: str, position: float, speed: Annotated[float, Gt(0)] | None = None
    ) -> Json:
        """Move an external axis to a position, m or rad, at `speed`, m/s or rad/s. Returns its `position`."""
        number = self._number(axis)
        end = await self._moved(caller, number, MoveAxis(number, position, 0.0 if speed is None else speed))
        # Another command may have replaced the target: then this is the arrival at that one.
        tolerance = self._axes[number - self._first].tolerance
        if isinstance(end, AxisAtRest) and not (end.reached and abs(end.position - position) <= 2.0 * tolerance):
            unit = self._channel.config.unit_of(number)
            message = f"{axis} was stopped at {end.position:.6g} {unit}, before it was at {position:.6g} {unit}"
            raise RtcpError("refused", message, "axis_stopped", {"position": end.position})
        return {"position": end.position}

    @method()
    async def home_axis(self, caller: Caller, axis: str) -> Json:
        """Let the drive of an external axis search its home: what it does says `homing_method`.

        Returns its `position` afterwards, m or rad.
        """
        number = self._number(axis)
        end = await self._moved(caller, number, HomeAxis(number, await self._machine.home_offset(number)))
        if not isinstance(end, Homed):
            raise RtcpError("refused", f"{axis}: homing was stopped; it is not homed", "axis_stopped")
        return {"position": end.position}

    @method()
    async def run_axis(
        self,
        caller: Caller,
        axis: str,
        velocity: float,
        hold_s: Annotated[float, Gt(0), Le(LONGEST_RUN_S)] = HOLD_S,
        sent_s: float | None = None,
    ) -> Json:
        """Run an external axis at a velocity, m/s or rad/s, for `hold_s`; returns when it was accepted.

        The connection holds the lease until the axis rests: it may command other motions meanwhile. Progress reports
        follow the answer; when the client no longer reads them, or the connection closes, the axis stops.
        """
        number, connection = self._number(axis), caller.connection
        run = self._runs.get(connection)
        if run is None or run.task.done():
            run = self._runs[connection] = _Run(self._channel, caller)
        await run.send(caller, RunAxis(number, velocity, left(hold_s, sent_s)))
        return {}

    @method(at_once=True)
    async def stop_axis(self, caller: Caller, axis: str) -> Json:
        """Halt an external axis; returns when it rests. Needs no lease."""
        channel, number = self._channel, self._number(axis)
        head = await channel.accept(caller.without_lease, StopAxis(number))
        await channel.wait(lambda: self._rested(number, head), math.inf, _endless)
        return {}

    async def end_connection(self, connection: int) -> None:
        """End the runs of a connection that has closed."""
        run = self._runs.pop(connection, None)
        if run is not None:
            run.task.cancel()
            await asyncio.gather(run.task, return_exceptions=True)

    def _number(self, axis: str) -> int:
        names = [axis.name for axis in self._axes]
        if not names:
            raise RtcpError("refused", "this platform has no external axes (external_axes in its file)", "no_axis")
        return self._first + index_of("axis", axis, names)

    def _rested(self, number: int, head: int) -> bool | None:
        """Return True once a record after number `head` shows the axis at rest."""
        channel = self._channel
        channel.check_loop()
        return (channel.observer.head > head and not _moves(channel, number)) or None

    async def _moved(self, caller: Caller, number: int, command: Command) -> AxisAtRest | Homed:
        """Carry out a motion that ends by itself; return its end."""
        channel, since = self._channel, self._channel.observer.last_event
        async with channel.lease(caller) as lease:
            head = await channel.accept(lease, command)
            try:
                await channel.wait(lambda: self._rested(number, head), math.inf, _endless)
            except asyncio.CancelledError:
                # Its end may not end the lease, which other requests of the connection share.
                if channel.is_shared(lease):
                    await channel.accept(caller.without_lease, StopAxis(number))
                raise
        if channel.state in BROKEN:
            raise channel.fault_since(since)
        events = [record.event for record in channel.events(since)]
        ends = [event for event in events if isinstance(event, _ENDS) and event.axis == number]
        if not ends:
            raise RtcpError("refused", f"{command.name} was ended by another command: the drives are disabled")
        failed = next((event for event in ends if isinstance(event, AxisFailed | HomedElsewhere | HomingFailed)), None)
        if failed is not None:
            raise channel.error("fault", failed)
        assert isinstance(ends[-1], AxisAtRest | Homed)
        return ends[-1]


class _Run:
    """The lease of one connection's axes that run; `task` ends when they all rest.

    Args:
        channel: to the loop.
        caller: begins the first run.
    """

    def __init__(self, channel: CommandChannel, caller: Caller) -> None:
        self._channel = channel
        self._head: float = math.inf
        """Number of the last record before the newest command's effect; infinite while a command is under way."""
        self._lease: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        # It reports on beyond the answer: a client that no longer reads must not keep the axis running.
        self.task = asyncio.create_task(self._keep(caller))

    async def send(self, caller: Caller, command: Command) -> None:
        """Send a command with the lease."""
        self._head = math.inf
        try:
            lease = await asyncio.shield(self._lease)
            self._head = await self._channel.accept(Lease.of(lease, caller), command)
        finally:
            if self._head == math.inf:
                self._head = 0.0

    async def _keep(self, caller: Caller) -> None:
        try:
            async with self._channel.lease(caller) as lease:
                self._lease.set_result(lease)
                await self._channel.wait(self._resting, math.inf, _endless)
        except RtcpError as error:
            if not self._lease.done():
                self._lease.set_exception(error)

    def _resting(self) -> bool | None:
        channel = self._channel
        channel.check_loop()
        first = channel.config.first_external
        moves = any(_moves(channel, first + at) for at in range(len(channel.config.external_axes)))
        return (channel.observer.head > self._head and not moves) or None


def _moves(channel: CommandChannel, number: int) -> bool:
    return bool(channel.record()[f"{identifier(channel.config.axes[number].name)}_moving"])
