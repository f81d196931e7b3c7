"""The controller's process: a UDP socket for each unit, each with its own period, and the operator's socket.

The operator's socket is a Unix socket of packets as the virtual segment's: one JSON object each, answered by
`{"ok": true, "result": ...}` or by `{"ok": false, "error": "a sentence"}`.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rtcp.config.model import ConfigError
from rtcp.virtual.faults.control import control_socket
from rtcp.virtual.irc5.config import UnitConfig, load_irc5
from rtcp.virtual.irc5.controller import Controller, RequestRefused, Unit
from rtcp.virtual.server import StopRequest

DATAGRAM = 2048
"""Longest datagram that is read, bytes; EgmSensor has about 130."""
MOST_A_CYCLE = 64
"""Datagrams that are taken from the socket in one cycle."""
PHASE_S = 0.0011
"""From the first message of a unit to that of the next: units are not in step."""
STALL_S = 0.1
"""A unit that is further behind, because the process was stopped, goes on from now without catching up."""
LONGEST_REQUEST = 1024
MOST_OPERATORS = 8

Ready = Callable[[dict[str, Any]], None]


class UnitSocket:
    """A unit's UdpUc device: speaks to the PC's port, and takes datagrams from there alone."""

    def __init__(self, unit: Unit, config: UnitConfig) -> None:
        """Open the socket.

        Raises:
            ConfigError: the PC's address cannot be resolved.
        """
        self._unit = unit
        self.period_s = config.period_s
        try:
            self._remote = socket.getaddrinfo(config.remote, config.port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]
        except OSError as error:
            sentence = f"remote of {config.name}: {config.remote} has no address ({error.strerror})"
            raise ConfigError([sentence]) from error
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        # The kernel takes the sender's address from the route; a datagram before the first message has nowhere to go.
        self.socket.bind(("", 0))

    def cycle(self, clock_s: float) -> None:
        """Read, let the unit step, send."""
        for datagram in self._unit.step(self._received(), clock_s):
            try:
                self.socket.sendto(datagram, self._remote)
            except OSError:
                self._unit.mechanical.counts["send_error"] += 1  # event 41830

    def _received(self) -> list[bytes]:
        received = []
        for _ in range(MOST_A_CYCLE):
            try:
                datagram, sender = self.socket.recvfrom(DATAGRAM)
            except OSError:
                break
            if sender == self._remote:
                received.append(datagram)
            else:
                self._unit.mechanical.counts["foreign_sender"] += 1
        return received


class OperatorSocket:
    """Answers at most one request of each operator in a look; nothing here waits."""

    def __init__(self, listener: socket.socket, controller: Controller) -> None:
        self._listener = listener
        self._controller = controller
        self._operators: list[socket.socket] = []

    def close(self) -> None:
        """Let all operators go."""
        for operator in self._operators:
            operator.close()

    def look(self) -> None:
        """Take a new operator, and answer requests."""
        try:
            operator, _ = self._listener.accept()
        except OSError:
            pass
        else:
            operator.setblocking(False)
            self._operators.append(operator)
            if len(self._operators) > MOST_OPERATORS:
                self._operators.pop(0).close()
        for operator in tuple(self._operators):
            try:
                packet = operator.recv(LONGEST_REQUEST)
                if packet:
                    operator.send(json.dumps(self._answer(packet)).encode(), socket.MSG_NOSIGNAL)
            except BlockingIOError:
                continue
            except OSError:
                packet = b""
            if not packet:
                self._operators.remove(operator)
                operator.close()

    def _answer(self, packet: bytes) -> dict[str, Any]:
        try:
            request = json.loads(packet)
        except (ValueError, RecursionError):
            request = None
        if not isinstance(request, dict):
            return {"ok": False, "error": "a request is one JSON object in UTF-8, and this is none"}
        try:
            return {"ok": True, "result": self._controller.request(request)}
        except RequestRefused as refusal:
            return {"ok": False, "error": str(refusal)}


def serve(
    controller: Controller, sockets: list[UnitSocket], operators: OperatorSocket | None, stop: StopRequest
) -> None:
    """Run in real time until `stop` came."""
    last = time.monotonic()
    due = [last + PHASE_S * i for i in range(len(sockets))]
    while not stop.came:
        i = min(range(len(due)), key=due.__getitem__)
        if (wait := due[i] - time.monotonic()) > 0.0:
            time.sleep(wait)
        now = time.monotonic()
        controller.panel.advance(now - last)
        last = now
        sockets[i].cycle(time.time())
        due[i] += sockets[i].period_s
        if now - due[i] > STALL_S:
            due[i] = now
        if operators is not None:
            operators.look()


def run(config_path: Path, ready: Ready, control_path: Path | None = None) -> None:
    """Run a virtual IRC5 until SIGTERM or SIGINT.

    `ready` is called once with "pid" and "units", the names. At `control_path` an operator works and faults can be
    asked for.

    Raises:
        ConfigError, ValueError: with sentences for the user.
    """
    config = load_irc5(config_path)
    controller = Controller(config)
    stop = StopRequest()
    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    with ExitStack() as kept:
        operators = None
        if control_path is not None:
            operators = OperatorSocket(kept.enter_context(control_socket(control_path)), controller)
            kept.callback(operators.close)
        sockets = [UnitSocket(controller.units[unit.name], unit) for unit in config.units]
        for each in sockets:
            kept.enter_context(each.socket)
        ready({"pid": os.getpid(), "units": list(controller.units)})
        serve(controller, sockets, operators, stop)
