"""The client's end of the control socket."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError


@pytest.fixture
def listener(directory: Path) -> Iterator[socket.socket]:
    """A socket behind which the test itself speaks."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as bound:
        bound.bind(str(directory / "control.sock"))
        bound.listen()
        yield bound


def replies(listener: socket.socket, *chunks: bytes) -> None:
    """Answer the first request with these bytes, a packet each, and close."""

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(65536)
            for chunk in chunks:
                connection.sendall(chunk)

    threading.Thread(target=serve, daemon=True).start()


def error_of(listener: socket.socket, *chunks: bytes) -> RtcpError:
    replies(listener, *chunks)
    with ControlClient() as client, pytest.raises(RtcpError) as raised:
        client.call("status")
    return raised.value


def test_a_request_carries_the_verb_the_arguments_and_who_asks(platform: Any) -> None:
    with ControlClient("a test") as client:
        client.call("mode", {"name": "csv"})
    assert platform.requests == [{"id": 1, "do": "mode", "args": {"name": "csv"}, "client": "a test"}]


def test_progress_is_passed_on_before_the_result_comes(platform: Any) -> None:
    seen: list[float] = []
    with ControlClient() as client:
        result = client.call("move", {"q": [0.0] * 6}, lambda progress: seen.append(progress["fraction"]))
    assert seen == [0.0, 0.25, 0.5, 0.75]
    assert result["error"] == 0.00042


def test_one_connection_carries_many_requests(platform: Any) -> None:
    with ControlClient() as client:
        assert [client.call("status")["cycles"] for _ in range(3)] == [123_456] * 3
    assert [request["id"] for request in platform.requests] == [1, 2, 3]


def test_an_answer_in_pieces_is_put_together(listener: socket.socket) -> None:
    replies(listener, b'{"id": 1, "ok": tr', b'ue, "result": {"cycles"', b": 5}}\n")
    with ControlClient() as client:
        assert client.call("status") == {"cycles": 5}


def test_an_answer_to_another_request_is_passed_over(listener: socket.socket) -> None:
    replies(listener, b'{"id": 9, "ok": true, "result": {}}\n{"id": 1, "ok": true, "result": {"cycles": 5}}\n')
    with ControlClient() as client:
        assert client.call("status") == {"cycles": 5}


def test_a_refusal_keeps_its_kind_and_its_sentence(platform: Any) -> None:
    platform.refusals["enable"] = ("refused", "the arm is commanded by a panel")
    with ControlClient() as client, pytest.raises(RtcpError) as raised:
        client.call("enable")
    assert (raised.value.kind, raised.value.message) == ("refused", "the arm is commanded by a panel")


def test_a_refusal_of_a_kind_that_is_not_known_is_a_fault(listener: socket.socket) -> None:
    error = error_of(listener, b'{"id": 1, "ok": false, "error": {"kind": "not running", "message": "odd"}}\n')
    assert (error.kind, error.message) == ("fault", "odd")


def test_a_refusal_without_words_is_still_a_sentence(listener: socket.socket) -> None:
    assert "status" in error_of(listener, b'{"id": 1, "ok": false}\n').message


def test_a_connection_that_ends_before_the_answer_is_lost(listener: socket.socket) -> None:
    error = error_of(listener, b'{"id": 1, "ok"')
    assert error.kind == "lost"
    assert "'status'" in error.message


def test_an_answer_that_is_no_json_is_shown(listener: socket.socket) -> None:
    error = error_of(listener, b"hello\n")
    assert error.kind == "internal"
    assert "hello" in error.message


def test_silence_ends_in_a_timeout_that_names_the_verb(listener: socket.socket) -> None:
    with ControlClient() as client, pytest.raises(RtcpError, match=r"'reset' for 0\.05 s") as raised:
        client.call("reset", timeout_s=0.05)
    assert raised.value.kind == "timeout"
    assert f"its gateway (process {os.getpid()})" in raised.value.message


def test_a_socket_that_nobody_serves_is_not_running(listener: socket.socket, directory: Path) -> None:
    listener.close()
    assert (directory / "control.sock").exists()
    with pytest.raises(RtcpError, match="nobody listens") as raised:
        ControlClient()
    assert raised.value.kind == "not running"


def test_a_path_too_long_for_a_socket_is_named_with_the_limit(tmp_path: Path) -> None:
    with pytest.raises(RtcpError, match="at most 107") as raised:
        ControlClient(path=tmp_path / ("x" * 120) / "control.sock")
    assert raised.value.kind == "invalid"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open any socket")
def test_the_socket_of_another_user_is_refused(listener: socket.socket, directory: Path) -> None:
    (directory / "control.sock").chmod(0)
    with pytest.raises(RtcpError, match="only its owner") as raised:
        ControlClient()
    assert raised.value.kind == "refused"
