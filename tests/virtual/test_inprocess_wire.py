"""A drive on the in-process bus does what it does behind an EtherCAT slave controller: the same bytes, each frame."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.launch.inprocess import InProcessBus
from rtcp.virtual.models import CubemarsDrive, create
from rtcp.virtual.protocol import AlState, DatagramCommand
from tests.virtual.frames import Datagram
from tests.virtual.line import MS, OP, SAFE_OP, Line, fmmu, start_sync0

DRIVE = struct.Struct("<Hiiib")
SIZE = DRIVE.size
CYCLE = MS
SETTLED = 300
"""Cycles after which the self-test is over on either side."""
MODES = {"csp": 8, "csv": 9, "cst": 10}


def schedule(mode: int) -> list[bytes]:
    """Outputs of each cycle: enable, move there and back, stop on a quick stop, fault reset, disable."""
    told = [DRIVE.pack(0x00, 0, 0, 0, mode)] * SETTLED
    told += [DRIVE.pack(word, 1000, 0, 0, mode) for word in (0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F, 0x0F)]
    for n in range(400):
        position = 1000 + (n if n < 200 else 400 - n) * 3
        told.append(DRIVE.pack(0x0F, position, 5000 if mode == 8 else (n % 50) * 20, 30_000 - 100 * n, mode))
    told += [DRIVE.pack(0x02, 1000, 3000, 0, mode)] * 60
    told += [DRIVE.pack(word, 1000, 0, 0, mode) for word in (0x00, 0x80, 0x06, 0x07, 0x06, 0x00) for _ in range(3)]
    return told


def drive() -> CubemarsDrive:
    made = create("cubemars-orh60", initial_position=0.1, load_mass_moment=1.0)
    made.objects[0x605A, 0].value = 6
    made.objects[0x60C2, 1].value, made.objects[0x60C2, 2].value = 1, -3
    return made


def over_the_wire(told: Sequence[bytes], lost: Sequence[int]) -> list[bytes]:
    """What frames bring back whose datagram passes a virtual slave controller half a cycle after SYNC0."""
    line = Line([drive()])  # type: ignore[list-item]
    line.to_pre_op()
    for address, start, control in ((0x0810, 0x1100, 0x64), (0x0818, 0x1400, 0x20)):
        line.write(0, address, struct.pack("<HHBBBB", start, SIZE, control, 0, 1, 0))
    line.write(0, 0x0600, fmmu(0, SIZE, 0x1100, write=True))
    line.write(0, 0x0610, fmmu(SIZE, SIZE, 0x1400, write=False))
    start_sync0(line, 0, CYCLE, first_in=50 * MS)
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)
    sync0 = line.slaves[0].esc.dc.sync0  # type: ignore[union-attr]
    line.pass_time(((sync0.due or 0) - line.now) % CYCLE + CYCLE // 2)
    line.write(0, 0x0120, bytes((OP, 0)))
    line.pass_time(CYCLE - 100_000)

    def exchange(outputs: bytes) -> bytes:
        answer = line.send(Datagram(DatagramCommand.LRW, 0, 0, 0, outputs + bytes(SIZE)), after=CYCLE)[0]
        return answer.data[SIZE:]

    for _ in range(100):
        exchange(bytes(SIZE))
    assert line.slaves[0].application.state == OP
    heard = []
    for n, outputs in enumerate(told):
        if n in lost:
            line.pass_time(CYCLE)
        else:
            heard.append(exchange(outputs))
    return heard


def in_process(told: Sequence[bytes], lost: Sequence[int]) -> list[bytes]:
    config = load(default_config())
    slave = config.slaves[1]
    # The start-up objects are those of `drive`.
    bus = InProcessBus([drive()], now_ns=0)
    data = bus.configure([replace(slave, device=replace(slave.device, sdo=()))], CYCLE)
    now = -bus.offset_ns % CYCLE + CYCLE // 2
    heard = []
    for n, outputs in enumerate([bytes(SIZE)] * 100 + list(told)):
        if n == 1:
            bus.request_state(AlState.OP)
        bus.advance_to(now)
        now += CYCLE
        if n - 100 in lost:
            data.lose(1, heard=False)
        data.set_output(0, outputs)
        data.send()
        if data.receive() >= 0 and n >= 100:
            heard.append(data.input(0))
    return heard


@pytest.mark.parametrize(
    ("lost", "state"),
    [((), 0x07), ((450, 460), 0x07), (range(500, 515), 0x08)],
    ids=["all frames", "single ones lost", "so many lost that it leaves OP"],
)
@pytest.mark.parametrize("mode", MODES)
def test_the_same_outputs_bring_the_same_inputs(mode: str, lost: Sequence[int], state: int) -> None:
    told = schedule(MODES[mode])
    wire, process = over_the_wire(told, lost), in_process(told, lost)
    assert len(wire) == len(process) == len(told) - len(lost)
    first = next((n for n, (one, other) in enumerate(zip(wire, process, strict=True)) if one != other), None)
    assert first is None, (first, DRIVE.unpack(wire[first or 0]), DRIVE.unpack(process[first or 0]))
    statuswords = {DRIVE.unpack(inputs)[0] & 0x6F for inputs in process}
    assert {0x40, 0x21, 0x23, 0x27, state} <= statuswords
