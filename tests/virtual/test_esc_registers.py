"""A slave controller as a master meets it: topology, EEPROM, sync managers, FMMUs (ETG.1000.4, clause 6)."""

from __future__ import annotations

import pytest

from rtcp.virtual.device import Emergency
from rtcp.virtual.protocol import DatagramCommand
from tests.virtual.frames import Datagram
from tests.virtual.line import (
    INIT,
    MS,
    PRE_OP,
    SM_MAILBOXES,
    SM_OUTPUTS,
    STATION,
    Line,
    TinyDevice,
    fmmu,
)

USER_RAM = 0x0F80
SDO_READ_NAME = bytes.fromhex("0a00 0000 00 13 0020 40 1810 01 00000000")
"""CoE SDO upload request of 0x1018:01, mailbox counter 1."""


@pytest.fixture
def line() -> Line:
    addressed = Line()
    addressed.address()
    return addressed


def eeprom_read(line: Line, slave: int, word: int) -> bytes:
    line.write(slave, 0x0502, (0x0100).to_bytes(2, "little") + word.to_bytes(4, "little"))
    assert line.number(slave, 0x0502, 2) & 0xF800 == 0
    return line.read(slave, 0x0508, 8)


def test_a_slave_reports_its_fmmus_sync_managers_memory_and_clocks() -> None:
    line = Line([TinyDevice(), TinyDevice(supports_dc=False)])
    line.address()
    assert line.read(0, 0x0004, 3) == bytes((8, 8, 8))
    assert line.number(0, 0x0008, 2) & 0x000C == 0x000C
    assert line.number(1, 0x0008, 2) & 0x000C == 0


@pytest.mark.parametrize(("written", "cleared"), [(0x0300, range(0x0300, 0x030C)), (0x0310, range(0x0310, 0x0314))])
def test_a_write_to_an_error_counter_clears_its_group_alone(line: Line, written: int, cleared: range) -> None:
    line.slaves[0].esc.memory[0x0300:0x0314] = b"\x01" * 20
    line.write(0, written, b"\xff")
    counts = line.read(0, 0x0300, 20)
    assert [counts[n] for n in range(20)] == [0x0300 + n not in cleared for n in range(20)]


def test_clock_registers_of_a_slave_without_a_clock_do_not_count() -> None:
    line = Line([TinyDevice(supports_dc=False), TinyDevice()])
    line.address()
    assert line.one(DatagramCommand.BRD, 0, 0x0910, bytes(8)).counter == 1
    assert line.one(DatagramCommand.FPWR, STATION, 0x0980, b"\0").counter == 0
    assert line.one(DatagramCommand.FPRD, STATION, 0x0910, bytes(8)).counter == 0


def test_al_control_written_again_before_the_firmware_has_read_it_does_not_count(line: Line) -> None:
    control = [Datagram(DatagramCommand.FPWR, number, STATION, 0x0120, bytes((PRE_OP, 0))) for number in range(2)]
    assert [answer.counter for answer in line.send(*control)] == [1, 0]


@pytest.mark.parametrize(("control", "event"), [("26", 0), ("36", 0x0010)])
def test_a_sync_manager_with_the_event_bit_mirrors_it_in_0x0210(line: Line, control: str, event: int) -> None:
    line.write(0, 0x0800, bytes.fromhex(f"0010 8000 {control} 00 01 00  8010 8000 22 00 01 00"))
    assert line.request(0, PRE_OP) == (PRE_OP, 0)
    line.write(0, 0x1000, SDO_READ_NAME.ljust(128, b"\0"))
    line.pass_time(MS)
    assert line.number(0, 0x0210, 2) & 0x0FF0 == event, "the firmware has taken the message"


def test_a_loop_that_is_closed_by_0x0101_cuts_the_rest_off_until_it_opens_again(line: Line) -> None:
    assert line.one(DatagramCommand.BRD, 0, 0, bytes(1)).counter == 3
    line.write(0, 0x0101, bytes((0x0C,)))  # port 1 always closed
    assert line.one(DatagramCommand.BRD, 0, 0, bytes(1)).counter == 1
    line.write(0, 0x0101, b"\0")
    assert line.one(DatagramCommand.BRD, 0, 0, bytes(1)).counter == 3


def test_the_reset_sequence_takes_a_slave_back_to_power_on(line: Line) -> None:
    line.write(0, 0x0800, SM_MAILBOXES)
    assert line.request(0, PRE_OP) == (PRE_OP, 0)
    for byte in b"RES":
        line.write(0, 0x0040, bytes((byte,)))
    line.pass_time(MS)
    assert line.one(DatagramCommand.FPRD, STATION, 0x0130, bytes(2)).counter == 0, "its station address is gone"
    answer = line.one(DatagramCommand.APRD, 0, 0x0130, bytes(2))
    assert (answer.counter, answer.data[0]) == (1, INIT)


