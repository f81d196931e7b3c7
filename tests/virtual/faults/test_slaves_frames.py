"""Cables that damage frames, and slaves that do not count themselves."""

from __future__ import annotations

from typing import Literal

import pytest

from rtcp.fieldbus.port_errors import ErrorCounters
from rtcp.fieldbus.registers import Answer, RegisterPort
from rtcp.ipc.events import CableEvent
from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.slaves import CableFault, Corrupt, WorkingCounter
from rtcp.virtual.protocol import DatagramCommand
from tests.virtual.frames import Datagram, build
from tests.virtual.line import MS, STATION, Line, begin, in_op

COUNTERS = 0x0300


class Direct(RegisterPort):
    """The master's register port, directly on the slaves, without a socket."""

    def __init__(self, line: Line) -> None:
        self._line = line

    def exchange(self, command: int, station: int, address: int, data: bytes, *, timeout_s: float = 0.02,
                 tries: int = 3) -> Answer:  # fmt: skip
        answer = self._line.one(DatagramCommand(command), station, address, data)
        return Answer(answer.data, answer.counter)


def lrw(*outputs: int) -> bytes:
    data = b"".join(value.to_bytes(2, "little") for value in outputs)
    return build(Datagram(DatagramCommand.LRW, 0, 0, 0, data + bytes(len(data))))


def errors(line: Line, port: int = 0) -> list[tuple[int, int, int]]:
    """For each slave: invalid frames, receive errors and forwarded errors of a port."""
    counters = [line.read(n, COUNTERS, 20) for n in range(len(line.slaves))]
    return [(raw[2 * port], raw[2 * port + 1], raw[8 + port]) for raw in counters]


@pytest.mark.parametrize("after", [0, 1, 3])
def test_slaves_before_the_damage_do_their_work_the_next_counts_an_error_and_those_behind_a_forwarded_one(
    after: int,
) -> None:
    line = in_op()
    undo = begin(line.segment, Corrupt(after, burst=1), line.now)
    line.pass_time(MS)
    assert line.raw(lrw(1, 2, 3, 4)) is None
    assert undo.over
    assert undo.counts == {"corrupted": 1}
    assert [device.out.value for device in line.tiny] == [1, 2, 3, 4][:after] + [0] * (4 - after)
    assert errors(line) == [(0, 0, 0)] * after + [(1, 1, 0)] + [(0, 0, 1)] * (3 - after)
    assert line.exchange(5, 6, 7, 8)[1] == 12
    assert line.exchange(5, 6, 7, 8) == ([6, 7, 8, 9], 12)


def test_a_slave_before_the_damage_does_what_a_request_asks_and_a_slave_behind_it_does_not() -> None:
    line = in_op()
    begin(line.segment, Corrupt(2, burst=3), line.now)
    for slave in (0, 3):
        line.raw(build(Datagram(DatagramCommand.FPWR, 0, STATION + slave, 0x0120, b"\x04\x00")))
    line.raw(build(Datagram(DatagramCommand.FRMW, 0, STATION, 0x0910, bytes(8))))
    assert [line.al(n)[0] for n in range(4)] == [4, 8, 8, 8]


def test_damage_to_every_frame_ends_with_the_fault_and_the_counters_stop_at_255() -> None:
    line = in_op()
    end = begin(line.segment, Corrupt(2, rate=1.0), line.now)
    for _ in range(300):
        assert line.raw(lrw(0, 0, 0, 0)) is None
    assert end.counts == {"corrupted": 300}
    assert not end.over
    end(line.now)
    assert errors(line) == [(0, 0, 0)] * 2 + [(255, 255, 0), (0, 0, 255)]
    assert not line.segment.damages


def test_a_rate_damages_its_share_and_the_same_frames_with_the_same_seed() -> None:
    def damaged() -> list[bool]:
        line = in_op(2)
        begin(line.segment, Corrupt(1, rate=0.2, seed=7), line.now)
        return [line.raw(lrw(0, 0)) is None for _ in range(500)]

    first = damaged()
    assert 60 < sum(first) < 140
    assert damaged() == first


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_all_slaves_have_worked_when_a_frame_is_damaged_on_its_way_back_and_those_before_the_cable_count_at_port_1(
    after: int,
) -> None:
    line = in_op()
    undo = begin(line.segment, Corrupt(after, "back", burst=1), line.now)
    line.pass_time(MS)
    assert line.raw(lrw(1, 2, 3, 4)) is None
    assert undo.over
    assert undo.counts == {"corrupted": 1}
    assert [device.out.value for device in line.tiny] == [1, 2, 3, 4]
    assert errors(line, 1) == ([(0, 0, 1)] * (after - 1) + [(1, 1, 0)] * bool(after) + [(0, 0, 0)] * (4 - after))
    assert errors(line) == [(0, 0, 0)] * 4
    assert line.exchange(5, 6, 7, 8)[1] == 12
    assert line.exchange(5, 6, 7, 8) == ([6, 7, 8, 9], 12)


def test_a_request_in_a_frame_that_is_damaged_on_its_way_back_is_done() -> None:
    line = in_op()
    begin(line.segment, Corrupt(2, "back", burst=2), line.now)
    for slave in (0, 3):
        assert line.raw(build(Datagram(DatagramCommand.FPWR, 0, STATION + slave, 0x0120, b"\x04\x00"))) is None
    assert [line.al(n)[0] for n in range(4)] == [4, 8, 8, 4]


