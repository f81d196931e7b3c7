"""A frame that tells when everything sent before it has come back or is lost.

SOEM knows a frame's answer by an index of 0 to 15 only: an answer that is 16 cycles late is taken for the current one,
and the cycles after it each take the next late one, for ever. Frames do not overtake one another on a segment, so once
a NOP datagram with a number of its own is back, no older frame is under way any more.
"""

from __future__ import annotations

import ctypes
import socket
import time

from rtcp.fieldbus.registers import Command, build_frame, open_socket

_INDEX = 0xF0
_NUMBER_AT = 26
# PyDLL keeps the interpreter's lock: the cycle must not have to win it back from another thread after each poll.
_libc = ctypes.PyDLL(None)
_DONTWAIT = int(socket.MSG_DONTWAIT)


class Fence:
    """Numbered NOP frames (ETG.1000.4, 5.4.1: passed on by every slave, acted on by none). Used by the cycle only."""

    def __init__(self, interface: str) -> None:
        """Open its socket; raises BusError where the interface cannot be opened."""
        self._socket = open_socket(interface, _INDEX, _INDEX)
        self._socket.setblocking(False)
        self._fd = self._socket.fileno()
        self._frame = bytearray(build_frame(Command.NOP, _INDEX, 0, 0, bytes(8)))
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
