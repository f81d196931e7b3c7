"""The control socket of a real gateway on mutated lines: answered or closed, and without effect."""

from __future__ import annotations

import copy
import json
import socket
from collections import Counter
from collections.abc import Iterator
from random import Random
from typing import Any

import pytest

from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import Platform, lives

pytestmark = pytest.mark.platform

LINES = 400
A_CONNECTION = 60
Q = [0.1] * 6
OBJECT = {"slave": 2, "index": 0x6041, "subindex": 0}
REQUESTS: tuple[dict[str, Any], ...] = tuple(
    {"jsonrpc": "2.0", "id": 7, "method": method, "params": params}
    for method, params in (
        ("status", {}), ("scan", {}), ("events", {"since": 0}), ("halt", {}), ("disable", {}), ("limits", {}),
        ("move_joints", {"q": Q, "speed": 0.2, "synchronized": False}), ("move_pose", {"pose": Q, "line": True}),
        ("move_line", {"poses": [Q, Q], "speed": 0.1}), ("run", {"file": "/none/a.csv"}),
        ("run_trajectory", {"points": [{"t": 0.0, "q": Q}, {"t": 1.0, "q": Q}], "approach": True}),
        ("run_path", {"stops": [{"pose": Q, "speed": 0.1}, {"q": Q}]}), ("stream_position", {"q": Q, "stamp_s": 1.0}),
        ("jog", {"velocity": Q, "frame": "base", "hold_s": 0.1}), ("move_at_velocity", {"velocity": Q, "hold_s": 0.1}),
        ("apply_torque", {"torque": Q, "stiffness": 0.5, "damping": 0.5, "hold_s": 0.1}),
        ("sdo_read", OBJECT), ("sdo_write", {**OBJECT, "index": 0x5FFF, "hex": "00"}),
        ("set_limits", {"changes": {"joint9.max": 1.0}}), ("zero", {"joint": "joint9"}), ("mode", {"name": "csp"}),
        ("set_output", {"output": 17, "value": True}), ("joystick", {"pressed": ["away"], "hold_s": 0.1}),
    )
)  # fmt: skip
NASTY: tuple[Any, ...] = (
    None, True, False, 0, -1, 1.5, 1e308, -1e308, 10**400, 2**63, -(2**63) - 1, "", "x", "x" * 5000, "\ud800",
    "\udfff\x00\x1b[2J", "../../etc/passwd", "ÿ" * 100, [], {}, [[]], [None] * 6, [1e308] * 6, {"": ""},
    {"x" * 2000: 1}, [[[[[[[[]]]]]]]], list(range(3000)), "NaN", "1",
)  # fmt: skip
RAW = (
    b"", b"\x00", b"\xff\xfe", b"{", b"}", b"[]", b"null", b'"', b"NaN", b"[" * 20_000, b'{"a":' * 5000,
    b'{"jsonrpc":"2.0","method":"status","method":"scan","id":1}', b'{"jsonrpc":"2.0","id":1e999,"method":"status"}',
    b'{"jsonrpc":"2.0","method":"\\ud800","id":"\\ud800"}', b'{"jsonrpc":"2.0","id":NaN,"method":"status"}',
    b'{"jsonrpc":"2.0","id":1,"method":"move_joints","params":{"q":[NaN,Infinity]}}',
    b'{"jsonrpc":"2.0","method":"cancel","params":{"request":[]},"id":1}',
    b"GET / HTTP/1.1\r", b"\xef\xbb\xbf{}", b'{"id":' + b"9" * 5000 + b"}", b"9" * 60_000, bytes(range(11, 256)),
)  # fmt: skip


def nodes(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths to all values in a request."""
    if path:
        yield path
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, below in inside:
        yield from nodes(below, (*path, key))


def mutated_line(random: Random) -> bytes:
    """Return a line without its newline."""
    if random.random() < 0.1:
        return random.choice(RAW)
    request = copy.deepcopy(random.choice(REQUESTS))
    for _ in range(random.choice((1, 1, 2, 3))):
        path = random.choice(list(nodes(request)))
        within: Any = request
        for key in path[:-1]:
            within = within[key]
        if random.random() < 0.2:
            del within[path[-1]]
        else:
            within[path[-1]] = copy.deepcopy(random.choice(NASTY))
    # Without the methods that end the platform or enable the arm; no mutation produces their names.
    line = bytearray(json.dumps(request).encode())
    if random.random() < 0.2:
        for _ in range(random.randrange(1, 4)):
            line[random.randrange(len(line))] = random.choice(b'\x00\xff{}[]",:0e-\\')
    if random.random() < 0.05:
        del line[random.randrange(len(line)) :]
    return bytes(line).replace(b"\n", b" ")


class Raw:
    """A connection that sends any bytes."""

    def __init__(self, platform: Platform) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(60)
        self._socket.connect(str(control_socket(platform.directory)))
        self._file = self._socket.makefile("rb")

    def send(self, data: bytes) -> None:
        self._socket.sendall(data)

    def receive(self) -> dict[str, Any] | None:
        """Return the answer, None where the connection was closed."""
        while line := self._file.readline():
            answer: dict[str, Any] = json.loads(line)
            if "method" not in answer:
                return answer
        return None

    def close(self) -> None:
        self._file.close()
        self._socket.close()


def test_every_mutated_line_is_answered_or_ends_its_connection_a_flood_delays_nobody_and_nothing_moves(
    running: Platform,
) -> None:
    random = Random(1)
    before = running.status()
    gateway = running.pids()["gateway"]
    ends: Counter[str] = Counter()
    raw = Raw(running)
    silent = [Raw(running) for _ in range(40)]
    for number in range(LINES):
        line = mutated_line(random)
        if number % A_CONNECTION == A_CONNECTION - 1:
            # Hangs up in the middle of a line.
            raw.send(line[: len(line) // 2])
            raw.close()
            raw = Raw(running)
        for part in (line[: len(line) // 3], line[len(line) // 3 :], b"\n"):
            raw.send(part)
        answer = raw.receive()
        if answer is None:
            ends["closed"] += 1
            raw.close()
            raw = Raw(running)
        else:
            assert "result" in answer or len(answer["error"]["message"]) > 10, answer
            ends["done" if "result" in answer else answer["error"]["data"]["kind"]] += 1
    for client in (raw, *silent):
        client.close()
    assert ends["internal"] == 0, running.logs()
    assert ends["invalid"] > LINES // 3
    assert ends["done"] > 10
    # Requests that nobody waits for, and a flood of them.
    flood = Raw(running)
    flood.send(b'{"jsonrpc":"2.0","id":1,"method":"sdo_read","params":{"slave":2,"index":24641,"subindex":0}}\n' * 200)
    for _ in range(30):
        client = Raw(running)
        client.send(b'{"jsonrpc":"2.0","id":1,"method":"status"}\n' * 20)
        client.close()
    assert running.status()["state"] == "ready"
    assert all("result" in (flood.receive() or {}) for _ in range(200))
    flood.close()
    after = running.status()
    assert after["state"] == before["state"] == "ready"
    assert after["joints"]["actual_position"] == pytest.approx(before["joints"]["actual_position"], abs=1e-3)
    assert running.pids()["gateway"] == gateway
    assert lives(gateway)
    for log in running.directory.glob("*.log"):
        assert "Traceback" not in log.read_text(), log
