"""The processes of a platform: start each and wait until it is ready, end them all.

Each has a session of its own: a terminal's Ctrl-C reaches the launcher alone.
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
from typing import Any, BinaryIO

from rtcp.config.model import ArmConfig
from rtcp.ipc import session
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import (
    blackboard_file,
    control_socket,
    free_control,
    is_listening,
    limits_file,
    open_log,
    stop_marker,
)
from rtcp.realtime.scheduling import available_cpus, choose_cpu

_READY_TIMEOUT_S = 60.0
"""Longest time until a process is ready, from its start or its last report, s."""
_ANSWER_TIMEOUT_S = 3.0
"""Longest wait for the gateway's answer to `status`, s: one that hangs must not delay the stop of the arm."""
_STOP_TIMEOUT_S = 20.0
_EXIT_TIMEOUT_S = 5.0
_LOOP_END_TIMEOUT_S = 10.0
"""Time for a controlled stop, disabling the drives and INIT, s; a loop that is killed leaves them to a watchdog."""
_END_TIMEOUT_S = 5.0
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that stop the platform."""
Report = Callable[[str], None]


def spawn(
    module: str,
    *arguments: str,
    stdout: int | BinaryIO,
    stderr: int | BinaryIO,
    stdin: int = subprocess.DEVNULL,
    env: dict[str, str] | None = None,
) -> tuple[subprocess.Popen[bytes], int]:
    """Start a module as a process in a session of its own; return also the pipe on which it reports, as JSON lines."""
    reading, writing = os.pipe()
    try:
        child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments, "--ready-fd", str(writing)],
            stdin=stdin,
            stdout=stdout,
            stderr=stderr,
            env=env,
            pass_fds=(writing,),
            start_new_session=True,
        )
    except BaseException:
        os.close(reading)
        raise
    finally:
        os.close(writing)
    return child, reading


def read_lines(reading: int, timeout_s: float) -> Iterator[dict[str, Any]]:
    """Yield the JSON lines of a pipe until it ends or is silent for `timeout_s`; then close it."""
    pending = b""
    with open(reading, "rb", buffering=0) as pipe:
        while select.select([pipe], [], [], timeout_s)[0] and (read := pipe.read(65536)):
            *lines, pending = (pending + read).split(b"\n")
            for line in lines:
                yield json.loads(line)


def _release(child: subprocess.Popen[bytes]) -> None:
    """Let a process that was loaded begin; once is enough."""
    if child.stdin is not None and not child.stdin.closed:
        with contextlib.suppress(BrokenPipeError), child.stdin:  # it has ended
            child.stdin.write(b"\n")


class Platform:
    """The processes of a running platform; `rtcp.launch.launcher.start` makes it.

    Args:
        directory: the runtime directory.
        config: the arm.
        processes: those that run already.
        state: directory of persistent state, for the processes; None: as in this process's environment.
    """

    def __init__(
        self, directory: Path, config: ArmConfig, processes: session.Processes, state: Path | None = None
    ) -> None:
        self.directory = directory
        self.processes = processes
        self._config = config
        # Absolute paths: a child must not look for the platform's name in them again.
        self._environment = None if state is None else {**os.environ, "RTCP_STATE_DIR": str(state), "RTCP_NAME": ""}
        self.segment_control: Path | None = None
        """Control socket of the segment that was started."""
        self.facts: dict[str, Any] = {}
        """Facts that the loop reported of its start: realtime, start_to_op_s."""
        self._children: list[subprocess.Popen[bytes]] = []

    # -- starting -----------------------------------------------------------------------------------------------

    def _spawn(
        self, name: str, module: str, *arguments: str, stdin: int = subprocess.DEVNULL
    ) -> tuple[subprocess.Popen[bytes], int]:
        """Start a process and write down its id; where the disk refuses that, kill it."""
        # A signal between start and registration would leave a process that nobody knows of.
        with open_log(self.directory / f"{name}.log") as log, defer_signals():
            child, reading = spawn(module, *arguments, stdin=stdin, stdout=log, stderr=log, env=self._environment)
            before = getattr(self.processes, name)
            self._children.append(child)
            setattr(self.processes, name, session.identify(child.pid))
            try:
                self.processes.write(self.directory)
            except BaseException:
                setattr(self.processes, name, before)
                os.close(reading)
                child.kill()
                child.communicate()  # closes the pipe to it, too
                raise
        others = set(available_cpus()) - {choose_cpu(self._config.cycle.cpu)}
        if name != "loop" and others:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(child.pid, others)  # off the cycle's CPU
        return child, reading

    def _load(self, name: str, module: str) -> tuple[subprocess.Popen[bytes], int]:
        """Start a process that loads its modules and does nothing before `_release`."""
        return self._spawn(name, module, "--directory", str(self.directory), "--wait", stdin=subprocess.PIPE)

    def start_segment(self, path: Path, poll: bool) -> dict[str, Any]:
        """Start the segment; return its ready line: pid, interface, slaves."""
        self.segment_control = free_control(self.directory / f"{self._config.bus.VIRTUAL_CONTROL}.sock")
        module, *options = self._config.bus.VIRTUAL_PROCESS
        options += ["--poll"] if poll else []
        arguments = ["--config", str(path), *options, "--control", str(self.segment_control)]
        child, reading = self._spawn("segment", module, *arguments)
        for line in read_lines(reading, _READY_TIMEOUT_S):
            if "pid" in line:
                return line
        raise self._not_ready("segment", child)

    def load_loop(self) -> tuple[subprocess.Popen[bytes], int]:
        """Start the loop's process, which loads its modules and waits; return what `start_loop` takes."""
        return self._load("loop", "rtcp.control.process")

    def start_loop(self, loaded: tuple[subprocess.Popen[bytes], int], report: Report) -> None:
        """Start the loop; return when all slaves are in OP."""
        child, reading = loaded
        _release(child)
        for line in read_lines(reading, _READY_TIMEOUT_S):
            if line["event"] == "phase":
                report(line["text"])
            elif line["event"] == "error":
                raise RtcpError("fault", "\n".join(line["sentences"]))
            elif line["event"] == "ready":
                self.facts = line
                report(line["text"])
                return
        raise self._not_ready("loop", child)

    def load_gateway(self) -> int:
        """Start the gateway's process, which loads its modules and waits; return what `await_gateway` takes."""
        return self._load("gateway", "rtcp.gateway.server")[1]

    def begin_gateway(self) -> int:
        """Start the gateway; return the pipe on which it reports that the control socket listens."""
        reading = self.load_gateway()
        _release(self._children[-1])
        return reading

    def await_gateway(self, reading: int) -> None:
        """Wait until the gateway that was started last listens at the control socket."""
        child = self._children[-1]
        _release(child)
        for _ in read_lines(reading, _READY_TIMEOUT_S):
            return
        raise self._not_ready("gateway", child)

    @property
    def started_loop(self) -> bool:
        """Whether this process started the loop; False where the loop ran already and only got a new gateway."""
        return any(child.pid == self.processes.loop for child in self._children)

    def exit_code(self, pid: int) -> int | None:
        """Return the exit code of a child of this process; None while it runs, or where it is no child."""
        return next((child.poll() for child in self._children if child.pid == pid), None)

    def _not_ready(self, name: str, child: subprocess.Popen[bytes]) -> RtcpError:
        path = self.directory / f"{name}.log"  # absent where the journal has it
        log = path.read_text(errors="replace").strip().splitlines() if path.exists() else []
        try:
            # Its pipe closes a moment before it can be waited for.
            fate = f"ended with code {child.wait(_EXIT_TIMEOUT_S)}"
        except subprocess.TimeoutExpired:
            fate = "did not become ready in time"
        last = f": {log[-1]}" if log else ""
        return RtcpError("fault", f"the {name} (process {child.pid}) {fate}{last}")

    # -- running and stopping -----------------------------------------------------------------------------------

    def ended_in_order(self) -> bool:
        """Return whether an `rtcp stop` ended the loop; then a new platform may own the directory already."""
        loop = next((child for child in self._children if child.pid == self.processes.loop), None)
        if loop is not None and loop.wait() not in (0, session.EXIT_INCOMPLETE):
            return False
        return stop_marker(self.directory).exists() or not session.processes_file(self.directory).exists()

    def reap(self, timeout_s: float) -> None:
        """Wait for the processes that this one has started."""
        for child in self._children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(timeout=timeout_s)

    def stop(self, report: Report | None = None) -> tuple[str, ...]:
        """Stop everything: controlled stop, drives disabled, slaves in INIT, processes ended; again: no effect.

        Return, and report, the steps that failed, in sentences.
        """
        problems = end_platform(self.directory, self.processes, report)
        self.reap(2.0)
        if report is not None:
            for sentence in problems:
                report(f"stopped, but: {sentence}")
        return problems


