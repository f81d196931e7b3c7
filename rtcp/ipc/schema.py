"""Schema of a cycle record: the fields that the parts of the cycle declare, with type, unit and meaning.

The loop stores the schema with its records, a recording with its messages, both as a message definition: readers look
fields up by name. Nothing here imports numpy (see `rtcp.ipc.layout`).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rtcp.config.model import ExternalAxis

CODES = {"uint8": "B", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q",
         "float32": "f", "float64": "d"}  # fmt: skip
"""Types by their names in ROS 2, and their struct codes."""
_NAME = re.compile(r"[a-z][a-z0-9_]{0,127}")
_LINE = re.compile(r"(\w+?)(?:\[(\d{1,4})\])? ([a-z][a-z0-9_]*)(?:  # ([^,:]*), ([^,:]*): (.*))?")
MOST_NUMBERS = 4096
"""Most numbers of a record: more than any platform has, less than a damaged file may claim."""


class SchemaError(ValueError):
    """A schema that cannot be used: the message says which field and why."""


@dataclass(frozen=True)
class Field:
    """A field of the cycle record.

    Attributes:
        name: lower case, digits and underscores; unique in the record.
        type: a key of `CODES`.
        unit: SI, as `rad/s`; empty: none.
        description: one line.
        shape: empty for one number, (n,) for n of them.
        part: of the cycle that publishes it.
    """

    name: str
    type: str = "float64"
    unit: str = ""
    description: str = ""
    shape: tuple[int, ...] = ()
    part: str = ""

    def __post_init__(self) -> None:
        for problem, bad in (
            ("its name is not of lower case letters, digits and underscores", not _NAME.fullmatch(self.name)),
            (f"its type {self.type} is none of {', '.join(CODES)}", self.type not in CODES),
            (f"its shape is {self.shape}", len(self.shape) > 1 or not 0 <= self.count <= MOST_NUMBERS),
            (f"its unit {self.unit!r} has a comma or a colon", any(mark in self.unit for mark in ",:")),
            (f"its part {self.part!r} has a comma or a colon", any(mark in self.part for mark in ",:")),
            ("its texts are not of one line", not (self.unit + self.part + self.description).isprintable()),
        ):
            if bad:
                raise SchemaError(f"field {self.name!r} of {self.part or 'a driver'}: {problem}")

    @property
    def count(self) -> int:
        """Count of its numbers."""
        return self.shape[0] if self.shape else 1

    @property
    def code(self) -> str:
        """The struct format."""
        return f"{self.count}{CODES[self.type]}" if self.shape else CODES[self.type]

    @property
    def local_name(self) -> str:
        """The name without the prefix of a device's slave."""
        return self.name.removeprefix(f"{identifier(self.part)}_")


def identifier(name: str) -> str:
    """Return a name as prefix of a field's name: lower case, an underscore for each character that is not allowed."""
    return re.sub(r"[^a-z0-9_]", "_", name.lower()).lstrip("_0123456789") or "part"


@dataclass(frozen=True)
class RecordSchema:
    """The fields of a cycle record, in their order. The first is `number`, written last.

    Raises:
        SchemaError: a name occurs twice, or the record is too large.
    """

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        seen: dict[str, str] = {}
        for field in self.fields:
            if field.name in seen:
                owners = f"{seen[field.name] or 'one part'} and {field.part or 'another'}"
                raise SchemaError(f"field {field.name!r} is declared twice, by {owners}: rename one of the slaves")
            seen[field.name] = field.part
        if (count := sum(field.count for field in self.fields)) > MOST_NUMBERS:
            raise SchemaError(f"a record of {count} numbers, at most {MOST_NUMBERS} are possible")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields."""
        return tuple(field.name for field in self.fields)

    def __getitem__(self, name: str) -> Field:
        """Return a field; raises KeyError."""
        for field in self.fields:
            if field.name == name:
                return field
        raise KeyError(name)

    @property
    def format(self) -> str:
        """The struct format, without padding; the record's number again at the end."""
        return "<" + "".join(field.code for field in self.fields) + "Q"

    @property
    def size(self) -> int:
        """Size of a record in the ring: a multiple of 64 bytes."""
        return (struct.calcsize(self.format) + 63) & ~63

    @property
    def joints(self) -> int:
        """Joints of the arm; 0 without one."""
        return next((field.count for field in self.fields if field.name in _VECTORS), 0)

    def subset(self, names: Collection[str]) -> RecordSchema:
        """Return the schema of those fields only."""
        return RecordSchema(tuple(field for field in self.fields if field.name in names))

    def definition(self) -> bytes:
        """Return the schema as a ROS 2 message definition, unit and meaning in comments."""
        lines = [
            f"{field.type}{f'[{field.shape[0]}]' if field.shape else ''} {field.name}  # {field.part}, {field.unit}: "
            f"{field.description}"
            for field in self.fields
        ]
        return ("\n".join(lines) + "\n").encode()

    @classmethod
    def from_definition(cls, definition: bytes) -> RecordSchema:
        """Read what `definition` returned, with or without the comments; raises SchemaError."""
        fields = []
        for line in definition.decode(errors="replace").splitlines():
            match = _LINE.fullmatch(line)
            if match is None:
                raise SchemaError(f"no field of a cycle: {line[:80]!r}")
            kind, count, name, part, unit, description = match.groups()
            shape = (int(count),) if count else ()
            fields.append(Field(name, kind, unit or "", description or "", shape, part or ""))
        if not fields or (fields[0].name, fields[0].type, fields[0].shape) != ("number", "uint64", ()):
            raise SchemaError("no schema of a record: its first field is not `number`, uint64")
        return cls(tuple(fields))


