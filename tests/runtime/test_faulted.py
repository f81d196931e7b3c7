"""A fault that lasts: whose torque goes although the fault's rung would hold, and when."""

from __future__ import annotations

import pytest

from rtcp.fieldbus.alstatus import AlState
from rtcp.runtime.machine import Code, Command, State

from .bench import CSP, CST, CSV, QUICK_STOP, UNDER_VOLTAGE, VOLTAGE_OFF, Bench

BOX = 1
DEAF_S = 1.0


def powered(bench: Bench) -> list[bool]:
    return [model.powered for model in bench.models]


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
@pytest.mark.parametrize("kind", ["drive", "slave", "frames"])
def test_a_fault_while_disabling_ramps_down_and_then_takes_the_torque(bench: Bench, mode: int, kind: str) -> None:
    bench.set_in_motion(mode).do(Command.DISABLE)
    bench.run(0.02)
    assert bench.state is State.DISABLING
    if kind == "drive":
        bench.models[1].inject_fault(UNDER_VOLTAGE)
    elif kind == "slave":
        bench.service.lost_slave = 3
    else:
        bench.data.away.add(2)
    bench.until(State.FAULT)
    begun = len(bench.log)
    assert abs(bench.models[0].mechanics.velocity) > 0.05
    bench.wait(lambda: not powered(bench)[0])
    words = [cycle.drives[0].controlword for cycle in bench.log[begun:]]
    assert words[0] == QUICK_STOP
    assert words[-1] == VOLTAGE_OFF
    assert abs(bench.models[0].mechanics.velocity) < 0.01
    assert len(words) < 600
    assert bench.codes[-1] == Code.TORQUE_OFF


def test_any_other_fault_holds(bench: Bench) -> None:
    bench.set_in_motion()
    bench.service.lost_slave = 3
    bench.until(State.FAULT)
    bench.run(3.0)
    assert powered(bench) == [True, True]
    assert Code.TORQUE_OFF not in bench.codes


@pytest.mark.parametrize("state", [AlState.NONE, AlState.PREOP, AlState.SAFEOP])
def test_a_box_that_stays_away_takes_the_button_with_it_which_then_counts_as_pressed(bench: Bench, state: int) -> None:
    bench.hold()
    bench.board.slave(BOX, state, 0)
    bench.service.lost_slave = BOX
    bench.until(State.FAULT)
    bench.run(DEAF_S - 0.05)
    assert powered(bench) == [True, True]
    took_s = bench.wait(lambda: powered(bench) == [False, False])
    assert took_s < 0.2
    assert bench.codes[-2:] == [Code.BUTTON_UNHEARD, Code.TORQUE_OFF]
    assert "is not heard: it counts as pressed" in bench.said[-2]
    assert bench.state is State.FAULT


def test_a_box_that_comes_back_in_time_lets_the_arm_hold(bench: Bench) -> None:
    bench.hold()
    for _ in range(3):
        bench.board.slave(BOX, AlState.SAFEOP, 0)
        bench.service.lost_slave = BOX
        bench.run(0.9 * DEAF_S)
        bench.board.slave(BOX, AlState.OP, 0)
        bench.run(0.05)
    assert powered(bench) == [True, True]
    assert Code.BUTTON_UNHEARD not in bench.codes
