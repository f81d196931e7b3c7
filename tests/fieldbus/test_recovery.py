"""The watcher, turn by turn: slaves that leave OP, stay away, or change their state late."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.fieldbus import recovery, supervision
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import station_of
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import Answer, DatagramCommand, Register, RegisterPort, Steps
from rtcp.fieldbus.supervision import SlaveWatcher
from rtcp.ipc.events import Event, SlavesBackInOp, SlavesLeftOp

COUNT = 3
OP, SAFEOP, PREOP, INIT = AlState.OP, AlState.SAFEOP, AlState.PREOP, AlState.INIT
FALLEN = SAFEOP | 0x10
TURN_S = 0.01


class Slaves(RegisterPort):
    """AL states alone; a request changes them at once, or where `slow` is a list when `act` is called."""

    def __init__(self) -> None:
        self.al = [int(OP)] * COUNT
        self.slow: list[tuple[int, int]] | None = None
        """Delayed requests: index and state; None: slaves are not slow."""
        self.deaf: set[int] = set()
        """Positions that receive no requests."""
        self.requests: list[tuple[int, int]] = []
        """Position and state."""
        self.lost: set[int] = set()
        """Positions whose answers get lost."""

    def exchange(
        self,
        command: DatagramCommand,
        station: int,
        address: int,
        data: bytes,
        *,
        timeout_s: float = 0.02,
        tries: int = 3,
    ) -> Answer:
        if command is DatagramCommand.BRD:
            together = 0
            for status in self.al:
                together |= status
            return Answer(bytes((together, 0)), len(self.al))
        index = station - station_of(1)
        if command is DatagramCommand.FPRD and address == Register.AL_STATUS:
            if index + 1 in self.lost:
                return Answer(b"", -1)
            return Answer(bytes((self.al[index], 0, 0, 0, 0x1A if self.al[index] & 0x10 else 0, 0)), 1)
        if command is DatagramCommand.FPWR and address == Register.AL_CONTROL:
            if index + 1 in self.deaf:
                return Answer(data, 0)
            self.requests.append((index + 1, data[0] & 0x0F))
            if self.slow is None:
                self.al[index] = data[0] & 0x0F
            else:
                self.slow.append((index, data[0] & 0x0F))
        return Answer(bytes(len(data)), 1)

    def act(self) -> None:
        """Carry out the delayed requests."""
        requested, self.slow = self.slow or [], None
        for index, state in requested:
            self.al[index] = state


class Bench:
    """A watcher of three slaves in simulated time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        clock = SimpleNamespace(monotonic=lambda: self.now, sleep=self.wait)
        for module in (supervision, recovery):
            monkeypatch.setattr(module, "time", clock)
        self.port = Slaves()
        self.reported: list[Event] = []
        self.restored: list[int] = []
        self.restoration: Callable[[int], Steps[None]] = self.endless
        self.watcher = SlaveWatcher(self.port, COUNT, self, self.reported.append)  # type: ignore[arg-type]

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def restore(self, position: int, place: int | None) -> Steps[None]:
        self.restored.append(position)
        return self.restoration(position)

    def endless(self, position: int) -> Steps[None]:
        while True:
            yield

    def at_once(self, position: int) -> Steps[None]:
        yield
        self.port.al[position - 1] = SAFEOP

    def fails_in_safeop(self, position: int) -> Steps[None]:
        yield
        self.port.al[position - 1] = SAFEOP
        raise BusError("its clock does not settle")

    def turn(self, count: int = 1) -> list[int]:
        """Run turns; return the positions that left OP."""
        left = []
        for _ in range(count):
            left.append(self.watcher.turn())
            self.now += TURN_S
        return [position for position in left if position]

    def until_op(self) -> None:
        for _ in range(1000):
            if self.watcher.all_op:
                return
            self.turn()
        raise AssertionError(f"never in OP again: {self.port.al}, {self.reported}")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


@pytest.mark.parametrize("state", [INIT, PREOP, SAFEOP, OP])
def test_a_slave_that_was_being_set_up_when_it_was_parked_is_set_up_from_the_beginning(
    bench: Bench, state: AlState
) -> None:
    bench.port.al[1] = INIT
    bench.turn(3)
    assert bench.restored == [2]
    bench.port.al[1] = state
    bench.watcher.park()
    bench.turn(15)
    bench.port.requests.clear()
    bench.restoration = bench.at_once
    bench.watcher.resume()
    bench.until_op()
    assert bench.restored == [2, 2]
    assert [wanted for position, wanted in bench.port.requests if position == 2] == [OP]
    assert [wanted for position, wanted in bench.port.requests if position == 3] == [SAFEOP, OP]


def test_a_slave_that_was_parked_twice_comes_back_with_its_set_up(bench: Bench) -> None:
    for _ in range(2):
        bench.watcher.park()
        bench.turn(15)
        assert bench.port.al == [PREOP] * 3
        bench.watcher.resume()
        bench.turn()
    bench.until_op()
    assert bench.restored == []


def test_a_slave_that_was_lost_when_it_was_parked_is_set_up_again(bench: Bench) -> None:
    bench.port.al[1] = PREOP
    bench.turn()
    bench.watcher.park()
    bench.turn(15)
    bench.restored.clear()
    bench.restoration = bench.at_once
    bench.watcher.resume()
    bench.until_op()
    assert bench.restored == [2]


