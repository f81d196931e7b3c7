"""The processes of a platform: each started and waited for until it says that it is ready, all of them ended.

Each has a session of its own, so that a terminal's Ctrl-C reaches the launcher alone.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from rtcp.config.model import ArmConfig
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import (
    blackboard_file,
    control_socket,
    free_segment_control,
    is_listening,
    limits_file,
    open_log,
    stop_marker,
)
from rtcp.ipc.session import (
    EXIT_INCOMPLETE,
    NO_PROCESS,
    Processes,
    exit_problems,
    identify,
    is_running,
    processes_file,
    read_processes,
    terminate,
)
from rtcp.realtime.scheduling import available_cpus, choose_cpu

_SEGMENT_S = 60.0
_LOOP_S = 60.0
_GATEWAY_S = 60.0
_ANSWER_S = 3.0
"""For the gateway to say how the platform is: one that does not hangs, and meanwhile the arm holds under torque."""
_STOP_S = 20.0
_ENDING_S = 0.5
_LOOP_END_S = 10.0
"""For a controlled stop, the drives' torque and the way to INIT: a loop that is killed leaves them to a watchdog."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
Report = Callable[[str], None]
Kind = Literal["refused", "fault", "usage", "timeout"]


class StartError(Exception):
    """The platform could not be started: a sentence, and whether that is a refusal, a fault or a wrong usage."""

    def __init__(self, message: str, kind: Kind = "fault") -> None:
        super().__init__(message)
        self.kind = kind


class Platform:
    """A platform that runs; made by `start`.

    Args:
        directory: the runtime directory.
        config: the arm.
        processes: those that run already.
        state: directory of what outlives a restart, handed to the processes; None: as this process' environment has it.
    """

    def __init__(self, directory: Path, config: ArmConfig, processes: Processes, state: Path | None = None) -> None:
        self.directory = directory
        self.processes = processes
        self._config = config
        self._environment = None if state is None else {**os.environ, "RTCP_STATE_DIR": str(state)}
        self.segment_control: Path | None = None
        """Control socket of the segment that was started."""
        self.facts: dict[str, Any] = {}
        """What the loop told of its start: realtime, start_to_op_s."""
        self._children: list[subprocess.Popen[bytes]] = []

    # -- starting -----------------------------------------------------------------------------------------------

    def _spawn(self, name: str, module: str, *arguments: str) -> tuple[subprocess.Popen[bytes], int]:
        reading, writing = os.pipe()
        try:
            with open_log(self.directory / f"{name}.log") as log, undisturbed():
                # A signal between start and registration would leave a process that nobody knows of.
                child = subprocess.Popen(
                    [sys.executable, "-m", module, *arguments, "--ready-fd", str(writing)],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env=self._environment,
                    pass_fds=(writing,),
                    start_new_session=True,
                )
                self._register(name, child)
        except BaseException:
            os.close(reading)
            raise
        finally:
            os.close(writing)
        return child, reading

    def _register(self, name: str, child: subprocess.Popen[bytes]) -> None:
        """Write down whose process it is; where the disk refuses that, it is ended again."""
        before = getattr(self.processes, name)
        self._children.append(child)
        setattr(self.processes, name, identify(child.pid))
        try:
            self.processes.write(self.directory)
        except BaseException:
            setattr(self.processes, name, before)
            child.kill()
            child.wait()
            raise

    def start_segment(self, path: Path, poll: bool) -> dict[str, Any]:
        """Start the segment; return its ready line."""
        more = ["--poll"] if poll else []
        self.segment_control = free_segment_control(self.directory)
        more += ["--control", str(self.segment_control)]
        child, reading = self._spawn("segment", "rtcp.virtual", "--config", str(path), *more)
        self._keep_off(child.pid)
        for line in _lines(reading, _SEGMENT_S):
            if "pid" in line:
                return line
        raise StartError(self._last_words("segment", child))

    def start_loop(self, report: Report) -> None:
        """Start the loop; return when all slaves are in OP."""
        child, reading = self._spawn("loop", "rtcp.control.process", "--directory", str(self.directory))
        for line in _lines(reading, _LOOP_S):
            if line["event"] == "phase":
                report(line["text"])
            elif line["event"] == "error":
                raise StartError("\n".join(line["sentences"]), "fault")
            elif line["event"] == "ready":
                self.facts = line
                report("all slaves in OP")
                return
        raise StartError(self._last_words("loop", child))

    def begin_gateway(self) -> int:
        """Start the gateway and return the pipe on which it says when the control socket listens."""
        child, reading = self._spawn("gateway", "rtcp.gateway.server", "--directory", str(self.directory))
        self._keep_off(child.pid)
        return reading

    def start_gateway(self) -> None:
        """Start the gateway; return when the control socket listens."""
        self.await_gateway(self.begin_gateway())

    def await_gateway(self, reading: int) -> None:
        """Return when the gateway that was begun last says on its pipe that the control socket listens."""
        child = self._children[-1]
        for _ in _lines(reading, _GATEWAY_S):
            return
        raise StartError(self._last_words("gateway", child))

    def exit_code(self, pid: int) -> int | None:
        """Return how a child of this process has ended; None where it has not, or is no child."""
        return next((child.poll() for child in self._children if child.pid == pid), None)

    def _keep_off(self, pid: int) -> None:
        """Keep a process off the cycle's CPU where there is another."""
        others = set(available_cpus()) - {choose_cpu(self._config.cycle.cpu)}
        if others:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(pid, others)

    def _last_words(self, name: str, child: subprocess.Popen[bytes]) -> str:
        path = self.directory / f"{name}.log"  # absent where the journal has it
        log = path.read_text(errors="replace").strip().splitlines() if path.exists() else []
        try:
            # Its pipe closes a moment before it can be waited for.
            fate = f"ended with code {child.wait(_ENDING_S)}"
        except subprocess.TimeoutExpired:
            fate = "did not become ready in time"
        said = f": {log[-1]}" if log else ""
        return f"the {name} (process {child.pid}) {fate}{said}"

    # -- running and stopping -----------------------------------------------------------------------------------

    def ended_in_order(self) -> bool:
        """Return whether an `rtcp stop` ended the loop; then a new platform may own the directory already."""
        loop = next((child for child in self._children if child.pid == self.processes.loop), None)
        if loop is not None and loop.wait() not in (0, EXIT_INCOMPLETE):
            return False
        return stop_marker(self.directory).exists() or not processes_file(self.directory).exists()

    def reap(self, timeout_s: float) -> None:
        """Wait for the processes that this one has started."""
        for child in self._children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(timeout=timeout_s)

    def stop(self, report: Report | None = None) -> tuple[str, ...]:
        """Stop everything: controlled stop, drives disabled, slaves in INIT, processes ended. May be called twice.

        Return, and tell `report`, in sentences what of that could not be done.
        """
        left = end_platform(self.directory, self.processes, report)
        self.reap(2.0)
        if report is not None:
            for sentence in left:
                report(f"stopped, but: {sentence}")
        return left


