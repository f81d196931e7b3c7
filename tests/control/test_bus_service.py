"""The thread beside the cycle: what it reports of a slave that was lost, and whom it keeps waiting."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.control import bus_service
from rtcp.control.bus_service import BusService
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.bus import SlaveState
from rtcp.fieldbus.emergency import Emergency
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.port_errors import PortErrors
from rtcp.fieldbus.recovery import MonitoredSlave
from rtcp.fieldbus.registers import Steps
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Health, Observer
from tests.control import rig

GONE = "the interface does not take frames any more"


class Watching:
    """A watcher that sees what a test lets it see."""

    silent = False

    def __init__(self) -> None:
        self.slaves = (MonitoredSlave(1, "io"), MonitoredSlave(2, "drive1"))
        self.errors = SimpleNamespace(of=[PortErrors(), PortErrors()])
        self.all_op = True
        self.parked = False
        self.left = 0
        self.turns = 0
        self.resumed = 0
        self.gone = False
        self.op_allowed = True
        self.hold: Callable[[], None] | None = None

    def turn(self) -> int:
        self.turns += 1
        if self.hold is not None:
            self.hold()
        if self.gone:
            raise BusError(GONE)
        left, self.left = self.left, 0
        return left

    def park(self) -> None:
        self.parked, self.all_op = True, False

    def resume(self) -> None:
        self.parked, self.all_op = False, True
        self.resumed += 1


class Bus:
    """Two slaves in OP whose watcher a test holds; slave 2 takes `patience` turns for an object."""

    def __init__(self) -> None:
        self.watching = Watching()
        self.patience = 0
        self.waiting: list[Emergency] = []
        self.gone = False

    def request_state(self, state: AlState) -> None:
        pass

    def wait_for_state(self, state: AlState, timeout_s: float) -> tuple[str, ...]:
        return ()

    def read_states(self) -> tuple[SlaveState, ...]:
        if self.gone:
            raise BusError(GONE)
        return ()

    def emergencies(self) -> tuple[Emergency, ...]:
        return tuple(self.waiting)

    def watcher(self, say: Callable[[str], None]) -> Watching:
        return self.watching

    def sdo(self, position: int) -> Bus:
        return self

    def reading(self, index: int, subindex: int) -> Steps[bytes]:
        until = self.watching.turns + self.patience
        while self.watching.turns < until:
            yield
        return b"\x2a"

    def reading_int(self, index: int, subindex: int) -> Steps[int]:
        return int.from_bytes((yield from self.reading(index, subindex)), "little")


@pytest.mark.parametrize(("policy", "named"), [(os.SCHED_FIFO, True), (os.SCHED_OTHER, False)])
def test_a_cycle_that_does_not_lock_under_fifo_names_the_cpu_that_it_keeps(
    bus: Bus, board: Blackboard, monkeypatch: pytest.MonkeyPatch, policy: int, named: bool
) -> None:
    monkeypatch.setattr(bus_service, "_LOCK_S", 0.0)
    monkeypatch.setattr(os, "sched_getscheduler", lambda pid: policy)
    waiting = BusService(rig.master(bus), board, [(2, 1), (3, 1)], ["joint1", "joint2"], 5.0, 1, 80, watch_s=0.001)
    refused = threading.Event()
    waiting.on_refused = refused.set
    waiting.start()
    refused.wait()
    waiting.finish()
    (sentence,) = waiting.refused
    assert sentence.startswith("the cycle did not lock onto the reference clock")
    assert ("the cycle keeps CPU 1 under SCHED_FIFO while it waits" in sentence) is named


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def service(bus: Bus, board: Blackboard) -> Iterator[BusService]:
    made = BusService(rig.master(bus), board, [(2, 1), (3, 1)], ["joint1", "joint2"], 5.0, 0, 1, watch_s=0.001)
    made.want_op()
    made.start()
    until(lambda: made.all_op)
    yield made
    made.finish()


@pytest.fixture
def observer(board: Blackboard, path: Path) -> Iterator[Observer]:
    made = Observer(path)
    yield made
    made.close()


def until(met: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not met():
        assert time.monotonic() < end
        time.sleep(0.0005)


def sentences(observer: Observer) -> list[str]:
    return [text.sentence for text in observer.texts_since(0)]


def answer_of(observer: Observer) -> dict[str, Any]:
    """Wait for the service's answer."""
    found: list[dict[str, Any]] = []

    def answered() -> bool:
        answer = observer.service_answer()
        found.extend([] if answer is None else [answer])
        return bool(found)

    until(answered)
    return found[0]


def hold_turn(bus: Bus) -> threading.Event:
    """Hold the watcher in the middle of a turn until the event is set."""
    held, inside = threading.Event(), threading.Event()

    def hold() -> None:
        bus.watching.hold = None
        inside.set()
        held.wait(20)

    bus.watching.hold = hold
    assert inside.wait(20)
    return held


def turns(bus: Bus, count: int = 20) -> None:
    before = bus.watching.turns
    until(lambda: bus.watching.turns >= before + count)


def test_a_slave_that_is_back_before_anybody_looked_stays_lost_until_it_is_recovered(
    bus: Bus, service: BusService
) -> None:
    bus.watching.left = 2
    until(lambda: service.lost_slave == 2)
    turns(bus)
    assert bus.watching.all_op
    assert (service.lost_slave, service.all_op) == (2, False)
    service.recover()
    assert not service.all_op
    until(lambda: service.all_op)
    assert (service.lost_slave, bus.watching.resumed) == (0, 1)


