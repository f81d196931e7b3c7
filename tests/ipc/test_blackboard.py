"""Two processes, one file in memory: records, events, lease, commands."""

from __future__ import annotations

import os
import resource
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from rtcp.ipc.blackboard import Blackboard, BlackboardTooLarge
from rtcp.ipc.commands import COMMANDS, Enable, MoveJoints, SetDriveMode
from rtcp.ipc.events import EVENTS as EVENT_KINDS
from rtcp.ipc.events import ErrorReported, OverSpeed
from rtcp.ipc.layout import COMMAND, COMMAND_SIZE, COMMANDS_AT, EVENTS, RECORDS, records_for
from rtcp.ipc.observer import BlackboardError, EventRecord, LeaseRefused, Observer
from rtcp.ipc.refusals import Malformed, PositionOutOfRange
from rtcp.ipc.schema import PER_JOINT, Field, RecordSchema, arm_schema
from rtcp.ipc.states import DriveMode, DriveState
from tests.records import numbers
from tests.simulated_time import Clock

JOINTS = 6
SCHEMA = arm_schema(JOINTS)
MEASURED = tuple(name for name in PER_JOINT if name not in ("drive_state", "statusword"))
"""Fields of a joint other than its drive's words."""


@pytest.fixture
def observer(board: Blackboard, path: Path) -> Iterator[Observer]:
    made = Observer(path)
    yield made
    made.close()


def record(cycle: int) -> list[float]:
    words = {"drive_state": cycle % len(DriveState), "statusword": cycle & 0xFFFF}
    return numbers(SCHEMA, cycle=cycle, **dict.fromkeys(MEASURED, cycle), **words)


def values(records: Sequence[EventRecord]) -> list[float]:
    return [record.event.value for record in records if isinstance(record.event, OverSpeed)]


def test_a_record_is_read_as_it_was_written(board: Blackboard, observer: Observer) -> None:
    scalars = {"state": 4, "wkc": -1, "dc_filtered_ns": -77, "elapsed_s": 0.5}
    vectors = {name: [0.1 * (i + JOINTS * at) for i in range(JOINTS)] for at, name in enumerate(MEASURED)}
    words = {"drive_state": range(JOINTS), "statusword": range(100, 100 + JOINTS)}
    board.publish(numbers(SCHEMA, **scalars, **vectors, **words))
    latest = observer.latest()
    assert latest is not None
    assert int(latest[0]["number"]) == 1
    assert int(latest[0]["state"]) == 4
    assert int(latest[0]["wkc"]) == -1
    assert int(latest[0]["dc_filtered_ns"]) == -77
    assert list(latest[0]["actual_position"]) == [0.1 * i for i in range(JOINTS)]
    assert list(latest[0]["sent_position"]) == [0.1 * i for i in range(4 * JOINTS, 5 * JOINTS)]
    assert list(latest[0]["drive_state"]) == list(range(JOINTS))
    assert list(latest[0]["statusword"]) == list(range(100, 100 + JOINTS))


def test_an_observer_reads_any_schema_and_what_it_means(path: Path) -> None:
    field = Field("kiln_zones", "float32", "K", "Of the kiln, lid first.", (3,), "kiln")
    board = Blackboard(path, RecordSchema((SCHEMA["number"], field)), 500_000)
    board.publish([1.0, 2.0, 3.0])
    observer = Observer(path)
    assert observer.schema["kiln_zones"] == field
    assert (observer.latest() or [])[0]["kiln_zones"].tolist() == [1.0, 2.0, 3.0]
    observer.close()
    board.close()


def test_before_the_first_cycle_there_is_no_record(observer: Observer) -> None:
    assert observer.latest() is None
    assert observer.since(0)[1] == 0


