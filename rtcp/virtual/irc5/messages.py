"""EGM messages of the controller: field numbers, encoding and decoding.

The definitions are compiled from the table below into a private descriptor pool, without protoc and without entries in
the process-wide pool. Names and numbers: ABB, Application manual Externally Guided Motion,
3HAC073318-001 rev K; EgmMeasuredForce of RobotWare 6.08 from ros-industrial/abb_libegm, egm.proto V1.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

from rtcp.virtual.irc5.geometry import FlangePose

PACKAGE = "rtcp.virtual.egm"
ROBOT_AXES = 6
"""Number of values in `joints`; further axes are in `externalJoints`."""
LARGEST_VALUE = 1e6
"""Upper bound on values, degrees or degrees/s: beyond any joint, and safe from overflow."""

_MESSAGES = {
    "EgmHeader": "1 seqno uint32, 2 tm uint32, 3 mtype MessageType",
    "EgmCartesian": "1 x required double, 2 y required double, 3 z required double",
    "EgmQuaternion": "1 u0 required double, 2 u1 required double, 3 u2 required double, 4 u3 required double",
    "EgmEuler": "1 x required double, 2 y required double, 3 z required double",
    "EgmClock": "1 sec required uint64, 2 usec required uint64",
    "EgmPose": "1 pos EgmCartesian, 2 orient EgmQuaternion, 3 euler EgmEuler",
    "EgmJoints": "1 joints repeated double",
    "EgmCartesianSpeed": "1 value repeated double",
    "EgmPlanned": "1 joints EgmJoints, 2 cartesian EgmPose, 3 externalJoints EgmJoints, 4 time EgmClock",
    "EgmFeedBack": "1 joints EgmJoints, 2 cartesian EgmPose, 3 externalJoints EgmJoints, 4 time EgmClock",
    "EgmSpeedRef": "1 joints EgmJoints, 2 cartesians EgmCartesianSpeed, 3 externalJoints EgmJoints",
    "EgmMotorState": "1 state required MotorStateType",
    "EgmMCIState": "1 state required MCIStateType",
    "EgmRapidCtrlExecState": "1 state required RapidCtrlExecStateType",
    "EgmTestSignals": "1 signals repeated double",
    "EgmMeasuredForce": "1 fcActive bool, 2 force repeated double",
    "EgmCollisionInfo": "1 collsionTriggered bool, 2 collDetQuota repeated double",  # ABB's spelling
    "EgmRAPIDdata": "1 digVal bool, 2 dnum repeated double",
    "EgmRobot": "1 header EgmHeader, 2 feedBack EgmFeedBack, 3 planned EgmPlanned, 4 motorState EgmMotorState, "
    "5 mciState EgmMCIState, 6 mciConvergenceMet bool, 7 testSignals EgmTestSignals, "
    "8 rapidExecState EgmRapidCtrlExecState, 9 measuredForce EgmMeasuredForce, 10 utilizationRate double, "
    "11 moveIndex uint32, 12 CollisionInfo EgmCollisionInfo, 13 RAPIDfromRobot EgmRAPIDdata, 14 torqueRef EgmJoints",
    "EgmSensor": "1 header EgmHeader, 2 planned EgmPlanned, 3 speedRef EgmSpeedRef, 4 RAPIDtoRobot EgmRAPIDdata",
}
"""Message -> fields: number, name, label (default: optional), type."""
_OF_ROBOTWARE_6 = {"EgmMeasuredForce": "1 force repeated double"}
_ENUMS = {
    "MessageType": ("EgmHeader", "MSGTYPE", "UNDEFINED COMMAND DATA CORRECTION PATH_CORRECTION"),
    "MotorStateType": ("EgmMotorState", "MOTORS", "UNDEFINED ON OFF"),
    "MCIStateType": ("EgmMCIState", "MCI", "UNDEFINED ERROR STOPPED RUNNING"),
    "RapidCtrlExecStateType": ("EgmRapidCtrlExecState", "RAPID", "UNDEFINED STOPPED RUNNING"),
}
"""Enum -> its message, prefix and names of its values, which count from 0."""
_FIELD = descriptor_pb2.FieldDescriptorProto
_LABELS = {"optional": _FIELD.LABEL_OPTIONAL, "required": _FIELD.LABEL_REQUIRED, "repeated": _FIELD.LABEL_REPEATED}
_SCALARS = {
    "double": _FIELD.TYPE_DOUBLE, "uint32": _FIELD.TYPE_UINT32, "uint64": _FIELD.TYPE_UINT64, "bool": _FIELD.TYPE_BOOL,
}  # fmt: skip
_DATA, _CORRECTION = 2, 3
_MOTORS_ON, _MOTORS_OFF = 1, 2
_RAPID_STOPPED, _RAPID_RUNNING = 1, 2


class MciState(IntEnum):
    """State of the motion correction interface, EgmMCIState."""

    ERROR = 1
    STOPPED = 2
    RUNNING = 3


class GarbledDatagram(Exception):
    """A datagram that is not an EgmSensor or has invalid numbers; the message is a sentence."""


class ForeignDatagram(Exception):
    """An EgmSensor without joint corrections for this unit; the message is a sentence."""


@dataclass(frozen=True)
class UnitState:
    """Feedback of a unit in a cycle; joints in degrees, the seventh last."""

    seqno: int
    clock_s: float
    """Controller's clock, s since 1970."""
    actual: tuple[float, ...]
    planned: tuple[float, ...]
    actual_pose: FlangePose
    planned_pose: FlangePose
    motors_on: bool
    rapid_running: bool
    mci: MciState
    converged: bool
    utilization: float
    """%."""
    move_index: int
    collision: bool


