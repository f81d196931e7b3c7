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
from typing import TYPE_CHECKING

from rtcp.ipc.journal import place_of_log
from rtcp.ipc.lock import Busy, alone
from rtcp.ipc.paths import stopping_mark
from rtcp.ipc.session import is_ours, read_processes

if TYPE_CHECKING:
    from rtcp.launch.running import Running

STARTS, WINDOW_S = 5, 60.0
"""At most so many starts in so many seconds: a gateway that cannot live is not started for ever."""


class GatewayKeeper:
    """Looks after the gateway of a platform in the foreground.

    Args:
        running: the platform.
        report: is told in a sentence what happened.
    """

    def __init__(self, running: Running, report: Callable[[str], None]) -> None:
        self._running = running
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
        if is_ours(self._running.processes.gateway):
            return
        while self._starts and now - self._starts[0] > WINDOW_S:
            self._starts.popleft()
        if len(self._starts) >= STARTS:
            if not self._gave_up:
                self._gave_up = True
                where = place_of_log(self._running.directory / "gateway.log")
                again = f"it is left alone for a while; {where} says why"
                self._tell(f"{self._fate()}, {STARTS} times within {WINDOW_S:g} s: {again}")
            return
        try:
            with alone(self._running.directory):
                self._start(now)
        except Busy:
            pass  # whoever has the lock is stopping the platform, or giving it a gateway

    def close(self) -> None:
        """Let go of the pipe."""
        if self._ready is not None:
            os.close(self._ready)
            self._ready = None

    def _start(self, now: float) -> None:
        running = self._running
        found = read_processes(running.directory)
        if found.loop != running.processes.loop or stopping_mark(running.directory).exists():
            return
        if is_ours(found.gateway):
            running.processes = found  # a command was quicker
            return
        self._starts.append(now)
        self._gave_up = False
        fate = self._fate()
        self.close()
        self._ready = running.begin_gateway()
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
            self._tell(f"the gateway (process {self._running.processes.gateway}) answers again")
        self.close()

    def _fate(self) -> str:
        gateway = self._running.processes.gateway
        code = self._running.exit_code(gateway)
        how = "" if code is None else f" by {_name(-code)}" if code < 0 else f" with code {code}"
        return f"the gateway (process {gateway}) has ended{how}"


def _name(number: int) -> str:
    """Return a signal's name; those of real time have none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
