"""The client's end of the control socket: one request at a time, JSON-RPC 2.0, a message a line."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rtcp.ipc import jsonrpc
from rtcp.ipc.closing import Closing
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import control_socket, runtime_directory
from rtcp.ipc.session import is_running, read_processes
from rtcp.ipc.stops import StopWriter

Progress = Callable[[Mapping[str, Any]], object]

ANSWER_TIMEOUT_S = 15.0
"""Longest silence of the platform within one request: longer than any step of its start or stop."""

LONGEST_SOCKET_PATH = 107
"""sun_path of unix(7): 108 bytes with the closing zero."""

_PEER = struct.Struct("3i")
"""Process, user and group at the other end (unix(7), SO_PEERCRED)."""


class ControlClient(Closing):
    """A connection to the running platform, made by `connect` or by the first call.

    Closing it while a move is under way ends the lease of this client: the arm comes to a controlled stop.
    """

    def __init__(self, name: str = "", path: Path | None = None) -> None:
        """Prepare the connection.

        Args:
            name: of this client, in refusals to others; empty: name and id of this process.
            path: the control socket; that of the runtime directory when None.
        """
        self._path = control_socket(runtime_directory()) if path is None else path
        self._greeting = jsonrpc.line({"method": "identify", "params": {"name": client_name(name)}})
        """Sent with the first request."""
        self._request = 0
        self._received = bytearray()
        self._stops = StopWriter(self._path.parent)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._is_connected = False

    def connect(self) -> None:
        """Connect; a second time is harmless.

        Raises:
            RtcpError: `not running` when nobody listens, `refused` when the socket is another user's, `invalid`
                when its path is too long for a socket.
        """
        if self._is_connected:
            return
        self._socket.settimeout(ANSWER_TIMEOUT_S)
        try:
            self._socket.connect(os.fspath(self._path))
        except OSError as error:
            raise connection_error(self._path, error) from error
        self._is_connected = True

    def close(self) -> None:
        """Close the connection; a second time is harmless."""
        self._socket.close()
        self._stops.close()

    def call(
        self,
        method: str,
        params: Mapping[str, Any] | None = None,
        progress: Progress | None = None,
        timeout_s: float = ANSWER_TIMEOUT_S,
    ) -> dict[str, Any]:
        """Send one request and return the result of its answer.

        An exception before the answer (Ctrl-C, or one of `progress`) cancels the request.

        Args:
            method: its name (`docs/protocol.md`).
            params: its parameters.
            progress: called with each progress report that comes before the answer.
            timeout_s: longest silence, not longest duration: a progress report starts it anew.

        Raises:
            RtcpError: the one that the platform answered; `timeout` after `timeout_s` of silence; `lost` when the
                connection ends first; as `connect`. A stop reaches the loop in all of these cases
                (`StopWriter.requested`).
        """
        self._request = number = self._request + 1
        with self._stops.requested(method, params or {}) as sent:
            self.connect()
            self._socket.settimeout(timeout_s)
            self._send(method, self._greeting + jsonrpc.request(number, method, sent))
            self._greeting = b""
            try:
                reply = self._reply(number, method, progress, timeout_s)
            except BaseException:
                with contextlib.suppress(OSError):
                    self._socket.sendall(jsonrpc.line({"method": "cancel", "params": {"request": number}}))
                raise
            return jsonrpc.result(reply, method)

    def _reply(self, number: int, method: str, progress: Progress | None, timeout_s: float) -> dict[str, Any]:
        """Return the answer to a request; report the progress before it."""
        while True:
            reply = jsonrpc.read_reply(self._receive(method, timeout_s), method)
            report = jsonrpc.progress(reply)
            if report is not None:
                if progress is not None and report.get("request") == number:
                    progress(report)
            elif "id" in reply and reply["id"] in (number, None):
                # null: the answer to a line whose id could not be read.
                return reply

    def _send(self, method: str, data: bytes) -> None:
        try:
            self._socket.sendall(data, socket.MSG_NOSIGNAL)
        except TimeoutError as error:
            raise self._silence(method, self._socket.gettimeout()) from error
        except OSError as error:
            message = f"the platform closed the connection before it received the request {method!r}"
            raise RtcpError("lost", message) from error

    def _receive(self, method: str, timeout_s: float) -> bytes:
        """Return the next line."""
        while (end := self._received.find(b"\n")) < 0:
            try:
                chunk = self._socket.recv(65536)
            except TimeoutError as error:
                raise self._silence(method, timeout_s) from error
            except OSError:
                chunk = b""
            if not chunk:
                raise RtcpError("lost", f"the platform closed the connection before it answered {method!r}")
            self._received += chunk
        line = bytes(self._received[:end])
        del self._received[: end + 1]
        return line

    def _silence(self, method: str, timeout_s: float | None) -> RtcpError:
        gateway, _, _ = _PEER.unpack(self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        return RtcpError(
            "timeout",
            f"the platform has not answered {method!r} for {timeout_s:g} s: if its gateway (process {gateway}) hangs, "
            f"`kill -9 {gateway}` and `rtcp start` give the loop another, `rtcp stop` ends all of it",
        )


def client_name(name: str) -> str:
    """Return the name of this client in messages to others: `name`, or name and id of the process."""
    return name or f"{Path(sys.argv[0]).name} (pid {os.getpid()})"


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
    # The requested platform, which may differ from that of the environment.
    name = path.parent.name if path.parent.parent.absolute() == runtime_directory("").absolute() else ""
    how = f"`rtcp --name {name} start`, or `rtcp cell start`" if name else "`rtcp start`"
    return f"no platform is running (nobody listens at {path}): start one with {how}"