@dataclass(frozen=True)
class Reference:
    """References from the PC; joints in degrees and degrees/s, the seventh last. None: not in the datagram."""

    seqno: int
    position: tuple[float, ...] | None
    speed: tuple[float, ...] | None


class EgmCodec:
    """Encodes and decodes the messages of a RobotWare version, 6 or 7."""

    def __init__(self, robotware: int) -> None:
        self._robotware = robotware
        self._robot, self._sensor = _message_classes(robotware)

    def encode(self, state: UnitState) -> bytes:
        """Return the EgmRobot of a cycle, with every field that abb_libegm requires."""
        robot = self._robot()
        robot.header.seqno = state.seqno
        robot.header.tm = int(state.clock_s * 1e3) & 0xFFFFFFFF
        robot.header.mtype = _DATA
        _fill(robot.feedBack, state.actual, state.actual_pose, state.clock_s)
        _fill(robot.planned, state.planned, state.planned_pose, state.clock_s)
        robot.motorState.state = _MOTORS_ON if state.motors_on else _MOTORS_OFF
        robot.mciState.state = state.mci
        robot.mciConvergenceMet = state.converged
        robot.rapidExecState.state = _RAPID_RUNNING if state.rapid_running else _RAPID_STOPPED
        robot.measuredForce.force.extend((0.0,) * 6)
        robot.utilizationRate = state.utilization
        if self._robotware >= 7:
            robot.measuredForce.fcActive = False
            robot.moveIndex = state.move_index
            robot.CollisionInfo.collsionTriggered = state.collision
            robot.CollisionInfo.collDetQuota.extend((0.0,) * len(state.actual))
        encoded: bytes = robot.SerializeToString()
        return encoded

    def decode(self, datagram: bytes, axes: int) -> Reference:
        """Return the reference in a datagram for a unit with `axes` joints.

        Raises:
            GarbledDatagram, ForeignDatagram: it has none.
        """
        sensor = self._sensor()
        try:
            sensor.ParseFromString(datagram)
        except message.DecodeError as error:
            raise GarbledDatagram(f"a datagram of {len(datagram)} bytes is no EgmSensor") from error
        if not sensor.IsInitialized():
            raise GarbledDatagram(f"an EgmSensor of {len(datagram)} bytes lacks required fields")
        if sensor.header.mtype != _CORRECTION:
            raise ForeignDatagram(f"found mtype {sensor.header.mtype}, allowed is {_CORRECTION} (CORRECTION)")
        position, speed = _joints(sensor.planned, axes), _joints(sensor.speedRef, axes)
        if position is None and speed is None:
            raise ForeignDatagram("an EgmSensor without joints: this unit runs EGMRunJoint (event 41826)")
        return Reference(sensor.header.seqno, position, speed)


def _fill(part: Any, joints: tuple[float, ...], pose: FlangePose, clock_s: float) -> None:
    part.joints.joints.extend(joints[:ROBOT_AXES])
    if len(joints) > ROBOT_AXES:
        part.externalJoints.joints.extend(joints[ROBOT_AXES:])
    position, orientation = part.cartesian.pos, part.cartesian.orient
    position.x, position.y, position.z = pose.position
    orientation.u0, orientation.u1, orientation.u2, orientation.u3 = pose.orientation
    part.time.sec = int(clock_s)
    part.time.usec = int((clock_s - int(clock_s)) * 1e6)


def _joints(part: Any, axes: int) -> tuple[float, ...] | None:
    robot = tuple(part.joints.joints)
    values = robot + tuple(part.externalJoints.joints)
    if not values:
        return None
    if len(robot) != ROBOT_AXES or len(values) != axes:
        raise ForeignDatagram(f"found {len(robot)} joints of {len(values)} axes, allowed are {ROBOT_AXES} of {axes}")
    if not all(-LARGEST_VALUE <= value <= LARGEST_VALUE for value in values):  # false for NaN too
        raise GarbledDatagram(f"found joints {values}, allowed are numbers up to {LARGEST_VALUE:g}")
    return values


@cache
def _message_classes(robotware: int) -> tuple[Any, Any]:
    file = descriptor_pb2.FileDescriptorProto(name="rtcp_virtual_egm.proto", package=PACKAGE, syntax="proto2")
    for name, fields in (_MESSAGES | (_OF_ROBOTWARE_6 if robotware < 7 else {})).items():
        kind = file.message_type.add(name=name)
        for written in fields.split(", "):
            number, field, *label, type_name = written.split()
            entry = kind.field.add(name=field, number=int(number), label=_LABELS[label[0] if label else "optional"])
            if type_name in _SCALARS:
                entry.type = _SCALARS[type_name]
            elif type_name in _ENUMS:
                entry.type, entry.type_name = _FIELD.TYPE_ENUM, f".{PACKAGE}.{name}.{type_name}"
            else:
                entry.type, entry.type_name = _FIELD.TYPE_MESSAGE, f".{PACKAGE}.{type_name}"
        for enum, (owner, prefix, values) in _ENUMS.items():
            if owner == name:
                enum_type = kind.enum_type.add(name=enum)
                for value, text in enumerate(values.split()):
                    enum_type.value.add(name=f"{prefix}_{text}", number=value)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    robot, sensor = (pool.FindMessageTypeByName(f"{PACKAGE}.{name}") for name in ("EgmRobot", "EgmSensor"))
    return message_factory.GetMessageClass(robot), message_factory.GetMessageClass(sensor)