def test_a_recovery_lasts_until_every_slave_is_in_op(bus: Bus, service: BusService) -> None:
    bus.watching.left = 2
    until(lambda: service.lost_slave == 2)
    bus.watching.resume = lambda: None  # type: ignore[method-assign]
    bus.watching.all_op = False
    service.recover()
    turns(bus)
    assert not service.all_op
    bus.watching.all_op = True
    until(lambda: service.all_op)


def test_parked_slaves_are_in_op_again_only_when_they_are_recovered(bus: Bus, service: BusService) -> None:
    service.park()
    until(lambda: bus.watching.parked)
    bus.watching.all_op = True
    turns(bus)
    assert not service.all_op
    service.recover()
    until(lambda: service.all_op)


def test_of_recovery_and_parking_asked_within_one_turn_the_last_one_counts(bus: Bus, service: BusService) -> None:
    for asked, parked in (
        (("park",), True),
        (("recover", "park"), True),
        (("park", "recover"), False),
        (("recover", "park", "recover", "park"), True),
        (("recover",), False),
    ):
        held = hold_turn(bus)
        for name in asked:
            getattr(service, name)()
        held.set()
        turns(bus)
        assert (bus.watching.parked, service.all_op) == (parked, not parked), asked


def test_what_was_seen_before_a_recovery_was_asked_for_is_not_taken_for_its_success(
    bus: Bus, service: BusService
) -> None:
    # Asked while the watcher is looking: it saw slaves in OP, and they are not when it has brought them back.
    bus.watching.resume = lambda: setattr(bus.watching, "all_op", False)  # type: ignore[method-assign]
    held = hold_turn(bus)
    service.recover()
    held.set()
    seen = []
    until(lambda: seen.append(service.all_op) or len(seen) > 50)  # type: ignore[func-returns-value]
    assert True not in seen


def test_slaves_are_not_asked_for_op_while_the_clock_is_not_followed(bus: Bus, service: BusService) -> None:
    for followed in (False, True):
        service.clock_followed = lambda followed=followed: followed  # type: ignore[misc]
        turns(bus, 2)
        assert bus.watching.op_allowed is followed


def test_an_object_that_takes_its_time_holds_up_no_turn_of_the_watcher(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.patience = 30
    before = bus.watching.turns
    observer.ask_service({"do": "sdo_read", "slave": 2, "index": 0x1000, "subindex": 0})
    found = answer_of(observer)
    assert found == {"hex": "2a"}
    assert bus.watching.turns >= before + 30


@pytest.mark.parametrize("request_", [{"do": "nothing", "slave": 1, "index": 0, "subindex": 0}, {"do": "sdo_read"}, []])
def test_a_request_of_another_form_is_answered_in_a_sentence(
    service: BusService, observer: Observer, request_: Any
) -> None:  # fmt: skip
    observer.ask_service(request_)
    found = answer_of(observer)
    assert "not of the service's form" in found["error"]
    assert service.is_alive()


def test_what_slaves_have_been_through_is_read_as_it_was_written(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.watching.slaves[1].lost, bus.watching.slaves[1].recovered = 3, 2
    service.temperature = {1: 40.5, 2: -3.25}.__getitem__
    bus.watching.errors.of[1] = PortErrors([0, 70_000, 0, 0], [0, 0, 0, 1 << 40], [5, 0, 0, 0])
    until(lambda: observer.health(2)[1] == Health(3, 2, -3.25, (0, 70_000, 0, 0), (0, 0, 0, 0xFF_FFFF), (5, 0, 0, 0)))
    assert observer.health(2)[0] == Health(0, 0, 40.5, *[(0, 0, 0, 0)] * 3)


def test_an_interface_that_is_gone_is_reported_once_and_not_in_every_turn(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.watching.gone = True
    turns(bus, 100)
    assert sentences(observer) == [GONE]
    assert service.is_alive()


def test_an_end_without_the_interface_is_no_defect(bus: Bus, service: BusService, observer: Observer) -> None:
    bus.gone = True
    service.finish()
    assert (service.refused, sentences(observer)) == ((), [GONE])


def test_two_failures_that_take_turns_are_reported_once_each(bus: Bus, service: BusService, observer: Observer) -> None:
    def alternate() -> None:
        bus.watching.gone = False
        raise BusError(f"failure {bus.watching.turns % 2}")

    bus.watching.hold = alternate
    turns(bus, 100)
    assert sorted(sentences(observer)) == ["failure 0", "failure 1"]


def test_emergencies_of_one_slave_without_an_end_leave_room_for_those_of_another(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.waiting = [Emergency(1, "io", code, 0, bytes(5)) for code in (0x1000, *range(0x5000, 0x5030))]
    bus.waiting += [Emergency(2, "drive1", 0x3210, 0, bytes(5))]
    turns(bus, 500)
    said = sentences(observer)
    assert [sum(sentence.startswith(f"slave {position} ") for sentence in said) for position in (1, 2)] == [4, 1]
    assert len(said) == 5


def test_an_emergency_that_comes_again_after_a_reset_is_reported_again(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.waiting = [Emergency(2, "drive1", 0x3210, 0, bytes(5))]
    for _ in range(2):
        turns(bus, 300)
        service.recover()
        turns(bus)
    bus.waiting = []
    turns(bus, 200)
    assert 2 <= len(sentences(observer)) <= 3
    assert len(set(sentences(observer))) == 1


def test_drives_that_fail_together_are_all_explained(bus: Bus, service: BusService, observer: Observer) -> None:
    bus.patience = 10
    held = hold_turn(bus)
    service.explain_drive(1)
    service.explain_drive(0)
    held.set()
    until(lambda: len(sentences(observer)) == 2)
    assert [sentence.partition(":")[0] for sentence in sentences(observer)] == ["joint1 (slave 2)", "joint2 (slave 3)"]