def _fields_of(part: str, *rows: tuple[str, str, str, str]) -> tuple[Field, ...]:
    """Return fields of one number each: name, type, unit and description in a row."""
    return tuple(Field(*row, part=part) for row in rows)


CYCLE_FIELDS = _fields_of(
    "cycle",
    ("number", "uint64", "", "Number of the record, from 1."),
    ("cycle", "uint64", "", "Number of the cycle, from 1."),
    ("time_ns", "int64", "ns", "Wake-up, CLOCK_MONOTONIC."),
    ("dc_time_ns", "int64", "ns", "System time of the reference clock."),
    ("state", "uint8", "", "State of the machine (rtcp.ipc.states.State)."),
    ("flags", "uint16", "", "Bits FLAG_... of rtcp.ipc.schema."),
    ("wkc", "int16", "", "Working counter; -1 without an answer."),
    ("wkc_expected", "int16", "", "Working counter with all slaves."),
    ("missed", "uint32", "", "Ticks skipped since the start."),
    ("lost", "uint32", "", "Cycles in a row without the expected working counter."),
    ("wakeup_ns", "int32", "ns", "Wake-up after its tick."),
    ("exchange_ns", "int32", "ns", "From the wake-up to the answer."),
    ("compute_ns", "int32", "ns", "From the answer to the end of the cycle, of the cycle before."),
    ("dc_offset_ns", "int32", "ns", "Phase of the cycle to the reference clock."),
    ("dc_filtered_ns", "int32", "ns", "The same, filtered."),
    ("fault", "uint32", "", "Number of the event that began the fault; 0 for none."),
    ("limit", "uint32", "", "Number of the event by which a limit ended the last motion; 0 for none."),
    ("enables", "uint32", "", "How often the arm was enabled."),
    ("moves", "uint32", "", "How many motions have begun."),
    ("drives_powered", "int16", "", "Motors: 1 at least one has power, 0 none has, -1 unknown."),
    ("e_stopped", "int16", "", "Emergency stop at an IO box or the robot controller: 1 pressed, 0 not, -1 unknown."),
    ("operating_mode", "int16", "", "Key of the robot controller: 1 manual, 2 automatic, -1 unknown or no key."),
)
"""Fields of every record, for any platform."""
OPERATOR_FIELDS = (Field("joystick_mode", "uint8", "", "0 X-Y, 1 Z-yaw, 2 roll-pitch, 3 gripper.", part="operator"),)
ARM_MODES = (
    Field("drive_mode", "uint8", "", "Commanded mode of operation (CiA 402, 0x6060).", part="arm"),
    Field("control_mode", "uint8", "", "Commands that the arm takes (rtcp.ipc.states.ControlMode).", part="arm"),
    Field("held", "uint32", "", "What holds or slows the motion; bits HELD_... of rtcp.ipc.schema.", part="arm"),
    Field("elapsed_s", "float32", "s", "Time since the motion began.", part="arm"),
    Field("duration_s", "float32", "s", "Duration of the motion, where it is known.", part="arm"),
    Field(
        "speed_override",
        "float64",
        "",
        "Fraction of its speed at which the arm moves; 0: paused.",
        part="arm",
    ),
)
LOAD_FIELDS = (
    Field("tool", "uint8", "", "Number of the tool in use, from 0, in the order of the arm's file.", part="arm"),
    Field("payload_mass", "float64", "kg", "Mass of what the tool holds.", part="arm"),
    *(Field(f"payload_{axis}", "float64", "m", "Its centre in the frame of the tool.", part="arm") for axis in "xyz"),
)
_VECTORS = {
    "actual_position": ("float64", "rad", "Measured position."),
    "actual_velocity": ("float64", "rad/s", "Measured velocity."),
    "actual_torque": ("float64", "Nm", "Measured torque."),
    "commanded_position": ("float64", "rad", "Setpoint after the trajectory guard."),
    "sent_position": ("float64", "rad", "Target position in the frame, after the output limiter."),
    "sent_velocity": ("float64", "rad/s", "Target velocity in the frame."),
    "sent_torque": ("float64", "Nm", "Target torque in the frame."),
    "drive_state": ("uint8", "", "State of the drive (rtcp.ipc.states.DriveState)."),
    "statusword": ("uint16", "", "Statusword of the drive (CiA 402, 0x6041); 0 where it has none."),
}
"""One number a joint each; the drive mode decides which of the targets a drive follows."""
PER_JOINT = tuple(_VECTORS)


