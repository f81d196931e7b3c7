"""A random session on a whole platform, checked by the frames that reached its segment."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.wire import BOX_OUT, DRIVE, HEAD, LEAVES, LRW, datagrams, frames
from tests.sessions.session import Outcome
from tests.sessions.wire_session import check, run_on_the_wire

pytestmark = pytest.mark.platform

PERIOD_US = 2000
SECONDS = 6.0
SEED = 5
OUTPUTS_AT = 26
ENABLE_OPERATION = 0x0F
FURTHER = 1000
"""0.1 rad in counts; a joint may move 10 in a cycle."""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Outcome, Path]:
    """The result of a session and its capture."""
    path = tmp_path_factory.mktemp("wire") / "capture"
    return run_on_the_wire(SEED, SECONDS, PERIOD_US, path), path


def test_no_frame_of_a_random_session_breaks_a_limit_on_the_wire(session: tuple[Outcome, Path]) -> None:
    outcome, _ = session
    assert outcome.failures == []
    assert outcome.checked > 1000
    assert outcome.taken.total() > 10


def test_one_target_that_is_changed_in_its_capture_is_found(session: tuple[Outcome, Path], tmp_path: Path) -> None:
    _, path = session
    spoilt = tmp_path / "spoilt"
    enabled = 0
    with spoilt.open("wb") as file:
        for when, leaves, got in frames(path):
            frame = bytearray(got)
            if not leaves and next(datagrams(got))[0] == LRW:
                control, position, *rest = DRIVE.unpack_from(frame, OUTPUTS_AT + BOX_OUT)
                enabled += control == ENABLE_OPERATION
                if enabled == 100:
                    enabled += 1
                    DRIVE.pack_into(frame, OUTPUTS_AT + BOX_OUT, control, position + FURTHER, *rest)
            file.write(HEAD.pack(when, len(frame) | (LEAVES if leaves else 0)) + frame)
    assert enabled > 100
    _, failures = check(spoilt, PERIOD_US * 1e-6)
    assert any("joint 1: step 0.1," in sentence for sentence, *_ in failures)
