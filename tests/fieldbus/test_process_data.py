"""The exchange through SOEM cycle by cycle: which answers are taken as new, against a master without a segment."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest

from rtcp.fieldbus.image import Place, Places
from rtcp.fieldbus.process_data import SoemProcessData

WKC = 3
NO_ANSWER = -1


class Slave:
    def __init__(self) -> None:
        self.input, self.output = bytes(2), bytes(2)


class Soem:
    """A pysoem master whose answers the test names, and the barrier of its interface."""

    def __init__(self) -> None:
        self.expected_wkc, self.dc_time = WKC, 0
        self.slave = Slave()
        self.answers: list[int] = []
        """Working counter of each answer from now on; then all are good."""
        self.done: list[str] = []
        """What was done since the last look: barrier, send, receive, or only a buffer taken back."""
        self.returns = True
        """Whether the barrier frame comes back."""

    def pass_through(self, timeout_ns: int) -> bool:
        assert timeout_ns == 100_000
        self.done.append("barrier")
        return self.returns

    def send_processdata(self) -> None:
        self.done.append("send")

    def receive_processdata(self, timeout_us: int) -> int:
        self.done.append("receive" if timeout_us else "drop")
        wkc = self.answers.pop(0) if self.answers else WKC
        if wkc >= 0:
            self.dc_time += 1
            self.slave.input = self.dc_time.to_bytes(2, "little")
        return wkc


@pytest.fixture
def soem() -> Soem:
    return Soem()


@pytest.fixture
def data(soem: Soem) -> Iterator[SoemProcessData]:
    reading, writing = os.pipe()
    place = Places(Place(0, 16), Place(16, 16))
    barrier: Any = soem
    yield SoemProcessData(soem, [soem.slave], [place], reading, barrier, 50, 100)
    os.close(reading)
    os.close(writing)


def exchange(soem: Soem, data: SoemProcessData) -> tuple[int, list[str]]:
    """Return the working counter of a cycle and what was done in it; its inputs are new if there is one."""
    before = data.input(0), data.dc_time
    soem.done.clear()
    data.send()
    wkc = data.receive()
    now = data.input(0), data.dc_time
    assert now == (before if wkc < 0 else (soem.slave.input, soem.dc_time))
    return wkc, list(soem.done)


def test_the_first_frame_waits_for_the_barrier_and_the_next_ones_do_not(soem: Soem, data: SoemProcessData) -> None:
    assert exchange(soem, data) == (WKC, ["barrier", "send", "receive"])
    for _ in range(20):
        assert exchange(soem, data) == (WKC, ["send", "receive"])


@pytest.mark.parametrize("lost", [1, 2, 17])
def test_after_each_lost_answer_the_next_frame_waits_for_the_barrier(
    soem: Soem, data: SoemProcessData, lost: int
) -> None:
    exchange(soem, data)
    for _ in range(2):
        soem.answers = [NO_ANSWER] * lost
        assert exchange(soem, data) == (NO_ANSWER, ["send", "receive"])
        for _ in range(lost - 1):
            assert exchange(soem, data) == (NO_ANSWER, ["barrier", "send", "receive"])
        assert exchange(soem, data) == (WKC, ["barrier", "send", "receive"])
        assert exchange(soem, data) == (WKC, ["send", "receive"])
    assert data.missed == 2 * lost


def test_while_the_barrier_does_not_come_back_outputs_are_sent_and_no_answer_is_taken(
    soem: Soem, data: SoemProcessData
) -> None:
    exchange(soem, data)
    soem.answers, soem.returns = [NO_ANSWER], False
    exchange(soem, data)
    for n in range(5):
        data.set_output(0, bytes((n, 1)))
        # SOEM finds an old answer with a perfect working counter.
        assert exchange(soem, data) == (NO_ANSWER, ["barrier", "send", "drop"])
        assert soem.slave.output == bytes((n, 1))
    soem.returns = True
    assert exchange(soem, data) == (WKC, ["barrier", "send", "receive"])
    assert data.missed == 6


def test_an_answer_of_fewer_slaves_is_new_all_the_same(soem: Soem, data: SoemProcessData) -> None:
    exchange(soem, data)
    soem.answers = [1, 0]
    assert [exchange(soem, data) for _ in range(2)] == [(1, ["send", "receive"]), (0, ["send", "receive"])]


def test_outputs_of_a_wrong_length_are_not_taken(soem: Soem, data: SoemProcessData) -> None:
    for output in (b"ab", b"c", b"def"):
        data.set_output(0, output)
        exchange(soem, data)
        assert soem.slave.output == b"ab"
