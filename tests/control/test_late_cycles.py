"""When the next cycle begins after one that began or ended late, and how many ticks are skipped. In periods."""

from __future__ import annotations

import pytest

from .rig import PERIOD_S, LoopRig

PERIOD_NS = round(PERIOD_S * 1e9)


@pytest.mark.parametrize(
    ("late", "busy", "due", "skipped"),
    [
        (0.0, 0.5, 1, 0),
        (0.4, 0.2, 1, 0),
        # Frames are never closer than half a period.
        (0.6, 0.1, 2, 1),
        # The frame of the next tick still comes to the drives before their SYNC0, half a period after the tick.
        (0.0, 1.2, 1, 0),
        (0.4, 0.8, 1, 0),
        (0.0, 1.3, 2, 1),
        (0.0, 3.2, 3, 2),
        (3.2, 0.1, 4, 3),
    ],
)
def test_a_late_cycle_skips_the_ticks_whose_frame_would_be_too_late(
    rig: LoopRig, late: float, busy: float, due: int, skipped: int
) -> None:
    planned = rig.now_ns
    woken = planned + round(late * PERIOD_NS)
    receive = rig.data.receive

    def slow() -> int:
        rig.now_ns = woken + round(busy * PERIOD_NS)
        return receive()

    rig.data.receive = slow  # type: ignore[method-assign]
    assert rig.loop.cycle(planned, woken) == planned + due * PERIOD_NS
    assert rig.loop.missed == skipped
