"""Waiting for AL states while frames get lost: a stall of the host is not reported as a missing cable."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import cast

import pytest

from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.al_state import AlState, read_al, wait_for_state
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.foe import FoeClient
from rtcp.fieldbus.mailbox import Mailbox, MailboxType
from rtcp.virtual.segment import make_segment
from tests.fieldbus.direct import Direct

STATION = 0x1001
SLAVES = {STATION: "slave 1 (drive1)"}


@pytest.fixture
def port() -> Direct:
    """One drive, in INIT."""
    segment = make_segment(SegmentConfig((SegmentSlave(model="cubemars-orh70"),), Path()), 0)
    segment.slaves[0].esc.write(0x0010, STATION.to_bytes(2, "little"), 0)
    return Direct(segment)


def test_a_slave_whose_last_answers_were_lost_is_judged_by_the_next(port: Direct) -> None:
    port.losses = 7
    assert read_al(port, STATION)[0] is AlState.NONE
    sentences = wait_for_state(port, SLAVES, AlState.PREOP, 0.0)
    assert sentences == ("slave 1 (drive1) did not reach PRE-OP: it is in INIT; it gave no reason (AL status code 0)",)


def test_a_slave_that_has_got_there_while_frames_were_lost_is_not_told(port: Direct) -> None:
    port.losses = 7
    assert wait_for_state(port, SLAVES, AlState.INIT, 0.0) == ()


def test_a_slave_without_any_answer_is_told_with_what_to_check(port: Direct) -> None:
    port.losses = 1000
    assert wait_for_state(port, SLAVES, AlState.INIT, 0.0) == (
        "slave 1 (drive1) did not reach INIT: it does not answer; check its cable and its supply",
    )


def test_a_slave_in_no_state_that_exists_has_not_reached_init(port: Direct) -> None:
    port.segment.slaves[0].esc.set_al_status(7, 0)
    (sentence,) = wait_for_state(port, SLAVES, AlState.INIT, 0.0)
    assert "did not reach INIT" in sentence


class Box:
    """A mailbox whose answers are rubbish."""

    patience_s, room, sent_room = 0.3, 100, 100

    def __init__(self) -> None:
        self.asked = 0

    def send(self, request: bytes, kind: MailboxType) -> bool:
        self.asked += 1
        return True

    def receive_any(self) -> tuple[MailboxType, bytes]:
        return MailboxType.FOE, bytes(6)


def test_a_file_that_is_answered_by_rubbish_is_asked_for_three_times() -> None:
    box = Box()
    client = FoeClient(cast(Mailbox, box), 1, "drive1", threading.Lock(), lambda *_: None)
    with pytest.raises(BusError, match="it answered something else"):
        client.read("firmware", 0, lambda _: None)
    assert box.asked == 3
