"""`rtcp capture`: a process that joins the bus's network namespace and writes every frame to a pcapng file."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rtcp.config.model import VIRTUAL
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.interface import check_interface, enter
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import SessionError, is_running, read_processes, read_session
from rtcp.launch.offline import configuration
from rtcp.launch.platform import SIGNALS, defer_signals

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
"""Block types (pcapng, draft-ietf-opsawg-pcapng)."""
_ETHERNET = 1
_RESOLUTION, _NANOSECONDS, _FLAGS, _END = 9, 9, 2, 0
"""Options: resolution of times (10^-9 s), flags of a packet, end."""
_INBOUND, _OUTBOUND = 1, 2
_LARGEST_FRAME = 1 << 16
_ETH_P_ALL = 0x0003
_SO_TIMESTAMPNS = 35
_PACKET_STATISTICS = 6
_SOL_PACKET = 263
_BUFFER_BYTES = 1 << 24
_TIME = struct.Struct("@ll")
_FRAMES_AT_ONCE = 1000
_END_S = 5.0


class Counted(NamedTuple):
    """Frames that were written, and that were lost because the host was too slow."""

    frames: int
    lost: int


class PcapngFile:
    """Writes frames with times in ns to a pcapng file of one interface."""

    def __init__(self, file: BinaryIO, interface: str) -> None:
        self._file = file
        self._block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
        name = interface.encode()
        options = _option(2, name) + _option(_RESOLUTION, bytes((_NANOSECONDS,))) + _option(_END, b"")
        self._block(_INTERFACE, struct.pack("<HHI", _ETHERNET, 0, _LARGEST_FRAME) + options)

    def write(self, frame: bytes, time_ns: int, outbound: bool) -> None:
        """Append a frame."""
        head = struct.pack("<IIIII", 0, time_ns >> 32, time_ns & 0xFFFFFFFF, len(frame), len(frame))
        flags = _option(_FLAGS, struct.pack("<I", _OUTBOUND if outbound else _INBOUND)) + _option(_END, b"")
        self._block(_PACKET, head + _padded(frame) + flags)

    def _block(self, kind: int, content: bytes) -> None:
        length = struct.pack("<I", len(content) + 12)
        self._file.write(struct.pack("<I", kind) + length + content + length)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def place_of_bus(bus: str | None, config: Path | None) -> tuple[str, int | None]:
    """Return the interface of a bus and the process in whose namespace it is; None: in this one's.

    Raises:
        RtcpError: the bus `virtual` of no running platform.
        ConfigError: the configuration is wrong.
    """
    directory = runtime_directory()
    if is_running(read_processes(directory).loop):
        try:
            session = read_session(directory)
        except SessionError as error:
            raise RtcpError("internal", str(error)) from error
        if bus in (None, session.bus):
            return session.interface, session.segment_pid or None
    name = configuration(config).bus.interface if bus is None else bus
    if name == VIRTUAL:
        raise RtcpError("not running", "the bus virtual exists while a platform runs: `rtcp start` starts one")
    return name, None


class Capture:
    """A capture in a child process: only a process of one thread may join another's namespace."""

    def __init__(self, interface: str, pid: int | None, file: BinaryIO) -> None:
        """Start it; it ends when its standard input does, also where this process is killed.

        Args:
            interface: the interface.
            pid: a process in whose network namespace it is, None: in this one's.
            file: receives the frames.

        Raises:
            RtcpError: there is no such interface, or no right to see its frames.
        """
        self._file = file
        question = json.dumps({"interface": interface, "pid": pid, "file": file.fileno()})
        with defer_signals():
            self._child = subprocess.Popen(
                [sys.executable, "-m", "rtcp.launch.capturing", question],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=(file.fileno(),),
                start_new_session=True,
            )
        try:
            self._answer()
        except BaseException:
            self._end()
            raise

    def _answer(self) -> dict[str, int]:
        """Return the next answer of the child; raises RtcpError where it failed."""
        assert self._child.stdout is not None
        line = self._child.stdout.readline()
        answer = json.loads(line) if line else {"error": f"its process ended with exit code {self._child.wait()}"}
        if "error" in answer:
            raise RtcpError("fault", f"capturing into {self._file.name}: {answer['error']}")
        return dict(answer)

    def __enter__(self) -> Capture:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        """End the child by the end of its input, so that the file ends with a whole block; after a time by SIGKILL."""
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self._child.stdin.close()
        try:
            self._child.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._child.stdout.close()

    def wait(self, seconds: float | None) -> Counted:
        """Let it run for a time, s, or until a signal that raises KeyboardInterrupt; end it, return its counts.

        Raises:
            RtcpError: a frame could not be written or received.
        """
        assert self._child.stdin is not None
        with contextlib.suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
            self._child.wait(seconds)
        self._child.stdin.close()
        return Counted(**self._answer())


def main() -> int:
    """Capture until standard input ends: the child's side."""
    # A service manager signals every process of a unit: the command alone ends this one.
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    question = json.loads(sys.argv[1])
    try:
        with open(question["file"], "wb") as file:
            if question["pid"] is not None:
                enter(question["pid"])
            check_interface(question["interface"])
            with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as port:
                _prepare(port, question["interface"])
                _send({})
                frames = 0
                writer = PcapngFile(file, question["interface"])
                while sys.stdin not in select.select([port, sys.stdin], [], [])[0]:
                    frames += _write_waiting(port, writer)
                frames += _write_waiting(port, writer)
                lost = struct.unpack("=II", port.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 8))[1]
    except PermissionError as error:
        _send({"error": f"capturing on {question['interface']} needs the capability CAP_NET_RAW (or root): {error}"})
        return 1
    except (OSError, BusError) as error:
        _send({"error": getattr(error, "strerror", None) or str(error)})
        return 1
    _send({"frames": frames, "lost": lost})
    return 0


def _prepare(port: socket.socket, interface: str) -> None:
    port.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    port.setblocking(False)
    port.bind((interface, _ETH_P_ALL))


def _write_waiting(port: socket.socket, writer: PcapngFile) -> int:
    """Write the waiting frames, at most `_FRAMES_AT_ONCE`; return how many were written."""
    for count in range(_FRAMES_AT_ONCE):
        try:
            frame, extras, _, address = port.recvmsg(_LARGEST_FRAME, socket.CMSG_SPACE(_TIME.size))
        except BlockingIOError:
            return count
        time_ns = time.time_ns()
        for level, kind, data in extras:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIME.unpack(data)
                time_ns = seconds * 1_000_000_000 + nanoseconds
        writer.write(frame, time_ns, address[2] == socket.PACKET_OUTGOING)
    return _FRAMES_AT_ONCE


def _send(answer: dict[str, object]) -> None:
    os.write(1, json.dumps(answer).encode() + b"\n")


if __name__ == "__main__":
    raise SystemExit(main())
