"""Keeps a platform's gateway there: one that has ended is started anew, in turns that never wait.

Nothing moves by that: the lease of what the old one carried has run out, and a new one enables nothing.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import time
from collections import deque
from collections.abc import Callable

from rtcp.ipc.runtime_directory import LockHeld, blackboard_file, exclusive, log_location, stop_marker
from rtcp.ipc.session import EXIT_INCOMPLETE, is_running, read_processes
from rtcp.launch.notifier import Notifier
from rtcp.launch.platform import SIGNALS, Platform

_POLL_S = 0.1
STARTS, WINDOW_S = 5, 60.0
"""At most so many starts in so many seconds: a gateway that cannot live is not started for ever."""


class GatewaySupervisor:
    """Looks after the gateway of a platform in the foreground.

    Args:
        platform: the platform.
        report: is told in a sentence what happened.
    """

    def __init__(self, platform: Platform, report: Callable[[str], None]) -> None:
        self._platform = platform
        self._report = report
        self._starts: deque[float] = deque()
        self._gave_up = False
        self._trouble = ""
        """Why it could not be started, as it was told last."""
        self._ready: int | None = None
        """Pipe on which the gateway that is being started says that it is ready."""

    def look(self) -> None:
        """Start the gateway anew where it has ended; where that is refused it is told, and tried again in a while."""
        now = time.monotonic()
        try:
            self._look(now)
        except (OSError, ValueError) as error:
            # Nothing of it may end the launcher: the loop would be nobody's.
            self._failed(now, error)

    def _look(self, now: float) -> None:
        self._hear()
        if is_running(self._platform.processes.gateway):
            return
        while self._starts and now - self._starts[0] > WINDOW_S:
            self._starts.popleft()
        if len(self._starts) >= STARTS:
            if not self._gave_up:
                self._gave_up = True
                where = log_location(self._platform.directory / "gateway.log")
                again = f"it is left alone for a while; {where} says why"
                self._tell(f"{self._fate()}, {STARTS} times within {WINDOW_S:g} s: {again}")
            return
        try:
            with exclusive(self._platform.directory):
                self._start(now)
        except LockHeld:
            pass  # whoever has the lock is stopping the platform, or giving it a gateway

    def close(self) -> None:
        """Let go of the pipe."""
        if self._ready is not None:
            os.close(self._ready)
            self._ready = None

    def _start(self, now: float) -> None:
        platform = self._platform
        found = read_processes(platform.directory)
        if found.loop != platform.processes.loop or stop_marker(platform.directory).exists():
            return
        if is_running(found.gateway):
            platform.processes = found  # a command was quicker
            return
        self._starts.append(now)
        self._gave_up = False
        fate = self._fate()
        self.close()
        self._ready = platform.begin_gateway()
        self._trouble = ""
        self._tell(f"{fate}: it is started anew")

    def _failed(self, now: float, error: Exception) -> None:
        self.close()
        if not self._starts or self._starts[-1] != now:
            self._starts.append(now)
        if str(error) != self._trouble:
            self._trouble = str(error)
            self._tell(f"the gateway cannot be started anew: {error}")

    def _tell(self, sentence: str) -> None:
        with contextlib.suppress(OSError):  # the terminal may be gone
            self._report(sentence)

    def _hear(self) -> None:
        if self._ready is None or not select.select([self._ready], [], [], 0.0)[0]:
            return
        if os.read(self._ready, 4096):
            self._tell(f"the gateway (process {self._platform.processes.gateway}) answers again")
        self.close()

    def _fate(self) -> str:
        gateway = self._platform.processes.gateway
        code = self._platform.exit_code(gateway)
        how = "" if code is None else f" by {_name(-code)}" if code < 0 else f" with code {code}"
        return f"the gateway (process {gateway}) has ended{how}"


def supervise(platform: Platform, report: Callable[[str], None]) -> int:
    """Wait until the platform is stopped or its loop ends, restart its gateway, notify systemd; return the exit code.

    SIGINT, SIGTERM and SIGHUP stop it (0), and so does `rtcp stop` (0). 5: something is not left as it should be, or
    the loop ended by itself; the rest is then stopped too.
    """
    received: list[int] = []
    before = {number: signal.signal(number, lambda got, frame: received.append(got)) for number in SIGNALS}
    notifier = Notifier.of_environment(blackboard_file(platform.directory))
    gateway = GatewaySupervisor(platform, report)
    try:
        notifier.ready()
        while not received and is_running(platform.processes.loop):
            notifier.look()
            gateway.look()
            time.sleep(_POLL_S)
        notifier.stopping("stopping" if received else "the loop has ended")
        if not received and platform.ended_in_order():
            platform.reap(10.0)
            return 5 if platform.exit_code(platform.processes.loop) == EXIT_INCOMPLETE else 0
        problems = platform.stop(report)
        return 0 if received and not problems else 5
    finally:
        notifier.close()
        gateway.close()
        for number, handler in before.items():
            signal.signal(number, handler)


def _name(number: int) -> str:
    """Return a signal's name; those of real time have none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
