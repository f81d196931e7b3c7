"""Registers of the slaves, read and written outside the cycle through a separate socket.

SOEM's functions hold the interpreter while they wait for a frame; these do not. Datagram indices from 0x80 up
distinguish these frames from SOEM's, which uses 0 to 15 (EC_MAXBUF); a filter in the kernel gives each socket its own
answers only. Frames: ETG.1000.4, 5.4 and 5.5.
"""

from __future__ import annotations

import ctypes
import socket
import struct
import threading
import time
from collections.abc import Generator, Sequence
from enum import IntEnum
from typing import NamedTuple, TypeVar

from rtcp.fieldbus.errors import BusError

ETHERTYPE = 0x88A4
FIRST_INDEX, LAST_INDEX = 0x80, 0xEF
"""Datagram indices of this port; the frames beside the process data use those above."""
_COMMAND_AT, _INDEX_AT, _STATION_AT, _ADDRESS_AT, _LENGTH_AT = 16, 17, 18, 20, 22
_LENGTH_MASK = 0x07FF
_DATA_AT = 26
_SMALLEST_FRAME = 60
_SO_ATTACH_FILTER = 26
_HEADER = struct.Struct("<6s6s2sHBBHHHH")
SOURCE = bytes((0x02, 0, 0, 0x52, 0x54, 0x43))


class DatagramCommand(IntEnum):
    """EtherCAT commands used here (ETG.1000.4, 5.4)."""

    NOP = 0
    APRD = 1
    APWR = 2
    FPRD = 4
    FPWR = 5
    BRD = 7
    BWR = 8
    FRMW = 14


class Register(IntEnum):
    """Addresses of the registers used here (ETG.1000.4, clause 6)."""

    FMMU_COUNT = 0x0004
    FEATURES = 0x0008
    STATION_ADDRESS = 0x0010
    STATION_ALIAS = 0x0012
    DL_STATUS = 0x0110
    AL_CONTROL = 0x0120
    AL_STATUS = 0x0130
    """AL status (2 bytes), two reserved bytes, AL status code (2 bytes)."""
    ESC_CONFIGURATION = 0x0141
    ERROR_COUNTERS = 0x0300
    WATCHDOG_DIVIDER = 0x0400
    WATCHDOG_PROCESS_DATA = 0x0420
    EEPROM_CONFIG = 0x0500
    EEPROM_CONTROL = 0x0502
    EEPROM_DATA = 0x0508
    FMMU = 0x0600
    SYNC_MANAGER = 0x0800
    DC_PORT_RECEIVE_TIMES = 0x0900
    """A write latches the local time here and in DC_RECEIVE_TIME, in every slave that the frame passes."""
    DC_SYSTEM_TIME = 0x0910
    DC_RECEIVE_TIME = 0x0918
    """Local time at which the processing unit received the latching frame, ns."""
    DC_OFFSET = 0x0920
    DC_DELAY = 0x0928
    """Propagation delay from the reference clock, ns."""
    DC_DIFFERENCE = 0x092C
    DC_SPEED = 0x0930
    DC_CYCLIC_UNIT = 0x0980
    DC_ACTIVATION = 0x0981
    """Bit 0 cyclic operation, bit 1 SYNC0, bit 2 SYNC1."""
    DC_START = 0x0990
    DC_SYNC0_CYCLE = 0x09A0
    """Cycle of SYNC0, 4 bytes, ns; the 4 bytes of SYNC1 follow."""


DEVICE_EMULATION = 0x01
"""Bit of ESC_CONFIGURATION: AL status is a copy of AL control."""
FEATURE_DC = 0x04
"""Bit of FEATURES: the slave has a distributed clock."""
_ANSWER_S = 0.02
TRIES, PATIENT_TRIES = 3, 25
"""Attempts for a datagram: beside the cycle, for a quick answer, and before it, for half a second, which is longer than
a shared host's stall."""
_BY_STATION = (DatagramCommand.FPRD, DatagramCommand.FPWR)
_NOT_TAKEN = "{label} did not take what was written to register 0x{address:04X}"


class Answer(NamedTuple):
    """Returned data and working counter; -1: no frame came back."""

    data: bytes
    wkc: int


def build_frame(command: DatagramCommand, index: int, station: int, address: int, data: bytes) -> bytes:
    """Return an Ethernet frame with one datagram."""
    header = _HEADER.pack(
        b"\xff" * 6, SOURCE, ETHERTYPE.to_bytes(2, "big"), 0x1000 | (12 + len(data)),
        command, index, station, address, len(data), 0,
    )  # fmt: skip
    return (header + data + b"\0\0").ljust(_SMALLEST_FRAME, b"\0")


def open_socket(interface: str, first: int, last: int) -> socket.socket:
    """Return a packet socket that receives only EtherCAT frames whose first datagram's index is in `first`..`last`.

    Raises:
        BusError: no such interface, or no permission for raw sockets.
    """
    try:
        port = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError as error:
        raise BusError(f"a raw socket on {interface} needs the capability CAP_NET_RAW (or root): {error}") from error
    try:
        attach_filter(port, first, last)
        # Bind last: with protocol 0 the socket receives nothing before its filter is attached.
        port.bind((interface, ETHERTYPE))
    except OSError as error:
        port.close()
        raise BusError(f"interface {interface} cannot be opened: {error.strerror}") from error
    return port


def attach_filter(port: socket.socket, first: int, last: int) -> None:
    """Limit packet socket `port` to frames whose first datagram's index is in `first`..`last`."""
    # Classic BPF: A = byte 17; below `first` or above `last`: drop; else accept.
    lines = ((0x30, 0, 0, _INDEX_AT), (0x35, 0, 2, first), (0x25, 1, 0, last), (0x06, 0, 0, 0xFFFF), (0x06, 0, 0, 0))
    attach_program(port, lines)


