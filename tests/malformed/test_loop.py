"""The real loop on mutated answers: no exception, no target beyond a limit, no jump."""

from __future__ import annotations

from tests.malformed import mutated_loop


def test_mutated_process_data_never_break_the_cycle_or_lead_a_target_beyond_its_limits() -> None:
    outcome = mutated_loop.run(300, 1)
    assert outcome.failures == []
    assert outcome.frames >= 300
    assert outcome.starts == 3
    assert outcome.kinds["cycles with a drive enabled"] > 400
    assert outcome.kinds["FAULT"] > 1
