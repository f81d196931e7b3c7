"""The controller's process: sockets of the units or of RAPID streaming, and the operator's socket."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol

from rtcp.config.model import ConfigError
from rtcp.virtual.irc5.config import UnitConfig, load_irc5
from rtcp.virtual.irc5.controller import Controller, Unit
from rtcp.virtual.irc5.streaming_server import StreamingServer
from rtcp.virtual.network import private_loopback
from rtcp.virtual.request_socket import RequestSocket, control_socket
from rtcp.virtual.server import StopRequest, request_prompt_scheduling

DATAGRAM = 2048
"""Upper bound on a received datagram, bytes; EgmSensor has about 130."""
MOST_A_CYCLE = 64
"""Upper bound on datagrams read per cycle."""
PHASE_S = 0.0011
"""Offset between the first messages of two units: units are not in phase."""
STALL_S = 0.1
"""Delay (the process was stopped) above which a unit continues without catching up."""

Ready = Callable[[Controller, "str | None"], None]


class Cyclic(Protocol):
    """Sockets with their own period."""

    period_s: float

    def cycle(self, clock_s: float) -> None:
        """Read, advance, send."""

    def close(self) -> None:
        """Close the sockets."""


class UnitSocket:
    """A unit's UdpUc device: sends to the PC's port and receives only from there."""

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
        # The kernel takes the sender's address from the route; before the first message no datagram can arrive.
        self.socket.bind(("", 0))

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()

    def cycle(self, clock_s: float) -> None:
        """Read, let the unit step, send."""
        datagrams = self._unit.step(self._received(), clock_s)
        unit = self._unit.mechanical
        unit.accelerometer.sample(unit.actual, time.monotonic())
        for datagram in datagrams:
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


def serve(
    controller: Controller, sockets: Sequence[Cyclic], operators: RequestSocket | None, stop: StopRequest
) -> None:
    """Run in real time until `stop` is requested."""
    last = time.monotonic()
    since_1970 = time.time() - last
    due = [last + PHASE_S * i for i in range(len(sockets))]
    while not stop.requested:
        i = min(range(len(due)), key=due.__getitem__)
        if (wait := due[i] - time.monotonic()) > 0.0:
            time.sleep(wait)
        now = time.monotonic()
        controller.panel.advance(now - last)
        last = now
        # The controller's own clock has exact periods, even if this process is late.
        sockets[i].cycle(due[i] + since_1970)
        due[i] += sockets[i].period_s
        if now - due[i] > STALL_S:
            due[i] = now
        if operators is not None:
            operators.poll()


def run(config_path: Path, ready: Ready, control_path: Path | None = None, private: bool = False) -> None:
    """Run a virtual IRC5 until SIGTERM or SIGINT.

    `ready` is called once, with the units' network interface, or None for the caller's. `control_path` accepts requests
    of an operator and for faults. With `private` a PC reaches the units by joining this process's namespaces
    (/proc/PID/ns/user and /proc/PID/ns/net).

    Raises:
        ConfigError, ValueError, NetworkError: with sentences for the user.
    """
    config = load_irc5(config_path)
    controller = Controller(config)
    stop = StopRequest()
    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    with ExitStack() as resources:
        operators = None
        if control_path is not None:
            operators = RequestSocket(resources.enter_context(control_socket(control_path)), controller.request)
            resources.callback(operators.close)
        interface = private_loopback() if private else None
        sockets: Sequence[Cyclic]
        if controller.streaming is None:
            sockets = [UnitSocket(controller.units[unit.name], unit) for unit in config.units]
        else:
            sockets = [StreamingServer(controller.streaming, config.units[0].period_s)]
        for server in sockets:
            resources.callback(server.close)
        request_prompt_scheduling()
        ready(controller, interface)
        serve(controller, sockets, operators, stop)
