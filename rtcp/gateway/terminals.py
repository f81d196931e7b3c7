"""Inputs and outputs of the IO boxes, and channels of other slaves, by name: read, waited for, set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Annotated, TypeVar

from annotated_types import Ge

from rtcp.gateway.command_channel import Caller, CommandChannel, Json
from rtcp.gateway.method import method
from rtcp.ipc.commands import SetChannel, SetOutput
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.terminals import NumberChannel, Terminal, terminals_of

_REPORT_S = 0.5
"""Interval between progress reports of a wait, s: the client sees that the platform lives."""


class Terminals:
    """The terminals of all IO boxes, and the channels; every method raises RtcpError.

    Args:
        channel: to the loop.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        self._terminals, self._numbers = terminals_of(channel.config, channel.observer.schema)

    @method(at_once=True)
    async def read_io(self, caller: Caller) -> Json:
        """Return `inputs` and `outputs`: `name`, `box`, `number`, level `value`, `has_function` of all terminals.

        Channels of one bit of other slaves are among them; `channels`: `name`, `value` and `unit` of those with a
        number, and of outputs whether they are `settable`, and their `range`.
        """
        record = self._channel.record()
        answer: Json = {
            which: [
                {
                    "name": terminal.name,
                    "box": terminal.slave,
                    "number": terminal.number,
                    "value": terminal.value(record),
                    "has_function": terminal.has_function,
                }
                for terminal in self._terminals
                if terminal.is_output is is_output
            ]
            for which, is_output in (("inputs", False), ("outputs", True))
        }
        answer["channels"] = [
            {
                "name": number.name,
                "value": _finite(number.value(record)),
                "unit": number.entry.unit,
                "is_output": number.is_output,
                "settable": number.settable,
                "range": [_finite(end) for end in number.entry.range] if number.settable else None,
            }
            for number in self._numbers
        ]
        return answer

    @method()
    async def set_output(self, caller: Caller, output: int, value: bool, box: str | None = None) -> Json:
        """Set a digital output, from 1, of an IO box; `box`: its slave, needed with several."""
        boxes = self._channel.config.boxes
        if (box is None and len(boxes) > 1) or (box is not None and box not in boxes):
            error = "the key is missing" if box is None else f'found the text "{box}"'
            raise RtcpError("invalid", f"box: {error}, allowed is one of {', '.join(boxes) or 'none: there is no box'}")
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, SetOutput(output, value, boxes.index(box) if box else 0))
        return {}

    @method()
    async def write_io(self, caller: Caller, name: str, value: bool) -> Json:
        """Set the digital output of a name (`outputs.named`, `box.number`, `slave.channel`) as `set_output` does."""
        return await self._write(caller, name, value)

    @method()
    async def set_channel(self, caller: Caller, name: str, value: float) -> Json:
        """Set an output with a number, `slave.channel`, in its unit; or as `write_io`, to 0 or 1."""
        return await self._write(caller, name, value)

    async def _write(self, caller: Caller, name: str, value: float) -> Json:
        """Set an output: one with two levels to 0 or 1, one with a number to a number, not a bool."""
        outputs: list[Terminal | NumberChannel] = [*self._terminals, *self._numbers]
        output = _find([output for output in outputs if output.is_output], name)
        if isinstance(output, NumberChannel):
            if isinstance(value, bool):
                low, high = output.entry.range
                text = f"value: found {'on' if value else 'off'}, allowed is {low:g} to {high:g} for {output.name}"
                raise RtcpError("invalid", text, "wrong_level", {"name": name, "value": value})
            return await self._send(caller, output, value)
        if value not in (0.0, 1.0):
            text = f"value: found {value:g}, allowed is 0 or 1 for {output.name}, which has two levels"
            raise RtcpError("invalid", text, "wrong_level", {"name": name, "value": value})
        if output.is_channel:
            return await self._send(caller, output, value)
        return await self.set_output(caller, output.number, bool(value), output.slave)

    async def _send(self, caller: Caller, output: Terminal | NumberChannel, value: float) -> Json:
        position = 1 + [slave.name for slave in self._channel.config.slaves].index(output.slave)
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, SetChannel(position, output.number - 1, float(value)))
        return {}

    @method(at_once=True)
    async def wait_io(
        self,
        caller: Caller,
        name: str,
        value: bool = True,
        timeout_s: Annotated[float, Ge(0)] | None = None,
    ) -> Json:
        """Return when the input or output of a name has the level `value`, if only for a cycle; without lease."""
        terminal = _find(sorted(self._terminals, key=lambda terminal: terminal.is_output), name)
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

        def poll() -> bool | None:
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

        return poll


_Entry = TypeVar("_Entry", bound=Terminal | NumberChannel)


def _find(terminals: Sequence[_Entry], name: str) -> _Entry:
    for terminal in terminals:
        if name in terminal.names:
            return terminal
    allowed = [terminal.name for terminal in terminals]
    none = "none: there is no IO box, and no slave with channels"
    text = f'name: found the text "{name}", allowed is one of {", ".join(allowed) or none}'
    raise RtcpError("invalid", text, "unknown_terminal", {"name": name, "allowed": allowed})


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
