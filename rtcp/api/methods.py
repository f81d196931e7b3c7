"""Every method of a robot, once: what it sends, and what becomes of the answer.

`Robot` and `AsyncRobot` take signature, type hints and docstring from here (`Call` is not seen by their users).
Each method raises `RtcpError` as described there; what a method raises in particular stands in its docstring.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rtcp.api.results import Arrival, EventRecord, GripperRest, Progress, Status, Streamed, Zero
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

T = TypeVar("T")
OnProgress = Callable[[Progress], None]
Json = dict[str, Any]


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request of the control socket (`docs/protocol.md`)."""

    method: str
    params: Mapping[str, Any]
    result: Callable[[Json], T]
    progress: OnProgress | None = None


def _nothing(answer: Json) -> None:
    return None


def _as_is(answer: Json) -> Json:
    return answer


# -- state ------------------------------------------------------------------------------------------------------------


def status(self: object) -> Call[Status]:
    """Return the state of the machine, the joints and the bus."""
    return Call("status", {}, Status.from_json)


def events(self: object, since: int = 0) -> Call[list[EventRecord]]:
    """Return the events after the number `since`, oldest first; the last 256 are kept."""
    return Call("events", {"since": since}, lambda answer: [EventRecord(**one) for one in answer["events"]])


def scan(self: object) -> Call[list[Json]]:
    """Return the slaves as the start found them: identity, PDO entries, and their AL states now."""
    return Call("scan", {}, lambda answer: list(answer["slaves"]))


def enable(self: object) -> Call[None]:
    """Enable all drives; return when the arm holds where it stands."""
    return Call("enable", {}, _nothing)


def disable(self: object) -> Call[tuple[str, ...]]:
    """Stop, remove the torque and return when the drives show that it is gone. Needs no lease.

    Returns:
        drives that were told to, and that no record shows: a gripper's during a fault.
    """
    return Call("disable", {}, lambda answer: tuple(answer["unconfirmed"]))


def reset(self: object) -> Call[State]:
    """Leave a fault or an emergency stop (drives are disabled then), or a stop by a limit (the arm holds).

    Returns:
        the state that was left; `READY` or `HOLDING`: there was nothing to reset.
    """
    return Call("reset", {}, lambda answer: State[answer["from"].upper()])


def halt(self: object) -> Call[None]:
    """Stop every motion, whoever began it; return when the arm holds. Needs no lease."""
    return Call("halt", {}, _nothing)


def mode(self: object, name: ControlMode | DriveMode | str) -> Call[None]:
    """Change the control mode (`joint`, `cartesian`, ...) or the drive mode (`csp`, `csv`, `cst`) at standstill."""
    return Call("mode", {"name": name if isinstance(name, str) else name.name.lower()}, _nothing)


def stop(self: object) -> Call[tuple[str, ...]]:
    """End the platform: stop the arm, disable the drives, leave the bus.

    Returns:
        what could not be left in order, a sentence each.
    """
    return Call("stop", {}, lambda answer: tuple(answer["problems"]))


# -- motions with an end ----------------------------------------------------------------------------------------------


def move_joints(
    self: object,
    q: Sequence[float],
    speed: float | None = None,
    synchronized: bool = True,
    progress: OnProgress | None = None,
) -> Call[Arrival]:
    """Move to joint positions and return when the arm is there.

    Args:
        q: rad, base to tool.
        speed: of the fastest joint, rad/s; None: its limit.
        synchronized: all joints arrive together; else each as soon as it can.
        progress: called about ten times a second meanwhile.

    Raises:
        Refused: a target outside the limits, the wrong state, another commander.
        Faulted: it ended before it arrived.
    """
    params = {"q": list(q), "speed": speed, "synchronized": synchronized}
    return Call("move_joints", params, Arrival.from_json, progress)


