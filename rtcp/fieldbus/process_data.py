"""The exchange of process data through SOEM: one frame a cycle; an old answer is never taken for a new one.

SOEM identifies a frame's answer by an index of 0 to 15 only: it takes an answer that is 16 cycles late for the current
one, and then in each cycle the next late one, for ever. Frames do not overtake one another on a segment, so once a
numbered NOP datagram is back, no older frame is under way.
"""

from __future__ import annotations

import ctypes
import socket
import time
from collections.abc import Sequence
from typing import Any, Final

from rtcp.fieldbus.image import Place, Places, image_memory, missing_counts
from rtcp.fieldbus.registers import DatagramCommand, Register, build_frame, open_socket

_LARGEST_FRAME_DATA: Final = 1466
"""Most process data of a frame with the clock's datagram, bytes (SOEM: EC_MAXLRWDATA - EC_FIRSTDCDATAGRAM)."""


class SoemProcessData:
    """ProcessData over a configured pysoem master. `receive` holds the interpreter and polls, at most `receive_us`.

    After an exchange without an answer the next `send` first waits for a barrier frame, drops all frames that came back
    before it and only then sends, so that the next answer is the new one. While the barrier frame does not come back,
    outputs are still sent (a drive that receives frames must get its targets), but answers are ignored.
    """

    def __init__(
        self,
        master: Any,
        slaves: Sequence[Any],
        places: Sequence[Places],
        socket_fd: int,
        barrier: FrameBarrier,
        receive_us: int,
        barrier_us: int,
        reference: ReferenceFrame | None = None,
    ) -> None:
        """Use the image of `slaves` (pysoem's), with all outputs 0.

        Args:
            master: pysoem's master after `config_map`.
            slaves: its slaves.
            places: places of their images.
            socket_fd: a duplicate of SOEM's packet socket, non-blocking.
            barrier: the frame barrier on the same interface.
            receive_us: longest wait for an answer, us.
            barrier_us: longest wait for the barrier frame, us.
            reference: sends the reference clock's time where SOEM's frames do not.
        """
        self.expected_wkc = int(master.expected_wkc) + missing_counts(places)
        self.missed = 0
        self.stale = 0
        self._master = master
        self._slaves = tuple(slaves)
        self._fd = socket_fd
        self._barrier = barrier
        self._reference = reference
        self._receive_us = receive_us
        self._barrier_ns = barrier_us * 1000
        self._inputs = [bytes(slave.input) for slave in slaves]
        self._outputs = [bytes(len(slave.output)) for slave in slaves]
        self._lengths = tuple(len(output) for output in self._outputs)
        each = tuple(enumerate(zip(slaves, places, strict=True)))
        self._with_inputs = tuple((i, s) for i, (s, at) in each if self._inputs[i] and not at.inputs.is_small)
        self._with_outputs = tuple((i, s) for i, (s, at) in each if self._outputs[i] and not at.outputs.is_small)
        small_inputs = [(i, at.inputs) for i, (_, at) in each if at.inputs.is_small]
        small_outputs = [(i, at.outputs) for i, (_, at) in each if at.outputs.is_small]
        self._small = (
            SmallImages(image_memory(master), small_outputs, small_inputs) if (small_inputs or small_outputs) else None
        )
        self._several_frames = sum(map(len, self._inputs + self._outputs)) > _LARGEST_FRAME_DATA
        self._buffer = ctypes.create_string_buffer(1518)
        # SOEM repeats frames while it configures, so late answers may arrive at the start.
        self._doubtful = True
        self._blind = False
        self.dc_time = int(master.dc_time)

    def send(self) -> None:
        """Send the outputs; after a lost answer a barrier frame first."""
        if self._doubtful:
            self._blind = not self._barrier.pass_through(self._barrier_ns)
            self.stale += drain(self._fd, self._buffer)
        outputs = self._outputs
        # All outputs each time: SOEM overwrites its image with every frame that comes back, also an older one.
        for i, slave in self._with_outputs:
            slave.output = outputs[i]
        if self._small is not None:
            self._small.write(outputs)
        if self._reference is not None:
            self._reference.send()
        self._master.send_processdata()

    def receive(self) -> int:
        """Return the working counter of the answer, -1: none in time; inputs and `dc_time` then stay."""
        if self._blind:
            self.stale += drain(self._fd, self._buffer)
            # Only returns SOEM's buffer; a frame that it finds may be old.
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
        if self._small is not None:
            self._small.read(inputs)
        self.dc_time = self._master.dc_time if self._reference is None else self._reference.time_of_answer()
        return wkc

    def input(self, index: int) -> bytes:
        """Return the inputs of slave `index` of the last answer."""
        return self._inputs[index]

    def set_output(self, index: int, data: bytes) -> None:
        """Set the outputs of slave `index` for the next `send`; data of another length is ignored."""
        if len(data) == self._lengths[index]:
            self._outputs[index] = data


