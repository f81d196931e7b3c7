"""SDO services that are answered late or aborted."""

from __future__ import annotations

import struct

import pytest

from rtcp.virtual.device import Emergency
from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.slaves import PowerFault, SdoAbort, SdoLate
from rtcp.virtual.protocol import DatagramCommand
from tests.virtual.line import MS, PRE_OP, SM_MAILBOXES, STATION, Line, TinyDevice, begin

OUT, IN, SIZE = 0x1000, 0x1080, 0x80


class Master:
    """The mailbox of slave 1, in PRE-OP."""

    def __init__(self) -> None:
        self.line = Line([TinyDevice(), TinyDevice()])
        self.line.to_pre_op()
        self.counter = 0

    def ask(self, index: int, subindex: int = 1, command: int = 0x40, data: int = 0) -> int:
        """Write an SDO request; return the instant at which it arrived."""
        self.counter = self.counter % 7 + 1
        sdo = struct.pack("<BHBI", command, index, subindex, data)
        message = struct.pack("<HHBB", 10, 0, 0, self.counter << 4 | 3) + b"\x00\x20" + sdo
        self.line.write(0, OUT, message.ljust(SIZE, b"\0"))
        return self.line.now

    def answer(self) -> bytes | None:
        """Content of SM1 behind the mailbox header; None: empty."""
        mailbox = self.line.one(DatagramCommand.FPRD, STATION, IN, bytes(SIZE))
        return mailbox.data[6 : 6 + mailbox.data[0]] if mailbox.counter else None

    def wait(self, ms: int) -> tuple[bytes, int]:
        """Poll each 100 us; return the answer and the instant at which it was read."""
        for _ in range(10 * ms):
            if (answer := self.answer()) is not None:
                return answer, self.line.now
        raise AssertionError(f"no answer within {ms} ms")

    def abort_code(self, index: int, command: int = 0x40) -> int:
        self.ask(index, command=command)
        answer, _ = self.wait(5)
        return int.from_bytes(answer[6:10], "little") if answer[2] == 0x80 else 0


def test_an_answer_comes_so_much_later_and_afterwards_at_once_again() -> None:
    master = Master()
    end = begin(master.line.segment, SdoLate(1, 20.0), master.line.now)
    requested_at = master.ask(0x7000)
    answer, at = master.wait(50)
    assert answer[2:6] == bytes.fromhex("4b 00 70 01")
    assert 20 * MS <= at - requested_at < 22 * MS
    end(master.line.now)
    requested_at = master.ask(0x7000)
    assert master.wait(5)[1] - requested_at < MS


def test_other_traffic_waits_behind_a_late_answer_in_order() -> None:
    master = Master()
    begin(master.line.segment, SdoLate(1, 20.0), master.line.now)
    first = master.ask(0x7000)
    master.line.devices[0].emergencies.append(Emergency(0x1234, 0))
    master.line.pass_time(5 * MS)
    second = master.ask(0x6000)
    answers = [master.wait(50) for _ in range(3)]
    assert [at - first >= 20 * MS for _, at in answers] == [True] * 3
    assert answers[2][1] - second >= 20 * MS
    assert answers[0][0][2:4] == b"\x34\x12" or answers[1][0][2:4] == b"\x34\x12"
    indices = [answer[3:5] for answer, _ in answers if answer[1] >> 4 == 3]
    assert indices == [b"\x00\x70", b"\x00\x60"]


def test_the_other_slaves_answer_at_once() -> None:
    master = Master()
    begin(master.line.segment, SdoLate(2, 20.0), master.line.now)
    requested_at = master.ask(0x7000)
    assert master.wait(5)[1] - requested_at < MS


def test_of_several_delays_the_longest_counts() -> None:
    master = Master()
    begin(master.line.segment, SdoLate(1, 30.0), master.line.now)
    begin(master.line.segment, SdoLate(1, 10.0), master.line.now)
    requested_at = master.ask(0x7000)
    assert 30 * MS <= master.wait(50)[1] - requested_at < 32 * MS


@pytest.mark.parametrize("command", [0x40, 0x2B], ids=["upload", "download"])
def test_every_service_is_aborted_with_the_code_and_changes_nothing(command: int) -> None:
    master = Master()
    end = begin(master.line.segment, SdoAbort(1, 0x08000021), master.line.now)
    before = master.line.tiny[0].out.value
    assert master.abort_code(0x7000, command) == 0x08000021
    assert master.line.tiny[0].out.value == before
    assert master.abort_code(0x1018, 0x40) == 0x08000021
    end(master.line.now)
    assert master.abort_code(0x7000, command) == 0


def test_only_the_object_named_is_aborted() -> None:
    master = Master()
    begin(master.line.segment, SdoAbort(1, 0x08000022, 0x7000), master.line.now)
    assert master.abort_code(0x6000) == 0
    assert master.abort_code(0x7000) == 0x08000022


def test_the_fault_is_still_there_after_a_loss_of_supply() -> None:
    master = Master()
    line = master.line
    begin(line.segment, SdoAbort(1, 0x08000021), line.now)
    begin(line.segment, PowerFault(1), line.now)(line.now)
    line.address()
    line.write(0, 0x0800, SM_MAILBOXES)
    assert line.request(0, PRE_OP) == (PRE_OP, 0)
    assert master.abort_code(0x7000) == 0x08000021


@pytest.mark.parametrize("fault", [SdoLate(3, 1.0), SdoAbort(3)])
def test_there_must_be_such_a_slave(fault: SdoLate | SdoAbort) -> None:
    with pytest.raises(FaultRefused, match="no slave 3: the segment has slaves 1 to 2"):
        begin(Master().line.segment, fault, 0)
