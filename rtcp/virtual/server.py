"""The segment's process: a raw socket on its end of the cable, and a loop that answers first and works after."""

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

from rtcp.config.faults import Planned, load_script
from rtcp.config.segment import load_segment
from rtcp.virtual.faults.control import Control, control_socket
from rtcp.virtual.faults.frames import FOR_EVER
from rtcp.virtual.faults.ground_truth import GroundTruth
from rtcp.virtual.faults.registry import FaultRegistry
from rtcp.virtual.network import NetworkError, private_pair, public_pair
from rtcp.virtual.protocol import ETHERTYPE
from rtcp.virtual.segment import Segment, make_segment

PRIORITY = 70
PR_SET_TIMERSLACK = 29
MCL_CURRENT, MCL_FUTURE = 1, 2
SO_TIMESTAMPNS = 35
TIMESPEC = struct.Struct("@qq")
ANCILLARY = socket.CMSG_SPACE(TIMESPEC.size)
BUFFER = 2048
OLDEST = 1_000_000_000
"""A receive time stamp more than this many ns old, or from the future, means that the wall clock was set: not used."""
RECEIVE_BUFFER = 1 << 20
STALE = 4_000_000
"""A frame that waited this many ns, because the process was stopped, reaches the slaves but does not come back: SOEM
has 16 frame numbers, would take an answer from the last round for the present one, and stay a round behind for ever."""
REST_SHARE = 8
"""Polling sleeps for this part of the time between frames, right after one: a FIFO thread that never sleeps would be
throttled by the kernel for 50 ms in every second (sched_rt_runtime_us)."""
LONGEST_REST = 250_000
SILENCE = 20_000_000
"""Without frames for this many ns polling stops until the next one comes."""
LOOK = 1_000_000
"""The control socket is looked at no more often than once in so many ns."""

Ready = Callable[[dict[str, int | str | bool]], None]


class StopRequest:
    """A handler of signals that remembers that one came."""

    def __init__(self) -> None:
        self.came = False

    def __call__(self, number: int, at: FrameType | None) -> None:
        """The signal has come."""
        self.came = True


