"""A platform that speaks the control protocol over a real socket, and the command line as its client."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli.__main__ import main
from rtcp.config import default_config
from tests.waiting import until

JOINTS = 6

SLAVE = {
    "position": 1,
    "station": 0x1001,
    "name": "DIEWU 16DI16DO",
    "vendor_id": 0xD1E,
    "product_code": 0x161602,
    "revision": 0x10000,
    "serial": 7,
    "alias": 0,
    "state": "PRE-OP",
    "al_status_code": 0,
    "al_status": "no error",
    "has_coe": True,
    "mailbox": {
        "receive_start": 0x1000,
        "receive_size": 128,
        "send_start": 0x1080,
        "send_size": 128,
        "protocols": ["CoE"],
    },
    "outputs": [{"index": 0x1600, "entries": [{"index": 0x7000, "sub_index": 1, "bits": 16, "name": "outputs"}]}],
    "inputs": [
        {
            "index": 0x1A00,
            "entries": [
                {"index": 0x6000, "sub_index": 1, "bits": 16, "name": "inputs"},
                {"index": 0, "sub_index": 0, "bits": 4, "name": ""},
                {"index": 0x6001, "sub_index": 1, "bits": 32, "name": "counter"},
            ],
        }
    ],
    "output_bits": 16,
    "input_bits": 52,
    "sync_managers": [{"number": 0, "start": 0x1000, "length": 128, "control": 0x26, "enabled": True}],
    "fmmus": 3,
    "dc": True,
    "delay_ns": 820,
    "ports": ["open", "no link", "closed", "closed"],
    "parent": 0,
    "parent_port": 0,
    "port_errors": {"rx": [0, 3, 0, 0], "forwarded": [0, 0, 0, 0], "links": [0, 1, 0, 0]},
    "watchdog_off": [],
}


def status() -> dict[str, Any]:
    times = {"p50": 24.04, "p99": 61.0, "max": 105.5}
    position = [0.1, -0.2, 0.3, -0.4, 0.5, -1.23456]
    return {
        "state": "holding",
        "message": "enabled: the arm holds",
        "limited_by": {},
        "control_mode": "joint",
        "speed_override": 1.0,
        "tool_name": "tool",
        "payload": {"mass": 0.0, "centre": [0.0, 0.0, 0.0]},
        "drive_mode": "csp",
        "joystick": {"mode": "X-Y", "controls_arm": True},
        "robot": {"mode": "auto", "e_stopped": False, "drives_powered": True, "motion_possible": True,
                  "in_motion": False, "in_error": False, "error_code": 0},
        "bus": "virtual",
        "bus_kind": "ethercat",
        "lacks": {},
        "drive_states": ["operation enabled"] * 6,
        "cycle_ns": 500_000,
        "cycles": 123_456,
        "time_ns": 61_728_000_000,
        "missed": 2,
        "lost_s": 0.0,
        "wkc": {"expected": 21, "actual": 21},
        "last_second": {"cycles": 2000, "unanswered": 0, "incomplete": 0, "tracked": 2000},
        "slaves": [
            {
                "position": at,
                "name": name,
                "state": "OP",
                "lost": 0,
                "errors": {kind: [0] * 4 for kind in ("rx", "forwarded", "links")},
            }
            for at, name in enumerate(["io", *(f"drive{n}" for n in range(1, JOINTS + 1))], 1)
        ],
        "joint_names": [f"joint{n}" for n in range(1, JOINTS + 1)],
        "joints": {
            "actual_position": position,
            "actual_velocity": [0.0] * JOINTS,
            "actual_torque": [1.0, -2.0, 3.0, 0.5, 0.25, 0.125],
            "commanded_position": position,
            "sent_position": position,
        },
        "axes": {},
        "devices": {"io": {"inputs": {"value": 63, "unit": ""}, "outputs": {"value": 0x8001, "unit": ""}}},
        "processes": {},
        "wakeup_us": times,
        "exchange_us": times,
        "compute_us": times,
        "dc": {"locked": True, "offset_ns": -3200, "filtered_ns": 410, "offset_us": times, "filtered_us": times},
        "realtime": {
            "scheduler": "FIFO 80", "memory_locked": True, "cpu": 1, "compiled": True, "interpreted_because": "",
            "notes": [],
        },
        "start_to_op_s": 1.5,
        "pids": {"loop": 11, "gateway": 12, "segment": 13},
        "tool": {"pose": [0.1, -0.2, 0.9, 0.0, 0.5, -1.0], "velocity": [0.03, 0.04, 0.0, 0.0, 0.0, 0.2],
                 "commanded_pose": [0.1, -0.2, 0.9, 0.0, 0.5, -1.0]},
        "goal": None,
        "lease": {"holder": ""},
        "messages": [],
        "message_times": [],
    }  # fmt: skip


class Platform:
    """Answers requests on `control.sock`; a test sets the answers and reads the requests."""

    def __init__(self, directory: Path) -> None:
        self.status = status()
        self.refusals: dict[str, tuple[str, str]] = {}
        self.answers: dict[str, dict[str, Any] | Callable[[dict[str, Any]], dict[str, Any]]] = {}
        """Result of a method, or a function that returns it for the parameters of a request."""
        self.objects: dict[tuple[int, int, int], bytes] = {}
        self.requests: list[tuple[str, dict[str, Any]]] = []
        self.move_steps = 4
        self.step_s = 0.005
        self.moving = threading.Event()
        self.left_while_moving = threading.Event()
        self.path = directory / "control.sock"
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(self.path))
        self._listener.listen()
        self.connections: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def end(self) -> None:
        """Close the listening socket and all connections, as a process that ends."""
        if self._listener.fileno() < 0:
            return
        self.path.unlink(missing_ok=True)
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self.connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def asked(self, method: str) -> list[dict[str, Any]]:
        return [params for name, params in self.requests if name == method]

    @property
    def methods(self) -> list[str]:
        return [name for name, _ in self.requests]

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self.connections.append(connection)
            threading.Thread(target=self._converse, args=(connection,), daemon=True).start()

    def _converse(self, connection: socket.socket) -> None:
        # A client may reset its connection while it is read or answered.
        with contextlib.suppress(OSError), connection, connection.makefile("rb") as lines:
            for line in lines:
                request = json.loads(line)
                if "id" not in request:
                    continue  # the notification `identify`
                method, params = request["method"], request["params"]
                self.requests.append((method, params))
                _send(connection, {"id": request["id"], **self._answer(request["id"], method, params, connection)})

    def _answer(self, number: int, method: str, params: dict[str, Any], connection: socket.socket) -> dict[str, Any]:
        if method in self.refusals:
            kind, message = self.refusals[method]
            return {"error": {"code": -32000, "message": message, "data": {"kind": kind, "reason": "", "fields": {}}}}
        if method == "status":
            return {"result": self.status}
        if method in self.answers:
            answer = self.answers[method]
            return {"result": answer(params) if callable(answer) else answer}
        if method == "scan":
            return {"result": {"slaves": [SLAVE]}}
        if method == "sdo_read":
            return {"result": {"hex": self.objects[params["slave"], params["index"], params["subindex"]].hex()}}
        if method == "sdo_write":
            self.objects[params["slave"], params["index"], params["subindex"]] = bytes.fromhex(params["hex"])
        if method in ("move_joints", "move_pose", "run"):
            self._move(number, connection)
            return {"result": {"positions": params.get("q", []), "error": 0.00042}}
        if method in ("jog", "joystick"):
            return {"result": {"state": "moving", "positions": []}}
        return {"result": {"disable": {"unconfirmed": []}, "reset": {"from": "fault"}}.get(method, {})}

    def _move(self, number: int, connection: socket.socket) -> None:
        self.moving.set()
        for step in range(self.move_steps):
            connection.settimeout(self.step_s)
            try:
                connection.recv(1, socket.MSG_PEEK)  # the notification `cancel`, or the end of the connection
                self.left_while_moving.set()
                raise ConnectionError
            except TimeoutError:
                pass
            finally:
                connection.settimeout(None)
            params = {"fraction": step / self.move_steps, "remaining_s": (self.move_steps - step) * self.step_s}
            _send(connection, {"method": "progress", "params": {"request": number, **params}})


def _send(connection: socket.socket, message: dict[str, Any]) -> None:
    connection.sendall(json.dumps({"jsonrpc": "2.0", **message}).encode() + b"\n", socket.MSG_NOSIGNAL)


@pytest.fixture(autouse=True)
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A runtime directory of the test's own."""
    place = tmp_path / "run"
    place.mkdir(mode=0o700)
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(place))
    monkeypatch.delenv("RTCP_CONFIG", raising=False)
    for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "TERMINAL_WIDTH"):
        monkeypatch.delenv(name, raising=False)
    return place


