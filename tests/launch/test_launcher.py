"""The launcher beside other launchers: remains of an unclean end, waiting, and the start of a new gateway."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.ipc import session
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import LockHeld, blackboard_file, control_socket, exclusive, stop_marker
from rtcp.ipc.schema import arm_schema
from rtcp.launch import launcher, platform
from rtcp.launch.platform import Platform
from rtcp.virtual.irc5.config import load_irc5
from rtcp.virtual.irc5.controller import Controller
from tests.records import numbers
from tests.waiting import until

JOINTS = 6


@pytest.fixture(scope="module")
def config() -> ArmConfig:
    return load(default_config())


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "state"))
    return tmp_path


@pytest.fixture
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    """A process in place of one of a platform."""
    process = subprocess.Popen(["sleep", "600"])
    yield process
    process.kill()
    process.wait()


def session_of(config: ArmConfig) -> session.Session:
    return session.Session(config, "virtual", "ecat0", 0, 77)


@pytest.fixture
def dead_loop(directory: Path, sleeper: subprocess.Popen[bytes]) -> Iterator[None]:
    """A platform whose loop (this process has its number) has ended uncleanly, and whose segment lives."""
    board = Blackboard(blackboard_file(directory), arm_schema(JOINTS), 500_000)
    board.publish(numbers(board.schema))
    session.Processes(loop=session.Pid(os.getpid(), 1), segment=session.identify(sleeper.pid)).write(directory)
    yield
    board.close()
    blackboard_file(directory).unlink(missing_ok=True)


@pytest.mark.parametrize("wrong", ["session", "black box"])
def test_the_files_of_an_unclean_end_are_removed_even_if_they_are_damaged(
    directory: Path, dead_loop: None, sleeper: subprocess.Popen[bytes], config: ArmConfig,
    monkeypatch: pytest.MonkeyPatch, wrong: str,
) -> None:  # fmt: skip
    if wrong == "session":
        session.session_file(directory).write_text('{"version": "0.0.1"}')
    else:
        session_of(config).write(directory)
        monkeypatch.setattr(launcher, "BlackBox", lambda *arguments: arguments.nothing)
    sockets = [directory / "segment.sock", directory / "segment-7.sock"]
    for path in sockets:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stale_socket:
            stale_socket.bind(str(path))
    reports: list[str] = []
    left_over = launcher.stop(reports.append)
    sentence = "had ended before, and not in order: its drives were left to their watchdog"
    assert left_over == (f"the loop (process {os.getpid()}) {sentence}",)
    assert not any(path.exists() for path in sockets)
    assert len(reports) == 1
    assert f"the end of the loop (process {os.getpid()}) was not recorded" in reports[0]
    assert ("another version" if wrong == "session" else "AttributeError") in reports[0]
    assert sleeper.wait(timeout=60) == -signal.SIGTERM
    assert not blackboard_file(directory).exists()
    assert session.read_processes(directory) == session.Processes()


def test_a_stop_waits_for_the_lock(directory: Path, sleeper: subprocess.Popen[bytes]) -> None:
    session.Processes(segment=session.identify(sleeper.pid)).write(directory)
    reports: list[str] = []
    stopper = threading.Thread(target=launcher.stop, args=(reports.append,))
    with exclusive(directory):
        stopper.start()
        time.sleep(0.3)
        assert sleeper.poll() is None
        assert reports == ["another process starts or stops the platform: waiting for it, at most 30 s"]
    stopper.join()
    assert sleeper.wait(timeout=60) == -signal.SIGTERM


def test_a_stop_does_not_wait_long_for_a_gateway_that_hangs(
    directory: Path, sleeper: subprocess.Popen[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "_ANSWER_TIMEOUT_S", 0.2)
    gateway = subprocess.Popen(["sleep", "600"])
    session.Processes(loop=session.identify(sleeper.pid), gateway=session.identify(gateway.pid)).write(directory)
    reports: list[tuple[str, int | None]] = []
    began_s = time.monotonic()
    # As of a stopped process: the kernel accepts the connection, and the request is not read.
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(control_socket(directory)))
        listener.listen()
        launcher.stop(lambda text: reports.append((text, sleeper.poll())))
    ended_by = sleeper.wait(), gateway.wait()
    # Far below the 20 s for one that answers.
    assert time.monotonic() - began_s < 10
    why = "the gateway did not stop the platform: it has not answered for 0.2 s; its processes are ended one by one"
    assert reports == [(why, None)]
    assert ended_by == (-signal.SIGTERM, -signal.SIGTERM)


def test_a_stop_that_does_not_get_the_lock_is_refused_and_has_done_nothing(
    directory: Path, sleeper: subprocess.Popen[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launcher, "STOP_TIMEOUT_S", 0.1)
    session.Processes(segment=session.identify(sleeper.pid)).write(directory)
    with exclusive(directory), pytest.raises(RtcpError, match=r"another process starts or stops .* has done nothing"):
        launcher.stop(print)
    assert sleeper.poll() is None


class Replacement:
    """A gateway that is starting for a loop (this process) and blocked before it is ready."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self.ended: list[object] = []
        self._thread = threading.Thread(target=self._replace)
        self._thread.start()
        while not (gateway := session.read_processes(directory).gateway):
            time.sleep(0.002)
        self.gateway = gateway
        os.kill(gateway, signal.SIGSTOP)

    def _replace(self) -> None:
        try:
            self.ended.append(launcher.replace_gateway(self._directory))
        except RtcpError as error:
            self.ended.append(error)

    def until_ended(self) -> object:
        self._thread.join()
        return self.ended[0]


