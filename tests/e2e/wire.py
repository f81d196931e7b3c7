"""Independent access to the wire: its own frames, its own decoder, no code of the platform.

Usage: python wire.py SEGMENT_PID al | init POSITION | safeop POSITION | station POSITION ADDRESS | capture FILE
The layout of the process image is that of the facts: an IO box (2 bytes out), then six drives (15 bytes out each); then
what they bring back in the same order (6 bytes, and 15 each).
"""

from __future__ import annotations

import contextlib
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
BOX_OUT, BOX_IN = 2, 6
DRIVES = 6
COUNTS_PER_RAD = 10_000
AL_STATES = {"init": 1, "safeop": 4}
STATION, AL_CONTROL = 0x0010, 0x0120
ETH_P_ALL = 3
"""Protocol of a socket that also receives outgoing frames, packet(7)."""
LEAVES = 0x8000
"""Flag in a capture, beside the length, of a frame that leaves the segment."""
SO_TIMESTAMPNS = 35
SO_RCVBUFFORCE = 33
SOL_PACKET, PACKET_STATISTICS = 263, 6
BUFFER = 16 << 20
TIMESPEC = struct.Struct("@qq")
HEAD = struct.Struct("<QH")
"""Header of a frame in a capture: time, ns, and length."""


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
            # Own outgoing frames are received too; only an incoming one is an answer.
            if where[2] != socket.PACKET_OUTGOING and answer[17] == index and answer[16] == command:
                return answer[26 : 26 + length], struct.unpack_from("<H", answer, 26 + length)[0]
    raise TimeoutError("the segment does not answer")


def al_words(interface: str, register: int) -> list[int]:
    """Return the AL status words (0x0130) or AL status codes (0x0134) of all slaves, by position."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) as port:
        port.bind((interface, ETHERTYPE))
        _, count = ask(port, BRD, 0, 0x0130, 2)
        return [int.from_bytes(ask(port, APRD, -position, register, 2)[0], "little") for position in range(count)]


def write(interface: str, position: int, register: int, word: int) -> None:
    """Write a register of the slave at `position` (from 0), for example a lower AL state or another station."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) as port:
        port.bind((interface, ETHERTYPE))
        port.send(frame(APWR, 0xDD, -position, register, struct.pack("<H", word)))


def capture(interface: str, path: str) -> None:
    """Write every frame that reaches or leaves the segment to a file, with its time, until SIGTERM; then what was lost.

    Times are the kernel's, as CLOCK_MONOTONIC: a host that is busy delays the writing, not the stamp.
    """
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, at: ended.append(number))
    with (
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL)) as port,
        open(path, "wb") as file,
    ):
        for option in (socket.SO_RCVBUF, SO_RCVBUFFORCE):
            with contextlib.suppress(PermissionError):
                port.setsockopt(socket.SOL_SOCKET, option, BUFFER)
        port.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        port.bind((interface, ETH_P_ALL))
        port.settimeout(0.1)
        print("ready", flush=True)
        while not ended:
            try:
                got, extra, _, where = port.recvmsg(1600, socket.CMSG_SPACE(TIMESPEC.size))
            except TimeoutError:
                continue
            except OSError:
                break  # the interface ended with the segment
            if got[12:14] != ETHERTYPE.to_bytes(2, "big"):
                continue
            s, ns = TIMESPEC.unpack_from(extra[0][2])
            when = s * 1_000_000_000 + ns - time.time_ns() + time.monotonic_ns()
            leaves = LEAVES if where[2] == socket.PACKET_OUTGOING else 0
            file.write(HEAD.pack(when, len(got) | leaves) + got)
        # tpacket_stats of packet(7): frames seen, frames for which there was no room.
        _, lost = struct.unpack("@II", port.getsockopt(SOL_PACKET, PACKET_STATISTICS, 8))
        print(lost, flush=True)


@dataclass(frozen=True)
class Targets:
    """Outputs of a drive in a frame, in counts."""

    controlword: int
    position: int
    velocity: int
    torque: int
    mode: int


def frames(path: Path) -> Iterator[tuple[int, bool, bytes]]:
    """Yield time (ns), whether it leaves the segment, and bytes of captured frames."""
    with path.open("rb") as file:
        while len(head := file.read(HEAD.size)) == HEAD.size:
            when, word = HEAD.unpack(head)
            yield when, bool(word & LEAVES), file.read(word & ~LEAVES)


def datagrams(frame: bytes) -> Iterator[tuple[int, int, bytes, int]]:
    """Yield command, index, data and working counter of every datagram in a frame."""
    at, more = 16, True
    while more:
        command, index, _, _, word, _ = struct.unpack_from("<BBHHHH", frame, at)
        length, more = word & 0x07FF, bool(word & 0x8000)
        data = frame[at + 10 : at + 10 + length]
        yield command, index, data, int.from_bytes(frame[at + 10 + length : at + 12 + length], "little")
        at += 12 + length


def images(path: Path, leave: bool) -> Iterator[tuple[int, bytes]]:
    """Yield time (ns) and process image of every frame that leaves the segment, or that reaches it."""
    for when, leaves, got in frames(path):
        if leaves is leave:
            for command, _, image, _ in datagrams(got):
                if command == LRW:
                    yield when, image


def outputs(path: Path, answered: bool = False) -> Iterator[tuple[int, list[Targets]]]:
    """Yield time (ns) and the targets of all drives of every process data frame that reached the segment.

    `answered`: of those only that the segment answered, as they stand beside the inputs in the answers.
    """
    for when, image in images(path, leave=answered):
        yield when, [Targets(*DRIVE.unpack_from(image, BOX_OUT + i * DRIVE.size)) for i in range(DRIVES)]


@dataclass(frozen=True)
class Actual:
    """Inputs of a drive in a frame, in counts."""

    statusword: int
    position: int
    velocity: int
    torque: int
    mode: int


def inputs(path: Path) -> Iterator[tuple[int, list[Actual]]]:
    """Yield time (ns) and the inputs of all drives of every process data frame that leaves the segment."""
    first = BOX_OUT + DRIVES * DRIVE.size + BOX_IN
    for when, image in images(path, leave=True):
        yield when, [Actual(*DRIVE.unpack_from(image, first + i * DRIVE.size)) for i in range(DRIVES)]


def main() -> None:
    """Run the command of the command line."""
    enter(int(sys.argv[1]))
    if sys.argv[2] == "al":
        print(json.dumps(al_words("ecat0", 0x0130)))
    elif sys.argv[2] == "codes":
        print(json.dumps(al_words("ecat0", 0x0134)))
    elif sys.argv[2] in AL_STATES:
        write("ecat0", int(sys.argv[3]), AL_CONTROL, AL_STATES[sys.argv[2]])
    elif sys.argv[2] == "station":
        write("ecat0", int(sys.argv[3]), STATION, int(sys.argv[4], 0))
    else:
        capture("ecat0-seg", sys.argv[3])


if __name__ == "__main__":
    main()