class SmallImages:
    """Images of 1 to 7 bits, which share bytes with others, in the order of the cable."""

    def __init__(
        self, image: memoryview, outputs: Sequence[tuple[int, Place]], inputs: Sequence[tuple[int, Place]]
    ) -> None:
        """Use the process image, and index and place of each slave with such an image."""
        self._image = image
        self._reads = tuple(
            (i, slice(place.first // 8, (place.first + place.bits + 7) // 8), place.first % 8, (1 << place.bits) - 1)
            for i, place in inputs
        )
        # Runs of bytes that are written at once, with the bits of each slave that shares them.
        runs: list[tuple[int, int, list[tuple[int, int, int]]]] = []
        for i, place in sorted(outputs, key=lambda output: output[1].first):
            begin, end = place.first // 8, (place.first + place.bits + 7) // 8
            if not runs or begin >= runs[-1][1]:
                runs.append((begin, end, []))
            begin, last, members = runs[-1]
            members.append((i, place.first - 8 * begin, (1 << place.bits) - 1))
            runs[-1] = (begin, max(last, end), members)
        self._writes = tuple((slice(begin, end), end - begin, tuple(members)) for begin, end, members in runs)

    def write(self, outputs: Sequence[bytes]) -> None:
        """Write the bits of each slave's outputs; bits of other slaves stay."""
        for where, length, members in self._writes:
            value = 0
            for i, shift, mask in members:
                value |= (outputs[i][0] & mask) << shift
            self._image[where] = value.to_bytes(length, "little")

    def read(self, inputs: list[bytes]) -> None:
        """Read each slave's inputs."""
        for i, where, shift, mask in self._reads:
            inputs[i] = _BYTES[int.from_bytes(self._image[where], "little") >> shift & mask]


_BYTES: Final = tuple(bytes((value,)) for value in range(256))
_INDEX = 0xF0
_INDEX_AT: Final = 17
_NUMBER_AT: Final = 26
_COUNTER_AT: Final = 34
"""Working counter behind 8 bytes of data."""
# PyDLL keeps the interpreter's lock, so that the cycle need not regain it from another thread after each poll.
_libc = ctypes.PyDLL(None)
_DONTWAIT = int(socket.MSG_DONTWAIT)


class FrameBarrier:
    """Numbered NOP frames, which slaves forward without effect (ETG.1000.4, 5.4.1). Used by the cycle only."""

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
        """Send the next number and poll for its return; return whether it came back within `timeout_ns`."""
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


_FIRST_INDEX, _LAST_INDEX = 0xF1, 0xFF


class ReferenceFrame:
    """A frame each cycle that brings the time of the reference clock to all other clocks (ETG.1000.4, 5.4: FRMW).

    SOEM's own datagram for this always names the first slave that measures delays, even where its clock cannot be set.
    """

    def __init__(self, interface: str, station: int) -> None:
        """Open the socket; raises BusError where the interface cannot be opened. `station`: the reference clock's."""
        self._socket = open_socket(interface, _FIRST_INDEX, _LAST_INDEX)
        self._socket.setblocking(False)
        self._fd = self._socket.fileno()
        self._frame = bytearray(
            build_frame(DatagramCommand.FRMW, _FIRST_INDEX, station, Register.DC_SYSTEM_TIME, bytes(8))
        )
        self._out = (ctypes.c_char * len(self._frame)).from_buffer(self._frame)
        self._answer = bytearray(1518)
        self._in = (ctypes.c_char * len(self._answer)).from_buffer(self._answer)
        self._index = _FIRST_INDEX
        self._time = 0

    def send(self) -> None:
        """Send the frame, before that of the process data: it is back before that one."""
        self._index = _FIRST_INDEX if self._index == _LAST_INDEX else self._index + 1
        self._frame[_INDEX_AT] = self._index
        _libc.send(self._fd, self._out, len(self._frame), _DONTWAIT)

    def time_of_answer(self) -> int:
        """Return the time that the last frame brought back; where the reference did not answer, the one before."""
        answer = self._answer
        while _libc.recv(self._fd, self._in, len(answer), _DONTWAIT) > 0:
            # Late answers carry an older index.
            if answer[_INDEX_AT] == self._index and answer[_COUNTER_AT]:
                time_bytes = answer[_NUMBER_AT:_COUNTER_AT]
                self._time = int.from_bytes(time_bytes, "little")
                # As in SOEM: without the reference the other clocks get its last time.
                self._frame[_NUMBER_AT:_COUNTER_AT] = time_bytes
        return self._time

    def close(self) -> None:
        """Close its socket; may be called twice."""
        self._socket.close()


def drain(fd: int, buffer: ctypes.Array[ctypes.c_char]) -> int:
    """Read and drop all waiting frames of packet socket `fd`; return their number."""
    count = 0
    while _libc.recv(fd, buffer, len(buffer), _DONTWAIT) > 0:
        count += 1
    return count
