"""Stops in shared memory: they overtake the ring, many requests are one stop, and each request gets its answer."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import Disable, Enable, Halt, SetSpeedOverride, SetTool
from rtcp.ipc.observer import Answer, Observer
from rtcp.ipc.refusals import Superseded, WrongState
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.schema import arm_schema
from rtcp.ipc.states import State
from rtcp.ipc.stops import STOPS, StopWriter, words_of


@pytest.fixture
def observer(board: Blackboard, path: Path) -> Iterator[Observer]:
    made = Observer(path)
    yield made
    made.close()


def test_a_stop_overtakes_a_full_ring(board: Blackboard, observer: Observer) -> None:
    for _ in range(64):
        observer.command(0, SetSpeedOverride(0.5))
    observer.stop(Halt)
    assert board.take_command()[2] == Halt()
    assert board.take_command()[2] == SetSpeedOverride(0.5)


def test_requests_of_all_processes_are_one_stop_and_each_is_answered(board: Blackboard, observer: Observer) -> None:
    instants = [observer.stop(Halt) for _ in range(1000)]
    number, _, command = board.take_command()
    assert command == Halt()
    assert not board.command_waits()
    assert observer.stop_answer(Halt, instants[0]) is None
    board.answer(number, WrongState(Halt.number, State.FAULT))
    refused = Answer(WrongState(Halt.number, State.FAULT))
    assert {observer.stop_answer(Halt, instant) for instant in instants} == {refused}


@pytest.mark.parametrize("kind", STOPS)
def test_each_kind_of_stop_has_its_own_answer(board: Blackboard, observer: Observer, kind: type) -> None:
    instants = {other: observer.stop(other) for other in STOPS}
    while board.command_waits():
        number, _, command = board.take_command()
        if isinstance(command, kind):
            board.answer(number)
    assert [other for other in STOPS if observer.stop_answer(other, instants[other])] == [kind]


def test_an_earlier_request_written_over_a_later_one_loses_no_stop(board: Blackboard, observer: Observer) -> None:
    early, late = observer.stop(Halt), observer.stop(Halt)
    board.words[words_of(Halt)] = early  # by a process that was interrupted before it wrote
    board.answer(board.take_command()[0])
    assert observer.stop_answer(Halt, early) == Answer(None)
    assert observer.stop_answer(Halt, late) is None
    board.answer(board.take_command()[0])
    assert observer.stop_answer(Halt, late) == Answer(None)


def test_what_was_requested_before_a_stop_moves_nothing_after_it(board: Blackboard, observer: Observer) -> None:
    before = time.monotonic_ns()
    observer.command(1, Enable())
    observer.stop(Disable)
    observer.command(1, Enable(), before)
    observer.command(1, SetTool(1), before)
    observer.command(1, Enable())
    taken = [board.take_command()[2] for _ in range(5)]
    assert taken == [Disable(), Superseded(Enable.number), Superseded(Enable.number), SetTool(1), Enable()]


@pytest.mark.parametrize("requested_ns", [1, 1 << 62])
def test_an_impossible_instant_of_a_request_counts_as_now(
    board: Blackboard, observer: Observer, requested_ns: int
) -> None:
    stopped_ns = observer.stop(Halt, requested_ns)
    assert 0 <= time.monotonic_ns() - stopped_ns < 10e9
    assert board.take_command()[2] == Halt()


def test_a_client_stops_without_gateway_and_the_gateway_does_not_repeat_its_stop(tmp_path: Path) -> None:
    board = Blackboard(blackboard_file(tmp_path), arm_schema(6), 500_000)
    try:
        with StopWriter(tmp_path) as writer:
            requested_ns = writer.request_of("halt", {})["requested_ns"]
            assert writer.request_of("status", {}) == {}
        assert board.take_command()[2] == Halt()
        observer = Observer(blackboard_file(tmp_path))
        assert observer.stop(Halt, requested_ns) == requested_ns
        assert not board.command_waits()
        observer.close()
    finally:
        board.close()
        blackboard_file(tmp_path).unlink()


def test_a_client_without_a_platform_requests_no_stop(tmp_path: Path) -> None:
    with StopWriter(tmp_path) as writer:
        assert writer.request_of("halt", {}) == {}
