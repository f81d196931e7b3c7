"""Cycles in which a slave is missing, and sequences of good and lost cycles."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from rtcp.control.context import good_for_lost
from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.commands import Reset
from rtcp.ipc.events import EmergencyStopActivated, ProcessDataLost
from rtcp.ipc.states import State

from .rig import CONFIG, CSP, CST, CSV, EMERGENCY_STOP_INPUT, LOST_CYCLES, PERIOD_S, VOLTAGE_OFF, LoopRig

BOX, FIRST, SECOND = 0, 1, 2


def lose(rig: LoopRig, device: int) -> None:
    """A slave loses its supply, and the watcher has reported it."""
    rig.away.add(device)
    rig.board.slave(device + 1, AlState.NONE, 0)
    rig.service.lost_slave = device + 1


def lose_cycles(rig: LoopRig, pattern: str) -> None:
    """Repeat a pattern of answers: `+` complete, `-` without the second drive."""
    marks = itertools.cycle(pattern)
    send = rig.data.send

    def sends() -> None:
        rig.away = set() if next(marks) == "+" else {SECOND}
        send()

    rig.data.send = sends  # type: ignore[method-assign]


# -- the emergency stop while a slave is missing --------------------------------------------------------------------


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_the_emergency_stop_is_heard_while_a_drive_is_missing_and_takes_the_others_torque(
    rig: LoopRig, mode: int
) -> None:
    rig.set_in_motion(mode)
    lose(rig, SECOND)
    rig.bring_to(State.FAULT)
    rig.run(0.3)
    assert rig.models[0].powered
    rig.press()
    assert rig.state is State.EMERGENCY_STOP
    assert EmergencyStopActivated in rig.kinds
    took_s = rig.wait(lambda: not rig.models[0].powered)
    assert took_s < 0.6
    assert rig.log[-1].drives[0].controlword == VOLTAGE_OFF


def test_a_release_is_not_taken_from_a_cycle_in_which_a_slave_is_missing(rig: LoopRig) -> None:
    rig.hold()
    rig.press()
    lose(rig, SECOND)
    rig.press(False)
    rig.run(0.1)
    assert rig.operator.emergency_stop


def test_what_a_box_says_that_is_not_in_op_is_not_taken_for_a_press(rig: LoopRig) -> None:
    rig.set_in_motion()
    lose(rig, SECOND)
    rig.board.slave(BOX + 1, AlState.SAFEOP, 0)
    rig.press()
    assert rig.state is State.FAULT
    assert not rig.operator.emergency_stop


def test_an_input_that_bounces_is_no_press_while_a_slave_is_missing(rig: LoopRig) -> None:
    rig.hold()
    lose(rig, SECOND)
    for _ in range(20):
        for level, seconds in ((False, 0.002), (True, 0.008)):
            rig.box.set_input(EMERGENCY_STOP_INPUT, level)
            rig.run(seconds)
    assert not rig.operator.emergency_stop


# -- cycles of which most are lost ----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
@pytest.mark.parametrize(("bad", "good"), [(39, 1), (9, 1), (3, 2), (39, 39), (1, 1), (9, 40), (1, 8)])
def test_more_lost_cycles_than_a_tenth_of_the_good_ones_stop_the_arm_although_never_so_many_in_a_row(
    rig: LoopRig, mode: int, bad: int, good: int
) -> None:
    rig.set_in_motion(mode)
    lose_cycles(rig, "-" * bad + "+" * good)
    took_s = rig.wait(lambda: rig.state is State.FAULT)
    share = (bad - 0.1 * good) / (bad + good)
    assert took_s <= (LOST_CYCLES / share + bad + good) * PERIOD_S
    assert rig.kinds[-1] == ProcessDataLost
    assert rig.last_of(ProcessDataLost).allowed == LOST_CYCLES


@pytest.mark.parametrize(("bad", "good"), [(1, 10), (9, 90), (1, 40)])
def test_lost_cycles_that_are_less_than_a_tenth_of_the_good_ones_are_no_fault(
    rig: LoopRig, bad: int, good: int
) -> None:
    rig.set_in_motion()
    lose_cycles(rig, "-" * bad + "+" * good)
    rig.run(1.0)
    assert rig.state in (State.MOVING, State.HOLDING)
    assert ProcessDataLost not in rig.kinds


def test_what_was_lost_before_a_reset_does_not_count_after_it(rig: LoopRig) -> None:
    rig.hold()
    rig.lose_frames()
    rig.bring_to(State.FAULT)
    rig.run(1.0)
    rig.lose_frames(False)
    rig.run(0.01)
    rig.do(Reset())
    rig.bring_to(State.READY)
    rig.lose_frames()
    rig.run((LOST_CYCLES - 2) * PERIOD_S)
    assert rig.state is State.READY


@pytest.mark.parametrize(
    ("interface", "scale", "good"), [("virtual", 100.0, 1), ("virtual", 1.0, 10), ("eth0", 100.0, 10)]
)
def test_only_on_the_virtual_bus_with_wider_timeouts_a_good_cycle_makes_up_for_a_lost_one(
    interface: str, scale: float, good: int
) -> None:
    bus = replace(CONFIG.bus, interface=interface, timeout_scale=scale)
    assert good_for_lost(replace(CONFIG, bus=bus)) == good