def test_the_link_that_came_up_at_power_on_is_an_event_until_the_dl_status_is_read() -> None:
    line = Line()
    line.address()
    assert line.number(0, 0x0210, 2) & 0x0004
    line.read(0, 0x0110, 2)
    assert line.number(0, 0x0210, 2) & 0x0004 == 0


# EEPROM


def test_the_eeprom_is_busy_right_after_a_command(line: Line) -> None:
    line.write(0, 0x0502, bytes.fromhex("0001 08000000"))
    busy = line.send(Datagram(DatagramCommand.FPRD, 0, STATION, 0x0502, bytes(2)), after=5_000)
    assert busy[0].data[1] & 0x80
    assert line.number(0, 0x0502, 2) & 0x8000 == 0


def test_the_eeprom_is_written_only_with_write_enable(line: Line) -> None:
    before = eeprom_read(line, 0, 4)
    line.write(0, 0x0502, bytes.fromhex("0002 04000000 3412"))
    assert line.number(0, 0x0502, 2) & 0x4000
    assert eeprom_read(line, 0, 4) == before
    line.write(0, 0x0502, bytes.fromhex("0102 04000000 3412"))
    line.pass_time(MS)
    assert eeprom_read(line, 0, 4)[:2] == b"\x34\x12"


def test_an_unknown_eeprom_command_and_a_command_while_busy_set_the_error_bit(line: Line) -> None:
    line.write(0, 0x0502, bytes.fromhex("0007"))
    assert line.number(0, 0x0502, 2) & 0x2000
    line.write(0, 0x0502, bytes.fromhex("0001 08000000"))
    assert line.number(0, 0x0502, 2) & 0x2000 == 0
    read = Datagram(DatagramCommand.FPWR, 0, STATION, 0x0502, bytes.fromhex("0001 08000000"))
    line.send(read, after=100_000)
    line.send(read, after=1_000)
    assert line.number(0, 0x0502, 2) & 0x2000


def test_a_damaged_eeprom_shows_as_a_checksum_error_and_its_alias_is_not_used(line: Line) -> None:
    image = line.slaves[0].esc.eeprom.image
    image[8] ^= 0x01
    line.write(0, 0x0502, bytes.fromhex("0004"))
    assert line.number(0, 0x0502, 2) & 0x0800
    assert line.number(0, 0x0012, 2) == 0
    image[8] ^= 0x01
    line.write(0, 0x0502, bytes.fromhex("0004"))
    assert line.number(0, 0x0502, 2) & 0x0800 == 0


def test_the_eeprom_that_belongs_to_the_device_is_closed_to_the_master_until_it_is_taken_back(line: Line) -> None:
    line.write(0, 0x0500, b"\x01")
    assert line.one(DatagramCommand.FPWR, STATION, 0x0502, b"\x00\x01").counter == 0
    line.write(0, 0x0500, b"\x02")
    line.write(0, 0x0500, b"\x00")
    line.write(0, 0x0502, b"\x00\x01")


# Sync managers


def test_a_sync_manager_that_is_on_cannot_be_set_up_anew(line: Line) -> None:
    line.write(0, 0x0810, SM_OUTPUTS)
    line.write(0, 0x0810, bytes.fromhex("0012 0400 64 00 01 00"))
    assert line.read(0, 0x0810, 4) == bytes.fromhex("0011 0200")
    line.write(0, 0x0816, b"\x00")
    line.write(0, 0x0810, bytes.fromhex("0012 0400 64 00 01 00"))
    assert line.read(0, 0x0810, 4) == bytes.fromhex("0012 0400")


def test_mailboxes_are_closed_in_init(line: Line) -> None:
    line.write(0, 0x0800, SM_MAILBOXES)
    assert line.one(DatagramCommand.FPWR, STATION, 0x1000, bytes(128)).counter == 0
    assert line.request(0, PRE_OP) == (PRE_OP, 0)
    line.write(0, 0x1000, bytes(128))
    assert line.request(0, INIT) == (INIT, 0)
    assert line.one(DatagramCommand.FPWR, STATION, 0x1000, bytes(128)).counter == 0


