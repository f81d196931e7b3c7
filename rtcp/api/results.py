"""What the platform answers, as frozen dataclasses. SI units; one number a joint, base to tool."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from rtcp.ipc.robot_status import RobotStatus
from rtcp.ipc.states import ControlMode, DriveMode, State

T = TypeVar("T")
Positions = tuple[float, ...]
"""rad, or rad/s, or Nm: one number a joint."""


def result(kind: type[T], found: Mapping[str, Any]) -> T:
    """Return a result of this type from an answer's keys: lists as tuples, a state by its name."""
    values: dict[str, Any] = {}
    for name in (one.name for one in fields(kind)):  # type: ignore[arg-type]
        if name in found:
            value = found[name]
            values[name] = (
                tuple(value) if isinstance(value, list) else State[value.upper()] if name == "state" else value
            )
    return kind(**values)


@dataclass(frozen=True)
class Status:
    """The platform at one instant."""

    state: State
    message: str
    """What happened last; in a fault: why."""
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
    """Target positions in the frame, rad: what left on the wire."""
    goal: Positions | None
    """Joint positions at the end of the motion under way, rad; None: nothing moves, the arm stops, or the motion has no
    known end (jog, stream, a package's own command)."""
    robot: RobotStatus
    """As ROS-Industrial has it."""
    holder: str
    """Who commands the arm; empty: nobody."""
    speed_override: float
    """Fraction of its speed at which the arm moves, 0.01 to 1."""
    raw: Mapping[str, Any]
    """Everything that `rtcp status --json` prints."""

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> Status:
        """Read the answer of the method `status`."""
        joints = found["joints"]
        return cls(
            state=State[found["state"].upper()],
            message=found["message"],
            drive_mode=_mode(DriveMode, found["drive_mode"]),
            control_mode=_mode(ControlMode, found["control_mode"]),
            joint_names=tuple(found["joint_names"]),
            positions=tuple(joints["actual_position"]),
            velocities=tuple(joints["actual_velocity"]),
            torques=tuple(joints["actual_torque"]),
            commanded_positions=tuple(joints["commanded_position"]),
            sent_positions=tuple(joints["sent_position"]),
            goal=None if found["goal"] is None else tuple(found["goal"]),
            robot=RobotStatus(**found["robot"]),
            holder=found["lease"]["holder"],
            speed_override=found["speed_override"],
            raw=found,
        )


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
    """Fraction of the wanted speed that the joints' limits allowed."""


@dataclass(frozen=True)
class Buffered:
    """What an open trajectory still has."""

    room: int
    """Points that can be appended now."""
    ahead_s: float
    """Time until its last point, s."""


@dataclass(frozen=True)
class Preview:
    """The way of a motion that has not begun."""

    path: tuple[Positions, ...]
    """Configurations along it, rad, from its begin to its end."""
    duration_s: float
    length_m: float | None = None
    """Length of the path of the tool along lines."""
    slowed: float | None = None
    """Fraction of the wanted speed that the joints' limits allow."""


@dataclass(frozen=True)
class Streamed:
    """The arm when a streaming command was accepted."""

    state: State
    positions: Positions
    """Actual positions, rad."""


@dataclass(frozen=True)
class GripperRest:
    """Where the gripper came to rest; both fields are None for a gripper on a digital output."""

    position: float | None = None
    """rad"""
    holds: bool | None = None
    """Something keeps it from its end position."""


@dataclass(frozen=True)
class Zero:
    """The zero of a joint, rad of its drive."""

    joint: str
    offset: float
    before: float
    file: str
    """Where it is kept."""


@dataclass(frozen=True)
class RecorderStatus:
    """What a recorder has written up to now, or had written when it ended."""

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
