"""Supervise a running platform: wait for its end, restart its gateway, notify systemd.

A restart of the gateway moves nothing: the lease of the old one has expired, and a new one enables nothing.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import LockHeld, blackboard_file, exclusive, log_location, stop_marker
from rtcp.ipc.session import EXIT_INCOMPLETE, is_running, read_processes
from rtcp.ipc.states import State
from rtcp.launch.platform import SIGNALS, Platform

_POLL_S = 0.1
STARTS, WINDOW_S = 5, 60.0
"""Limit of gateway starts: this many within this time, s."""


class GatewaySupervisor:
    """Restarts the gateway of a platform in the foreground when it has ended; no call waits for it.

    Args:
        platform: the platform.
        report: receives events as sentences.
    """

    def __init__(self, platform: Platform, report: Callable[[str], None]) -> None:
        self._platform = platform
        self._report = report
        self._starts: deque[float] = deque()
        self._gave_up = False
        self._error = ""
        """Why it could not be started, as reported last."""
        self._ready: int | None = None
        """Pipe on which the gateway that is being started reports that it is ready."""

    def poll(self) -> None:
        """Restart the gateway if it has ended; report a failure once, and try again within the limit."""
        now = time.monotonic()
        try:
            self._poll(now)
        except (OSError, ValueError) as error:
            # Must not end the launcher: nobody would supervise the loop.
            self.close()
            if not self._starts or self._starts[-1] != now:
                self._starts.append(now)
            if str(error) != self._error:
                self._error = str(error)
                self._notify(f"the gateway cannot be restarted: {error}")

    def _poll(self, now: float) -> None:
        platform = self._platform
        if self._ready is not None and select.select([self._ready], [], [], 0.0)[0]:
            if os.read(self._ready, 4096):
                self._notify(f"the gateway (process {platform.processes.gateway}) answers again")
            self.close()
        if is_running(platform.processes.gateway):
            return
        while self._starts and now - self._starts[0] > WINDOW_S:
            self._starts.popleft()
        if len(self._starts) < STARTS:
            # Whoever holds the lock is stopping the platform, or starting a gateway.
            with contextlib.suppress(LockHeld), exclusive(platform.directory):
                self._start(now)
        elif not self._gave_up:
            self._gave_up = True
            where = log_location(platform.directory / "gateway.log")
            again = f"it is tried again later; {where} has the reason"
            self._notify(f"{self._fate()}, {STARTS} times within {WINDOW_S:g} s: {again}")

    def close(self) -> None:
        """Close the pipe."""
        if self._ready is not None:
            os.close(self._ready)
            self._ready = None

    def _start(self, now: float) -> None:
        platform = self._platform
        processes = read_processes(platform.directory)
        if processes.loop != platform.processes.loop or stop_marker(platform.directory).exists():
            return
        if is_running(processes.gateway):
            platform.processes = processes  # a command was quicker
            return
        self._starts.append(now)
        self._gave_up = False
        fate = self._fate()
        self.close()
        self._ready = platform.begin_gateway()
        self._error = ""
        self._notify(f"{fate}: it is restarted")

    def _notify(self, sentence: str) -> None:
        with contextlib.suppress(OSError):  # the terminal may be gone
            self._report(sentence)

    def _fate(self) -> str:
        gateway = self._platform.processes.gateway
        code = self._platform.exit_code(gateway)
        how = "" if code is None else f" by {_name(-code)}" if code < 0 else f" with code {code}"
        return f"the gateway (process {gateway}) has ended{how}"


# -- systemd: sd_notify(3), a few words in a datagram -----------------------------------------------------------

PINGS_A_WATCHDOG = 3
"""Pings within systemd's watchdog interval; sd_watchdog_enabled(3) advises at least two."""
_SEND_S = 0.5


class Notifier:
    """Notifies the service manager of the platform of one blackboard; without a manager every call does nothing.

    Args:
        blackboard: the file in which the cycle's progress shows.
        address: $NOTIFY_SOCKET, a path or `@` and an abstract name; empty: no manager.
        watchdog_s: systemd's watchdog interval, s; 0: it expects no pings.
    """

    def __init__(self, blackboard: Path, address: str = "", watchdog_s: float = 0.0) -> None:
        # unix(7): an abstract name begins with a zero byte.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._every_s = watchdog_s / PINGS_A_WATCHDOG
        self._due_s = 0.0
        self._head = 0
        self._state = ""
        self._socket: socket.socket | None = None
        self._observer: Observer | None = None
        if not address:
            return
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.settimeout(_SEND_S)
        with contextlib.suppress(BlackboardError):  # a loop that has ended already: no pings
            self._observer = Observer(blackboard)

    @classmethod
    def of_environment(cls, blackboard: Path) -> Notifier:
        """Return the notifier that the environment of this process asks for, or one that does nothing."""
        address = os.environ.get("NOTIFY_SOCKET", "")
        # sd_watchdog_enabled(3): the pings may be expected of another process.
        is_for_this = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_us = os.environ.get("WATCHDOG_USEC", "")
        return cls(blackboard, address, int(watchdog_us) * 1e-6 if is_for_this and watchdog_us.isdecimal() else 0.0)

    def ready(self) -> None:
        """Notify that every slave is in OP and commands are accepted."""
        self._send("READY=1")
        self._due_s = time.monotonic() + self._every_s

    def poll(self) -> None:
        """Send the state if it has changed, and a ping if one is due and the cycle has published a record since."""
        if self._observer is None:
            return
        self._send_state(self._observer)
        now = time.monotonic()
        if self._every_s and now >= self._due_s:
            self._due_s = now + self._every_s
            head = self._observer.head
            if head != self._head:
                self._head = head
                self._send("WATCHDOG=1")

    def stopping(self, why: str) -> None:
        """Notify that the platform is stopping."""
        self._send(f"STOPPING=1\nSTATUS={why}")

    def close(self) -> None:
        """Close the socket and the blackboard."""
        if self._observer is not None:
            self._observer.close()
            self._observer = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send_state(self, observer: Observer) -> None:
        record = observer.latest()
        if record is None:
            return
        words = State(int(record["state"][0])).words
        if words != self._state:
            self._state = words
            self._send(f"STATUS={words}")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            # A manager that is gone or busy must not disturb the arm; without pings it ends the service itself.
            with contextlib.suppress(OSError):
                self._socket.sendto(text.encode(), self._address)


def supervise(platform: Platform, report: Callable[[str], None]) -> int:
    """Wait until the platform is stopped or its loop ends, restart its gateway, notify systemd; return the exit code.

    0: it was stopped in order, by SIGINT, SIGTERM, SIGHUP or `rtcp stop`. 5: drives, slaves or processes were not
    stopped in order, or the loop ended by itself, and the rest was stopped then.
    """
    received: list[int] = []
    before = {number: signal.signal(number, lambda got, frame: received.append(got)) for number in SIGNALS}
    notifier = Notifier.of_environment(blackboard_file(platform.directory))
    gateway = GatewaySupervisor(platform, report)
    try:
        notifier.ready()
        while not received and is_running(platform.processes.loop):
            notifier.poll()
            gateway.poll()
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
