"""The messages of Simple Message and their bytes (ROS-Industrial REP-I0004: numbers, REP-I0006: layouts).

A body has int32 and float32 without padding, in either byte order. Joints are from base to tool. Units: rad, s.
`JointPoint` is an extension: any number of joints, float64.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from enum import Enum, IntEnum, IntFlag
from typing import ClassVar, TypeAlias

MOST_JOINTS = 24
"""Most joints of JOINT_POSITION and JOINT_TRAJ_PT between programs that agree on it: four arms of six."""
JOINTS = 10
"""Joints of every message except `JointPoint`; unused ones are 0."""
Joints: TypeAlias = tuple[float, ...]


class ByteOrder(Enum):
    """Byte order, a build option of the peer that the protocol does not announce. Values: codes of `struct`."""

    LITTLE = "<"
    BIG = ">"


class MessageType(IntEnum):
    """Supported message types; 12, 20 and 21 are deprecated and have no agreed layout."""

    PING = 1
    GET_VERSION = 2
    JOINT_POSITION = 10
    JOINT_TRAJ_PT = 11
    STATUS = 13
    JOINT_TRAJ_PT_FULL = 14
    JOINT_FEEDBACK = 15
    JOINT_POINT = 65000
    """An extension, from the range that REP-I0004 leaves free."""


class CommType(IntEnum):
    """Communication type: a topic has no answer."""

    TOPIC = 1
    SERVICE_REQUEST = 2
    SERVICE_REPLY = 3


class ReplyCode(IntEnum):
    """Reply code; INVALID in all messages but replies."""

    INVALID = 0
    SUCCESS = 1
    FAILURE = 2


class SpecialSequence(IntEnum):
    """Meaning of a negative sequence number; from 0 it counts the points of a trajectory."""

    START_TRAJECTORY_DOWNLOAD = -1
    START_TRAJECTORY_STREAMING = -2
    END_TRAJECTORY = -3
    STOP_TRAJECTORY = -4


class ValidFields(IntFlag):
    """Valid fields of a point."""

    TIME = 1
    POSITION = 2
    VELOCITY = 4
    ACCELERATION = 8


class TriState(IntEnum):
    """True, false or unknown (industrial_msgs/TriState)."""

    UNKNOWN = -1
    FALSE = 0
    TRUE = 1


class RobotMode(IntEnum):
    """Operating mode, which says who may command the arm (industrial_msgs/RobotMode)."""

    UNKNOWN = -1
    MANUAL = 1
    AUTO = 2


class MessageError(ValueError):
    """Values that a message cannot represent, or a body whose length differs from the layout."""


@dataclass(frozen=True)
class Ping:
    """Checks that the peer answers. REP-I0006 has a body of ten zeros, the reference client none; both are accepted."""

    TYPE: ClassVar = MessageType.PING

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        return b""

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> Ping:
        """Read a body; raises MessageError."""
        if body:
            _unpack(cls.TYPE, order, "10i", body)
        return cls()


@dataclass(frozen=True)
class GetVersion:
    """Ask for a `Version`."""

    TYPE: ClassVar = MessageType.GET_VERSION

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        return b""

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> GetVersion:
        """Read a body; raises MessageError."""
        _unpack(cls.TYPE, order, "", body)
        return cls()


@dataclass(frozen=True)
class Version:
    """The reply to `GetVersion`."""

    TYPE: ClassVar = MessageType.GET_VERSION
    major: int
    minor: int
    patch: int

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        return _pack(self.TYPE, order, "3i", self.major, self.minor, self.patch)

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> Version:
        """Read a body; raises MessageError."""
        major, minor, patch = _unpack(cls.TYPE, order, "3i", body)
        return cls(int(major), int(minor), int(patch))


@dataclass(frozen=True)
class JointPosition:
    """Positions of the joints: actual (state) or commanded now (motion)."""

    TYPE: ClassVar = MessageType.JOINT_POSITION
    sequence: int
    positions: Joints

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        positions = _ten(self.TYPE, self.positions, MOST_JOINTS)
        return _pack(self.TYPE, order, f"i{len(positions)}f", self.sequence, *positions)

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> JointPosition:
        """Read a body, with ten positions or more; raises MessageError."""
        sequence, *positions = _unpack(cls.TYPE, order, f"i{_joints_in(len(body) - 4)}f", body)
        return cls(int(sequence), tuple(positions))


@dataclass(frozen=True)
class JointTrajPt:
    """A point of a trajectory, with the time since the point before."""

    TYPE: ClassVar = MessageType.JOINT_TRAJ_PT
    sequence: int
    positions: Joints
    velocity: float
    """Fraction of the joint limits, 0 to 1."""
    duration: float

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        positions = _ten(self.TYPE, self.positions, MOST_JOINTS)
        layout = f"i{len(positions)}fff"
        return _pack(self.TYPE, order, layout, self.sequence, *positions, self.velocity, self.duration)

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> JointTrajPt:
        """Read a body, with ten positions or more; raises MessageError."""
        layout = f"i{_joints_in(len(body) - 12)}fff"
        sequence, *positions, velocity, duration = _unpack(cls.TYPE, order, layout, body)
        return cls(int(sequence), tuple(positions), velocity, duration)


@dataclass(frozen=True)
class Status:
    """The fields of RobotStatus; by default all unknown."""

    TYPE: ClassVar = MessageType.STATUS
    drives_powered: TriState = TriState.UNKNOWN
    e_stopped: TriState = TriState.UNKNOWN
    error_code: int = -1
    in_error: TriState = TriState.UNKNOWN
    in_motion: TriState = TriState.UNKNOWN
    mode: RobotMode = RobotMode.UNKNOWN
    motion_possible: TriState = TriState.UNKNOWN

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        return _pack(self.TYPE, order, "7i", *astuple(self))

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> Status:
        """Read a body; raises MessageError."""
        powered, stopped, code, error, motion, mode, possible = map(int, _unpack(cls.TYPE, order, "7i", body))
        try:
            states = [TriState(each) for each in (powered, stopped, error, motion, possible)]
            return cls(states[0], states[1], code, states[2], states[3], RobotMode(mode), states[4])
        except ValueError as wrong:
            raise MessageError(f"STATUS: {wrong}") from None


@dataclass(frozen=True)
class JointTrajPtFull:
    """A point of a trajectory, with the time since its start; `valid_fields` names the fields in use."""

    TYPE: ClassVar = MessageType.JOINT_TRAJ_PT_FULL
    robot_id: int
    sequence: int
    valid_fields: ValidFields
    time: float
    positions: Joints
    velocities: Joints = ()
    accelerations: Joints = ()

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        joints = _thirty(self.TYPE, self.positions, self.velocities, self.accelerations)
        return _pack(self.TYPE, order, "3i31f", self.robot_id, self.sequence, self.valid_fields, self.time, *joints)

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> JointTrajPtFull:
        """Read a body, with ten numbers in each field of the joints; raises MessageError."""
        robot, sequence, valid, time, *joints = _unpack(cls.TYPE, order, "3i31f", body)
        return cls(int(robot), int(sequence), ValidFields(int(valid) & 15), time, *_by_ten(joints))


@dataclass(frozen=True)
class JointFeedback:
    """Actual positions, velocities and accelerations of the joints."""

    TYPE: ClassVar = MessageType.JOINT_FEEDBACK
    robot_id: int
    valid_fields: ValidFields
    time: float
    positions: Joints
    velocities: Joints = ()
    accelerations: Joints = ()

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        joints = _thirty(self.TYPE, self.positions, self.velocities, self.accelerations)
        return _pack(self.TYPE, order, "2i31f", self.robot_id, self.valid_fields, self.time, *joints)

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> JointFeedback:
        """Read a body, with ten numbers in each field of the joints; raises MessageError."""
        robot, valid, time, *joints = _unpack(cls.TYPE, order, "2i31f", body)
        return cls(int(robot), ValidFields(int(valid) & 15), time, *_by_ten(joints))


@dataclass(frozen=True)
class JointPoint:
    """Any number of joints, in float64: a point of a trajectory (motion) or the actual values (state).

    `sequence` and `time` are as in `JointTrajPtFull`. Empty velocities or accelerations are not sent.
    """

    TYPE: ClassVar = MessageType.JOINT_POINT
    sequence: int
    time: float
    positions: Joints
    velocities: Joints = ()
    accelerations: Joints = ()

    def pack(self, order: ByteOrder) -> bytes:
        """Return the body."""
        count, valid = len(self.positions), ValidFields.TIME | ValidFields.POSITION
        for field, values in (
            (ValidFields.VELOCITY, self.velocities),
            (ValidFields.ACCELERATION, self.accelerations),
        ):
            if values and len(values) != count:
                raise MessageError(f"JOINT_POINT: {len(values)} numbers beside the positions of {count} joints")
            valid |= field if values else 0
        numbers = (*self.positions, *self.velocities, *self.accelerations)
        if (size := _POINT_HEAD_BYTES + 8 * len(numbers)) > MOST_BODY_BYTES:
            raise MessageError(f"JOINT_POINT: {size} bytes of body for {count} joints; at most {MOST_BODY_BYTES} fit")
        return _pack(self.TYPE, order, f"3id{len(numbers)}d", self.sequence, valid, count, self.time, *numbers)

    @classmethod
    def unpack(cls, body: bytes, order: ByteOrder) -> JointPoint:
        """Read a body; raises MessageError."""
        if len(body) < _POINT_HEAD_BYTES:
            raise MessageError(f"JOINT_POINT: {len(body)} bytes of body; {_POINT_HEAD_BYTES} are its least")
        sequence, bits, count = struct.unpack_from(f"{order.value}3i", body)
        valid = ValidFields(bits & 15)
        if count < 1 or not valid & ValidFields.TIME or not valid & ValidFields.POSITION:
            raise MessageError(f"JOINT_POINT: {count} joints, valid_fields {bits}: it has a time (1) and positions (2)")
        fields = 1 + bool(valid & ValidFields.VELOCITY) + bool(valid & ValidFields.ACCELERATION)
        if len(body) != (size := _POINT_HEAD_BYTES + 8 * fields * count):
            raise MessageError(f"JOINT_POINT: {len(body)} bytes of body; {size} are {fields} fields of {count} joints")
        time, *numbers = struct.unpack_from(f"{order.value}{1 + fields * count}d", body, 12)
        rows = [tuple(numbers[at : at + count]) for at in range(0, fields * count, count)]
        velocities = rows[1] if valid & ValidFields.VELOCITY else ()
        accelerations = rows[-1] if valid & ValidFields.ACCELERATION else ()
        return cls(sequence, time, rows[0], velocities, accelerations)


Message: TypeAlias = (
    Ping | GetVersion | Version | JointPosition | JointTrajPt | Status | JointTrajPtFull | JointFeedback | JointPoint
)
TrajectoryPoint: TypeAlias = JointTrajPt | JointTrajPtFull | JointPoint

MOST_BODY_BYTES = 1023 - 12
"""Largest body: the reference client receives into 1024 bytes without a check; 12 bytes of the length are header."""
_POINT_HEAD_BYTES = 20
_KINDS: dict[int, type[Message]] = {
    kind.TYPE: kind
    for kind in (Ping, GetVersion, JointPosition, JointTrajPt, Status, JointTrajPtFull, JointFeedback, JointPoint)
}


def unpack_message(number: int, body: bytes, order: ByteOrder, is_reply: bool = False) -> Message:
    """Return the message of this type; raises MessageError for an unknown type or a wrong length."""
    if number not in _KINDS:
        raise MessageError(f"message {number} is not known")
    kind = Version if is_reply and number == MessageType.GET_VERSION else _KINDS[number]
    return kind.unpack(body, order)


def _pack(kind: MessageType, order: ByteOrder, layout: str, *values: float) -> bytes:
    try:
        return struct.pack(order.value + layout, *values)
    except (struct.error, OverflowError) as error:
        raise MessageError(f"{kind.name}: {error}") from None


def _unpack(kind: MessageType, order: ByteOrder, layout: str, body: bytes) -> tuple[float, ...]:
    if len(body) != (size := struct.calcsize(order.value + layout)):
        raise MessageError(f"{kind.name}: {len(body)} bytes of body; it has {size}")
    return struct.unpack(order.value + layout, body)


def _joints_in(size: int) -> int:
    """Return the number of joints in positions of `size` bytes; ten where `size` is invalid."""
    joints = size // 4
    return joints if size % 4 == 0 and JOINTS <= joints <= MOST_JOINTS else JOINTS


def _ten(kind: MessageType, values: Sequence[float], most: int = JOINTS) -> Joints:
    """Return the values padded with 0 to ten."""
    if len(values) > most:
        raise MessageError(f"{kind.name}: {len(values)} joints; {most} fit, JOINT_POINT has room for more")
    return (*values, *[0.0] * (JOINTS - len(values)))


def _thirty(kind: MessageType, *fields: Sequence[float]) -> Joints:
    return tuple(value for field in fields for value in _ten(kind, field))


def _by_ten(values: Sequence[float]) -> tuple[Joints, Joints, Joints]:
    return tuple(values[:10]), tuple(values[10:20]), tuple(values[20:])