def arm_fields(joints: int) -> tuple[Field, ...]:
    """Return the fields of an arm."""
    vectors = [Field(name, *about, shape=(joints,), part="arm") for name, about in _VECTORS.items()]
    return (*ARM_MODES, *vectors, *LOAD_FIELDS)


GRIPPER_FIELDS = _fields_of(
    "gripper",
    ("gripper_actual_position", "float64", "rad", "Measured position at the drive's shaft."),
    ("gripper_actual_velocity", "float64", "rad/s", "Measured velocity."),
    ("gripper_actual_torque", "float64", "Nm", "Measured torque."),
    ("gripper_sent_position", "float64", "rad", "Target position in the frame."),
    ("gripper_drive_state", "uint8", "", "State of the drive (rtcp.ipc.states.DriveState)."),
    ("gripper_statusword", "uint16", "", "Statusword of the drive (CiA 402, 0x6041)."),
)
"""Fields of a gripper with a drive of its own."""


_AXIS_FIELDS = (
    ("actual_position", "float64", "{unit}", "Measured position."),
    ("actual_velocity", "float64", "{unit}/s", "Measured velocity."),
    ("target_position", "float64", "{unit}", "Last set-point of profile position."),
    ("target_velocity", "float64", "{unit}/s", "Target velocity of profile velocity."),
    ("mode", "int16", "", "Mode of operation that the drive displays (CiA 402, 0x6061)."),
    ("drive_state", "uint8", "", "State of the drive (rtcp.ipc.states.DriveState)."),
    ("statusword", "uint16", "", "Statusword of the drive (CiA 402, 0x6041)."),
    ("moving", "uint8", "", "1: a motion is under way, or the axis comes to rest."),
    ("homed", "uint8", "", "1: its positions count from its home, or it needs none."),
)


def axis_fields(axis: ExternalAxis) -> tuple[Field, ...]:
    """Return the fields of an external axis."""
    return tuple(
        device_field(axis.name, Field(name, kind, unit.format(unit=axis.unit), about))
        for name, kind, unit, about in _AXIS_FIELDS
    )


def schema_of(parts: Iterable[Sequence[Field]]) -> RecordSchema:
    """Return the schema of a cycle of these parts; raises SchemaError."""
    return RecordSchema((*CYCLE_FIELDS, *(field for fields in parts for field in fields)))


def arm_schema(joints: int) -> RecordSchema:
    """Return the schema of an arm without devices: the fields that every recording of an arm has."""
    return schema_of((OPERATOR_FIELDS, arm_fields(joints)))


def device_field(part: str, field: Field) -> Field:
    """Return a field as the record has it: named after its part, which is the slave."""
    return replace(field, name=f"{identifier(part)}_{field.name}", part=part)


FLAG_DC_LOCKED = 1
FLAG_ALL_OP = 2
FLAG_ENABLED = 4
FLAG_SWITCHING = 8
FLAG_EMERGENCY_STOP = 16
"""The emergency stop is pressed, or was not read for 0.5 s."""
FLAG_MOTION_ALLOWED = 32
"""The enabling switch is pressed, or there is none."""
FLAG_ARM_HAS_JOYSTICK = 64

HELD_SHOULDER = 1 << 16
"""`held`, bits 0 to 15: a guard or the output limiter cut the target of this joint. From here on, the limit of a jog:
the singularity of the shoulder; elbow and wrist are the next two bits."""
HELD_RANGE_AT, HELD_SPEED_AT = 19, 23
"""4 bits each: 1 + the joint whose range, or whose speed, is the limit; 0: none."""
HELD_BOX_AT = 27
HELD_CONE, HELD_ITSELF = 28, 29
"""5 bits: 1: the box that the tool stays in; 2 + the number of a keep-out box; 2 + 28: a cone of the tool's
orientation; 2 + 29: the arm itself; 0: none."""
FIRST_CONE = 900
"""Number of the first cone (cartesian.cones) where events and refusals name a box."""
