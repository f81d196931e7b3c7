"""Channels of the cycle records for people and tools: the same in a recording and in the live view.

| topic | schema | how often |
|---|---|---|
| `/cycle` | `rtcp_msgs/msg/Cycle`: the fields of the record's schema, or those that were chosen | each record |
| `/joint_states` | `sensor_msgs/msg/JointState`: measured | each record |
| `/joint_commands`, `/joint_targets` | the same: commanded; sent | each record |
| `/tf` | `tf2_msgs/msg/TFMessage`: the frames from base_link to tool0 | up to 100 Hz |
| `/machine` | JSON: state, modes, drive states, inputs and outputs in words | each change |
| `/log` | `foxglove.Log`: events | each |
| `/robot_description` | `std_msgs/msg/String`: the arm as URDF | once |
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from typing import Any

import foxglove
import numpy as np
import numpy.typing as npt

from kinematics.model import ArmModel
from kinematics.urdf import to_urdf
from rtcp.api.feed import Records
from rtcp.config.model import ArmConfig
from rtcp.ipc import schema as record
from rtcp.ipc.cdr import CdrTemplate, stamps
from rtcp.ipc.cycle_channels import CycleChannels, send
from rtcp.ipc.schema import RecordSchema
from rtcp.ipc.states import ControlMode, DriveMode, DriveState, State
from rtcp.motion.planning.interpolation import quaternion

TF_S = 0.01
"""Interval between two transforms, s."""
_HEADER = "std_msgs/Header header\n"
_RULE = "=" * 80 + "\nMSG: "
_HEADER_TYPES = _RULE + "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + _RULE + (
    "builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)  # fmt: skip
_JOINT_STATE = _HEADER + "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n" + _HEADER_TYPES
_TF = (
    "geometry_msgs/TransformStamped[] transforms\n" + _RULE + "geometry_msgs/TransformStamped\n" + _HEADER
    + "string child_frame_id\ngeometry_msgs/Transform transform\n" + _RULE + "geometry_msgs/Transform\n"
    + "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n" + _RULE
    + "geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n" + _RULE
    + "geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n" + _HEADER_TYPES
)  # fmt: skip
_JOINTS = {
    "/joint_states": ("actual_position", "actual_velocity", "actual_torque"),
    "/joint_commands": ("commanded_position", None, None),
    "/joint_targets": ("sent_position", "sent_velocity", "sent_torque"),
}
_FLAGS = {
    "clock locked": record.FLAG_DC_LOCKED, "all slaves in OP": record.FLAG_ALL_OP, "enabled": record.FLAG_ENABLED,
    "mode changing": record.FLAG_SWITCHING, "emergency stop": record.FLAG_EMERGENCY_STOP,
    "motion allowed": record.FLAG_MOTION_ALLOWED, "arm has joystick": record.FLAG_ARM_HAS_JOYSTICK,
}  # fmt: skip
_WATCHED = ("state", "drive_mode", "control_mode", "flags")


class UnknownSignal(ValueError):
    """A signal that no record has; the message lists the existing ones."""

    def __init__(self, signal: str, allowed: Sequence[str]) -> None:
        super().__init__(f"{signal}: there is no such signal; allowed are {', '.join(allowed)}")
        self.signal, self.allowed = signal, list(allowed)


def fields_of(schema: RecordSchema, signals: Sequence[str]) -> list[str]:
    """Return the names of the record's fields that match.

    Args:
        schema: schema of the record.
        signals: names of fields or patterns (`*_position`), none: all; number and time are always included.

    Raises:
        UnknownSignal: no field matches.
    """
    for signal in signals:
        if not any(fnmatchcase(name, signal) for name in schema.names):
            raise UnknownSignal(signal, schema.names)
    wanted = (*signals, "number", "time_ns") if signals else ("*",)
    return [name for name in schema.names if any(fnmatchcase(name, signal) for signal in wanted)]


class Channels(CycleChannels):
    """Channels of an arm: cycles, messages, joint states, targets, frames and changes of its machine.

    Args:
        config: the arm.
        schema: schema of its records.
        offset_ns, context: see `CycleChannels`.
        signals: signals of `/cycle`; see `fields_of`.
    """

    def __init__(
        self,
        config: ArmConfig,
        schema: RecordSchema,
        offset_ns: int,
        signals: Sequence[str] = (),
        context: foxglove.Context | None = None,
    ) -> None:
        super().__init__(schema.subset(fields_of(schema, signals)), offset_ns, context)
        self._config = config
        names = [joint.name for joint in config.joints]
        self._joints = {
            topic: (
                self._ros_channel(topic, "sensor_msgs/msg/JointState", _JOINT_STATE),
                sources,
                _joint_template(names, sources),
            )
            for topic, sources in _JOINTS.items()
        }
        self._frames = Frames(config.models) if config.models else None
        self._tf = self._ros_channel("/tf", "tf2_msgs/msg/TFMessage", _TF)
        self._tf_ns = 0
        self._machine = self._json_channel("/machine", {"type": "object", "title": "rtcp.Machine"})
        self._last: npt.NDArray[np.int64] | None = None
        self._inputs, self._outputs = config.terminals(config.inputs), config.terminals(config.outputs)
        self._outputs.pop("heartbeat", None)  # it changes in every cycle
        for places, which in ((self._inputs, "inputs"), (self._outputs, "outputs")):
            for name in [name for name, (box, _) in places.items() if box_field(box, which) not in schema.names]:
                del places[name]  # the recording lacks its box
        self._boxes = _masks(self._inputs, "inputs") | _masks(self._outputs, "outputs")
        self._description = self._ros_channel("/robot_description", "std_msgs/msg/String", "string data\n")

    def describe(self, time_ns: int) -> None:
        """Publish the arm's URDF, where its geometry is known; `/machine` follows with the next record."""
        self._last = None
        if self._config.arm is not None:
            (message,) = CdrTemplate().string(urdf_of(self._config)).fill(1, {})
            self._description.log(message, log_time=time_ns)

    def repeat(self, topic: str) -> None:
        """Publish the last message of a topic without regular messages again, for a new subscriber."""
        if topic == self._description.topic():
            self.describe(self.wall_ns(time.monotonic_ns()))
        elif topic == self._machine.topic():
            self._last = None  # the next record counts as a change

    def publish(self, records: Records, chosen: Records | None = None) -> None:
        """Publish cycle records, oldest first; a channel without listeners costs nothing.

        Args:
            records: all records, for the changes.
            chosen: records whose values are published; None: all.
        """
        if len(records) and self._machine.has_sinks():
            self._publish_changes(records, (records["time_ns"] + self._offset_ns).tolist())
        records = records if chosen is None else chosen
        if not len(records):
            return
        super().publish(records)
        time_ns = records["time_ns"] + self._offset_ns
        instants = time_ns.tolist()
        for channel, sources, template in self._joints.values():
            if channel.has_sinks():
                values = {name: records[name] for name in sources if name}
                send(channel, instants, template.fill(len(records), {**stamps(time_ns), **values}))
        if self._frames is not None and self._tf.has_sinks():
            self._publish_frames(records, time_ns)

    def _publish_frames(self, records: Records, time_ns: npt.NDArray[Any]) -> None:
        assert self._frames is not None
        chosen = []
        for at, instant in enumerate(time_ns.tolist()):
            if instant - self._tf_ns >= TF_S * 1e9:
                # Count from the due time, so that the cycle's jitter does not accumulate.
                self._tf_ns = max(self._tf_ns + round(TF_S * 1e9), instant - round(TF_S * 1e9))
                chosen.append(at)
        if chosen:
            due, instants = records[chosen], time_ns[chosen]
            send(self._tf, instants.tolist(), self._frames.messages(due["actual_position"], due["tool"], instants))

    def _publish_changes(self, records: Records, instants: Sequence[int]) -> None:
        columns = [
            *(records[name] for name in _WATCHED),
            *(records[name] & mask for name, mask in self._boxes.items()),
            *records["drive_state"].T,
        ]
        rows = np.column_stack([column.astype(np.int64) for column in columns])
        before = np.vstack([rows[:1] - 1 if self._last is None else self._last, rows[:-1]])
        for at in np.flatnonzero((rows != before).any(axis=1)).tolist():
            row = rows[at].tolist()
            self._machine.log(self._in_words(row), log_time=instants[at])
        self._last = rows[-1]

    def _in_words(self, row: Sequence[int]) -> dict[str, Any]:
        (state, drive_mode, control_mode, flags), words = row[: len(_WATCHED)], row[len(_WATCHED) + len(self._boxes) :]
        boxes = dict(zip(self._boxes, row[len(_WATCHED) :], strict=False))
        config = self._config
        drives = {joint.name: DriveState(word).words for joint, word in zip(config.joints, words, strict=True)}
        return {
            "state": State(state).words,
            "drive_mode": _name(DriveMode, drive_mode),
            "control_mode": _name(ControlMode, control_mode),
            "flags": [name for name, bit in _FLAGS.items() if flags & bit],
            "drives": drives,
            "inputs": {name: _level(boxes, place, "inputs") for name, place in self._inputs.items()},
            "outputs": {name: _level(boxes, place, "outputs") for name, place in self._outputs.items()},
        }


