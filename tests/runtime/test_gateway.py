"""The gateway's process on a real blackboard; the loop's part is played here."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.client import ControlClient, ControlError
from rtcp.runtime.layout import PER_JOINT, SCALARS, SERVICE_LENGTH_AT, SERVICE_STATE_AT, SERVICE_TEXT_AT
from rtcp.runtime.machine import Command
from rtcp.runtime.paths import blackboard_file, control_socket
from rtcp.runtime.session import Session

JOINTS = 6
FIELDS = len(SCALARS) - 1 + len(PER_JOINT) * JOINTS
READY = 2
LINE_LIMIT = 65536


class Loop:
    """Takes every command and every request for the service thread, as long as the arm is ready."""

    def __init__(self, path: Path) -> None:
        self.board = Blackboard(path, JOINTS, 500_000)
        self.commands: list[tuple[float, ...]] = []
        self.requests: list[dict[str, Any]] = []
        self._record: list[float] = [0] * FIELDS
        self._record[[name for name, _ in SCALARS[1:]].index("state")] = READY
        self._ended = threading.Event()
        self.board.publish(self._record)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        words, memory = self.board.words, self.board.memory
        while not self._ended.wait(0.001):
            if self.board.command_waits():
                number, _, *command = self.board.take_command()
                self.commands.append(tuple(command))
                self.board.answer(int(number))
            if words[SERVICE_STATE_AT] == 1:
                end = SERVICE_TEXT_AT + words[SERVICE_LENGTH_AT]
                self.requests.append(json.loads(memory[SERVICE_TEXT_AT:end]))
                memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + 13] = b'{"hex": "2a"}'
                words[SERVICE_LENGTH_AT] = 13
                words[SERVICE_STATE_AT] = 2
            self.board.publish(self._record)

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self.board.close()


@pytest.fixture(scope="module")
def directory() -> Iterator[Path]:
    # Short: a control socket's path has 107 bytes at most.
    made = Path(tempfile.mkdtemp(prefix="rtcp-gateway-", dir="/tmp"))
    yield made
    blackboard_file(made).unlink(missing_ok=True)
    shutil.rmtree(made)


@pytest.fixture(scope="module")
def loop(directory: Path) -> Iterator[Loop]:
    config = load(default_config())
    Session(config, "virtual", "ecat0", 0, time.monotonic_ns()).write(directory / "session.pickle")
    (directory / "started.json").write_text("{}")
    made = Loop(blackboard_file(directory))
    reading, writing = os.pipe()
    gateway = subprocess.Popen(
        [sys.executable, "-m", "rtcp.runtime.gateway", "--directory", str(directory), "--ready-fd", str(writing)],
        pass_fds=(writing,),
    )
    os.close(writing)
    with open(reading) as pipe:
        assert pipe.readline()
    yield made
    gateway.terminate()
    gateway.wait()
    made.end()


@pytest.fixture
def client(directory: Path, loop: Loop) -> Iterator[ControlClient]:
    loop.commands.clear()
    loop.requests.clear()
    with ControlClient("a test", control_socket(directory)) as made:
        yield made


OBJECT = {"slave": 2, "index": 0x6065, "subindex": 0}
Q = [0.0] * JOINTS
WRONG = {
    "an output's number with a fraction": ("output", {"number": 1.9, "value": True}, "number: found 1.9, allowed is"),
    "an output's number as a truth": ("output", {"number": True, "value": True}, "number: found true, allowed is an"),
    "an output's number as a text": ("output", {"number": "1", "value": True}, 'number: found "1", allowed is an'),
    "an output's value as a number": ("output", {"number": 1, "value": 1}, "value: found 1, allowed is true or false"),
    "an output's value as a text": ("output", {"number": 1, "value": "off"}, 'value: found "off", allowed is true or'),
    "an output without a value": ("output", {"number": 1}, "value is missing; it must be true or false"),
    "a slave's position with a fraction": ("sdo_read", {**OBJECT, "slave": 2.5}, "slave: found 2.5, allowed is an"),
    "a slave's position as a truth": ("sdo_read", {**OBJECT, "slave": True}, "slave: found true, allowed is an"),
    "an index with a fraction": ("sdo_read", {**OBJECT, "index": 24677.0}, "index: found 24677.0, allowed is an"),
    "a subindex as a truth": ("sdo_read", {**OBJECT, "subindex": False}, "subindex: found false, allowed is an"),
    "an index to be written with a fraction": (
        "sdo_write", {**OBJECT, "index": 24677.5, "hex": "00"}, "index: found 24677.5, allowed is an integer",
    ),
    "bytes to be written that are no text": ("sdo_write", {**OBJECT, "hex": 12}, "hex: found 12, allowed is a text"),
    "positions as truths": ("move", {"q": [True] * JOINTS}, "q: found [true, true, true, true, true, true], allowed"),
    "positions as a text": ("move", {"q": "000000"}, 'q: found "000000", allowed is a list of numbers'),
    "a position as a text": ("move", {"q": ["0"] * JOINTS}, "allowed is a list of numbers"),
    "a position beyond all numbers": ("move", {"q": [10**400] * JOINTS}, "allowed is a list of numbers"),
    "a speed as a truth": ("move", {"q": Q, "speed": True}, "speed: found true, allowed is a number"),
    "a mode that is no text": ("mode", {"name": 8}, "name: found 8, allowed is a text"),
}  # fmt: skip


@pytest.mark.parametrize(("verb", "arguments", "sentence"), WRONG.values(), ids=WRONG.keys())
def test_an_argument_of_another_kind_is_refused_in_a_sentence_and_never_made_into_the_right_one(
    client: ControlClient, loop: Loop, verb: str, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ControlError) as raised:
        client.call(verb, arguments)
    assert raised.value.kind == "invalid"
    assert sentence in raised.value.message
    assert loop.commands == []
    assert loop.requests == []


def test_arguments_of_the_right_kind_reach_the_loop_as_they_are(client: ControlClient, loop: Loop) -> None:
    client.call("output", {"number": 3, "value": False})
    assert [command[:3] for command in loop.commands] == [(Command.OUTPUT, 3.0, 0.0)]
    assert client.call("sdo_read", OBJECT) == {"hex": "2a"}
    client.call("sdo_write", {**OBJECT, "hex": "0b"})
    assert loop.requests == [{"do": "sdo_read", **OBJECT}, {"do": "sdo_write", **OBJECT, "hex": "0b"}]


@pytest.mark.parametrize("length", [LINE_LIMIT + 1, 4_000_000])
@pytest.mark.parametrize("newline", [b"", b"\n"], ids=["endless", "whole"])
def test_a_line_over_64_kib_is_answered_with_a_sentence_and_the_connection_is_closed(
    directory: Path, loop: Loop, length: int, newline: bytes
) -> None:
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(20)
        raw.connect(str(control_socket(directory)))
        raw.sendall(b" " * length + newline)
        said = raw.makefile("rb").read()
    answer = json.loads(said)
    assert answer["ok"] is False
    assert answer["error"]["kind"] == "invalid"
    assert f"longer than {LINE_LIMIT} bytes" in answer["error"]["message"]


def test_requests_before_a_line_over_64_kib_are_answered_first(directory: Path, loop: Loop) -> None:
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(20)
        raw.connect(str(control_socket(directory)))
        request = {"id": 1, "do": "sdo_read", "args": OBJECT}
        raw.sendall(json.dumps(request).encode() + b"\n" + b" " * 100_000 + b"\n")
        answers = [json.loads(line) for line in raw.makefile("rb")]
    assert [answer["ok"] for answer in answers] == [True, False]


def test_a_client_whose_request_is_too_long_is_told_so(client: ControlClient) -> None:
    with pytest.raises(ControlError, match=f"longer than {LINE_LIMIT} bytes") as raised:
        client.call("sdo_write", {**OBJECT, "hex": "00" * 1_000_000})
    assert raised.value.kind == "invalid"
