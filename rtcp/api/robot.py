"""A robot, commanded by blocking calls; and every method of a robot: its request, and the result made of the answer.

Each method raises `RtcpError` as described there; its docstring lists only its own cases.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, Protocol, TypeVar, overload

from rtcp.api.results import (
    Arrival,
    Buffered,
    Channel,
    EventRecord,
    GripperRest,
    HomingMethod,
    JointLimits,
    Levels,
    Pose,
    Positions,
    Preview,
    Progress,
    RecorderStatus,
    Status,
    Streamed,
    Terminals,
    Zero,
    result,
)
from rtcp.ipc.client import ControlClient
from rtcp.ipc.closing import Closing
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

if TYPE_CHECKING:
    from rtcp.api.stream import Stream

P = ParamSpec("P")
T = TypeVar("T")
OnProgress = Callable[[Progress], object]
Json = dict[str, Any]


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request of the control socket (`docs/protocol.md`)."""

    method: str
    params: Mapping[str, Any]
    result: Callable[[Json], T]
    progress: OnProgress | None = None


class _Blocking(Protocol):
    def _carry_out(self, call: Call[T]) -> T: ...


class _Awaited(Protocol):
    def _carry_out(self, call: Call[T]) -> Coroutine[Any, Any, T]: ...


class Method(Generic[P, T]):
    """A method, described by the `Call` that it makes; a robot returns the result of the call, or awaits it."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Call[T]]) -> None:
        self.describe = describe

    @overload
    def __get__(self, robot: None, kind: object) -> Callable[..., Any]: ...

    @overload
    def __get__(self, robot: _Blocking, kind: object) -> Callable[P, T]: ...

    @overload
    def __get__(self, robot: _Awaited, kind: object) -> Callable[P, Coroutine[Any, Any, T]]: ...

    def __get__(self, robot: Any, kind: object) -> Any:
        """Return the description, for `help` and the like: on a robot, functions replace the methods."""
        return self.describe

    def function(self, awaited: bool) -> object:
        """Return the function that carries the call out, with name, signature and docstring of the description."""
        describe = self.describe

        @functools.wraps(describe)
        def call(self: Any, /, *args: Any, **kwargs: Any) -> Any:
            return self._carry_out(describe(self, *args, **kwargs))

        @functools.wraps(describe)
        async def call_awaited(self: Any, /, *args: Any, **kwargs: Any) -> Any:
            return await self._carry_out(describe(self, *args, **kwargs))

        signature = inspect.signature(describe)
        wrapper: Any = call_awaited if awaited else call
        wrapper.__signature__ = signature.replace(
            return_annotation=str(signature.return_annotation).removeprefix("Call[").removesuffix("]")
        )
        return wrapper


def _nothing(answer: Json) -> None:
    return None


def _as_is(answer: Json) -> Json:
    return answer


def _joint_limits(answer: Json) -> tuple[JointLimits, ...]:
    limits = answer["limits"]
    keys = [item.name for item in dataclasses.fields(JointLimits)][1:]
    return tuple(JointLimits(name, *(limits[key][i] for key in keys)) for i, name in enumerate(answer["joint_names"]))


def _recordings(answer: Json) -> list[RecorderStatus]:
    return [result(RecorderStatus, recording) for recording in answer["recordings"]]


_arrival, _streamed, _buffered = partial(result, Arrival), partial(result, Streamed), partial(result, Buffered)


def _expiry(hold_s: float, sent_s: float | None) -> Json:
    return {"hold_s": hold_s, "sent_s": time.monotonic() if sent_s is None else sent_s}


class Methods:
    """The methods of every robot; a subclass has `_carry_out`, which a coroutine function makes awaited methods."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if Methods not in cls.__bases__:
            return  # it inherits those of a robot, and may have put its own in their place
        awaited = inspect.iscoroutinefunction(cls._carry_out)  # type: ignore[attr-defined]
        for name, method in vars(Methods).items():
            if isinstance(method, Method):
                setattr(cls, name, method.function(awaited))

    # -- state --------------------------------------------------------------------------------------------------------

    @Method
    def status(self) -> Call[Status]:
        """Return the state of the machine, the joints and the bus."""
        return Call("status", {}, Status.from_json)

    @Method
    def events(self, since: int = 0) -> Call[list[EventRecord]]:
        """Return the events after the number `since`, oldest first; the last 256 are kept."""
        return Call("events", {"since": since}, lambda answer: [result(EventRecord, e) for e in answer["events"]])

    @Method
    def scan(self) -> Call[list[Json]]:
        """Return the slaves as the start found them: identity, PDO entries, and their AL states now."""
        return Call("scan", {}, lambda answer: list(answer["slaves"]))

    @Method
    def enable(self) -> Call[None]:
        """Enable all drives; return when the arm holds."""
        return Call("enable", {}, _nothing)

    @Method
    def disable(self) -> Call[tuple[str, ...]]:
        """Stop, remove the torque and return when the drives show that it is gone. Needs no lease.

        Returns:
            drives that were commanded off and that no record shows: a gripper's during a fault.
        """
        return Call("disable", {}, lambda answer: tuple(answer["unconfirmed"]))

    @Method
    def reset(self) -> Call[State]:
        """Leave a fault or an emergency stop (drives are disabled then), or a stop by a limit (the arm holds).

        Returns:
            the state that was left; `READY` or `HOLDING`: there was nothing to reset.
        """
        return Call("reset", {}, lambda answer: State[answer["from"].upper()])

    @Method
    def halt(self) -> Call[None]:
        """Stop every motion, whoever began it; return when the arm holds. Needs no lease."""
        return Call("halt", {}, _nothing)

    @Method
    def mode(self, name: ControlMode | DriveMode | str) -> Call[None]:
        """Change the control mode (`joint`, `cartesian`, ...) or the drive mode (`csp`, `csv`, `cst`) at standstill."""
        return Call("mode", {"name": name if isinstance(name, str) else name.name.lower()}, _nothing)

    @Method
    def set_speed_override(self, fraction: float) -> Call[None]:
        """Set the fraction of its speed at which the arm moves, also now; streams and torques are not slowed.

        Args:
            fraction: 0.01 to 1. Anyone may lower it; raising it takes the lease for a moment.

        Raises:
            Refused: it is raised while another commander holds the lease.
            Invalid: not a number from 0.01 to 1.
        """
        return Call("set_speed_override", {"fraction": fraction}, _nothing)

    @Method
    def pause(self) -> Call[None]:
        """Bring the motion under way, whoever began it, to rest on its path; `resume` continues it. Needs no lease.

        Its call keeps waiting. A halt, or the end of its commander, also ends a paused motion.

        Raises:
            Refused: nothing moves, or the motion cannot be paused (jog, stream, torque, a motion in step).
        """
        return Call("pause", {}, _nothing)

    @Method
    def resume(self) -> Call[None]:
        """Continue the motion that is paused: for the connection that paused it or commands it.

        Raises:
            Refused: none is paused; or reason `paused_by_another`.
        """
        return Call("resume", {}, _nothing)

    @Method
    def set_tool(self, name: str) -> Call[None]:
        """Use another tool of the arm's file (`kinematics.tools`); at rest, in state ready or holding.

        Poses, lines, jogs, boxes, collisions and gravity are those of this tool from then on. Its payload is 0:
        see `set_payload`. After each start of the loop the first tool of the file is in use.

        Raises:
            Refused: the arm moves, another commander, or its bodies would be in a box or too near to the arm itself
                (reason `tool_in_box`).
            Invalid: no tool has this name.
        """
        return Call("set_tool", {"name": name}, _nothing)

    @Method
    def set_payload(self, mass: float, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> Call[None]:
        """Set the payload of the tool, whose weight control mode torque carries; at rest. `set_tool` sets it to 0.

        Args:
            mass: kg, at most `payload.max_mass` of the arm's file.
            centre: of mass, x y z in the frame of the tool, m.

        Raises:
            Refused: the arm moves, another commander, too heavy or too far, or the masses of the links are unknown.
        """
        return Call("set_payload", {"mass": mass, "centre": list(centre)}, _nothing)

    @Method
    def stop(self) -> Call[tuple[str, ...]]:
        """End the platform: stop the arm, disable the drives, leave the bus.

        Returns:
            the steps that failed, a sentence each.
        """
        return Call("stop", {}, lambda answer: tuple(answer["problems"]))

    # -- motions with an end ------------------------------------------------------------------------------------------

    @Method
    def move_joints(
        self,
        q: Sequence[float],
        speed: float | None = None,
        synchronized: bool = True,
        progress: OnProgress | None = None,
        replace: bool = False,
    ) -> Call[Arrival]:
        """Move to joint positions and return when the arm is there.

        Args:
            q: rad, base to tool.
            speed: of the fastest joint, rad/s; None: its limit.
            synchronized: all joints arrive together; else each as soon as it can.
            progress: called about ten times a second meanwhile.
            replace: blend a motion of this connection that is under way (`AsyncRobot`) into this one without a stop,
                under the limits; a refusal of this one leaves that under way.

        Raises:
            Refused: a target outside the limits, the wrong state, another commander.
            Faulted: it ended before it arrived.
            Replaced: another motion took its place.
        """
        params = {"q": list(q), "speed": speed, "synchronized": synchronized, "replace": replace}
        return Call("move_joints", params, _arrival, progress)

    @Method
    def move_to_rest_pose(self, speed: float | None = None, progress: OnProgress | None = None) -> Call[Arrival]:
        """Move the joints to `rest_pose` of the arm's file.

        Args:
            speed: of the fastest joint, rad/s; None: its limit.
            progress: called about ten times a second meanwhile.

        Raises:
            Refused: as `move_joints`; reason `no_rest_pose`: the file has none.
        """
        return Call("move_to_rest_pose", {"speed": speed}, _arrival, progress)

    @Method
    def move_pose(
        self,
        pose: Sequence[float],
        speed: float | None = None,
        line: bool = False,
        progress: OnProgress | None = None,
    ) -> Call[Arrival]:
        """Move the tool to a pose, by the nearest solution of the joints, and return when it is there.

        Args:
            pose: x y z, m, and rx ry rz, rad, with R = Rx Ry Rz.
            speed: of the fastest joint, rad/s, or with `line` of the tool, m/s; None: the limit.
            line: on a straight line, as always in control mode `cartesian`.
            progress: called about ten times a second meanwhile.
        """
        params = {"pose": list(pose), "speed": speed, "line": line}
        return Call("move_pose", params, _arrival, progress)

    @Method
    def move_line(
        self,
        poses: Sequence[Sequence[float]],
        speed: float | None = None,
        progress: OnProgress | None = None,
        blend: float = 0.0,
    ) -> Call[Arrival]:
        """Move the tool on straight lines through poses (m, rad), at `speed`, m/s; None: its limit.

        Args:
            poses: at least one.
            speed: of the tool.
            progress: called about ten times a second meanwhile.
            blend: radius within which corners are rounded, m; 0: the tool rests at each pose.
        """
        params = {"poses": [list(pose) for pose in poses], "speed": speed, "blend": blend}
        return Call("move_line", params, _arrival, progress)

    @Method
    def move_arc(
        self,
        via: Sequence[float],
        pose: Sequence[float],
        angle: float | None = None,
        speed: float | None = None,
        progress: OnProgress | None = None,
    ) -> Call[Arrival]:
        """Move the tool on the arc through a place to a pose.

        Args:
            via: x y z, m; also longer: of a pose the first three count.
            pose: x y z, m, and rx ry rz, rad: its end.
            angle: rad, travelled on the circle through the present place, `via` and `pose`, at constant orientation;
                `2 * pi` is the whole circle. None: up to the pose.
            speed: m/s; None: its limit.
            progress: called about ten times a second meanwhile.
        """
        params = {"via": list(via)[:3], "pose": list(pose), "angle": angle, "speed": speed}
        return Call("move_arc", params, _arrival, progress)

    @Method
    def move_by(
        self,
        offset: Sequence[float],
        frame: str = "base",
        speed: float | None = None,
        progress: OnProgress | None = None,
    ) -> Call[Arrival]:
        """Move by an offset from where the arm is, as one step of a jog.

        Args:
            offset: of the tool, m and rad, along and about the axes of the frame, on a straight line; or of the joints.
            frame: `base`, `tool` or `joints`.
            speed: of the tool, m/s, or of the fastest joint, rad/s; None: its limit.
            progress: called about ten times a second meanwhile.
        """
        return Call("move_by", {"offset": list(offset), "frame": frame, "speed": speed}, _arrival, progress)

    @Method
    def run(self, file: str, approach: bool = False, progress: OnProgress | None = None) -> Call[Arrival]:
        """Run a motion file (`docs/motion.md`), checked as a whole first.

        Args:
            file: absolute path.
            approach: move by the joints to where it begins.
            progress: called about ten times a second meanwhile.
        """
        return Call("run", {"file": str(file), "approach": approach}, _arrival, progress)

    @Method
    def run_trajectory(
        self,
        points: Sequence[Mapping[str, Any]],
        approach: bool = False,
        progress: OnProgress | None = None,
        replace: bool = False,
        start_tolerance: float = 0.0,
        path_tolerance: Sequence[float] = (),
        goal_tolerance: Sequence[float] = (),
        goal_time_s: float | None = None,
    ) -> Call[Arrival]:
        """Run a trajectory through points `{"t": s, "q": [rad]}`; `approach`: the joints first move to the first point.

        A point may also have velocities `v` and accelerations `a`. With `replace` as `move_joints`: while the arm moves
        a first point at time 0 is left out, and the others are delayed by what the way to the next one demands.

        Args:
            points: times rise, from 0 on or later; where the first is later, the arm first moves to it. If all are 0,
                the joints move at the speeds `v`, else at their limits, as fast as accelerations allow.
            approach: see above.
            progress: called about ten times a second meanwhile.
            replace: see above.
            start_tolerance: rad; a first point at time 0 this near to the commanded position counts as reached.
            path_tolerance: largest distance of measured and commanded position, rad, one a joint, 0: none; beyond it
                the arm brakes on its path.
            goal_tolerance: largest distance of the measured position from the last point, rad, one a joint, 0: none.
            goal_time_s: how much later than planned the arm may be inside `goal_tolerance`, s; None: 3.

        Raises:
            Faulted: among others reason `path_tolerance_violated` or `goal_tolerance_violated`, with fields `axis`,
                `error` and `limit`.
        """
        params = {
            "points": [dict(point) for point in points],
            "approach": approach,
            "replace": replace,
            "start_tolerance": start_tolerance,
            "path_tolerance": list(path_tolerance),
            "goal_tolerance": list(goal_tolerance),
            "goal_time_s": goal_time_s,
        }
        return Call("run_trajectory", params, _arrival, progress)

    @Method
    def open_trajectory(self, points: Sequence[Mapping[str, Any]], replace: bool = False) -> Call[Buffered]:
        """Begin an open-ended trajectory: `append` points, then `finish_trajectory`; points as of `run_trajectory`.

        Returns when it is accepted. Points with positions only get velocities that pass no point. Where none is
        appended in time, the arm comes to rest at the last point or, with velocities given, brakes, and the trajectory
        has ended with the event `out_of_points`.

        Args:
            points: at least one; times in s from its begin.
            replace: as of `move_joints`.
        """
        params = {"points": [dict(point) for point in points], "replace": replace}
        return Call("open_trajectory", params, _buffered)

    @Method
    def append(self, points: Sequence[Mapping[str, Any]]) -> Call[Buffered]:
        """Append points to the open trajectory, all or none; a refusal leaves it running.

        Raises:
            Refused: `not_open`, `no_room_for_points`, or a mistake in a point.
            Faulted: it has ended; `reason` is the cause.
        """
        return Call("append", {"points": [dict(point) for point in points]}, _buffered)

    @Method
    def finish_trajectory(self, progress: OnProgress | None = None) -> Call[Arrival]:
        """End the open trajectory at its last point, at rest, and return when the arm is there."""
        return Call("finish_trajectory", {}, _arrival, progress)

    @Method
    def run_path(
        self,
        stops: Sequence[Mapping[str, Any]],
        speed: float | None = None,
        approach: bool = False,
        progress: OnProgress | None = None,
    ) -> Call[Arrival]:
        """Run a path through stops `{"pose": [...]}` or `{"q": [...]}`, each with or without `speed`.

        With `via` beside it on an arc, with `by_joints` by the joints, with `blend` without a rest: the keys of `path`
        in `docs/motion.md`. `speed`: of the tool, m/s, where a stop has none. With `approach` the joints first move to
        the first stop.
        """
        params = {"stops": [dict(stop) for stop in stops], "speed": speed, "approach": approach}
        return Call("run_path", params, _arrival, progress)

    @Method
    def preview(
        self,
        q: Sequence[float] | None = None,
        pose: Sequence[float] | None = None,
        file: str | None = None,
        speed: float | None = None,
        line: bool = False,
        synchronized: bool = True,
        approach: bool = False,
        stops: Sequence[Mapping[str, Any]] = (),
        start: Sequence[float] | None = None,
        tool: str | None = None,
    ) -> Call[Preview]:
        """Plan what `move_joints(q)`, `move_pose(pose)`, `run(file)` or `run_path(stops)` would do now; nothing moves.

        No lease is needed. A path may also begin at the joint positions `start`, rad; `tool`: plan as if this one were
        in use.

        Raises:
            Refused: as the motion would be, or because its path leads through a box.
            Invalid: not exactly one of `q`, `pose`, `file` and `stops`, or one with mistakes.
        """
        params: dict[str, Any] = {
            "q": None if q is None else list(q),
            "pose": None if pose is None else list(pose),
            "file": file,
            "speed": speed,
            "line": line,
            "synchronized": synchronized,
            "approach": approach,
            "tool": tool,
        }
        if stops:
            params |= {"stops": [dict(stop) for stop in stops], "start": None if start is None else list(start)}
        return Call("preview", params, partial(result, Preview))

    # -- streaming commands -------------------------------------------------------------------------------------------

    @Method
    def jog(
        self,
        velocity: Sequence[float],
        frame: JogFrame | str = "base",
        hold_s: float = 0.25,
        sent_s: float | None = None,
    ) -> Call[Streamed]:
        """Move with a velocity for `hold_s`; call it again in time to continue. Else the arm stops by itself.

        Args:
            velocity: of the tool along and about the axes of `frame`, 6 numbers, m/s and rad/s; of the joints, rad/s.
            frame: `base`, `tool` or `joints`.
            hold_s: s
            sent_s: CLOCK_MONOTONIC, s, of the operator's input; a command older than `hold_s` has no effect. None: now.

        Raises:
            TimedOut: it was received later than `hold_s` after `sent_s`.
        """
        name = frame if isinstance(frame, str) else frame.name.lower()
        return Call("jog", {"velocity": list(velocity), "frame": name, **_expiry(hold_s, sent_s)}, _streamed)

    @Method
    def move_at_velocity(
        self, velocity: Sequence[float], hold_s: float = 0.25, sent_s: float | None = None
    ) -> Call[Streamed]:
        """Move the joints with velocities, rad/s, in control mode `velocity`; `hold_s` and `sent_s` as for `jog`."""
        return Call("move_at_velocity", {"velocity": list(velocity), **_expiry(hold_s, sent_s)}, _streamed)

    @Method
    def apply_torque(
        self,
        torque: Sequence[float],
        stiffness: float = 0.0,
        damping: float = 0.0,
        hold_s: float = 0.25,
        sent_s: float | None = None,
    ) -> Call[Streamed]:
        """Add joint torques, Nm, to the gravity compensation, in control mode `torque`.

        Args:
            torque: Nm, one a joint.
            stiffness: fraction, 0 to 1, of each joint's `cst_stiffness`.
            damping: fraction, 0 to 1, of each joint's `cst_damping`.
            hold_s: as for `jog`.
            sent_s: as for `jog`.
        """
        params = {"torque": list(torque), "stiffness": stiffness, "damping": damping, **_expiry(hold_s, sent_s)}
        return Call("apply_torque", params, _streamed)

    @Method
    def guide(self, duration_s: float = 0.0, progress: OnProgress | None = None) -> Call[str]:
        """Let a person guide the arm by hand, in control mode `torque`; then return to the mode before.

        Args:
            duration_s: how long, s; 0: until a halt, the release of the enabling switch, or 3600 s.
            progress: called meanwhile.

        Returns:
            Why it ended: `done`, `halted` or `released` (the enabling switch).
        """
        return Call("guide", {"duration_s": duration_s}, lambda answer: str(answer["ended"]), progress)

    @Method
    def stream(self, q: Sequence[float], t: float) -> Call[Streamed]:
        """Send the next position of a stream, rad, with the sender's time stamp, s; the stream ends by itself."""
        return Call("stream_position", {"q": list(q), "stamp_s": t}, _streamed)

    @Method
    def open_stream(self) -> Call[Stream]:
        """Begin a stream of setpoints, sent without waiting for answers: 1 kHz and more; leave its block to end it.

        Raises:
            Refused: as any motion.
        """
        from rtcp.api.stream import Stream  # here: numpy loads slowly, and a command has no use for it

        return Call("open_stream", {}, Stream.from_json)

    # -- kinematics ---------------------------------------------------------------------------------------------------

    @Method
    def fk(self, q: Sequence[float]) -> Call[Pose]:
        """Return the pose of the tool, x y z, m, rx ry rz, rad, at joint positions, rad, within their limits or not."""
        return Call("fk", {"q": list(q)}, lambda answer: tuple(answer["pose"]))

    @Method
    def ik(self, pose: Sequence[float], near: Sequence[float] | None = None) -> Call[Positions]:
        """Return the joint positions, rad, that bring the tool to a pose, m and rad, under the limits in force.

        Args:
            pose: x y z, m, and rx ry rz, rad, with R = Rx Ry Rz.
            near: rad; of several solutions the nearest to these; None: to where the arm is.

        Raises:
            Refused: reason `out_of_reach` (`distance`, m, 0: only the orientation), `joint_limited` (`axis`, `joint`),
                `in_box` (`box`: which, in words), `no_geometry`.
        """
        params = {"pose": list(pose), "near": None if near is None else list(near)}
        return Call("ik", params, lambda answer: tuple(answer["q"]))

    # -- inputs, outputs, limits, zero, objects -----------------------------------------------------------------------

    @Method
    def read_io(self) -> Call[Terminals]:
        """Return the levels of all inputs and outputs of the IO boxes."""
        return Call("read_io", {}, Terminals.from_json)

    @Method
    def wait_io(self, name: str, value: bool = True, timeout_s: float | None = None) -> Call[None]:
        """Return when an input, or an output, has a level; a level of one cycle counts. Needs no lease.

        Args:
            name: of `inputs.named` or `outputs.named` in the arm's file, of a function there, or `box.number`.
            value: the level; True: high.
            timeout_s: s; None: for ever.

        Raises:
            TimedOut: reason `level_not_reached` (`name`, `value`, `timeout_s`).
            Invalid: reason `unknown_terminal` (`name`, `allowed`).
        """
        return Call("wait_io", {"name": name, "value": value, "timeout_s": timeout_s}, _nothing)

    @Method
    def set_output(self, output: int | str, value: bool | float, box: str | None = None) -> Call[None]:
        """Set an output by its name (`wait_io`), or one of an IO box counted from 1; `box`: needed with several.

        An output with a number, `slave.channel`, is set in its unit.

        Raises:
            Refused: reasons `channel_out_of_range` (`lowest`, `highest`), `channel_not_settable`, `reserved_output`.
            Invalid: reason `unknown_terminal` (`name`, `allowed`).
        """
        if isinstance(output, str) and not isinstance(value, bool):
            return Call("set_channel", {"name": output, "value": float(value)}, _nothing)
        if isinstance(output, str):
            return Call("write_io", {"name": output, "value": value}, _nothing)
        return Call("set_output", {"output": output, "value": value, "box": box}, _nothing)

    @Method
    def gripper(self, open: bool) -> Call[GripperRest]:
        """Open or close the gripper; return when one with a drive is at rest."""
        return Call("move_gripper", {"open": open}, lambda end: GripperRest(end.get("position"), end.get("holds")))

    @Method
    def move_axis(self, axis: str, position: float, speed: float | None = None) -> Call[float]:
        """Move an external axis by its drive's profile; return its position when it is there, m or rad.

        Args:
            axis: its name.
            position: m or rad.
            speed: m/s or rad/s; None: its limit.

        Raises:
            Refused: reasons `axis_out_of_range`, `axis_speed_out_of_range`, `axis_not_homed`, `axis_busy`,
                `axis_disabled`, `axis_mode_missing`; `axis_stopped` (`position`): it was stopped on its way.
            Fault: reason `axis_failed`: its drive did not carry it out.
        """
        params = {"axis": axis, "position": position, "speed": speed}
        return Call("move_axis", params, lambda answer: float(answer["position"]))

    @Method
    def run_axis(self, axis: str, velocity: float, hold_s: float = 0.25, sent_s: float | None = None) -> Call[None]:
        """Run an external axis at a velocity for `hold_s`; return at once, so that other motions can begin.

        A `Robot` that only sleeps meanwhile has to call `status` at least every 0.5 s: the axis of a client that reads
        no reports stops. It also stops when `hold_s` has passed since the last of these calls, when it comes to an end
        of its range, and when this robot is closed.

        Args:
            axis: its name.
            velocity: m/s or rad/s.
            hold_s: s, at most 3600.
            sent_s: as for `jog`.

        Raises:
            Refused: as `move_axis`.
        """
        return Call("run_axis", {"axis": axis, "velocity": velocity, **_expiry(hold_s, sent_s)}, _nothing)

    @Method
    def home_axis(self, axis: str) -> Call[float]:
        """Let the drive of an external axis search its home; return its position afterwards, m or rad.

        `homing_method` says what it does.

        Raises:
            Refused: reasons `axis_mode_missing`, `axis_busy`, `axis_disabled`, `axis_stopped`.
            Fault: reason `homing_failed`.
        """
        return Call("home_axis", {"axis": axis}, lambda answer: float(answer["position"]))

    @Method
    def stop_axis(self, axis: str) -> Call[None]:
        """Halt an external axis; return when it rests. Needs no lease."""
        return Call("stop_axis", {"axis": axis}, _nothing)

    @Method
    def limits(self) -> Call[Json]:
        """Return the limits in force beside the configured ones, as `rtcp limits show --json` prints them."""
        return Call("limits", {}, _as_is)

    @Method
    def joint_limits(self) -> Call[tuple[JointLimits, ...]]:
        """Return the limits of the joints that are in force, base to tool."""
        return Call("limits", {}, _joint_limits)

    @Method
    def set_limits(self, changes: Mapping[str, float], *, widen: bool = False) -> Call[Json]:
        """Narrow limits, all or none, until the platform ends; return them.

        Args:
            changes: by key: `joint2.max`, `joints.velocity`, `box.min.x`, `user.max.z`, `supervision.torque`, ...
            widen: whether they may be wider than the configured ones, up to the keys `absolute` of the arm's file; only
                while the drives have no torque.
        """
        return Call("set_limits", {"changes": dict(changes), "widen": widen}, _as_is)

    @Method
    def zero(self, joint: str, at: float = 0.0) -> Call[Zero]:
        """Define the present position of a joint as `at`, rad, now and in the file of offsets; drives have no torque.

        Args:
            joint: its configured name, or its number from 1, as text.
            at: rad
        """
        return Call("zero", {"joint": joint, "at": at}, partial(result, Zero))

    @Method
    def home(self, joint: str, progress: OnProgress | None = None) -> Call[float]:
        """Run the homing of a joint's drive; return its position afterwards, rad. `homing_method` says what it does.

        Raises:
            Faulted: the drive reports an error, or success at a position that is not its home offset.
        """
        return Call("home", {"joint": joint}, lambda answer: float(answer["position"]), progress)

    @Method
    def homing_method(self, joint: str) -> Call[HomingMethod]:
        """Read from a drive what `home`, or of an external axis `home_axis`, would do; nothing moves."""
        return Call("homing_method", {"joint": joint}, partial(result, HomingMethod))

    @Method
    def sdo_read(self, slave: int, index: int, subindex: int = 0) -> Call[bytes]:
        """Read an object of the slave at position `slave`, from 1."""
        params = {"slave": slave, "index": index, "subindex": subindex}
        return Call("sdo_read", params, lambda answer: bytes.fromhex(answer["hex"]))

    @Method
    def sdo_write(self, slave: int, index: int, subindex: int, data: bytes) -> Call[None]:
        """Write an object of the slave at position `slave`, from 1; only while no drive has torque."""
        params = {"slave": slave, "index": index, "subindex": subindex, "hex": data.hex()}
        return Call("sdo_write", params, _nothing)

    @Method
    def joystick(
        self, *pressed: str, byte: int | None = None, hold_s: float = 1.0, sent_s: float | None = None
    ) -> Call[None]:
        """Hold the joystick of the virtual IO box for `hold_s`, at most 1 s; nothing pressed: neutral.

        Args:
            pressed: of forward, backward, left, right, mode_up, mode_down, chair, emergency_stop, enabling_switch.
            byte: the joystick's byte instead.
            hold_s: s
            sent_s: as for `jog`.
        """
        return Call("joystick", {"pressed": list(pressed), "byte": byte, **_expiry(hold_s, sent_s)}, _nothing)

    # -- recordings ---------------------------------------------------------------------------------------------------

    @Method
    def record_start(
        self,
        out: str | Path | None = None,
        formats: Sequence[str] = (),
        signals: Sequence[str] = (),
        every: int = 1,
        seconds: float | None = None,
        max_file_mb: int | None = None,
        max_file_seconds: float | None = None,
        keep: int | None = None,
        reserve_mb: int = 256,
    ) -> Call[RecorderStatus]:
        """Start a recording of the cycle; return when it runs.

        Args:
            out: directory, or a file that ends in the name of its only format; None: the platform's own place.
            formats: `mcap`, `csv`, or both; none: the ending of `out`, or mcap.
            signals: names of fields of a cycle record or patterns (`*_position`); none: all, or as CSV the thesis'.
            every: N: every Nth cycle.
            seconds: how long; None: until `record_stop`.
            max_file_mb: size of a file at which the next one begins, MB.
            max_file_seconds: age of a file at which the next one begins, s.
            keep: newest files that are kept, of each format; None: all.
            reserve_mb: free space of the disk below which the recording ends, MB.

        Raises:
            Refused: reason `not_writable` (`file`, `error`), `disk_reserve` (`directory`, `free_mb`, `reserve_mb`).
            Invalid: reason `unknown_signal` (`signal`, `allowed`), `format_mismatch` (`file`, `formats`),
                `keep_without_limit` (`keep`).
        """
        params = {
            "out": None if out is None else str(Path(out).absolute()),
            "formats": list(formats),
            "signals": list(signals),
            "every": every,
            "seconds": seconds,
            "max_file_mb": max_file_mb,
            "max_file_seconds": max_file_seconds,
            "keep": keep,
            "reserve_mb": reserve_mb,
        }
        return Call("record_start", params, partial(result, RecorderStatus))

    @Method
    def record_stop(self, pid: int | None = None) -> Call[list[RecorderStatus]]:
        """End all recordings, or the one of the process `pid`; return their results."""
        return Call("record_stop", {"pid": pid}, _recordings)

    @Method
    def record_status(self) -> Call[list[RecorderStatus]]:
        """Return the recordings that run, and those that have ended since the platform was started."""
        return Call("record_status", {}, _recordings)

    @Method
    def command(self, name: str, /, progress: OnProgress | None = None, **fields: Any) -> Call[Json]:
        """Send a command by its name, also one that a package outside registers (`docs/extending.md`).

        Args:
            name: of the command or of any other method (`docs/protocol.md`).
            progress: called about ten times a second meanwhile.
            fields: its fields; enums by their names in lower case.

        Returns:
            the answer as JSON has it.
        """
        return Call(name, fields, _as_is, progress)


class Robot(Methods, Closing):
    """A connection to the running platform; one call at a time, from one thread.

    Closing it stops its motions: its lease ends, and the arm comes to a controlled stop.

    Args:
        name: of this commander, shown to others that are refused; empty: this process.
        path: the control socket; None: that of the runtime directory.

    Raises:
        NotRunning: nobody listens.
        Refused: the socket is another user's.
    """

    def __init__(self, name: str = "", path: Path | None = None) -> None:
        self._client = ControlClient(name, path)
        try:
            self._client.connect()
        except RtcpError:
            self._client.close()
            raise
        self.directory = runtime_directory() if path is None else path.parent
        """Runtime directory of its platform."""

    def close(self) -> None:
        """Close the connection; a second time is harmless."""
        self._client.close()

    @property
    def state(self) -> State:
        """State of the machine now."""
        return self.status().state

    @property
    def positions(self) -> Positions:
        """Measured joint positions now, rad."""
        return self.status().positions

    @property
    def pose(self) -> Pose | None:
        """Measured pose of the tool now, x y z, m, rx ry rz, rad; None: the geometry is unknown."""
        return self.status().pose

    @property
    def io(self) -> Io:
        """Inputs and outputs by their names."""
        return Io(self)

    @property
    def speed_override(self) -> float:
        """Fraction of its speed at which the arm moves."""
        return self.status().speed_override

    @property
    def processes(self) -> dict[str, Process]:
        """The processes beside motion, by their names."""
        processes = self.status().raw["processes"]
        return {name: Process(self, name, entry["kind"], tuple(entry["commands"])) for name, entry in processes.items()}

    def _carry_out(self, call: Call[T]) -> T:
        return call.result(self._client.call(call.method, call.params, _reader(call)))


class Io:
    """Inputs and outputs of a robot: `robot.io["part_present"]`, `robot.io["blower"] = True`. True is a high level.

    Names are those of `inputs.named` and `outputs.named` in the arm's file, of the functions there, `box.number`, and
    `slave.channel` of analog, encoder and generic slaves: `robot.io["valve.pressure"] = 2.5`, in the channel's unit.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    @property
    def inputs(self) -> Levels:
        """Levels of all inputs now."""
        return self._robot.read_io().inputs

    @property
    def outputs(self) -> Levels:
        """Levels of all outputs now."""
        return self._robot.read_io().outputs

    @property
    def channels(self) -> Mapping[str, Channel]:
        """Channels with a number now."""
        return self._robot.read_io().channels

    def __getitem__(self, name: str) -> bool | float:
        """Return the level of an input, or else of an output, or the value of a channel; raises KeyError."""
        terminals = self._robot.read_io()
        if name in terminals.channels:
            return terminals.channels[name].value
        return terminals.inputs[name] if name in terminals.inputs else terminals.outputs[name]

    def __setitem__(self, name: str, value: bool | float) -> None:
        """Set an output; raises as `Robot.set_output`."""
        self._robot.set_output(name, value)

    def wait(self, name: str, value: bool = True, timeout_s: float | None = None) -> None:
        """Wait as `Robot.wait_io`."""
        self._robot.wait_io(name, value, timeout_s)


class Process:
    """A process of the platform: `robot.processes["heater"]`.

    Args:
        robot: the connection to its platform.
        name: of the process.
        kind: of the process.
        commands: names of the commands that it accepts.
    """

    def __init__(self, robot: Robot, name: str, kind: str, commands: tuple[str, ...]) -> None:
        self._robot = robot
        self.name = name
        self.kind = kind
        self.commands = commands

    @property
    def state(self) -> str:
        """Its state in words; empty: it has none."""
        return str(self._robot.status().raw["processes"][self.name]["state"] or "")

    @property
    def fields(self) -> Mapping[str, Any]:
        """Its fields in the newest cycle record, in the units of `rtcp status --json`."""
        published = self._robot.status().raw["devices"].get(self.name, {})
        return {name: field["value"] for name, field in published.items()}

    def command(self, name: str, **fields: Any) -> Any:
        """Send one of its commands; return when it is carried out, of a lasting one when the process has finished.

        Raises:
            Refused: the process does not accept it now.
            Faulted: it ended early; `reason` and `fields` are the cause.
        """
        return self._robot.command(name, **fields)


def command_fields(words: Iterable[str]) -> dict[str, Any]:
    """Return the fields of a command that is written as words, NAME=VALUE, where a value is JSON or a text.

    Raises:
        ValueError: a word is no field.
    """
    found: dict[str, Any] = {}
    for word in words:
        name, separator, value = word.partition("=")
        if not separator or not name:
            raise ValueError(f"{word!r} is not a field of a command: write NAME=VALUE, as target_c=510")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


def _reader(call: Call[Any]) -> Callable[[Mapping[str, Any]], object] | None:
    report = call.progress
    return None if report is None else lambda update: report(result(Progress, update))


def connect(name: str = "", path: Path | None = None) -> Robot:
    """Connect to the running platform; arguments and errors as of `Robot`."""
    return Robot(name, path)
