"""A drive on the in-process bus does what it does behind an EtherCAT slave controller: the same bytes, each frame."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.testing.bus import InProcessBus
from rtcp.virtual.models.cubemars import CubemarsOrh60
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
    outputs = [DRIVE.pack(0x00, 0, 0, 0, mode)] * SETTLED
    outputs += [DRIVE.pack(word, 1000, 0, 0, mode) for word in (0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F, 0x0F)]
    for n in range(400):
        position = 1000 + (n if n < 200 else 400 - n) * 3
        outputs.append(DRIVE.pack(0x0F, position, 5000 if mode == 8 else (n % 50) * 20, 30_000 - 100 * n, mode))
    outputs += [DRIVE.pack(0x02, 1000, 3000, 0, mode)] * 60
    outputs += [DRIVE.pack(word, 1000, 0, 0, mode) for word in (0x00, 0x80, 0x06, 0x07, 0x06, 0x00) for _ in range(3)]
    return outputs


def drive() -> CubemarsOrh60:
    device = CubemarsOrh60(initial_position=0.1, load_mass_moment=1.0)
    device.objects[0x605A, 0].value = 6
    device.objects[0x60C2, 1].value, device.objects[0x60C2, 2].value = 1, -3
    return device


def over_the_wire(cycles: Sequence[bytes], lost: Sequence[int]) -> list[bytes]:
    """Inputs of each cycle, by frames that reach a virtual slave controller half a cycle after SYNC0."""
    line = Line([drive()])
    line.to_pre_op()
    for address, start, control in ((0x0810, 0x1100, 0x64), (0x0818, 0x1400, 0x20)):
        line.write(0, address, struct.pack("<HHBBBB", start, SIZE, control, 0, 1, 0))
    line.write(0, 0x0600, fmmu(0, SIZE, 0x1100, write=True))
    line.write(0, 0x0610, fmmu(SIZE, SIZE, 0x1400, write=False))
    start_sync0(line, 0, CYCLE, first_in=50 * MS)
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)
    sync0 = line.slaves[0].esc.dc.sync0
    line.pass_time(((sync0.due or 0) - line.now) % CYCLE + CYCLE // 2)
    line.write(0, 0x0120, bytes((OP, 0)))
    line.pass_time(CYCLE - 100_000)

    def exchange(outputs: bytes) -> bytes:
        answer = line.send(Datagram(DatagramCommand.LRW, 0, 0, 0, outputs + bytes(SIZE)), after=CYCLE)[0]
        return answer.data[SIZE:]

    for _ in range(100):
        exchange(bytes(SIZE))
    assert line.slaves[0].application.state == OP
    inputs = []
    for n, outputs in enumerate(cycles):
        if n in lost:
            line.pass_time(CYCLE)
        else:
            inputs.append(exchange(outputs))
    return inputs


def in_process(cycles: Sequence[bytes], lost: Sequence[int]) -> list[bytes]:
    config = load(default_config())
    slave = config.slaves[1]
    # The start-up objects are those of `drive`.
    bus = InProcessBus([drive()], now_ns=0)
    data = bus.configure([replace(slave, device=replace(slave.device, sdo=()))], CYCLE)
    now = -bus.offset_ns % CYCLE + CYCLE // 2
    inputs = []
    for n, outputs in enumerate([bytes(SIZE)] * 100 + list(cycles)):
        if n == 1:
            bus.request_state(AlState.OP)
        bus.advance_to(now)
        now += CYCLE
        if n - 100 in lost:
            data.lose(1, heard=False)
        data.set_output(0, outputs)
        data.send()
        if data.receive() >= 0 and n >= 100:
            inputs.append(data.input(0))
    return inputs


@pytest.mark.parametrize(
    ("lost", "state"),
    [((), 0x07), ((450, 460), 0x07), (range(500, 515), 0x08)],
    ids=["all frames", "single ones lost", "so many lost that it leaves OP"],
)
@pytest.mark.parametrize("mode", MODES)
def test_the_same_outputs_bring_the_same_inputs(mode: str, lost: Sequence[int], state: int) -> None:
    cycles = schedule(MODES[mode])
    wire, process = over_the_wire(cycles, lost), in_process(cycles, lost)
    assert len(wire) == len(process) == len(cycles) - len(lost)
    first = next((n for n, (a, b) in enumerate(zip(wire, process, strict=True)) if a != b), None)
    assert first is None, (first, DRIVE.unpack(wire[first or 0]), DRIVE.unpack(process[first or 0]))
    statuswords = {DRIVE.unpack(inputs)[0] & 0x6F for inputs in process}
    assert {0x40, 0x21, 0x23, 0x27, state} <= statuswords
