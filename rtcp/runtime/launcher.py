"""Starting and stopping the platform: segment, loop, gateway, in this order, and back.

Each is a process in a session of its own, so that a terminal's Ctrl-C reaches the launcher alone.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rtcp.config.find import find_config
from rtcp.config.model import ArmConfig, DriveModeName
from rtcp.config.schema import load, segment_path, with_period
from rtcp.realtime.scheduling import available_cpus, choose_cpu
from rtcp.runtime.client import LONGEST_SOCKET_PATH, ControlClient, ControlError
from rtcp.runtime.paths import (
    RuntimeDirectoryError,
    blackboard_file,
    control_socket,
    prepare,
    processes_file,
    runtime_directory,
    stopping_mark,
)
from rtcp.runtime.session import Processes, Session, end, is_ours, read_processes, read_session

VIRTUAL = "virtual"
_SEGMENT_S = 15.0
_LOOP_S = 60.0
_GATEWAY_S = 15.0
_STOP_S = 20.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
Report = Callable[[str], None]
Kind = Literal["refused", "fault", "usage", "timeout"]


@dataclass(frozen=True)
class StartOptions:
    """What `rtcp start` was told; None: as configured."""

    config: Path | None = None
    bus: str | None = None
    mode: str | None = None
    cycle_us: float | None = None
    poll: bool = False


class StartError(Exception):
    """The platform could not be started: a sentence, and whether that is a refusal, a fault or a wrong usage."""

    def __init__(self, message: str, kind: Kind = "fault") -> None:
        super().__init__(message)
        self.kind = kind


@contextlib.contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Hold the directory's lock: two starts at once would each find nothing running."""
    descriptor = os.open(directory / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StartError("another `rtcp start` or `rtcp stop` is under way", "refused") from None
        yield
    finally:
        os.close(descriptor)


def start(options: StartOptions, report: Report) -> Running:
    """Start the platform; return when all slaves are in OP and the control socket listens.

    Args:
        options: what was asked for.
        report: is told each step in a sentence.

    Raises:
        StartError: where it cannot be started; nothing is left running.
        ConfigError: where the configuration has mistakes.
    """
    began_ns = time.monotonic_ns()
    directory = runtime_directory()
    length = len(os.fsencode(control_socket(directory)))
    if length > LONGEST_SOCKET_PATH:
        raise StartError(
            f"the control socket's path {control_socket(directory)} has {length} bytes, at most {LONGEST_SOCKET_PATH} "
            "are allowed: set RTCP_RUNTIME_DIR to a shorter one",
            "usage",
        )
    try:
        prepare(directory)
    except RuntimeDirectoryError as error:
        raise StartError(str(error), "usage") from None
    with _alone(directory):
        stopping_mark(directory).unlink(missing_ok=True)
        if adopted := _adopt(directory, options, report):
            return adopted
        config = _configured(options)
        return _start_all(directory, config, options, began_ns, report)


def _adopt(directory: Path, options: StartOptions, report: Report) -> Running | None:
    """Deal with what an earlier start left: refuse, give a lone loop its gateway back, or clear remnants away."""
    found = read_processes(directory)
    if is_ours(found.loop):
        if is_ours(found.gateway):
            raise StartError(
                f"the platform is running already (loop process {found.loop}): `rtcp status`, `rtcp stop`", "refused"
            )
        if options != StartOptions():
            raise StartError(
                f"the loop (process {found.loop}) is running without a gateway: `rtcp start` without options starts "
                "one; for other options `rtcp stop` first",
                "refused",
            )
        running = Running(directory, read_session(directory / "session.pickle").config, found)
        report(f"the loop (process {found.loop}) is running without a gateway: starting one")
        running.start_gateway()
        return running
    clear(directory, found)
    return None


def clear(directory: Path, found: Processes) -> None:
    """End what is left of a platform and remove its files."""
    for pid in (found.loop, found.gateway, found.segment):
        end(pid, 5.0)
    for path in (control_socket(directory), processes_file(directory), blackboard_file(directory)):
        path.unlink(missing_ok=True)


def _configured(options: StartOptions) -> ArmConfig:
    config = load(find_config(options.config))
    if options.mode is not None:
        modes: dict[str, DriveModeName] = {"csp": "csp", "csv": "csv", "cst": "cst"}
        if options.mode not in modes:
            raise StartError(f"mode {options.mode!r} is unknown: csp, csv or cst", "usage")
        config = dataclasses.replace(config, mode=modes[options.mode])
    if options.bus is not None:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, interface=options.bus))
    if options.cycle_us is not None:
        config = with_period(config, options.cycle_us)
    return config


def _start_all(
    directory: Path, config: ArmConfig, options: StartOptions, began_ns: int, report: Report
) -> Running:  # fmt: skip
    bus = config.bus.interface
    running = Running(directory, config, Processes())
    try:
        interface, segment = bus, 0
        if bus == VIRTUAL:
            facts = running.start_segment(segment_path(config), options.poll)
            interface, segment = str(facts["interface"]), int(facts["pid"])
            report(f"segment of {facts['slaves']} virtual slaves (process {segment})")
        Session(config, bus, interface, segment, began_ns).write(directory / "session.pickle")
        running.start_loop(report)
        running.start_gateway()
    except BaseException:
        with _undisturbed():
            running.stop()
        raise
    return running


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Put off Ctrl-C and its kin until the block is done: what was started is known, or ended, by then."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.signal(number, lambda got, frame: came.append(got)) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


