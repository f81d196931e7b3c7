"""The text of events and refusals: their docstrings, filled in with the names of the configuration."""

from __future__ import annotations

import inspect
import re
import string
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any

from rtcp.config.model import SUPERVISION, VIRTUAL, ArmConfig, Capability
from rtcp.ipc import codes
from rtcp.ipc.commands import COMMANDS, Reset
from rtcp.ipc.events import JOYSTICK_MODES, EmergencyStop
from rtcp.ipc.message import Message
from rtcp.ipc.schema import FIRST_CONE
from rtcp.ipc.states import DriveState, Missing, State
from rtcp.ipc.stop_reactions import StopReaction, reactions

SINGULARITIES = (("shoulder", "m"), ("elbow", "rad"), ("wrist", "rad"))
MISSING_WORDS = {
    Missing.NOTHING: "nothing is missing",
    Missing.CONNECTION: "no message comes from the robot controller: check its cable, the address and port that it "
    "sends to, and that its program runs",
    Missing.MOTORS: "the motors are off: release the stops, then press Motors On (in Hand hold the enabling device)",
    Missing.PROGRAM: "the controller's program is stopped: start it from its main routine",
    Missing.CONTROL: "the controller's program takes no references now: let it run to where it does",
    Missing.CLEARANCE: "the controller reports a fault: see its display, clear it there and start its program again",
    Missing.PACE: "the controller sends at another interval than cycle.period_us says: correct that key, or "
    "\\SampleRate in the controller's program",
}
"""Remedies at a robot controller."""
_RAD = re.compile(r"\brad\b")
"""The unit in messages about one axis, which an external axis may have in metres."""
_MODE_WORDS = {1: "profile position", 3: "profile velocity", 6: "homing"}
_DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")


