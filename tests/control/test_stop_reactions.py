"""Stop reactions beside the cases of test_faults.py: slow stops, several causes at once, held cycles, the end."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rtcp.ipc.commands import Command, Disable, Halt, Reset, SetControlMode, SetDriveMode, Shutdown
from rtcp.ipc.events import ClockLost, Event, LeaseExpired, MovedSinceFault, PermissionWithdrawn
from rtcp.ipc.names import Names
from rtcp.ipc.states import ControlMode, DriveMode, State

from .rig import (
    CAUSES,
    CONFIG,
    CONTROLWORD,
    CSP,
    CST,
    CSV,
    DIRECTIONS,
    ENABLE_OPERATION,
    LONGEST_STEP,
    LOST_CYCLES,
    PERIOD_S,
    QUICK_STOP,
    SWITCH_ON,
    VOLTAGE_OFF,
    LoopRig,
    move_to,
    with_switch,
)

HARD = {"quick_stop": QUICK_STOP, "torque_off": VOLTAGE_OFF}
"""Controlword of each reaction that the drives carry out by themselves."""
Make = Callable[..., LoopRig]
QUICK_STOP_DECELERATION = 0x6085


def cause(rig: LoopRig, key: str) -> int:
    """Cause an event; return the index of its cycle in the log."""
    before = len(rig.events)
    CAUSES[key][0](rig)
    rig.wait(lambda: any(type(event.event).stop_key == key for event in rig.events[before:]), 1.1)
    return len(rig.log) - 1


def test_a_joint_that_ramps_down_slowly_is_not_reported_as_moved(switch_rig: Make) -> None:
    rig = switch_rig().set_in_motion()
    for model in rig.models:
        # 0.2 rad/s2.
        model.objects[QUICK_STOP_DECELERATION, 0].value = 2000
    stood = rig.arm.state.actual[0]
    cause(rig, "slave_lost")
    rig.run(2.0)
    rig.do(Reset())
    rig.bring_to(State.READY)
    assert rig.arm.state.actual[0] - stood > 0.2
    assert MovedSinceFault not in rig.kinds


@pytest.mark.parametrize("key", ["lease_ended", "enabling_switch"])
@pytest.mark.parametrize("reaction", HARD)
def test_an_arm_that_holds_needs_neither_a_lease_nor_the_enabling_switch(
    switch_rig: Make, key: str, reaction: str
) -> None:
    rig = switch_rig(**{key: reaction}).hold()
    CAUSES[key][0](rig)
    rig.run(0.2)
    assert rig.state is State.HOLDING
    CAUSES[key][1](rig)


@pytest.mark.parametrize("begins", [State.MOVING, State.HOMING])
def test_drives_are_disabled_some_time_after_the_stop_of_an_arm_whose_commander_was_lost(
    switch_rig: Make, begins: State
) -> None:
    rig = switch_rig(power_off_after_s=0.5)
    if begins is State.MOVING:
        rig.set_in_motion()
    else:
        rig.lead_to(begins)
    CAUSES["lease_ended"][0](rig)
    rig.wait(lambda: rig.state is State.HOLDING)
    assert rig.wait(lambda: rig.state is State.DISABLING) == pytest.approx(0.5, abs=0.01)
    rig.wait(lambda: rig.state is State.READY)
    assert rig.messages[-2:] == [
        "the drives are disabled: nobody has commanded the arm for 0.5 s since its commander was lost in a motion "
        "(stops.power_off_after_s)",
        "all drives are disabled",
    ]
    CAUSES["lease_ended"][1](rig)
    rig.hold()
    rig.run(1.0)
    assert rig.state is State.HOLDING  # no commander was lost since


@pytest.mark.parametrize("command", [SetDriveMode(DriveMode.CSP), SetControlMode(ControlMode.JOINT), move_to(0.1, 0.1)])
def test_who_commands_an_arm_after_the_loss_of_its_commander_keeps_its_drives_enabled(
    switch_rig: Make, command: Command
) -> None:
    rig = switch_rig(power_off_after_s=0.5)
    rig.set_in_motion()
    CAUSES["lease_ended"][0](rig)
    rig.wait(lambda: rig.state is State.HOLDING)
    CAUSES["lease_ended"][1](rig)
    rig.run(0.3)
    rig.do(command)
    rig.run(2.0)
    assert rig.state is State.HOLDING


def test_without_a_time_an_arm_whose_commander_was_lost_holds(switch_rig: Make) -> None:
    rig = switch_rig()
    rig.set_in_motion()
    CAUSES["lease_ended"][0](rig)
    rig.run(10.0)
    assert rig.state is State.HOLDING
    CAUSES["lease_ended"][1](rig)


@pytest.mark.parametrize("reaction", HARD)
def test_a_homing_whose_commander_falls_silent_takes_the_reaction(switch_rig: Make, reaction: str) -> None:
    rig = switch_rig(lease_ended=reaction).lead_to(State.HOMING)
    rig.run(0.1)
    cause(rig, "lease_ended")
    assert rig.state is State.FAULT
    assert {drive.controlword for drive in rig.log[-1].drives} == {HARD[reaction]}
    CAUSES["lease_ended"][1](rig)


@pytest.mark.parametrize("code", [LeaseExpired, PermissionWithdrawn], ids=lambda code: code.name.lower())
def test_a_harder_reaction_makes_it_a_fault(code: type[LeaseExpired] | type[PermissionWithdrawn]) -> None:
    soft = Names(CONFIG)
    hard = Names(with_switch(**{code.stop_key: "quick_stop"}))
    assert hard.faults - soft.faults == {code}
    assert hard.message(code()).endswith("then `rtcp reset`")
    assert "reset" not in soft.message(code())


# -- a controlled stop that ends in a fault -------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.MOVING, State.STOPPING, State.DISABLING], ids=lambda state: state.name.lower())
def test_for_a_lost_clock_the_arm_comes_to_rest_under_its_limits_before_it_is_a_fault(
    switch_rig: Make, state: State
) -> None:
    rig = switch_rig(clock_lost="controlled_stop")
    # So slow that the arm still moves a second later.
    rig.arm.limits.acceleration[:] = [0.2, 0.2]
    rig.arm.limits.jerk[:] = [2.0, 2.0]
    rig.hold()
    rig.move(1.8, 1.8)
    rig.run(2.0)
    CAUSES["clock_lost"][0](rig)
    rig.run(0.7)
    if state is not State.MOVING:
        rig.do(Halt() if state is State.STOPPING else Disable())
    assert rig.state is state
    rig.wait(lambda: ClockLost in rig.kinds)
    at = len(rig.log)
    on_the_way = State.DISABLING if state is State.DISABLING else State.STOPPING
    assert (rig.state, rig.machine.fault) == (on_the_way, ClockLost.number)
    rig.bring_to(State.FAULT)
    ramp = rig.log[at:-1]
    assert {drive.controlword for cycle in ramp for drive in cycle.drives} == {ENABLE_OPERATION}
    assert rig.joints.first_moving() == -1
    assert rig.kinds.count(ClockLost) == 1
    assert rig.machine.fault == ClockLost.number
    rig.run(0.2)
    # After `Disable` the drives have no torque.
    assert rig.powered == [state is not State.DISABLING] * 2


def test_a_clock_that_is_lost_while_the_torque_is_taken_ends_without_torque(switch_rig: Make) -> None:
    rig = switch_rig(clock_lost="controlled_stop").hold()
    CAUSES["clock_lost"][0](rig)
    rig.run(0.98)
    rig.misunderstood[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    rig.do(Disable())
    rig.bring_to(State.FAULT, 0.05)
    rig.run(0.1)
    assert rig.kinds.count(ClockLost) == 1
    assert (rig.machine.fault, rig.powered) == (ClockLost.number, [False, False])


def test_an_arm_that_stands_goes_into_the_fault_of_a_lost_clock_at_once(switch_rig: Make) -> None:
    rig = switch_rig(clock_lost="controlled_stop").hold()
    cause(rig, "clock_lost")
    assert rig.state is State.FAULT
    assert {drive.controlword for drive in rig.log[-1].drives} == {QUICK_STOP}


def test_disabled_on_the_way_to_the_fault_of_a_lost_clock_the_arm_ends_there_without_torque(
    switch_rig: Make,
) -> None:
    rig = switch_rig(clock_lost="controlled_stop").set_in_motion()
    cause(rig, "clock_lost")
    rig.do(Disable())
    rig.bring_to(State.FAULT)
    rig.run(0.1)
    assert (rig.machine.fault, rig.powered) == (ClockLost.number, [False, False])


@pytest.mark.parametrize("key", ["lost_frames", "drive_fault", "emergency_stop"])
def test_what_is_worse_ends_the_controlled_stop_for_a_lost_clock(switch_rig: Make, key: str) -> None:
    rig = switch_rig(clock_lost="controlled_stop").set_in_motion()
    cause(rig, "clock_lost")
    cause(rig, key)
    assert rig.state is (State.EMERGENCY_STOP if key == "emergency_stop" else State.FAULT)
    faults = {kind.number for kind in Event.kinds if kind.stop_key == key}
    assert rig.machine.fault in faults
    rig.run(0.5)
    assert rig.machine.fault in faults


# -- closing --------------------------------------------------------------------------------------------------------


@DIRECTIONS
@pytest.mark.parametrize("reaction", HARD)
def test_a_press_while_the_loop_is_ending_takes_its_reaction(switch_rig: Make, reaction: str, direction: int) -> None:
    rig = switch_rig(emergency_stop=reaction).set_in_motion(direction=direction)
    rig.do(Shutdown())
    at = cause(rig, "emergency_stop")
    assert {drive.controlword for drive in rig.log[at].drives} == {HARD[reaction]}
    rig.finish()
    assert rig.powered == [False, False]


@pytest.mark.parametrize("reaction", HARD)
def test_frames_that_stay_away_while_the_loop_is_ending_take_their_reaction(switch_rig: Make, reaction: str) -> None:
    rig = switch_rig(lost_frames=reaction).lead_to(State.CLOSING)
    rig.lose_frames()
    rig.finish()
    assert {drive.controlword for cycle in rig.log[-20:] for drive in cycle.drives} == {HARD[reaction]}


# -- hold -----------------------------------------------------------------------------------------------------------

HELD_IN = [
    *((state, mode) for mode in (CSP, CSV, CST)
      for state in (State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING, State.STOPPED_BY_LIMIT)),
    (State.HOMING, CSP),
]  # fmt: skip


@pytest.mark.parametrize(("state", "mode"), HELD_IN, ids=lambda value: getattr(value, "name", str(value)).lower())
def test_a_cycle_with_a_wrong_working_counter_sends_the_last_targets_again(
    switch_rig: Make, state: State, mode: int
) -> None:
    rig = switch_rig()
    if mode == CSP:
        rig.lead_to(state)
    else:
        rig.hold(mode)
        if state is not State.HOLDING:
            rig.move(1.8, 1.8)
            rig.run(0.6)
        if state is State.STOPPED_BY_LIMIT:
            rig.arm.limits.high[0] = rig.arm.state.commanded[0] + 0.3
            rig.bring_to(State.STOPPED_BY_LIMIT)
        elif state in (State.STOPPING, State.DISABLING):
            rig.do(Halt() if state is State.STOPPING else Disable())
            rig.run(0.05)
    assert rig.state is state
    sent = [rig.data.outputs[slot] for slot in (1, 2)]
    # One slave's part of the working counter is missing; the others have received the frame.
    rig.away.add(2)
    for _ in range(LOST_CYCLES - 1):
        rig.cycle()
        assert [rig.data.outputs[slot] for slot in (1, 2)] == sent
        assert rig.state is state
    rig.cycle()
    assert rig.state is State.FAULT
    assert {drive.controlword for drive in rig.log[-1].drives} == {QUICK_STOP}
    assert [(drive.speed, drive.effort) for drive in rig.log[-1].drives] == [(0, 0), (0, 0)]


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_set_points_go_on_after_held_cycles_without_a_jump(switch_rig: Make, mode: int) -> None:
    rig = switch_rig().set_in_motion(mode)
    at = len(rig.log)
    for _ in range(4):
        rig.away.add(2)
        rig.run((LOST_CYCLES - 1) * PERIOD_S)
        rig.away.clear()
        rig.run(10 * LOST_CYCLES * PERIOD_S)
    assert rig.state is State.MOVING
    assert max(abs(drive.velocity) for cycle in rig.log[at:] for drive in cycle.drives) < 5000
    assert [rig.longest_step(axis) <= LONGEST_STEP for axis in range(2)] == [True, True]


@pytest.mark.parametrize("ends", ["stop", "lease"])
def test_a_move_that_is_stopped_before_a_frame_came_for_it_never_begins(switch_rig: Make, ends: str) -> None:
    rig = switch_rig().hold()
    rig.lose_frames()
    rig.move(1.0, 1.0)
    if ends == "stop":
        rig.do(Halt())
    else:
        CAUSES["lease_ended"][0](rig)
        rig.cycle()
    rig.lose_frames(False)
    rig.run(0.5)
    if ends == "lease":
        CAUSES["lease_ended"][1](rig)
    assert rig.state is State.HOLDING
    assert {drive.target for cycle in rig.log[-500:] for drive in cycle.drives} == {0}


# -- torque off -----------------------------------------------------------------------------------------------------


def test_a_drive_that_does_not_hear_the_torque_off_is_commanded_for_as_long_as_the_fault_lasts(
    switch_rig: Make,
) -> None:
    rig = switch_rig(slave_lost="torque_off").set_in_motion()
    rig.misunderstood[1, CONTROLWORD] = {VOLTAGE_OFF: ENABLE_OPERATION}
    cause(rig, "slave_lost")
    rig.run(0.3)
    rig.misunderstood.clear()
    rig.run(0.01)
    assert rig.powered == [False, False]