class Running:
    """A platform that runs; made by `start`."""

    def __init__(self, directory: Path, config: ArmConfig, processes: Processes) -> None:
        self.directory = directory
        self.processes = processes
        self._config = config
        self.facts: dict[str, Any] = {}
        """What the loop told of its start: realtime, start_to_op_s."""
        self._children: list[subprocess.Popen[bytes]] = []

    # -- starting -----------------------------------------------------------------------------------------------

    def _spawn(self, name: str, module: str, *arguments: str) -> tuple[subprocess.Popen[bytes], int]:
        reading, writing = os.pipe()
        with open(self.directory / f"{name}.log", "wb") as log, _undisturbed():
            # A signal between start and registration would leave a process that nobody knows of.
            child = subprocess.Popen(
                [sys.executable, "-m", module, *arguments, "--ready-fd", str(writing)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=(writing,),
                start_new_session=True,
            )
            os.close(writing)
            self._children.append(child)
            setattr(self.processes, name, child.pid)
            self.processes.write(self.directory)
        return child, reading

    def start_segment(self, path: Path, poll: bool) -> dict[str, Any]:
        """Start the segment; return its ready line."""
        more = ["--poll"] if poll else []
        child, reading = self._spawn("segment", "rtcp.virtual", "--config", str(path), *more)
        self._keep_off(child.pid)
        for line in _lines(reading, _SEGMENT_S, child):
            if "pid" in line:
                return line
        raise StartError(self._last_words("segment", child))

    def start_loop(self, report: Report) -> None:
        """Start the loop; return when all slaves are in OP."""
        child, reading = self._spawn("loop", "rtcp.runtime.loop_process", "--directory", str(self.directory))
        for line in _lines(reading, _LOOP_S, child):
            if line["event"] == "phase":
                report(line["text"])
            elif line["event"] == "error":
                raise StartError("\n".join(line["sentences"]), "fault")
            elif line["event"] == "ready":
                self.facts = line
                report("all slaves in OP")
                return
        raise StartError(self._last_words("loop", child))

    def start_gateway(self) -> None:
        """Start the gateway; return when the control socket listens."""
        child, reading = self._spawn("gateway", "rtcp.runtime.gateway", "--directory", str(self.directory))
        self._keep_off(child.pid)
        for _ in _lines(reading, _GATEWAY_S, child):
            return
        raise StartError(self._last_words("gateway", child))

    def _keep_off(self, pid: int) -> None:
        """Keep a process off the cycle's CPU where there is another."""
        others = set(available_cpus()) - {choose_cpu(self._config.cycle.cpu)}
        if others:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(pid, others)

    def _last_words(self, name: str, child: subprocess.Popen[bytes]) -> str:
        log = (self.directory / f"{name}.log").read_text(errors="replace").strip().splitlines()
        ended = child.poll()
        fate = "did not become ready in time" if ended is None else f"ended with code {ended}"
        said = f": {log[-1]}" if log else ""
        return f"the {name} (process {child.pid}) {fate}{said}"

    # -- running and stopping -----------------------------------------------------------------------------------

    def wait(self) -> int:
        """Wait until the platform is stopped or its loop ends; return the exit code.

        SIGINT, SIGTERM and SIGHUP stop it in an orderly way (0), and so does `rtcp stop` (0); a loop that ends by
        itself is a fault (5), whereupon the rest is stopped too.
        """
        stopped: list[int] = []
        before = {number: signal.signal(number, lambda got, frame: stopped.append(got)) for number in _SIGNALS}
        try:
            while not stopped and is_ours(self.processes.loop):
                time.sleep(0.1)
            if not stopped and self._ended_orderly():
                self._reap(10.0)
                return 0
            self.stop()
            return 0 if stopped else 5
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _ended_orderly(self) -> bool:
        """Whether another `rtcp stop` ended the loop: the directory, maybe a new platform's by now, is left alone."""
        loop = next((child for child in self._children if child.pid == self.processes.loop), None)
        if loop is not None and loop.wait() != 0:
            return False
        return stopping_mark(self.directory).exists() or not processes_file(self.directory).exists()

    def _reap(self, patience_s: float) -> None:
        for child in self._children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(timeout=patience_s)

    def stop(self) -> None:
        """Stop everything: controlled stop, drives disabled, slaves in INIT, processes ended. May be called twice."""
        _ask_gateway(self.directory)
        clear(self.directory, self.processes)
        self._reap(2.0)


def _ask_gateway(directory: Path) -> None:
    """Let the gateway end the platform; where it does not answer, the processes are ended one by one afterwards."""
    with contextlib.suppress(ControlError, OSError):
        path = control_socket(directory)
        with ControlClient("rtcp stop", path) as client:
            client.call("stop", timeout_s=_STOP_S)


def stop() -> None:
    """Stop the platform of this runtime directory.

    Raises:
        ControlError: `not running` where nothing runs.
        StartError: while another start or stop is under way.
    """
    directory = runtime_directory()
    found = read_processes(directory)
    if not any(is_ours(pid) for pid in (found.loop, found.gateway, found.segment)):
        raise ControlError("not running", f"no platform is running (runtime directory {directory})")
    with _alone(directory):
        _ask_gateway(directory)
        clear(directory, found)


def _lines(reading: int, patience_s: float, child: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    """Yield the JSON lines of a pipe until it ends or nothing comes for `patience_s`."""
    kept = b""
    with open(reading, "rb", buffering=0) as pipe:
        while True:
            if not select.select([pipe], [], [], patience_s)[0]:
                return
            read = pipe.read(65536)
            if not read:
                return
            kept += read
            *whole, kept = kept.split(b"\n")
            for line in whole:
                yield json.loads(line)
