"""Behaviour of the machine in its states, beside the table of test_transitions.py and the cases of test_faults.py."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, takewhile
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rtcp.ipc import events
from rtcp.ipc.commands import Disable, Enable, Halt, MoveJoints, Reset, SetDriveMode, Shutdown
from rtcp.ipc.states import DriveMode, State
from rtcp.ipc.stop_reactions import StopReaction, bounds
from rtcp.motion.guards.output_limiter import BACK_RAD_S
from rtcp.motion.state import ArmState, Setpoint
from tests.samples import examples

from .rig import (
    CAUSES,
    CONFIG,
    CONTROLWORD,
    COUNTS,
    CSP,
    CST,
    CSV,
    DIRECTIONS,
    EMERGENCY_STOP_INPUT,
    ENABLE_OPERATION,
    ENABLE_TIMEOUT_S,
    LONGEST_STEP,
    LOST_CYCLES,
    MOTIONS,
    PERIOD_S,
    QUICK_STOP,
    SWITCH_ON,
    UNDER_VOLTAGE,
    LoopRig,
    move_to,
)

# -- starting -------------------------------------------------------------------------------------------------------


def test_the_slaves_are_asked_for_op_only_when_the_clock_is_followed(rig: LoopRig) -> None:
    asked: list[int] = []
    rig.service.want_op = lambda: asked.append(len(rig.log))  # type: ignore[method-assign]
    rig.discipline.locked = False
    rig.run(0.1)
    assert asked == []
    rig.discipline.locked = True
    rig.cycle()
    assert asked == [100]


def test_ready_is_reported_when_all_slaves_are_in_op_and_not_before(rig: LoopRig) -> None:
    rig.run(0.1)
    assert (rig.state, rig.kinds) == (State.STARTING, [events.ClockLocked])
    rig.service.all_op = True
    rig.cycle()
    assert (rig.state, rig.kinds) == (State.READY, [events.ClockLocked, events.Ready])


def test_a_slave_that_leaves_op_before_the_machine_is_ready_is_brought_back_without_a_reset(rig: LoopRig) -> None:
    asked: list[int] = []
    rig.service.recover = lambda: asked.append(len(rig.log))  # type: ignore[method-assign]
    rig.run(0.01)
    assert asked == []
    rig.service.lost_slave = 2
    rig.cycle()
    assert asked == [10]
    rig.service.lost_slave, rig.service.all_op = 0, True
    rig.cycle()
    assert (asked, rig.state) == ([10], State.READY)


def test_what_is_lost_from_when_all_slaves_are_in_op_is_a_fault_also_before_the_machine_was_ready(rig: LoopRig) -> None:
    rig.models[0].mechanics.position = 0.7
    rig.away.add(2)
    rig.run(2 * LOST_CYCLES * PERIOD_S)
    assert rig.state is State.STARTING
    rig.service.all_op = True
    took_s = rig.wait(lambda: rig.state is State.FAULT)
    # Earlier cycles do not count. No input of the box was received: the emergency stop is not pressed.
    assert took_s == pytest.approx(LOST_CYCLES * PERIOD_S, abs=1.5 * PERIOD_S)
    rig.run(0.1)
    assert (rig.state, rig.kinds) == (State.FAULT, [events.ClockLocked, events.ProcessDataLost])
    rig.away.clear()
    rig.do(Reset())
    rig.bring_to(State.READY)
    # No position was received either: no joint counts as moved.
    assert rig.kinds[2:] == [events.ResetDone]


def test_an_emergency_stop_that_is_pressed_when_the_start_fails_is_heard(rig: LoopRig) -> None:
    rig.box.set_input(EMERGENCY_STOP_INPUT, False)
    rig.away.add(2)
    rig.service.all_op = True
    rig.bring_to(State.FAULT)
    rig.bring_to(State.EMERGENCY_STOP, 0.1)


# -- enabling -------------------------------------------------------------------------------------------------------


def test_enabling_starts_with_the_target_where_each_joint_stands(rig: LoopRig) -> None:
    for model, position in zip(rig.models, (0.7, -0.4), strict=True):
        model.mechanics.position = position
    rig.hold()
    for axis, position in enumerate((7000, -4000)):
        sent = [cycle.drives[axis] for cycle in rig.log if cycle.drives[axis].controlword == ENABLE_OPERATION]
        assert {drive.target for drive in sent} == {position}


def test_a_joint_that_was_turned_by_hand_is_enabled_where_it_stands_then(rig: LoopRig) -> None:
    rig.hold()
    rig.do(Disable())
    rig.bring_to(State.READY)
    rig.run(0.1)
    rig.models[0].mechanics.position = 0.5
    rig.run(0.01)
    before = len(rig.log)
    rig.enable()
    sent = [drive for cycle in rig.log[before:] if (drive := cycle.drives[0]).controlword == ENABLE_OPERATION]
    assert {drive.target for drive in sent} == {5000}


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_just_beyond_its_range_is_enabled_where_it_stands_and_brought_back_gently(
    rig: LoopRig, side: int, mode: int
) -> None:
    rig.models[1].mechanics.position = 2.018 * side
    rig.hold(mode)
    rig.run(1.0)
    frames = [cycle.drives[1] for cycle in rig.log if cycle.drives[1].controlword == ENABLE_OPERATION]
    assert abs(frames[0].target - frames[0].position) <= 1
    assert abs(frames[0].position) == 20180
    targets = [drive.target for drive in frames]
    for cycles in (1, 4, 16, 64):
        # Both ends are rounded to counts.
        allowed = BACK_RAD_S * cycles * PERIOD_S * COUNTS + 1
        assert max(abs(after - before) for before, after in zip(targets, targets[cycles:], strict=False)) <= allowed
    assert targets[-1] == 20000 * side
    assert max(abs(drive.velocity) for drive in frames) < 0.1 * COUNTS
    assert rig.arm.drives[1].position == pytest.approx(2.0 * side, abs=2e-3)


@pytest.mark.parametrize("mode", [CSV, CST])
def test_drives_are_enabled_in_csp_and_take_the_wanted_mode_only_then(rig: LoopRig, mode: int) -> None:
    rig.hold(mode)
    enabling = [cycle.drives[1].mode for cycle in rig.log if cycle.state is State.ENABLING]
    assert set(enabling) == {CSP}
    assert [drive.mode_display for drive in rig.log[-1].drives] == [mode, mode]


@pytest.mark.parametrize("position", [0.0, 1.2])
def test_the_arm_holds_its_place_through_every_change_of_mode(rig: LoopRig, position: float) -> None:
    # A load that pulls: a mode that began without torque would sag.
    rig.models[0].mechanics.gravity_torque = 15.0
    rig.models[0].mechanics.position = position
    rig.hold()
    rig.run(0.3)
    before = len(rig.log)
    for mode in (CSV, CST, CSP, CST, CSV, CSP):
        rig.do(SetDriveMode(DriveMode(mode)))
        rig.run(0.3)
        assert rig.joints.first_in_another_mode() == -1
    seen = [cycle.drives[0] for cycle in rig.log[before:]]
    assert len({drive.target for drive in seen}) == 1
    assert max(abs(drive.position - round(position * COUNTS)) for drive in seen) <= 50


# -- time limits ---------------------------------------------------------------------------------------------------


def test_the_time_for_disabling_begins_when_the_arm_stands(rig: LoopRig) -> None:
    rig.misunderstood[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    rig.set_in_motion().do(Disable())
    rig.bring_to(State.FAULT)
    sent = [drive for cycle in rig.log if (drive := cycle.drives[1]).controlword == SWITCH_ON and drive.has_torque]
    assert len(sent) * PERIOD_S == pytest.approx(ENABLE_TIMEOUT_S, abs=3 * PERIOD_S)


# -- lost frames ----------------------------------------------------------------------------------------------------


def lose(rig: LoopRig, cycles: int) -> None:
    rig.lose_frames()
    rig.run(cycles * PERIOD_S)
    rig.lose_frames(False)


def test_drives_that_still_hear_are_commanded_to_stop_for_as_long_as_no_frame_comes_back(rig: LoopRig) -> None:
    rig.set_in_motion().lose_frames()
    rig.bring_to(State.FAULT)
    at = len(rig.log)
    rig.run(0.5)
    assert {drive.controlword for cycle in rig.log[at:] for drive in cycle.drives} == {QUICK_STOP}


# -- faults in motion -----------------------------------------------------------------------------------------------


@DIRECTIONS
@pytest.mark.parametrize("key", ["drive_fault", "slave_lost"])
def test_a_fault_makes_no_target_jump_where_a_joint_was_held_back(rig: LoopRig, key: str, direction: int) -> None:
    rig.set_in_motion(direction=direction)
    rig.models[0].mechanics.external_torque = -direction * 100.0
    rig.run(0.04)
    lag = direction * (rig.log[-1].drives[0].target - rig.log[-1].drives[0].position)
    assert lag > 20 * LONGEST_STEP
    CAUSES[key][0](rig)
    rig.bring_to(State.FAULT)
    rig.models[0].mechanics.external_torque = 0.0
    rig.run(0.5)
    rig.recover()
    rig.run(0.2)
    assert rig.longest_step(0) <= LONGEST_STEP


@MOTIONS
def test_a_fault_of_one_drive_brings_the_others_to_rest_under_torque_in_every_mode(
    rig: LoopRig, mode: int, direction: int
) -> None:
    rig.set_in_motion(mode, direction)
    rig.models[1].inject_fault(UNDER_VOLTAGE)
    rig.bring_to(State.FAULT)
    rig.run(0.5)
    assert rig.models[0].powered
    assert abs(rig.models[0].mechanics.velocity) < 0.001


# -- reset and torque off -------------------------------------------------------------------------------------------


def test_disable_in_a_fault_takes_the_torque_off_and_leaves_the_fault(rig: LoopRig) -> None:
    rig.lead_to(State.FAULT)
    assert rig.powered == [True, True]
    rig.do(Disable())
    rig.run(0.05)
    assert rig.powered == [False, False]
    assert (rig.state, rig.machine.fault) == (State.FAULT, events.SlaveLost.number)
    assert rig.kinds[-1] is events.TorqueRemoved


def test_disable_during_a_reset_ends_it_in_the_fault_that_was(rig: LoopRig) -> None:
    rig.lead_to(State.RESETTING)
    rig.do(Disable())
    rig.slaves_come_back = True
    rig.run(0.5)
    assert (rig.state, rig.machine.fault) == (State.FAULT, events.SlaveLost.number)
    assert rig.powered == [False, False]


def test_the_fault_after_one_whose_torque_was_taken_off_is_a_quick_stop_again(rig: LoopRig) -> None:
    rig.lead_to(State.FAULT)
    rig.do(Disable())
    rig.run(0.05)
    rig.recover()
    rig.service.lost_slave = 3
    rig.run(0.1)
    assert rig.state is State.FAULT
    assert rig.powered == [True, True]


def slow_quick_stop(rig: LoopRig) -> None:
    """Set a quick stop of 0.2 rad/s2: 1.5 s from full speed."""
    for model in rig.models:
        model.objects[0x6085, 0].value = 2000


@DIRECTIONS
def test_a_reset_lets_come_to_rest_what_still_moves_before_it_takes_its_torque(rig: LoopRig, direction: int) -> None:
    slow_quick_stop(rig)
    rig.set_in_motion(direction=direction)
    rig.service.lost_slave = 3
    rig.cycle()
    rig.do(Reset())
    rig.bring_to(State.READY)
    moving = [drive for cycle in rig.log for drive in cycle.drives if drive.has_torque and abs(drive.velocity) > 100]
    assert {drive.controlword for drive in moving} == {ENABLE_OPERATION, QUICK_STOP}


def test_a_reset_is_tried_again_until_the_cause_of_a_drive_fault_is_gone(rig: LoopRig) -> None:
    rig.start().models[1].condition.bus_voltage = 10.0
    rig.bring_to(State.FAULT)
    rig.do(Reset())
    rig.run(0.5)
    assert rig.state is State.RESETTING
    rig.models[1].condition.bus_voltage = 48.0
    rig.bring_to(State.READY, 0.1)


def test_a_reset_waits_for_the_clock_to_be_followed(rig: LoopRig) -> None:
    rig.set_in_motion().discipline.locked = False
    rig.bring_to(State.FAULT)
    rig.do(Reset())
    rig.run(1.0)
    assert rig.state is State.RESETTING
    rig.discipline.locked = True
    rig.bring_to(State.READY, 0.1)


# -- moving, stopping, disabling ------------------------------------------------------------------------------------


@pytest.mark.interpreted
def test_set_points_that_jump_reach_the_drives_in_steps_inside_the_speed_limit(rig: LoopRig) -> None:
    rig.hold()

    def jump(state: ArmState) -> Setpoint:
        target = Setpoint(2)
        target.position = [1.0, -2.5]
        return target

    generator = rig.arm.controllers[MoveJoints]
    generator.update = jump  # type: ignore[method-assign]
    rig.run(0.3)
    rig.run(4.0)
    assert all(rig.longest_step(axis) <= LONGEST_STEP for axis in range(2))
    assert min(cycle.drives[1].target for cycle in rig.log) >= -2.0 * COUNTS


@DIRECTIONS
def test_a_stop_comes_to_rest_far_before_the_target_and_holds(rig: LoopRig, direction: int) -> None:
    rig.lead_to(State.STOPPING, direction)
    rig.bring_to(State.HOLDING)
    rig.run(0.1)
    assert rig.kinds[-1] is events.Stopped
    assert 0.0 < direction * rig.arm.drives[0].position < 0.3
    assert rig.joints.first_moving() == -1


def test_a_lease_of_another_commander_ends_the_move_too(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.acquire()
    rig.cycle()
    assert (rig.state, rig.kinds[-1]) == (State.STOPPING, events.LeaseExpired)


@DIRECTIONS
@pytest.mark.parametrize("state", [State.DISABLING, State.CLOSING], ids=lambda state: state.name.lower())
def test_disabling_and_closing_in_motion_take_the_torque_only_at_standstill(
    rig: LoopRig, state: State, direction: int
) -> None:
    rig.lead_to(state, direction)
    rig.wait(lambda: rig.done or rig.state is State.READY)
    assert (events.Disabled in rig.kinds) is (state is State.DISABLING)
    sent = [drive for cycle in rig.log for drive in cycle.drives if drive.has_torque and drive.controlword == SWITCH_ON]
    assert sent
    assert max(abs(drive.velocity) for drive in sent) <= 0.02 * COUNTS


def test_disabling_while_enabling_is_done_only_when_no_drive_has_torque(rig: LoopRig) -> None:
    rig.lead_to(State.ENABLING)
    # The drives have been sent Enable Operation and do not show it yet.
    rig.wait(lambda: rig.log[-1].drives[0].controlword == ENABLE_OPERATION)
    rig.do(Disable())
    rig.bring_to(State.READY)
    assert rig.powered == [False, False]


# -- the end --------------------------------------------------------------------------------------------------------


@DIRECTIONS
def test_closing_in_a_fault_lets_come_to_rest_what_ramps_down_before_it_takes_the_torque(
    rig: LoopRig, direction: int
) -> None:
    slow_quick_stop(rig)
    rig.set_in_motion(direction=direction)
    rig.service.lost_slave = 3
    rig.run(0.01)
    rig.do(Shutdown())
    rig.finish()
    moving = [drive for cycle in rig.log for drive in cycle.drives if drive.has_torque and abs(drive.velocity) > 100]
    assert {drive.controlword for drive in moving} == {ENABLE_OPERATION, QUICK_STOP}


@pytest.mark.parametrize("period_us", [1000.0, 200.0])
def test_closing_without_frames_commands_a_quick_stop_for_as_long_as_one_takes(
    new_rig: Callable[..., LoopRig], period_us: float
) -> None:
    config = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=period_us))
    rig = new_rig(config).start()
    rig.run(0.1)
    rig.enable().lose_frames()
    rig.do(Shutdown())
    rig.finish()
    longest_s = max(bound.time_s for bound in bounds(config, StopReaction.QUICK_STOP))
    stops = list(takewhile(lambda cycle: {drive.controlword for drive in cycle.drives} == {QUICK_STOP}, rig.log[::-1]))
    assert longest_s <= len(stops) * period_us * 1e-6 <= longest_s + 0.02


@MOTIONS
def test_closing_without_one_of_the_slaves_ends_when_the_joints_of_the_others_stand(
    rig: LoopRig, mode: int, direction: int
) -> None:
    for model in rig.models:
        model.objects[0x6085, 0].value = 100_000  # as the start-up SDOs of the drive's description set it
    rig.set_in_motion(mode, direction)
    receive = rig.data.receive
    rig.data.receive = lambda: receive() - 3  # type: ignore[method-assign]
    rig.do(Shutdown())
    rig.finish()
    # The process takes the slaves out of OP after the loop.
    assert rig.powered == [True, True]
    assert all(abs(model.mechanics.velocity) < 0.01 for model in rig.models)


def test_closing_ends_after_2_s_where_a_drive_does_not_disable(rig: LoopRig) -> None:
    rig.misunderstood[1, CONTROLWORD] = {SWITCH_ON: ENABLE_OPERATION}
    rig.hold()
    rig.do(Shutdown())
    assert rig.finish() == pytest.approx(2.0, abs=3 * PERIOD_S)


# -- random commands and faults -------------------------------------------------------------------------------------

COMMANDS = {"enable": Enable(), "disable": Disable(), "reset": Reset(), "halt": Halt()}
FAULTS = ["drive fault", "slave lost", "clock lost"]
ACTIONS = st.one_of(
    st.tuples(st.just("run"), st.integers(1, 300)),
    st.tuples(st.just("lose"), st.integers(1, 60)),
    st.tuples(st.just("move"), st.tuples(st.floats(-2.2, 2.2), st.floats(-2.2, 2.2), st.floats(0.05, 0.55))),
    st.tuples(st.just("mode"), st.sampled_from([CSP, CSV, CST])),
    st.tuples(st.sampled_from(sorted(COMMANDS)), st.none()),
    st.tuples(st.sampled_from(FAULTS), st.none()),
    st.tuples(st.just("recover"), st.none()),
)


def do(rig: LoopRig, action: str, how: Any) -> None:
    if action == "run":
        rig.run(how * PERIOD_S)
    elif action == "lose":
        lose(rig, how)
    elif action == "move":
        rig.send(move_to(*how[:2], speed=how[2]))
    elif action == "mode":
        rig.send(SetDriveMode(DriveMode(how)))
    elif action == "drive fault":
        rig.models[1].inject_fault(UNDER_VOLTAGE)
    elif action == "slave lost":
        rig.service.lost_slave = 3
    elif action == "clock lost":
        rig.discipline.locked = False
    elif action == "recover":
        rig.discipline.locked = True
        rig.send(Reset())
        rig.run(0.2)
        rig.send(Enable())
        rig.run(0.05)
    else:
        rig.send(COMMANDS[action])
    rig.cycle()


# A failing example is not shortened: that would take minutes.
@settings(max_examples=examples(50), deadline=None, derandomize=True, phases=[Phase.generate])
@given(actions=st.lists(ACTIONS, min_size=20, max_size=40))
def test_whatever_happens_targets_stay_in_steps_and_only_enable_enables(actions: list[tuple[str, Any]]) -> None:
    with LoopRig() as rig:
        rig.set_in_motion()
        for action, how in actions:
            do(rig, action, how)
    for axis, joint in enumerate(CONFIG.joints):
        assert rig.longest_step(axis) <= LONGEST_STEP
        obeyed = [drive.target for cycle in rig.log if (drive := cycle.drives[axis]).obeys_target]
        assert all(joint.position.min * COUNTS <= target <= joint.position.max * COUNTS for target in obeyed)
    quiet = (State.READY, State.FAULT, State.RESETTING)
    assert all(
        drive.controlword != ENABLE_OPERATION for cycle in rig.log if cycle.state in quiet for drive in cycle.drives
    )
    before: dict[State, set[State]] = {after.state: set() for after in rig.log}
    for earlier, after in pairwise(rig.log):
        before[after.state].add(earlier.state)
    assert before.get(State.ENABLING, set()) <= {State.READY, State.ENABLING}
    assert before.get(State.MOVING, set()) <= {State.HOLDING, State.MOVING}