def test_a_slave_that_was_waiting_for_its_set_up_when_it_was_parked_gets_it(bench: Bench) -> None:
    for state in (FALLEN, PREOP):
        bench.port.al[1] = state
        bench.turn(5)
    # It left OP again at once: it is left alone until a pause is over.
    assert (bench.watcher.all_op, bench.restored) == (False, [])
    bench.watcher.park()
    bench.turn(15)
    bench.restoration = bench.at_once
    bench.watcher.resume()
    bench.until_op()
    assert bench.restored == [2]


def test_a_set_up_that_failed_half_way_is_begun_anew_and_op_is_not_asked_for(bench: Bench) -> None:
    bench.port.al[1] = INIT
    bench.restoration = bench.fails_in_safeop
    bench.turn(350)
    assert len(bench.restored) > 1
    assert (2, OP) not in bench.port.requests
    bench.restoration = bench.at_once
    bench.until_op()


def test_slaves_that_are_about_to_be_parked_are_not_taken_for_well_when_they_are_wanted_back_at_once(
    bench: Bench,
) -> None:
    bench.port.slow = []
    bench.watcher.park()
    bench.watcher.resume()
    assert bench.turn(5) == []
    assert not bench.watcher.all_op
    bench.port.act()
    assert bench.port.al == [PREOP] * 3
    bench.turn()
    assert not bench.watcher.all_op
    bench.until_op()
    assert (bench.port.al, bench.restored, bench.reported) == ([OP] * 3, [], [])
    assert [slave.lost for slave in bench.watcher.slaves] == [0, 0, 0]


def test_a_slave_that_has_surely_not_heard_that_it_is_to_be_parked_is_not_waited_for(bench: Bench) -> None:
    bench.port.deaf = {1, 2, 3}
    bench.watcher.park()
    bench.watcher.resume()
    bench.turn()
    assert bench.watcher.all_op


def test_a_slave_that_falls_again_and_again_is_told_every_ten_seconds_and_brought_back_after_pauses(
    bench: Bench,
) -> None:
    bench.restoration = bench.at_once
    falls = 0
    times_s: list[float] = []
    for _ in range(3000):
        if bench.watcher.all_op:
            bench.port.al[1] = FALLEN
            falls += 1
        before = len(bench.reported)
        bench.turn()
        times_s += [bench.now for event in bench.reported[before:] if isinstance(event, SlavesLeftOp)]
    left = [event for event in bench.reported if isinstance(event, SlavesLeftOp)]
    # At 0 s, after 10 s and after 20 s, one pair each; pauses of 1, 2, 3, 4, 5, 5, ... s.
    assert 8 <= falls <= 10
    assert [at_s - times_s[0] for at_s in times_s] == pytest.approx([0.0, 10.0, 20.0], abs=2 * TURN_S)
    assert [event.falls for event in left] == [1, 4, 2]
    assert len(bench.reported) <= 7, bench.reported
    assert bench.watcher.slaves[1].lost == falls
    assert bench.watcher.slaves[1].recovered >= falls - 1
    assert 2 in bench.restored


def test_a_slave_that_was_well_for_a_while_is_brought_back_without_a_pause(bench: Bench) -> None:
    for fallen in range(4):
        bench.turn(150)
        bench.port.al[1] = FALLEN
        assert bench.turn() == [2]
        bench.turn(5)
        assert bench.watcher.all_op
        assert bench.watcher.slaves[1].recovered == fallen + 1
    assert bench.restored == []


def test_a_fall_that_was_not_told_at_once_is_told_later_where_the_slave_stays_away(bench: Bench) -> None:
    bench.port.al[1] = FALLEN
    bench.turn(5)
    assert len(bench.reported) == 2
    bench.port.al[1] = FALLEN
    bench.port.deaf = {2}
    bench.turn(600)
    assert not any(isinstance(event, SlavesLeftOp) for event in bench.reported[2:])
    bench.turn(500)
    (left,) = [event for event in bench.reported[2:] if isinstance(event, SlavesLeftOp)]
    assert (left.slave, left.last) == (2, 2)


def test_a_slave_waits_in_safe_op_until_outputs_come_in_time_with_its_clock(bench: Bench) -> None:
    bench.watcher.op_allowed = False
    bench.port.al[1] = FALLEN
    bench.turn(500)
    assert bench.port.al[1] == SAFEOP
    bench.watcher.op_allowed = True
    bench.turn(2)
    assert bench.watcher.all_op


def test_a_fall_after_a_reset_is_told_at_once(bench: Bench) -> None:
    for _ in range(3):
        bench.reported.clear()
        bench.port.al[1] = FALLEN
        bench.turn()
        bench.watcher.resume()
        bench.until_op()
        assert [type(event) for event in bench.reported[:2]] == [SlavesLeftOp, SlavesBackInOp]


def test_a_look_that_was_cut_short_changes_nothing(bench: Bench) -> None:
    bench.port.al[1] = FALLEN
    bench.port.lost = {3}
    assert bench.turn() == []
    seen: list[Any] = [slave.state for slave in bench.watcher.slaves]
    assert (seen, bench.watcher.all_op) == ([OP] * 3, True)
    bench.port.al[1] = OP
    bench.port.lost = set()
    bench.turn()
    assert [slave.state for slave in bench.watcher.slaves] == [OP] * 3
    bench.port.al[1] = FALLEN
    assert bench.turn() == [2]
