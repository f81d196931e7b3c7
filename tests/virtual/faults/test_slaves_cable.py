"""Broken cables and slaves without supply: what a master sees meanwhile and afterwards."""

from __future__ import annotations

import gc

import pytest

from rtcp.virtual import coe as sdo_access
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.registry import ActiveFault
from rtcp.virtual.faults.slaves import CableFault, PowerFault
from rtcp.virtual.models import DiewuIoBox
from rtcp.virtual.models.cubemars import CubemarsOrh70
from rtcp.virtual.objects import Value
from rtcp.virtual.protocol import DatagramCommand
from tests.virtual.frames import Datagram, build
from tests.virtual.line import (
    ACK,
    ERROR,
    INIT,
    MS,
    OP,
    PRE_OP,
    SAFE_OP,
    STATION,
    Line,
    TinyDevice,
    begin,
    in_op,
    start_sync0,
)

DL_STATUS, LOST_LINKS = 0x0110, 0x0310
LINK_0, LINK_1, CLOSED_0, CLOSED_1 = 0x10, 0x20, 0x100, 0x400


def cut(line: Line, after: int) -> ActiveFault:
    return begin(line.segment, CableFault(after), line.now)


def count(line: Line) -> int:
    """Number of slaves that answer a broadcast."""
    return line.one(DatagramCommand.BRD, 0, 0x0000, bytes(1)).counter


