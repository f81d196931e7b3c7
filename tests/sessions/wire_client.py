"""Requests of a random session on the control socket, and the answers: counted, and kept with their time."""

from __future__ import annotations

import json
import math
import socket
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtcp.ipc import jsonrpc
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError

NAME = "a random session"
PATIENCE_S = 30.0
DEFECTS = ("internal", "lost", "not running", "timeout")
"""Kinds of errors that no request may cause."""


class Connection:
    """A connection for requests that are not waited for; it also sends numbers that JSON lacks."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(path))
        self._received = b""

    def begin(self, verb: str, arguments: Mapping[str, Any]) -> None:
        """Send a request."""
        identify = {"jsonrpc": jsonrpc.VERSION, "method": "identify", "params": {"name": NAME}}
        request = {"jsonrpc": jsonrpc.VERSION, "id": 1, "method": verb, "params": dict(arguments)}
        self._socket.sendall(
            b"".join(json.dumps(request_line).encode() + b"\n" for request_line in (identify, request))
        )

    def answer(self, patience_s: float) -> dict[str, Any] | None:
        """Return the answer, or None where it has not come in time."""
        end = time.monotonic() + patience_s
        while True:
            *lines, self._received = self._received.split(b"\n")
            for reply in map(json.loads, lines):
                if jsonrpc.progress(reply) is None:
                    return dict(reply)
            self._socket.settimeout(max(end - time.monotonic(), 1e-3))
            try:
                got = self._socket.recv(65536)
            except TimeoutError:
                return None
            if not got:
                return {"error": {"message": "the connection was closed", "data": {"kind": "lost"}}}
            self._received += got

    def close(self) -> None:
        """Close the connection, with or without an open request."""
        self._socket.close()


class WireClient:
    """Sends requests and records them: `actions` are (ns of CLOCK_MONOTONIC, sentence)."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._client = ControlClient(NAME, path)
        self._long: Connection | None = None
        self._verb = ""
        self.actions: list[tuple[int, str]] = []
        self.taken: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.defects: list[tuple[int, str]] = []

    def ask(self, verb: str, **arguments: Any) -> dict[str, Any] | None:
        """Send a request; return the result, or None if refused."""
        begun = time.monotonic_ns()
        kind, message, result = "", "", None
        if _is_json(arguments):
            try:
                result = self._client.call(verb, arguments, timeout_s=PATIENCE_S)
            except RtcpError as error:
                kind, message = error.kind, error.message
                if kind == "lost":
                    self.hang_up()
        else:
            line = Connection(self._path)
            line.begin(verb, arguments)
            reply = line.answer(PATIENCE_S)
            line.close()
            kind, message, result = _read(reply)
        self._keep(begun, verb, arguments, kind, message)
        return result

    @property
    def commanded(self) -> list[float]:
        """The last targets, rad."""
        return list(self.status()["joints"]["commanded_position"])

    def status(self) -> dict[str, Any]:
        """Return the status, which is no action."""
        return self._client.call("status", timeout_s=PATIENCE_S)

    def begin(self, verb: str, **arguments: Any) -> None:
        """Send a long request on a connection of its own without waiting."""
        self.drop()
        self._long, self._verb = Connection(self._path), verb
        self._long.begin(verb, arguments)
        self.actions.append((time.monotonic_ns(), f"{verb} {_short(arguments)} begins"))

    def busy(self, patience_s: float) -> bool:
        """Whether the long request has no answer within this time."""
        if self._long is None:
            return False
        reply = self._long.answer(patience_s)
        if reply is None:
            return True
        kind, message, _ = _read(reply)
        self._keep(time.monotonic_ns(), self._verb, {}, kind, message)
        self._long.close()
        self._long = None
        return False

    def drop(self) -> None:
        """Close the connection of the long request, and with it its lease."""
        if self._long is not None:
            if self.busy(1e-3):
                self.count_fault("connection closed", f"in the middle of {self._verb}")
                self._long.close()
            self._long = None

    def hang_up(self) -> None:
        """Replace the connection of the requests; its lease ends."""
        self._client.close()
        self._client = ControlClient(NAME, self._path)

    def count_fault(self, name: str, what: str = "") -> None:
        """Record an action."""
        self.faults[name] += 1
        self.actions.append((time.monotonic_ns(), f"* {name} {what}"))

    def close(self) -> None:
        """Close both connections."""
        self.drop()
        self._client.close()

    def _keep(self, when: int, verb: str, arguments: Mapping[str, Any], kind: str, message: str) -> None:
        (self.refused if kind else self.taken)[verb] += 1
        self.actions.append((when, f"{verb} {_short(arguments)} -> {kind or 'taken'} {message[:120]}"))
        if kind in DEFECTS:
            self.defects.append((when, f"{verb} {_short(arguments)}: {kind}: {message}"))


def _is_json(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_is_json, value.values()))
    if isinstance(value, (list, tuple)):
        return all(map(_is_json, value))
    return not isinstance(value, float) or math.isfinite(value)


def _read(reply: dict[str, Any] | None) -> tuple[str, str, dict[str, Any] | None]:
    if reply is None:
        return "timeout", "no answer", None
    if "result" in reply:
        return "", "", dict(reply["result"])
    return str(reply["error"]["data"]["kind"]), str(reply["error"]["message"]), None


def _short(value: Any) -> str:
    """The arguments, with rounded numbers."""
    if isinstance(value, dict):
        return " ".join(f"{key}={_short(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return "[" + " ".join(map(_short, value)) + "]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
