"""The service thread: lost slaves, recovery and parking, SDO requests beside them, repeated messages."""

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
from rtcp.fieldbus.bus import PortErrors, SlaveState
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.recovery import MonitoredSlave
from rtcp.fieldbus.registers import Steps
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import DriveErrorCode, EmergencyMessage, ErrorReported, Event
from rtcp.ipc.observer import Health, Observer
from tests.control import rig
from tests.waiting import until

GONE = "the interface does not take frames any more"


class Watching:
    """A watcher whose observations a test sets."""

    silent = False

    def __init__(self) -> None:
        self.slaves = (MonitoredSlave(1), MonitoredSlave(2))
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
    """Two slaves in OP; slave 2 answers an SDO request after `patience` turns of the watcher."""

    def __init__(self) -> None:
        self.watching = Watching()
        self.patience = 0
        self.waiting: list[EmergencyMessage] = []
        self.gone = False
        self.answer = b"\x2a"
        """Value of every object."""

    def request_state(self, state: AlState) -> None:
        pass

    def wait_for_state(self, state: AlState, timeout_s: float) -> tuple[str, ...]:
        return ()

    def read_states(self) -> tuple[SlaveState, ...]:
        if self.gone:
            raise BusError(GONE)
        return ()

    def emergencies(self) -> tuple[EmergencyMessage, ...]:
        return tuple(self.waiting)

    def watcher(self, report: Callable[[Event], None]) -> Watching:
        return self.watching

    def sdo(self, position: int) -> Bus:
        return self

    def reading(self, index: int, subindex: int) -> Steps[bytes]:
        until = self.watching.turns + self.patience
        while self.watching.turns < until:
            yield
        return self.answer

    def reading_int(self, index: int, subindex: int) -> Steps[int]:
        return int.from_bytes((yield from self.reading(index, subindex)), "little")


@pytest.mark.parametrize(("policy", "named"), [(os.SCHED_FIFO, True), (os.SCHED_OTHER, False)])
def test_a_cycle_that_does_not_lock_under_fifo_names_the_cpu_that_it_keeps(
    bus: Bus, board: Blackboard, monkeypatch: pytest.MonkeyPatch, policy: int, named: bool
) -> None:
    monkeypatch.setattr(bus_service, "_LOCK_S", 0.0)
    monkeypatch.setattr(os, "sched_getscheduler", lambda pid: policy)
    waiting = BusService(rig.master(bus), board, [(2, 1), (3, 1)], 5.0, 1, 80, watch_s=0.001)
    refused = threading.Event()
    waiting.on_refused = refused.set
    waiting.start()
    refused.wait()
    waiting.finish()
    (sentence,) = waiting.refused
    assert sentence.startswith("the cycle did not lock onto the reference clock")
    assert ("the cycle keeps CPU 1 under SCHED_FIFO while it waits" in sentence) is named


def test_the_time_to_lock_passes_also_while_polls_take_long(
    bus: Bus, board: Blackboard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus_service, "_LOCK_S", 0.1)
    waiting = BusService(rig.master(bus), board, [(2, 1), (3, 1)], 5.0, 1, 80, watch_s=0.001)
    polls: list[float] = []
    refused = threading.Event()

    def look_around() -> None:
        polls.append(time.monotonic())
        time.sleep(0.02)  # as every frame that no slave answers

    waiting.look_around, waiting.on_refused = look_around, refused.set
    waiting.start()
    refused.wait()
    waiting.finish()
    assert len(polls) < 20


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def service(bus: Bus, board: Blackboard) -> Iterator[BusService]:
    made = BusService(rig.master(bus), board, [(2, 1), (3, 1)], 5.0, 0, 1, watch_s=0.001)
    made.want_op()
    made.start()
    until(lambda: made.all_op, "the service", interval_s=0.001)
    yield made
    made.finish()


@pytest.fixture
def observer(board: Blackboard, path: Path) -> Iterator[Observer]:
    made = Observer(path)
    yield made
    made.close()


