"""A platform that speaks the control protocol over a real socket, and the command in front of it."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli.__main__ import main
from rtcp.config import default_config

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
}


def status() -> dict[str, Any]:
    times = {"p50": 24.04, "p99": 61.0, "max": 105.5}
    return {
        "state": "holding",
        "message": "enabled: the arm holds",
        "mode": "csp",
        "bus": "virtual",
        "cycle_ns": 500_000,
        "cycles": 123_456,
        "missed": 2,
        "unheard_s": 0.0,
        "wkc": {"expected": 21, "actual": 21},
        "slaves": [{"position": 1, "name": "io", "state": "OP"}]
        + [{"position": n + 1, "name": f"drive{n}", "state": "OP"} for n in range(1, JOINTS + 1)],
        "joint_names": [f"joint{n}" for n in range(1, JOINTS + 1)],
        "joints": {
            "position": [0.1, -0.2, 0.3, -0.4, 0.5, -1.23456],
            "velocity": [0.0] * JOINTS,
            "torque": [1.0, -2.0, 3.0, 0.5, 0.25, 0.125],
            "target": [0.1, -0.2, 0.3, -0.4, 0.5, -1.23456],
        },
        "inputs": 63,
        "outputs": 0x8001,
        "wakeup_us": times,
        "exchange_us": times,
        "compute_us": times,
        "dc": {"locked": True, "offset_ns": -3200, "filtered_ns": 410},
        "realtime": {"scheduler": "FIFO 80", "memory_locked": True, "cpu": 1, "notes": []},
        "pids": {"loop": 11, "gateway": 12, "segment": 13},
        "lease": {"holder": None},
    }


class Platform:
    """Answers requests on `control.sock`; a test sets what it answers and sees what it was asked."""

    def __init__(self, directory: Path) -> None:
        self.status = status()
        self.refusals: dict[str, tuple[str, str]] = {}
        self.answers: dict[str, dict[str, Any]] = {}
        self.objects: dict[tuple[int, int, int], bytes] = {}
        self.requests: list[dict[str, Any]] = []
        self.move_steps = 4
        self.step_s = 0.005
        self.moving = threading.Event()
        self.left_while_moving = threading.Event()
        self.path = directory / "control.sock"
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(self.path))
        self._listener.listen()
        self._connections: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def end(self) -> None:
        """Go away as a process does: nobody listens, open connections end."""
        if self._listener.fileno() < 0:
            return
        self.path.unlink(missing_ok=True)
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self._connections:
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass

    def asked(self, verb: str) -> list[dict[str, Any]]:
        return [request["args"] for request in self.requests if request["do"] == verb]

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._connections.append(connection)
            threading.Thread(target=self._converse, args=(connection,), daemon=True).start()

    def _converse(self, connection: socket.socket) -> None:
        with connection, connection.makefile("rb") as lines:
            for line in lines:
                request = json.loads(line)
                self.requests.append(request)
                try:
                    answer = self._answer(request, connection)
                    _send(connection, {"id": request["id"], **answer})
                except OSError:
                    return

    def _answer(self, request: dict[str, Any], connection: socket.socket) -> dict[str, Any]:
        verb, args = request["do"], request["args"]
        if verb in self.refusals:
            kind, message = self.refusals[verb]
            return {"ok": False, "error": {"kind": kind, "message": message}}
        result: dict[str, Any] = {}
        if verb == "status":
            result = self.status
        elif verb == "scan":
            result = {"slaves": [SLAVE]}
        elif verb == "sdo_read":
            result = {"hex": self.objects[args["slave"], args["index"], args["subindex"]].hex()}
        elif verb == "sdo_write":
            self.objects[args["slave"], args["index"], args["subindex"]] = bytes.fromhex(args["hex"])
        elif verb in self.answers:
            result = self.answers[verb]
        elif verb in ("move", "move_pose", "run"):
            self._move(request, connection)
            result = {"q": args.get("q"), "error": 0.00042}
        return {"ok": True, "result": result}

    def _move(self, request: dict[str, Any], connection: socket.socket) -> None:
        self.moving.set()
        for step in range(self.move_steps):
            connection.settimeout(self.step_s)
            try:
                if not connection.recv(1, socket.MSG_PEEK):
                    self.left_while_moving.set()
                    raise ConnectionError
            except TimeoutError:
                pass
            finally:
                connection.settimeout(None)
            progress = {"fraction": step / self.move_steps, "remaining_s": (self.move_steps - step) * self.step_s}
            _send(connection, {"id": request["id"], "progress": progress})


def _send(connection: socket.socket, word: dict[str, Any]) -> None:
    connection.sendall(json.dumps(word).encode() + b"\n", socket.MSG_NOSIGNAL)


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
    """What a command left: exit code, what it printed, and the same without line breaks and boxes."""

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
    """Wait for what another process or thread does; fail when it does not."""

    def wait(holds: Callable[[], bool], patience_s: float = 20.0) -> None:
        until = time.monotonic() + patience_s
        while not holds():
            assert time.monotonic() < until, "it did not happen"
            time.sleep(0.01)

    return wait


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """The default configuration at a place of its own, which the processes that use it carry in their command lines."""
    shutil.copytree(default_config().parent, tmp_path / "config", ignore=shutil.ignore_patterns("*.py"))
    return tmp_path / "config" / "assistive_arm.yaml"


@pytest.fixture
def processes_of() -> Callable[[Path], list[int]]:
    """Find the processes whose command line names something at a place; a zombie has none."""

    def find(place: Path) -> list[int]:
        found = []
        for line in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                if str(place).encode() in line.read_bytes():
                    found.append(int(line.parent.name))
            except OSError:
                continue  # it has ended meanwhile
        return found

    return find
