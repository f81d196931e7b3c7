"""Inputs and outputs of the IO boxes, and channels of other slaves: their names and record fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.config.model import ArmConfig, PdoEntry
from rtcp.ipc.schema import RecordSchema, identifier


@dataclass(frozen=True)
class Terminal:
    """An input or output of an IO box, or a channel of one bit."""

    name: str
    """Name in the file, or `box.number`; of a channel `slave.channel`."""
    slave: str
    number: int
    """Number on the box; of a channel: its number among the slave's inputs or outputs, from 1."""
    field: str
    """Field of the cycle record."""
    is_output: bool
    has_function: bool
    """Whether the platform itself reads or writes it."""
    is_channel: bool = False

    @property
    def bit(self) -> int:
        """Bit of the field."""
        return 0 if self.is_channel else self.number - 1

    @property
    def place(self) -> str:
        """`box.number`, which every terminal has."""
        return f"{self.slave}.{self.number}"

    @property
    def local_name(self) -> str:
        """Its name among those of the slave."""
        return self.name.removeprefix(f"{self.slave}.")

    @property
    def names(self) -> tuple[str, ...]:
        """By which programs know it."""
        return self.name, self.place, f"{self.slave}.{self.name}"

    @property
    def settable(self) -> bool:
        """Whether a command may set it."""
        return self.is_output and not self.has_function

    def value(self, record: Any) -> bool:
        """Return its level in a cycle record."""
        return bool(int(record[self.field]) >> self.bit & 1)


@dataclass(frozen=True)
class NumberChannel:
    """A channel with a number."""

    slave: str
    number: int
    """Number among the channels of the slave in its direction, from 1."""
    is_output: bool
    entry: PdoEntry
    field: str
    """Of the cycle record."""
    settable: bool
    """Whether a command may set it."""

    @property
    def name(self) -> str:
        """By which programs know it."""
        return f"{self.slave}.{self.entry.name}"

    @property
    def local_name(self) -> str:
        """Its name among those of the slave."""
        return self.entry.name

    @property
    def names(self) -> tuple[str, ...]:
        """As of `Terminal`."""
        return (self.name,)

    def value(self, record: Any) -> float:
        """Return its value in a cycle record, in its unit."""
        return float(record[self.field])


def terminals_of(config: ArmConfig, schema: RecordSchema) -> tuple[list[Terminal], list[NumberChannel]]:
    """Return the terminals and the channels with a number of a platform, in the order of the cable."""
    terminals: list[Terminal] = []
    for which, section in (("inputs", config.inputs), ("outputs", config.outputs)):
        places = config.terminals(section)
        free = {terminal.name for terminal in section.named}
        gripper = config.gripper
        if which == "outputs" and gripper is not None and gripper.output is not None:
            places["gripper"] = config.box_of(gripper), gripper.output
        names = {place: name for name, place in places.items()}
        for box in config.boxes:
            field = f"{identifier(box)}_{which}"
            bits = int(schema[field].type.lstrip("uint")) if field in schema.names else 0
            for number in range(1, bits + 1):
                name = names.get((box, number), f"{box}.{number}")
                has_function = (box, number) in names and name not in free
                terminals.append(Terminal(name, box, number, field, which == "outputs", has_function))
    numbers: list[NumberChannel] = []
    taken = config.process_outputs
    for slave in config.slaves:
        if not slave.device.has_channels:
            continue
        directions: Sequence[tuple[bool, Sequence[PdoEntry]]]
        directions = (False, slave.device.inputs), (True, slave.device.outputs)
        for is_output, entries in directions:
            for number, entry in enumerate(entries, 1):
                field = f"{identifier(slave.name)}_{identifier(entry.name)}"
                is_taken = is_output and (slave.name, entry.name) in taken
                if field not in schema.names:
                    continue
                if entry.type == "bool":
                    name = f"{slave.name}.{entry.name}"
                    terminals.append(Terminal(name, slave.name, number, field, is_output, is_taken, is_channel=True))
                else:
                    settable = is_output and not is_taken
                    numbers.append(NumberChannel(slave.name, number, is_output, entry, field, settable))
    return terminals, numbers


def named(terminals: Sequence[Terminal], numbers: Sequence[NumberChannel]) -> list[Terminal | NumberChannel]:
    """Return all terminals and channels but those of IO boxes without a name."""
    return [*(terminal for terminal in terminals if terminal.is_channel or terminal.name != terminal.place), *numbers]