def exchange_for(line: Line, ns: int) -> list[int]:
    """Working counters of one frame a millisecond."""
    return [line.exchange(1, 2, 3, 4)[1] for _ in range(ns // MS)]


def test_frames_turn_round_at_a_broken_cable_and_only_the_slaves_before_it_count() -> None:
    line = in_op()
    end = cut(line, 2)
    assert count(line) == 2
    assert line.one(DatagramCommand.APRD, 0, 0x0130, bytes(2)).counter == 1
    assert line.one(DatagramCommand.APRD, -2 & 0xFFFF, 0x0130, bytes(2)).counter == 0
    assert line.one(DatagramCommand.FPRD, STATION + 2, 0x0130, bytes(2)).counter == 0
    assert line.one(DatagramCommand.BRD, 0, 0, bytes(1)).address == 2
    assert exchange_for(line, 20 * MS) == [6] * 20
    end(line.now)
    assert count(line) == 4


def test_after_a_quick_repair_the_slaves_behind_go_on_in_op_with_their_addresses() -> None:
    line = in_op()
    end = cut(line, 1)
    exchange_for(line, 20 * MS)
    assert line.tiny[1].out.value == 0
    end(line.now)
    assert line.exchange(10, 20, 30, 40)[1] == 12
    assert line.exchange(10, 20, 30, 40) == ([11, 21, 31, 41], 12)
    assert [line.al(n) for n in range(4)] == [(OP, 0)] * 4


def test_the_watchdog_takes_the_slaves_behind_a_broken_cable_out_of_op_and_they_can_come_back() -> None:
    line = in_op()
    end = cut(line, 2)
    exchange_for(line, 150 * MS)
    assert [device.valid for device in line.tiny] == [[True], [True], [True, False], [True, False]]
    end(line.now)
    assert line.al(2) == line.al(3) == (SAFE_OP | ERROR, 0x001B)
    assert line.exchange()[1] == 8
    for slave in (2, 3):
        assert line.request(slave, SAFE_OP | ACK) == (SAFE_OP, 0)
        line.write(slave, 0x0120, b"\x08\x00")
    line.exchange()
    assert [line.al(n) for n in range(4)] == [(OP, 0)] * 4
    assert exchange_for(line, 3 * MS) == [12] * 3


def test_what_the_slaves_before_a_broken_cable_are_set_to_meanwhile_is_kept() -> None:
    line = in_op()
    end = cut(line, 2)
    line.one(DatagramCommand.APWR, 0, 0x0010, b"\x77\x00")
    line.one(DatagramCommand.FPWR, 0x77, 0x0600, bytes(32))
    assert line.exchange()[1] == 3
    end(line.now)
    assert line.exchange()[1] == 9
    assert line.one(DatagramCommand.FPRD, 0x77, 0x0130, bytes(2)).counter == 1
    assert line.one(DatagramCommand.FPRD, STATION, 0x0130, bytes(2)).counter == 0


def test_between_master_and_slave_1_a_broken_cable_brings_nothing_back_and_no_slave_sees_the_frame() -> None:
    line = in_op()
    end = cut(line, 0)
    frame = build(Datagram(DatagramCommand.BWR, 0, 0, 0x0F80, b"\x55"))
    assert line.raw(frame) is None
    line.pass_time(150 * MS)
    assert line.raw(frame) is None
    assert [slave.application.state for slave in line.slaves] == [SAFE_OP] * 4
    assert [slave.esc.memory[0x0F80] for slave in line.slaves] == [0] * 4
    end(line.now)
    assert count(line) == 4
    assert line.number(0, LOST_LINKS, 1) == 1


def test_of_several_broken_cables_the_nearest_counts() -> None:
    line = in_op()
    far, near, again = cut(line, 3), cut(line, 1), cut(line, 3)
    assert count(line) == 1
    near(line.now)
    assert count(line) == 3
    far(line.now)
    assert count(line) == 3
    far(line.now)
    assert count(line) == 3, "what is ended twice is ended once"
    again(line.now)
    assert count(line) == 4


def test_both_ends_of_a_broken_cable_show_no_link_and_count_its_loss() -> None:
    line = in_op()
    before = [line.number(n, DL_STATUS, 2) for n in range(4)]
    assert [status & (LINK_0 | LINK_1 | CLOSED_0 | CLOSED_1) for status in before] == [
        LINK_0 | LINK_1, LINK_0 | LINK_1, LINK_0 | LINK_1, LINK_0 | CLOSED_1,
    ]  # fmt: skip
    end = cut(line, 2)
    assert line.number(1, DL_STATUS, 2) & (LINK_0 | LINK_1 | CLOSED_0 | CLOSED_1) == LINK_0 | CLOSED_1
    assert line.number(0, DL_STATUS, 2) == before[0]
    assert int.from_bytes(line.slaves[2].esc.memory[0x0110:0x0112], "little") & (LINK_0 | CLOSED_0) == CLOSED_0
    assert line.read(1, LOST_LINKS, 4) == bytes((0, 1, 0, 0))
    end(line.now)
    assert [line.number(n, DL_STATUS, 2) for n in range(4)] == before
    assert [line.read(n, LOST_LINKS, 2) for n in range(4)] == [bytes(2), b"\0\1", b"\1\0", bytes(2)]


def test_a_lost_link_raises_the_event_of_the_dl_status_until_it_is_read() -> None:
    line = in_op()
    line.read(1, DL_STATUS, 2)
    line.write(1, 0x0200, b"\x04\x00")
    assert line.one(DatagramCommand.BRD, 0, 0, bytes(1)).event == 0
    cut(line, 2)
    assert line.one(DatagramCommand.FPRD, STATION, 0, bytes(1)).event == 0x04
    line.read(1, DL_STATUS, 2)
    assert line.one(DatagramCommand.FPRD, STATION, 0, bytes(1)).event == 0


def test_lost_links_are_counted_to_255() -> None:
    line = in_op(2)
    for _ in range(300):
        cut(line, 1)(line.now)
    assert line.read(0, LOST_LINKS, 2) == b"\x00\xff"


def test_the_delays_measured_are_those_of_the_slaves_reached_and_afterwards_as_before() -> None:
    line = in_op(delays=(0, 820, 1660, 2500))

    def around() -> list[int]:
        reached = line.one(DatagramCommand.BWR, 0, 0x0900, bytes(4)).counter
        ports = [(line.number(n, 0x0900, 4), line.number(n, 0x0904, 4)) for n in range(reached)]
        return [back - there if back else 0 for there, back in ports]

    assert around() == [5000, 3360, 1680, 0]
    end = cut(line, 3)
    assert around() == [3320, 1680, 0]
    end(line.now)
    assert around() == [5000, 3360, 1680, 0]


def test_sync0_goes_on_behind_a_broken_cable() -> None:
    line = Line([TinyDevice(), TinyDevice()])
    line.to_pre_op()
    line.configure_process_data()
    start_sync0(line, 1, MS)
    line.pass_time(20 * MS)
    pulses = line.slaves[1].esc.dc.sync0.pulses
    end = cut(line, 1)
    line.pass_time(50 * MS)
    assert line.slaves[1].esc.dc.sync0.pulses - pulses == 50
    end(line.now)
    assert line.al(1) == (PRE_OP, 0)


def test_frames_do_not_hurry_the_slaves_that_they_do_not_reach() -> None:
    line = in_op(2)
    cut(line, 1)
    before = [device.steps for device in line.tiny]
    for _ in range(100):
        line.exchange(1, 2, after=MS // 10)
    steps = [device.steps - begun for device, begun in zip(line.tiny, before, strict=True)]
    assert steps[0] >= 100
    assert steps[1] <= 11


def test_a_cable_behind_the_last_slave_cannot_be_broken() -> None:
    with pytest.raises(FaultRefused, match=r"no cable behind slave 4: .* 0 \(the master\) to 3"):
        cut(in_op(), 4)


# -- supply -----------------------------------------------------------------------------------------------------------


def test_no_frame_passes_a_slave_without_supply_and_its_neighbours_lose_their_links() -> None:
    line = in_op()
    begin(line.segment, PowerFault(3), line.now)
    assert count(line) == 2
    assert exchange_for(line, 5 * MS) == [6] * 5
    assert line.read(1, LOST_LINKS, 2) == b"\0\1"
    assert line.slaves[3].esc.memory[LOST_LINKS : LOST_LINKS + 2] == b"\1\0"
    assert line.tiny[2].valid == [True, False]
    assert line.tiny[3].valid == [True]


def test_with_its_supply_back_a_slave_is_in_init_with_the_registers_of_power_on() -> None:
    line = Line([TinyDevice() for _ in range(3)], aliases=(5, 6, 7))
    line.to_op()
    line.write(1, 0x0F80, b"\x55")
    back = begin(line.segment, PowerFault(2), line.now)
    exchange_for(line, 5 * MS)
    back(line.now)
    line.pass_time(10 * MS)
    assert count(line) == 3
    assert line.one(DatagramCommand.FPRD, STATION + 1, 0x0130, bytes(2)).counter == 0
    there = -1 & 0xFFFF
    assert line.one(DatagramCommand.APRD, there, 0x0010, bytes(4)).data == b"\0\0\6\0"
    assert line.one(DatagramCommand.APRD, there, 0x0130, bytes(6)).data == b"\1\0\0\0\0\0"
    assert line.one(DatagramCommand.APRD, there, 0x0600, bytes(16)).data == bytes(16)
    assert line.one(DatagramCommand.APRD, there, 0x0F80, bytes(1)).data == b"\0"
    assert line.one(DatagramCommand.APRD, there, LOST_LINKS, bytes(2)).data == bytes(2)
    local = int.from_bytes(line.one(DatagramCommand.APRD, there, 0x0910, bytes(8)).data, "little")
    assert 10 * MS < local < 20 * MS
    assert line.exchange()[1] == 6
    assert line.al(0) == (OP, 0)


def test_with_its_supply_back_a_slave_can_be_brought_to_op_again() -> None:
    line = in_op()
    begin(line.segment, PowerFault(2), line.now)(line.now)
    assert line.one(DatagramCommand.APWR, -1 & 0xFFFF, 0x0010, (STATION + 1).to_bytes(2, "little")).counter == 1
    line.write(1, 0x0800, bytes.fromhex("0010 8000 26 00 01 00  8010 8000 22 00 01 00"))
    assert line.request(1, PRE_OP) == (PRE_OP, 0)
    line.configure_process_data()
    assert line.request(1, SAFE_OP) == (SAFE_OP, 0)
    line.write(1, 0x0120, b"\x08\x00")
    exchange_for(line, 2 * MS)
    assert line.al(1) == (OP, 0)
    assert line.exchange(7, 8, 9, 10) == ([2, 3, 4, 5], 12)


def test_what_was_written_to_the_eeprom_outlives_the_supply() -> None:
    line = in_op()
    image = line.slaves[1].esc.eeprom.image
    image[100:102] = b"\xab\xcd"
    begin(line.segment, PowerFault(2), line.now)(line.now)
    assert line.slaves[1].esc.eeprom.image == image
    assert line.slaves[1].esc.eeprom.image is not image


def test_without_supply_behind_a_broken_cable_both_must_be_cleared() -> None:
    line = in_op()
    whole, back = cut(line, 1), begin(line.segment, PowerFault(3), line.now)
    assert count(line) == 1
    whole(line.now)
    assert count(line) == 2
    back(line.now)
    assert count(line) == 4


def test_slave_1_without_supply_is_a_master_without_an_answer() -> None:
    line = in_op()
    back = begin(line.segment, PowerFault(1), line.now)
    assert line.raw(build(Datagram(DatagramCommand.BRD, 0, 0, 0, bytes(1)))) is None
    back(line.now)
    assert count(line) == 4


def test_a_slave_that_does_not_exist_has_no_supply_to_lose() -> None:
    with pytest.raises(FaultRefused, match="no slave 5: the segment has slaves 1 to 4"):
        begin(in_op().segment, PowerFault(5), 0)


def enabled_drive() -> tuple[Line, CubemarsOrh70]:
    """A drive that moves at 1 rad/s, set valid directly: no process data are exchanged."""
    drive = CubemarsOrh70()
    line = Line([drive, TinyDevice()])
    drive.set_outputs_valid(True)
    drive.objects[0x6085, 0].value = 12345
    drive.objects[0x1A00, 0].value = 2
    drive.objects[0x6060, 0].value = 9
    for word in (0, 6, 7, 15):
        drive.objects[0x6040, 0].value = word
        line.pass_time(150 * MS)
    drive.objects[0x60FF, 0].value = 10000
    line.pass_time(500 * MS)
    assert drive.powered
    assert drive.mechanics.velocity == pytest.approx(1.0, abs=0.05)
    return line, drive


def values_of(device: DeviceModel) -> dict[tuple[int, int], Value]:
    """All objects except the temperature: the motor stays warm."""
    entries = [entry for group in device.objects for entry in group.entries.values()]
    return {(e.index, e.subindex): e.value for e in entries if (e.index, e.subindex) != (0x2000, 1)}


def test_a_drive_without_supply_stands_by_its_brake_and_comes_back_as_at_power_on_where_it_stands() -> None:
    line, drive = enabled_drive()
    back = begin(line.segment, PowerFault(1), line.now)
    assert not drive.powered
    line.pass_time(2 * MS)
    assert drive.mechanics.braked
    line.pass_time(500 * MS)
    position = drive.mechanics.position
    drive.axis.shift(0.5)
    assert drive.mechanics.velocity == 0.0
    assert position > 0.3
    assert drive.state.name == "NOT_READY_TO_SWITCH_ON"
    back(line.now)
    line.pass_time(50 * MS)
    assert drive.state.name == "NOT_READY_TO_SWITCH_ON"
    line.pass_time(100 * MS)
    assert drive.state.name == "SWITCH_ON_DISABLED"
    fresh = CubemarsOrh70(initial_position=position)
    fresh.step(0.15)
    fresh.step(0.001)
    assert values_of(drive) == values_of(fresh)
    assert not drive.emergencies
    line.pass_time(100 * MS)
    assert drive.mechanics.position == position


def test_without_supply_the_outputs_of_the_io_box_are_off_and_afterwards_nothing_is_forced() -> None:
    box = DiewuIoBox(inputs=0x1234)
    line = Line([box])
    box.set_outputs_valid(True)
    box.objects[0x7000, 1].value = 0xFFFF
    box.objects[0x2000, 1].value = 0xFFFF
    sdo_access.write(box.objects, 0x2000, 3, False, PRE_OP, b"\x32\x00")
    box.turn(5)
    line.pass_time(2 * MS)
    assert (box.outputs, box.objects[0x6000, 1].value, box.objects[0x6010, 1].value) == (0xFFFF, 0, 5)
    back = begin(line.segment, PowerFault(1), line.now)
    assert box.outputs == 0
    line.pass_time(5 * MS)
    back(line.now)
    line.pass_time(2 * MS)
    assert (box.outputs, box.objects[0x6000, 1].value, box.objects[0x6010, 1].value) == (0, 0x1234, 0)
    assert line.slaves[0].application.state == INIT
    box.objects[0x2000, 1].value = 0xFFFF
    line.pass_time(100 * MS)
    assert box.objects[0x6000, 1].value == 0, "what is forced now has no end"


def test_a_cleared_fault_leaves_nothing_to_the_garbage_collector_which_is_off_in_a_segment() -> None:
    line = Line([DiewuIoBox(), CubemarsOrh70(), TinyDevice()])
    gc.collect()
    gc.disable()
    try:
        for fault in (PowerFault(2), PowerFault(1), CableFault(1)):
            begin(line.segment, fault, line.now)(line.now)
            line.pass_time(5 * MS)
        assert gc.collect() == 0
    finally:
        gc.enable()
