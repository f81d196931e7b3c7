"""The gateway's process on a real blackboard; the loop's part is played here."""

from __future__ import annotations

import json
import socket
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from tests.runtime.played_loop import JOINTS, Loop

from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.machine import Command
from rtcp.ipc.runtime_directory import control_socket

LINE_LIMIT = 65536


@pytest.fixture
def directory(gateway_directory: Path) -> Path:
    return gateway_directory


@pytest.fixture
def loop(gateway_loop: Loop) -> Loop:
    return gateway_loop


@pytest.fixture
def client(gateway_client: ControlClient) -> ControlClient:
    return gateway_client


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
    "a pose as a text": ("move_pose", {"pose": "0"}, 'pose: found "0", allowed is a list of numbers'),
    "a pose of five numbers": ("move_pose", {"pose": [0.0] * 5}, "the pose: found 5 numbers, allowed are 6"),
    "poses that are none": ("line", {"poses": [1.0]}, "poses: found [1.0], allowed is a list of lists of numbers"),
    "a line that is a number": ("move_pose", {"pose": Q, "line": 1}, "line: found 1, allowed is true or false"),
    "a file beside a folder": ("run", {"file": "a.csv"}, "file: found 'a.csv', allowed is an absolute path"),
    "a file that is not there": ("run", {"file": "/none/a.csv"}, "/none/a.csv"),
    "a frame that is none": ("jog", {"v": Q, "frame": "world"}, "frame: found 'world', allowed is one of base"),
    "five speeds": ("jog", {"v": [0.0] * 5, "frame": "base"}, "v: found 5 numbers, allowed are 6"),
    "torques as a text": ("torque", {"numbers": "0"}, 'numbers: found "0", allowed is a list of numbers'),
    "a target without a stamp": ("stream", {"q": Q}, "t is missing; it must be a number"),
    "limits that are a list": ("limits", {"set": []}, "set: found [], allowed is an object of numbers"),
    "no limits": ("limits", {"set": {}}, "no limit was named"),
    "a limit of another name": ("limits", {"set": {"joint9.max": 1}}, "joint9.max: there is no such limit"),
    "a stick's position of another name": ("stick", {"pressed": ["away"]}, "pressed: found 'away', allowed"),
    "a stick's byte beyond it": ("stick", {"pressed": [], "byte": 256}, "byte: found 256, allowed is 0 to 255"),
    "a stick held for ever": ("stick", {"pressed": [], "hold_s": 60}, "hold_s: found 60.0, allowed is more than 0"),
    "a joint that is none": ("zero", {"joint": "joint9"}, "joint: found 'joint9', allowed is one of joint1"),
    "a gripper as a text": ("gripper", {"open": "yes"}, 'open: found "yes", allowed is true or false'),
    "a mode of another name": ("mode", {"name": "fast"}, "mode 'fast' is unknown: one of joint, cartesian, joystick"),
    "a mode that is no text": ("mode", {"name": 8}, "name: found 8, allowed is a text"),
}  # fmt: skip


@pytest.mark.parametrize(("verb", "arguments", "sentence"), WRONG.values(), ids=WRONG.keys())
def test_an_argument_of_another_kind_is_refused_in_a_sentence_and_never_made_into_the_right_one(
    client: ControlClient, loop: Loop, verb: str, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(RtcpError) as raised:
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
    with pytest.raises(RtcpError, match=f"longer than {LINE_LIMIT} bytes") as raised:
        client.call("sdo_write", {**OBJECT, "hex": "00" * 1_000_000})
    assert raised.value.kind == "invalid"


def test_the_status_tells_each_message_with_its_instant(client: ControlClient, loop: Loop) -> None:
    before = datetime.now().astimezone()
    loop.board.text("a sentence with a time")
    status = client.call("status")
    told = [event for event in status["events"] if event["sentence"] == "a sentence with a time"]
    assert [event["sentence"] for event in status["events"]] == status["messages"]
    when = datetime.fromisoformat(told[-1]["time"])
    assert before - timedelta(milliseconds=1) <= when <= datetime.now().astimezone()
