"""Errors of requests to the platform: one exception a kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

ErrorKind = Literal["refused", "fault", "replaced", "timeout", "invalid", "internal", "not running", "lost"]


class RtcpError(Exception):
    """A request that did not succeed. `RtcpError("refused", ...)` makes a `Refused`, and so on for each kind.

    Attributes:
        kind: for programs: refused, fault, replaced, timeout, invalid, internal (the platform's own); not running, lost
            (raised at this end: nobody answers; the connection ended before the answer).
        message: for people: what happened, where, what to do.
        reason: name of the refusal (`rtcp.ipc.refusals`) or event (`rtcp.ipc.events`) behind it; empty: none.
        fields: its fields by name, SI units.
    """

    def __new__(
        cls, kind: ErrorKind, message: str, reason: str = "", fields: Mapping[str, Any] | None = None
    ) -> RtcpError:
        """Make an instance of the kind's class."""
        return super().__new__(_CLASSES.get(kind, RtcpError), kind, message, reason, fields)

    def __init__(
        self, kind: ErrorKind, message: str, reason: str = "", fields: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(kind, message, reason, fields)
        self.kind: ErrorKind = kind
        self.message = message
        self.reason = reason
        self.fields: dict[str, Any] = dict(fields or {})

    def __str__(self) -> str:
        return self.message


class Refused(RtcpError):
    """The platform runs and will not do this now; nothing was begun."""


class Faulted(RtcpError):
    """It was begun and failed: a fault, an emergency stop, a motion that ended before its goal."""


class Replaced(RtcpError):
    """Another motion took its place (`replace=True`), without a stop between them."""


class TimedOut(RtcpError):
    """It took too long, or no answer came."""


class Invalid(RtcpError):
    """A parameter is wrong; nothing was begun."""


class NotRunning(RtcpError):
    """No platform listens at the control socket."""


class ConnectionLost(RtcpError):
    """The connection ended before the answer."""


_CLASSES: dict[str, type[RtcpError]] = {
    "refused": Refused,
    "fault": Faulted,
    "replaced": Replaced,
    "timeout": TimedOut,
    "invalid": Invalid,
    "not running": NotRunning,
    "lost": ConnectionLost,
}
