"""The methods of the control socket: one function each, whose signature is the form of the parameters.

Every command of the loop that needs no planning (`rtcp.ipc.commands`, and those of packages outside) is a method of
its own name by itself.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import inspect
import time
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass, field, make_dataclass
from enum import IntEnum
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_type_hints

from annotated_types import Ge, Gt, Le

import rtcp.config.rules  # noqa: F401 its rules hold for stops and points too
from rtcp.config.find import load_messages
from rtcp.config.model import Point, RecordingConfig, RecordingFormat, Stop
from rtcp.config.validation import Checker
from rtcp.gateway.cell_actions import CellActions, StepTarget
from rtcp.gateway.command_channel import Caller, CommandChannel, Json, StreamingCommands
from rtcp.gateway.joystick_override import LONGEST_HOLD_S, JoystickOverride
from rtcp.gateway.limit_settings import LimitSettings
from rtcp.gateway.machine_actions import MachineActions
from rtcp.gateway.motion_actions import MotionActions, Planner
from rtcp.gateway.process_actions import ProcessActions
from rtcp.gateway.recordings import Recordings
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.gateway.terminals import Terminals
from rtcp.gateway.tolerances import Tolerances
from rtcp.ipc import commands
from rtcp.ipc.commands import COMMANDS, Command, MotionCommand, ProcessCommand
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.message import Joints
from rtcp.ipc.observer import Observer
from rtcp.ipc.refusals import DriveModeChanging
from rtcp.ipc.session import Session, SessionError, read_json, read_processes
from rtcp.ipc.states import ControlMode, JogFrame, State
from rtcp.motion.limits import Limits
from rtcp.motion.speed_override import LOWEST

HOLD_S = 0.25
"""Hold time of a command that gives none."""
_RESTORE_S, _LOOK_S = 5.0, 0.05
_STANDS_RAD = 2e-3
_REPORT_S = 0.5
"""Interval between progress reports of a plan that takes long."""
_OWN_CONNECTION = -1
_INTERNAL = (commands.Shutdown, commands.SetZero, commands.RunLines, commands.ExtendTrajectory)
"""Commands that no client sends by themselves."""
GOAL_TIME_S = 3.0
"""How much later than planned an arm with tolerances may be at its goal, where nothing is said."""
Numbers = tuple[float, ...]
Frame = Literal["base", "tool", "joints"]
F = TypeVar("F", bound=Callable[..., Awaitable[Json]])


@dataclass(frozen=True)
class Method:
    """One method of the control socket."""

    name: str
    parameters: Checker[Any]
    call: Callable[..., Awaitable[Json]]
    """Takes the caller and the parameters by name."""
    documentation: str
    at_once: bool = False
    """Whether it does not wait for its connection's other requests."""
    streams: bool = False
    """Whether it goes on with what its connection moves; else it waits until that has come to rest."""

    async def __call__(self, caller: Caller, given: Json) -> Json:
        """Check the parameters and carry it out; raises RtcpError."""
        found, findings = self.parameters.check(given)
        if findings:
            raise RtcpError("invalid", "\n".join(_sentence(where, text) for where, text in findings))
        return await self.call(caller, **vars(found))


def _sentence(where: tuple[int | str, ...], text: str) -> str:
    path = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in where).removeprefix(".")
    return f"{path}: {text}" if path else text


def method(at_once: bool = False, streams: bool = False) -> Callable[[F], F]:
    """Mark a function of `Methods` as a method of the control socket."""

    def mark(function: F) -> F:
        function.method_flags = {"at_once": at_once, "streams": streams}  # type: ignore[attr-defined]
        return function

    return mark


