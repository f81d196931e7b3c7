"""The controller as a process: sockets, operator, and EGM clients that others wrote."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from tests.virtual.irc5.wire import Robot, sensor
from tests.virtual.test_segment_process import NOBODY, needs_nobody
from tests.waiting import until

ROOT = Path(__file__).parents[3]
PEERS = Path(os.environ.get("RTCP_EGM_PEERS", ROOT / ".venv-egm-peers")) / "bin" / "python"
"""Python of an environment with abb-robot-client 0.4.0 and ABBRobotEGM 1.0.7; one process cannot import both."""


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def unit(name: str, port: int, *more: str) -> str:
    keys = [f"name: {name}", f"port: {port}", *more]
    return (
        "  - {"
        + ", ".join(keys)
        + ", egm: {max_speed_deviation: 250, position_gain: 20, cond_time_s: 600, comm_timeout_s: 2}}\n"
    )


@contextmanager
def irc5(folder: Path, *units: str) -> Iterator[socket.socket]:
    """A running controller; its operator's socket."""
    with started(folder, *units) as (operator, _):
        yield operator


@contextmanager
def started(
    folder: Path, *units: str, options: tuple[str, ...] = (), user: int | None = None
) -> Iterator[tuple[socket.socket, dict[str, Any]]]:
    """A running controller: its operator's socket and its line when ready."""
    config, control = folder / "irc5.yaml", folder / "irc5.sock"
    config.write_text("units:\n" + "".join(units), encoding="utf-8")
    command = [sys.executable, "-m", "rtcp.virtual.irc5", "--config", str(config), "--control", str(control)]
    process = subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, user=user,
        group=user, extra_groups=None if user is None else [],
    )  # fmt: skip
    try:
        line = process.stdout.readline()
        assert line, process.communicate()[1]
        ready = json.loads(line)
        assert ready["pid"] == process.pid
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as operator:
            operator.settimeout(10.0)
            operator.connect(str(control))
            yield operator, ready
        process.send_signal(signal.SIGTERM)
        assert process.communicate()[1] == ""
        assert process.returncode == 0
        assert not control.exists()
    finally:
        process.kill()
        process.communicate()


def ask(operator: socket.socket, **request: Any) -> Any:
    operator.send(json.dumps(request).encode())
    answer = json.loads(operator.recv(1 << 16))
    assert answer["ok"], answer
    return answer["result"]


@contextmanager
def listening() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pc:
        pc.bind(("127.0.0.1", 0))
        pc.settimeout(10.0)
        yield pc


def drain(pc: socket.socket) -> tuple[bytes, Any]:
    """Return the newest message and its sender."""
    newest = pc.recvfrom(2048)
    pc.setblocking(False)
    try:
        while True:
            newest = pc.recvfrom(2048)
    except BlockingIOError:
        pc.settimeout(10.0)
        return newest


def lead(pc: socket.socket, joint: float) -> Robot:
    """Answer messages until joint 1 reaches `joint`, degrees."""
    for seqno in range(3000):
        message, sender = drain(pc)
        robot = Robot(message)
        if abs(robot.actual[0] - joint) < 0.1:
            return robot
        pc.sendto(sensor(seqno, (joint, *robot.actual[1:])), sender)
    raise AssertionError(f"joint 1 stands at {robot.actual[0]}")


@pytest.mark.timing
def test_four_units_speak_each_to_its_port_with_a_period_of_its_own(tmp_path: Path) -> None:
    with ExitStack() as stack:
        pcs = [stack.enter_context(listening()) for _ in range(4)]
        units = [unit(f"ROB_{i + 1}", pc.getsockname()[1], f"period_s: {0.008 * (i + 1)}") for i, pc in enumerate(pcs)]
        stack.enter_context(irc5(tmp_path, *units))
        assert [Robot(pc.recv(2048)).seqno for pc in pcs] == [0] * 4
        time.sleep(1.0)
        counts = [Robot(drain(pc)[0]).seqno for pc in pcs]
        for i in range(1, 4):
            assert counts[0] / counts[i] == pytest.approx(i + 1, rel=0.15)


def test_units_move_each_by_their_own_references(tmp_path: Path) -> None:
    with listening() as first, listening() as second:
        units = unit("ROB_1", first.getsockname()[1]), unit("ROB_2", second.getsockname()[1])
        with irc5(tmp_path, *units) as operator:
            lead(first, 5.0)
            positions = {n: s["position_deg"][0] for n, s in ask(operator, do="status")["units"].items()}
    assert positions["ROB_1"] == pytest.approx(5.0, abs=0.2)
    assert positions["ROB_2"] == 0.0


