"""The shipped segment in simulated time, and the start-up of a sane master: raw frames, the standard's registers."""

from __future__ import annotations

import struct

from rtcp.config.segment import load_segment
from rtcp.virtual.protocol import DatagramCommand
from rtcp.virtual.segment import make_segment
from rtcp.virtual.server import BUFFER
from tests.malformed.cable import CONFIG
from tests.virtual.frames import Datagram, build, parse

STATION = 0x1001
INIT, PRE_OP, SAFE_OP, OP, ACK = 1, 2, 4, 8, 0x10
FRAME_NS = 100_000
PERIOD_NS = 1_000_000
MOST_TICKS = 500
"""Most steps of the segment between two frames; more would delay the next answer."""
SIZES = ((2, 6), *((15, 15),) * 6)
"""Bytes of outputs and inputs of each slave."""
RX = (0x60400010, 0x607A0020, 0x60FF0020, 0x60710020, 0x60600008)
TX = (0x60410010, 0x60640020, 0x606C0020, 0x60770020, 0x60610008)
_SM_MAILBOXES = bytes.fromhex("0010 8000 26 00 01 00  8010 8000 22 00 01 00")
_SDO = struct.Struct("<HHBBHBHBI")
_DRIVE = struct.Struct("<HiiiB")
_UNITS = 8
"""FMMUs, and sync managers, of a slave."""
_IMAGE_OUT = sum(out for out, _ in SIZES)
_IMAGE_IN = sum(in_ for _, in_ in SIZES)