def attach_program(port: socket.socket, lines: Sequence[tuple[int, int, int, int]]) -> None:
    """Filter the frames of packet socket `port` by a program of classic BPF: operation, two jumps, constant."""
    program = b"".join(struct.pack("=HBBI", *line) for line in lines)
    buffer = ctypes.create_string_buffer(program, len(program))
    port.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(lines), ctypes.addressof(buffer)))


def _answers(frame: bytes, sent: bytes, length: int) -> bool:
    """Whether `frame` is the answer to `sent`. Indices are reused soon, so more than the index is compared."""
    if len(frame) < _DATA_AT + length + 2 or frame[_COMMAND_AT:_STATION_AT] != sent[_COMMAND_AT:_STATION_AT]:
        return False
    # Each slave increments the station field of auto-increment and broadcast commands.
    kept = _STATION_AT if sent[_COMMAND_AT] in _BY_STATION else _ADDRESS_AT
    if frame[kept:_LENGTH_AT] != sent[kept:_LENGTH_AT]:
        return False
    return int.from_bytes(frame[_LENGTH_AT : _LENGTH_AT + 2], "little") & _LENGTH_MASK == length


class RegisterPort:
    """Sends single datagrams to one slave or to all. Its methods may be called from any thread."""

    tries = TRIES
    """Default number of attempts for a datagram; after that the slave counts as not answering."""

    def __init__(self, interface: str) -> None:
        """Open the port; raises BusError where the interface cannot be opened."""
        self._socket = open_socket(interface, FIRST_INDEX, LAST_INDEX)
        self._lock = threading.Lock()
        self._index = LAST_INDEX

    def exchange(
        self,
        command: DatagramCommand,
        station: int,
        address: int,
        data: bytes,
        *,
        timeout_s: float = _ANSWER_S,
        tries: int | None = None,
    ) -> Answer:
        """Send a datagram and wait for its return; repeat a lost frame, `tries` attempts in all."""
        with self._lock:
            for _ in range(self.tries if tries is None else tries):
                # A new index each time distinguishes a late answer to the former attempt.
                self._index = FIRST_INDEX if self._index >= LAST_INDEX else self._index + 1
                frame = build_frame(command, self._index, station, address, data)
                try:
                    self._socket.send(frame)
                    answer = self._wait(frame, len(data), time.monotonic() + timeout_s)
                except OSError as error:
                    raise BusError(f"the interface does not take frames any more: {error.strerror}") from error
                if answer is not None:
                    return answer
        return Answer(b"", -1)

    def _wait(self, sent: bytes, length: int, deadline: float) -> Answer | None:
        while (left := deadline - time.monotonic()) > 0:
            self._socket.settimeout(left)
            try:
                frame = self._socket.recv(1518)
            except TimeoutError:
                return None
            if _answers(frame, sent, length):
                end = _DATA_AT + length
                return Answer(frame[_DATA_AT:end], int.from_bytes(frame[end : end + 2], "little"))
        return None

    @property
    def patience_s(self) -> float:
        """Time for which a service of several datagrams is repeated, s; 0 beside the cycle."""
        return (self.tries - TRIES) * _ANSWER_S

    def read(self, station: int, address: int, length: int, *, tries: int | None = None) -> bytes | None:
        """Return registers of the slave at configured address `station` (FPRD), None where it does not answer."""
        tries = self.tries if tries is None else tries
        data, wkc = self.exchange(DatagramCommand.FPRD, station, address, bytes(length), tries=tries)
        return data if wkc == 1 else None

    def write(self, station: int, address: int, data: bytes) -> bool:
        """Write registers of the slave at configured address `station` (FPWR); return whether it did."""
        return self.exchange(DatagramCommand.FPWR, station, address, data).wkc == 1

    def put(self, station: int, address: int, data: bytes, label: str) -> None:
        """Do `write`; raise BusError where that fails; `label`: the slave in the message."""
        if not self.write(station, address, data):
            raise BusError(_NOT_TAKEN.format(label=label, address=address))

    def read_at(self, position: int, address: int, length: int) -> bytes | None:
        """Return registers of the slave at `position` on the cable (APRD), which works without a station address."""
        data, wkc = self.exchange(DatagramCommand.APRD, 1 - position & 0xFFFF, address, bytes(length))
        return data if wkc == 1 else None

    def write_at(self, position: int, address: int, data: bytes) -> bool:
        """Write registers of the slave at `position` on the cable (APWR); return whether it did."""
        return self.exchange(DatagramCommand.APWR, 1 - position & 0xFFFF, address, data).wkc == 1

    def read_all(self, address: int, length: int) -> Answer:
        """Read registers of all slaves (BRD): OR of their data, and their number as working counter."""
        return self.exchange(DatagramCommand.BRD, 0, address, bytes(length))

    def write_all(self, address: int, data: bytes) -> int:
        """Write registers of all slaves (BWR); return the working counter, -1 where no frame came back."""
        return self.exchange(DatagramCommand.BWR, 0, address, data).wkc

    def close(self) -> None:
        """Close the port; may be called twice."""
        self._socket.close()


T = TypeVar("T")
Steps = Generator[None, None, T]
_POLL_S = 0.0002


def finish(steps: Steps[T]) -> T:
    """Run all steps, with sleeps between them; return their result or raise their exception."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
        time.sleep(_POLL_S)


def pause(seconds: float) -> Steps[None]:
    """Yield until this time has passed."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        yield