class Methods:
    """Everything that may be asked of one running platform.

    Args:
        observer: the blackboard.
        snapshot: what `status` shows.
        session: what was started.
        directory: the runtime directory.
        end_platform: ends all processes but this one; returns what could not be left in order.
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
        self._limits = LimitSettings(channel, limits, directory)
        self._motion = MotionActions(
            channel, [Planner(config, limits, number) for number in range(len(config.tool_names))]
        )
        self._processes = ProcessActions(channel, config)
        self._terminals = Terminals(channel)
        self._cell = CellActions(session, self._motion, limits)
        self._paused_by: set[int] = set()
        """Connections that have paused a motion."""
        self._restoring: asyncio.Task[None] | None = None
        self.table = self._table()

    def _table(self) -> dict[str, Method]:
        load_messages()
        found = (getattr(self, name) for name in dir(type(self)) if hasattr(getattr(type(self), name), "method_flags"))
        table = {one.name: one for one in map(_method_of, found)}
        for kind in COMMANDS:
            if kind.name not in table and kind not in _INTERNAL:
                table[kind.name] = self._command_method(kind)
        return dict(sorted(table.items()))

    async def call(self, name: str, caller: Caller, given: Json) -> Json:
        """Carry out a method by its name; raises RtcpError."""
        one = self.table[name]
        if not (one.streams or one.at_once):
            if not given.get("replace") and await self._motion.end_connection(caller.connection):
                await self._streaming.wait_for_rest()
            await self._streaming.rest(caller)
        return await one(caller, given)

    async def end_connection(self, connection: int) -> None:
        """End what a connection that has closed was moving or holding."""
        self._paused_by.discard(connection)
        self._streaming.end(connection)
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

    @method()
    async def stop(self, caller: Caller) -> Json:
        """End the platform. Returns `problems`: what could not be left in order."""
        return {"problems": await self._end_platform()}

    # -- the machine --------------------------------------------------------------------------------------------------

    @method()
    async def enable(self, caller: Caller) -> Json:
        """Enable all drives; returns when the arm holds."""
        return await self.machine.enable(caller)

    @method(at_once=True)
    async def disable(self, caller: Caller) -> Json:
        """Stop and remove the torque; returns when the drives show that it is gone. Needs no lease.

        Returns `unconfirmed`: drives that no cycle record shows, a gripper's in a fault.
        """
        return await self.machine.disable()

    @method()
    async def reset(self, caller: Caller) -> Json:
        """Leave a fault, an emergency stop or a stop by a limit. Returns `from`: the state that was left."""
        return await self.machine.reset(caller)

    @method(at_once=True)
    async def halt(self, caller: Caller) -> Json:
        """Stop every motion; returns when the arm holds. Needs no lease."""
        return await self.machine.halt()

    @method(at_once=True)
    async def pause(self, caller: Caller) -> Json:
        """Bring the motion under way to rest on its path. Needs no lease."""
        if self.channel.speed_override() > 0.0:
            self._paused_by.clear()  # who paused a motion that has ended
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

    @method()
    async def mode(self, caller: Caller, name: str) -> Json:
        """Change the control mode (joint, cartesian, joystick, velocity, torque) or the drive mode (csp, csv, cst)."""
        return await self.machine.mode(caller, name)

    @method(at_once=True)
    async def set_speed_override(self, caller: Caller, fraction: Annotated[float, Ge(LOWEST), Le(1)]) -> Json:
        """Move at a `fraction` of the speed from now on, 0.01 to 1, also what is under way.

        Anyone may lower it. Raising it needs the lease: refused with its holder while another commands the arm.
        """
        lease = self._streaming.lease_of(caller.connection)
        return await self.machine.set_speed_override(caller, fraction, lease)

    @method()
    async def set_tool(self, caller: Caller, name: str) -> Json:
        """Use another tool of the arm's file, which holds nothing yet; at rest, in state ready or holding.

        Refused where its bodies would be in a box or too near to the arm itself (reason `tool_in_box`).
        """
        return await self.machine.set_tool(caller, name)

    @method()
    async def set_payload(
        self, caller: Caller, mass: Annotated[float, Ge(0)], centre: Numbers = (0.0, 0.0, 0.0)
    ) -> Json:
        """Carry the weight of what the tool holds: `mass`, kg, `centre` of mass in the frame of the tool, m; at rest.

        At most `payload.max_mass` of the arm's file; until another tool is chosen.
        """
        self._check_count("centre", centre, 3)
        return await self.machine.set_payload(caller, mass, centre)

    @method()
    async def move_gripper(self, caller: Caller, open: bool) -> Json:
        """Open or close the gripper. One with a drive has come to rest: returns its `position`, rad, and `holds`."""
        return await self.machine.gripper(caller, open)

    @method()
    async def zero(self, caller: Caller, joint: str, at: float = 0.0) -> Json:
        """Define the present position of a joint as `at`, rad. Returns `joint`, `offset`, `before`, `file`."""
        return await self.machine.zero(caller, joint, at)

    @method()
    async def home(self, caller: Caller, joint: str) -> Json:
        """Run the homing of a joint's drive. Returns its `position`, rad."""
        return await self.machine.home(caller, joint)

    @method(streams=True)
    async def sdo_read(self, caller: Caller, slave: int, index: int, subindex: int) -> Json:
        """Read an object of the slave at a position from 1. Returns its bytes as `hex`."""
        return await self.machine.service({"do": "sdo_read", "slave": slave, "index": index, "subindex": subindex})

    @method()
    async def sdo_write(self, caller: Caller, slave: int, index: int, subindex: int, hex: str) -> Json:
        """Write an object of a slave, in state ready only."""
        return await self.machine.sdo_write(caller, {"slave": slave, "index": index, "subindex": subindex, "hex": hex})

    @method(at_once=True)
    async def limits(self, caller: Caller) -> Json:
        """Return the `limits` in force beside those that are `configured`."""
        return self._limits.show()

    @method()
    async def set_limits(self, caller: Caller, changes: dict[str, Any]) -> Json:
        """Narrow limits, all or none; keys as `joint2.max`, `joints.velocity`, `box.min.x`. Returns as `limits`."""
        return await self._limits.change(caller, changes)

    @method(streams=True)
    async def joystick(
        self,
        caller: Caller,
        pressed: tuple[str, ...] | None = None,
        byte: int | None = None,
        hold_s: Annotated[float, Gt(0), Le(LONGEST_HOLD_S)] = LONGEST_HOLD_S,
        sent_s: float | None = None,
    ) -> Json:
        """Hold the joystick of the virtual IO box as `pressed` names it, or at `byte`; neither: release it.

        `pressed`: of forward, backward, left, right, mode_up, mode_down, chair, emergency_stop, enabling_switch.
        """
        _left(hold_s, sent_s)
        return await self.joystick_override.force(caller, pressed, byte, hold_s)

    # -- recordings ---------------------------------------------------------------------------------------------------

    @method(at_once=True)
    async def record_start(
        self,
        caller: Caller,
        out: str | None = None,
        formats: tuple[RecordingFormat, ...] = (),
        signals: tuple[str, ...] = (),
        every: Annotated[int, Ge(1), Le(1_000_000)] = 1,
        seconds: Annotated[float, Gt(0)] | None = None,
        max_file_mb: Annotated[int, Ge(1)] | None = None,
        max_file_seconds: Annotated[float, Ge(1)] | None = None,
        keep: Annotated[int, Ge(1)] | None = None,
        reserve_mb: Annotated[int, Ge(0)] = RecordingConfig.reserve_mb,
    ) -> Json:
        """Start a recording: the keys of `recording` in the arm's file. Returns what `record_status` lists."""
        rotation = (max_file_mb, max_file_seconds, keep)
        return await self.recordings.start(
            RecordingConfig(out, formats, signals, every, seconds, *rotation, reserve_mb)
        )

    @method(at_once=True)
    async def record_stop(self, caller: Caller, pid: int | None = None) -> Json:
        """End all recordings, or that of the process `pid`. Returns `recordings`: those that were ended."""
        return {"recordings": await self.recordings.stop(pid)}

    @method(at_once=True)
    async def record_status(self, caller: Caller) -> Json:
        """Return `recordings`: files, rotations, records, missing, bytes, seconds, whether it runs, its problem."""
        return {"recordings": self.recordings.status()}

    # -- motion -------------------------------------------------------------------------------------------------------

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

        With `replace` it waits for no other request of its connection: a motion of that goes over into this one without
        a stop, and ends with the error kind `replaced`.
        """
        return await self._motion.move_joints(caller, q, speed, synchronized)

    @method()
    async def move_home(self, caller: Caller, speed: float | None = None) -> Json:
        """Move the joints to `home` of the arm's file; `speed` and result as of `move_joints`."""
        if self._config.home is None:
            raise RtcpError("refused", f"the key home is missing in {self._config.source}", "no_home")
        return await self._motion.move_joints(caller, self._config.home, speed, True)

    @method()
    async def move_pose(self, caller: Caller, pose: Numbers, speed: float | None = None, line: bool = False) -> Json:
        """Move the tool to x y z, m, rx ry rz, rad, by the joints or on a `line`; `speed` in rad/s or m/s."""
        return await self._motion.move_pose(caller, pose, speed, line)

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
        return await self._motion.run_path(caller, [Stop(pose, blend=blend) for pose in poses], speed, False)

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
        if len(via) != 3:
            raise RtcpError("invalid", f"via: found {len(via)} numbers, allowed are 3: x y z, m")
        return await self._motion.run_path(caller, [Stop(pose, speed=speed, via=via, angle=angle)], None, False)

    @method()
    async def move_by(self, caller: Caller, offset: Numbers, frame: Frame = "base", speed: float | None = None) -> Json:
        """Move by an offset: the tool on a line, m and rad along and about the axes of `frame`, or the joints, rad."""
        return await self._motion.move_by(caller, offset, JogFrame[frame.upper()], speed)

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
        Returns `path`, configurations along it, rad, `duration_s`, and of lines `length_m` and `slowed`; refused with
        what would refuse it, or where its way leads through a box.
        """
        if (q is not None) + (pose is not None) + (file is not None) + bool(stops) != 1:
            raise RtcpError("invalid", "found none or several of q, pose, file and stops, allowed is one of them")
        if start is not None:
            self._check_count("start", start, len(self._config.joints))
        number = None if tool is None else self.machine.tool_number(tool, "tool")
        if stops:
            plan = self._motion.preview(None, stops, (), speed, synchronized, start, number)
            return await self._with_progress(caller, plan)
        if file is not None:
            return await self._with_progress(caller, self._motion.preview_file(file, approach, number))
        if pose is not None:
            return await self._motion.preview_pose(pose, speed, line, number)
        return await self._motion.preview(q, (), (), speed, synchronized, tool=number)

    async def _with_progress(self, caller: Caller, work: Coroutine[Any, Any, Json]) -> Json:
        """Carry out what takes long and moves nothing; its caller sees that the platform lives."""
        task = asyncio.ensure_future(work)
        try:
            while not (await asyncio.wait({task}, timeout=_REPORT_S))[0]:
                caller.report(self.channel.progress())
            return task.result()
        finally:
            task.cancel()

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
            # Also where its connection is lost: the arm comes to rest, and is left as it was before.
            own = Caller("the end of hand guiding", _OWN_CONNECTION)
            self._restoring = asyncio.create_task(self._restore_mode(own, name))
            raise

    async def _restore_mode(self, caller: Caller, name: str) -> None:
        """Change the control mode once the arm stands where it is commanded: no position loop snaps a hand away."""
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

    @method(at_once=True)
    async def fk(self, caller: Caller, q: Numbers) -> Json:
        """Return the `pose` of the tool, x y z, m, rx ry rz, rad, at joint positions, rad."""
        return await self._motion.fk(q)

    @method(at_once=True)
    async def ik(self, caller: Caller, pose: Numbers, near: Numbers | None = None) -> Json:
        """Return the joint positions `q`, rad, nearest to `near` or to where the arm is, that bring the tool to `pose`.

        Refused with reason `out_of_reach` (`distance`, m), `joint_limited` (`axis`, `joint`), `in_box` (`box`), or
        `no_geometry`.
        """
        return await self._motion.ik(pose, near)

    @method()
    async def run(self, caller: Caller, file: str, approach: bool = False) -> Json:
        """Run a motion file (`docs/motion.md`), an absolute path. `approach`: the joints first move to its start."""
        return await self._motion.run_file(caller, file, approach)

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

        One that begins at time 0 within `start_tolerance`, rad, of where the arm is commanded begins there. Tolerances,
        rad, one a joint, 0: none: `path_tolerance` of the measured from the commanded position on the way,
        `goal_tolerance` at the end, at most `goal_time_s` later than planned. Where one is not kept the arm brakes on
        its path; reason `path_tolerance_violated` or `goal_tolerance_violated`, with `axis`, `error` and `limit`.

        With `replace` as `move_joints`; a first point at time 0 is left out where the arm moves, and the others come as
        much later as the way to the next one lasts longer than its time.
        """
        tolerances = None
        if path_tolerance or goal_tolerance or goal_time_s is not None:
            tolerances = Tolerances(
                self._tolerance("path_tolerance", path_tolerance),
                self._tolerance("goal_tolerance", goal_tolerance),
                GOAL_TIME_S if goal_time_s is None else goal_time_s,
            )
        return await self._motion.run_trajectory(caller, points, approach, tolerances, start_tolerance)

    @method(at_once=True)
    async def plan_in_step(
        self, caller: Caller, targets: tuple[StepTarget, ...], speed: Annotated[float, Gt(0)] | None = None
    ) -> Json:
        """Plan a motion of several arms of the cell that begin and end together; nothing moves.

        Each target names an `arm` and has joint positions `q`, rad, or `points` of a trajectory; `speed`: of the
        fastest joint, rad/s. Returns `points` of each arm, `duration_s`, and the table of the group's brakes: what
        `run_in_step` of each arm takes.
        """
        return await self._cell.plan(targets, speed)

    @method()
    async def run_in_step(
        self,
        caller: Caller,
        points: tuple[Point, ...],
        motion: Annotated[int, Ge(1)],
        start_ns: int,
        brakes: Numbers,
        brake_step_s: Annotated[float, Gt(0)],
        partners: tuple[str, ...] = (),
    ) -> Json:
        """Run what `plan_in_step` returned for this arm, from `start_ns` on (CLOCK_MONOTONIC, ns).

        It begins if all partners named have accepted the same number `motion` by then; it ends for all when it ends for
        one. Returns as `move_joints`.
        """
        return await self._cell.run(caller, points, motion, partners, start_ns, brakes, brake_step_s)

    def _tolerance(self, name: str, given: Numbers) -> Numbers:
        count = len(self._config.joints)
        if given:
            self._check_count(name, given, count)
        return tuple(one if one > 0.0 else inf for one in given) or (inf,) * count

    @method()
    async def open_trajectory(self, caller: Caller, points: tuple[Point, ...], replace: bool = False) -> Json:
        """Begin a trajectory that is open at its end; returns as `append` when it is accepted.

        Points with positions only get velocities that pass no point; the last one waits for the next, or the arm comes
        to rest at it. One that comes to its last point without more is stopped, with the event `out_of_points`.
        """
        return await self._motion.open_trajectory(caller, points)

    @method(streams=True)
    async def append(self, caller: Caller, points: tuple[Point, ...]) -> Json:
        """Append points to the open trajectory. Returns `room`, points that fit, and `ahead_s`, time to the end."""
        return await self._motion.append(caller, points)

    @method(streams=True)
    async def finish_trajectory(self, caller: Caller) -> Json:
        """End the open trajectory at its last point, at rest; returns as `move_joints` when the arm is there."""
        return await self._motion.finish_trajectory(caller)

    @method()
    async def run_path(
        self, caller: Caller, stops: tuple[Stop, ...], speed: float | None = None, approach: bool = False
    ) -> Json:
        """Run a path to stops: each a `pose` or the joints `q` that have it, and if given its `speed`, m/s.

        On a straight line, on the arc through `via`, x y z, m, or where it says so `by_joints`; it rests there, or
        rounds the corner within `blend`, m: the keys of `path` in `docs/motion.md`. Returns as `move_line`.
        """
        return await self._motion.run_path(caller, stops, speed, approach)

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
        hold_s = _left(hold_s, sent_s)
        self._check_count("velocity", velocity, len(self._config.joints) if frame == "joints" else 6)
        command: Command = commands.Jog(velocity, JogFrame[frame.upper()], hold_s)
        if frame == "joints" and self.channel.control_mode is ControlMode.VELOCITY:
            command = commands.MoveAtVelocity(velocity, hold_s)
        return await self._streaming.send(caller, command)

    @method()
    async def set_output(self, caller: Caller, output: int, value: bool, box: str | None = None) -> Json:
        """Set a digital output, from 1, of an IO box; `box`: its slave, needed with several."""
        boxes = self._config.boxes
        if (box is None and len(boxes) > 1) or (box is not None and box not in boxes):
            found = "the key is missing" if box is None else f'found the text "{box}"'
            raise RtcpError("invalid", f"box: {found}, allowed is one of {', '.join(boxes) or 'none: there is no box'}")
        async with self.channel.lease(caller) as lease:
            await self.channel.send(lease, commands.SetOutput(output, value, boxes.index(box) if box else 0))
        return {}

    @method(at_once=True)
    async def read_io(self, caller: Caller) -> Json:
        """Return `inputs` and `outputs`: `name`, `box`, `number`, level `value`, `has_function` of all terminals.

        Channels of one bit of other slaves are among them; `channels`: `name`, `value` and `unit` of those with a
        number, and of outputs whether they are `settable`, and their `range`.
        """
        return self._terminals.read()

    @method()
    async def write_io(self, caller: Caller, name: str, value: bool) -> Json:
        """Set the digital output of a name (`outputs.named`, `box.number`, `slave.channel`) as `set_output` does."""
        return await self._terminals.write(caller, name, value)

    @method()
    async def set_channel(self, caller: Caller, name: str, value: float) -> Json:
        """Set an output with a number, `slave.channel`, in its unit; or as `write_io`, to 0 or 1."""
        return await self._terminals.write(caller, name, value)

    @method(at_once=True)
    async def wait_io(
        self,
        caller: Caller,
        name: str,
        value: bool = True,
        timeout_s: Annotated[float, Ge(0)] | None = None,
    ) -> Json:
        """Return when the input or output of a name has the level `value`, if only for a cycle; without lease."""
        return await self._terminals.wait(caller, name, value, timeout_s)

    # -- commands without a function of their own ---------------------------------------------------------------------

    def _command_method(self, kind: type[Command]) -> Method:
        """Return the method of a command: it lasts until arm or process rest, streams, or ends when accepted."""
        streams = issubclass(kind, MotionCommand) and kind.renewed
        hints = _fields_of(kind)

        async def call(caller: Caller, sent_s: float | None = None, **given: Any) -> Json:
            for name, hint in hints.items():
                if isinstance(hint, type) and issubclass(hint, IntEnum):
                    given[name] = hint[given[name].upper()]
                elif hint == Joints:
                    self._check_count(name, given[name], len(self._config.joints))
            if _expires(kind):
                given["hold_s"] = _left(given["hold_s"], sent_s)
            command = kind(**given)
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

    @staticmethod
    def _check_count(name: str, numbers: Numbers, count: int) -> None:
        if len(numbers) != count:
            raise RtcpError("invalid", f"{name}: found {len(numbers)} numbers, allowed are {count}")


