"""Distributed clocks: receive times, system time, drift compensation and SYNC0 (ETG.1000.4, 6.6)."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rtcp.virtual.distributed_clock import Clock, SyncGenerator
from rtcp.virtual.protocol import DatagramCommand
from rtcp.virtual.segment import default_delays
from tests.virtual.frames import Datagram
from tests.virtual.line import MS, STATION, Line, TinyDevice, start_sync0

FACTS = (0, 820, 1660, 2500, 3320, 4160, 5020)
DRIFTS = (3.0, -12.0, 17.5, -20.0, 8.0, -5.5, 20.0)


@pytest.fixture
def arm() -> Line:
    line = Line([TinyDevice() for _ in FACTS], DRIFTS, FACTS)
    line.address()
    return line


def set_up_time(line: Line) -> None:
    """What a master does: latch, offsets from the processing units' times, delays."""
    line.one(DatagramCommand.BWR, 0, 0x0900, bytes(4))
    for slave, delay in enumerate(FACTS):
        latched = line.number(slave, 0x0918, 8)
        line.write(slave, 0x0920, ((10**15 - latched) % 2**64).to_bytes(8, "little"))
        line.write(slave, 0x0928, delay.to_bytes(4, "little"))


def follow(line: Line, seconds: float, period: int = 500_000) -> None:
    for _ in range(int(seconds * 1e9 / period)):
        answer = line.send(Datagram(DatagramCommand.FRMW, 0, STATION, 0x0910, bytes(8)), after=period)[0]
        assert answer.counter == len(FACTS)


def spread(line: Line) -> list[int]:
    """System time of every slave minus the first one's, at one instant."""
    times = [slave.clock.system(line.now) for slave in line.slaves]
    return [time - times[0] for time in times]


def test_the_delays_are_those_of_the_robot_and_840_ns_for_each_further_slave() -> None:
    assert default_delays(3) == FACTS[:3]
    assert default_delays(9) == (*FACTS, 5860, 6700)


