"""A method of the control socket: a function whose signature defines its parameters."""

from __future__ import annotations

import functools
import inspect
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field, make_dataclass
from typing import Any, Literal, NamedTuple, TypeVar, get_type_hints

import rtcp.config.rules  # noqa: F401 its rules hold for stops and points too
from rtcp.config.validation import Checker
from rtcp.gateway.command_channel import Caller, Json
from rtcp.ipc.commands import Command
from rtcp.ipc.errors import RtcpError

HOLD_S = 0.25
"""Default hold time of a command, s."""
Numbers = tuple[float, ...]
Frame = Literal["base", "tool", "joints"]
F = TypeVar("F", bound=Callable[..., Awaitable[Json]])


@dataclass(frozen=True)
class Method:
    """One method of the control socket."""

    name: str
    parameters: Checker[Any]
    call: Callable[..., Awaitable[Json]]
    """Called with the caller, and the parameters by name."""
    documentation: str
    at_once: bool = False
    """Whether it does not wait for its connection's other requests."""
    streams: bool = False
    """Whether it continues the motion of its connection; else it waits until that has come to rest."""
    stops: type[Command] | None = None
    """The stop that is requested as soon as the request is received, before those that wait (`rtcp.ipc.stops`)."""

    async def __call__(self, caller: Caller, params: Json) -> Json:
        """Check the parameters and carry it out; raises RtcpError."""
        checked, findings = self.parameters.check(params)
        if findings:
            raise RtcpError("invalid", "\n".join(map(str, findings)))
        return await self.call(caller, **vars(checked))


def method(at_once: bool = False, streams: bool = False, stops: type[Command] | None = None) -> Callable[[F], F]:
    """Mark a function for `methods_of`: its arguments are `self` and the caller, then the parameters."""

    def mark(function: F) -> F:
        function.method_flags = {"at_once": at_once, "streams": streams, "stops": stops}  # type: ignore[attr-defined]
        return function

    return mark


class Documented(NamedTuple):
    """A method as in `docs/methods.md`."""

    name: str
    parameters: type
    """Dataclass of the parameters."""
    about: str
    at_once: bool = False
    """Whether it does not wait for its connection's other requests."""


def methods_of(*owners: object) -> dict[str, Method]:
    """Return the methods of these objects by name."""
    methods = (_method_of(function, owner) for owner in owners for function in _marked(type(owner)))
    return {entry.name: entry for entry in methods}


def documented_of(*kinds: type) -> list[Documented]:
    """Return the methods of these classes for `docs/methods.md`."""
    return [
        Documented(marked.__name__, parameters_of(marked).kind, marked.__doc__ or "", marked.method_flags["at_once"])
        for kind in kinds
        for marked in _marked(kind)
    ]


def _marked(kind: type) -> Iterator[Any]:
    return (member for member in vars(kind).values() if hasattr(member, "method_flags"))


def _method_of(function: Any, owner: object) -> Method:
    documentation = inspect.cleandoc(function.__doc__)
    call = functools.partial(function, owner)
    return Method(function.__name__, parameters_of(function), call, documentation, **function.method_flags)


@functools.cache
def parameters_of(function: Any) -> Checker[Any]:
    """Return the checker of a function's parameters: those after `self` and `caller`."""
    hints = get_type_hints(function, include_extras=True)
    fields = [
        (name, hints[name], field() if param.default is inspect.Parameter.empty else field(default=param.default))
        for name, param in list(inspect.signature(function).parameters.items())[2:]
    ]
    return Checker(make_dataclass(function.__name__, fields, frozen=True, kw_only=True))


def index_of(key: str, text: str, allowed: Sequence[str]) -> int:
    """Return the place of a text among those that are allowed.

    Raises:
        RtcpError: `invalid`: it is none of them.
    """
    if text not in allowed:
        raise RtcpError("invalid", f'{key}: found the text "{text}", allowed is one of {", ".join(allowed)}')
    return list(allowed).index(text)


def check_count(key: str, numbers: Sequence[float], count: int, meaning: str = "") -> None:
    """Check the count of a parameter's numbers; raises RtcpError, whose message ends with `meaning`."""
    if len(numbers) != count:
        raise RtcpError("invalid", f"{key}: found {len(numbers)} numbers, allowed are {count}{meaning}")


def left(hold_s: float, sent_s: float | None) -> float:
    """Return the rest of `hold_s`, s, since the command was sent at `sent_s`, CLOCK_MONOTONIC.

    Raises:
        TimedOut: `hold_s` has passed.
    """
    if sent_s is None:
        return hold_s
    late_s = time.monotonic() - sent_s
    if not late_s <= hold_s:
        raise RtcpError("timeout", f"it came {late_s:.1f} s after it was sent, and lasts for {hold_s:g} s only")
    return hold_s - max(0.0, late_s)