class Names:
    """Names that a configuration gives to joints, slaves, boxes and reactions.

    Args:
        config: the arm.
        partners: the names of its partners in a cell.
    """

    def __init__(self, config: ArmConfig, partners: Sequence[str] = ()) -> None:
        self.config = config
        self._partners = partners
        self.reactions = reactions(config.stops)
        """The stop reaction to each event that has one."""
        self.faults = frozenset(
            kind
            for kind, reaction in self.reactions.items()
            if kind.is_fault or reaction > StopReaction.CONTROLLED_STOP
        )
        """Events that begin a fault or an emergency stop, by their kind or by their configured reaction."""

    @property
    def file(self) -> str:
        """Name of the configuration file, without its folder."""
        return self.config.source.name or "the configuration"

    def joint(self, axis: int) -> str:
        """Return the name of an axis."""
        axes = self.config.axes
        return axes[axis].name if 0 <= axis < len(axes) else f"joint {axis + 1}"

    def key(self, axis: int) -> str:
        """Return the key of an axis in the file."""
        external = axis - self.config.first_external
        if 0 <= external < len(self.config.external_axes):
            return f"external_axes[{external}]"
        return f"joints[{axis}]" if axis < len(self.config.joints) else "gripper.joint"

    def axis_range(self, axis: int) -> str:
        """Return the range of an axis in words, with the key that sets it."""
        external = axis - self.config.first_external
        axes = self.config.external_axes
        ends = axes[external].position if 0 <= external < len(axes) else None
        if ends is None:
            return f"allowed is what target_position of its drive can express ({self.key(axis)} in {self.file})"
        unit, key = self.config.unit_of(axis), self.key(axis)
        return f"allowed is {ends.min:.6g} to {ends.max:.6g} {unit} ({key}.position in {self.file})"

    def lacks(self, capability: Capability) -> str:
        """Return why the bus lacks a capability; empty: it has it."""
        return self.config.bus.LACKS.get(capability, "")

    def drive(self, about: Any) -> str:
        """Return state and, if it has one, statusword of the drive of an event's axis."""
        axes, slaves = self.config.axes, self.config.slaves
        named = axes[about.axis].slave if 0 <= about.axis < len(axes) else ""
        channels = (e.name for s in slaves if s.name == named for pdo in s.device.tpdo for e in pdo.channels)
        word = f", statusword 0x{about.statusword:04X}" if "statusword" in channels else ""
        return f"{DriveState(about.state).words}{word}"

    def slave(self, position: int) -> str:
        """Return the name of the slave at `position`, from 1."""
        slaves = self.config.slaves
        return slaves[position - 1].name if 1 <= position <= len(slaves) else "not configured"

    def label(self, position: int) -> str:
        """Return the slave at `position` with its name; 0: the master."""
        return f"slave {position} ({self.slave(position)})" if position else "the master"

    def slaves_named(self, first: int, last: int) -> str:
        """Return the names of neighbours on the cable, by the positions of the first and the last."""
        return self.label(first) if first == last else f"{self.label(first)} to {self.label(last)}"

    def left_op(self, about: Any) -> str:
        """Return the state of slaves that left OP, with the remedy if they do not answer."""
        alone = about.slave == about.last
        if about.al_status:
            return f"{'it' if alone else 'each'} is in {codes.status_words(about.al_status, about.code)}"
        first = self.label(about.slave)
        check = f"check the supply of {first} and the cable between {self.label(about.parent)} and {first}"
        return f"{'it does not answer' if alone else 'none of them answers'}; {check}"

    def cable(self, near: int, far: int) -> str:
        """Return the name of a cable by the slaves at its ends."""
        return f"between {self.label(near)} and {self.label(far)}" if far else f"behind {self.label(near)}"

    def channel(self, position: int, number: int) -> str:
        """Return an output channel of the slave at `position`, as SLAVE.CHANNEL."""
        slaves = self.config.slaves
        outputs = slaves[position - 1].device.outputs if 1 <= position <= len(slaves) else ()
        channel = outputs[number].name if 0 <= number < len(outputs) else f"channel {number}"
        return f"{self.slave(position)}.{channel}"

    def process(self, number: int) -> str:
        """Return the name of a process by its place in the configuration, from 0."""
        processes = self.config.processes
        return processes[number].name if 0 <= number < len(processes) else "not configured"

    def box(self, which: int) -> str:
        """Return name and key of a keep-out box, of the box that the tool stays in (-1), of a cone, else of the arm."""
        boxes = self.config.cartesian.keep_out
        if cone := self.cone(which):
            return f"the cone {cone} (cartesian.cones[{which - FIRST_CONE}] in {self.file})"
        if 0 <= which < len(boxes):
            return f"the keep-out box {boxes[which].name} (cartesian.keep_out[{which}] in {self.file})"
        if which >= 0:
            return f"the clearance of the arm's own bodies (cartesian.clearance in {self.file})"
        return f"the box that the tool stays in (cartesian.box in {self.file})"

    def cone(self, which: int) -> str:
        """Return the name of a cone by its number among boxes and cones; empty: it is that of something else."""
        cones = self.config.cartesian.cones
        return cones[which - FIRST_CONE].name if 0 <= which - FIRST_CONE < len(cones) else ""

    def tool(self, number: int) -> str:
        """Return the name of a tool."""
        names = self.config.tool_names
        return names[number] if 0 <= number < len(names) else f"number {number}"

    def partner(self, which: int) -> str:
        """Return the name of a partner in the cell."""
        return self._partners[which] if 0 <= which < len(self._partners) else f"partner {which + 1}"

    def link(self, number: int) -> str:
        """Return the name of a link: that of the joint that moves it."""
        return f"the link of {self.joint(number - 1)}" if number else "the base"

    def lost_cycles(self) -> str:
        """Return the keys that set the number of cycles that may be lost."""
        bus = self.config.bus
        if bus.interface == VIRTUAL and bus.timeout_scale != 1:
            return f"bus.lost_cycles times bus.timeout_scale, {bus.timeout_scale:g},"
        return "bus.lost_cycles"

    def reaction(self, event: Any) -> str:
        """Return the stop reaction to an event, the key that sets it, and the reset where it is needed."""
        stop_reaction = self.reactions[type(event)]
        words = stop_reaction.words
        if isinstance(event, EmergencyStop):
            words += " at once" if stop_reaction is StopReaction.TORQUE_OFF else ", then torque off"
        if event.stop_key:
            words += f" (stops.{event.stop_key} in {self.file})"
        hold = event.is_fault or stop_reaction is StopReaction.CONTROLLED_STOP
        return words if hold else f"{words}; then `rtcp reset`"

    def message(self, about: Message) -> str:
        """Return the text of an event or a refusal: what happened, where, and what to do."""
        template = " ".join(inspect.cleandoc(type(about).__doc__ or about.name).split())
        if self.config.unit_of(getattr(about, "axis", -1)) == "m":
            template = _RAD.sub("m", template)
        return _Template(self, about).format(template)