def end_platform(directory: Path, found: Processes, report: Report | None = None) -> tuple[str, ...]:
    """Stop a platform, by its gateway where that answers; return in sentences what is not left as it should be.

    `report` is told why the gateway did not do it.
    """
    lived, answers = is_running(found.loop), is_running(found.gateway)
    error = ask_gateway(directory)
    if error is not None and answers and report is not None:
        report(f"the gateway did not stop the platform: {error}; its processes are ended one by one")
    clear(directory, found)
    return exit_problems(directory, found.loop, lived)


def clear(directory: Path, found: Processes) -> None:
    """End what is left of a platform and remove its files."""
    now = read_processes(directory)
    # A gateway that has been replaced since.
    newer = now.gateway if now.loop == found.loop else NO_PROCESS
    terminate(found.loop, _LOOP_END_S)
    for pid in (found.gateway, newer, found.segment):
        terminate(pid, 5.0)
    processes_file(directory).unlink(missing_ok=True)
    sockets = [path for path in directory.glob("segment*.sock") if not is_listening(path)]
    # Narrowed limits are told apart by their loop's process, whose number may come again.
    for path in (control_socket(directory), blackboard_file(directory), limits_file(directory), *sockets):
        path.unlink(missing_ok=True)


def ask_gateway(directory: Path) -> Exception | None:
    """Let the gateway end the platform; return why it did not: the processes are then ended one by one."""
    try:
        with ControlClient("rtcp stop", control_socket(directory)) as client:
            try:
                client.call("status", timeout_s=_ANSWER_S)
            except RtcpError as error:
                if error.kind == "timeout":
                    return TimeoutError(f"it has not answered for {_ANSWER_S:g} s")
            client.call("stop", timeout_s=_STOP_S)
    except (RtcpError, OSError) as error:
        return error
    return None


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Put off Ctrl-C and its kin until the block is done: what was started is known, or ended, by then."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.signal(number, lambda got, frame: came.append(got)) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


def _lines(reading: int, patience_s: float) -> Iterator[dict[str, Any]]:
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
