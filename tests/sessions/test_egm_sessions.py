"""A random session on the virtual IRC5: no reference breaks a limit."""

from __future__ import annotations

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from tests.samples import THOROUGH
from tests.sessions.egm_session import run_on_egm

pytestmark = pytest.mark.platform


@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", range(1, 6) if THOROUGH else [1])
def test_no_reference_of_a_random_session_breaks_a_limit(seed: int) -> None:
    outcome = run_on_egm(seed, 60.0 if THOROUGH else 5.0)
    assert outcome.failures == []
    assert outcome.replies > 300
    assert outcome.taken
    assert outcome.requests