class Line:
    """A segment in simulated time, and the steps of a sane master."""

    def __init__(self) -> None:
        self.now = 1_000_000_000
        self.segment = make_segment(load_segment(CONFIG), self.now)
        self.buffer = bytearray(BUFFER)
        self._counter = 0

    @property
    def states(self) -> list[int]:
        """AL status of each slave, error bit included."""
        return [slave.esc.memory[0x0130] for slave in self.segment.slaves]

    def targets(self) -> list[bytes]:
        """Present outputs of each slave."""
        return [bytes(slave.esc.sync_managers[2].buffer) for slave in self.segment.slaves]

    def give(self, frame: bytes | bytearray, after: int = FRAME_NS) -> bytes | None:
        """Send the segment a frame as its server does; return the answer, None without one."""
        self.pass_time(after)
        size = len(frame)
        self.buffer[:size] = frame
        answer = bytes(self.buffer[:size]) if self.segment.process(self.buffer, size, self.now) else None
        if answer is not None:
            self.segment.settle(self.now)
        return answer

    def pass_time(self, ns: int) -> None:
        """Let time pass: run every event at its instant, and step every device that is due."""
        segment, until = self.segment, self.now + ns
        turns = 0
        while segment.next_event <= until:
            turns += 1
            assert turns < MOST_TICKS * (1 + ns // 1_000_000), "the segment looks at itself without end"
            self.now = max(self.now, segment.next_event)
            segment.tick(self.now)
        self.now = until
        while segment.busy:
            segment.step_one()

    # -- a sane master ----------------------------------------------------------------------------------------------

    def ask(self, command: DatagramCommand, address: int, offset: int, data: bytes) -> Datagram:
        answer = self.give(build(Datagram(command, 0, address, offset, data)))
        assert answer is not None
        return next(parse(answer))

    def write_all(self, offset: int, data: bytes) -> None:
        assert self.ask(DatagramCommand.BWR, 0, offset, data).counter == len(SIZES), hex(offset)

    def write(self, slave: int, offset: int, data: bytes) -> None:
        assert self.ask(DatagramCommand.FPWR, STATION + slave, offset, data).counter == 1, (slave, hex(offset))

    def read(self, slave: int, offset: int, length: int) -> bytes:
        answer = self.ask(DatagramCommand.FPRD, STATION + slave, offset, bytes(length))
        assert answer.counter == 1, (slave, hex(offset))
        return answer.data

    def request(self, state: int) -> None:
        """Request a state of all slaves; assert that they reach it."""
        self.write_all(0x0120, bytes((state, 0)))
        for _ in range(100):
            if self.states == [state & ~ACK] * len(SIZES):
                return
            self.exchange()
        codes = [self.read(slave, 0x0130, 6).hex(" ") for slave in range(len(SIZES))]
        raise AssertionError(f"the slaves do not go to {state}: {codes}")

    def download(self, slave: int, index: int, subindex: int, value: int, size: int) -> None:
        """Write an object, expedited; assert that it is accepted."""
        self._counter = self._counter % 7 + 1
        command = 0x23 | (4 - size) << 2
        message = _SDO.pack(10, 0, 0, self._counter << 4 | 3, 2 << 12, command, index, subindex, value)
        self.write(slave, 0x1000, message.ljust(128, b"\0"))
        for _ in range(20):
            if self.read(slave, 0x080D, 1)[0] & 0x08:
                answer = self.read(slave, 0x1080, 128)
                if answer[7] >> 4 in (2, 3):
                    assert answer[8] == 0x60, (slave, hex(index), subindex, answer[:16].hex(" "))
                    return
        raise AssertionError(f"slave {slave} does not answer the download of 0x{index:04X}:{subindex}")

    def reset(self) -> None:
        """The first steps of SOEM: INIT, and all settings of the last master cleared."""
        topology = self.segment.topology
        if len(topology.reached) < len(SIZES) or not topology.returns:
            # A mutated frame closed or opened a port: no frame of a master opens port 0 again, the supply does.
            for slave in self.segment.slaves:
                topology.restart(slave, self.now)
            self.segment.rewire()
        self.write_all(0x0120, bytes((INIT | ACK, 0)))
        for offset, data in (
            (0x0103, bytes(1)), (0x0200, bytes(2)), (0x0300, bytes(8)), (0x0600, bytes(16 * _UNITS)),
            *((0x0806 + 8 * unit, bytes(1)) for unit in range(_UNITS)), (0x0800, bytes(8 * _UNITS)),
            (0x0400, (2498).to_bytes(2, "little")), (0x0420, (1000).to_bytes(2, "little")), (0x0500, b"\x02\x00"),
            (0x0500, b"\x00\x00"), (0x0981, bytes(1)), (0x0920, bytes(12)), (0x0930, b"\x00\x10"),
        ):  # fmt: skip
            self.write_all(offset, data)
        for position in range(len(SIZES)):
            station = (STATION + position).to_bytes(2, "little")
            assert self.ask(DatagramCommand.APWR, -position & 0xFFFF, 0x0010, station).counter == 1
        self.request(INIT | ACK)

    def start(self, state: int) -> None:
        """Bring all slaves from any state to `state`."""
        self.reset()
        if state == INIT:
            return
        for slave in range(len(SIZES)):
            self.write(slave, 0x0800, _SM_MAILBOXES)
        self.request(PRE_OP)
        for slave in range(1, len(SIZES)):
            for assignment, mapping, entries in ((0x1C12, 0x1600, RX), (0x1C13, 0x1A00, TX)):
                self.download(slave, assignment, 0, 0, 1)
                self.download(slave, mapping, 0, 0, 1)
                for place, entry in enumerate(entries, 1):
                    self.download(slave, mapping, place, entry, 4)
                self.download(slave, mapping, 0, len(entries), 1)
                self.download(slave, assignment, 1, mapping, 2)
                self.download(slave, assignment, 0, 1, 1)
            self.download(slave, 0x10F1, 2, 4, 2)
        if state == PRE_OP:
            return
        self._process_data()
        self.request(SAFE_OP)
        if state == OP:
            self.request(OP)
            assert self.exchange() == 3 * len(SIZES)

    def _process_data(self) -> None:
        """Sync managers 2 and 3, FMMUs (outputs from logical 0 on, then inputs), SYNC0 of the drives."""
        out = 0
        in_ = _IMAGE_OUT
        for slave, (outputs, inputs) in enumerate(SIZES):
            self.write(slave, 0x0810, struct.pack("<HHBBBB", 0x1100, outputs, 0x64, 0, 1, 0))
            self.write(slave, 0x0818, struct.pack("<HHBBBB", 0x1400, inputs, 0x20, 0, 1, 0))
            self.write(slave, 0x0600, struct.pack("<IHBBHBBB3x", out, outputs, 0, 7, 0x1100, 0, 2, 1))
            self.write(slave, 0x0610, struct.pack("<IHBBHBBB3x", in_, inputs, 0, 7, 0x1400, 0, 1, 1))
            out += outputs
            in_ += inputs
            if slave:
                start = int.from_bytes(self.read(slave, 0x0910, 8), "little") + 30 * PERIOD_NS
                self.write(slave, 0x0990, (start & (1 << 64) - 1).to_bytes(8, "little"))
                self.write(slave, 0x09A0, PERIOD_NS.to_bytes(4, "little"))
                self.write(slave, 0x0981, b"\x03")

    def exchange(self, controlword: int = 6, target: int = 0) -> int:
        """One LRW, a period after the last; return its working counter."""
        drive = _DRIVE.pack(controlword, target, 20_000, 0, 8)
        data = bytes(SIZES[0][0]) + drive * (len(SIZES) - 1) + bytes(_IMAGE_IN)
        answer = self.give(build(Datagram(DatagramCommand.LRW, 0, 0, 0, data)), PERIOD_NS)
        assert (answer is not None) == (self.segment.topology.returns and bool(self.segment.topology.reached))
        return next(parse(answer)).counter if answer else 0
