"""The text of events and refusals: their docstrings, filled in with what the configuration calls things."""

from __future__ import annotations

import inspect
import string
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any

from rtcp.config.model import VIRTUAL, ArmConfig, Capability
from rtcp.ipc.commands import COMMANDS, Reset
from rtcp.ipc.events import JOYSTICK_MODES, EmergencyStop
from rtcp.ipc.message import Message
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
"""What people have to do at a robot controller."""
_DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")


class Names:
    """What a configuration calls joints, slaves, boxes and reactions.

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
        """Events that begin a fault or an emergency stop, also because their reaction is configured harder."""

    @property
    def file(self) -> str:
        """The configuration file, without its folder."""
        return self.config.source.name or "the configuration"

    def joint(self, axis: int) -> str:
        """Return the name of an axis."""
        axes = self.config.axes
        return axes[axis].name if 0 <= axis < len(axes) else f"joint {axis + 1}"

    def key(self, axis: int) -> str:
        """Return the key of an axis in the file."""
        return f"joints[{axis}]" if axis < len(self.config.joints) else "gripper.joint"

    def lacks(self, capability: Capability) -> str:
        """Return why the bus does not offer something; empty: it does."""
        return self.config.bus.LACKS.get(capability, "")

    def drive(self, about: Any) -> str:
        """Return what the drive of an event's axis shows: its state, and the statusword where it has one."""
        axes, slaves = self.config.axes, self.config.slaves
        named = axes[about.axis].slave if 0 <= about.axis < len(axes) else ""
        channels = (e.name for s in slaves if s.name == named for pdo in s.device.tpdo for e in pdo.channels)
        word = f", statusword 0x{about.statusword:04X}" if "statusword" in channels else ""
        return f"{DriveState(about.state).words}{word}"

    def slave(self, position: int) -> str:
        """Return the name of the slave at `position`, from 1."""
        slaves = self.config.slaves
        return slaves[position - 1].name if 1 <= position <= len(slaves) else "not configured"

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
        """Return the name and key of a keep-out box, of the box that the tool stays in (-1), else of the arm itself."""
        boxes = self.config.cartesian.keep_out
        if 0 <= which < len(boxes):
            return f"the keep-out box {boxes[which].name} (cartesian.keep_out[{which}] in {self.file})"
        if which >= 0:
            return f"the clearance of the arm's own bodies (cartesian.clearance in {self.file})"
        return f"the box that the tool stays in (cartesian.box in {self.file})"

    def tool(self, number: int) -> str:
        """Return the name of a tool."""
        names = self.config.tool_names
        return names[number] if 0 <= number < len(names) else f"number {number}"

    def partner(self, which: int) -> str:
        """Return the name of a partner in the cell."""
        return self._partners[which] if 0 <= which < len(self._partners) else f"partner {which + 1}"

    def link(self, number: int) -> str:
        """Return what a link is called: by the joint that moves it."""
        return f"the link of {self.joint(number - 1)}" if number else "the base"

    def lost_cycles(self) -> str:
        """Return the keys that set how many cycles may be lost."""
        bus = self.config.bus
        if bus.interface == VIRTUAL and bus.timeout_scale != 1:
            return f"bus.lost_cycles times bus.timeout_scale, {bus.timeout_scale:g},"
        return "bus.lost_cycles"

    def reaction(self, event: Any) -> str:
        """Return the stop reaction to an event, the key that sets it, and the way out where the arm does not hold."""
        found = self.reactions[type(event)]
        words = found.words
        if isinstance(event, EmergencyStop):
            words += " at once" if found is StopReaction.TORQUE_OFF else ", then torque off"
        if event.stop_key:
            words += f" (stops.{event.stop_key} in {self.file})"
        hold = event.is_fault or found is StopReaction.CONTROLLED_STOP
        return words if hold else f"{words}; then `rtcp reset`"

    def message(self, about: Message) -> str:
        """Return the text of an event or a refusal: what happened, where, and what to do."""
        template = " ".join(inspect.cleandoc(type(about).__doc__ or about.name).split())
        return _Template(self, about).format(template)


_WORDS: dict[str, Callable[[Names, Any], object]] = {
    "file": lambda names, about: names.file,
    "joint": lambda names, about: names.joint(about.axis),
    "joint_or_box": lambda names, about: names.joint(about.axis) if about.axis >= 0 else "the Cartesian limits",
    "key": lambda names, about: names.key(about.axis),
    "drive_words": lambda names, about: names.drive(about),
    "mode_reason": lambda names, about: (
        names.lacks("torque") or "it has no process data for that (rpdo and tpdo in its device file)"
    ),
    "homing_reason": lambda names, about: (
        names.lacks("homing") or "the PDOs of its drive have no modes_of_operation, so it stays in CSP"
    ),
    "all_in_op": lambda names, about: "the controller sends" if names.lacks("states") else "all slaves are in OP",
    "not_in_op": lambda names, about: (
        "the robot controller sends nothing" if names.lacks("states") else "not all slaves are in OP"
    ),
    "missing_words": lambda names, about: MISSING_WORDS[about.missing],
    "low": lambda names, about: names.config.axes[about.axis].position.min,
    "high": lambda names, about: names.config.axes[about.axis].position.max,
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
    "reaction": Names.reaction,
    "lost_cycles": lambda names, about: names.lost_cycles(),
    "enable_timeout": lambda names, about: names.config.enable_timeout_s,
    "supervision": lambda names, about: f"{names.config.supervision.cycles} cycles (supervision in {names.file})",
    "joystick_mode": lambda names, about: JOYSTICK_MODES[about.mode % len(JOYSTICK_MODES)],
    "direction_name": lambda names, about: _DIRECTIONS[about.direction % len(_DIRECTIONS)],
    "singularity": lambda names, about: SINGULARITIES[about.which % 3][0],
    "singularity_unit": lambda names, about: SINGULARITIES[about.which % 3][1],
    "command_name": lambda names, about: COMMANDS[about.command].name,
    "accepting_states": lambda names, about: ", ".join(sorted(one.words for one in COMMANDS[about.command].states)),
    "way_out": lambda names, about: _way_out(about.command, about.state),
}
"""What a message may name beside its own fields."""


class _Template(string.Formatter):
    """Fills in the message of one event or refusal."""

    def __init__(self, names: Names, about: Message) -> None:
        self._names = names
        self._about = about

    def get_value(self, key: int | str, args: Any, kwargs: Any) -> object:
        """Return the value of a field, or what `_WORDS` has under its name."""
        word = _WORDS.get(str(key))
        if word is not None:
            return word(self._names, self._about)
        value = getattr(self._about, str(key))
        return value.name.lower().replace("_", " ") if isinstance(value, IntEnum) else value


def _way_out(number: int, state: State) -> str:
    """Return what leads from a state to one that accepts the command."""
    command = COMMANDS[number]
    if state in Reset.states:
        return "; `rtcp reset` first"
    if state is State.READY and State.HOLDING in command.states:
        return "; `rtcp enable` first"
    return "; `rtcp disable` first" if command.states == {State.READY} and command.name != "enable" else ""
