"""The controller's process: sockets for each unit or for RAPID streaming, and the operator's socket."""

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
"""Longest datagram that is read, bytes; EgmSensor has about 130."""
MOST_A_CYCLE = 64
"""Datagrams that are taken from the socket in one cycle."""
PHASE_S = 0.0011
"""From the first message of a unit to that of the next: units are not in step."""
STALL_S = 0.1
"""A unit that is further behind, because the process was stopped, goes on from now without catching up."""

Ready = Callable[[Controller, "str | None"], None]


class Cyclic(Protocol):
    """Sockets with a period of their own."""

    period_s: float

    def cycle(self, clock_s: float) -> None:
        """Read, let time pass, send."""

    def close(self) -> None:
        """Close the sockets."""


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
    """Run in real time until `stop` came."""
    last = time.monotonic()
    since_1970 = time.time() - last
    due = [last + PHASE_S * i for i in range(len(sockets))]
    while not stop.came:
        i = min(range(len(due)), key=due.__getitem__)
        if (wait := due[i] - time.monotonic()) > 0.0:
            time.sleep(wait)
        now = time.monotonic()
        controller.panel.advance(now - last)
        last = now
        # The controller's own clock: exact periods, however late this process is.
        sockets[i].cycle(due[i] + since_1970)
        due[i] += sockets[i].period_s
        if now - due[i] > STALL_S:
            due[i] = now
        if operators is not None:
            operators.look()


def run(config_path: Path, ready: Ready, control_path: Path | None = None, private: bool = False) -> None:
    """Run a virtual IRC5 until SIGTERM or SIGINT.

    `ready` is called once, with the network interface of the units or None for those of the caller. At `control_path`
    an operator works and faults can be asked for. With `private` a PC reaches the units by joining this process's
    namespaces (/proc/PID/ns/user and /proc/PID/ns/net).

    Raises:
        ConfigError, ValueError, NetworkError: with sentences for the user.
    """
    config = load_irc5(config_path)
    controller = Controller(config)
    stop = StopRequest()
    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    with ExitStack() as kept:
        operators = None
        if control_path is not None:
            operators = RequestSocket(kept.enter_context(control_socket(control_path)), controller.request)
            kept.callback(operators.close)
        interface = private_loopback() if private else None
        sockets: Sequence[Cyclic]
        if controller.streaming is None:
            sockets = [UnitSocket(controller.units[unit.name], unit) for unit in config.units]
        else:
            sockets = [StreamingServer(controller.streaming, config.units[0].period_s)]
        for each in sockets:
            kept.callback(each.close)
        request_prompt_scheduling()
        ready(controller, interface)
        serve(controller, sockets, operators, stop)
