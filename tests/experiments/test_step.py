"""The experiment `step` in simulated time: a step of a joint settles without overshoot."""

from __future__ import annotations

import pytest

from rtcp.config import default_config, load, with_period
from rtcp.ipc.commands import MoveJoints
from rtcp.ipc.states import State
from rtcp.testing import Simulation

STEP, SPEED, BAND = 0.3, 0.2, 0.0007
"""rad, rad/s, rad."""


def test_a_step_settles_without_overshoot() -> None:
    with Simulation(with_period(load(default_config()), 4000)) as arm:
        arm.hold()
        begin = arm.loop.arm.state.actual[0]
        arm.do(MoveJoints((begin + STEP, *arm.loop.arm.state.actual[1:]), SPEED, True))
        began_ns, path = arm.now_ns, []
        while arm.state is not State.HOLDING:
            arm.cycle()
            path.append(arm.loop.arm.state.actual[0] - begin)
        arm.run(0.5)
        rest = arm.loop.arm.state.actual[0] - begin
    assert (arm.now_ns - began_ns) * 1e-9 == pytest.approx(STEP / SPEED + 0.5, abs=0.5)
    assert max(path) < STEP + BAND
    assert rest == pytest.approx(STEP, abs=BAND)