@pytest.fixture
def replacement(directory: Path, config: ArmConfig) -> Iterator[Replacement]:
    session_of(config).write(directory)
    session.Processes(loop=session.identify(os.getpid())).write(directory)
    started = Replacement(directory)
    yield started
    if session.is_running(started.gateway):
        os.kill(started.gateway, signal.SIGKILL)
    started.until_ended()


def test_the_lock_is_free_while_a_new_gateway_is_waited_for(directory: Path, replacement: Replacement) -> None:
    def is_free() -> bool:
        try:
            with exclusive(directory):
                return True
        except LockHeld:
            return False

    until(is_free, "the free lock")
    assert replacement.ended == []
    # While a gateway is starting no other launcher starts one.
    assert launcher.replace_gateway(directory) == 0
    os.kill(replacement.gateway, signal.SIGKILL)
    assert f"the gateway (process {replacement.gateway}) ended with code -9" in str(replacement.until_ended())


def test_a_gateway_that_a_stop_ends_while_it_starts_is_no_error(directory: Path, replacement: Replacement) -> None:
    stop_marker(directory).touch()
    os.kill(replacement.gateway, signal.SIGKILL)
    assert replacement.until_ended() == 0


def test_a_new_gateway_gets_the_state_directory_of_the_start(directory: Path, config: ArmConfig) -> None:
    running = Platform(directory, config, session.Processes(), directory / "of the start")
    os.close(running.begin_gateway())
    (child,) = running._children
    try:
        while not (environment := Path(f"/proc/{child.pid}/environ").read_bytes()):
            time.sleep(0.01)  # the kernel shows it a moment after the program has started
    finally:
        child.kill()
        child.wait()
    assert f"RTCP_STATE_DIR={directory}/of the start".encode() in environment.split(b"\0")


@pytest.mark.parametrize("part", ["loop", "gateway"])
def test_a_platform_that_only_got_a_gateway_has_not_started_its_loop(
    directory: Path, config: ArmConfig, part: str
) -> None:
    running = Platform(directory, config, session.Processes(loop=session.identify(os.getpid())))
    if part == "loop":
        os.close(running.load_loop()[1])
    else:
        os.close(running.load_gateway())
    (child,) = running._children
    child.kill()
    child.communicate()
    assert running.started_loop is (part == "loop")