def move_pose(
    self: object,
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
    return Call("move_pose", params, Arrival.from_json, progress)


def move_line(
    self: object, poses: Sequence[Sequence[float]], speed: float | None = None, progress: OnProgress | None = None
) -> Call[Arrival]:
    """Move the tool on straight lines through poses (m, rad), at `speed`, m/s; None: its limit."""
    params = {"poses": [list(pose) for pose in poses], "speed": speed}
    return Call("move_line", params, Arrival.from_json, progress)


def run(self: object, file: str, approach: bool = False, progress: OnProgress | None = None) -> Call[Arrival]:
    """Run a motion file (`docs/motion.md`), checked as a whole first.

    Args:
        file: absolute path.
        approach: move by the joints to where it begins.
        progress: called about ten times a second meanwhile.
    """
    return Call("run", {"file": str(file), "approach": approach}, Arrival.from_json, progress)


def run_trajectory(
    self: object, points: Sequence[Mapping[str, Any]], approach: bool = False, progress: OnProgress | None = None
) -> Call[Arrival]:
    """Run a trajectory through points `{"t": s, "q": [rad]}`; `approach`: the joints first move to the first point.

    A point may also have velocities `v` and accelerations `a`.
    """
    params = {"points": [dict(point) for point in points], "approach": approach}
    return Call("run_trajectory", params, Arrival.from_json, progress)


def run_path(
    self: object,
    stops: Sequence[Mapping[str, Any]],
    speed: float | None = None,
    approach: bool = False,
    progress: OnProgress | None = None,
) -> Call[Arrival]:
    """Run a path of straight lines through stops `{"pose": [...]}` or `{"q": [...]}`, each optionally with its `speed`.

    `speed`: of the tool, m/s, where a stop has none. With `approach` the joints first move to the first stop.
    """
    params = {"stops": [dict(stop) for stop in stops], "speed": speed, "approach": approach}
    return Call("run_path", params, Arrival.from_json, progress)


# -- streaming commands -----------------------------------------------------------------------------------------------


def jog(
    self: object,
    velocity: Sequence[float],
    frame: JogFrame | str = "base",
    hold_s: float = 0.25,
    sent_s: float | None = None,
) -> Call[Streamed]:
    """Move with a velocity for `hold_s`; call it again meanwhile to go on. The arm stops by itself.

    Args:
        velocity: of the tool along and about the axes of `frame`, 6 numbers, m/s and rad/s; of the joints, rad/s.
        frame: `base`, `tool` or `joints`.
        hold_s: s
        sent_s: CLOCK_MONOTONIC, s, of the operator's input; a command older than `hold_s` has no effect. None: now.

    Raises:
        TimedOut: it came later than `hold_s` after `sent_s`.
    """
    name = frame if isinstance(frame, str) else frame.name.lower()
    return Call("jog", {"velocity": list(velocity), "frame": name, **_held(hold_s, sent_s)}, Streamed.from_json)


def move_at_velocity(
    self: object, velocity: Sequence[float], hold_s: float = 0.25, sent_s: float | None = None
) -> Call[Streamed]:
    """Move the joints with velocities, rad/s, in control mode `velocity`; `hold_s` and `sent_s` as for `jog`."""
    return Call("move_at_velocity", {"velocity": list(velocity), **_held(hold_s, sent_s)}, Streamed.from_json)


def apply_torque(
    self: object,
    torque: Sequence[float],
    stiffness: float = 0.0,
    damping: float = 0.0,
    hold_s: float = 0.25,
    sent_s: float | None = None,
) -> Call[Streamed]:
    """Add joint torques, Nm, to what carries the weight of the arm, in control mode `torque`.

    Args:
        torque: Nm, one a joint.
        stiffness: fraction, 0 to 1, of each joint's `cst_stiffness`.
        damping: fraction, 0 to 1, of each joint's `cst_damping`.
        hold_s: as for `jog`.
        sent_s: as for `jog`.
    """
    params = {"torque": list(torque), "stiffness": stiffness, "damping": damping, **_held(hold_s, sent_s)}
    return Call("apply_torque", params, Streamed.from_json)


def stream(self: object, q: Sequence[float], t: float) -> Call[Streamed]:
    """Send the next position of a stream, rad, with the sender's time stamp, s; it ends when no more positions come."""
    return Call("stream_position", {"q": list(q), "stamp_s": t}, Streamed.from_json)


def _held(hold_s: float, sent_s: float | None) -> Json:
    return {"hold_s": hold_s, "sent_s": time.monotonic() if sent_s is None else sent_s}


# -- outputs, limits, zero, objects -----------------------------------------------------------------------------------


def set_output(self: object, output: int, value: bool) -> Call[None]:
    """Set a digital output of the IO box, counted from 1."""
    return Call("set_output", {"output": output, "value": value}, _nothing)


def gripper(self: object, open: bool) -> Call[GripperRest]:
    """Open or close the gripper; one with a drive has come to rest when this returns."""
    return Call("move_gripper", {"open": open}, lambda found: GripperRest(found.get("position"), found.get("holds")))


def limits(self: object) -> Call[Json]:
    """Return the limits in force beside the configured ones, as `rtcp limits show --json` prints them."""
    return Call("limits", {}, _as_is)


def set_limits(self: object, changes: Mapping[str, float]) -> Call[Json]:
    """Narrow limits, all or none, until the platform ends; return them.

    Args:
        changes: by key: `joint2.max`, `joints.velocity`, `box.min.x`, `user.max.z`, ...
    """
    return Call("set_limits", {"changes": dict(changes)}, _as_is)


def zero(self: object, joint: str, at: float = 0.0) -> Call[Zero]:
    """Define the present position of a joint as `at`, rad, now and in the file of offsets; drives have no torque.

    Args:
        joint: its configured name, or its number from 1, as text.
        at: rad
    """
    return Call("zero", {"joint": joint, "at": at}, lambda found: Zero(**found))


def home(self: object, joint: str, progress: OnProgress | None = None) -> Call[float]:
    """Run the homing of a joint's drive; return its position afterwards, rad."""
    return Call("home", {"joint": joint}, lambda found: float(found["position"]), progress)


def sdo_read(self: object, slave: int, index: int, subindex: int = 0) -> Call[bytes]:
    """Read an object of the slave at position `slave`, from 1."""
    params = {"slave": slave, "index": index, "subindex": subindex}
    return Call("sdo_read", params, lambda found: bytes.fromhex(found["hex"]))


def sdo_write(self: object, slave: int, index: int, subindex: int, data: bytes) -> Call[None]:
    """Write an object of the slave at position `slave`, from 1; only while no drive has torque."""
    params = {"slave": slave, "index": index, "subindex": subindex, "hex": data.hex()}
    return Call("sdo_write", params, _nothing)


def joystick(
    self: object, *pressed: str, byte: int | None = None, hold_s: float = 1.0, sent_s: float | None = None
) -> Call[None]:
    """Hold the joystick of the virtual IO box for `hold_s`, at most 1 s; nothing pressed: neutral.

    Args:
        pressed: of forward, backward, left, right, mode_up, mode_down, chair, emergency_stop, enabling_switch.
        byte: the joystick's byte instead.
        hold_s: s
        sent_s: as for `jog`.
    """
    return Call("joystick", {"pressed": list(pressed), "byte": byte, **_held(hold_s, sent_s)}, _nothing)


def command(self: object, name: str, /, progress: OnProgress | None = None, **fields: Any) -> Call[Json]:
    """Send a command by its name, also one that a package outside registers (`docs/extending.md`).

    Args:
        name: of the command or of any other method (`docs/protocol.md`).
        progress: called about ten times a second meanwhile.
        fields: its fields; enums by their names in lower case.

    Returns:
        the answer as JSON has it.
    """
    return Call(name, fields, _as_is, progress)