def urdf_of(config: ArmConfig) -> str:
    """Return the arm as URDF; the geometry must be known."""
    assert config.arm is not None
    return to_urdf(config.arm, [joint.torque for joint in config.joints])


Terminal = tuple[str, int]
"""Box and number, from 1."""


def box_field(box: str, which: str) -> str:
    """Return the name of the record's field with the `inputs` or the `outputs` of a box."""
    return f"{record.identifier(box)}_{which}"


def _masks(places: Mapping[str, Terminal], which: str) -> dict[str, int]:
    masks: dict[str, int] = {}
    for box, number in places.values():
        name = box_field(box, which)
        masks[name] = masks.get(name, 0) | 1 << number - 1
    return masks


def _level(words: Mapping[str, int], place: Terminal, which: str) -> bool:
    box, number = place
    return bool(words[box_field(box, which)] >> number - 1 & 1)


def _name(kind: Any, value: int) -> str:
    return str(kind(value).name).lower() if value in kind._value2member_map_ else str(value)


def _joint_template(names: Sequence[str], sources: Sequence[str | None]) -> CdrTemplate:
    template = CdrTemplate().stamp("base_link").count(len(names))
    for name in names:
        template.string(name)
    for source in sources:
        if source is None:
            template.count(0)
        else:
            template.count(len(names)).numbers(source, "<f8", len(names))
    return template


