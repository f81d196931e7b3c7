"""The emergency stop and its button, supervision, the stop by a limit, homing, the enabling switch, lamps."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest

from rtcp.control.operator import UNREAD_S
from rtcp.ipc import events
from rtcp.ipc.commands import Command, Disable, Enable, Halt, Home, MoveGripper, Reset, Shutdown
from rtcp.ipc.refusals import WrongState
from rtcp.ipc.states import State

from .rig import (
    CAUSES,
    CONFIG,
    COUNTS,
    DIRECTIONS,
    EMERGENCY_STOP_INPUT,
    LONGEST_STEP,
    PERIOD_S,
    QUICK_STOP,
    SPEED,
    SWITCH_INPUT,
    LoopRig,
    Step,
    move_to,
    turn,
    with_switch,
)

PRESSED_SAYS = (
    "the emergency stop is pressed (inputs.emergency_stop in assistive_arm.yaml): release it, then `rtcp reset`"
)


# -- the button -----------------------------------------------------------------------------------------------------


@DIRECTIONS
def test_each_time_the_drives_ramp_down_before_the_torque_goes_and_the_slaves_are_parked_last(
    rig: LoopRig, direction: int
) -> None:
    parked: list[int] = []
    rig.set_in_motion(direction=direction)
    rig.service.park = lambda: parked.append(rig.context.cycle)  # type: ignore[method-assign]
    for times in (1, 2, 3):
        begun = len(rig.log)
        rig.press()
        rig.wait(lambda: len(parked) == times)  # noqa: B023
        seen = rig.log[begun:]
        moving = [n for n, cycle in enumerate(seen) if any(abs(drive.velocity) > 200 for drive in cycle.drives)]
        torque = [n for n, cycle in enumerate(seen) if any(drive.has_torque for drive in cycle.drives)]
        assert moving
        assert max(moving) < max(torque) < len(seen)
        assert parked[-1] == rig.context.cycle
        assert rig.kinds[-2:] == [events.EmergencyStopActivated, events.SlavesParked]
        rig.press(False)
        rig.recover().move(direction * 1.8, direction * 1.8)
        rig.run(0.6)


def test_while_it_is_pressed_neither_reset_nor_enable_is_taken(rig: LoopRig) -> None:
    rig.hold().press()
    assert rig.refused(rig.send(Reset())) == PRESSED_SAYS
    rig.run(2.0)
    assert rig.refused(rig.send(Reset())) == PRESSED_SAYS
    rig.press(False)
    rig.do(Reset())
    rig.bring_to(State.READY)
    rig.press()
    assert rig.refused(rig.send(Enable())) == PRESSED_SAYS


def test_released_while_the_parked_box_says_nothing_it_is_reset(rig: LoopRig) -> None:
    rig.hold().press()
    rig.run(1.0)
    rig.lose_frames()
    rig.run(0.1)
    rig.press(False)
    rig.do(Reset())
    rig.lose_frames(False)
    rig.bring_to(State.READY)
    rig.enable()


def test_still_pressed_when_the_parked_box_is_heard_again_it_is_an_emergency_stop_and_no_drive_is_enabled(
    rig: LoopRig,
) -> None:
    rig.hold().press()
    rig.run(1.0)
    rig.lose_frames()
    rig.run(0.1)
    at = len(rig.log)
    rig.do(Reset())
    rig.lose_frames(False)
    rig.run(0.5)
    assert rig.state is State.EMERGENCY_STOP
    assert State.READY not in {cycle.state for cycle in rig.log[at:]}
    assert rig.refused(rig.send(Enable()))
    assert rig.joints.first_with_torque() == -1


def test_the_gripper_is_not_switched_while_it_is_pressed(rig: LoopRig) -> None:
    rig.start().press()
    assert "the emergency stop is pressed" in rig.refused(rig.send(MoveGripper(False)))


def test_a_bounce_shorter_than_the_debounce_is_no_press(rig: LoopRig) -> None:
    rig.hold()
    for level in (False, True) * 5:
        rig.put(EMERGENCY_STOP_INPUT, level)
        rig.run(0.002)
    assert rig.state is State.HOLDING


def test_it_counts_while_frames_are_lost_as_soon_as_they_come_again(rig: LoopRig) -> None:
    rig.hold()
    rig.lose_frames()
    rig.run(0.01)
    rig.put(EMERGENCY_STOP_INPUT, False)
    rig.lose_frames(False)
    rig.run(0.02)
    assert rig.state is State.EMERGENCY_STOP


# -- what is measured -----------------------------------------------------------------------------------------------


def test_a_joint_that_does_not_follow_ends_in_the_emergency_stop(rig: LoopRig) -> None:
    rig.hold()
    rig.misunderstood[1, 0x607A] = dict.fromkeys(range(-40000, 40000), 0)
    rig.do(move_to(0.0, 0.4, speed=SPEED))
    rig.bring_to(State.EMERGENCY_STOP)
    assert (rig.kinds[-1], rig.last_of(events.FollowingError).axis) == (events.FollowingError, 1)
    assert "supervision in assistive_arm.yaml" in rig.messages[-1]


@pytest.mark.interpreted
@pytest.mark.parametrize("missing", [1, 0])
def test_a_torque_beyond_its_limit_for_its_time_stops_the_arm(rig: LoopRig, missing: int) -> None:
    rig.hold()
    drive = rig.arm.drives[0]
    decode = rig.arm.decode

    def too_much(data: object) -> None:
        decode(data)  # type: ignore[arg-type]
        rig.arm.samples.actual_torque[0] = 1.6 * CONFIG.joints[0].torque

    rig.arm.decode = too_much  # type: ignore[method-assign]
    for _ in range(round(CONFIG.supervision.torque_s / PERIOD_S) - missing):
        rig.cycle()
    rig.arm.decode = decode  # type: ignore[method-assign]
    rig.run(0.01)
    assert drive.name == "drive1"
    assert rig.state is (State.HOLDING if missing else State.EMERGENCY_STOP)


# -- stopped by a limit ---------------------------------------------------------------------------------------------


@DIRECTIONS
def test_a_move_that_meets_a_limit_is_stopped_before_it_and_says_which(rig: LoopRig, direction: int) -> None:
    rig.lead_to(State.STOPPED_BY_LIMIT, direction)
    limit = rig.arm.limits.high[0] if direction > 0 else -rig.arm.limits.low[0]
    assert max(direction * cycle.drives[0].target for cycle in rig.log) <= limit * COUNTS
    assert rig.kinds[-2:] == [events.JointLimitReached, events.StoppedByLimit]
    assert rig.last_of(events.JointLimitReached).axis == 0
    assert "`rtcp reset`" in rig.messages[-2]
    assert all(rig.longest_step(axis) <= LONGEST_STEP for axis in range(2))


def test_stopped_by_a_limit_the_arm_holds_and_moves_again_only_after_reset(rig: LoopRig) -> None:
    rig.lead_to(State.STOPPED_BY_LIMIT)
    targets = [drive.target for drive in rig.log[-1].drives]
    rig.run(0.2)
    assert [drive.target for drive in rig.log[-1].drives] == targets
    assert rig.joints.first_not_enabled() == -1
    answer = rig.send(move_to(0.0, 0.0))
    assert isinstance(answer.refusal, WrongState)
    assert rig.refused(answer).endswith("`rtcp reset` first")
    rig.do(Reset())
    assert rig.state is State.HOLDING
    rig.move(0.0, 0.0)
    rig.bring_to(State.HOLDING)
    assert rig.arm.drives[0].position == pytest.approx(0.0, abs=1e-3)


# -- homing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("beyond", [-0.05, 0.015, 0.019])
@pytest.mark.parametrize(("speed", "side"), [(0.1, 1), (0.3, -1), (0.5, 1), (0.5, -1)])
def test_a_move_right_after_a_homing_beyond_the_range_begins_as_any_other(
    rig: LoopRig, beyond: float, speed: float, side: int
) -> None:
    rig.hold()
    edge = rig.arm.limits.high[0] if side > 0 else rig.arm.limits.low[0]
    rig.models[0].objects[0x6098, 0].value = 37
    rig.models[0].objects[0x607C, 0].value = round((edge + side * beyond) * COUNTS)
    rig.do(Home(0))
    rig.bring_to(State.HOLDING)
    begun = len(rig.log) - 1
    rig.move(edge - side * 0.8, rig.arm.drives[1].position, speed=speed)
    rig.run(1.2)
    targets = [cycle.drives[0].target for cycle in rig.log[begun:]]
    speeds = [(after - before) / COUNTS / PERIOD_S for before, after in pairwise(targets)]
    faster = max(abs(after - before) for before, after in pairwise(speeds))
    # The targets are whole counts.
    rounding = 2 / COUNTS / PERIOD_S
    assert faster <= CONFIG.joints[0].acceleration * PERIOD_S + rounding
    assert max(map(abs, speeds)) <= speed * 1.01 + rounding


def test_a_drive_is_homed_where_it_stands_and_the_others_hold(rig: LoopRig) -> None:
    rig.models[0].mechanics.position = 0.5
    rig.hold()
    rig.models[0].objects[0x6098, 0].value = 37
    rig.do(Home(0))
    rig.bring_to(State.HOLDING)
    rig.run(0.1)
    assert events.Homed in rig.kinds
    assert rig.arm.drives[0].position == pytest.approx(0.0, abs=1e-3)
    assert rig.longest_step(1) <= 1
    rig.move(0.2, 0.0)
    rig.bring_to(State.HOLDING)
    rig.run(0.2)
    assert rig.arm.drives[0].position == pytest.approx(0.2, abs=1e-3)


def test_a_homing_that_is_stopped_leaves_the_arm_holding(rig: LoopRig) -> None:
    rig.lead_to(State.HOMING)
    rig.run(0.2)
    rig.do(Halt())
    rig.bring_to(State.HOLDING)
    assert [drive.mode_display for drive in rig.log[-1].drives] == [8, 8]


@pytest.mark.parametrize(
    ("meanwhile", "ends_in"),
    [
        (lambda rig: None, State.READY),
        (CAUSES["emergency_stop"][0], State.EMERGENCY_STOP),
        (CAUSES["lost_frames"][0], State.FAULT),
    ],
    ids=["nothing", "emergency stop", "lost frames"],
)
def test_disabling_ends_a_homing_before_the_torque_goes(rig: LoopRig, meanwhile: Step, ends_in: State) -> None:
    rig.lead_to(State.HOMING).run(0.1)
    rig.do(Disable())
    meanwhile(rig)
    rig.bring_to(ends_in)
    rig.run(1.0)
    assert rig.joints.first_with_torque() == -1 or ends_in is State.FAULT
    assert (events.TorqueRemoved in rig.kinds) is (ends_in is State.FAULT)


@pytest.mark.parametrize("command", [Disable, Shutdown])
def test_a_joint_that_turns_on_after_its_homing_is_stopped_hard_whatever_ended_it(
    rig: LoopRig, command: type[Command]
) -> None:
    rig.lead_to(State.HOMING)
    rig.run(0.1)
    turn(rig, 0, 1e5, 0.015, 117.0)
    rig.do(command())
    rig.run(3.2)
    assert events.HomingStillMoving in rig.kinds
    assert rig.log[-1].drives[0].controlword == QUICK_STOP


def test_a_drive_that_reads_a_place_outside_its_range_after_homing_is_a_fault(rig: LoopRig) -> None:
    rig.hold()
    rig.models[1].objects[0x6098, 0].value = 37
    rig.models[1].objects[0x607C, 0].value = 30000
    rig.do(Home(1))
    rig.bring_to(State.FAULT)
    assert (rig.kinds[-1], rig.last_of(events.LeftRange).axis) == (events.LeftRange, 1)


# -- the enabling switch --------------------------------------------------------------------------------------------


def test_without_the_enabling_switch_no_motion_begins(new_rig: Callable[..., LoopRig]) -> None:
    rig = new_rig(with_switch()).hold()
    rig.put(SWITCH_INPUT, False)
    rig.run(0.02)
    answer = rig.send(move_to(0.1, 0.1))
    assert rig.refused(answer) == "the enabling switch is not pressed (inputs.enabling_switch in assistive_arm.yaml)"
    assert rig.state is State.HOLDING


@pytest.mark.parametrize("cause", ["enabling_switch", "lease_ended", "halt"])
def test_without_permission_and_after_a_halt_no_joint_returns_to_its_range_after_its_homing(
    new_rig: Callable[..., LoopRig], cause: str
) -> None:
    rig = new_rig(with_switch()).hold()
    edge = rig.arm.limits.high[0]
    rig.models[0].objects[0x6098, 0].value = 37
    rig.models[0].objects[0x607C, 0].value = round((edge + 0.018) * COUNTS)
    rig.do(Home(0))
    rig.wait(lambda: rig.context.homing.ended)
    rig.run(0.1)
    CAUSES[cause][0](rig)
    rig.bring_to(State.DISABLING, 0.02)
    rig.bring_to(State.READY)
    assert edge + 0.01 < rig.arm.drives[0].position < edge + 0.018


def test_an_enabling_switch_that_nobody_reads_counts_as_released(new_rig: Callable[..., LoopRig]) -> None:
    rig = new_rig(with_switch()).hold()
    rig.away.add(0)
    rig.run(UNREAD_S - 0.05)
    assert rig.operator.permitted
    rig.run(0.1)
    assert not rig.operator.permitted
    rig.away.clear()
    rig.run(0.02)
    assert rig.operator.permitted


def test_where_there_is_no_enabling_switch_none_counts_as_released(rig: LoopRig) -> None:
    rig.hold()
    rig.away.add(0)
    rig.run(UNREAD_S + 0.1)
    assert rig.operator.permitted


# -- lamps and the gripper ------------------------------------------------------------------------------------------


def test_the_lamps_show_torque_and_motion_and_the_heartbeat_changes_each_cycle(rig: LoopRig) -> None:
    rig.start()
    assert rig.box.outputs & 3 == 0
    rig.enable()
    rig.run(0.01)
    assert rig.box.outputs & 3 == 1
    rig.move(0.3, 0.3)
    rig.run(0.1)
    assert rig.box.outputs & 3 == 3
    beats = []
    for _ in range(6):
        rig.cycle()
        beats.append(rig.box.outputs >> 2 & 1)
    assert beats in ([0, 1] * 3, [1, 0] * 3)


def test_the_gripper_opens_and_closes_on_its_output(rig: LoopRig) -> None:
    rig.hold()
    rig.do(MoveGripper(False))
    rig.run(0.005)
    assert rig.box.outputs >> 3 & 1 == 1
    rig.do(MoveGripper(True))
    rig.run(0.005)
    assert rig.box.outputs >> 3 & 1 == 0


# -- what the record says -------------------------------------------------------------------------------------------


def test_the_record_shows_the_button_and_the_power_of_the_drives_and_that_there_is_no_key(rig: LoopRig) -> None:
    def told() -> tuple[int, ...]:
        rig.cycle()
        newest = rig.observer.latest()
        assert newest is not None
        return tuple(int(newest[0][name]) for name in ("e_stopped", "drives_powered", "operating_mode"))

    rig.lose_frames()
    assert told()[0] == -1  # the button was never read
    rig.lose_frames(False)
    rig.lead_to(State.HOLDING)
    assert told() == (0, 1, -1)
    rig.press()
    rig.wait(lambda: rig.state is State.EMERGENCY_STOP)
    rig.wait(lambda: not any(drive.has_torque for drive in rig.log[-1].drives))
    assert told() == (1, 0, -1)
    rig.press(False)
    assert told() == (0, 0, -1)
    rig.lose_frames()
    rig.run(UNREAD_S + 0.1)
    assert told()[0] == -1
