"""Notify systemd of the platform's state and of the progress of its cycle: sd_notify(3), a few words in a datagram."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from pathlib import Path

from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.states import State

PINGS_A_WATCHDOG = 3
"""Checks of the cycle within systemd's watchdog interval; sd_watchdog_enabled(3) advises at least two."""
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
        mine = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_us = os.environ.get("WATCHDOG_USEC", "")
        return cls(blackboard, address, int(watchdog_us) * 1e-6 if mine and watchdog_us.isdecimal() else 0.0)

    def ready(self) -> None:
        """Notify that every slave is in OP and commands are accepted."""
        self._send("READY=1")
        self._due_s = time.monotonic() + self._every_s

    def look(self) -> None:
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
        found = observer.latest()
        if found is None:
            return
        words = State(int(found["state"][0])).words
        if words != self._state:
            self._state = words
            self._send(f"STATUS={words}")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            # A manager that is gone or busy must not disturb the arm; without pings it ends the service itself.
            with contextlib.suppress(OSError):
                self._socket.sendto(text.encode(), self._address)