class Documented(NamedTuple):
    """A method as `docs/methods.md` shows it."""

    name: str
    parameters: type
    """A dataclass of them."""
    about: str


def documented() -> list[Documented]:
    """Return every method of this package, by name."""
    found = [one for one in vars(Methods).values() if hasattr(one, "method_flags")]
    shown = [Documented(one.__name__, _parameters_of(one).kind, one.__doc__) for one in found]
    names = {one.name for one in shown}
    shown += [
        Documented(kind.name, _parameters_of_command(kind).kind, kind.__doc__ or "")  # type: ignore[arg-type]
        for kind in COMMANDS
        if kind.name not in names and kind not in _INTERNAL and kind.__module__ == commands.__name__
    ]
    return sorted(shown)


def _method_of(function: Any) -> Method:
    documentation = inspect.cleandoc(function.__doc__)
    return Method(
        function.__name__, _parameters_of(function.__func__), function, documentation, **function.method_flags
    )


@functools.cache
def _parameters_of(function: Any) -> Checker[Any]:
    """Return what checks the parameters of a function: those after `self` and `caller`."""
    hints = get_type_hints(function, include_extras=True)
    fields = [
        (name, hints[name], field() if one.default is inspect.Parameter.empty else field(default=one.default))
        for name, one in list(inspect.signature(function).parameters.items())[2:]
    ]
    return Checker(make_dataclass(function.__name__, fields, frozen=True, kw_only=True))


