"""Inputs and outputs of the IO boxes by name: read, waited for, set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from rtcp.gateway.command_channel import Caller, CommandChannel, Json
from rtcp.ipc.commands import SetOutput
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.schema import identifier

_REPORT_S = 0.5
"""Interval between progress reports of a wait: the client sees that the platform lives."""


@dataclass(frozen=True)
class Terminal:
    """An input or output of an IO box."""

    name: str
    """Of the file, or `box.number`."""
    box: str
    number: int
    field: str
    """Of the cycle record; bit 0 is number 1."""
    has_function: bool
    """The platform reads or writes it itself."""

    @property
    def place(self) -> str:
        """The name that every terminal has."""
        return f"{self.box}.{self.number}"


class Terminals:
    """The terminals of all IO boxes; every method raises RtcpError.

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

    def read(self) -> Json:
        """Return each terminal's name, box, number, level and if it has a function, by `inputs` and `outputs`."""
        record = self._channel.record()
        return {
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

    async def write(self, caller: Caller, name: str, value: bool) -> Json:
        """Set an output."""
        terminal = self._find("outputs", name)
        async with self._channel.lease(caller) as lease:
            box = self._channel.config.boxes.index(terminal.box)
            await self._channel.send(lease, SetOutput(terminal.number, value, box))
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
            levels = (records[terminal.field] >> (terminal.number - 1)) & 1
            return bool((levels == value).any()) or None

        return look

    def _find(self, which: str, name: str, others: list[Terminal] | None = None) -> Terminal:
        terminals = [*self._all[which], *(others or [])]
        for terminal in terminals:
            if name in (terminal.name, terminal.place):
                return terminal
        allowed = [one.name for one in terminals]
        text = f'name: found the text "{name}", allowed is one of {", ".join(allowed) or "none: there is no IO box"}'
        raise RtcpError("invalid", text, "unknown_terminal", {"name": name, "allowed": allowed})


def _is_set(levels: int, terminal: Terminal) -> bool:
    return bool(levels >> terminal.number - 1 & 1)
