"""Answers of the platform as frozen dataclasses. SI units; one number a joint, base to tool."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from rtcp.ipc.robot_status import RobotStatus
from rtcp.ipc.states import ControlMode, DriveMode, State

T = TypeVar("T")
Positions = tuple[float, ...]
"""rad, or rad/s, or Nm: one number a joint."""
Pose = tuple[float, ...]
"""Six numbers: x y z, m, rx ry rz, rad, R = Rx Ry Rz; or their velocities."""


def result(kind: type[T], answer: Mapping[str, Any]) -> T:
    """Return a result of this type from an answer's keys: lists as tuples, a state by its name."""
    values: dict[str, Any] = {}
    for name in (item.name for item in fields(kind)):  # type: ignore[arg-type]
        if name in answer:
            value = answer[name]
            values[name] = (
                tuple(value) if isinstance(value, list) else State[value.upper()] if name == "state" else value
            )
    return kind(**values)


@dataclass(frozen=True)
class Payload:
    """The load in the tool."""

    mass: float = 0.0
    """kg"""
    centre: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Of mass, x y z in the frame of the tool, m."""


@dataclass(frozen=True)
class AxisStatus:
    """An external axis."""

    unit: str
    """Unit of its positions, m or rad."""
    position: float
    """Measured position."""
    velocity: float
    """Measured velocity, unit/s."""
    target_position: float
    """Last set-point of profile position."""
    target_velocity: float
    """Target velocity of profile velocity, unit/s."""
    mode: int
    """Mode of operation that its drive displays: 1 profile position, 3 profile velocity, 6 homing."""
    drive_state: str
    """State of its drive in words."""
    moving: bool
    """Whether a motion is under way, or the axis comes to rest."""
    homed: bool
    """Whether its positions count from its home, or it needs none."""


@dataclass(frozen=True)
class Status:
    """The platform at one instant."""

    state: State
    message: str
    """The last event in words; in a fault: its cause."""
    drive_mode: DriveMode | None
    """None: the drives show another mode than those the cycle uses."""
    control_mode: ControlMode | None
    """None: before the first cycle."""
    joint_names: tuple[str, ...]
    positions: Positions
    """Actual positions, rad."""
    velocities: Positions
    """Actual velocities, rad/s."""
    torques: Positions
    """Actual torques, Nm."""
    commanded_positions: Positions
    """Setpoints of the controller, rad."""
    sent_positions: Positions
    """Target positions in the frame as sent, rad."""
    goal: Positions | None
    """Joint positions at the end of the motion under way, rad; None: nothing moves, the arm stops, or the motion has no
    known end (jog, stream, a package's own command)."""
    pose: Pose | None
    """Measured pose of the tool, x y z, m, rx ry rz, rad, R = Rx Ry Rz, base frame; None: the geometry is unknown."""
    tool_velocity: Pose | None
    """Measured velocity of the tool, vx vy vz, m/s, wx wy wz, rad/s, along and about the axes of the base; or None."""
    commanded_pose: Pose | None
    """Pose of the tool at `commanded_positions`; or None."""
    robot: RobotStatus
    """As ROS-Industrial has it."""
    holder: str
    """Who commands the arm; empty: nobody."""
    speed_override: float
    """Fraction of its speed at which the arm moves, 0.01 to 1; 0 while its motion is paused."""
    tool: str
    """Name of the tool in use."""
    payload: Payload
    """The load in the tool."""
    axes: Mapping[str, AxisStatus]
    """External axes by name."""
    raw: Mapping[str, Any]
    """Everything that `rtcp status --json` prints."""

    @classmethod
    def from_json(cls, answer: Mapping[str, Any]) -> Status:
        """Read the answer of the method `status`."""
        joints, tool = answer["joints"], answer["tool"] or {}
        return cls(
            state=State[answer["state"].upper()],
            message=answer["message"],
            drive_mode=_mode(DriveMode, answer["drive_mode"]),
            control_mode=_mode(ControlMode, answer["control_mode"]),
            joint_names=tuple(answer["joint_names"]),
            positions=tuple(joints["actual_position"]),
            velocities=tuple(joints["actual_velocity"]),
            torques=tuple(joints["actual_torque"]),
            commanded_positions=tuple(joints["commanded_position"]),
            sent_positions=tuple(joints["sent_position"]),
            goal=_tuple(answer["goal"]),
            pose=_tuple(tool.get("pose")),
            tool_velocity=_tuple(tool.get("velocity")),
            commanded_pose=_tuple(tool.get("commanded_pose")),
            robot=RobotStatus(**answer["robot"]),
            holder=answer["lease"]["holder"],
            speed_override=answer["speed_override"],
            tool=answer["tool_name"],
            payload=result(Payload, answer["payload"]),
            axes={name: result(AxisStatus, axis) for name, axis in answer["axes"].items()},
            raw=answer,
        )


def _tuple(numbers: Sequence[float] | None) -> tuple[float, ...] | None:
    return None if numbers is None else tuple(numbers)


def _mode(kind: Any, name: str) -> Any:
    return kind.__members__.get(name.upper())


@dataclass(frozen=True)
class JointLimits:
    """The limits of a joint that are in force: rad, rad/s, rad/s^2, rad/s^3, Nm."""

    name: str
    min: float
    max: float
    velocity: float
    acceleration: float
    jerk: float
    torque: float


@dataclass(frozen=True)
class Progress:
    """How far a motion is."""

    fraction: float = 0.0
    """0 to 1."""
    remaining_s: float = 0.0
    positions: Positions = ()
    """Actual positions, rad."""
    accepted: bool = False
    """True once, in the report of a joint move or trajectory that the loop has accepted just now."""


@dataclass(frozen=True)
class Arrival:
    """Where a motion ended."""

    positions: Positions
    """Actual positions, rad."""
    error: float
    """Largest distance of a joint from its goal, rad."""
    duration_s: float | None = None
    """Planned duration; None: it was not planned in advance."""
    length_m: float | None = None
    """Length of the path of the tool."""
    slowed: float | None = None
    """Fraction of the requested speed that the joints' limits allowed."""


@dataclass(frozen=True)
class Buffered:
    """State of an open trajectory."""

    room: int
    """Points that can be appended now."""
    ahead_s: float
    """Time until its last point, s."""


@dataclass(frozen=True)
class Preview:
    """The planned path of a motion that has not begun."""

    path: tuple[Positions, ...]
    """Configurations along it, rad, from its begin to its end."""
    duration_s: float
    length_m: float | None = None
    """Length of the path of the tool along lines."""
    slowed: float | None = None
    """Fraction of the requested speed that the joints' limits allow."""


@dataclass(frozen=True)
class Streamed:
    """The arm when a streaming command was accepted."""

    state: State
    positions: Positions
    """Actual positions, rad."""


class Levels(Mapping[str, bool]):
    """Levels of inputs or outputs by name, True: high; also by `box.number` where a terminal has another name."""

    def __init__(self, terminals: Sequence[Mapping[str, Any]]) -> None:
        self._levels = {terminal["name"]: bool(terminal["value"]) for terminal in terminals}
        self._names = {f"{terminal['box']}.{terminal['number']}": terminal["name"] for terminal in terminals}
        self._functions = {terminal["name"] for terminal in terminals if terminal["has_function"]}

    def __getitem__(self, name: str) -> bool:
        if name not in self._levels and name not in self._names:
            raise KeyError(f"{name}: allowed is one of {', '.join(self._levels) or 'none: there is no IO box'}")
        return self._levels[self._names.get(name, name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._levels)

    def __len__(self) -> int:
        return len(self._levels)

    def has_function(self, name: str) -> bool:
        """Whether the platform reads or writes a terminal itself: such an output cannot be set."""
        return self._names.get(name, name) in self._functions

    @property
    def places(self) -> dict[str, str]:
        """The terminal of each name, as `box.number`."""
        return {name: place for place, name in self._names.items()}

    def __repr__(self) -> str:
        return repr(self._levels)


@dataclass(frozen=True)
class Channel:
    """A numeric channel of an analog, encoder or generic slave."""

    name: str
    """slave.channel"""
    value: float
    unit: str
    is_output: bool
    settable: bool
    """Whether a command may set it: it is an output, and no process writes it."""
    range: tuple[float, float]
    """Smallest and largest value that may be set."""

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Channel:
        """Read an entry of the answer of the method `read_io`."""
        low, high = entry["range"] or (None, None)
        ends = -math.inf if low is None else low, math.inf if high is None else high
        value = math.nan if entry["value"] is None else entry["value"]
        return cls(**{**entry, "range": ends, "value": value})


@dataclass(frozen=True)
class Terminals:
    """The IO boxes and other slaves' channels at one instant."""

    inputs: Levels
    outputs: Levels
    channels: Mapping[str, Channel] = field(default_factory=dict)
    """Numeric channels, by name."""

    @classmethod
    def from_json(cls, answer: Mapping[str, Any]) -> Terminals:
        """Read the answer of the method `read_io`."""
        channels = {entry["name"]: Channel.from_json(entry) for entry in answer["channels"]}
        return cls(Levels(answer["inputs"]), Levels(answer["outputs"]), channels)


@dataclass(frozen=True)
class GripperRest:
    """Where the gripper came to rest; both fields are None for a gripper on a digital output."""

    position: float | None = None
    """rad"""
    holds: bool | None = None
    """Whether an object keeps it from its end position."""


@dataclass(frozen=True)
class Zero:
    """The zero of a joint, rad of its drive; of an external axis in its unit."""

    joint: str
    offset: float
    before: float
    file: str
    """File in which it is kept."""
    unit: str = "rad"
    """m or rad"""


@dataclass(frozen=True)
class HomingMethod:
    """What the homing of a drive does."""

    joint: str
    method: int | None
    """Object 0x6098; None: the drive has no such object."""
    text: str
    """What the drive does, as a verb with its object."""
    declares_present: bool
    """Whether the drive declares its present position to be the home, or does not tell its method."""
    home_offset: float
    """What the drive counts at its home (0x607C), in `unit`."""
    unit: str
    """rad, or m of an external axis."""


@dataclass(frozen=True)
class RecorderStatus:
    """Files and counts of a recorder; final once it has ended."""

    pid: int
    """Of its process."""
    files: tuple[str, ...]
    """Those that it writes, or wrote last: one a format."""
    rotations: int
    """How many files of each format came before them."""
    records: int
    missing: int
    """Cycles that were overwritten before they were read; the file says where."""
    bytes: int
    seconds: float
    problem: str
    """Why it ended early; empty: it did not."""
    running: bool


@dataclass(frozen=True)
class EventRecord:
    """Something that happened in the loop (`rtcp.ipc.events`)."""

    number: int
    """Counted from the start of the platform."""
    time: str
    """ISO 8601, local time."""
    name: str
    fields: Mapping[str, Any]
    message: str
    severity: str = "note"
    """What a person has to do: `emergency_stop`, `fault`, `limit` (reset, and move away), `warning`, `note`."""
