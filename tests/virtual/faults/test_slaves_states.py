"""Slaves that refuse an AL state, hang in one, or leave OP by themselves."""

from __future__ import annotations

from typing import Literal

import pytest

from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.slaves import AlFall, AlHang, AlRefuse, PowerFault
from rtcp.virtual.protocol import DatagramCommand
from tests.virtual.line import (
    ACK,
    ERROR,
    INIT,
    MS,
    OP,
    PRE_OP,
    SAFE_OP,
    SM_MAILBOXES,
    STATION,
    Line,
    TinyDevice,
    begin,
    in_op,
)

REFUSED = 0x0042


@pytest.mark.parametrize(("name", "state", "below"), [("OP", OP, SAFE_OP), ("SAFE-OP", SAFE_OP, PRE_OP),
                                                      ("PRE-OP", PRE_OP, INIT)])  # fmt: skip
def test_a_refused_state_gives_the_code_until_cleared_and_lower_states_are_free(
    name: Literal["PRE-OP", "SAFE-OP", "OP"], state: int, below: int
) -> None:
    line = in_op(2)
    end = begin(line.segment, AlRefuse(2, name, REFUSED), line.now)
    assert line.al(1) == (OP, 0), "who is there stays there"
    assert line.request(1, below) == (below, 0)
    assert line.request(1, state) == (below | ERROR, REFUSED)
    assert line.request(1, below | ACK) == (below, 0)
    assert line.request(0, INIT) == (INIT, 0)
    end(line.now)
    if state == PRE_OP:
        line.write(1, 0x0800, SM_MAILBOXES)
    line.write(1, 0x0120, bytes((state, 0)))
    line.exchange()
    assert line.al(1) == (state, 0)


def test_a_request_downwards_is_not_refused() -> None:
    line = in_op(2)
    begin(line.segment, AlRefuse(1, "SAFE-OP", REFUSED), line.now)
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)


def test_a_slave_that_hangs_neither_follows_nor_refuses_and_does_it_afterwards() -> None:
    line = in_op(2)
    end = begin(line.segment, AlHang(2), line.now)
    assert line.request(1, INIT) == (OP, 0)
    assert line.one(DatagramCommand.FPWR, STATION + 1, 0x0120, b"\x02\x00").counter == 0, "AL control was not read yet"
    for _ in range(200):
        assert line.exchange()[1] == 6
    assert line.request(0, SAFE_OP) == (SAFE_OP, 0)
    end(line.now)
    assert line.al(1) == (INIT, 0)


def test_a_slave_that_hangs_on_its_way_to_op_does_not_arrive_there() -> None:
    line = Line([TinyDevice()])
    line.to_safe_op()
    line.request(0, OP)
    end = begin(line.segment, AlHang(1), line.now)
    for _ in range(50):
        line.exchange()
    assert line.al(0) == (SAFE_OP, 0)
    end(line.now)
    line.exchange()
    assert line.al(0) == (OP, 0)


@pytest.mark.parametrize(("name", "state", "counter"), [("SAFE-OP", SAFE_OP, 4), ("PRE-OP", PRE_OP, 3)])
def test_a_fall_is_a_state_with_error_and_code_a_working_counter_and_invalid_outputs(
    name: Literal["PRE-OP", "SAFE-OP"], state: int, counter: int
) -> None:
    line = in_op(2)
    undo = begin(line.segment, AlFall(2, name, REFUSED), line.now)
    assert undo.over
    assert line.al(1) == (state | ERROR, REFUSED)
    assert line.exchange(5, 5)[1] == counter
    assert line.tiny[1].valid == [True, False]
    assert line.al(0) == (OP, 0)
    undo(line.now)
    assert line.request(1, state | ACK) == (state, 0)
    assert line.request(1, SAFE_OP) == (SAFE_OP, 0)
    line.write(1, 0x0120, b"\x08\x00")
    line.exchange()
    assert line.al(1) == (OP, 0)


def test_who_is_not_in_op_cannot_fall_out_of_it() -> None:
    line = Line([TinyDevice()])
    line.to_safe_op()
    with pytest.raises(FaultRefused, match="slave 1 is in SAFE-OP: al_fall takes a slave out of OP"):
        begin(line.segment, AlFall(1), line.now)


def test_a_refusal_outlives_a_loss_of_supply() -> None:
    line = in_op(2)
    begin(line.segment, AlRefuse(1, "PRE-OP", REFUSED), line.now)
    begin(line.segment, PowerFault(1), line.now)(line.now)
    line.pass_time(5 * MS)
    line.address()
    line.write(0, 0x0800, SM_MAILBOXES)
    assert line.request(0, PRE_OP) == (INIT | ERROR, REFUSED)
