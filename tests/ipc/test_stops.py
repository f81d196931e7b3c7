"""Stops in shared memory: they overtake the ring, many requests are one stop, and each request gets its answer."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.client import ControlClient
from rtcp.ipc.commands import Command, Disable, Enable, Halt, SetSpeedOverride, SetTool
from rtcp.ipc.errors import NotRunning, RtcpError
from rtcp.ipc.observer import Answer, Observer
from rtcp.ipc.refusals import Superseded, WrongState
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from rtcp.ipc.schema import arm_schema
from rtcp.ipc.states import State
from rtcp.ipc.stops import STOPS, StopWriter, requested, words_of
from tests.gateway.fake_loop import RunningLoop


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


@pytest.fixture
def directory(tmp_path: Path) -> Iterator[Path]:
    """A runtime directory; its blackboard is removed."""
    yield tmp_path
    blackboard_file(tmp_path).unlink(missing_ok=True)


@pytest.fixture
def own(directory: Path) -> Iterator[Blackboard]:
    """The blackboard of a loop in a runtime directory; the loop takes nothing."""
    board = Blackboard(blackboard_file(directory), arm_schema(6), 500_000)
    yield board
    board.close()


def test_a_client_stops_without_gateway_and_the_gateway_does_not_repeat_its_stop(
    own: Blackboard, directory: Path
) -> None:
    with StopWriter(directory) as writer:
        with writer.requested("halt", {}) as params:
            assert own.take_command()[2] == Halt()
        with writer.requested("halt", params) as repeated:
            assert repeated == params
        with writer.requested("status", {}) as params_of_status:
            assert params_of_status == {}
    observer = Observer(blackboard_file(directory))
    assert observer.stop(Halt, params["requested_ns"]) == params["requested_ns"]
    assert not own.command_waits()
    observer.close()


def test_a_client_without_a_platform_requests_no_stop(directory: Path) -> None:
    with requested(directory, "halt") as params:
        assert params == {}


@pytest.mark.parametrize("kind", [Halt, Disable])
def test_a_stop_without_gateway_is_requested_and_an_error_says_that_the_loop_has_not_taken_it(
    own: Blackboard, directory: Path, kind: type[Command]
) -> None:
    with ControlClient(path=control_socket(directory)) as client:
        with pytest.raises(NotRunning, match="has not taken") as raised:
            client.call(kind.name)
        with pytest.raises(NotRunning) as of_status:
            client.call("status")
    assert own.take_command()[2] == kind()
    assert raised.value.fields == {"stop_taken": False}
    assert of_status.value.fields == {}


def test_a_stop_without_gateway_that_the_loop_has_taken_is_an_error_that_says_so(directory: Path) -> None:
    loop = RunningLoop(blackboard_file(directory))
    try:
        with ControlClient(path=control_socket(directory)) as client, pytest.raises(NotRunning) as raised:
            client.call("halt")
        assert raised.value.fields == {"stop_taken": True}
        assert loop.kinds == [Halt]
    finally:
        loop.end()


def test_a_stop_that_the_gateway_refuses_is_its_error(own: Blackboard, directory: Path) -> None:
    refused = RtcpError("refused", "no", "wrong_state")
    with pytest.raises(RtcpError) as raised, requested(directory, "halt"):
        raise refused
    assert raised.value is refused
