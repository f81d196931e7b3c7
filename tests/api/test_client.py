"""The client's end of the control socket."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import Faulted, Refused, RtcpError


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "control.sock"


@pytest.fixture
def listener(path: Path) -> Iterator[socket.socket]:
    """A socket behind which the test itself answers."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as bound:
        bound.bind(str(path))
        bound.listen()
        yield bound


class Peer:
    """Answers the first request with these bytes, a packet each, and closes; `received` holds the requests.

    Of several `requests` each has one packet; without a packet it reads on.
    """

    def __init__(self, listener: socket.socket, *packets: bytes, requests: int = 1) -> None:
        self.received: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._serve, args=(listener, packets, requests), daemon=True)
        self._thread.start()

    def _serve(self, listener: socket.socket, packets: tuple[bytes, ...], requests: int) -> None:
        connection, _ = listener.accept()
        with connection, connection.makefile("rb") as lines:
            for number in range(requests):
                while not self.received or self.received[-1].get("id") != number + 1:
                    self.received.append(json.loads(lines.readline()))
                for packet in packets[number : number + 1] if requests > 1 else packets:
                    connection.sendall(packet)
            if not packets:
                self.received += [json.loads(line) for line in lines]

    def join(self) -> list[dict[str, Any]]:
        self._thread.join(10)
        return self.received


def error_of(listener: socket.socket, *chunks: bytes) -> RtcpError:
    Peer(listener, *chunks)
    with ControlClient() as client, pytest.raises(RtcpError) as raised:
        client.call("status")
    return raised.value


OK = b'{"jsonrpc": "2.0", "id": 1, "result": {"cycles": 5}}\n'


def test_a_connection_gives_its_name_once_and_numbers_its_requests(listener: socket.socket) -> None:
    peer = Peer(listener, OK, b'{"jsonrpc": "2.0", "id": 2, "result": {}}\n', requests=2)
    began_ns = time.monotonic_ns()
    with ControlClient("a test") as client:
        assert client.call("mode", {"name": "csv"}) == {"cycles": 5}
        client.call("status")
    greeting, *requests = peer.join()
    assert greeting == {"jsonrpc": "2.0", "method": "identify", "params": {"name": "a test"}}
    first, second = (request.pop("requested_ns") for request in requests)
    assert began_ns <= first < second <= time.monotonic_ns()
    assert requests == [
        {"jsonrpc": "2.0", "id": 1, "method": "mode", "params": {"name": "csv"}},
        {"jsonrpc": "2.0", "id": 2, "method": "status", "params": {}},
    ]


def test_progress_of_the_request_is_passed_on_before_the_result(listener: socket.socket) -> None:
    reports = [(1, 0.0), (9, 0.1), (1, 0.5)]
    lines = [
        json.dumps({"method": "progress", "params": {"request": number, "fraction": fraction}}).encode() + b"\n"
        for number, fraction in reports
    ]
    Peer(listener, *lines, OK)
    seen: list[float] = []
    with ControlClient() as client:
        client.call("run", {}, lambda progress: seen.append(progress["fraction"]))
    assert seen == [0.0, 0.5]


@pytest.mark.parametrize("packets", [(OK[:20], OK[20:50], OK[50:]), (b'{"id": 9, "result": {}}\n' + OK,)])
def test_pieces_are_put_together_and_an_answer_to_another_request_is_skipped(
    listener: socket.socket, packets: tuple[bytes, ...]
) -> None:
    Peer(listener, *packets)
    with ControlClient() as client:
        assert client.call("status") == {"cycles": 5}


def test_an_error_has_the_class_of_its_kind_and_carries_reason_and_fields(listener: socket.socket) -> None:
    data = {"kind": "refused", "reason": "lease_held", "fields": {"holder": "a panel"}}
    answer = {"id": 1, "error": {"code": -32000, "message": "the arm is commanded by a panel", "data": data}}
    error = error_of(listener, json.dumps(answer).encode() + b"\n")
    assert type(error) is Refused
    assert str(error) == error.message == "the arm is commanded by a panel"
    assert (error.kind, error.reason, error.fields) == ("refused", "lease_held", {"holder": "a panel"})


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b'{"id": 1, "error": {"message": "odd", "data": {"kind": "not running"}}}\n', "odd"),
        (b'{"id": 1, "error": {"data": 3}}\n', "the platform refused 'status' without saying why"),
        (b'{"id": null, "error": 3}\n', "the platform refused 'status' without saying why"),
        (b'{"id": 1}\n', "the platform refused 'status' without saying why"),
    ],
)
def test_an_error_of_any_other_form_is_a_fault(listener: socket.socket, answer: bytes, message: str) -> None:
    error = error_of(listener, answer)
    assert (type(error), error.message) == (Faulted, message)


def test_a_call_that_an_exception_leaves_is_cancelled(listener: socket.socket) -> None:
    peer = Peer(listener)
    with ControlClient() as client, pytest.raises(RtcpError, match=r"'reset' for 0\.05 s") as raised:
        client.call("reset", timeout_s=0.05)
    assert raised.value.kind == "timeout"
    assert f"its gateway (process {os.getpid()})" in raised.value.message
    assert peer.join()[-1] == {"jsonrpc": "2.0", "method": "cancel", "params": {"request": 1}}


@pytest.mark.parametrize("value", [float("nan"), object()])
def test_what_json_cannot_express_is_not_sent(listener: socket.socket, value: object) -> None:
    with ControlClient() as client, pytest.raises(RtcpError, match="cannot be sent as JSON") as raised:
        client.call("run", {"file": value})
    assert raised.value.kind == "invalid"


def test_a_number_that_is_not_finite_is_named_by_its_place(listener: socket.socket) -> None:
    points = [{"t": 0.0, "q": [0.0, 1.0]}, {"t": 1.0, "q": [0.0, float("nan")]}]
    with ControlClient() as client, pytest.raises(RtcpError) as raised:
        client.call("run_trajectory", {"points": points})
    assert raised.value.message.endswith("as JSON: points[1].q[1] is nan, a finite number is needed")


def test_a_connection_that_ends_before_the_answer_is_lost(listener: socket.socket) -> None:
    error = error_of(listener, b'{"id": 1, "ok"')
    assert error.kind == "lost"
    assert "'status'" in error.message


def test_an_answer_that_is_no_json_is_shown(listener: socket.socket) -> None:
    error = error_of(listener, b"hello\n")
    assert error.kind == "internal"
    assert "hello" in error.message


def test_a_socket_that_nobody_serves_is_not_running(listener: socket.socket, path: Path) -> None:
    listener.close()
    assert path.exists()
    with ControlClient() as client, pytest.raises(RtcpError, match="nobody listens") as raised:
        client.connect()
    assert raised.value.kind == "not running"


def test_a_path_too_long_for_a_socket_is_named_with_the_limit(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 120) / "control.sock"
    with ControlClient(path=path) as client, pytest.raises(RtcpError, match="at most 107") as raised:
        client.connect()
    assert raised.value.kind == "invalid"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open any socket")
def test_the_socket_of_another_user_is_refused(listener: socket.socket, path: Path) -> None:
    path.chmod(0)
    with ControlClient() as client, pytest.raises(RtcpError, match="only its owner") as raised:
        client.connect()
    assert raised.value.kind == "refused"
