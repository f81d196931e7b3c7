"""The exchange of process data through SOEM: one frame a cycle, and never an old answer taken for a new one.

SOEM knows a frame's answer by an index of 0 to 15 only: an answer that is 16 cycles late is taken for the current one,
and the cycles after it each take the next late one, for ever. Frames do not overtake one another on a segment, so once
a NOP datagram with a number of its own is back, no older frame is under way any more.
"""

from __future__ import annotations

import ctypes
import socket
import time
from collections.abc import Sequence
from typing import Any, Final

from rtcp.fieldbus.registers import DatagramCommand, build_frame, open_socket

_LARGEST_FRAME_DATA: Final = 1466
"""Bytes of process data that fit one frame beside the clock's datagram (SOEM: EC_MAXLRWDATA - EC_FIRSTDCDATAGRAM)."""


class SoemProcessData:
    """ProcessData over a configured pysoem master. `receive` holds the interpreter and polls, at most `receive_us`.

    After an exchange without an answer the next `send` first lets a barrier frame pass, throws away what came back
    before it and only then sends: the answer that follows can only be the new one. While that frame does not come back,
    outputs are still sent (a drive that receives frames must get its targets), but no answer is taken.
    """

    def __init__(
        self,
        master: Any,
        slaves: Sequence[Any],
        socket_fd: int,
        barrier: FrameBarrier,
        receive_us: int,
        barrier_us: int,
    ) -> None:
        """Take over the image of `slaves` (pysoem's), outputs zero.

        Args:
            master: pysoem's master after `config_map`.
            slaves: its slaves.
            socket_fd: a duplicate of SOEM's packet socket, non-blocking.
            barrier: the frame barrier on the same interface.
            receive_us: how long an answer is waited for.
            barrier_us: how long the barrier frame is waited for.
        """
        self.expected_wkc = int(master.expected_wkc)
        self.missed = 0
        self.stale = 0
        self._master = master
        self._slaves = tuple(slaves)
        self._fd = socket_fd
        self._barrier = barrier
        self._receive_us = receive_us
        self._barrier_ns = barrier_us * 1000
        self._inputs = [bytes(slave.input) for slave in slaves]
        self._outputs = [bytes(len(slave.output)) for slave in slaves]
        self._lengths = tuple(len(output) for output in self._outputs)
        self._with_inputs = tuple((i, slave) for i, slave in enumerate(slaves) if self._inputs[i])
        self._with_outputs = tuple((i, slave) for i, slave in enumerate(slaves) if self._outputs[i])
        self._several_frames = sum(map(len, self._inputs + self._outputs)) > _LARGEST_FRAME_DATA
        self._buffer = ctypes.create_string_buffer(1518)
        # SOEM sends frames again while it configures: their late answers are around at the start.
        self._doubtful = True
        self._blind = False
        self.dc_time = int(master.dc_time)

    def send(self) -> None:
        """Send the outputs that were set."""
        if self._doubtful:
            self._blind = not self._barrier.pass_through(self._barrier_ns)
            self.stale += drain(self._fd, self._buffer)
        outputs = self._outputs
        # All of them, each time: SOEM copies what comes back, also an older frame's outputs, over its image.
        for i, slave in self._with_outputs:
            slave.output = outputs[i]
        self._master.send_processdata()

    def receive(self) -> int:
        """Return the working counter of the answer, -1 where none came in time; then inputs and `dc_time` stay."""
        if self._blind:
            self.stale += drain(self._fd, self._buffer)
            # Only gives SOEM's buffer back; whatever it finds is not known to be new.
            self._master.receive_processdata(0)
            self._blind = False
            self.missed += 1
            return -1
        wkc = int(self._master.receive_processdata(self._receive_us))
        if wkc < 0:
            self._doubtful = True
            self.missed += 1
            return -1
        self._doubtful = self._several_frames and wkc != self.expected_wkc
        inputs = self._inputs
        for i, slave in self._with_inputs:
            inputs[i] = slave.input
        self.dc_time = self._master.dc_time
        return wkc

    def input(self, index: int) -> bytes:
        """Return the inputs of slave `index` of the last answer."""
        return self._inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of slave `index` for the next `send`; data of another length is not taken."""
        if len(data) == self._lengths[index]:
            self._outputs[index] = data


_INDEX = 0xF0
_NUMBER_AT: Final = 26
# PyDLL keeps the interpreter's lock: the cycle must not have to win it back from another thread after each poll.
_libc = ctypes.PyDLL(None)
_DONTWAIT = int(socket.MSG_DONTWAIT)


class FrameBarrier:
    """Numbered NOP frames (ETG.1000.4, 5.4.1: passed on by every slave, acted on by none). Used by the cycle only."""

    def __init__(self, interface: str) -> None:
        """Open its socket; raises BusError where the interface cannot be opened."""
        self._socket = open_socket(interface, _INDEX, _INDEX)
        self._socket.setblocking(False)
        self._fd = self._socket.fileno()
        self._frame = bytearray(build_frame(DatagramCommand.NOP, _INDEX, 0, 0, bytes(8)))
        self._out = (ctypes.c_char * len(self._frame)).from_buffer(self._frame)
        self._in = ctypes.create_string_buffer(1518)
        self._number = 0

    def pass_through(self, timeout_ns: int) -> bool:
        """Send the next number and poll for its return; return whether it came within `timeout_ns`."""
        deadline = time.monotonic_ns() + timeout_ns
        self._number += 1
        number = self._number.to_bytes(8, "little")
        self._frame[_NUMBER_AT : _NUMBER_AT + 8] = number
        if _libc.send(self._fd, self._out, len(self._frame), _DONTWAIT) < 0:
            return False
        while True:
            if _libc.recv(self._fd, self._in, 1518, _DONTWAIT) > 0:
                if self._in.raw[_NUMBER_AT : _NUMBER_AT + 8] == number:
                    return True
            elif time.monotonic_ns() >= deadline:
                return False

    def close(self) -> None:
        """Close its socket; may be called twice."""
        self._socket.close()


def drain(fd: int, buffer: ctypes.Array[ctypes.c_char]) -> int:
    """Read the frames that wait at packet socket `fd` into `buffer` until there is none; return how many there were."""
    count = 0
    while _libc.recv(fd, buffer, len(buffer), _DONTWAIT) > 0:
        count += 1
    return count
