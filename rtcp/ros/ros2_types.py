"""The messages of ROS 2 that the arm uses, without ROS: their definitions, encoding (XCDR1) and type hashes (REP 2011).

The common interfaces are from rosbags; missing ones are defined here, or read from `messages` where ROS 1 has the same.
Names are those of ROS: `sensor_msgs/msg/JointState`. The only file that imports rosbags.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from rtcp.ros.ros1_messages import DEFINITIONS

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


@dataclass(frozen=True)
class Field:
    """A field of a message."""

    name: str
    type: str
    """A basic type, like `float64`, or a message type, whose name has slashes."""
    length: int | None
    """Length of an array; 0: a sequence, None: a single value."""

    @property
    def has_numbers(self) -> bool:
        """Whether it is a sequence or an array of numbers."""
        return self.length is not None and self.type != "string" and "/" not in self.type


FOLLOW = "control_msgs/action/FollowJointTrajectory"
GROUP_VALUES = "control_msgs/msg/DynamicInterfaceGroupValues"
CANCEL = "action_msgs/srv/CancelGoal"
TRIGGER = "std_srvs/srv/Trigger"
WITH_TEXT = "diagnostic_msgs/srv/AddDiagnostics"
"""Service of a process' command that has fields: a text, answered as a Trigger is (`rtcp.ros.processes`)."""
STOP_MOTION = "industrial_msgs/srv/StopMotion"
PATH_COMMAND = "industrial_msgs/srv/CmdJointTrajectory"

_AS_IN_ROS_1 = ("control_msgs/msg/JointTolerance", "industrial_msgs/msg/RobotMode",
                "industrial_msgs/msg/ServiceReturnCode", "industrial_msgs/msg/TriState")  # fmt: skip
_MESSAGES = {
    # In rosbags client_gid has the type char, which gives another hash than the .msg file.
    "service_msgs/msg/ServiceEventInfo": """
        uint8 event_type
        builtin_interfaces/Time stamp
        uint8[16] client_gid
        int64 sequence_number""",
    "industrial_msgs/msg/RobotStatus": """
        std_msgs/Header header
        RobotMode mode
        TriState e_stopped
        TriState drives_powered
        TriState motion_possible
        TriState in_motion
        TriState in_error
        int32[] error_codes""",
    "control_msgs/msg/JointComponentTolerance": """
        string joint_name
        uint16 component
        float64 position
        float64 velocity
        float64 acceleration""",
    "control_msgs/msg/InterfaceValue": """
        string[] interface_names
        float64[] values""",
    GROUP_VALUES: """
        std_msgs/Header header
        string[] interface_groups
        control_msgs/InterfaceValue[] interface_values""",
    f"{FOLLOW}_Goal": """
        trajectory_msgs/JointTrajectory trajectory
        trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
        control_msgs/JointTolerance[] path_tolerance
        control_msgs/JointComponentTolerance[] component_path_tolerance
        control_msgs/JointTolerance[] goal_tolerance
        control_msgs/JointComponentTolerance[] component_goal_tolerance
        builtin_interfaces/Duration goal_time_tolerance""",
    f"{FOLLOW}_Result": """
        int32 error_code
        string error_string""",
    f"{FOLLOW}_Feedback": """
        std_msgs/Header header
        string[] joint_names
        trajectory_msgs/JointTrajectoryPoint desired
        trajectory_msgs/JointTrajectoryPoint actual
        trajectory_msgs/JointTrajectoryPoint error
        string[] multi_dof_joint_names
        trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
        trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
        trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error""",
    f"{FOLLOW}_FeedbackMessage": f"""
        unique_identifier_msgs/UUID goal_id
        {FOLLOW}_Feedback feedback""",
}
_SERVICES = {
    TRIGGER: ("", "bool success\nstring message"),
    WITH_TEXT: ("string load_namespace", "bool success\nstring message"),
    STOP_MOTION: ("", "industrial_msgs/ServiceReturnCode code"),
    PATH_COMMAND: ("trajectory_msgs/JointTrajectory trajectory", "industrial_msgs/ServiceReturnCode code"),
    CANCEL: ("action_msgs/GoalInfo goal_info", "int8 return_code\naction_msgs/GoalInfo[] goals_canceling"),
    f"{FOLLOW}_SendGoal": (
        f"unique_identifier_msgs/UUID goal_id\n{FOLLOW}_Goal goal",
        "bool accepted\nbuiltin_interfaces/Time stamp",
    ),
    f"{FOLLOW}_GetResult": ("unique_identifier_msgs/UUID goal_id", f"int8 status\n{FOLLOW}_Result result"),
}
"""Service -> definitions of request and response."""


