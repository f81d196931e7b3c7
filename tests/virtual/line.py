"""A segment in simulated time, and a minimal master with hand-written datagrams."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rtcp.virtual.device import DeviceModel
from rtcp.virtual.faults.fault import Fault, Frames
from rtcp.virtual.faults.registry import ActiveFault, Planned
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary
from rtcp.virtual.pdo import define_pdo_objects
from rtcp.virtual.protocol import DatagramCommand
from rtcp.virtual.segment import Connection, Segment
from rtcp.virtual.slave import make_slaves
from tests.virtual.frames import Datagram, build, parse

STATION = 0x1001
MS = 1_000_000
INIT, PRE_OP, BOOT, SAFE_OP, OP, ACK, ERROR = 1, 2, 3, 4, 8, 0x10, 0x10
SM_MAILBOXES = bytes.fromhex("0010 8000 26 00 01 00  8010 8000 22 00 01 00")
SM_OUTPUTS = bytes.fromhex("0011 0200 64 00 01 00")
SM_INPUTS = bytes.fromhex("0014 0200 20 00 01 00")


class TinyDevice(DeviceModel):
    """Two bytes each way: the input is the output plus one; `sync_limit` adds object 0x10F1:02."""

    vendor_id, product_code, revision, name, group, order_code = 0x0BAD, 0xCAFE, 1, "Tiny", "Tests", "T1"

    def __init__(self, supports_dc: bool = True, sync_limit: int | None = None, fixed: bool = False,
                 **options: object) -> None:  # fmt: skip
        self._sync_limit, self._fixed = sync_limit, fixed
        self.valid: list[bool] = []
        self.passed = 0.0
        self.steps = 0
        super().__init__(serial=7, **options)
        self.supports_dc = supports_dc

    def define(self, objects: ObjectDictionary) -> None:
        word = DataType.UNSIGNED16
        self.out = Entry(0x7000, 1, "Out", word, 0, Access.RW | Access.RXPDO)
        self.in_ = Entry(0x6000, 1, "In", word, 0, Access.RO | Access.TXPDO)
        objects.record(0x7000, "Outputs", [self.out])
        objects.record(0x6000, "Inputs", [self.in_])
        if self._sync_limit is not None:
            limit = Entry(0x10F1, 2, "Sync error counter limit", word, self._sync_limit, Access.RW)
            objects.record(0x10F1, "Error settings", [Entry(0x10F1, 1, "Reaction", word), limit])
        define_pdo_objects(objects, {0x1600: [(0x7000, 1, 16)]}, {0x1A00: [(0x6000, 1, 16)]},
                           [0x1600], [0x1A00], self._fixed)  # fmt: skip

    def step(self, dt: float) -> None:
        self.passed += dt
        self.steps += 1
        self.in_.value = (int(self.out.value) + 1) & 0xFFFF

    def set_outputs_valid(self, valid: bool) -> None:
        super().set_outputs_valid(valid)
        self.valid.append(valid)
        if not valid:
            self.out.value = 0


class Line:
    """The segment, its devices and the time."""

    def __init__(self, devices: Sequence[DeviceModel] | None = None, drifts: Sequence[float] | None = None,
                 delays: Sequence[int] | None = None, aliases: Sequence[int] | None = None,
                 clock_bits: Sequence[int] = (), connections: Sequence[Connection] | None = None) -> None:  # fmt: skip
        self.devices: list[DeviceModel] = [TinyDevice() for _ in range(3)] if devices is None else list(devices)
        count = len(self.devices)
        self.now = 50 * MS
        self.slaves = make_slaves(
            self.devices, drifts or [0.0] * count, delays or [820 * n for n in range(count)], aliases or [0] * count,
            self.now, clock_bits,
        )  # fmt: skip
        self.segment = Segment(self.slaves, self.now, connections)

    @property
    def tiny(self) -> list[TinyDevice]:
        """The tiny devices among them, in order."""
        return [device for device in self.devices if isinstance(device, TinyDevice)]

    def pass_time(self, ns: int) -> None:
        """Advance time; each event runs at its instant."""
        until = self.now + ns
        while self.segment.next_event <= until:
            self.now = max(self.now, self.segment.next_event)
            self.segment.tick(self.now)
            self._step()
        self.now = until

    def _step(self) -> None:
        while self.segment.busy:
            self.segment.step_one()

    def raw(self, frame: bytes) -> bytes | None:
        """Send a frame unchanged; return it as it comes back, None if it is lost."""
        buffer = bytearray(frame)
        answered = self.segment.process(buffer, len(frame), self.now)
        self.segment.settle(self.now)
        self._step()
        return bytes(buffer) if answered else None

    def send(self, *datagrams: Datagram, after: int = 100_000) -> list[Datagram]:
        self.pass_time(after)
        answer = self.raw(build(*datagrams))
        return list(parse(answer))

    def one(self, command: DatagramCommand, address: int, offset: int, data: bytes) -> Datagram:
        return self.send(Datagram(command, 0, address, offset, data))[0]

    def logical(self, command: DatagramCommand, address: int, data: bytes) -> Datagram:
        return self.one(command, address & 0xFFFF, address >> 16, data)

    def read(self, slave: int, offset: int, length: int) -> bytes:
        """FPRD from slave number `slave`, counted from 0."""
        answer = self.one(DatagramCommand.FPRD, STATION + slave, offset, bytes(length))
        assert answer.counter == 1
        return answer.data

    def write(self, slave: int, offset: int, data: bytes) -> None:
        assert self.one(DatagramCommand.FPWR, STATION + slave, offset, data).counter == 1

    def number(self, slave: int, offset: int, length: int) -> int:
        return int.from_bytes(self.read(slave, offset, length), "little")

    def request(self, slave: int, state: int) -> tuple[int, int]:
        """Write AL control, return AL status and AL status code."""
        self.write(slave, 0x0120, state.to_bytes(2, "little"))
        return self.al(slave)

    def al(self, slave: int) -> tuple[int, int]:
        raw = self.read(slave, 0x0130, 6)
        return int.from_bytes(raw[0:2], "little"), int.from_bytes(raw[4:6], "little")

    def address(self) -> None:
        for number in range(len(self.devices)):
            station = (STATION + number).to_bytes(2, "little")
            assert self.one(DatagramCommand.APWR, -number & 0xFFFF, 0x0010, station).counter == 1

    def to_pre_op(self) -> None:
        self.address()
        for number in range(len(self.devices)):
            self.write(number, 0x0800, SM_MAILBOXES)
            assert self.request(number, PRE_OP) == (PRE_OP, 0)

    def configure_process_data(self) -> None:
        """SM2, SM3 and FMMUs: all outputs from logical 0 on, then all inputs, two bytes a slave."""
        count = len(self.devices)
        for number in range(count):
            self.write(number, 0x0810, SM_OUTPUTS)
            self.write(number, 0x0818, SM_INPUTS)
            self.write(number, 0x0600, fmmu(2 * number, 2, 0x1100, write=True))
            self.write(number, 0x0610, fmmu(2 * count + 2 * number, 2, 0x1400, write=False))

    def to_safe_op(self) -> None:
        self.to_pre_op()
        self.configure_process_data()
        for number in range(len(self.devices)):
            assert self.request(number, SAFE_OP) == (SAFE_OP, 0)

    def exchange(self, *outputs: int, after: int = MS) -> tuple[list[int], int]:
        """One LRW with the outputs; return the inputs and the working counter."""
        count = len(self.devices)
        values = list(outputs) + [0] * (count - len(outputs))
        data = b"".join(value.to_bytes(2, "little") for value in values) + bytes(2 * count)
        answer = self.send(Datagram(DatagramCommand.LRW, 0, 0, 0, data), after=after)[0]
        inputs = answer.data[2 * count :]
        return [int.from_bytes(inputs[2 * n : 2 * n + 2], "little") for n in range(count)], answer.counter

    def to_op(self) -> None:
        self.to_safe_op()
        for number in range(len(self.devices)):
            self.write(number, 0x0120, OP.to_bytes(2, "little"))
        self.exchange()
        assert [self.al(number) for number in range(len(self.devices))] == [(OP, 0)] * len(self.devices)


def in_op(count: int = 4, **line: Any) -> Line:
    """Tiny devices in OP."""
    made = Line([TinyDevice() for _ in range(count)], **line)
    made.to_op()
    return made


def fmmu(logical: int, length: int, physical: int, *, write: bool, start_bit: int = 0, end_bit: int = 7,
         physical_bit: int = 0) -> bytes:  # fmt: skip
    """The 16 bytes of an FMMU."""
    return (
        logical.to_bytes(4, "little") + length.to_bytes(2, "little") + bytes((start_bit, end_bit))
        + physical.to_bytes(2, "little") + bytes((physical_bit, 2 if write else 1, 1, 0, 0, 0))
    )  # fmt: skip


def start_sync0(line: Line, slave: int, cycle: int, first_in: int = 10 * MS) -> None:
    """Start SYNC0 on a slave `first_in` ns from now."""
    now = line.number(slave, 0x0910, 8)
    line.write(slave, 0x0990, (now + first_in).to_bytes(8, "little"))
    line.write(slave, 0x09A0, cycle.to_bytes(4, "little"))
    line.write(slave, 0x0981, b"\x03")


def by_sync0(device: TinyDevice, cycle: int = MS) -> Line:
    """One slave in OP whose SYNC0 comes half a cycle after each frame."""
    line = Line([device])
    line.to_pre_op()
    line.configure_process_data()
    start_sync0(line, 0, cycle, first_in=50 * MS)
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)
    due = line.slaves[0].esc.dc.sync0.due
    line.pass_time((due - line.now) % cycle + cycle // 2)
    line.write(0, 0x0120, b"\x08\x00")
    line.pass_time(cycle - 100_000)
    for _ in range(100):
        line.exchange(1, after=cycle)
    assert line.slaves[0].application.state == OP
    return line


def begin(segment: Segment, fault: Fault, t: int, lasts: float | None = None) -> ActiveFault:
    """Begin a fault at instant `t`; calling the result ends it."""
    return ActiveFault(Planned(fault, lasts=lasts), segment, Frames(lambda frame: None), t)