def test_a_write_to_0x0900_latches_times_whose_differences_give_the_delays(arm: Line) -> None:
    assert arm.one(DatagramCommand.BWR, 0, 0x0900, bytes(4)).counter == 7
    ports = [(arm.number(n, 0x0900, 4), arm.number(n, 0x0904, 4)) for n in range(7)]
    around = [back - there for there, back in ports[:-1]] + [0]
    assert ports[-1][1] == 0
    delays = [0]
    for before, behind in pairwise(around):
        delays.append(delays[-1] + (before - behind) // 2)
    assert tuple(delays) == FACTS


def test_each_clock_runs_free_with_its_drift(arm: Line) -> None:
    start = [slave.clock.local(arm.now) for slave in arm.slaves]
    arm.pass_time(1000 * MS)
    ran = [slave.clock.local(arm.now) - begun for slave, begun in zip(arm.slaves, start, strict=True)]
    assert ran == [pytest.approx(10**9 + 1000 * drift, abs=1.5) for drift in DRIFTS]


def test_system_time_is_local_time_plus_offset_at_the_arrival_of_the_frame(arm: Line) -> None:
    arm.write(3, 0x0920, (5 * 10**9).to_bytes(8, "little"))
    expected = arm.slaves[3].clock.local(arm.now + 100_000 + FACTS[3]) + 5 * 10**9
    assert arm.number(3, 0x0910, 8) == expected


def test_an_offset_may_be_negative(arm: Line) -> None:
    arm.write(2, 0x0920, (-(10**9) % 2**64).to_bytes(8, "little"))
    assert arm.slaves[2].clock.offset == -(10**9)


def test_seven_drifting_clocks_agree_within_100_ns_after_a_second(arm: Line) -> None:
    set_up_time(arm)
    follow(arm, 1.0)
    assert max(map(abs, spread(arm))) < 100
    difference = arm.number(6, 0x092C, 4)
    assert difference & 0x7FFFFFFF < 100


def test_clocks_that_are_no_longer_steered_keep_the_rate_they_learnt(arm: Line) -> None:
    set_up_time(arm)
    follow(arm, 2.0)
    arm.pass_time(1000 * MS)
    assert max(map(abs, spread(arm))) < 1000


def test_rare_references_steer_too(arm: Line) -> None:
    set_up_time(arm)
    follow(arm, 10.0, period=10 * MS)
    assert max(map(abs, spread(arm))) < 1000


def test_the_reference_runs_free(arm: Line) -> None:
    set_up_time(arm)
    begin = arm.slaves[0].clock.local(arm.now)
    started = arm.now
    follow(arm, 1.0)
    ran = arm.slaves[0].clock.local(arm.now) - begin
    passed = arm.now - started
    assert ran == pytest.approx(passed * (1 + DRIFTS[0] * 1e-6), abs=2)


def test_time_never_runs_backwards_while_a_clock_is_steered_from_far_off() -> None:
    clock = Clock(20.0, 0, 0)
    last = -1
    for n in range(1, 2000):
        t = n * 100_000
        clock.follow(t, t - 50_000_000 & 0xFFFFFFFF)
        assert clock.local(t) > last
        last = clock.local(t)


def test_the_sign_of_the_difference_is_in_bit_31(arm: Line) -> None:
    set_up_time(arm)
    here = arm.slaves[1].clock.system(arm.now + 100_000 + FACTS[1]) - FACTS[1]
    arm.write(1, 0x0910, ((here + 300) & 0xFFFFFFFF).to_bytes(4, "little"))
    assert arm.number(1, 0x092C, 4) == 0x80000000 | 300


def test_sync0_comes_at_the_start_time_and_every_cycle_after_it() -> None:
    line = Line([TinyDevice()])
    line.address()
    start_sync0(line, 0, MS, first_in=10 * MS)
    start = int.from_bytes(line.slaves[0].esc.memory[0x0990:0x0998], "little")
    sync0 = line.slaves[0].esc.dc.sync0
    assert line.read(0, 0x0984, 1) == b"\x01"
    line.pass_time(20 * MS)
    assert sync0.pulses == 11
    assert sync0.next == start + 11 * MS
    assert line.slaves[0].clock.system(sync0.due) == pytest.approx(sync0.next, abs=1)


def test_sync0_of_all_slaves_comes_within_a_microsecond(arm: Line) -> None:
    set_up_time(arm)
    follow(arm, 1.0)
    begin = arm.number(0, 0x0910, 8) // MS * MS + 20 * MS
    for slave in range(7):
        arm.write(slave, 0x0990, begin.to_bytes(8, "little"))
        arm.write(slave, 0x09A0, (500_000).to_bytes(4, "little"))
        arm.write(slave, 0x0981, b"\x03")
    follow(arm, 0.5)
    due = [slave.esc.dc.sync0.due for slave in arm.slaves]
    assert max(due) - min(due) < 1000


def test_a_start_time_in_the_past_brings_no_pulse() -> None:
    clock = Clock(0.0, 0, 0)
    sync0 = SyncGenerator(clock)
    sync0.activate(start=999, cycle=500, t=1000)
    assert sync0.due is None
    assert sync0.lost


@pytest.mark.parametrize("unix_s", [600, 946_684_700, 1_790_000_000])
def test_a_system_time_before_2000_starts_sync0_as_any_other(unix_s: int) -> None:
    line = Line([TinyDevice()])
    line.address()
    own = line.number(0, 0x0910, 8)
    line.write(0, 0x0920, ((unix_s - 946_684_800) * 10**9 - own & (1 << 64) - 1).to_bytes(8, "little"))
    start_sync0(line, 0, MS, first_in=100 * MS)
    assert 0 < line.slaves[0].esc.dc.sync0.due - line.now < 100 * MS
    line.pass_time(200 * MS)
    assert line.slaves[0].esc.dc.sync0.pulses > 100


def test_a_clock_of_32_bits_shows_and_takes_the_low_half_of_times_and_wraps() -> None:
    line = Line([TinyDevice()], clock_bits=(32,))
    line.address()
    features = line.number(0, 0x0008, 2)
    assert features & 0x000C == 0x0004
    line.write(0, 0x0920, ((1 << 64) - 1).to_bytes(8, "little"))
    assert line.number(0, 0x0920, 8) == (1 << 32) - 1
    line.pass_time((1 << 32) - line.slaves[0].clock.local(line.now) - 50 * MS)
    before = line.number(0, 0x0910, 8)
    start_sync0(line, 0, MS, first_in=100 * MS)
    line.pass_time(90 * MS)
    after = line.send(Datagram(DatagramCommand.FRMW, 0, STATION, 0x0910, bytes(8)))[0]
    assert int.from_bytes(after.data, "little") < 100 * MS < before < 1 << 32
    line.pass_time(20 * MS)
    sync0 = line.slaves[0].esc.dc.sync0
    assert 0 < sync0.pulses < 20
    assert line.number(0, 0x0990, 8) < 1 << 32


def test_a_start_time_in_the_past_of_a_clock_of_32_bits_comes_after_its_wrap() -> None:
    clock = Clock(0.0, 0, 0, 32)
    sync0 = SyncGenerator(clock)
    sync0.activate(start=999, cycle=500, t=1000)
    assert sync0.due == (1 << 32) + 999


def test_pulses_skipped_after_a_stop_keep_to_the_grid() -> None:
    clock = Clock(-20.0, 0, 0)
    sync0 = SyncGenerator(clock)
    sync0.activate(start=10_000, cycle=500_000, t=0)
    sync0.skip_to(50 * MS)
    assert (sync0.next - 10_000) % 500_000 == 0
    assert sync0.next <= clock.system(50 * MS) < sync0.next + 500_000
