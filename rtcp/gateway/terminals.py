"""Inputs and outputs of the IO boxes, and channels of slaves that are nothing else, by name: read, waited for, set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from rtcp.gateway.command_channel import Caller, CommandChannel, Json
from rtcp.ipc.commands import SetChannel, SetOutput
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.terminals import NumberChannel, Terminal, terminals_of

_REPORT_S = 0.5
"""Interval between progress reports of a wait: the client sees that the platform lives."""


class Terminals:
    """The terminals of all IO boxes, and the channels; every method raises RtcpError.

    Args:
        channel: the way to the loop.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        self._terminals, self._numbers = terminals_of(channel.config, channel.observer.schema)

    def read(self) -> Json:
        """Return every terminal, by `inputs` and `outputs`, with its level, and the `channels`."""
        record = self._channel.record()
        found: Json = {
            which: [
                {
                    "name": one.name,
                    "box": one.slave,
                    "number": one.number,
                    "value": one.value(record),
                    "has_function": one.has_function,
                }
                for one in self._terminals
                if one.is_output is is_output
            ]
            for which, is_output in (("inputs", False), ("outputs", True))
        }
        found["channels"] = [
            {
                "name": one.name,
                "value": _finite(one.value(record)),
                "unit": one.entry.unit,
                "is_output": one.is_output,
                "settable": one.settable,
                "range": [_finite(end) for end in one.entry.range] if one.settable else None,
            }
            for one in self._numbers
        ]
        return found

    async def write(self, caller: Caller, name: str, value: float) -> Json:
        """Set an output; one with two levels to 0 or 1, one with a number not by a truth value."""
        outputs: list[Terminal | NumberChannel] = [*self._terminals, *self._numbers]
        one = _find([one for one in outputs if one.is_output], name)
        if isinstance(one, NumberChannel):
            if isinstance(value, bool):
                low, high = one.entry.range
                text = f"value: found {'on' if value else 'off'}, allowed is {low:g} to {high:g} for {one.name}"
                raise RtcpError("invalid", text, "wrong_level", {"name": name, "value": value})
            return await self._send(caller, one, value)
        if value not in (0.0, 1.0):
            text = f"value: found {value:g}, allowed is 0 or 1 for {one.name}, which has two levels"
            raise RtcpError("invalid", text, "wrong_level", {"name": name, "value": value})
        if one.is_channel:
            return await self._send(caller, one, value)
        async with self._channel.lease(caller) as lease:
            box = self._channel.config.boxes.index(one.slave)
            await self._channel.send(lease, SetOutput(one.number, bool(value), box))
        return {}

    async def _send(self, caller: Caller, one: Terminal | NumberChannel, value: float) -> Json:
        position = 1 + [slave.name for slave in self._channel.config.slaves].index(one.slave)
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, SetChannel(position, one.number - 1, float(value)))
        return {}

    async def wait(self, caller: Caller, name: str, value: bool, timeout_s: float | None) -> Json:
        """Return once the level is `value` in a cycle from now on; a level of one cycle counts."""
        terminal = _find(sorted(self._terminals, key=lambda one: one.is_output), name)
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


_Found = TypeVar("_Found", bound=Terminal | NumberChannel)


def _find(terminals: Sequence[_Found], name: str) -> _Found:
    for terminal in terminals:
        if name in terminal.names:
            return terminal
    allowed = [one.name for one in terminals]
    none = "none: there is no IO box, and no slave with channels"
    text = f'name: found the text "{name}", allowed is one of {", ".join(allowed) or none}'
    raise RtcpError("invalid", text, "unknown_terminal", {"name": name, "allowed": allowed})


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
