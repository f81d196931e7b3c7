"""A look at the wire that shares nothing with the platform: its own frames, its own decoder.

Usage: python wire.py SEGMENT_PID al | init POSITION | capture FILE
The layout of the process image is that of the facts: an IO box (2 bytes out), then six drives (15 bytes out each).
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ETHERTYPE = 0x88A4
LRW = 12
APRD = 1
APWR = 2
BRD = 7
DRIVE = struct.Struct("<Hiiib")
BOX_OUT = 2
DRIVES = 6
COUNTS_PER_RAD = 10_000


def enter(pid: int) -> None:
    """Join the network namespace (and for an ordinary user the user namespace) of a process."""
    libc = ctypes.CDLL(None, use_errno=True)
    for kind in ("user", "net"):
        if os.readlink(f"/proc/{pid}/ns/{kind}") != os.readlink(f"/proc/self/ns/{kind}"):
            descriptor = os.open(f"/proc/{pid}/ns/{kind}", os.O_RDONLY)
            if libc.setns(descriptor, 0) != 0:
                raise OSError(ctypes.get_errno(), f"setns {kind}")
            os.close(descriptor)


def frame(command: int, index: int, address: int, offset: int, data: bytes) -> bytes:
    """Build a frame of one datagram."""
    datagram = struct.pack("<BBHHHH", command, index, address & 0xFFFF, offset, len(data), 0) + data + bytes(2)
    header = struct.pack("<H", len(datagram) | 0x1000)
    return (b"\xff" * 6 + b"\x02\x77\x77\x77\x77\x77" + struct.pack(">H", ETHERTYPE) + header + datagram).ljust(
        60, b"\0"
    )


def ask(port: socket.socket, command: int, address: int, offset: int, length: int) -> tuple[bytes, int]:
    """Send a read and return its data and working counter; a frame that is lost is sent again."""
    index = 0xDD
    port.settimeout(0.2)
    end = time.monotonic() + 10
    while time.monotonic() < end:
        port.send(frame(command, index, address, offset, bytes(length)))
        again = time.monotonic() + 0.2
        while time.monotonic() < again:
            try:
                answer, where = port.recvfrom(1600)
            except TimeoutError:
                break
            # Own frames on their way out are seen too; an answer comes in.
            if where[2] != socket.PACKET_OUTGOING and answer[17] == index and answer[16] == command:
                return answer[26 : 26 + length], struct.unpack_from("<H", answer, 26 + length)[0]
    raise TimeoutError("the segment does not answer")


def al_states(interface: str) -> list[int]:
    """Return the AL status words of all slaves, by position."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) as port:
        port.bind((interface, ETHERTYPE))
        _, count = ask(port, BRD, 0, 0x0130, 2)
        return [int.from_bytes(ask(port, APRD, -position, 0x0130, 2)[0], "little") for position in range(count)]


def to_init(interface: str, position: int) -> None:
    """Send the slave at `position` (from 0) to INIT, as if it had lost its way."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) as port:
        port.bind((interface, ETHERTYPE))
        port.send(frame(APWR, 0xDD, -position, 0x0120, b"\x01\x00"))


def capture(interface: str, path: str) -> None:
    """Write every frame that reaches the segment to a file, with its time, until SIGTERM."""
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, at: ended.append(number))
    with (
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) as port,
        open(path, "wb") as file,
    ):
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 << 20)
        port.bind((interface, ETHERTYPE))
        port.settimeout(0.1)
        print("ready", flush=True)
        while not ended:
            try:
                got, where = port.recvfrom(1600)
            except TimeoutError:
                continue
            if where[2] != socket.PACKET_OUTGOING:
                file.write(struct.pack("<QH", time.monotonic_ns(), len(got)) + got)


@dataclass(frozen=True)
class Targets:
    """What one frame asks of a drive, in counts."""

    controlword: int
    position: int
    velocity: int
    torque: int
    mode: int


def frames(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield time (ns) and bytes of captured frames."""
    data = path.read_bytes()
    at = 0
    while at + 10 <= len(data):
        when, length = struct.unpack_from("<QH", data, at)
        yield when, data[at + 10 : at + 10 + length]
        at += 10 + length


def outputs(path: Path) -> Iterator[tuple[int, list[Targets]]]:
    """Yield time (ns) and the targets of all drives of every process data frame."""
    for when, got in frames(path):
        at = 16
        more = True
        while more:
            command, _, _, _, word, _ = struct.unpack_from("<BBHHHH", got, at)
            length, more = word & 0x07FF, bool(word & 0x8000)
            if command == LRW:
                image = got[at + 10 : at + 10 + length]
                yield when, [Targets(*DRIVE.unpack_from(image, BOX_OUT + i * DRIVE.size)) for i in range(DRIVES)]
            at += 12 + length


def main() -> None:
    """Do what the command line says."""
    enter(int(sys.argv[1]))
    if sys.argv[2] == "al":
        print(json.dumps(al_states("ecat0")))
    elif sys.argv[2] == "init":
        to_init("ecat0", int(sys.argv[3]))
    else:
        capture("ecat0-seg", sys.argv[3])


if __name__ == "__main__":
    main()