@cache
def _store() -> Typestore:
    # Imported here: with rclpy it is not needed, and not installed.
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name in _AS_IN_ROS_1:
        types |= get_types_from_msg((DEFINITIONS / f"{name}.msg").read_text(), name)
    for name, text in _MESSAGES.items():
        store.fielddefs.pop(name, None)
        types |= get_types_from_msg(text, name)
    for name, (request, response) in _SERVICES.items():
        types |= _service(name, request, response)
    store.register(types)
    return store


def _service(name: str, request: str, response: str) -> dict[str, Any]:
    """Return the types of a service, with its introspection events, which are part of its hash."""
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import get_types_from_msg

    texts = {f"{name}_Request": request, f"{name}_Response": response}
    types: dict[str, Any] = {part: get_types_from_msg(text, "x/msg/X")["x/msg/X"] for part, text in texts.items()}
    at_most_one = [(Nodetype.SEQUENCE, ((Nodetype.NAME, part), 1)) for part in texts]
    info = (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")
    types[f"{name}_Event"] = [], list(zip(("info", "request", "response"), (info, *at_most_one), strict=True))
    names = ("request_message", "response_message", "event_message")
    types[name] = [], [(field, (Nodetype.NAME, part)) for field, part in zip(names, types, strict=True)]
    return types


def fields_of(name: str) -> list[Field]:
    """Return the fields of a message."""
    from rosbags.interfaces import Nodetype

    fields = []
    defined: list[tuple[str, Any]] = list(_store().fielddefs[name][1])
    for field, definition in defined:
        kind, detail = definition
        inner, length = detail if kind in (Nodetype.SEQUENCE, Nodetype.ARRAY) else (definition, None)
        basic_or_name = inner[1][0] if inner[0] is Nodetype.BASE else inner[1]
        fields.append(Field(field, basic_or_name, 0 if kind is Nodetype.SEQUENCE else length))
    return fields


@cache
def type_hash(name: str) -> str:
    """Return the hash of a message or service, `RIHS01_` and 64 hexadecimal digits."""
    digest: str = _store().hash_rihs01(name)
    return digest


def dds_type(name: str) -> str:
    """Return the name of a type in DDS and Zenoh: `sensor_msgs::msg::dds_::JointState_`."""
    *modules, last = name.split("/")
    return "::".join((*modules, "dds_", f"{last}_"))


def encode(name: str, message: Any) -> bytes:
    """Return a message of `make` in XCDR1, little endian, with its header 00 01 00 00."""
    return bytes(_store().serialize_cdr(message, name, little_endian=True))


def decode(name: str, data: bytes) -> Any:
    """Return the message of XCDR1 data, in either byte order.

    Raises:
        ValueError: no message of this type.
    """
    try:
        return _store().deserialize_cdr(data, name)
    except Exception as error:  # invalid bytes may raise any exception
        raise ValueError(f"{len(data)} bytes are no {name}: {error}") from None


class Family:
    """Creates messages of one family of Python classes; fields without a value are zero or empty.

    Args:
        class_of: returns the class of a type.
        numbers: converts numbers of a type to the sequence that these classes use.
    """

    def __init__(self, class_of: Callable[[str], Any], numbers: Callable[[Iterable[Any], str], Any]) -> None:
        self._class_of, self._numbers = class_of, numbers
        self._made: dict[str, tuple[Any, dict[str, Any], dict[str, str]]] = {}

    def make(self, name: str, /, **fields: Any) -> Any:
        """Return a message."""
        if name not in self._made:
            defined = fields_of(name)
            zeros = {field.name: self._zero(field) for field in defined}
            numbers = {field.name: field.type for field in defined if field.has_numbers}
            self._made[name] = self._class_of(name), zeros, numbers
        kind, zeros, numbers = self._made[name]
        values = {
            field: self._numbers(value, numbers[field]) if field in numbers else value
            for field, value in fields.items()
        }
        return kind(**{**zeros, **values})

    def _zero(self, field: Field) -> Any:
        if field.length is not None:
            return self._numbers([0] * field.length, field.type) if field.has_numbers else []
        return self.make(field.type) if "/" in field.type else {"string": "", "bool": False}.get(field.type, 0)


def _array(values: Iterable[Any], base: str) -> Any:
    return np.array(list(values), "uint8" if base in ("byte", "char") else base)


make = Family(lambda name: _store().types[name], _array).make
"""Creates messages for `encode`."""