def events(observer: Observer) -> list[Event]:
    return [record.event for record in observer.events_since(0)]


def answer_of(observer: Observer) -> dict[str, Any]:
    """Wait for the service's answer."""
    answers: list[dict[str, Any]] = []

    def answered() -> bool:
        answer = observer.service_answer()
        answers.extend([] if answer is None else [answer])
        return bool(answers)

    until(answered, "the service", interval_s=0.001)
    return answers[0]


def hold_turn(bus: Bus) -> threading.Event:
    """Block the watcher in the middle of a turn until the returned event is set."""
    release, inside = threading.Event(), threading.Event()

    def hold() -> None:
        bus.watching.hold = None
        inside.set()
        release.wait(20)

    bus.watching.hold = hold
    assert inside.wait(20)
    return release


def turns(bus: Bus, count: int = 20) -> None:
    before = bus.watching.turns
    until(lambda: bus.watching.turns >= before + count, "the service", interval_s=0.001)


def test_a_slave_that_is_back_before_anybody_looked_stays_lost_until_it_is_recovered(
    bus: Bus, service: BusService
) -> None:
    bus.watching.left = 2
    until(lambda: service.lost_slave == 2, "the service", interval_s=0.001)
    turns(bus)
    assert bus.watching.all_op
    assert (service.lost_slave, service.all_op) == (2, False)
    service.recover()
    assert not service.all_op
    until(lambda: service.all_op, "the service", interval_s=0.001)
    assert (service.lost_slave, bus.watching.resumed) == (0, 1)


def test_a_recovery_lasts_until_every_slave_is_in_op(bus: Bus, service: BusService) -> None:
    bus.watching.left = 2
    until(lambda: service.lost_slave == 2, "the service", interval_s=0.001)
    bus.watching.resume = lambda: None  # type: ignore[method-assign]
    bus.watching.all_op = False
    service.recover()
    turns(bus)
    assert not service.all_op
    bus.watching.all_op = True
    until(lambda: service.all_op, "the service", interval_s=0.001)


def test_parked_slaves_are_in_op_again_only_when_they_are_recovered(bus: Bus, service: BusService) -> None:
    service.park()
    until(lambda: bus.watching.parked, "the service", interval_s=0.001)
    bus.watching.all_op = True
    turns(bus)
    assert not service.all_op
    service.recover()
    until(lambda: service.all_op, "the service", interval_s=0.001)


def test_of_recovery_and_parking_asked_within_one_turn_the_last_one_counts(bus: Bus, service: BusService) -> None:
    for asked, parked in (
        (("park",), True),
        (("recover", "park"), True),
        (("park", "recover"), False),
        (("recover", "park", "recover", "park"), True),
        (("recover",), False),
    ):
        release = hold_turn(bus)
        for name in asked:
            getattr(service, name)()
        release.set()
        turns(bus)
        assert (bus.watching.parked, service.all_op) == (parked, not parked), asked


def test_what_was_seen_before_a_recovery_was_asked_for_is_not_taken_for_its_success(
    bus: Bus, service: BusService
) -> None:
    # The request comes in the middle of a turn: the watcher has read OP, and the recovery ends that state.
    bus.watching.resume = lambda: setattr(bus.watching, "all_op", False)  # type: ignore[method-assign]
    release = hold_turn(bus)
    service.recover()
    release.set()
    seen = []
    until(lambda: seen.append(service.all_op) or len(seen) > 50, "the service", interval_s=0.001)  # type: ignore[func-returns-value]
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
    assert answer_of(observer) == {"hex": "2a"}
    assert bus.watching.turns >= before + 30


@pytest.mark.parametrize("request_", [{"do": "nothing", "slave": 1, "index": 0, "subindex": 0}, {"do": "sdo_read"}, []])
def test_a_request_of_another_form_is_answered_in_a_sentence(
    service: BusService, observer: Observer, request_: Any
) -> None:  # fmt: skip
    observer.ask_service(request_)
    assert "not of the service's form" in answer_of(observer)["error"]
    assert service.is_alive()


