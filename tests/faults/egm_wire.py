"""The datagrams of EGM on the network, decoded independently of the platform's codec.

As a program, `python egm_wire.py PID PORT FILE`: write what reaches and leaves this UDP port in the network namespace
of a process to a file, until SIGTERM.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic_ns

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.e2e.wire import BUFFER, SO_RCVBUFFORCE, enter

ETH_P_IP = 0x0800
HEAD = struct.Struct("<QBH")
"""Header of a datagram in a capture: time, ns, whether the PC sent it, and length."""
IP_HEAD, UDP_HEAD, UDP = 20, 8, 17
_ROUND_OFF = 1e-6
"""Degrees, degrees/s."""


def capture(port: int, path: Path) -> None:
    """Write datagrams to and from `port` of the loopback to a file."""
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, at: ended.append(number))
    with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(ETH_P_IP)) as tap, path.open("wb") as file:
        with contextlib.suppress(PermissionError):  # a user namespace allows only the default size
            tap.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER)
        tap.bind(("lo", ETH_P_IP))
        tap.settimeout(0.05)
        print("ready", flush=True)
        while not ended:
            try:
                packet = tap.recv(4096)
            except TimeoutError:
                continue
            if packet[9] != UDP:
                continue
            source, target = struct.unpack_from(">HH", packet, IP_HEAD)
            if port in (source, target):
                payload = packet[IP_HEAD + UDP_HEAD :]
                file.write(HEAD.pack(monotonic_ns(), source == port, len(payload)) + payload)


def datagrams(path: Path) -> Iterator[tuple[int, bool, bytes]]:
    """Yield time (ns), whether the PC sent it, and payload of each datagram of a capture."""
    data, at = path.read_bytes(), 0
    while at + HEAD.size <= len(data):
        time_ns, from_pc, size = HEAD.unpack_from(data, at)
        at += HEAD.size
        yield time_ns, bool(from_pc), data[at : at + size]
        at += size


@dataclass
class Limits:
    """Of each joint, degrees and degrees/s."""

    low: Sequence[float]
    high: Sequence[float]
    speed: Sequence[float]


@dataclass
class Checked:
    """Results of a capture."""

    messages: int
    replies: int
    largest_speed: float
    """Largest speed reference, as a fraction of its limit."""
    violations: list[str]


def check(path: Path, limits: Limits, period_s: float) -> Checked:
    """Decode every reply of a capture and compare it with the limits.

    A position reference steps by what the speed limit allows for each cycle since the one before, and one cycle more;
    from where the joint stands, as the newest message says, it may begin anew.
    """
    from rtcp.virtual.irc5.messages import EgmCodec
    from tests.virtual.irc5.wire import Robot

    codec = EgmCodec(7)
    checked = Checked(0, 0, 0.0, [])
    last: tuple[float, ...] | None = None
    last_ns = 0
    known: list[list[float]] = []
    for time_ns, from_pc, payload in datagrams(path):
        if not from_pc:
            checked.messages += 1
            known = [*known[-8:], Robot(payload).actual]
            continue
        checked.replies += 1
        reference = codec.decode(payload, len(limits.low))
        position, speed = reference.position, reference.speed
        assert position is not None
        assert speed is not None
        cycles = (time_ns - last_ns) * 1e-9 / period_s + 2.0
        for i, (q, v) in enumerate(zip(position, speed, strict=True)):
            where = f"reply {reference.seqno}, joint {i + 1}"
            if not limits.low[i] - _ROUND_OFF <= q <= limits.high[i] + _ROUND_OFF:
                checked.violations.append(f"{where}: position {q:.4f} degrees")
            checked.largest_speed = max(checked.largest_speed, abs(v) / limits.speed[i])
            if abs(v) > limits.speed[i] + _ROUND_OFF:
                checked.violations.append(f"{where}: speed {v:.4f} degrees/s")
            begins = v == 0.0 and any(abs(q - actual[i]) < _ROUND_OFF for actual in known)
            if last is not None and not begins and abs(q - last[i]) > limits.speed[i] * period_s * cycles:
                checked.violations.append(f"{where}: step of {q - last[i]:.4f} degrees in {cycles - 1:.1f} cycles")
        last, last_ns = position, time_ns
    if checked.replies > checked.messages + 1:  # the capture may begin between a message and its reply
        checked.violations.append(f"{checked.replies} replies to {checked.messages} messages")
    return checked


if __name__ == "__main__":
    enter(int(sys.argv[1]))
    capture(int(sys.argv[2]), Path(sys.argv[3]))