def test_a_frame_that_is_damaged_twice_counts_as_an_error_where_it_is_damaged_first() -> None:
    line = in_op()
    undo = [
        begin(line.segment, Corrupt(1, "back", rate=1.0), line.now),
        begin(line.segment, Corrupt(2, "back", rate=1.0), line.now),
    ]
    assert line.raw(lrw(1, 2, 3, 4)) is None
    undo.append(begin(line.segment, Corrupt(3, rate=1.0), line.now))
    assert line.raw(lrw(5, 6, 7, 8)) is None
    assert [each.counts["corrupted"] for each in undo] == [2, 2, 1]
    for each in undo:
        each(line.now)
    assert errors(line, 1) == [(0, 0, 1), (1, 1, 0), (0, 0, 0), (0, 0, 0)]
    assert errors(line) == [(0, 0, 0)] * 3 + [(1, 1, 0)]
    assert not line.segment.damages


@pytest.mark.parametrize("way", ["out", "back"])
@pytest.mark.parametrize("after", [0, 1, 2])
def test_the_master_names_the_cable_over_which_damaged_frames_come_whichever_way_they_went(
    after: int, way: Literal["out", "back"]
) -> None:
    line = in_op(3)
    events: list[CableEvent] = []
    counters = ErrorCounters(Direct(line), 3, events.append)
    undo = begin(line.segment, Corrupt(after, way, burst=5), line.now)
    for _ in range(5):
        assert line.raw(lrw(0, 0, 0)) is None
    assert undo.over
    for _ in range(3):
        counters.read_next()
    counters.report_due()
    # Only the master's network card receives frames that the first cable damages on their way back.
    cables = [] if (after, way) == (0, "back") else [(after, after + 1, 5)]
    assert [(event.near, event.far, event.count) for event in events] == cables


@pytest.mark.parametrize("after", [2, 3])
def test_a_frame_that_turns_round_before_the_damage_is_sound(after: int) -> None:
    line = in_op()
    begin(line.segment, Corrupt(after, rate=1.0), line.now)
    begin(line.segment, CableFault(2), line.now)
    assert line.one(DatagramCommand.BRD, 0, 0, bytes(1)).counter == 2


def test_a_burst_that_has_passed_costs_nothing_more() -> None:
    line = in_op()
    undo = begin(line.segment, Corrupt(2, burst=2), line.now)
    other = begin(line.segment, WorkingCounter(1, burst=1), line.now)
    assert [line.raw(lrw(0, 0, 0, 0)) is None for _ in range(3)] == [True, True, False]
    assert not line.segment.damages
    assert not line.segment.miscounts
    undo(line.now)
    other(line.now)


def test_there_is_no_cable_to_damage_frames_behind_the_last_slave() -> None:
    with pytest.raises(FaultRefused, match="no cable behind slave 4"):
        begin(in_op().segment, Corrupt(4, burst=1), 0)


@pytest.mark.parametrize(
    ("command", "share", "full"),
    [(DatagramCommand.LRW, 3, 12), (DatagramCommand.LRD, 1, 4), (DatagramCommand.LWR, 1, 4)],
)
def test_the_counter_lacks_the_share_of_a_slave_that_took_part(command: DatagramCommand, share: int, full: int) -> None:
    line = in_op()
    line.exchange(1, 2, 3, 4)
    end = begin(line.segment, WorkingCounter(2, rate=1.0), line.now)
    data = bytes.fromhex("0500 0600 0700 0800") + bytes(8)
    answer = line.logical(command, 0, data)
    assert answer.counter == full - share
    if command != DatagramCommand.LWR:
        assert answer.data[8:] == bytes.fromhex("0200 0300 0400 0500")
    line.pass_time(MS)
    assert line.tiny[1].out.value == (2 if command == DatagramCommand.LRD else 6)
    assert line.one(DatagramCommand.BRD, 0, 0, bytes(1)).counter == 4
    end(line.now)
    assert line.logical(command, 0, data).counter == full


@pytest.mark.parametrize("slave", [2, 3])
def test_the_share_is_missing_also_where_a_datagram_holds_half_a_buffer(slave: int) -> None:
    line = in_op()
    assert line.logical(DatagramCommand.LRD, 10, bytes(3)).counter == 2
    begin(line.segment, WorkingCounter(slave, rate=1.0), line.now)
    assert line.logical(DatagramCommand.LRD, 10, bytes(3)).counter == 1


def test_a_slave_without_outputs_taken_lacks_only_what_it_counts() -> None:
    line = in_op()
    line.write(1, 0x0120, b"\x02\x00")
    begin(line.segment, WorkingCounter(2, rate=1.0), line.now)
    assert line.exchange()[1] == 9


def test_a_burst_is_so_many_process_data_datagrams_and_no_others() -> None:
    line = in_op()
    undo = begin(line.segment, WorkingCounter(2, burst=2), line.now)
    line.one(DatagramCommand.BRD, 0, 0, bytes(1))
    assert [line.exchange()[1] for _ in range(4)] == [9, 9, 12, 12]
    assert undo.over
    assert undo.counts == {"not_counted": 2}
