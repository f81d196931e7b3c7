"""The segment's process: a raw socket on its end of the cable, and a loop that answers frames before other work."""

from __future__ import annotations

import ctypes
import gc
import os
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType

from rtcp.config.segment import load_segment
from rtcp.virtual.behaviour import WATCH
from rtcp.virtual.faults.control import Control, GroundTruth
from rtcp.virtual.faults.fault import FOR_EVER
from rtcp.virtual.faults.registry import FaultRegistry, Planned, load_script
from rtcp.virtual.network import NetworkError, private_pair, public_pair
from rtcp.virtual.protocol import ETHERTYPE
from rtcp.virtual.request_socket import control_socket
from rtcp.virtual.segment import Segment, make_segment

PRIORITY = 70
PR_SET_TIMERSLACK = 29
MCL_CURRENT, MCL_FUTURE = 1, 2
SO_TIMESTAMPNS = 35
TIMESPEC = struct.Struct("@qq")
ETH_P_ALL = 3
SOL_PACKET = 263
PACKET_IGNORE_OUTGOING = 23
PACKET_AUXDATA = 8
VLAN_AT = 12
"""Offset of a VLAN tag: before the EtherType."""
AUXDATA = struct.Struct("=IIIHHHH")
"""`struct tpacket_auxdata`: status, lengths, offsets, VLAN TCI and TPID (packet(7))."""
TP_STATUS_VLAN_VALID = 0x10
ANCILLARY = socket.CMSG_SPACE(TIMESPEC.size) + socket.CMSG_SPACE(AUXDATA.size)
BUFFER = 2048
OLDEST = 1_000_000_000
"""Upper bound on the age of a receive time stamp, ns; an older or future one means that the wall clock was set."""
RECEIVE_BUFFER = 1 << 20
STALE = 4_000_000
"""Age above which a frame (the process was stopped) reaches the slaves but gets no answer, ns: SOEM has 16 frame
numbers, would take an answer of the last round for the present one, and stay a round behind for ever."""
REST_WINDOW = 2_000_000
REST_MARGIN = 1.5
"""Margin factor on the sleep in each window of REST_WINDOW ns: the kernel stops a SCHED_FIFO thread that uses more than
`sched_rt_runtime_us` of each `sched_rt_period_us` of the CPU, so the server itself sleeps for the remaining share."""
RT_LIMITS = Path("/proc/sys/kernel")
SILENCE = 20_000_000
"""Time without frames after which polling stops until the next one, ns."""
LOOK = 1_000_000
"""Shortest interval between polls of the control socket, ns."""

Ancillary = list[tuple[int, int, bytes]]
Ready = Callable[[dict[str, int | str | bool]], None]