def test_the_operator_stops_and_an_unknown_request_is_answered_with_a_sentence(tmp_path: Path) -> None:
    with listening() as pc, irc5(tmp_path, unit("ROB_1", pc.getsockname()[1])) as operator:
        ask(operator, do="stop", circuit="emergency")
        assert ask(operator, do="status")["motors"] == "off"
        operator.send(b"[]")
        assert json.loads(operator.recv(4096))["error"] == "found an empty list, allowed is an object with the key do"


def test_datagrams_from_elsewhere_are_counted_and_dropped(tmp_path: Path) -> None:
    with listening() as pc, listening() as stranger, irc5(tmp_path, unit("ROB_1", pc.getsockname()[1])) as operator:
        _, robot = pc.recvfrom(2048)
        stranger.sendto(sensor(1, (50.0, 0, 0, 0, 30, 0)), robot)
        for datagram in (b"", b"hello", b"\xff" * 1500):
            pc.sendto(datagram, robot)

        def counts() -> list[int]:
            counted = ask(operator, do="status")["units"]["ROB_1"]["counts"]
            return [counted.get(kind, 0) for kind in ("foreign_sender", "garbled", "foreign")]

        until(lambda: counts() == [1, 2, 1], "all are counted")
        assert ask(operator, do="status")["units"]["ROB_1"]["position_deg"][0] == 0.0


def test_a_mistake_in_the_file_is_a_sentence_without_a_traceback(tmp_path: Path) -> None:
    config = tmp_path / "irc5.yaml"
    config.write_text("units:\n  - {name: A, port: 6511, dead_time_s: 0.5}\n", encoding="utf-8")
    command = [sys.executable, "-m", "rtcp.virtual.irc5", "--config", str(config)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2
    assert done.stderr == f"{config}:2: units[0].dead_time_s: found 0.5, allowed is a number from 0.01 to 0.02\n"


@pytest.mark.parametrize("user", [None, pytest.param(NOBODY, marks=needs_nobody)], ids=["caller", "nobody"])
def test_a_private_controller_is_reached_by_joining_its_namespaces_and_not_from_the_host(
    user: int | None, tmp_path: Path
) -> None:
    if user is not None:
        if os.getuid() != 0:
            pytest.skip("only root may start a process as another user")
        for folder in (tmp_path, *tmp_path.parents[:2]):
            folder.chmod(folder.stat().st_mode | 0o055)
        os.chown(tmp_path, user, user)
    with listening() as host:
        port = host.getsockname()[1]
        with started(tmp_path, unit("ROB_1", port), options=("--private",), user=user) as (_, ready):
            assert (ready["interface"], ready["units"]) == ("lo", ["ROB_1"])
            child = [sys.executable, str(Path(__file__).with_name("pc_child.py")), str(ready["pid"]), str(port), "5"]
            done = subprocess.run(
                child, capture_output=True, text=True, cwd=ROOT, check=False, user=user, group=user,
                extra_groups=None if user is None else [],
            )  # fmt: skip
            assert done.stderr == ""
            assert float(done.stdout) == pytest.approx(5.0, abs=0.1)
        host.setblocking(False)
        with pytest.raises(BlockingIOError):
            host.recv(1)


@pytest.mark.skipif(not PEERS.exists(), reason="no environment with abb-robot-client and ABBRobotEGM (RTCP_EGM_PEERS)")
@pytest.mark.parametrize("robotware", [6, 7])
@pytest.mark.parametrize("client", ["foreign_abb_robot_client.py", "foreign_abbrobotegm.py"])
def test_a_client_that_others_wrote_connects_and_moves_a_joint(client: str, robotware: int, tmp_path: Path) -> None:
    port = free_port()
    command = [str(PEERS), str(Path(__file__).with_name(client)), str(port), "10"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    peer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert peer.stdout.readline() == "ready\n"
        with irc5(tmp_path, unit("ROB_1", port, f"robotware: {robotware}")) as operator:
            report = json.loads(peer.communicate(timeout=40.0)[0])
            state = ask(operator, do="status")["units"]["ROB_1"]
    finally:
        peer.kill()
        peer.communicate()
    assert report["joint"] == pytest.approx(10.0, abs=0.1)
    assert (report["motors_on"], report["rapid_running"]) == (True, True)
    assert report["pose"][2] == pytest.approx(594.0)
    assert report["answered"] > 10
    assert state["counts"]["used"] > 10
    assert not {"garbled", "foreign"} & set(state["counts"])