@functools.cache
def _parameters_of_command(kind: Any) -> Checker[Any]:
    """Return what checks the fields of a command; one with a hold time needs none, and has `sent_s` beside."""
    hints = _fields_of(kind)
    held = _expires(kind)
    defaults = {one.name: one.default for one in dataclasses.fields(kind)}
    fields: list[tuple[str, Any, Any]] = [
        (name, _parameter(hint), field(default=HOLD_S) if held and name == "hold_s" else field(default=defaults[name]))
        for name, hint in hints.items()
    ]
    if held:
        fields.append(("sent_s", float | None, field(default=None)))
    return Checker(make_dataclass(kind.name, fields, frozen=True, kw_only=True))


def _expires(kind: type[Command]) -> bool:
    return issubclass(kind, MotionCommand) and "hold_s" in _fields_of(kind)


def _fields_of(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {one.name: hints[one.name] for one in dataclasses.fields(kind)}


def _parameter(hint: Any) -> Any:
    """Return the type of a parameter for a command's field: an enum goes by its names in lower case."""
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return Literal[tuple(one.name.lower() for one in hint)]
    return hint


def _left(hold_s: float, sent_s: float | None) -> float:
    """Return what is left of `hold_s` since `sent_s`, CLOCK_MONOTONIC, at which the command was wanted.

    Raises:
        TimedOut: nothing.
    """
    if sent_s is None:
        return hold_s
    late_s = time.monotonic() - sent_s
    if not late_s <= hold_s:
        raise RtcpError("timeout", f"it came {late_s:.1f} s after it was sent, and lasts for {hold_s:g} s only")
    return hold_s - max(0.0, late_s)
