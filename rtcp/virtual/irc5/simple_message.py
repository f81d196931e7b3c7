"""Simple Message of RAPID (ROS-Industrial REP-I0004: numbers, REP-I0006: layouts).

A message is its length, msg_type, comm_type, reply_code (int32 each) and a body, little endian and packed; the length
excludes itself. The number of joints of a joint message follows from its length. Units: rad, s.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from math import isfinite
from typing import NamedTuple

LEAST_LENGTH, MOST_LENGTH = 12, 1023
LEAST_JOINTS = 10
"""Number of joints in REP-I0006; longer messages have more."""
_HEADER = struct.Struct("<4i")


class MessageType(IntEnum):
    """Messages of the RAPID tasks; those above 65000 are extensions of `abb/rapid`."""

    PING = 1
    JOINT_POSITION = 10
    JOINT_TRAJ_PT = 11
    STATUS = 13
    MOTORS = 65001
    """1 orders Motors On, 0 Motors Off."""
    BOARD_STATE = 65002
    """Levels of inputs and outputs, bit 0 is number 1."""
    BOARD_OUTPUTS = 65003
    """Levels of the outputs."""


class CommType(IntEnum):
    """Whether a reply follows."""

    TOPIC = 1
    REQUEST = 2
    REPLY = 3


class ReplyCode(IntEnum):
    """0 in all but replies."""

    INVALID = 0
    SUCCESS = 1
    FAILURE = 2


class SpecialSequence(IntEnum):
    """Sequence numbers with a special meaning."""

    START_DOWNLOAD = -1
    END_TRAJECTORY = -3
    STOP_TRAJECTORY = -4


class NotAMessage(Exception):
    """A length outside 12..1023: the rest of the stream is unreadable."""


class Frame(NamedTuple):
    """A message, possibly with unknown numbers."""

    msg_type: int
    comm_type: int
    reply_code: int
    body: bytes


class JointPoint(NamedTuple):
    """A JOINT_TRAJ_PT."""

    sequence: int
    joints: tuple[float, ...]
    """rad."""
    duration: float
    """Time from the previous point, s."""


def pack(msg_type: int, comm_type: int, reply_code: int = 0, body: bytes = b"") -> bytes:
    """Return a message."""
    return _HEADER.pack(LEAST_LENGTH + len(body), msg_type, comm_type, reply_code) + body


def take_frame(data: bytearray) -> Frame | None:
    """Remove the first message from `data` and return it; None: incomplete.

    Raises:
        NotAMessage: the data do not begin with a valid length.
    """
    if len(data) < 4:
        return None
    length = int.from_bytes(data[:4], "little", signed=True)
    if not LEAST_LENGTH <= length <= MOST_LENGTH:
        raise NotAMessage(f"length {length} is outside {LEAST_LENGTH}..{MOST_LENGTH}")
    if len(data) < 4 + length:
        return None
    _, msg_type, comm_type, reply_code = _HEADER.unpack_from(data)
    frame = Frame(msg_type, comm_type, reply_code, bytes(data[_HEADER.size : 4 + length]))
    del data[: 4 + length]
    return frame


def read_joint_point(frame: Frame, joints: int) -> JointPoint | None:
    """Return the point of a JOINT_TRAJ_PT with its first `joints` joints.

    None: another message (only the type distinguishes a JOINT_POSITION of 12 joints from a point of 10), fewer joints,
    or numbers that are not finite.
    """
    sent, remainder = divmod(len(frame.body) - 12, 4)
    if frame.msg_type != MessageType.JOINT_TRAJ_PT or remainder or sent < joints:
        return None
    sequence, *values = struct.unpack(f"<i{sent + 2}f", frame.body)
    if not all(map(isfinite, values)):
        return None
    return JointPoint(sequence, tuple(values[:joints]), values[-1])


def joint_position(sequence: int, joints: Sequence[float]) -> bytes:
    """Return a JOINT_POSITION as a topic; joints in rad, at least ten on the wire."""
    padded = (*joints, *[0.0] * (LEAST_JOINTS - len(joints)))
    return pack(MessageType.JOINT_POSITION, CommType.TOPIC, body=struct.pack(f"<i{len(padded)}f", sequence, *padded))


def read_integer(frame: Frame) -> int | None:
    """Return the integer that is the body of a message; None: the body is another one."""
    return int.from_bytes(frame.body, "little", signed=True) if len(frame.body) == 4 else None


def board_state(inputs: int, outputs: int) -> bytes:
    """Return a BOARD_STATE as a topic."""
    return pack(MessageType.BOARD_STATE, CommType.TOPIC, body=struct.pack("<2i", inputs, outputs))


def status(powered: bool, e_stopped: bool, failed: bool, in_motion: bool, automatic: bool, possible: bool) -> bytes:
    """Return a STATUS as a topic; its error_code is always 0, as in `abb/rapid`."""
    fields = (powered, e_stopped, 0, failed, in_motion, 2 if automatic else 1, possible)
    return pack(MessageType.STATUS, CommType.TOPIC, body=struct.pack("<7i", *fields))
