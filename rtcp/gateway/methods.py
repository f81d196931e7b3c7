"""The methods of the control socket: those of machine, motion, recordings and others, and combinations of these.

Every command of the loop that needs no planning (`rtcp.ipc.commands`, and those of packages outside) is also a method,
under its own name.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import inspect
import time
from collections.abc import Awaitable, Callable
from dataclasses import field, make_dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from rtcp.config.find import load_messages
from rtcp.config.validation import Checker
from rtcp.gateway.axis_actions import AxisActions
from rtcp.gateway.cell_actions import CellActions
from rtcp.gateway.command_channel import Caller, CommandChannel, Json, StreamingCommands
from rtcp.gateway.joystick_override import JoystickOverride
from rtcp.gateway.limit_settings import LimitSettings
from rtcp.gateway.machine_actions import MachineActions
from rtcp.gateway.method import (
    HOLD_S,
    Documented,
    Frame,
    Method,
    Numbers,
    check_count,
    documented_of,
    left,
    method,
    methods_of,
)
from rtcp.gateway.motion_actions import MotionActions, Planner
from rtcp.gateway.process_actions import ProcessActions
from rtcp.gateway.recordings import Recordings
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.gateway.terminals import Terminals
from rtcp.ipc import commands
from rtcp.ipc.commands import COMMANDS, Command, MotionCommand, ProcessCommand
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.message import Joints
from rtcp.ipc.observer import Observer
from rtcp.ipc.refusals import DriveModeChanging, NoLease
from rtcp.ipc.session import Session, SessionError, read_json, read_processes
from rtcp.ipc.states import ControlMode, JogFrame, State
from rtcp.motion.limits import Limits
from rtcp.motion.speed_override import LOWEST

_RESTORE_S, _LOOK_S = 5.0, 0.05
_STANDS_RAD = 2e-3
_REPORT_S = 0.5
"""Interval between progress reports of a long plan, s."""
_OWN_CONNECTION = -1
_INTERNAL = (commands.Shutdown, commands.SetZero, commands.RunLines, commands.ExtendTrajectory)
"""Commands that no client sends by themselves."""


class Methods:
    """The methods of one running platform.

    Args:
        observer: the blackboard.
        snapshot: the source of `status`.
        session: the running platform.
        directory: the runtime directory.
        end_platform: ends all processes but this one; returns the problems with that.
    """

    def __init__(
        self,
        observer: Observer,
        snapshot: StatusSnapshot,
        session: Session,
        directory: Path,
        end_platform: Callable[[], Awaitable[list[str]]],
    ) -> None:
        config, limits = session.config, Limits(session.config)
        snapshot.limits = limits
        self._config = config
        self._snapshot = snapshot
        self._observer = observer
        self._directory = directory
        self._end_platform = end_platform
        self.channel = channel = CommandChannel(observer, snapshot, config)
        self.machine = MachineActions(channel)
        self.joystick_override = JoystickOverride(self.machine, config, session.bus)
        self._streaming = StreamingCommands(channel)
        self.recordings = Recordings(directory)
        planners = [Planner(config, limits, number) for number in range(len(config.tool_names))]
        self._motion = MotionActions(channel, planners)
        self._processes = ProcessActions(channel, config)
        self._axes = AxisActions(channel, self.machine)
        self._cell = CellActions(session, self._motion, limits)
        self._paused_by: set[int] = set()
        """Connections that have paused a motion."""
        self._restoring: asyncio.Task[None] | None = None
        load_messages()
        own = methods_of(
            self, self.machine, self._axes, self._motion, self._cell, self.joystick_override, self.recordings,
            Terminals(channel), LimitSettings(channel, limits, directory),
        )  # fmt: skip
        by_command = (self._command_method(kind) for kind in COMMANDS if kind.name not in own and kind not in _INTERNAL)
        self.table = dict(sorted((own | {entry.name: entry for entry in by_command}).items()))

    async def call(self, name: str, caller: Caller, params: Json) -> Json:
        """Carry out a method by its name; raises RtcpError."""
        called = self.table[name]
        if not (called.streams or called.at_once):
            if not params.get("replace") and await self._motion.end_connection(caller.connection):
                await self._streaming.wait_for_rest()
            await self._streaming.rest(caller)
        return await called(caller, params)

    async def end_connection(self, connection: int) -> None:
        """End the motion and the forced inputs of a connection that has closed."""
        self._paused_by.discard(connection)
        self._streaming.end(connection)
        await self._axes.end_connection(connection)
        await self._motion.end_connection(connection)
        await self.joystick_override.end(connection)

    # -- the platform -------------------------------------------------------------------------------------------------

    @method(at_once=True)
    async def status(self, caller: Caller) -> Json:
        """Return the state of machine, joints, bus and slaves: the object that `rtcp status --json` prints."""
        self._snapshot.follow()
        return self._snapshot.status(read_processes(self._directory), self._motion.goal)

    @method(at_once=True)
    async def events(self, caller: Caller, since: Annotated[int, Ge(0)] = 0) -> Json:
        """Return `events` after the number `since`, oldest first: number, time, name, fields, message, severity.

        `severity`: emergency_stop, fault, limit (reset, and move away), warning, note.
        """
        return {"events": [self._snapshot.event(record) for record in self._observer.events_since(since)]}

    @method(at_once=True)
    async def scan(self, caller: Caller) -> Json:
        """Return `slaves` as the start found them, with their AL states now."""
        bus = self._snapshot.names.config.bus
        if why := bus.LACKS.get("states"):
            raise RtcpError("refused", f"no slaves on a bus of kind {bus.kind}: {why}")
        try:
            slaves = read_json(self._directory / "scan.json", list)
        except SessionError as error:
            raise RtcpError("internal", str(error)) from error
        for slave, now in zip(slaves, (await self.status(caller))["slaves"], strict=False):
            slave["state"] = now["state"]
        return {"slaves": slaves}

    @method(at_once=True, stops=commands.Shutdown)
    async def stop(self, caller: Caller) -> Json:
        """End the platform. Returns `problems`: drives left enabled, and slaves not left in INIT."""
        return {"problems": await self._end_platform()}

    @method(at_once=True)
    async def pause(self, caller: Caller) -> Json:
        """Bring the motion under way to rest on its path. Needs no lease."""
        if self.channel.speed_override() > 0.0:
            self._paused_by.clear()  # left from a motion that has ended
        await self.channel.send(0, commands.Pause())
        self._paused_by.add(caller.connection)
        return {}

    @method(at_once=True)
    async def resume(self, caller: Caller) -> Json:
        """Continue the motion that is paused: for who commands it, and for who paused it once all who did resume."""
        lease = self.channel.lease_of(caller.connection)
        if not lease and caller.connection in self._paused_by:
            self._paused_by.discard(caller.connection)
            lease = 0 if self._paused_by else self.channel.lease_in_use()
        if not lease and self.channel.state is State.MOVING:
            text = "not resumed: another who paused the motion, or who commands it, resumes it; `rtcp halt` ends it"
            raise RtcpError("refused", text, "paused_by_another")
        await self.channel.send(lease, commands.Resume())
        self._paused_by.clear()
        return {}

    @method(at_once=True)
    async def set_speed_override(self, caller: Caller, fraction: Annotated[float, Ge(LOWEST), Le(1)]) -> Json:
        """Move at a `fraction` of the speed from now on, 0.01 to 1, also of the motion under way.

        Anyone may lower it. Raising it needs the lease: refused with its holder while another commands the arm.
        """
        channel, lease = self.channel, self._streaming.lease_of(caller.connection)
        channel.check_loop()
        try:
            await channel.send(lease, commands.SetSpeedOverride(fraction))
        except RtcpError as error:
            # Raised: the record of a paused motion lacks the value to compare with.
            if lease or error.reason != NoLease.name:
                raise
            async with channel.lease(caller) as acquired:
                await channel.send(acquired, commands.SetSpeedOverride(fraction))
        return {}

    # -- motion -------------------------------------------------------------------------------------------------------

    @method()
    async def guide(self, caller: Caller, duration_s: Annotated[float, Ge(0), Le(3600)] = 0.0) -> Json:
        """Let the arm be guided by hand (`docs/guiding.md`), in control mode torque, and go back to the mode before.

        Returns when the arm holds: `ended` is `done` after `duration_s`, `halted` by a halt, `released` by the enabling
        switch. 0: it has no end but these, and an hour.
        """
        before = self.channel.control_mode
        if before in (None, ControlMode.TORQUE):
            return await self._motion.guide(caller, duration_s)
        name = before.name.lower()
        try:
            async with self.channel.lease(caller):
                await self.machine.mode(caller, "torque")
                ended = await self._motion.guide(caller, duration_s)
                await self._restore_mode(caller, name)
                return ended
        except (RtcpError, asyncio.CancelledError):
            # Also if its connection is lost: the arm comes to rest, and its mode is restored.
            own = Caller("the end of hand guiding", _OWN_CONNECTION)
            self._restoring = asyncio.create_task(self._restore_mode(own, name))
            raise

    async def _restore_mode(self, caller: Caller, name: str) -> None:
        """Change the control mode once the arm is at its commanded position: no position loop may jerk the hand."""
        channel, end = self.channel, time.monotonic() + _RESTORE_S
        while time.monotonic() < end:
            pairs = zip(channel.joints("actual_position"), channel.joints("commanded_position"), strict=True)
            stands = channel.state is State.READY or all(abs(a - b) < _STANDS_RAD for a, b in pairs)
            if stands and channel.state in (State.READY, State.HOLDING):
                try:
                    await self.machine.mode(caller, name)
                    return
                except RtcpError as error:
                    if error.reason != DriveModeChanging.name:
                        break
            await asyncio.sleep(_LOOK_S)
        self._snapshot.note(f"after hand guiding the control mode stays torque: `rtcp mode {name}` changes it")

    @method()
    async def open_stream(
        self, caller: Caller, motion: Annotated[int, Ge(0)] = 0, partners: tuple[str, ...] = ()
    ) -> Json:
        """Begin a stream of setpoints through shared memory. Returns what `rtcp.Stream` needs for it.

        With `motion` it is in step with `partners` of the cell that open one with the same number: none moves before
        all have, and it ends for all when it ends for one.

        That is `stream`, its number, `lease`, which its sender renews, `since`, the last event before it, and the
        runtime `directory`.
        """
        opened = await self._streaming.open(caller, motion, self._cell.mask_of(partners))
        return {**opened, "directory": str(self._directory)}

    @method(streams=True)
    async def jog(
        self,
        caller: Caller,
        velocity: Numbers,
        frame: Frame = "base",
        hold_s: float = HOLD_S,
        sent_s: float | None = None,
    ) -> Json:
        """Move the tool, m/s and rad/s along and about the axes of `frame`, or the joints, rad/s, for `hold_s`."""
        hold_s = left(hold_s, sent_s)
        check_count("velocity", velocity, len(self._config.joints) if frame == "joints" else 6)
        command: Command = commands.Jog(velocity, JogFrame[frame.upper()], hold_s)
        if frame == "joints" and self.channel.control_mode is ControlMode.VELOCITY:
            command = commands.MoveAtVelocity(velocity, hold_s)
        return await self._streaming.send(caller, command)

    # -- commands without a function of their own ---------------------------------------------------------------------

    def _command_method(self, kind: type[Command]) -> Method:
        """Return the method of a command: it lasts until arm or process rest, streams, or ends when accepted."""
        streams = issubclass(kind, MotionCommand) and kind.renewed

        async def call(caller: Caller, sent_s: float | None = None, **fields: Any) -> Json:
            for name, hint in kind.field_types.items():
                if isinstance(hint, type) and issubclass(hint, IntEnum):
                    fields[name] = hint[fields[name].upper()]
                elif hint == Joints:
                    check_count(name, fields[name], len(self._config.joints))
            if _expires(kind):
                fields["hold_s"] = left(fields["hold_s"], sent_s)
            command = kind(**fields)
            if streams:
                return await self._streaming.send(caller, command)
            if isinstance(command, MotionCommand):
                return await self._motion.run_command(caller, command)
            if isinstance(command, ProcessCommand):
                return await self._processes.run(caller, command)
            if not kind.needs_lease:
                await self.channel.send(0, command)
                return {}
            async with self.channel.lease(caller) as lease:
                await self.channel.send(lease, command)
            return {}

        documentation = inspect.cleandoc(kind.__doc__ or "")
        return Method(kind.name, _parameters_of_command(kind), call, documentation, streams=streams)  # type: ignore[arg-type]


def documented() -> list[Documented]:
    """Return every method of this package, by name."""
    methods = documented_of(
        Methods,
        MachineActions,
        AxisActions,
        MotionActions,
        CellActions,
        JoystickOverride,
        Recordings,
        Terminals,
        LimitSettings,
    )
    names = {entry.name for entry in methods}
    methods += [
        Documented(kind.name, _parameters_of_command(kind).kind, kind.__doc__ or "")  # type: ignore[arg-type]
        for kind in COMMANDS
        if kind.name not in names and kind not in _INTERNAL and kind.__module__ == commands.__name__
    ]
    return sorted(methods)


@functools.cache
def _parameters_of_command(kind: Any) -> Checker[Any]:
    """Return the checker of a command's fields; a hold time has a default, and `sent_s` beside it."""
    timed = _expires(kind)
    defaults = {entry.name: entry.default for entry in dataclasses.fields(kind)}
    fields: list[tuple[str, Any, Any]] = [
        (name, _parameter(hint), field(default=HOLD_S) if timed and name == "hold_s" else field(default=defaults[name]))
        for name, hint in kind.field_types.items()
    ]
    if timed:
        fields.append(("sent_s", float | None, field(default=None)))
    return Checker(make_dataclass(kind.name, fields, frozen=True, kw_only=True))


def _expires(kind: type[Command]) -> bool:
    return issubclass(kind, MotionCommand) and "hold_s" in kind.field_types


def _parameter(hint: Any) -> Any:
    """Return the type of a parameter for a command's field: for an enum its names in lower case."""
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return Literal[tuple(member.name.lower() for member in hint)]
    return hint