def test_a_request_through_the_mailbox_is_answered_and_the_mailbox_empty_after_reading(line: Line) -> None:
    line.to_pre_op()
    assert line.read(0, 0x080D, 1)[0] & 0x08 == 0
    assert line.one(DatagramCommand.FPRD, STATION, 0x1080, bytes(128)).counter == 0
    line.write(0, 0x1000, SDO_READ_NAME.ljust(128, b"\0"))
    assert line.read(0, 0x080D, 1)[0] & 0x08
    answer = line.read(0, 0x1080, 128)
    assert answer[6:16] == bytes.fromhex("0030 43 1810 01 ad0b0000")
    assert line.read(0, 0x080D, 1)[0] & 0x08 == 0
    assert line.one(DatagramCommand.FPRD, STATION, 0x1080, bytes(128)).counter == 0


def test_a_slave_that_went_to_init_has_forgotten_messages_emergencies_transfers_and_the_masters_counter(
    line: Line,
) -> None:
    line.to_pre_op()
    line.segment.slaves[0].device.emergencies.append(Emergency(0x8611, 0x21))
    line.write(0, 0x1000, SDO_READ_NAME.ljust(128, b"\0"))
    line.write(0, 0x1000, bytes.fromhex("0a00 0000 00 23 0020 21 0120 00 15000000").ljust(128, b"\0"))
    assert line.request(0, INIT) == (INIT, 0)
    line.segment.slaves[0].device.emergencies.append(Emergency(0x8611, 0x21))
    assert line.request(0, PRE_OP) == (PRE_OP, 0)
    line.write(0, 0x1000, SDO_READ_NAME.ljust(128, b"\0"))
    assert line.read(0, 0x1080, 128)[5:16] == bytes.fromhex("13 0030 43 1810 01 ad0b0000")
    line.write(0, 0x1000, bytes.fromhex("0a00 0000 00 23 0020 00 31323334353637").ljust(128, b"\0"))
    assert line.read(0, 0x1080, 128)[8:16] == bytes.fromhex("80 3132 33 01000405"), "no transfer is under way"


def test_a_full_mailbox_refuses_a_second_message(line: Line) -> None:
    line.to_pre_op()
    message = SDO_READ_NAME.ljust(128, b"\0")
    # Both in one frame: the device does not run in between.
    both = line.send(Datagram(DatagramCommand.FPWR, 1, STATION, 0x1000, message),
                     Datagram(DatagramCommand.FPWR, 2, STATION, 0x1000, message))  # fmt: skip
    assert [datagram.counter for datagram in both] == [1, 0]


def test_a_mailbox_written_in_parts_is_full_with_its_last_byte_and_wants_its_first_one_first(line: Line) -> None:
    line.to_pre_op()
    message = SDO_READ_NAME.ljust(128, b"\0")
    assert line.one(DatagramCommand.FPWR, STATION, 0x1040, message[64:]).counter == 0
    line.write(0, 0x1000, message[:64])
    assert line.read(0, 0x080D, 1)[0] & 0x08 == 0
    line.write(0, 0x1040, message[64:])
    assert line.read(0, 0x080D, 1)[0] & 0x08


def test_a_lost_answer_is_repeated_when_the_repeat_bit_is_toggled(line: Line) -> None:
    line.to_pre_op()
    line.write(0, 0x1000, SDO_READ_NAME.ljust(128, b"\0"))
    answer = line.read(0, 0x1080, 128)
    line.write(0, 0x080D, b"\x00\x03")
    assert line.read(0, 0x080E, 2)[1] & 0x02
    assert line.read(0, 0x080D, 1)[0] & 0x08
    assert line.read(0, 0x1080, 128) == answer


def test_a_message_that_waits_behind_a_repeated_one_is_not_lost(line: Line) -> None:
    line.to_pre_op()
    line.write(0, 0x1000, SDO_READ_NAME.ljust(128, b"\0"))
    first = line.read(0, 0x1080, 128)
    second_request = bytearray(SDO_READ_NAME)
    second_request[5] = 0x23
    second_request[11] = 0x02
    line.write(0, 0x1000, bytes(second_request).ljust(128, b"\0"))
    line.write(0, 0x080D, b"\x00\x03")
    assert line.read(0, 0x1080, 128) == first
    assert line.read(0, 0x1080, 128)[6:16] == bytes.fromhex("0030 43 1810 02 feca0000")


def test_a_buffer_is_handed_over_only_when_its_last_byte_is_written(line: Line) -> None:
    line.to_op()
    line.write(0, 0x1100, b"\x34")
    line.pass_time(2 * MS)
    assert line.tiny[0].out.value == 0
    line.write(0, 0x1101, b"\x12")
    line.pass_time(2 * MS)
    assert line.tiny[0].out.value == 0x1234


def test_the_master_can_neither_read_the_outputs_nor_write_the_inputs(line: Line) -> None:
    line.to_op()
    assert line.one(DatagramCommand.FPRD, STATION, 0x1100, bytes(2)).counter == 0
    assert line.one(DatagramCommand.FPWR, STATION, 0x1400, bytes(2)).counter == 0