def test_a_reader_that_keeps_up_loses_nothing(board: Blackboard, observer: Observer) -> None:
    seen: list[int] = []
    for cycle in range(1, 3 * RECORDS // 2):
        board.publish(record(cycle))
        if cycle % 1000 == 0:
            records, lost = observer.since(seen[-1] if seen else 0)
            assert lost == 0
            seen += [int(number) for number in records["number"]]
    assert seen == list(range(1, len(seen) + 1))


def test_a_reader_that_comes_late_is_reported_how_much_it_lost(board: Blackboard, observer: Observer) -> None:
    for cycle in range(1, RECORDS + 1001):
        board.publish(record(cycle))
    records, lost = observer.since(0)
    assert lost >= 1000
    assert lost + len(records) == RECORDS + 1000
    assert [int(value) for value in records["cycle"]] == [int(value) for value in records["number"]]


@pytest.mark.parametrize("period_us", [100, 125, 250, 366, 367, 500, 1000, 4000, 100_000])
def test_the_ring_holds_twelve_seconds_of_every_cycle(period_us: int) -> None:
    records = records_for(period_us * 1000)
    assert records * period_us >= 12_000_000
    assert records & records - 1 == 0
    assert records == RECORDS or records * period_us < 24_000_000


def test_a_writer_in_another_process_is_never_read_torn(path: Path) -> None:
    child = os.fork()
    if child == 0:
        board = Blackboard(path, arm_schema(JOINTS), 500_000)
        for cycle in range(1, 40_000):
            board.publish(record(cycle))
        os._exit(0)
    while not path.exists():
        time.sleep(0.001)
    observer = Observer(path)
    at, read = 0, 0
    ended = False
    while not ended:
        ended = os.waitpid(child, os.WNOHANG)[0] != 0
        records, _ = observer.since(at)
        if len(records):
            at = int(records[-1]["number"])
            read += len(records)
            assert (records["cycle"] == records["number"]).all()
            assert (records["actual_position"] == records["cycle"][:, None]).all()
            assert (records["sent_position"] == records["cycle"][:, None]).all()
    observer.close()
    assert at == 39_999
    assert read > 1000


def test_no_event_of_two_threads_is_lost(
    board: Blackboard, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack, slow = OverSpeed.pack_into, threading.current_thread()

    def interrupted(event: OverSpeed, memory: Any, at: int) -> None:
        if threading.current_thread() is slow:
            other.start()
            other.join(0.1)
        pack(event, memory, at)

    monkeypatch.setattr(OverSpeed, "pack_into", interrupted)
    other = threading.Thread(target=lambda: board.event(OverSpeed(1, 2.0, 1.0)))
    board.event(OverSpeed(0, 1.0, 1.0))
    other.join()
    assert values(observer.events_since(0)) == [1.0, 2.0]


def test_events_arrive_in_order(board: Blackboard, observer: Observer) -> None:
    count = EVENTS + 44
    for number in range(count):
        board.event(OverSpeed(number % 6, number, 1.0))
    events = observer.events_since(0)
    assert values(events) == list(range(44, count))
    assert observer.events_since(count - 1)[0].event == OverSpeed((count - 1) % 6, count - 1.0, 1.0)


def test_an_event_has_its_instant_on_both_clocks(board: Blackboard, observer: Observer) -> None:
    wall, monotonic = time.time_ns(), time.monotonic_ns()
    board.event(OverSpeed(3, 0.25, 1.5))
    (event,) = observer.events_since(0)
    assert wall <= event.time_ns <= time.time_ns()
    assert monotonic <= event.monotonic_ns <= time.monotonic_ns()
    assert (event.number, event.event) == (1, OverSpeed(3, 0.25, 1.5))


def test_an_event_that_is_overwritten_while_it_is_read_is_left_out(
    board: Blackboard, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(2):
        board.event(OverSpeed(0, number, 1.0))
    read = EVENT_KINDS.unpack_from
    overtakes = iter([True])

    def overtaken(kind: int, memory: Any, at: int) -> Any:
        if next(overtakes, False):
            for number in range(EVENTS):
                board.event(OverSpeed(0, 100.0 + number, 1.0))
        return read(kind, memory, at)

    monkeypatch.setattr(EVENT_KINDS, "unpack_from", overtaken)
    assert values(observer.events_since(0)) == []
    assert values(observer.events_since(EVENTS))[-1] == 100.0 + EVENTS - 1


def test_a_long_text_is_cut_and_not_lost(board: Blackboard, observer: Observer) -> None:
    board.event(ErrorReported("ä" * 1000))
    assert observer.events_since(0)[0].event == ErrorReported("ä" * 248)


def test_a_second_commander_is_refused_with_the_holders_name(observer: Observer, path: Path) -> None:
    other = Observer(path)
    lease = observer.acquire("rtcp move (pid 7)", 10.0)
    with pytest.raises(LeaseRefused, match=r"rtcp move \(pid 7\)"):
        other.acquire("the panel", 10.0)
    observer.release(lease)
    assert other.acquire("the panel", 10.0) != lease
    other.close()


def test_a_lease_that_is_not_renewed_is_free_again(observer: Observer) -> None:
    with Clock().shown() as clock:
        lease = observer.acquire("first", 0.05)
        clock.advance(0.05)
        assert observer.renew(lease)
        clock.advance(0.05)
        assert observer.holder() == "first"
        clock.advance(1e-9)
        assert not observer.renew(lease)
        assert observer.holder() == ""
        observer.acquire("second", 10.0)
        observer.release(lease)
        assert observer.holder() == "second"


def test_a_lease_that_is_being_renewed_never_looks_free_to_another_process(board: Blackboard, path: Path) -> None:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        renewed_all = False
        try:
            observer = Observer(path)
            lease = observer.acquire("renewer", 60.0)
            os.write(writing, b"!")
            renewed_all = all(observer.renew(lease) for _ in range(50_000))
        finally:
            os._exit(0 if renewed_all else 1)
    os.read(reading, 1)
    seen = set()
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        for _ in range(2000):
            lease, renewed, duration = board.lease()
            seen.add((lease, duration))
            assert renewed >= lease
    assert os.waitstatus_to_exitcode(ended[1]) == 0
    assert len(seen) == 1
    os.close(reading)
    os.close(writing)


def test_commands_are_taken_in_order_and_answered(board: Blackboard, observer: Observer) -> None:
    lease = observer.acquire("test", 10.0)
    assert not board.command_waits()
    first = observer.command(lease, MoveJoints((0.1, -0.2), 0.3, True))
    second = observer.command(lease, Enable())
    assert board.command_waits()
    assert board.take_command() == (first, lease, MoveJoints((0.1, -0.2), 0.3, True))
    board.answer(first, PositionOutOfRange(2, 9.0, 1.5))
    answer = observer.answer(first)
    assert answer is not None
    assert answer.refusal == PositionOutOfRange(2, 9.0, 1.5)
    assert observer.answer(second) is None
    assert board.take_command()[2] == Enable()
    assert not board.command_waits()


def test_the_place_of_a_command_is_free_only_when_the_command_was_read(
    board: Blackboard, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, taken = COMMANDS.unpack_from, []

    def watched(kind: int, memory: Any, at: int) -> Any:
        taken.append(observer.commands_taken)
        return read(kind, memory, at)

    monkeypatch.setattr(COMMANDS, "unpack_from", watched)
    observer.command(1, Enable())
    assert board.take_command() == (1, 1, Enable())
    assert (taken, observer.commands_taken) == ([0], 1)


def test_a_command_that_cannot_be_read_is_malformed(board: Blackboard, observer: Observer) -> None:
    observer.command(1, SetDriveMode(DriveMode.CSP))
    memory = board.memory
    at = COMMANDS_AT + COMMAND_SIZE + COMMAND.size
    memory[at : at + 8] = (77).to_bytes(8, "little")
    assert board.take_command()[2] == Malformed(SetDriveMode.number)


def test_a_ring_that_nobody_empties_is_refused(observer: Observer) -> None:
    for _ in range(64):
        observer.command(1, Enable())
    with pytest.raises(BlackboardError, match="takes no commands"):
        observer.command(1, Enable())


def test_a_file_that_is_no_blackboard_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BlackboardError, match="cannot be opened"):
        Observer(tmp_path / "none")
    (tmp_path / "short").write_bytes(b"x" * 100)
    with pytest.raises(BlackboardError, match="cut short"):
        Observer(tmp_path / "short")
    (tmp_path / "zeros").write_bytes(bytes(1 << 22))
    with pytest.raises(BlackboardError, match="not of this version"):
        Observer(tmp_path / "zeros")


def test_a_ring_without_room_is_refused_before_the_cycle_and_leaves_nothing(path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, limits[1]))
    try:
        with pytest.raises(
            BlackboardTooLarge, match=r"[0-9.]+ MB \([0-9]+ cycle records of [0-9]+ bytes\) cannot be had"
        ):
            Blackboard(path, arm_schema(6), 500_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(path.parent.glob(path.name + "*"))


def test_a_ring_that_need_not_be_resident_takes_no_memory_and_is_refused_without_room(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Blackboard(path, arm_schema(6), 500_000, is_resident=False).close()
    assert 512 * path.stat().st_blocks < 0.1 * path.stat().st_size
    path.unlink()
    full = os.statvfs_result((4096, 4096, 200, 100, 100, 0, 0, 0, 0, 255))
    monkeypatch.setattr(os, "fstatvfs", lambda _: full)
    with pytest.raises(BlackboardTooLarge):
        Blackboard(path, arm_schema(6), 500_000, is_resident=False)
    assert not list(path.parent.glob(path.name + "*"))
