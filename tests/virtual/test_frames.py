"""Frames and datagrams, written by hand: addressing, commands and their working counters (ETG.1000.4, clause 5)."""

from __future__ import annotations

import pytest

from rtcp.virtual.protocol import DatagramCommand
from tests.virtual.frames import Datagram, build
from tests.virtual.line import SM_MAILBOXES, STATION, Line, fmmu

USER_RAM = 0x0F80
TYPE = 0x0000


def frame(hex_datagrams: str, length: int) -> bytes:
    header = "ffffffffffff 010101010101 88a4"
    return (bytes.fromhex(header) + (length | 0x1000).to_bytes(2, "little") + bytes.fromhex(hex_datagrams)).ljust(
        60, b"\0"
    )


@pytest.fixture
def line() -> Line:
    addressed = Line()
    addressed.address()
    return addressed


def test_a_broadcast_read_written_by_hand_comes_back_counted_by_every_slave_and_marked_by_the_first() -> None:
    # BRD, index 0x5A, position 0, register 0x0005 (number of sync managers), 1 byte, counter 0.
    answer = Line().raw(frame("07 5a 0000 0500 0100 0000 00 0000", 13))
    assert answer[:14].hex(" ") == "ff ff ff ff ff ff 03 01 01 01 01 01 88 a4"
    assert answer[16:29].hex(" ") == "07 5a 03 00 05 00 01 00 00 00 08 03 00"
    assert answer[29:] == bytes(31)


def test_two_datagrams_in_a_frame_are_both_answered() -> None:
    # BRD of 0x0004, more follow; then APRD at position -1 (the second slave) of 0x0006.
    answer = Line().raw(frame("07 01 0000 0400 0180 0000 00 0000  01 01 ffff 0600 0100 0000 00 0000", 26))
    assert answer[26:29].hex(" ") == "08 03 00"
    assert answer[29:42].hex(" ") == "01 01 02 00 06 00 01 00 00 00 08 01 00"


@pytest.mark.parametrize(
    ("command", "address", "counter"),
    [
        (DatagramCommand.NOP, 0, 0),
        (DatagramCommand.APRD, 0xFFFF, 1),
        (DatagramCommand.APWR, 0xFFFF, 1),
        (DatagramCommand.APRW, 0xFFFF, 3),
        (DatagramCommand.FPRD, STATION + 1, 1),
        (DatagramCommand.FPWR, STATION + 1, 1),
        (DatagramCommand.FPRW, STATION + 1, 3),
        (DatagramCommand.BRD, 0, 3),
        (DatagramCommand.BWR, 0, 3),
        (DatagramCommand.BRW, 0, 9),
        (DatagramCommand.ARMW, 0xFFFF, 3),
        (DatagramCommand.FRMW, STATION + 1, 3),
        (DatagramCommand.APRD, 0xFFF0, 0),
        (DatagramCommand.FPRD, 0x2222, 0),
    ],
)
def test_each_command_counts_reads_once_and_writes_as_the_standard_says(
    line: Line, command: DatagramCommand, address: int, counter: int
) -> None:
    assert line.one(command, address, USER_RAM, b"\x11\x22").counter == counter


@pytest.mark.parametrize(
    ("command", "counter"), [(DatagramCommand.LRD, 3), (DatagramCommand.LWR, 3), (DatagramCommand.LRW, 9)], ids=str
)
def test_logical_commands_count_one_for_a_read_and_two_for_a_write_of_an_lrw(
    line: Line, command: DatagramCommand, counter: int
) -> None:
    for slave in range(3):
        line.write(slave, 0x0600, fmmu(0x10000 + slave, 1, USER_RAM, write=True))
        line.write(slave, 0x0610, fmmu(0x10010 + slave, 1, USER_RAM, write=False))
    assert line.logical(command, 0x10000, bytes(32)).counter == counter


def test_a_working_counter_that_is_not_zero_is_added_to(line: Line) -> None:
    answer = line.send(Datagram(DatagramCommand.BRD, 0, 0, TYPE, bytes(1), counter=0xFFFE))
    assert answer[0].counter == 1


def test_position_commands_add_one_at_every_slave_and_station_commands_none(line: Line) -> None:
    for command in (
        DatagramCommand.APRD,
        DatagramCommand.APWR,
        DatagramCommand.APRW,
        DatagramCommand.BRD,
        DatagramCommand.BWR,
        DatagramCommand.BRW,
        DatagramCommand.ARMW,
    ):
        assert line.one(command, 0xFFFF, USER_RAM, b"\0").address == 2
    for command in (DatagramCommand.FPRD, DatagramCommand.FPWR, DatagramCommand.FPRW, DatagramCommand.FRMW):
        assert line.one(command, STATION, USER_RAM, b"\0").address == STATION