def test_a_gateway_whose_pipe_closes_before_it_exits_is_reported_with_its_exit_code(
    directory: Path, config: ArmConfig
) -> None:
    running = Platform(directory, config, session.Processes())
    running._children.append(subprocess.Popen(["sh", "-c", "sleep 0.2; exit 7"]))
    reading, writing = os.pipe()
    os.close(writing)
    with pytest.raises(RtcpError, match="ended with code 7"):
        running.await_gateway(reading)


@pytest.mark.parametrize("module", ["rtcp.control.process", "rtcp.gateway.server"])
def test_a_process_that_waits_for_its_turn_ends_with_its_launcher(module: str, directory: Path) -> None:
    child, reading = platform.spawn(
        module, "--directory", str(directory), "--wait",
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    # As the end of the launcher would, it closes the pipe; without a turn the session, which is missing, is not read.
    said, _ = child.communicate()
    assert (child.returncode, said) == (1, b"")
    assert not list(platform.read_lines(reading, 60.0))


def test_a_start_keeps_the_logs_of_the_run_before(directory: Path, config: ArmConfig) -> None:
    (directory / "loop.log").write_text("what went wrong")
    (directory / "gateway.log").write_text("who asked")
    (directory / "gateway.log.1").write_text("long ago")
    broken = replace(config, bus=replace(config.bus, interface="nosuch0"))
    with pytest.raises(RtcpError):
        launcher._start_all(directory, broken, launcher.StartOptions(), 0, lambda text: None)
    assert (directory / "loop.log.1").read_text() == "what went wrong"
    assert (directory / "gateway.log.1").read_text() == "who asked"


@pytest.mark.parametrize(
    ("file", "interface", "controller"),
    [("abb_irb120.yaml", "0.0.0.0", "10.0.0.2"), ("abb_irb120_rapid.yaml", "10.0.0.2", None)],
)
def test_the_start_puts_the_address_of_the_controller_into_the_configuration(
    file: str, interface: str, controller: str | None
) -> None:
    """EGM: the controller sends to this host. RAPID: this host opens the connections."""
    options = launcher.StartOptions(config=default_config().with_name(file), controller="10.0.0.2")
    bus = launcher._configure(options).bus
    assert (bus.interface, getattr(bus, "controller", None)) == (interface, controller)


@pytest.mark.parametrize(
    ("file", "address", "reason"),
    [
        ("assistive_arm.yaml", "10.0.0.2", "bus.kind is ethercat, without a robot controller: use --bus"),
        ("abb_irb120.yaml", "irc5", "allowed is an IPv4 address"),
    ],
)
def test_an_address_that_no_controller_has_is_refused(file: str, address: str, reason: str) -> None:
    options = launcher.StartOptions(config=default_config().with_name(file), controller=address)
    with pytest.raises(RtcpError, match=f"--controller {address}: {reason}"):
        launcher._configure(options)


@pytest.mark.parametrize(
    ("bus", "segment", "arms", "reason"),
    [
        ("abb_irb120.yaml", "irc5_rapid.yaml", 1, "has `rapid`: bus.kind egm needs a file that has no `rapid`"),
        ("abb_irb120_rapid.yaml", "irc5.yaml", 1, "has no `rapid`: bus.kind rapid needs a file that has `rapid`"),
        ("abb_irb120.yaml", "irc5.yaml", 2, "has 1 units, the controller has 2 arms"),
        ("abb_irb120.yaml", "irc5_egm_two_arms.yaml", 2, ""),
        ("abb_irb120_rapid.yaml", "irc5_two_arms.yaml", 2, ""),
    ],
)
def test_a_virtual_controller_that_the_arms_would_never_hear_is_refused(
    bus: str, segment: str, arms: int, reason: str
) -> None:
    config = load(default_config().with_name(bus))
    config = replace(config, bus=replace(config.bus, segment=segment))
    controller = Controller(load_irc5(default_config().with_name(segment)))
    facts = {"pid": 1, "units": list(controller.units)} | (controller.streaming.ports if controller.streaming else {})
    with pytest.raises(RtcpError, match=reason) if reason else contextlib.nullcontext():
        launcher._check_controller(config, facts, arms)