def test_what_slaves_have_been_through_is_read_as_it_was_written(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.watching.slaves[1].lost, bus.watching.slaves[1].recovered = 3, 2
    service.temperature = {1: 40.5, 2: -3.25}.__getitem__
    bus.watching.errors.of[1] = PortErrors([0, 70_000, 0, 0], [0, 0, 0, 1 << 40], [5, 0, 0, 0])
    until(
        lambda: observer.health(2)[1] == Health(3, 2, -3.25, (0, 70_000, 0, 0), (0, 0, 0, 0xFF_FFFF), (5, 0, 0, 0)),
        "the service",
        interval_s=0.001,
    )
    assert observer.health(2)[0] == Health(0, 0, 40.5, *[(0, 0, 0, 0)] * 3)


def test_an_interface_that_is_gone_is_reported_once_and_not_in_every_turn(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.watching.gone = True
    turns(bus, 100)
    assert events(observer) == [ErrorReported(GONE)]
    assert service.is_alive()


def test_an_end_without_the_interface_is_no_defect(bus: Bus, service: BusService, observer: Observer) -> None:
    bus.gone = True
    service.finish()
    assert (service.refused, events(observer)) == ((), [ErrorReported(GONE)])


def test_two_failures_that_take_turns_are_reported_once_each(bus: Bus, service: BusService, observer: Observer) -> None:
    def alternate() -> None:
        bus.watching.gone = False
        raise BusError(f"failure {bus.watching.turns % 2}")

    bus.watching.hold = alternate
    turns(bus, 100)
    assert set(events(observer)) == {ErrorReported("failure 0"), ErrorReported("failure 1")}
    assert len(events(observer)) == 2


def test_emergencies_of_one_slave_without_an_end_leave_room_for_those_of_another(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.waiting = [EmergencyMessage(1, code, 0, 0) for code in (0x1000, *range(0x5000, 0x5030))]
    bus.waiting += [EmergencyMessage(2, 0x3210, 0, 0)]
    turns(bus, 500)
    assert events(observer) == [*bus.waiting[:4], bus.waiting[-1]]


def test_an_emergency_that_comes_again_after_a_reset_is_reported_again(
    bus: Bus, service: BusService, observer: Observer
) -> None:
    bus.waiting = [EmergencyMessage(2, 0x3210, 0, 0)]
    for _ in range(2):
        turns(bus, 300)
        service.recover()
        turns(bus)
    bus.waiting = []
    turns(bus, 200)
    assert 2 <= len(events(observer)) <= 3
    assert set(events(observer)) == {EmergencyMessage(2, 0x3210, 0, 0)}


@pytest.mark.parametrize(("answer", "code"), [(b"\x2a", 0x2A), (b"\xff" * 8, 0xFFFF)])
def test_drives_that_fail_together_are_all_explained_whatever_they_answer(
    bus: Bus, service: BusService, observer: Observer, answer: bytes, code: int
) -> None:
    bus.patience, bus.answer = 10, answer
    release = hold_turn(bus)
    service.explain_drive(1)
    service.explain_drive(0)
    release.set()
    until(lambda: len(events(observer)) == 2, "the service", interval_s=0.001)
    assert events(observer) == [DriveErrorCode(0, 2, 1, code), DriveErrorCode(1, 3, 1, code)]


def test_the_states_that_the_watcher_sees_are_published(bus: Bus, service: BusService, observer: Observer) -> None:
    for slave, code in zip(bus.watching.slaves, (0x1A, 0x1B), strict=True):
        slave.update(AlState.SAFEOP, True, code)
    until(lambda: observer.slaves(2) == [(0x14, 0x1A), (0x14, 0x1B)], "the service", interval_s=0.001)
