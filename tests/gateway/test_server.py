"""The gateway's process on a real blackboard and a real socket: JSON-RPC, connections, and their ends."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from rtcp.gateway import server
from rtcp.ipc.client import ControlClient
from rtcp.ipc.commands import Command, Disable, Halt, MoveJoints
from rtcp.ipc.errors import Invalid, Refused
from rtcp.ipc.events import ErrorReported, SlaveLost
from rtcp.ipc.jsonrpc import LINE_LIMIT
from rtcp.ipc.runtime_directory import control_socket
from rtcp.ipc.states import State
from tests.gateway.fake_loop import JOINTS, FakeLoop
from tests.waiting import until

OBJECT = {"slave": 2, "index": 0x6065, "subindex": 0}
MOVE = {"q": [0.1] * JOINTS}
LONG = 1_000_000


class Raw:
    """A connection that sends any bytes."""

    def __init__(self, directory: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(20)
        self.socket.connect(str(control_socket(directory)))
        self.file = self.socket.makefile("rb")

    def send(self, *messages: dict[str, Any] | bytes) -> None:
        for message in messages:
            data = message if isinstance(message, bytes) else json.dumps({"jsonrpc": "2.0", **message}).encode()
            self.socket.sendall(data + b"\n")

    def receive(self) -> dict[str, Any]:
        """Return the next answer; progress is skipped."""
        while True:
            answer: dict[str, Any] = json.loads(self.file.readline())
            if "method" not in answer:
                return answer

    def ask(self, message: dict[str, Any] | bytes) -> dict[str, Any]:
        self.send(message)
        return self.receive()

    def close(self) -> None:
        self.file.close()
        self.socket.close()


@pytest.fixture
def raw(directory: Path, loop: FakeLoop) -> Iterator[Raw]:
    made = Raw(directory)
    yield made
    made.close()


# -- messages ---------------------------------------------------------------------------------------------------------


def test_parameters_reach_the_loop_as_they_are(client: ControlClient, loop: FakeLoop) -> None:
    assert client.call("sdo_read", OBJECT) == {"hex": "2a"}
    client.call("sdo_write", {**OBJECT, "hex": "0b"})
    assert loop.requests == [{"do": "sdo_read", **OBJECT}, {"do": "sdo_write", **OBJECT, "hex": "0b"}]


INVALID: dict[str, tuple[dict[str, Any] | bytes, Any, int, str]] = {
    "no JSON": (b"{", None, -32700, "the request is no JSON"),
    "NaN": (b'{"jsonrpc":"2.0","id":1,"method":"status","params":{"a":NaN}}', None, -32700, "NaN is no number"),
    "a batch": (b"[]", None, -32600, "the request must be an object, not list"),
    "an id with a fraction": ({"id": 1.5, "method": "status"}, None, -32600, "id: found float"),
    "another version": ({"jsonrpc": "1.0", "id": 7, "method": "status"}, 7, -32600, 'jsonrpc: found "1.0"'),
    "no method": ({"id": 7}, 7, -32600, "method: found NoneType, allowed is a text"),
    "an unknown method": ({"id": "x", "method": "fly"}, "x", -32601, 'method: found the text "fly", allowed is one of'),
    "parameters by position": ({"id": 7, "method": "status", "params": [1]}, 7, -32600, "params: found list, allowed"),
    "a notification": ({"method": "enable"}, None, -32600, "id: it is missing; only identify and cancel"),
    "a wrong parameter": (
        {"id": 7, "method": "run", "params": {"file": 1}},
        7,
        -32602,
        "file: found 1, allowed is a t",
    ),
}


@pytest.mark.parametrize(("message", "number", "code", "text"), INVALID.values(), ids=INVALID.keys())
def test_an_invalid_request_is_answered_with_the_code_of_the_specification(
    raw: Raw, loop: FakeLoop, message: dict[str, Any] | bytes, number: Any, code: int, text: str
) -> None:
    answer = raw.ask(message)
    assert (answer["jsonrpc"], answer["id"], answer["error"]["code"]) == ("2.0", number, code)
    assert text in answer["error"]["message"]
    assert answer["error"]["data"]["kind"] == "invalid"
    assert loop.commands == []


@pytest.mark.parametrize("length", [LINE_LIMIT + 1, 8_000_000])
@pytest.mark.parametrize("newline", [b"", b"\n"], ids=["endless", "whole"])
def test_a_line_over_the_limit_is_answered_and_the_connection_closed(raw: Raw, length: int, newline: bytes) -> None:
    raw.socket.sendall(b" " * length + newline)
    (answer,) = [json.loads(line) for line in raw.file]
    assert answer["error"]["data"]["kind"] == "invalid"
    assert f"longer than {LINE_LIMIT} bytes" in answer["error"]["message"]


def test_requests_before_a_line_over_the_limit_are_answered_first(raw: Raw) -> None:
    raw.send({"id": 1, "method": "sdo_read", "params": OBJECT}, b" " * 5_000_000)
    assert ["result" in json.loads(line) for line in raw.file] == [True, False]


def test_a_client_whose_request_is_too_long_gets_that_answer(client: ControlClient) -> None:
    with pytest.raises(Invalid, match=f"longer than {LINE_LIMIT} bytes"):
        client.call("sdo_write", {**OBJECT, "hex": "00" * 3_000_000})


def test_a_carriage_return_is_white_space_within_a_request(raw: Raw, loop: FakeLoop) -> None:
    raw.send(b'{"jsonrpc": "2.0",\r"id": 1, "method": "sdo_read",\r\t"params": ' + json.dumps(OBJECT).encode() + b"}\r")
    assert raw.receive()["result"] == {"hex": "2a"}
    raw.send(b'{"jsonrpc": "2.0",\r"method":\r"halt", "id": 2}')
    until(lambda: loop.kinds == [Halt], "the halt")


def test_what_was_read_no_longer_counts_as_backlog(
    directory: Path, loop: FakeLoop, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path))
    monkeypatch.setattr(server, "_MOST_BACKLOG", 100)
    ours, theirs = socket.socketpair()

    async def work() -> tuple[list[int], int]:
        gateway = server.Gateway(directory)
        gateway._main = gateway._sockets = running = asyncio.get_running_loop()
        _, served = await running.create_unix_connection(gateway._connect, sock=theirs)
        reader, writer = await asyncio.open_unix_connection(sock=ours)
        codes = []
        for _ in range(10):
            writer.write(b"[]\n" * 60)
            codes += [json.loads(await reader.readline())["error"]["code"] for _ in range(60)]
        await asyncio.sleep(0.01)
        writer.close()
        return codes, served._connection.backlog

    assert asyncio.run(work()) == ([-32600] * 600, 0)


def test_requests_beyond_256_pending_ones_are_refused(raw: Raw, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG
    raw.send({"id": 0, "method": "move_joints", "params": MOVE})
    raw.send(*({"id": number, "method": "sdo_read", "params": OBJECT} for number in range(1, 258)))
    assert [raw.receive()["error"]["data"]["kind"] for _ in range(2)] == ["refused"] * 2


# -- connections ------------------------------------------------------------------------------------------------------


def test_the_holder_of_the_lease_has_the_name_it_gave(client: ControlClient, loop: FakeLoop, directory: Path) -> None:
    loop.state = State.HOLDING
    with ControlClient("a jogger", control_socket(directory)) as jogger:
        jogger.call("jog", {"velocity": [0.1, 0, 0, 0, 0, 0], "hold_s": 0.2})
        assert client.call("status")["lease"]["holder"] == "a jogger"
        with pytest.raises(Refused, match="the arm is commanded by a jogger"):
            client.call("move_joints", MOVE)
    until(lambda: client.call("status")["lease"]["holder"] == "", "the end of the lease")


def test_a_connection_that_closes_during_a_move_ends_the_move(raw: Raw, loop: FakeLoop, client: ControlClient) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG
    raw.send({"id": 1, "method": "move_joints", "params": MOVE})
    until(lambda: loop.state is State.MOVING, "moving")
    raw.close()
    until(lambda: loop.state is State.HOLDING, "holding")
    assert client.call("status")["lease"]["holder"] == ""


def test_a_request_that_is_cancelled_ends_its_move_and_is_answered(raw: Raw, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG
    raw.send({"id": "a", "method": "move_joints", "params": MOVE})
    until(lambda: loop.state is State.MOVING, "moving")
    answer = raw.ask({"method": "cancel", "params": {"request": "a"}})
    assert (answer["id"], answer["error"]["message"]) == ("a", "move_joints was cancelled")
    until(lambda: loop.state is State.HOLDING, "holding")


def test_a_call_that_an_exception_leaves_ends_its_move(client: ControlClient, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG

    def interrupt(progress: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        client.call("move_joints", MOVE, interrupt)
    until(lambda: loop.state is State.HOLDING, "holding")
    assert client.call("status")["lease"]["holder"] == ""


def test_halt_does_not_wait_for_the_move_of_its_own_connection_and_other_requests_do(raw: Raw, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG
    raw.send(
        {"id": 1, "method": "move_joints", "params": MOVE},
        {"id": 2, "method": "set_output", "params": {"output": 1, "value": True}},
    )
    until(lambda: loop.state is State.MOVING, "moving")
    raw.send({"id": 3, "method": "halt"})
    until(lambda: loop.kinds == [MoveJoints, Halt], "the halt")
    loop.state = State.HOLDING
    assert sorted(raw.receive()["id"] for _ in range(3)) == [1, 2, 3]


@pytest.mark.parametrize("kind", [Halt, Disable])
def test_a_stop_overtakes_the_requests_of_a_hundred_clients(
    directory: Path, loop: FakeLoop, kind: type[Command]
) -> None:
    lowered = {"method": "set_speed_override", "params": {"fraction": 1.0}}
    clients = [Raw(directory) for _ in range(100)]
    try:
        for client in clients:
            client.send(*({"id": number, **lowered} for number in range(100)))
        until(lambda: len(loop.commands) > 10, "the first commands")
        before = len(loop.commands)
        clients[-1].send({"id": 100, "method": kind.name})  # behind 100 requests of its own connection
        until(lambda: kind in loop.kinds, "the stop")
        assert len(loop.commands) - before < 5_000
    finally:
        for client in clients:
            client.close()
        until(lambda: is_quiet(loop), "the end of all requests")


def is_quiet(loop: FakeLoop) -> bool:
    """Return whether the gateway sends nothing more for the clients that have gone."""
    before = len(loop.commands)
    time.sleep(0.3)
    return len(loop.commands) == before


def test_a_motion_that_was_requested_before_a_stop_does_not_begin_after_it(raw: Raw, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG
    move = {"method": "move_joints", "params": MOVE}
    raw.send({"id": 1, **move}, {"id": 2, **move})
    until(lambda: loop.state is State.MOVING, "moving")
    raw.send({"id": 3, "method": "halt"})
    until(lambda: Halt in loop.kinds, "the halt")
    loop.state = State.HOLDING
    errors = {answer["id"]: answer.get("error") for answer in (raw.receive() for _ in range(3))}
    assert errors[2]["data"]["reason"] == "superseded"
    assert loop.kinds == [MoveJoints, Halt]


def test_a_motion_that_arrives_after_a_stop_and_was_requested_before_it_does_not_begin(
    raw: Raw, loop: FakeLoop
) -> None:
    loop.state = State.HOLDING
    requested_ns = time.monotonic_ns()
    raw.send({"id": 1, "method": "halt"})
    assert raw.receive()["id"] == 1
    move = {"method": "move_joints", "params": MOVE}
    raw.send({"id": 2, **move, "requested_ns": requested_ns})
    assert raw.receive()["error"]["data"]["reason"] == "superseded"
    raw.send({"id": 3, **move, "requested_ns": time.monotonic_ns()})
    until(lambda: MoveJoints in loop.kinds, "the motion")


def test_a_stop_without_an_answer_stops_all_the_same(raw: Raw, loop: FakeLoop) -> None:
    raw.send({"method": "halt"})
    assert raw.receive()["error"]["data"]["kind"] == "invalid"
    until(lambda: loop.kinds == [Halt], "the halt")


def test_a_client_stopped_by_sigstop_during_a_move_loses_its_lease(
    directory: Path, loop: FakeLoop, client: ControlClient
) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG
    program = (
        "import sys; from pathlib import Path; from rtcp.ipc.client import ControlClient\n"
        f"ControlClient('stopped', Path(sys.argv[1])).call('move_joints', {MOVE!r}, timeout_s=60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(control_socket(directory))], stderr=subprocess.DEVNULL
    )
    try:
        until(lambda: loop.state is State.MOVING, "moving")
        process.send_signal(signal.SIGSTOP)
        until(lambda: loop.state is State.HOLDING, "holding")
        assert client.call("status")["lease"]["holder"] == ""
    finally:
        process.kill()
        process.wait()


# -- what is shown ----------------------------------------------------------------------------------------------------


def test_the_status_has_each_message_with_its_instant(client: ControlClient, loop: FakeLoop) -> None:
    before = datetime.now().astimezone()
    loop.board.event(ErrorReported("a message with a time"))
    status = client.call("status")
    at = status["messages"].index("a message with a time")
    when = datetime.fromisoformat(status["message_times"][at])
    assert before - timedelta(milliseconds=1) <= when <= datetime.now().astimezone()


def test_events_have_names_fields_and_messages(client: ControlClient, loop: FakeLoop) -> None:
    since = client.call("events")["events"]
    loop.board.event(SlaveLost(3))
    (event,) = client.call("events", {"since": since[-1]["number"] if since else 0})["events"]
    assert (event["name"], event["fields"]) == ("slave_lost", {"slave": 3})
    assert event["message"].startswith("slave 3 (")


# -- the last moments of the process ----------------------------------------------------------------------------------

PROGRAM = """
import asyncio, os, signal
from asyncio import selector_events
from pathlib import Path
from rtcp.gateway import server as gateway

class Served:
    def __init__(self, directory):
        pass

    async def serve(self, ready):
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ready)

def close(loop, sound=selector_events.BaseSelectorEventLoop.close):
    sound(loop)
    os.kill(os.getpid(), signal.SIGTERM)

gateway.Gateway = Served
selector_events.BaseSelectorEventLoop.close = close
asyncio.run(gateway._run(Path("."), lambda: None))
"""


def test_a_signal_while_the_gateway_ends_is_no_traceback() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
