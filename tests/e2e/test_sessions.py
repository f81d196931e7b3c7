"""A random session on a whole platform, checked by the frames that reached its segment."""

from __future__ import annotations

import pytest

from tests.sessions.wire_session import run_on_the_wire

SECONDS = 4.0
SEED = 5


@pytest.mark.platform
def test_no_frame_of_a_random_session_breaks_a_limit_on_the_wire() -> None:
    outcome = run_on_the_wire(SEED, SECONDS, 4000)
    assert outcome.failures == []
    assert outcome.checked > 100
    assert outcome.taken.total() > 3
