"""A fault that lasts: whose torque goes although the fault's rung would hold, and when."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from rtcp.config.model import ArmConfig
from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.machine import Code, Command, State
from rtcp.ipc.observer import Observer

from .bench import CONFIG, COUNTS, CSP, CST, CSV, QUICK_STOP, UNDER_VOLTAGE, VOLTAGE_OFF, Bench

BOX = 1
QUICK_STOP_RAMP = 0x6085
DEAF_S = 2.0


def lose_box(bench: Bench, state: int) -> None:
    """The IO box leaves OP, and no frame has its inputs any more."""
    bench.data.away.add(0)
    bench.board.slave(BOX, state, 0)
    bench.service.lost_slave = BOX


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


@pytest.mark.parametrize("state", [AlState.NONE, AlState.PREOP, AlState.INIT])
def test_a_box_that_stays_away_takes_the_button_with_it_which_then_counts_as_pressed(bench: Bench, state: int) -> None:
    bench.hold()
    lose_box(bench, state)
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
        lose_box(bench, AlState.PREOP)
        bench.run(0.9 * DEAF_S)
        bench.data.away.clear()
        bench.board.slave(BOX, AlState.OP, 0)
        bench.run(0.05)
    assert powered(bench) == [True, True]
    assert Code.BUTTON_UNHEARD not in bench.codes


def test_a_box_in_safe_op_that_answers_every_frame_is_heard(bench: Bench) -> None:
    bench.hold()
    bench.board.slave(BOX, AlState.SAFEOP, 0)
    bench.service.lost_slave = BOX
    bench.run(2 * DEAF_S)
    assert powered(bench) == [True, True]
    bench.press()
    assert bench.state is State.EMERGENCY_STOP


# -- what was asked for stays so through a reset that fails, and does not outlast one that succeeds -----------------


def fail_to_reset(bench: Bench) -> list[int]:
    """Reset although slaves do not come back; return the controlwords that the first drive was sent meanwhile."""
    begun = len(bench.log)
    bench.slaves_come_back = False
    bench.service.all_op = False
    bench.do(Command.RESET)
    bench.until(State.FAULT)
    bench.run(0.05)
    return [cycle.drives[0].controlword for cycle in bench.log[begun:]]


def test_a_reset_that_fails_gives_no_torque_back(bench: Bench) -> None:
    bench.hold()
    bench.service.lost_slave = 3
    bench.until(State.FAULT)
    bench.do(Command.DISABLE)
    bench.run(0.1)
    assert set(fail_to_reset(bench)) == {VOLTAGE_OFF}


@pytest.mark.parametrize("after_s", [0.0, 0.012, 1.5])
def test_a_reset_that_fails_out_of_the_emergency_stop_leaves_no_torque(bench: Bench, after_s: float) -> None:
    bench.set_in_motion()
    bench.press()
    bench.run(after_s)
    bench.press(False)
    words = fail_to_reset(bench)
    assert words[-1] == VOLTAGE_OFF
    assert powered(bench) == [False, False]
    assert Code.BUTTON_UNHEARD not in bench.codes


def test_a_reset_before_the_emergency_stop_has_ramped_down_does_not_drop_a_joint_that_turns(bench: Bench) -> None:
    # A fault before it whose torque was to go: that is over with its reset.
    bench.set_in_motion().do(Command.DISABLE)
    bench.service.lost_slave = 3
    bench.until(State.FAULT)
    bench.run(1.0)
    bench.service.lost_slave = 0
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.enable().move(1.8, 1.8)
    bench.run(0.6)
    bench.behaviour._failing.stop_in_emergency(Code.OVER_SPEED, 0, 1.0, 0.5)
    bench.run(0.012)
    assert abs(bench.models[0].mechanics.velocity) > 0.05
    begun = len(bench.log)
    fail_to_reset(bench)
    for cycle in bench.log[begun:]:
        if abs(cycle.drives[0].velocity) > 0.05 * COUNTS:
            assert cycle.drives[0].controlword == QUICK_STOP


# -- ramps that are slow --------------------------------------------------------------------------------------------

SLOWER = 64


def slow(config: ArmConfig) -> ArmConfig:
    """The arm with drives that ramp down in seconds."""
    slaves = []
    for slave in config.slaves:
        sdo = tuple(
            replace(one, value=int(one.value) // SLOWER) if one.index == QUICK_STOP_RAMP else one
            for one in slave.device.sdo
        )
        slaves.append(replace(slave, device=replace(slave.device, sdo=sdo)))
    return replace(config, slaves=tuple(slaves))


@pytest.fixture
def slow_bench(bench_board: tuple[Blackboard, Observer]) -> Iterator[Bench]:
    made = Bench(*bench_board, config=slow(CONFIG))
    for model in made.models:
        model.objects[QUICK_STOP_RAMP, 0].value //= SLOWER
    yield made
    bench_board[1].release(made.lease)


@pytest.mark.parametrize("stop", ["disable", "press"])
@pytest.mark.parametrize("away", [False, True])
def test_the_torque_waits_for_the_drives_own_ramp(slow_bench: Bench, stop: str, away: bool) -> None:
    bench = slow_bench.set_in_motion()
    if stop == "disable":
        bench.do(Command.DISABLE)
        bench.service.lost_slave = 3
        bench.until(State.FAULT)
    if away:
        bench.data.away.add(2)
    if stop == "press":
        bench.press()
    bench.wait(lambda: not powered(bench)[0])
    assert abs(bench.models[0].mechanics.velocity) < 0.01


# -- while the platform is told to end ------------------------------------------------------------------------------


def test_a_press_while_it_closes_without_a_slave_takes_the_others_torque(bench: Bench) -> None:
    bench.set_in_motion()
    bench.data.away.add(2)
    bench.do(Command.SHUTDOWN)
    bench.press()
    bench.finish()
    assert not powered(bench)[0]
    assert Code.PRESSED in bench.codes
