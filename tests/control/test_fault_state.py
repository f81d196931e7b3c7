"""A lasting fault: when the torque is removed although the fault's reaction holds the arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from rtcp.config.model import ArmConfig
from rtcp.fieldbus.al_state import AlState
from rtcp.ipc.commands import Disable, Reset, Shutdown
from rtcp.ipc.events import EmergencyStopActivated, EstopUnobservable, OverSpeed, TorqueRemoved
from rtcp.ipc.states import State

from .rig import CONFIG, COUNTS, DIRECTIONS, MOTIONS, QUICK_STOP, UNDER_VOLTAGE, VOLTAGE_OFF, LoopRig

BOX = 1
QUICK_STOP_RAMP = 0x6085
UNOBSERVABLE_S = 2.0


def lose_box(rig: LoopRig, state: int) -> None:
    """The IO box leaves OP, and no frame has its inputs any more."""
    rig.away.add(0)
    rig.board.slave(BOX, state, 0)
    rig.service.lost_slave = BOX


@MOTIONS
@pytest.mark.parametrize("kind", ["drive", "slave", "frames"])
def test_a_fault_while_disabling_ramps_down_and_then_takes_the_torque(
    rig: LoopRig, mode: int, direction: int, kind: str
) -> None:
    rig.set_in_motion(mode, direction).do(Disable())
    rig.run(0.02)
    assert rig.state is State.DISABLING
    if kind == "drive":
        rig.models[1].inject_fault(UNDER_VOLTAGE)
    elif kind == "slave":
        rig.service.lost_slave = 3
    else:
        rig.away.add(2)
    rig.bring_to(State.FAULT)
    begun = len(rig.log)
    assert abs(rig.models[0].mechanics.velocity) > 0.05
    rig.wait(lambda: not rig.powered[0])
    words = [cycle.drives[0].controlword for cycle in rig.log[begun:]]
    assert words[0] == QUICK_STOP
    assert words[-1] == VOLTAGE_OFF
    assert abs(rig.models[0].mechanics.velocity) < 0.01
    assert len(words) < 600
    assert rig.kinds[-1] == TorqueRemoved


@pytest.mark.parametrize("state", [AlState.NONE, AlState.PREOP, AlState.INIT])
def test_a_box_that_stays_away_takes_the_button_with_it_which_then_counts_as_pressed(rig: LoopRig, state: int) -> None:
    rig.hold()
    lose_box(rig, state)
    rig.bring_to(State.FAULT)
    rig.run(UNOBSERVABLE_S - 0.05)
    assert rig.powered == [True, True]
    took_s = rig.wait(lambda: rig.powered == [False, False])
    assert took_s < 0.2
    assert rig.kinds[-2:] == [EstopUnobservable, TorqueRemoved]
    assert rig.kinds[-2] is EstopUnobservable
    assert rig.state is State.FAULT


def test_a_box_that_comes_back_in_time_lets_the_arm_hold(rig: LoopRig) -> None:
    rig.hold()
    for _ in range(3):
        lose_box(rig, AlState.PREOP)
        rig.run(0.9 * UNOBSERVABLE_S)
        rig.away.clear()
        rig.board.slave(BOX, AlState.OP, 0)
        rig.run(0.05)
    assert rig.powered == [True, True]
    assert EstopUnobservable not in rig.kinds


def test_a_box_in_safe_op_that_answers_every_frame_is_heard(rig: LoopRig) -> None:
    rig.hold()
    rig.board.slave(BOX, AlState.SAFEOP, 0)
    rig.service.lost_slave = BOX
    rig.run(2 * UNOBSERVABLE_S)
    assert rig.powered == [True, True]
    rig.press()
    assert rig.state is State.EMERGENCY_STOP


# -- a reset that fails -----------------------------------------------------------------------------------------------


def fail_to_reset(rig: LoopRig) -> list[int]:
    """Reset although slaves do not come back; return the controlwords sent to the first drive meanwhile."""
    begun = len(rig.log)
    rig.slaves_come_back = False
    rig.service.all_op = False
    rig.do(Reset())
    rig.bring_to(State.FAULT)
    rig.run(0.05)
    return [cycle.drives[0].controlword for cycle in rig.log[begun:]]


def test_a_reset_that_fails_gives_no_torque_back(rig: LoopRig) -> None:
    rig.hold()
    rig.service.lost_slave = 3
    rig.bring_to(State.FAULT)
    rig.do(Disable())
    rig.run(0.1)
    assert set(fail_to_reset(rig)) == {VOLTAGE_OFF}


@pytest.mark.parametrize("after_s", [0.0, 0.012, 1.5])
def test_a_reset_that_fails_out_of_the_emergency_stop_leaves_no_torque(rig: LoopRig, after_s: float) -> None:
    rig.set_in_motion()
    rig.press()
    rig.run(after_s)
    rig.press(False)
    words = fail_to_reset(rig)
    assert words[-1] == VOLTAGE_OFF
    assert rig.powered == [False, False]
    assert EstopUnobservable not in rig.kinds


@DIRECTIONS
@pytest.mark.parametrize("frames", [True, False])
def test_a_reset_before_the_emergency_stop_has_ramped_down_does_not_drop_a_joint_that_turns(
    rig: LoopRig, frames: bool, direction: int
) -> None:
    # The removal of torque in an earlier fault, by silence or after a slave was lost, ends with its reset.
    rig.set_in_motion(direction=direction).do(Disable())
    if frames:
        rig.service.lost_slave = 3
    else:
        rig.lose_frames()
    rig.bring_to(State.FAULT)
    rig.run(1.0)
    rig.service.lost_slave = 0
    rig.lose_frames(False)
    rig.run(0.1)
    rig.recover().move(direction * 1.8, direction * 1.8)
    rig.run(0.6)
    rig.machine.change(OverSpeed(0, 1.0, 0.5))
    rig.run(0.012)
    assert abs(rig.models[0].mechanics.velocity) > 0.05
    begun = len(rig.log)
    fail_to_reset(rig)
    for cycle in rig.log[begun:]:
        if abs(cycle.drives[0].velocity) > 0.05 * COUNTS:
            assert cycle.drives[0].controlword == QUICK_STOP


# -- ramps that are slow ----------------------------------------------------------------------------------------------

SLOWER = 64


def slow(config: ArmConfig) -> ArmConfig:
    """The arm with drives that ramp down in seconds."""
    slaves = []
    for slave in config.slaves:
        sdo = tuple(
            replace(entry, value=int(entry.value) // SLOWER) if entry.index == QUICK_STOP_RAMP else entry
            for entry in slave.device.sdo
        )
        slaves.append(replace(slave, device=replace(slave.device, sdo=sdo)))
    return replace(config, slaves=tuple(slaves))


@pytest.mark.parametrize(("stop", "direction"), [("disable", 1), ("disable", -1), ("press", -1)])
@pytest.mark.parametrize("away", [False, True])
def test_the_torque_waits_for_the_drives_own_ramp(
    new_rig: Callable[..., LoopRig], stop: str, direction: int, away: bool
) -> None:
    rig = new_rig(slow(CONFIG)).set_in_motion(direction=direction)
    if stop == "disable":
        rig.do(Disable())
        rig.service.lost_slave = 3
        rig.bring_to(State.FAULT)
    if away:
        rig.away.add(2)
    parked: list[bool] = []
    rig.service.park = lambda: parked.append(any(rig.powered))  # type: ignore[method-assign]
    if stop == "press":
        rig.press()
    rig.wait(lambda: not rig.powered[0])
    assert abs(rig.models[0].mechanics.velocity) < 0.01
    if stop == "press" and not away:
        rig.run(0.1)
        assert parked == [False]


# -- while the platform closes ----------------------------------------------------------------------------------------


def test_a_press_while_it_closes_without_a_slave_takes_the_others_torque(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.away.add(2)
    rig.do(Shutdown())
    rig.press()
    rig.finish()
    assert not rig.powered[0]
    assert EmergencyStopActivated in rig.kinds