def end_platform(directory: Path, processes: session.Processes, report: Report | None = None) -> tuple[str, ...]:
    """Stop a platform, by its gateway where that answers; return the steps that failed, in sentences.

    `report` receives why the gateway did not do it.
    """
    lived, answers = session.is_running(processes.loop), session.is_running(processes.gateway)
    error = _stop_by_gateway(directory)
    if error is not None and answers and report is not None:
        report(f"the gateway did not stop the platform: {error}; its processes are ended one by one")
    clear(directory, processes)
    return session.exit_problems(directory, processes.loop, lived)


def clear(directory: Path, processes: session.Processes) -> None:
    """End the remaining processes of a platform and remove its files."""
    now = session.read_processes(directory)
    # The gateway may have been replaced since.
    newer = now.gateway if now.loop == processes.loop else session.NO_PROCESS
    session.terminate(processes.loop, _LOOP_END_TIMEOUT_S)
    for pid in (processes.gateway, newer, processes.segment):
        session.terminate(pid, _END_TIMEOUT_S)
    session.processes_file(directory).unlink(missing_ok=True)
    controls = (*directory.glob("segment*.sock"), *directory.glob("irc5*.sock"))
    sockets = [path for path in controls if not is_listening(path)]
    recorders = directory.glob("recorder-*.json")
    # Narrowed limits name their loop by its process id, which may be used again.
    for path in (control_socket(directory), blackboard_file(directory), limits_file(directory), *sockets, *recorders):
        path.unlink(missing_ok=True)


def _stop_by_gateway(directory: Path) -> Exception | None:
    """Have the gateway stop the platform; return why it did not."""
    try:
        with ControlClient("rtcp stop", control_socket(directory)) as client:
            try:
                client.call("status", timeout_s=_ANSWER_TIMEOUT_S)
            except RtcpError as error:
                if error.kind == "timeout":
                    return TimeoutError(f"it has not answered for {_ANSWER_TIMEOUT_S:g} s")
            client.call("stop", timeout_s=_STOP_TIMEOUT_S)
    except (RtcpError, OSError) as error:
        return error
    return None


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Deliver `SIGNALS` only after the block, when its process is registered, or has ended."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    before = {number: signal.signal(number, lambda got, frame: received.append(got)) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])