@pytest.fixture
def platform(directory: Path) -> Iterator[Platform]:
    running = Platform(directory)
    yield running
    running.end()


class Ended:
    """Exit code and output of a command; `trouble` is standard error without line breaks and boxes."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err
        self.trouble = " ".join(err.replace("│", " ").split())


@pytest.fixture
def rtcp(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """Run a command in this process."""

    def run(*arguments: str) -> Ended:
        capsys.readouterr()
        code = main(arguments)
        captured = capsys.readouterr()
        return Ended(code, captured.out, captured.err)

    return run


@pytest.fixture
def rtcp_process() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a command as a process of its own, for signals, pipes and terminals."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str, **options: Any) -> subprocess.Popen[str]:
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        process = subprocess.Popen([sys.executable, "-m", "rtcp.cli", *arguments], text=True, **{**pipes, **options})
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def wait_until() -> Callable[[Callable[[], bool]], None]:
    """Wait for a condition that another process or thread meets."""

    def wait(holds: Callable[[], bool]) -> None:
        until(holds, "what another process does", 0.01)

    return wait


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """A copy of the default configuration; the processes that use it have its path in their command lines."""
    shutil.copytree(default_config().parent, tmp_path / "config", ignore=shutil.ignore_patterns("*.py"))
    return tmp_path / "config" / "assistive_arm.yaml"


@pytest.fixture
def processes_of() -> Callable[[Path], list[int]]:
    """Find the processes whose command line contains a path; a zombie has none."""

    def find(place: Path) -> list[int]:
        pids = []
        for line in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                if str(place).encode() in line.read_bytes():
                    pids.append(int(line.parent.name))
            except OSError:
                continue  # it has ended meanwhile
        return pids

    return find
