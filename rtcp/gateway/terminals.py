"""Inputs and outputs of the IO boxes, and channels of slaves that are nothing else, by name: read, waited for, set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from rtcp.config.model import PdoEntry
from rtcp.gateway.command_channel import Caller, CommandChannel, Json
from rtcp.ipc.commands import SetChannel, SetOutput
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.schema import identifier

_REPORT_S = 0.5
"""Interval between progress reports of a wait: the client sees that the platform lives."""


@dataclass(frozen=True)
class Terminal:
    """An input or output of an IO box, or a channel of one bit."""

    name: str
    """Of the file, or `box.number`; of a channel `slave.channel`."""
    box: str
    """The slave."""
    number: int
    """On the box; of a channel among those of the slave in its direction, from 1."""
    field: str
    """Of the cycle record."""
    has_function: bool
    """The platform reads or writes it itself."""
    is_channel: bool = False

    @property
    def bit(self) -> int:
        """Of the field."""
        return 0 if self.is_channel else self.number - 1

    @property
    def place(self) -> str:
        """The name that every terminal has."""
        return f"{self.box}.{self.number}"


@dataclass(frozen=True)
class NumberChannel:
    """A channel with a number."""

    slave: str
    number: int
    """Among those of the slave in its direction, from 1."""
    is_output: bool
    entry: PdoEntry
    field: str
    """Of the cycle record."""
    settable: bool

    @property
    def name(self) -> str:
        """By which programs know it."""
        return f"{self.slave}.{self.entry.name}"


class Terminals:
    """The terminals of all IO boxes, and the channels; every method raises RtcpError.

    Args:
        channel: the way to the loop.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        config, schema = channel.config, channel.observer.schema
        functions = {"inputs": config.terminals(config.inputs), "outputs": config.terminals(config.outputs)}
        gripper = config.gripper
        if gripper is not None and gripper.output is not None:
            functions["outputs"]["gripper"] = config.box_of(gripper), gripper.output
        self._all: dict[str, list[Terminal]] = {"inputs": [], "outputs": []}
        for which, terminals in self._all.items():
            names = {place: name for name, place in functions[which].items()}
            free = {terminal.name for terminal in getattr(config, which).named}
            for box in config.boxes:
                field = f"{identifier(box)}_{which}"
                bits = int(schema[field].type.lstrip("uint")) if field in schema.names else 0
                for number in range(1, bits + 1):
                    name = names.get((box, number), f"{box}.{number}")
                    has_function = (box, number) in names and name not in free
                    terminals.append(Terminal(name, box, number, field, has_function))
        self._numbers: list[NumberChannel] = []
        taken = config.process_outputs
        for slave in config.slaves:
            inputs = {entry.name for entry in slave.device.inputs}
            for which, entries in (("inputs", slave.device.inputs), ("outputs", slave.device.outputs)):
                for number, entry in enumerate(entries if slave.device.has_channels else (), 1):
                    sent = "_sent" if which == "outputs" and entry.name in inputs else ""
                    field = f"{identifier(slave.name)}_{identifier(entry.name)}{sent}"
                    if field not in schema.names:
                        continue
                    if entry.type == "bool":
                        name = f"{slave.name}.{entry.name}"
                        is_taken = which == "outputs" and (slave.name, entry.name) in taken
                        self._all[which].append(Terminal(name, slave.name, number, field, is_taken, is_channel=True))
                    else:
                        is_output = which == "outputs"
                        settable = is_output and (slave.name, entry.name) not in taken
                        self._numbers.append(NumberChannel(slave.name, number, is_output, entry, field, settable))

    def read(self) -> Json:
        """Return every terminal, by `inputs` and `outputs`, with its level, and the `channels`."""
        record = self._channel.record()
        found: Json = {
            which: [
                {
                    "name": one.name,
                    "box": one.box,
                    "number": one.number,
                    "value": _is_set(int(record[one.field]), one),
                    "has_function": one.has_function,
                }
                for one in terminals
            ]
            for which, terminals in self._all.items()
        }
        found["channels"] = [
            {
                "name": one.name,
                "value": _finite(float(record[one.field])),
                "unit": one.entry.unit,
                "is_output": one.is_output,
                "settable": one.settable,
                "range": [_finite(end) for end in one.entry.range] if one.settable else None,
            }
            for one in self._numbers
        ]
        return found

    async def write(self, caller: Caller, name: str, value: bool) -> Json:
        """Set an output."""
        terminal = self._find("outputs", name)
        if terminal.is_channel:
            return await self._send(caller, terminal.box, terminal.number, float(value))
        async with self._channel.lease(caller) as lease:
            box = self._channel.config.boxes.index(terminal.box)
            await self._channel.send(lease, SetOutput(terminal.number, value, box))
        return {}

    async def write_number(self, caller: Caller, name: str, value: float) -> Json:
        """Set an output channel with a number."""
        outputs = [one for one in self._numbers if one.is_output]
        for one in outputs:
            if one.name == name:
                return await self._send(caller, one.slave, one.number, value)
        raise _unknown(name, [one.name for one in outputs], "no slave has such outputs")

    async def _send(self, caller: Caller, slave: str, number: int, value: float) -> Json:
        position = 1 + [one.name for one in self._channel.config.slaves].index(slave)
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, SetChannel(position, number - 1, value))
        return {}

    async def wait(self, caller: Caller, name: str, value: bool, timeout_s: float | None) -> Json:
        """Return once the level is `value` in a cycle from now on; a level of one cycle counts."""
        terminal = self._find("inputs", name, self._all["outputs"])
        channel = self._channel
        patience_s = math.inf if timeout_s is None else timeout_s
        message = f"{terminal.name} was not {'high' if value else 'low'} within {patience_s:g} s"
        fields = {"name": name, "value": value, "timeout_s": timeout_s}
        late = RtcpError("timeout", message, "level_not_reached", fields)
        await channel.wait(self._reaches(caller, terminal, value), patience_s, lambda: late)
        return {}

    def _reaches(self, caller: Caller, terminal: Terminal, value: bool) -> Callable[[], bool | None]:
        channel = self._channel
        seen, reported = channel.observer.head - 1, time.monotonic()

        def look() -> bool | None:
            nonlocal seen, reported
            channel.check_loop()
            if time.monotonic() - reported > _REPORT_S:
                reported = time.monotonic()
                caller.report(channel.progress())
            records, _ = channel.observer.since(seen)
            if len(records):
                seen = int(records[-1]["number"])
            levels = (records[terminal.field].astype("uint64") >> terminal.bit) & 1
            return bool((levels == value).any()) or None

        return look

    def _find(self, which: str, name: str, others: list[Terminal] | None = None) -> Terminal:
        terminals = [*self._all[which], *(others or [])]
        for terminal in terminals:
            if name in (terminal.name, terminal.place):
                return terminal
        raise _unknown(name, [one.name for one in terminals], "there is no IO box")


def _unknown(name: str, allowed: list[str], why: str) -> RtcpError:
    text = f'name: found the text "{name}", allowed is one of {", ".join(allowed) or f"none: {why}"}'
    return RtcpError("invalid", text, "unknown_terminal", {"name": name, "allowed": allowed})


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _is_set(levels: int, terminal: Terminal) -> bool:
    return bool(levels >> terminal.bit & 1)
