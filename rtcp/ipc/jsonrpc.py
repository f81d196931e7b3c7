"""JSON-RPC 2.0 on the control socket, for both ends: one message a line (`docs/protocol.md`).

No library: those on PyPI bring HTTP or Content-Length framing, or answer a request only when it is complete, while a
motion reports its progress before.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, cast

from rtcp.ipc.errors import ErrorKind, RtcpError

VERSION = "2.0"
LINE_LIMIT = 1 << 22
"""Largest request, bytes: fits a trajectory of the most points, with velocities and accelerations of ten joints."""
PARSE_ERROR, INVALID_REQUEST, METHOD_NOT_FOUND, INVALID_PARAMS, INTERNAL_ERROR = -32700, -32600, -32601, -32602, -32603
"""JSON-RPC 2.0 specification, section 5.1."""
CODES = {
    "refused": -32000,
    "fault": -32001,
    "timeout": -32002,
    "replaced": -32003,
    "invalid": INVALID_PARAMS,
    "internal": INTERNAL_ERROR,
}
"""Code of each kind of error; -32099 to -32000 are the server's own."""
RequestId = int | str | None


class InvalidMessage(ValueError):
    """A line that is no request; `code` is its JSON-RPC error code, `request` its id if it has one."""

    def __init__(self, code: int, message: str, request: RequestId = None) -> None:
        super().__init__(message)
        self.code = code
        self.request = request


def line(message: Mapping[str, Any]) -> bytes:
    """Return a message as a line.

    Raises:
        ValueError: a number in it is not finite.
    """
    return json.dumps({"jsonrpc": VERSION, **message}, allow_nan=False).encode() + b"\n"


class Request(NamedTuple):
    """A request or a notification, as read."""

    id: RequestId
    method: str
    params: dict[str, Any]
    is_notification: bool
    requested_ns: int
    """When its sender requested it, CLOCK_MONOTONIC; 0: it does not say."""


def request(number: int, method: str, params: Mapping[str, Any]) -> bytes:
    """Return a request with the instant of this call; raises RtcpError (`invalid`) for what JSON cannot express."""
    now = time.monotonic_ns()
    try:
        data = line({"id": number, "method": method, "params": dict(params), "requested_ns": now})
    except (TypeError, ValueError) as error:
        why = next(_wrong_numbers(params), error)
        raise RtcpError("invalid", f"{method}: the parameters cannot be sent as JSON: {why}") from error
    if len(data) > LINE_LIMIT:
        raise RtcpError("invalid", f"{method}: the parameters are {len(data)} bytes, longer than {LINE_LIMIT} bytes")
    return data


def _wrong_numbers(value: Any, place: str = "") -> Iterator[str]:
    """Yield the place of each number that is not finite, from 0, as `points[3].q[2] is nan`."""
    if isinstance(value, float) and not math.isfinite(value):
        yield f"{place} is {value}, a finite number is needed"
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _wrong_numbers(inner, f"{place}.{key}" if place else str(key))
    elif isinstance(value, list | tuple):
        for at, inner in enumerate(value):
            yield from _wrong_numbers(inner, f"{place}[{at}]")


def answer(message: Mapping[str, Any]) -> bytes:
    """Return an answer or a notification as a line; numbers that are not finite become null."""
    try:
        return line(message)
    except ValueError:
        return line(_finite(message))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def failure(number: RequestId, error: RtcpError, code: int = 0) -> dict[str, Any]:
    """Return the answer to a request that failed."""
    data = {"kind": error.kind, "reason": error.reason, "fields": error.fields}
    details = {"code": code or CODES.get(error.kind, INTERNAL_ERROR), "message": error.message, "data": data}
    return {"id": number, "error": details}


def read_request(text: bytes) -> Request:
    """Return a request.

    Raises:
        InvalidMessage: it is no JSON or no request.
    """
    try:
        message = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InvalidMessage(PARSE_ERROR, f"the request is no JSON: {error}") from None
    if not isinstance(message, dict):
        raise InvalidMessage(INVALID_REQUEST, f"the request must be an object, not {type(message).__name__}")
    number, method, params = message.get("id"), message.get("method"), message.get("params", {})
    if type(number) not in (int, str, type(None)):
        raise InvalidMessage(INVALID_REQUEST, f"id: found {type(number).__name__}, allowed is an integer or a text")
    if message.get("jsonrpc") != VERSION:
        version = json.dumps(message.get("jsonrpc"))[:60]
        raise InvalidMessage(INVALID_REQUEST, f'jsonrpc: found {version}, allowed is "{VERSION}"', number)
    if not isinstance(method, str):
        raise InvalidMessage(INVALID_REQUEST, f"method: found {type(method).__name__}, allowed is a text", number)
    if not isinstance(params, dict):
        raise InvalidMessage(INVALID_REQUEST, f"params: found {type(params).__name__}, allowed is an object", number)
    requested_ns = message.get("requested_ns", 0)
    if type(requested_ns) is not int:
        found = type(requested_ns).__name__
        raise InvalidMessage(INVALID_REQUEST, f"requested_ns: found {found}, allowed is an integer", number)
    return Request(number, method, params, number is None, requested_ns)


def _refuse_constant(constant: str) -> float:
    """Refuse NaN and Infinity, which Python accepts and JSON does not."""
    raise ValueError(f"{constant} is no number")


def read_reply(text: bytes, method: str) -> dict[str, Any]:
    """Return an answer or a notification; raises RtcpError (`internal`) for what is neither."""
    try:
        reply = json.loads(text)
    except ValueError as error:
        raise RtcpError("internal", f"the answer to {method!r} is not JSON: {text[:80]!r}") from error
    if not isinstance(reply, dict):
        raise RtcpError("internal", f"the answer to {method!r} is not an object: {text[:80]!r}")
    return reply


def progress(reply: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the parameters of the notification `progress`; None where the message is an answer."""
    params = reply.get("params")
    return params if reply.get("method") == "progress" and isinstance(params, dict) else None


def result(reply: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Return the result of an answer; raises RtcpError for an error of any form."""
    if "result" in reply:
        return _object(reply["result"])
    error = _object(reply.get("error"))
    data = _object(error.get("data"))
    kind = data.get("kind")
    raise RtcpError(
        cast(ErrorKind, kind) if kind in CODES else "fault",
        str(error.get("message") or f"the platform refused {method!r} without saying why"),
        str(data.get("reason") or ""),
        _object(data.get("fields")),
    )


def _object(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