def test_a_broadcast_read_ors_what_the_slaves_hold(line: Line) -> None:
    for slave, value in enumerate((0x01, 0x10, 0x80)):
        line.write(slave, USER_RAM, bytes((value,)))
    assert line.one(DatagramCommand.BRD, 0, USER_RAM, b"\x04").data == b"\x95"


def test_a_read_write_returns_the_old_value_and_stores_the_new_one(line: Line) -> None:
    line.write(1, USER_RAM, b"\xaa")
    assert line.one(DatagramCommand.FPRW, STATION + 1, USER_RAM, b"\x55").data == b"\xaa"
    assert line.read(1, USER_RAM, 1) == b"\x55"


def test_a_multiple_write_gives_what_the_addressed_slave_holds_to_those_behind_it(line: Line) -> None:
    for slave, value in enumerate((1, 2, 3)):
        line.write(slave, USER_RAM, bytes((value,)))
    assert line.one(DatagramCommand.FRMW, STATION + 1, USER_RAM, b"\x77").data == b"\x02"
    # The slave before the addressed one saw the datagram as the master sent it.
    assert [line.read(slave, USER_RAM, 1)[0] for slave in range(3)] == [0x77, 2, 2]


def test_the_alias_answers_only_while_dl_control_enables_it() -> None:
    line = Line(aliases=[0, 0x0BEE, 0])
    line.address()
    assert line.one(DatagramCommand.FPRD, 0x0BEE, TYPE, b"\0").counter == 0
    line.write(1, 0x0103, b"\x01")
    assert line.one(DatagramCommand.FPRD, 0x0BEE, TYPE, b"\0").counter == 1
    assert line.read(1, 0x0012, 2) == b"\xee\x0b"
    line.write(1, 0x0103, b"\x00")
    assert line.one(DatagramCommand.FPRD, 0x0BEE, TYPE, b"\0").counter == 0


def test_a_register_that_the_master_may_not_write_keeps_its_value_and_is_not_counted(line: Line) -> None:
    assert line.one(DatagramCommand.FPWR, STATION, 0x0130, b"\x08\x00").counter == 0
    assert line.al(0) == (1, 0)


def test_an_address_outside_the_memory_is_not_counted(line: Line) -> None:
    assert line.one(DatagramCommand.FPRD, STATION, 0x2FFF, bytes(2)).counter == 0
    assert line.one(DatagramCommand.FPWR, STATION, 0xFFFF, bytes(2)).counter == 0
    assert line.one(DatagramCommand.FPRD, STATION, 0x2FFE, bytes(2)).counter == 1


@pytest.mark.parametrize(
    "broken",
    [
        b"",
        b"\xff" * 15,
        build(Datagram(DatagramCommand.BRD, 0, 0, 0, b"\0"))[:20],
        frame("07 5a 0000 0500 0100 0000 00 0000", 1000),
        frame("07 5a 0000 0500 0100 0000 00 0000", 13)[:12] + b"\x08\x00" + bytes(46),
        bytes.fromhex("ffffffffffff 010101010101 88a4 0d20") + bytes(44),
    ],
    ids=["empty", "no header", "cut", "length beyond the frame", "not EtherCAT", "not datagrams"],
)
def test_a_malformed_frame_is_not_answered(broken: bytes) -> None:
    assert Line().raw(broken) is None


def test_a_datagram_that_is_cut_goes_back_as_it_came_and_those_before_it_are_answered() -> None:
    # The second datagram claims 200 bytes where the frame ends after its header.
    sent = frame("07 01 0000 0400 0180 0000 00 0000  07 02 0000 0400 c800 0000 11 2233", 26)
    answer = Line().raw(sent)
    assert answer[26:29].hex(" ") == "08 03 00"
    assert answer[29:] == sent[29:]


def test_an_event_that_is_masked_in_shows_in_the_datagram_until_al_status_is_read(line: Line) -> None:
    line.write(1, 0x0200, b"\x08\x00")
    line.write(1, 0x0800, SM_MAILBOXES)
    line.write(1, 0x0120, b"\x02\x00")
    assert line.one(DatagramCommand.NOP, 0, 0, b"\0").event == 0x0008
    line.al(1)
    assert line.one(DatagramCommand.NOP, 0, 0, b"\0").event == 0