class Server:
    """Answers frames on one interface, but for what the faults of its `registry` do to them."""

    def __init__(self, segment: Segment, interface: str, truth: GroundTruth, script: Sequence[Planned] = ()) -> None:
        self.segment = segment
        self._truth = truth
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE))
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._socket.bind((interface, ETHERTYPE))
        self.registry = FaultRegistry(segment, self._send, time.monotonic_ns(), script, _complain)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send(self, frame: bytes | memoryview) -> None:
        # A full queue of the interface loses the frame, as a cable would.
        with suppress(BlockingIOError):
            self._socket.send(frame)

    def serve(self, stop: StopRequest, poll: bool, control: Control | None = None) -> None:
        """Answer frames until `stop` came; with `poll` sleep no longer than it takes not to be throttled."""
        segment, registry, truth = self.segment, self.registry, self._truth
        frames = registry.frames
        frame = bytearray(BUFFER)
        view = memoryview(frame)
        receive, send = self._socket.recvmsg_into, self._socket.send
        descriptors = [self._socket.fileno()]
        monotonic, wait = time.monotonic_ns, select.select
        arrived = 0
        awake_from = 0 if poll else FOR_EVER
        look_at = FOR_EVER if control is None else 0
        while not stop.came:
            try:
                size, stamps, _, _ = receive([view], ANCILLARY)
            except BlockingIOError:
                size = 0
            if size:
                before, arrived = arrived, _arrival(stamps)
                if frames.active:
                    self._answer_disturbed(frame, size, arrived)
                elif segment.process(frame, size, arrived):
                    if monotonic() - arrived < STALE:
                        with suppress(BlockingIOError):
                            send(view[:size])
                    segment.settle(arrived)
                if poll:
                    awake_from = monotonic() + min((arrived - before) // REST_SHARE, LONGEST_REST)
                continue
            now = monotonic()
            if registry.due <= now:
                registry.tick(now)
            due = segment.next_event
            if due <= now:
                segment.tick(now)
                # At least once in segment.IDLE_TICK, and never before a frame that waits.
                if control is not None and look_at <= now:
                    look_at = now + LOOK
                    control.look()
            elif segment.busy:
                stepped = segment.step_one()
                if truth.watching and stepped is not None:
                    truth.look(stepped, now)
            elif now < awake_from:
                wait(descriptors, (), (), max(0, min(due, registry.due, awake_from) - now) * 1e-9)
            elif now - arrived > SILENCE:
                wait(descriptors, (), (), max(0, min(due, registry.due) - now) * 1e-9)

    def _answer_disturbed(self, frame: bytearray, size: int, arrived: int) -> None:
        """Answer a frame while a fault does something to those that pass."""
        if self.registry.frames.arrives() and self.segment.process(frame, size, arrived):
            if time.monotonic_ns() - arrived < STALE:
                self.registry.answers(bytes(frame[:size]), arrived)
            self.segment.settle(arrived)


def _complain(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


def _stamp(data: bytes) -> tuple[int, int]:
    seconds, nanoseconds = TIMESPEC.unpack_from(data)
    return seconds, nanoseconds


def _arrival(stamps: list[tuple[int, int, bytes]]) -> int:
    """The instant (CLOCK_MONOTONIC, ns) at which a frame arrived, by the kernel's receive time stamp."""
    now = time.monotonic_ns()
    if stamps:
        seconds, nanoseconds = _stamp(stamps[0][2])
        age = time.time_ns() - seconds * 1_000_000_000 - nanoseconds
        if 0 <= age < OLDEST:
            return now - age
    return now


def _run_on(cpu: int) -> None:
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, ValueError, OverflowError) as error:
        raise ValueError(f"--cpu {cpu} cannot be used, there are CPUs 0 to {(os.cpu_count() or 1) - 1}") from error


def _prefer() -> None:
    """Ask for prompt scheduling; without the right to it the segment runs on as it is."""
    libc = ctypes.CDLL(None)
    libc.prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    # Reclaimed pages of the interpreter's own text would cost milliseconds to read back; refused, it does without.
    libc.mlockall(MCL_CURRENT | MCL_FUTURE)
    gc.collect()
    gc.freeze()
    gc.disable()


def run(config_path: Path, interface: str | None, poll: bool, cpu: int | None, ready: Ready,
        control_path: Path | None = None, script_path: Path | None = None) -> None:  # fmt: skip
    """Run a segment until SIGTERM or SIGINT.

    `interface` names the master's end in the caller's network; None: everything in a namespace of the segment's own.
    `poll` hardly sleeps while frames come, best with a `cpu` of its own. `ready` is called once with "pid",
    "interface", "namespace" and "slaves" when frames are answered. At `control_path` faults can be asked for; those of
    the script begin by themselves.

    Raises:
        ConfigError, ValueError, NetworkError: with sentences for the user.
    """
    config = load_segment(config_path)
    script = () if script_path is None else load_script(script_path, len(config.slaves))
    if cpu is not None:
        _run_on(cpu)
    segment = make_segment(config, time.monotonic_ns())
    stop = StopRequest()
    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    with ExitStack() as kept:
        listener = None if control_path is None else kept.enter_context(control_socket(control_path))
        pair = private_pair() if interface is None else public_pair(interface)
        master_end, segment_end = kept.enter_context(pair)
        truth = GroundTruth(segment, [slave.model for slave in config.slaves])
        server = Server(segment, segment_end, truth, script)
        kept.callback(server.close)
        control = None if listener is None else Control(listener, server.registry, truth)
        if control is not None:
            kept.callback(control.close)
        _prefer()
        ready({
            "pid": os.getpid(),
            "interface": master_end,
            "namespace": interface is None,
            "slaves": len(segment.slaves),
        })  # fmt: skip
        try:
            server.serve(stop, poll, control)
        except OSError as error:
            raise NetworkError(f"the cable at {master_end} is gone ({error.strerror}): was it removed?") from error
