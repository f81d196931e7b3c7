"""Clocks of 32 and 64 bits on one time: the start, the loop and recovery, over wraps and with any clock of the host."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from rtcp.fieldbus import clocks
from rtcp.fieldbus.bus import station_of
from rtcp.fieldbus.clocks import start_clocks, start_sync, take_over_time
from rtcp.fieldbus.registers import Answer, DatagramCommand, build_frame
from rtcp.fieldbus.system_time import SystemTime
from rtcp.realtime.discipline import Discipline
from rtcp.virtual.protocol import DatagramCommand as WireCommand
from tests.fieldbus.direct import Direct
from tests.fieldbus.master_child import arm
from tests.virtual.frames import Datagram
from tests.virtual.line import MS, STATION, Line, TinyDevice

WRAP = 1 << 32
UNTIL_2000 = 946_684_800 * 10**9
IN_2026 = UNTIL_2000 + 193_000_000 * WRAP
DRIFTS = (50.0, -12.0, 17.5)
MIXTURES = [(32, 32, 32), (32, 64, 32), (64, 32, 64)]


class LinePort(Direct):
    """Exchanges frames with a line, one each millisecond of its time."""

    def __init__(self, line: Line) -> None:
        super().__init__(line.segment)
        self.line = line

    def exchange(
        self, command: DatagramCommand, station: int, address: int, data: bytes, *, timeout_s: float = 0.02,
        tries: int = 3,
    ) -> Answer:  # fmt: skip
        self.line.pass_time(MS)
        frame = self.line.raw(build_frame(command, 0x80, station, address, data))
        assert frame is not None
        end = 26 + len(data)
        return Answer(frame[26:end], int.from_bytes(frame[end : end + 2], "little"))


class Soem:
    """In place of SOEM, whose socket this port has not."""

    def config_dc(self) -> bool:
        return True


class Host:
    """Slaves on a line, and the host whose clocks are the line's time and `wall_ns`."""

    def __init__(self, bits: tuple[int, ...], wall_ns: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall_ns = wall_ns
        count = len(bits)
        delays = [820 * n for n in range(count)]
        self.line = Line([TinyDevice() for _ in bits], DRIFTS[:count], delays, clock_bits=bits)
        self.line.address()
        self.port = LinePort(self.line)
        own = SimpleNamespace(
            monotonic_ns=lambda: self.line.now, time_ns=lambda: self.wall_ns, monotonic=time.monotonic
        )
        monkeypatch.setattr(clocks, "time", own)
        self.slaves = [arm(2)[1]] * count

    def start(self, period_ns: int) -> SystemTime:
        return start_clocks(Soem(), self.port, self.slaves, period_ns)[0]

    def error_of(self, system_time: SystemTime) -> int:
        """Return by how much the system time is ahead of the low 32 bits of the reference clock, ns."""
        assert system_time.offset_ns is not None
        error = self.line.now + system_time.offset_ns - self.line.slaves[0].clock.system(self.line.now)
        return (error + WRAP // 2) % WRAP - WRAP // 2

    def sync0_beside_the_grid(self, period_ns: int, offset_ns: int) -> list[int]:
        """For each slave the time from an instant of the grid to its next SYNC0, ns."""
        dues = [slave.esc.dc.sync0.due for slave in self.line.slaves]
        return [(due + offset_ns + period_ns // 2) % period_ns - period_ns // 2 for due in dues]

    def cycles(self, discipline: Discipline, period_ns: int, seconds: float) -> Iterator[int]:
        """Do the cycles of a loop; yield when each frame was sent."""
        line = self.line
        planned = line.now + period_ns
        until = line.now + seconds * 1e9
        while planned < until:
            clock = line.send(Datagram(WireCommand.FRMW, 0, STATION, 0x0910, bytes(8)), after=planned - line.now)[0]
            discipline.observe(planned, int.from_bytes(clock.data, "little"))
            yield planned
            planned = discipline.next_wakeup(planned)


@pytest.mark.parametrize("bits", MIXTURES)
@pytest.mark.parametrize("before_ns", [MS, 12 * MS, 60 * MS, 150 * MS, 2000 * MS])
def test_the_first_sync0_of_all_slaves_lies_on_one_grid_although_a_clock_is_about_to_wrap(
    bits: tuple[int, ...], before_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    period_ns = 4 * MS
    host = Host(bits, IN_2026 - before_ns, monkeypatch)
    offset = host.start(period_ns).offset_ns
    assert offset is not None
    # Each slave's own crystal runs on since its clock was set.
    assert host.sync0_beside_the_grid(period_ns, offset) == pytest.approx([0] * len(bits), abs=100_000)
    dues = [slave.esc.dc.sync0.due for slave in host.line.slaves]
    assert all(0 < due - host.line.now < 110 * MS + period_ns for due in dues)


@pytest.mark.parametrize(
    ("bits", "period_ns", "seconds"),
    [((32, 32, 32), 250_000, 3), ((32, 32, 32), MS, 7), *((bits, 4 * MS, 30) for bits in MIXTURES)],
)
def test_phase_and_lock_are_those_of_64_bits_over_wraps(
    bits: tuple[int, ...], period_ns: int, seconds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = Host(bits, IN_2026 - 1500 * MS, monkeypatch)
    system_time = host.start(period_ns)
    discipline = Discipline(period_ns, period_ns // 2, system_time)
    phases = []
    for number, sent in enumerate(host.cycles(discipline, period_ns, seconds)):
        if number > 1000:
            assert discipline.locked
            if number % 100 == 0:
                dues = [slave.esc.dc.sync0.due for slave in host.line.slaves]
                phases += [(due - sent) % period_ns for due in dues]
    assert phases == pytest.approx([period_ns // 2] * len(phases), abs=3000)
    # The reference has drifted away from the host: recovery needs to know.
    assert abs(host.error_of(system_time)) < 5000


@pytest.mark.parametrize("bits", MIXTURES)
@pytest.mark.parametrize("place", [0, 2])
def test_a_slave_that_returns_gets_time_and_sync0_of_the_others(
    bits: tuple[int, ...], place: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = Host(bits, IN_2026 - 500 * MS, monkeypatch)
    system_time = host.start(MS)
    discipline = Discipline(MS, MS // 2, system_time)
    for _ in host.cycles(discipline, MS, 5.0):
        pass
    line, station, label = host.line, station_of(place + 1), "slave"
    slave = line.slaves[place]
    slave.power_off(line.now)
    slave.power_on(line.now)
    line.address()
    # What it shows before its clock is set reaches no cycle: it has no address until then.
    others = [position for position in (1, 2, 3) if position != place + 1]
    delay = (820 * place).to_bytes(4, "little")
    take_over_time(host.port, station, label, delay, others, system_time, always=True)
    start_sync(host.port, station, label, host.slaves[place].device, MS, system_time)
    assert system_time.offset_ns is not None
    assert host.sync0_beside_the_grid(MS, system_time.offset_ns) == pytest.approx([0] * 3, abs=100_000)


@pytest.mark.parametrize("wall_ns", [0, 600 * 10**9, UNTIL_2000 - 50 * MS, UNTIL_2000 + 1, IN_2026, 3 * UNTIL_2000])
def test_the_hosts_clock_may_show_any_date(wall_ns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    bits = (64, 32, 64)
    host = Host(bits, wall_ns, monkeypatch)
    system_time = host.start(MS)
    offset = system_time.offset_ns
    assert offset is not None
    assert host.sync0_beside_the_grid(MS, offset) == pytest.approx([0] * 3, abs=100_000)
    shown = [host.line.number(n, 0x0910, 8) for n in range(3)]
    assert all(WRAP < time_ns < 1 << 62 for time_ns, own in zip(shown, bits, strict=True) if own == 64)


@pytest.mark.parametrize("bits", [(64,), (32,)])
@pytest.mark.parametrize("set_to", [0, IN_2026 + 3600 * 10**9])
def test_a_hosts_clock_that_is_set_under_way_does_not_move_the_only_slaves_time(
    bits: tuple[int, ...], set_to: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = Host(bits, IN_2026, monkeypatch)
    system_time = host.start(MS)
    line = host.line
    host.wall_ns = set_to
    line.slaves[0].power_off(line.now)
    line.slaves[0].power_on(line.now)
    line.address()
    take_over_time(host.port, STATION, "slave", bytes(4), (), system_time, always=True)
    assert abs(host.error_of(system_time)) < MS