class StopRequest:
    """A signal handler that stores a request to stop."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self, number: int, at: FrameType | None) -> None:
        """Handle the signal."""
        self.requested = True


class Server:
    """Answers frames on an interface, subject to the faults of its `registry`."""

    def __init__(self, segment: Segment, interface: str, truth: GroundTruth, script: Sequence[Planned] = ()) -> None:
        self.segment = segment
        self._truth = truth
        # A socket for one EtherType receives tagged frames without their tag; this one receives everything.
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
        self._socket.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, 1)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(SOL_PACKET, PACKET_AUXDATA, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._socket.bind((interface, ETH_P_ALL))
        self.registry = FaultRegistry(segment, self._send, time.monotonic_ns(), script, _complain)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send(self, frame: bytes | memoryview) -> None:
        # A full queue of the interface loses the frame, like a cable.
        with suppress(BlockingIOError):
            self._socket.send(frame)

    def serve(self, stop: StopRequest, poll: bool, control: Control | None = None, sleep_share: float = 0.0) -> None:
        """Answer frames until `stop` is requested; with `poll` wait for frames without sleeping.

        `sleep_share`: least share of the time to sleep, see `rest_share`.
        """
        segment, registry, truth = self.segment, self.registry, self._truth
        frames = registry.frames
        frame = bytearray(BUFFER)
        view = memoryview(frame)
        receive, send = self._socket.recvmsg_into, self._socket.send
        descriptors = [self._socket.fileno()]
        monotonic, wait = time.monotonic_ns, select.select
        arrived = 0
        poll_at = FOR_EVER if control is None else 0
        budget = RestBudget(sleep_share, monotonic())
        window_end = budget.window_end
        while not stop.requested:
            try:
                size, ancillary, _, _ = receive([view], ANCILLARY)
            except BlockingIOError:
                size = 0
            if size:
                if frame[12] != ETHERTYPE >> 8 or frame[13] != ETHERTYPE & 0xFF:
                    continue
                arrived = arrival(ancillary, arrived)
                if frames.active or _tagged(ancillary):
                    self._answer_slowly(frame, size, arrived, ancillary)
                elif segment.process(frame, size, arrived):
                    if monotonic() - arrived < STALE:
                        with suppress(BlockingIOError):
                            send(view[:size])
                    segment.settle(arrived)
                if arrived > window_end:
                    window_end = budget.rest(monotonic())
                continue
            now = monotonic()
            if registry.due <= now:
                registry.tick(now)
            due = segment.next_event
            if due <= now:
                segment.tick(now)
                # At least once per segment.IDLE_TICK, and never before a waiting frame.
                if control is not None and poll_at <= now:
                    poll_at = now + LOOK
                    control.poll()
            elif segment.busy:
                stepped = segment.step_one()
                if truth.watching and stepped is not None:
                    truth.update(stepped, now)
            elif not poll or now - arrived > SILENCE:
                wait(descriptors, (), (), max(0, min(due, registry.due) - now) * 1e-9)
                budget.slept += monotonic() - now
            elif now > window_end + REST_WINDOW:
                # Only if frames are rare: right after a frame the sleep delays none.
                window_end = budget.rest(now)

    def _answer_slowly(self, frame: bytearray, size: int, arrived: int, ancillary: Ancillary) -> None:
        """Answer a frame under faults, or one with a VLAN tag, which the kernel delivers separately."""
        content, tag = frame, _tagged(ancillary)
        if tag:
            content = frame[:VLAN_AT] + tag + frame[VLAN_AT:size]
            size = len(content)
        frames = self.registry.frames
        if (not frames.active or frames.arrives()) and self.segment.process(content, size, arrived):
            if time.monotonic_ns() - arrived < STALE:
                self.registry.answers(bytes(content[:size]), arrived)
            self.segment.settle(arrived)


class RestBudget:
    """Bookkeeping of the sleep that avoids throttling by the kernel. Instants in ns.

    `slept`: time asleep in the window that ends at `window_end`.
    """

    def __init__(self, share: float, now: int) -> None:
        self._least = round(share * REST_WINDOW)
        self.slept = 0
        self.window_end = now + REST_WINDOW if self._least else FOR_EVER

    def rest(self, now: int) -> int:
        """Sleep the missing time at the end of a window; return the end of the next one."""
        passed = now - self.window_end + REST_WINDOW
        missing = min(self._least * passed // REST_WINDOW, REST_WINDOW) - self.slept
        if missing > 0:
            time.sleep(missing * 1e-9)
        self.slept = 0
        self.window_end = time.monotonic_ns() + REST_WINDOW
        return self.window_end


def rest_share() -> float:
    """Return the share of the time to sleep: 0 without SCHED_FIFO or without throttling."""
    if os.sched_getscheduler(0) != os.SCHED_FIFO:
        return 0.0
    try:
        runtime, period = (
            int((RT_LIMITS / name).read_text()) for name in ("sched_rt_runtime_us", "sched_rt_period_us")
        )
    except (OSError, ValueError):
        runtime, period = 950_000, 1_000_000
    return 0.0 if runtime < 0 else min(0.5, REST_MARGIN * max(0.0, 1.0 - runtime / period))


def _complain(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


def arrival(ancillary: Ancillary, previous: int) -> int:
    """Return the arrival of a frame (CLOCK_MONOTONIC, ns) from the kernel's receive time stamp.

    Never before that of the previous frame: a stall between reading the two clocks gives too early an instant.
    """
    now = time.monotonic_ns()
    if ancillary:
        seconds, nanoseconds = TIMESPEC.unpack_from(ancillary[0][2])
        age: int = time.time_ns() - seconds * 1_000_000_000 - nanoseconds
        if 0 <= age < OLDEST:
            return max(previous, now - age)
    return now


def _tagged(ancillary: Ancillary) -> bytes:
    """Return the VLAN tag (IEEE 802.1Q) that the kernel has removed from a frame; empty: none."""
    if len(ancillary) < 2 or not ancillary[1][2][0] & TP_STATUS_VLAN_VALID:
        return b""
    tci: int = AUXDATA.unpack_from(ancillary[1][2])[5]
    return b"\x81\x00" + tci.to_bytes(2, "big")


def _run_on(cpu: int) -> None:
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, ValueError, OverflowError) as error:
        raise ValueError(f"--cpu {cpu} cannot be used, there are CPUs 0 to {(os.cpu_count() or 1) - 1}") from error


def request_prompt_scheduling() -> None:
    """Request SCHED_FIFO and locked memory; no effect without the rights."""
    libc = ctypes.CDLL(None)
    libc.prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    # Reading back reclaimed pages of the interpreter's text would take milliseconds. Refusal is harmless.
    libc.mlockall(MCL_CURRENT | MCL_FUTURE)
    gc.collect()
    gc.freeze()
    gc.disable()


def run(config_path: Path, interface: str | None, poll: bool, cpu: int | None, ready: Ready,
        control_path: Path | None = None, script_path: Path | None = None) -> None:  # fmt: skip
    """Run a segment until SIGTERM or SIGINT.

    `interface` names the master's end in the caller's network; None: both ends in the segment's own namespace. `poll`
    hardly sleeps during traffic, best with a dedicated `cpu`. `ready` is called once with "pid", "interface",
    "namespace" and "slaves" when frames are answered. `control_path` accepts requests for faults; those of the script
    begin by themselves.

    Raises:
        ConfigError, ValueError, NetworkError: with sentences for the user.
    """
    config = load_segment(config_path)
    script = () if script_path is None else load_script(script_path, len(config.slaves))
    if cpu is not None:
        _run_on(cpu)
    stop = StopRequest()
    with ExitStack() as resources:
        if any(slave.behaviour is not None for slave in config.slaves):
            resources.enter_context(WATCH.started())
        segment = make_segment(config, time.monotonic_ns())
        signal.signal(signal.SIGTERM, stop)
        signal.signal(signal.SIGINT, stop)
        listener = None if control_path is None else resources.enter_context(control_socket(control_path))
        pair = private_pair() if interface is None else public_pair(interface)
        master_end, segment_end, bring_up = resources.enter_context(pair)
        truth = GroundTruth(segment, [slave.label for slave in config.slaves])
        server = Server(segment, segment_end, truth, script)
        resources.callback(server.close)
        control = None if listener is None else Control(listener, server.registry, truth)
        if control is not None:
            resources.callback(control.close)
        request_prompt_scheduling()
        # Last, so that a master with its interface up finds answering slaves.
        bring_up()
        ready({
            "pid": os.getpid(),
            "interface": master_end,
            "namespace": interface is None,
            "slaves": len(segment.slaves),
        })  # fmt: skip
        try:
            server.serve(stop, poll, control, rest_share())
        except OSError as error:
            raise NetworkError(f"the cable at {master_end} is gone ({error.strerror}): was it removed?") from error
