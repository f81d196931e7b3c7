"""`rtcp capture`: a process that joins the bus's network namespace and writes every frame to a pcapng file."""

from __future__ import annotations

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
from types import FrameType, TracebackType
from typing import BinaryIO, NamedTuple

from rtcp.config.model import VIRTUAL
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.interface import check_interface, enter
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import SessionError, is_running, read_processes, read_session
from rtcp.launch.offline import configuration
from rtcp.launch.platform import defer_signals

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
_POLL_S = 0.2


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

    def __init__(self, interface: str, pid: int | None, out: Path) -> None:
        """Start it.

        Raises:
            RtcpError: there is no such interface, or no right to see its frames.
        """
        question = json.dumps({"interface": interface, "pid": pid, "out": str(out)})
        with defer_signals():
            self._child = subprocess.Popen(
                [sys.executable, "-m", "rtcp.launch.capturing", question],
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
        assert self._child.stdout is not None
        first = self._child.stdout.readline()
        answer = json.loads(first) if first else {"error": "the capture ended before it began"}
        if "error" in answer:
            self._child.wait()
            self._child.stdout.close()
            raise RtcpError("fault", str(answer["error"]))

    def __enter__(self) -> Capture:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:  # fmt: skip
        if self._child.poll() is None:
            self._child.kill()
            self._child.wait()
        if self._child.stdout is not None:
            self._child.stdout.close()

    def wait(self, seconds: float | None) -> Counted:
        """Let it run for a time, None: until Ctrl-C; end it and return what it has written."""
        try:
            self._child.wait(seconds)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            self._child.terminate()
        assert self._child.stdout is not None
        last = self._child.stdout.readline()
        self._child.wait()
        if not last:
            raise RtcpError("fault", f"the capture ended with exit code {self._child.returncode}")
        return Counted(**json.loads(last))


def main() -> int:
    """Capture until SIGTERM: the child's side."""
    question = json.loads(sys.argv[1])
    ended = False

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal ended
        ended = True

    signal.signal(signal.SIGTERM, end)
    try:
        # Before the namespace is joined, in which this user is somebody else.
        with open(question["out"], "wb") as file:
            if question["pid"] is not None:
                enter(question["pid"])
            check_interface(question["interface"])
            with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as port:
                _prepare(port, question["interface"])
                _tell({})
                frames = 0
                writer = PcapngFile(file, question["interface"])
                while not ended:
                    frames += _write_waiting(port, writer)
                lost = struct.unpack("=II", port.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 8))[1]
    except PermissionError as error:
        _tell({"error": f"capturing on {question['interface']} needs the capability CAP_NET_RAW (or root): {error}"})
        return 1
    except (OSError, BusError) as error:
        _tell({"error": str(error)})
        return 1
    _tell({"frames": frames, "lost": lost})
    return 0


def _prepare(port: socket.socket, interface: str) -> None:
    port.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    port.setblocking(False)
    port.bind((interface, _ETH_P_ALL))


def _write_waiting(port: socket.socket, writer: PcapngFile) -> int:
    """Write the frames that wait, at most for a while; return how many there were."""
    if not select.select([port], [], [], _POLL_S)[0]:
        return 0
    count = 0
    while True:
        try:
            frame, extras, _, address = port.recvmsg(_LARGEST_FRAME, socket.CMSG_SPACE(_TIME.size))
        except BlockingIOError:
            return count
        time_ns = time.time_ns()
        for level, kind, data in extras:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, part = _TIME.unpack(data)
                time_ns = seconds * 1_000_000_000 + part
        writer.write(frame, time_ns, address[2] == socket.PACKET_OUTGOING)
        count += 1


def _tell(answer: dict[str, object]) -> None:
    os.write(1, json.dumps(answer).encode() + b"\n")


if __name__ == "__main__":
    raise SystemExit(main())
