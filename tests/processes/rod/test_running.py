"""The shipped cell bends a rod: real processes, two virtual controllers."""

from __future__ import annotations

import pytest

from tests.cell.running import RunningCell, shipped_cell
from tests.processes.rod.test_bending import planned


@pytest.mark.long("test_other_cells")
@pytest.mark.platform
def test_the_shipped_cell_runs_a_planned_bend() -> None:
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
    plan = planned()
    cell = RunningCell(shipped_cell(1.2))
    try:
        with cell.connect() as arms:
            arms.enable()
            arms.move_joints(plan.begin, speed=0.2)
            arrivals = arms.run_trajectory(plan.trajectory)
            assert {name: arrival.duration_s for name, arrival in arrivals.items()} == pytest.approx(
                dict.fromkeys(plan.arms, plan.duration_s)
            )
            for name, status in arms.status().items():
                assert status.positions == pytest.approx(plan.arms[name][-1].q, abs=2e-3)
            arms.disable()
    finally:
        cell.end()