# FMMUs


def test_bits_are_mapped_to_bits_and_those_beside_them_stay(line: Line) -> None:
    for slave in range(2):
        line.write(slave, USER_RAM, b"\xc3")
    # Slave 0: three bits from logical bit 2 to physical bit 1; slave 1: six bits across two logical bytes, to bit 0.
    line.write(0, 0x0600, fmmu(0x100, 1, USER_RAM, write=True, start_bit=2, end_bit=4, physical_bit=1))
    line.write(1, 0x0600, fmmu(0x100, 2, USER_RAM, write=True, start_bit=5, end_bit=2))
    answer = line.logical(DatagramCommand.LWR, 0x100, bytes((0b1011_0100, 0b0000_0010)))
    assert answer.counter == 2
    assert line.read(0, USER_RAM, 1)[0] == 0b1100_1011
    assert line.read(1, USER_RAM, 1)[0] == 0b1101_0101


def test_bits_of_several_slaves_are_read_into_one_byte(line: Line) -> None:
    for slave in range(3):
        line.write(slave, USER_RAM, bytes((0b0101_0000 << (slave == 1),)))
        line.write(slave, 0x0600, fmmu(0x200, 1, USER_RAM, write=False, start_bit=2 * slave, end_bit=2 * slave + 1,
                                       physical_bit=4))  # fmt: skip
    answer = line.logical(DatagramCommand.LRD, 0x200, b"\xff")
    assert answer.counter == 3
    assert answer.data[0] == 0b1101_1001


def test_a_datagram_that_covers_part_of_an_fmmu_moves_that_part(line: Line) -> None:
    line.write(0, 0x0600, fmmu(0x300, 8, USER_RAM, write=True))
    assert line.logical(DatagramCommand.LWR, 0x304, b"\xa1\xa2\xa3\xa4\xa5\xa6").counter == 1
    assert line.read(0, USER_RAM, 8) == bytes(4) + b"\xa1\xa2\xa3\xa4"


def test_a_slave_passes_on_what_the_one_before_it_has_put_into_the_datagram(line: Line) -> None:
    line.write(0, USER_RAM, b"\x77")
    line.write(0, 0x0600, fmmu(0x400, 1, USER_RAM, write=False))
    line.write(1, 0x0600, fmmu(0x400, 1, USER_RAM, write=True))
    assert line.logical(DatagramCommand.LRW, 0x400, b"\x11").counter == 3
    assert line.read(1, USER_RAM, 1) == b"\x77"


def test_a_slave_takes_its_outputs_before_it_puts_its_inputs_into_the_same_bytes(line: Line) -> None:
    line.to_safe_op()
    line.write(0, 0x0600, fmmu(0x500, 2, 0x1100, write=True))
    line.write(0, 0x0610, fmmu(0x500, 2, 0x1400, write=False))
    line.write(0, 0x0120, b"\x08\x00")
    answers = [line.logical(DatagramCommand.LRW, 0x500, b"\x41\x00") for _ in range(3)]
    assert [answer.counter for answer in answers] == [3, 3, 3]
    assert answers[2].data == b"\x42\x00"


def test_fmmus_changed_between_two_frames_are_used_at_once(line: Line) -> None:
    line.to_op()
    assert line.exchange(10, 20, 30)[1] == 9
    line.write(2, 0x060C, b"\x00")
    assert line.exchange(10, 20, 30)[1] == 7
    line.write(2, 0x060C, b"\x01")
    inputs, counter = line.exchange(10, 20, 30)
    assert (inputs, counter) == ([11, 21, 31], 9)


def test_the_copies_made_ahead_do_what_a_datagram_does_byte_by_byte(line: Line) -> None:
    line.to_op()
    line.exchange(0x0102, 0x0304, 0x0506)
    whole = line.exchange(0x0102, 0x0304, 0x0506)
    # The same bytes in datagrams that cut through the buffers are copied byte by byte.
    outputs = bytes.fromhex("0201 0403 0605")
    counters = [line.logical(DatagramCommand.LRW, at, outputs[at : at + 3]).counter for at in (0, 3)]
    inputs = b"".join(line.logical(DatagramCommand.LRD, 6 + at, bytes(3)).data for at in (0, 3))
    assert whole == ([0x0103, 0x0305, 0x0507], 9)
    assert sum(counters) == 8  # each of slaves 0 and 2 once, slave 1 in both
    assert [int.from_bytes(inputs[n : n + 2], "little") for n in (0, 2, 4)] == whole[0]
