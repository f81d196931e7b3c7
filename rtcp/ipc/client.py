"""The client's end of the control socket: one request at a time, newline-delimited JSON, standard library only."""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, cast

from rtcp.ipc.errors import ErrorKind, RtcpError
from rtcp.ipc.runtime_directory import control_socket, runtime_directory
from rtcp.ipc.session import is_running, read_processes

Progress = Callable[[Mapping[str, Any]], None]

ANSWER_TIMEOUT_S = 15.0
"""Longest silence of the platform within one request: longer than any step of its start or stop."""

LONGEST_SOCKET_PATH = 107
"""sun_path of unix(7): 108 bytes with the closing zero."""

_PEER = struct.Struct("3i")
"""Process, user and group at the other end (unix(7), SO_PEERCRED)."""

_KINDS_ON_THE_WIRE = frozenset({"refused", "fault", "timeout", "invalid", "internal"})


class ControlClient:
    """A connection to the running platform.

    Closing it while a move is under way ends the lease of this client: the arm comes to a controlled stop.
    """

    def __init__(self, name: str = "", path: Path | None = None) -> None:
        """Connect.

        Args:
            name: who asks, as others are told it when they are refused; this process is named when it is empty.
            path: the control socket; that of the runtime directory when None.

        Raises:
            RtcpError: `not running` when nobody listens, `refused` when the socket is another user's, `invalid`
                when its path is too long for a socket.
        """
        self._path = control_socket(runtime_directory()) if path is None else path
        self._name = client_name(name)
        self._request = 0
        self._received = bytearray()
        self._socket = _connect(self._path)

    def __enter__(self) -> ControlClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; a second time is harmless."""
        self._socket.close()

    def call(
        self,
        verb: str,
        arguments: Mapping[str, Any] | None = None,
        progress: Progress | None = None,
        timeout_s: float = ANSWER_TIMEOUT_S,
    ) -> dict[str, Any]:
        """Send one request and return the `result` of its answer.

        Args:
            verb: what to do (`status`, `move`, ...).
            arguments: the verb's arguments.
            progress: is called with each progress report that comes before the answer.
            timeout_s: longest silence, not longest duration: a progress report starts it anew.

        Raises:
            RtcpError: what the platform answered; `timeout` after `timeout_s` of silence; `lost` when the
                connection ends first.
        """
        self._request += 1
        request = {"id": self._request, "do": verb, "args": dict(arguments or {}), "client": self._name}
        self._socket.settimeout(timeout_s)
        self._send(verb, json.dumps(request, allow_nan=False).encode() + b"\n")
        while True:
            reply = self._receive(verb, timeout_s)
            # null: of a request of which no number could be read.
            if reply.get("id") not in (self._request, None):
                continue  # a late word on a request that was given up
            if "progress" in reply:
                if progress is not None and isinstance(reply["progress"], dict):
                    progress(reply["progress"])
            elif reply.get("ok") is True:
                result = reply.get("result")
                return result if isinstance(result, dict) else {}
            else:
                raise _refusal(verb, reply.get("error"))

    def _send(self, verb: str, line: bytes) -> None:
        try:
            self._socket.sendall(line, socket.MSG_NOSIGNAL)
        except TimeoutError as error:
            raise self._silence(verb, self._socket.gettimeout()) from error
        except OSError as error:
            raise RtcpError(
                "lost", f"the platform closed the connection before it took the request {verb!r}"
            ) from error

    def _receive(self, verb: str, timeout_s: float) -> dict[str, Any]:
        while (end := self._received.find(b"\n")) < 0:
            try:
                chunk = self._socket.recv(65536)
            except TimeoutError as error:
                raise self._silence(verb, timeout_s) from error
            except OSError:
                chunk = b""
            if not chunk:
                raise RtcpError("lost", f"the platform closed the connection before it answered {verb!r}")
            self._received += chunk
        line = bytes(self._received[:end])
        del self._received[: end + 1]
        try:
            reply = json.loads(line)
        except ValueError as error:
            raise RtcpError("internal", f"the answer to {verb!r} is not JSON: {line[:80]!r}") from error
        if not isinstance(reply, dict):
            raise RtcpError("internal", f"the answer to {verb!r} is not an object: {line[:80]!r}")
        return reply

    def _silence(self, verb: str, timeout_s: float | None) -> RtcpError:
        gateway, _, _ = _PEER.unpack(self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        return RtcpError(
            "timeout",
            f"the platform has not answered {verb!r} for {timeout_s:g} s: if its gateway (process {gateway}) hangs, "
            f"`kill -9 {gateway}` and `rtcp start` give the loop another, `rtcp stop` ends all of it",
        )


def client_name(name: str) -> str:
    """Return the name under which others hear of this client: `name`, or the process."""
    return name or f"{Path(sys.argv[0]).name} (pid {os.getpid()})"


def _connect(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(ANSWER_TIMEOUT_S)
    try:
        connection.connect(os.fspath(path))
    except OSError as error:
        connection.close()
        raise connection_error(path, error) from error
    return connection


def connection_error(path: Path, error: OSError) -> RtcpError:
    """Return why the control socket cannot be reached."""
    length = len(os.fsencode(path))
    if length > LONGEST_SOCKET_PATH:
        return RtcpError(
            "invalid",
            f"the path of the control socket, {path}, has {length} bytes, at most {LONGEST_SOCKET_PATH} are possible: "
            "set RTCP_RUNTIME_DIR to a shorter one",
        )
    if isinstance(error, FileNotFoundError | ConnectionRefusedError | NotADirectoryError):
        return RtcpError("not running", _who_runs(path))
    if isinstance(error, PermissionError):
        return RtcpError("refused", f"the control socket {path} is another user's: only its owner may use it")
    return RtcpError("lost", f"the control socket {path} cannot be reached: {error.strerror or error}")


def _who_runs(path: Path) -> str:
    loop = read_processes(path.parent).loop
    if is_running(loop):
        return f"the loop (process {loop}) runs without a gateway: `rtcp start` gives it one, `rtcp stop` ends it"
    return f"no platform is running (nobody listens at {path}): start one with `rtcp start`"


def _refusal(verb: str, error: object) -> RtcpError:
    """Turn the `error` of an answer into an exception, whatever shape it came in."""
    found = error if isinstance(error, dict) else {}
    kind = found.get("kind")
    message = str(found.get("message") or f"the platform refused {verb!r} without saying why")
    return RtcpError(cast("ErrorKind", kind) if kind in _KINDS_ON_THE_WIRE else "fault", message)
