"""SYNC0 that stops, clocks that jump and drift."""

from __future__ import annotations

import pytest

from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.slaves import ClockDrift, ClockJump, PowerFault, Sync0Lost
from rtcp.virtual.protocol import DatagramCommand
from tests.virtual.frames import Datagram
from tests.virtual.line import ACK, ERROR, MS, OP, SAFE_OP, STATION, Line, TinyDevice, begin, by_sync0, start_sync0


def local_times(line: Line) -> list[int]:
    return [slave.clock.local(line.now) for slave in line.slaves]


def test_without_sync0_a_slave_leaves_op_and_with_it_again_it_goes_on_in_the_same_grid() -> None:
    line = by_sync0(TinyDevice())
    sync0 = line.slaves[0].esc.dc.sync0
    first, pulses = sync0.next, sync0.pulses
    end = begin(line.segment, Sync0Lost(1), line.now)
    for _ in range(20):
        line.exchange(1)
    assert sync0.pulses == pulses
    assert line.al(0) == (SAFE_OP | ERROR, 0x002C)
    end(line.now)
    pulses = sync0.pulses
    line.pass_time(10 * MS)
    assert sync0.pulses == pulses + 10
    assert (sync0.next - first) % MS == 0
    assert line.request(0, SAFE_OP | ACK) == (SAFE_OP, 0)
    line.write(0, 0x0120, b"\x08\x00")
    line.exchange(1)
    assert line.al(0) == (OP, 0)


def test_sync0_that_is_activated_while_it_is_lost_begins_when_mended() -> None:
    line = Line([TinyDevice()])
    line.address()
    end = begin(line.segment, Sync0Lost(1), line.now)
    start_sync0(line, 0, MS, first_in=2 * MS)
    line.pass_time(20 * MS)
    sync0 = line.slaves[0].esc.dc.sync0
    assert (sync0.pulses, sync0.due) == (0, None)
    end(line.now)
    line.pass_time(5 * MS)
    assert sync0.pulses == 5


def test_sync0_stays_lost_through_a_loss_of_supply_and_when_lost_twice_until_cleared_twice() -> None:
    line = Line([TinyDevice()])
    ends = [begin(line.segment, Sync0Lost(1), line.now) for _ in range(2)]
    begin(line.segment, PowerFault(1), line.now)(line.now)
    line.address()
    for expected in (0, 0, 5):
        start_sync0(line, 0, MS, first_in=MS)
        line.pass_time(5 * MS + MS // 2)
        assert line.slaves[0].esc.dc.sync0.pulses == expected
        line.write(0, 0x0981, b"\x00")
        if ends:
            ends.pop()(line.now)


@pytest.mark.parametrize("us", [400.0, -400.0])
def test_a_clock_jumps_once_and_its_sync0_with_it(us: float) -> None:
    line = by_sync0(TinyDevice())
    clock, sync0 = line.slaves[0].clock, line.slaves[0].esc.dc.sync0
    before, due = clock.local(line.now), sync0.due
    line.segment.wake_at(line.now)
    line.segment.tick(line.now)
    undo = begin(line.segment, ClockJump(1, us), line.now)
    assert undo.over
    assert clock.local(line.now) - before == us * 1000
    assert sync0.due == due - us * 1000
    assert line.segment.next_event <= sync0.due
    undo(line.now)
    line.pass_time(3 * MS)
    assert clock.local(line.now) - before == us * 1000 + 3 * MS


def test_a_pulse_that_nobody_has_noticed_yet_comes_before_the_jump() -> None:
    line = by_sync0(TinyDevice())
    sync0 = line.slaves[0].esc.dc.sync0
    pulses = sync0.pulses
    line.now = sync0.due + 5_000
    begin(line.segment, ClockJump(1, 10.0), line.now)
    assert sync0.pulses == pulses + 1
    assert sync0.due is not None


def test_a_clock_that_jumps_over_its_next_pulse_has_lost_sync0() -> None:
    line = by_sync0(TinyDevice())
    begin(line.segment, ClockJump(1, 5000.0), line.now)
    for _ in range(5):
        line.exchange(1)
    assert line.al(0) == (SAFE_OP | ERROR, 0x002C)


def test_drift_compensation_takes_a_jump_back() -> None:
    line = Line([TinyDevice(), TinyDevice()])
    line.address()
    start = line.slaves[1].clock.system(line.now) - line.slaves[0].clock.system(line.now)
    line.write(1, 0x0920, (-start % 2**64).to_bytes(8, "little"))
    line.write(1, 0x0928, (820).to_bytes(4, "little"))
    begin(line.segment, ClockJump(2, 100.0), line.now)
    differences = []
    for _ in range(2000):
        line.send(Datagram(DatagramCommand.FRMW, 0, STATION, 0x0910, bytes(8)), after=MS)
        differences.append(line.slaves[1].clock.difference)
    assert abs(differences[0]) > 90_000
    assert max(map(abs, differences[-10:])) < 1000


def test_a_clock_drifts_from_now_on_until_cleared_and_its_gain_stays() -> None:
    line = Line([TinyDevice(), TinyDevice()], drifts=[0.0, 10.0])
    before = local_times(line)
    end = begin(line.segment, ClockDrift(2, 200.0), line.now)
    assert local_times(line) == before
    line.pass_time(1000 * MS)
    ran = [now - then for now, then in zip(local_times(line), before, strict=True)]
    assert ran == [10**9, pytest.approx(10**9 + 210_000, abs=2)]
    end(line.now)
    line.pass_time(1000 * MS)
    ran = [now - then for now, then in zip(local_times(line), before, strict=True)]
    assert ran == [2 * 10**9, pytest.approx(2 * 10**9 + 220_000, abs=3)]


def test_a_drift_is_still_there_after_a_loss_of_supply_and_gone_when_mended() -> None:
    line = Line([TinyDevice()])
    end = begin(line.segment, ClockDrift(1, 500.0), line.now)
    begin(line.segment, PowerFault(1), line.now)(line.now)
    line.pass_time(1000 * MS)
    assert local_times(line) == [pytest.approx(10**9 + 500_000, abs=2)]
    end(line.now)
    line.pass_time(1000 * MS)
    assert local_times(line) == [pytest.approx(2 * 10**9 + 500_000, abs=3)]


@pytest.mark.parametrize("fault", [Sync0Lost(1), ClockJump(1, 5.0), ClockDrift(1)])
def test_a_slave_without_distributed_clock_has_none_of_these_faults(fault: Sync0Lost | ClockJump | ClockDrift) -> None:
    line = Line([TinyDevice(supports_dc=False)])
    with pytest.raises(FaultRefused, match=r"slave 1 \(Tiny\) has no distributed clock"):
        begin(line.segment, fault, line.now)
