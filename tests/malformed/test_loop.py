"""The real loop behind a master that is sent nonsense: no exception, no target beyond a limit, no jump."""

from __future__ import annotations

from tests.malformed import mutated_loop


def test_mutated_process_data_never_break_the_cycle_or_lead_a_target_beyond_its_limits() -> None:
    found = mutated_loop.run(900, 1)
    assert found.failures == []
    assert found.frames >= 900
    assert found.starts == 3
    assert found.kinds["cycles with a drive enabled"] > 1500
    assert found.kinds["FAULT"] > 5
