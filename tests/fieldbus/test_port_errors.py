"""Error counters of the ports, read from virtual slave controllers without a wire."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.port_errors import ErrorCounters
from rtcp.fieldbus.registers import DatagramCommand
from rtcp.ipc.events import CableEvent, DamagedFrames, LinkLost
from rtcp.virtual.segment import make_segment
from tests.fieldbus.direct import Direct

MODELS = ("diewu-io", "cubemars-orh70", "cubemars-orh70")


class Bench:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.segment = make_segment(SegmentConfig(tuple(SegmentSlave(model=model) for model in MODELS), Path()), 0)
        self.port = Direct(self.segment)
        for position, slave in enumerate(self.segment.slaves, 1):
            slave.esc.write(0x0010, (0x1000 + position).to_bytes(2, "little"), 0)
        self.now = 100.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        self.reported: list[CableEvent] = []
        self.set(2, 0, 7)
        self.counters = ErrorCounters(self.port, len(MODELS), self.reported.append)

    def set(self, position: int, register: int, value: int) -> None:
        self.segment.slaves[position - 1].esc.memory[0x0300 + register] = value

    def get(self, position: int, register: int) -> int:
        return self.segment.slaves[position - 1].esc.memory[0x0300 + register]

    def round(self) -> list[CableEvent]:
        """Read every slave once; return what is reported."""
        self.reported.clear()
        for _ in MODELS:
            self.counters.read_next()
        self.counters.report_due()
        return list(self.reported)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_what_was_counted_before_the_start_is_nobodys_fault(bench: Bench) -> None:
    assert bench.round() == []
    assert [sum(slave.rx) for slave in bench.counters.of] == [0, 0, 0]


def test_counters_are_cleared_before_they_stop_and_the_sum_goes_on(bench: Bench) -> None:
    for shown in (107, 150, 60, 200, 255):
        bench.set(2, 0, shown)
        bench.round()
        assert bench.get(2, 0) < 128
    assert sum(bench.counters.of[1].rx) == 100 + 43 + 60 + 140 + 255


def test_a_frame_that_counts_as_damaged_and_as_received_wrongly_is_one(bench: Bench) -> None:
    bench.set(2, 0, 12)
    bench.set(2, 1, 4)
    bench.round()
    assert sum(bench.counters.of[1].rx) == 5


@pytest.mark.parametrize(
    ("position", "register", "near", "far"), [(1, 0x00, 0, 1), (2, 0x00, 1, 2), (1, 0x02, 1, 2), (3, 0x02, 3, 0)]
)
def test_errors_of_a_port_name_the_cable_that_is_plugged_in_there(
    bench: Bench, position: int, register: int, near: int, far: int
) -> None:
    bench.set(position, register, bench.get(position, register) + 3)
    (event,) = bench.round()
    assert event == DamagedFrames(near, far, 3, event.began_ns)


def test_forwarded_errors_name_no_cable(bench: Bench) -> None:
    bench.set(3, 0x08, 9)
    assert bench.round() == []
    assert sum(bench.counters.of[2].forwarded) == 9


def test_a_bad_cable_is_told_at_its_beginning_then_every_ten_seconds_with_the_number(bench: Bench) -> None:
    reports = []
    for second in range(25):
        bench.now = 100.0 + second
        bench.set(2, 0, 7 + 2 * (second + 1))
        reports += [(second, event.count) for event in bench.round()]
    assert reports == [(0, 2), (10, 22), (20, 42)]


def test_a_link_that_both_its_ends_lost_was_lost_once(bench: Bench) -> None:
    bench.set(2, 0x11, 1)
    bench.set(3, 0x10, 1)
    (event,) = bench.round()
    assert event == LinkLost(2, 3, 1, event.began_ns)
    assert [sum(slave.links) for slave in bench.counters.of] == [0, 1, 1]


def test_a_slave_that_was_without_supply_counts_from_zero(bench: Bench) -> None:
    bench.set(2, 0, 100)
    bench.round()
    bench.set(2, 0, 3)
    bench.round()
    assert sum(bench.counters.of[1].rx) == 93 + 3


def test_errors_that_are_no_cables_are_not_cleared_for_ever(bench: Bench) -> None:
    bench.set(2, 0x0D, 200)
    bench.set(2, 0x00, 9)
    bench.round()
    assert (bench.get(2, 0x0D), bench.get(2, 0x00)) == (200, 9)
    assert sum(bench.counters.of[1].rx) == 2


def test_links_whose_clearing_got_lost_are_not_counted_twice(bench: Bench) -> None:
    bench.port.lost = {(DatagramCommand.FPWR, 0x0310)}
    bench.set(2, 0x00, 130)
    for _ in range(3):
        # Not all slave controllers clear the links with the first write.
        bench.set(2, 0x11, 200)
        bench.round()
    assert (sum(bench.counters.of[1].rx), sum(bench.counters.of[1].links)) == (123, 200)
    bench.port.lost.clear()
    bench.round()
    bench.set(2, 0x11, 3)
    bench.round()
    assert sum(bench.counters.of[1].links) == 203


def test_a_cable_that_damages_frames_on_their_way_back_is_the_one_that_is_named(bench: Bench) -> None:
    # The slave before the cable counts them, at its port away from the master; the others forward them.
    bench.set(2, 0x02, 4)
    bench.set(2, 0x03, 4)
    bench.set(1, 0x09, 4)
    (event,) = bench.round()
    assert event == DamagedFrames(2, 3, 4, event.began_ns)
    assert [(sum(slave.rx), sum(slave.forwarded)) for slave in bench.counters.of] == [(0, 4), (4, 0), (0, 0)]