class Frames:
    """The transforms from link to link, base_link to tool0, by the names of the arm's URDF."""

    def __init__(self, models: Sequence[ArmModel]) -> None:
        self._rows = models[0].rows
        self._places = np.array([model.tool.position for model in models])
        self._turns = np.array([(x, y, z, w) for w, x, y, z in (quaternion(model.tool.rotation) for model in models)])
        count = len(self._rows)
        links = ["base_link", *(f"link{number}" for number in range(1, count + 1)), "tool0"]
        self._suffixes = [str(at) for at in range(count + 1)]
        self._template = CdrTemplate().count(count + 1)
        for at, (parent, child) in enumerate(pairwise(links)):
            self._template.stamp(parent, str(at)).string(child).numbers(f"place{at}", "<f8", 3)
            self._template.numbers(f"turn{at}", "<f8", 4)

    def messages(self, q: npt.NDArray[Any], tools: npt.NDArray[Any], time_ns: npt.NDArray[Any]) -> list[bytes]:
        """Return the messages for joint positions, shape (N, joints), rad, and tools at instants, shape (N,), ns."""
        values = dict(stamps(time_ns, self._suffixes))
        for at, row in enumerate(self._rows):
            # Modified DH: Rx(alpha) Tx(a) Rz(theta) Tz(d).
            half, theta = row.alpha / 2, (q[:, at] + row.offset) / 2
            sine, cosine = np.sin(half), np.cos(half)
            values[f"place{at}"] = np.tile((row.a, -np.sin(row.alpha) * row.d, np.cos(row.alpha) * row.d), (len(q), 1))
            values[f"turn{at}"] = np.column_stack(
                (sine * np.cos(theta), -sine * np.sin(theta), cosine * np.sin(theta), cosine * np.cos(theta))
            )
        last = len(self._rows)
        values[f"place{last}"], values[f"turn{last}"] = self._places[tools], self._turns[tools]
        return self._template.fill(len(q), values)
