"""Waiting for AL states where frames get lost: a stall of the host is not told as a cable that is off."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.al_state import AlState, read_al, wait_for_state
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
    port.hole = 7
    assert read_al(port, STATION)[0] is AlState.NONE
    said = wait_for_state(port, SLAVES, AlState.PREOP, 0.0)
    assert said == ("slave 1 (drive1) did not reach PRE-OP: it is in INIT; it gave no reason (AL status code 0)",)


def test_a_slave_that_has_got_there_while_frames_were_lost_is_not_told(port: Direct) -> None:
    port.hole = 7
    assert wait_for_state(port, SLAVES, AlState.INIT, 0.0) == ()


def test_a_slave_without_any_answer_is_told_with_what_to_check(port: Direct) -> None:
    port.hole = 1000
    assert wait_for_state(port, SLAVES, AlState.INIT, 0.0) == (
        "slave 1 (drive1) did not reach INIT: it does not answer; check its cable and its supply",
    )