_WORDS: dict[str, Callable[[Names, Any], object]] = {
    "file": lambda names, about: names.file,
    "joint": lambda names, about: names.joint(about.axis),
    "joint_or_box": lambda names, about: (
        names.joint(about.axis) if about.axis >= 0 else ("the supervision", "the Cartesian limits")[about.axis + 2]
    ),
    "key": lambda names, about: names.key(about.axis),
    "mode_words": lambda names, about: _MODE_WORDS.get(about.mode, f"mode {about.mode}"),
    "axis_range": lambda names, about: names.axis_range(about.axis),
    "drive_words": lambda names, about: names.drive(about),
    "mode_reason": lambda names, about: (
        names.lacks("torque") or "it has no process data for that (rpdo and tpdo in its device file)"
    ),
    "homing_reason": lambda names, about: (
        names.lacks("homing")
        or "the PDOs of its drive lack modes_of_operation or modes_of_operation_display, so it stays in CSP"
    ),
    "homing_tolerance": lambda names, about: names.config.homing.tolerance,
    "rest_s": lambda names, about: names.config.homing.rest_s,
    "all_in_op": lambda names, about: "the controller sends" if names.lacks("states") else "all slaves are in OP",
    "not_in_op": lambda names, about: (
        "the robot controller sends nothing" if names.lacks("states") else "not all slaves are in OP"
    ),
    "missing_words": lambda names, about: MISSING_WORDS[about.missing],
    "low": lambda names, about: names.config.axes[about.axis].position.min,
    "high": lambda names, about: names.config.axes[about.axis].position.max,
    "unit": lambda names, about: "rad" if names.cone(about.box) else "m",
    "box_name": lambda names, about: names.box(about.box),
    "tool_name": lambda names, about: names.tool(about.tool),
    "planned_tool": lambda names, about: names.tool(about.planned),
    "partner_name": lambda names, about: names.partner(about.partner),
    "first_link": lambda names, about: names.link(about.first),
    "second_link": lambda names, about: names.link(about.second),
    "clearance": lambda names, about: names.config.cartesian.clearance,
    "process_name": lambda names, about: names.process(about.process),
    "channel_name": lambda names, about: names.channel(about.slave, about.channel),
    "slave_name": lambda names, about: names.slave(about.slave),
    "slave_label": lambda names, about: names.label(about.slave),
    "other_label": lambda names, about: names.label(about.other),
    "first_slave": lambda names, about: names.label(1),
    "slaves_named": lambda names, about: names.slaves_named(about.slave, about.last),
    "are": lambda names, about: "is" if about.slave == about.last else "are",
    "left_words": Names.left_op,
    "falls_words": lambda names, about: (
        f"; it left OP {about.falls} times since the last report" if about.falls > 1 else ""
    ),
    "refusal_words": lambda names, about: codes.refusal(
        names.label(about.slave), about.requested, about.al_status, about.code
    ),
    "set_up_reason": lambda names, about: (
        f"it is in {codes.status_words(about.al_status, about.code)}" if about.al_status else "it was without supply"
    ),
    "cable": lambda names, about: names.cable(about.near, about.far),
    "frames_counted": lambda names, about: "1 damaged frame" if about.count == 1 else f"{about.count} damaged frames",
    "times": lambda names, about: _times(about.count),
    "began": lambda names, about: time.strftime("%H:%M:%S", time.localtime(about.began_ns * 1e-9)),
    "error_meaning": lambda names, about: codes.error_meaning(about.error_code),
    "error_advice": lambda names, about: codes.error_advice(about.error_code),
    "error_words": lambda names, about: codes.error_words(about.error_code),
    "data_bytes": lambda names, about: (about.data & (1 << 40) - 1).to_bytes(5, "big").hex(" "),
    "slave_axis_words": lambda names, about: f", axis {about.slave_axis}" if about.slave_axis > 1 else "",
    "repeated": lambda names, about: f" ({_times(about.again)} again in {about.seconds:.0f} s)" if about.again else "",
    "messages_of": lambda names, about: (
        f"emergency messages of slave {about.slave}" if about.slave else "failures of the bus"
    ),
    "reaction": Names.reaction,
    "lost_cycles": lambda names, about: names.lost_cycles(),
    "enable_timeout": lambda names, about: names.config.enable_timeout_s,
    "supervision": lambda names, about: f"{names.config.supervision.cycles} cycles (supervision in {names.file})",
    "threshold": lambda names, about: SUPERVISION[about.quantity % 3],
    "torque_time": lambda names, about: names.config.supervision.torque_s,
    "joystick_mode": lambda names, about: JOYSTICK_MODES[about.mode % len(JOYSTICK_MODES)],
    "direction_name": lambda names, about: _DIRECTIONS[about.direction % len(_DIRECTIONS)],
    "singularity": lambda names, about: SINGULARITIES[about.which % 3][0],
    "singularity_unit": lambda names, about: SINGULARITIES[about.which % 3][1],
    "command_name": lambda names, about: COMMANDS[about.command].name,
    "accepting_states": lambda names, about: ", ".join(sorted(state.words for state in COMMANDS[about.command].states)),
    "way_out": lambda names, about: _way_out(about.command, about.state),
}
"""Words for the messages beside their own fields."""


class _Template(string.Formatter):
    """Fills in the message of one event or refusal."""

    def __init__(self, names: Names, about: Message) -> None:
        self._names = names
        self._about = about

    def get_value(self, key: int | str, args: Any, kwargs: Any) -> object:
        """Return the value of a field, or that of `_WORDS` with this name."""
        word = _WORDS.get(str(key))
        if word is not None:
            return word(self._names, self._about)
        value = getattr(self._about, str(key))
        return value.name.lower().replace("_", " ") if isinstance(value, IntEnum) else value


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _way_out(number: int, state: State) -> str:
    """Return the command that leads from a state to one that accepts the refused command."""
    command = COMMANDS[number]
    if state in Reset.states:
        return "; `rtcp reset` first"
    if state is State.READY and State.HOLDING in command.states:
        return "; `rtcp enable` first"
    return "; `rtcp disable` first" if command.states == {State.READY} and command.name != "enable" else ""
