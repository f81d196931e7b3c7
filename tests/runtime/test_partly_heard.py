"""Cycles in which some slaves answer and others do not, and cycles of which some are good and others are not."""

from __future__ import annotations

import itertools

import pytest

from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.machine import Code, Command, State

from .bench import CSP, CST, CSV, EMERGENCY_STOP_INPUT, LOST_CYCLES, PERIOD_S, VOLTAGE_OFF, Bench

BOX, FIRST, SECOND = 0, 1, 2


def lose(bench: Bench, device: int) -> None:
    """A slave loses its supply; the watcher has seen it."""
    bench.data.away.add(device)
    bench.board.slave(device + 1, AlState.NONE, 0)
    bench.service.lost_slave = device + 1


def lose_cycles(bench: Bench, pattern: str) -> None:
    """Let frames come back as the pattern says, over and over: `+` good, `-` without the second drive."""
    marks = itertools.cycle(pattern)
    send = bench.data.send

    def sends() -> None:
        bench.data.away = set() if next(marks) == "+" else {SECOND}
        send()

    bench.data.send = sends  # type: ignore[method-assign]


# -- the emergency stop while a slave is missing --------------------------------------------------------------------


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_the_emergency_stop_is_heard_while_a_drive_is_missing_and_takes_the_others_torque(
    bench: Bench, mode: int
) -> None:
    bench.set_in_motion(mode)
    lose(bench, SECOND)
    bench.until(State.FAULT)
    bench.run(0.3)
    assert bench.models[0].powered
    bench.press()
    assert bench.state is State.EMERGENCY_STOP
    assert Code.PRESSED in bench.codes
    took_s = bench.wait(lambda: not bench.models[0].powered)
    assert took_s < 0.6
    assert bench.log[-1].drives[0].controlword == VOLTAGE_OFF


def test_it_is_heard_before_the_missing_drive_is_a_fault(bench: Bench) -> None:
    bench.set_in_motion()
    bench.data.away.add(SECOND)
    bench.press()
    assert bench.behaviour.lost < LOST_CYCLES
    assert bench.state is State.EMERGENCY_STOP


def test_a_release_is_not_taken_from_a_cycle_in_which_a_slave_is_missing(bench: Bench) -> None:
    bench.hold()
    bench.press()
    lose(bench, SECOND)
    bench.press(False)
    bench.run(0.1)
    assert bench.operator.emergency_stop


def test_what_a_box_says_that_is_not_in_op_is_not_taken_for_a_press(bench: Bench) -> None:
    bench.set_in_motion()
    lose(bench, SECOND)
    bench.board.slave(BOX + 1, AlState.SAFEOP, 0)
    bench.press()
    assert bench.state is State.FAULT
    assert not bench.operator.emergency_stop


def test_an_input_that_bounces_is_no_press_while_a_slave_is_missing(bench: Bench) -> None:
    bench.hold()
    lose(bench, SECOND)
    for _ in range(20):
        for level, seconds in ((False, 0.002), (True, 0.008)):
            bench.data.devices[BOX].set_input(EMERGENCY_STOP_INPUT, level)
            bench.run(seconds)
    assert not bench.operator.emergency_stop


# -- cycles of which most are lost ----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
@pytest.mark.parametrize(("bad", "good"), [(39, 1), (9, 1), (3, 1), (3, 2)])
def test_more_lost_cycles_than_good_ones_stop_the_arm_although_never_so_many_in_a_row(
    bench: Bench, mode: int, bad: int, good: int
) -> None:
    bench.set_in_motion(mode)
    lose_cycles(bench, "-" * bad + "+" * good)
    took_s = bench.until(State.FAULT)
    share = (bad - good) / (bad + good)
    assert took_s <= (LOST_CYCLES / share + bad + good) * PERIOD_S
    assert bench.codes[-1] == Code.BUS_LOST
    assert f"process data lost: {LOST_CYCLES} cycles more without than with the expected" in bench.said[-1]


@pytest.mark.parametrize(("bad", "good"), [(1, 1), (10, 10), (1, 9)])
def test_as_many_good_cycles_as_lost_ones_go_on(bench: Bench, bad: int, good: int) -> None:
    bench.set_in_motion()
    lose_cycles(bench, "-" * bad + "+" * good)
    bench.run(1.0)
    assert bench.state in (State.MOVING, State.HOLDING)
    assert Code.BUS_LOST not in bench.codes


def test_what_was_lost_before_a_reset_does_not_count_after_it(bench: Bench) -> None:
    bench.hold()
    bench.data.carries = False
    bench.until(State.FAULT)
    bench.run(1.0)
    bench.data.carries = True
    bench.run(0.01)
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.data.carries = False
    bench.run((LOST_CYCLES - 2) * PERIOD_S)
    assert bench.state is State.READY
