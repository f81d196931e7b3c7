"""Requests to a virtual device from other processes: client and server of a Unix packet socket.

Messages are JSON objects: the answer to `{"do": "fault", "fault": {...}}` is `{"ok": true, "result": ...}` or
`{"ok": false, "error": "a sentence"}`. The server never waits for a client, as the device's own work has priority.
"""

from __future__ import annotations

import json
import os
import select
import socket
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from rtcp.config.findings import shown
from rtcp.config.validation import unknown

LONGEST_REQUEST = 1024
MOST_CLIENTS = 16
"""Upper bound on clients; another one replaces the one that has been silent longest."""
BACKLOG = 16
ANSWER_TIMEOUT_S = 10.0
LONGEST_ANSWER = 1 << 20

_T = TypeVar("_T")
_Client = TypeVar("_Client", bound="RequestClient")


class RequestRefused(Exception):
    """The device refuses the request; the message is a sentence."""


class ServerAway(Exception):
    """No device answers; the message is a sentence with the path of the socket."""


def choose(verbs: Mapping[str, tuple[tuple[str, ...], _T]], request: dict[str, Any]) -> _T:
    """Remove "do" from a request and return the value of this verb; `verbs` has keys and value of each.

    Raises:
        RequestRefused: unknown verb or key.
    """
    verb = request.pop("do", None)
    if not isinstance(verb, str) or verb not in verbs:
        raise RequestRefused(f"do: found {shown(verb)}, allowed is one of {', '.join(verbs)}")
    keys, chosen = verbs[verb]
    for key in request:
        if key not in keys:
            raise RequestRefused(str(unknown((key,), key, ["do", *keys])))
    return chosen


@contextmanager
def control_socket(path: Path) -> Iterator[socket.socket]:
    """Listen at `path`, for this user only; remove the file at the end. An abandoned file is replaced.

    Raises:
        ValueError: the path is in use, not a socket, or cannot be created; the message is a sentence.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.setblocking(False)
        _make_room(path)
        before = os.umask(0o177)
        try:
            listener.bind(str(path))
            listener.listen(BACKLOG)
        except OSError as error:
            raise ValueError(f"the control socket {path} cannot be made: {error.strerror or error}") from error
        finally:
            os.umask(before)
        try:
            yield listener
        finally:
            with suppress(OSError):
                path.unlink()


def _make_room(path: Path) -> None:
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise ValueError(f"the control socket {path} cannot be made: there is a file that is no socket")
        if _in_use(path):
            raise ValueError(f"the control socket {path} is in use by a process that runs: choose another path")
        path.unlink()
    except FileNotFoundError:
        pass
    except OSError as error:
        raise ValueError(f"the control socket {path} cannot be made: {error.strerror or error}") from error


def _in_use(path: Path) -> bool:
    """Whether a process listens at the socket `path`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            return False
        except OSError:
            pass  # a full queue or the socket of another user
    return True


class RequestSocket:
    """Answers one request per `poll`, so that a flooding client takes no more time than any other."""

    def __init__(self, listener: socket.socket, answer: Callable[[dict[str, Any]], Any]) -> None:
        """`answer` returns the result of a request as plain values, or raises RequestRefused."""
        self._listener = listener
        self._answer_request = answer
        self._clients: dict[int, socket.socket] = {}
        self._epoll = select.epoll()
        self._epoll.register(listener, select.EPOLLIN)

    def close(self) -> None:
        """Disconnect all clients."""
        self._epoll.close()
        for client in self._clients.values():
            client.close()

    def poll(self) -> None:
        """Accept a waiting client or answer one request, if any."""
        for descriptor, _ in self._epoll.poll(0, 1):
            client = self._clients.get(descriptor)
            if client is None:
                self._accept()
            else:
                self._serve(client)

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return  # it has disconnected already
        client.setblocking(False)
        if len(self._clients) >= MOST_CLIENTS:
            self._dismiss(next(iter(self._clients.values())))
        self._clients[client.fileno()] = client
        self._epoll.register(client, select.EPOLLIN)

    def _serve(self, client: socket.socket) -> None:
        try:
            packet = client.recv(LONGEST_REQUEST + 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet or not self._send(client, self._answer(packet)):
            self._dismiss(client)
            return
        # Keep the longest silent client first.
        self._clients[client.fileno()] = self._clients.pop(client.fileno())

    def _dismiss(self, client: socket.socket) -> None:
        del self._clients[client.fileno()]
        self._epoll.unregister(client)
        client.close()

    @staticmethod
    def _send(client: socket.socket, answer: dict[str, Any]) -> bool:
        """Send an answer; return False if the client does not read its answers or has disconnected."""
        try:
            client.send(json.dumps(answer).encode(), socket.MSG_NOSIGNAL)
        except OSError:
            return False
        return True

    def _answer(self, packet: bytes) -> dict[str, Any]:
        try:
            return {"ok": True, "result": self._answer_request(_request(packet))}
        except RequestRefused as refusal:
            return {"ok": False, "error": str(refusal)}


def _request(packet: bytes) -> dict[str, Any]:
    if len(packet) > LONGEST_REQUEST:
        raise RequestRefused(f"a request has at most {LONGEST_REQUEST} bytes")
    try:
        request = json.loads(packet)
    except (ValueError, RecursionError) as error:
        raise RequestRefused("a request is one JSON object in UTF-8, and this is none") from error
    if not isinstance(request, dict):
        raise RequestRefused(f"found {shown(request)}, allowed is an object with the key do")
    return request


class RequestClient:
    """A connection to the device whose control socket is at `path`.

    Raises:
        ServerAway: by each method, if no device answers.
        RequestRefused: by each method, with the device's message.
    """

    def __init__(self, path: Path, server: str) -> None:
        """`server`: name of the device in messages, as "segment"."""
        self._path = path
        self._server = server
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWER_TIMEOUT_S)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise ServerAway(f"no {server} answers at {path} ({error.strerror or error})") from error

    def __enter__(self: _Client) -> _Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; the effects of requests stay."""
        self._socket.close()

    def ask(self, request: dict[str, Any]) -> Any:
        """Send a request and return its result."""
        try:
            self._socket.send(json.dumps(request).encode())
            packet = self._socket.recv(LONGEST_ANSWER)
        except TimeoutError as error:
            raise ServerAway(
                f"the {self._server} at {self._path} does not answer within {ANSWER_TIMEOUT_S:g} s"
            ) from error
        except OSError as error:
            raise ServerAway(f"the {self._server} at {self._path} has gone ({error.strerror or error})") from error
        if not packet:
            raise ServerAway(f"the {self._server} at {self._path} has gone")
        answer = json.loads(packet)
        if not answer["ok"]:
            raise RequestRefused(answer["error"])
        return answer["result"]
