"""Enabling: false statuswords and positions, joints that move or stand beyond their range, drives that drop out."""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise

import pytest

from rtcp.ipc.commands import Disable, Enable, MoveGripper, Reset
from rtcp.ipc.events import DriveLeftEnabled, Enabled, OverSpeed, PositionJumped, ReturningToRange
from rtcp.ipc.refusals import NotPermitted, WrongState
from rtcp.ipc.states import State

from .rig import (
    CAUSES,
    CONFIG,
    CONTROLWORD,
    COUNTS,
    DIRECTIONS,
    ENABLE_OPERATION,
    LONGEST_STEP,
    PERIOD_S,
    QUICK_STOP,
    SWITCH_INPUT,
    SWITCH_ON,
    UNDER_VOLTAGE,
    LoopRig,
    about,
    move_to,
    with_switch,
)

_INPUTS = struct.Struct("<Hiiib")
ENABLED, SWITCHED_ON, NO_STATE = 0x0237, 0x0233, 0x0213
"""Statuswords; the standard does not define the last."""
BOUND = CONFIG.supervision.speed * CONFIG.joints[0].velocity * CONFIG.supervision.cycles * PERIOD_S + 0.002
"""How far a joint can come while its samples are false until the fault, rad."""


def falsify(rig: LoopRig, axis: int = 0, word: int | None = None, position: float | None = None) -> Callable[[], None]:
    """Falsify a drive's statusword or position (rad) in all frames from now on; return a function that ends it."""
    real = rig.data.input

    def read(index: int) -> bytes:
        data = real(index)
        if index != axis + 1:
            return data
        values = list(_INPUTS.unpack(data))
        values[0] = values[0] if word is None else word
        values[1] = values[1] if position is None else round(position * COUNTS)
        return _INPUTS.pack(*values)

    rig.data.input = read  # type: ignore[method-assign]

    def end() -> None:
        rig.data.input = real  # type: ignore[method-assign]

    return end


def until_enable_is_sent(rig: LoopRig, axis: int = 0) -> LoopRig:
    """Enable, until the drive has been sent Enable Operation and does not show it yet."""
    rig.start().do(Enable())
    rig.wait(lambda: rig.log[-1].drives[axis].controlword == ENABLE_OPERATION)
    assert rig.log[-1].drives[axis].statusword & 0x6F == 0x23
    return rig


def largest_distance(rig: LoopRig, seconds: float) -> float:
    """Run; return the largest distance of the first joint from 0, where it began, rad."""
    distance = 0.0
    for _ in range(round(seconds / PERIOD_S)):
        rig.cycle()
        distance = max(distance, abs(rig.models[0].mechanics.position))
    return distance


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("position", [0.05, 0.1, -0.14])
def test_no_joint_follows_a_false_position_while_its_drive_is_being_enabled(
    rig: LoopRig, position: float, frames: int
) -> None:
    end = falsify(until_enable_is_sent(rig), word=SWITCHED_ON, position=position)
    rig.run(frames * PERIOD_S)
    end()
    assert largest_distance(rig, 0.5) < 1e-4
    assert rig.state is State.HOLDING
    assert {cycle.drives[0].target for cycle in rig.log if cycle.drives[0].controlword == ENABLE_OPERATION} == {0}


def test_a_position_that_stays_false_while_enabling_is_a_fault_that_names_both_places(rig: LoopRig) -> None:
    falsify(until_enable_is_sent(rig), word=SWITCHED_ON, position=0.1)
    rig.run((CONFIG.supervision.cycles - 1) * PERIOD_S)
    assert rig.state is State.ENABLING
    rig.cycle()
    assert (rig.state, rig.kinds[-1]) == (State.FAULT, PositionJumped)
    assert rig.last == PositionJumped(0, about(0.1), about(0.0, abs=1e-4), about(BOUND))
    assert largest_distance(rig, 0.5) < 1e-4


def test_false_positions_that_do_not_follow_each_other_are_not_added_up(rig: LoopRig) -> None:
    rig.misunderstood[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    until_enable_is_sent(rig)
    for _ in range(2 * CONFIG.supervision.cycles):
        end = falsify(rig, axis=1, position=0.1)
        rig.cycle()
        end()
        rig.cycle()
    rig.misunderstood.clear()
    rig.bring_to(State.HOLDING)


def test_a_joint_that_sags_while_its_brake_opens_is_followed_and_enabled(rig: LoopRig) -> None:
    rig.start().do(Enable())
    model = rig.models[1].mechanics
    while rig.log[-1].drives[1].statusword & 0x6F != 0x27:
        model.position -= 0.4 * PERIOD_S
        rig.cycle()
    rig.bring_to(State.HOLDING)
    assert rig.longest_step(1) <= LONGEST_STEP


def test_a_joint_that_runs_away_before_all_drives_are_enabled_is_an_emergency(rig: LoopRig) -> None:
    rig.misunderstood[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    rig.start().do(Enable())
    rig.wait(lambda: rig.log[-1].drives[0].statusword & 0x6F == 0x27)
    turned = rig.models[0].mechanics
    turned.inertia, turned.velocity = 1e5, 0.9
    rig.bring_to(State.EMERGENCY_STOP, (CONFIG.supervision.cycles + 3) * PERIOD_S)
    assert rig.kinds[-1] is OverSpeed


def test_a_drive_that_leaves_operation_enabled_while_others_are_on_their_way_is_not_enabled_again(
    rig: LoopRig,
) -> None:
    rig.misunderstood[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    rig.start().do(Enable())
    rig.wait(lambda: rig.log[-1].drives[0].statusword & 0x6F == 0x27)
    rig.run(0.02)
    rig.misunderstood[0, CONTROLWORD] = {ENABLE_OPERATION: 0}
    rig.bring_to(State.FAULT, 5 * PERIOD_S)
    assert (rig.kinds[-1], rig.last_of(DriveLeftEnabled).axis) == (DriveLeftEnabled, 0)
    rig.misunderstood.clear()
    rig.run(0.3)
    assert rig.words(0).count(ENABLE_OPERATION) == 1
    rig.recover()


def enable_beyond(rig: LoopRig, beyond: float = 0.018, side: int = 1) -> LoopRig:
    """Enable with the second joint `beyond` rad outside its range of -2 to 2 rad, until all drives are enabled."""
    rig.models[1].mechanics.position = side * (CONFIG.joints[1].position.max + beyond)
    rig.start().do(Enable())
    rig.wait(lambda: all(drive.statusword & 0x6F == 0x27 for drive in rig.log[-1].drives))
    return rig


@DIRECTIONS
@pytest.mark.parametrize(("velocity", "speed"), [(0.5, 0.05), (0.02, 0.02)])
def test_a_joint_that_is_brought_back_into_its_range_is_reported_with_how_far_and_how_fast(
    rig: LoopRig, velocity: float, speed: float, direction: int
) -> None:
    limits = rig.arm.limits
    limits.velocity[1] = velocity
    rig.arm.output_limiter.take(limits)
    enable_beyond(rig, side=direction).bring_to(State.HOLDING)
    assert rig.kinds[-2:] == [ReturningToRange, Enabled]
    assert rig.events[-2].event == ReturningToRange(1, about(0.018, abs=1e-4), speed)


@DIRECTIONS
def test_what_a_joint_at_the_edge_sags_is_made_good_without_a_word(rig: LoopRig, direction: int) -> None:
    enable_beyond(rig, 0.0005, direction).bring_to(State.HOLDING)
    assert ReturningToRange not in rig.kinds
    assert rig.log[-1].drives[1].target == direction * 20000


@DIRECTIONS
def test_no_motion_begins_before_a_joint_beyond_its_range_is_back(rig: LoopRig, direction: int) -> None:
    enable_beyond(rig, side=direction)
    assert rig.arm.state.commanded[1] == direction * 2.0
    began = len(rig.log)
    while rig.state is State.ENABLING:
        answer = rig.send(move_to(0.0, direction * 1.0))
    # The last command came in the cycle that ended enabling.
    assert (len(rig.log) - began) * PERIOD_S == pytest.approx(0.018 / 0.05, abs=0.04)
    assert isinstance(answer.refusal, WrongState)
    assert rig.log[-1].drives[1].target == direction * 20000
    rig.move(0.0, direction * 1.0)
    rig.bring_to(State.HOLDING)
    assert rig.log[-1].drives[1].target == direction * 10000


def test_a_joint_that_is_brought_back_stands_when_it_is_disabled_and_begins_anew_where_it_is(rig: LoopRig) -> None:
    enable_beyond(rig)
    rig.run(0.1)
    assert 20100 < rig.log[-1].drives[1].target < 20180
    before = len(rig.log)
    rig.do(Disable())
    rig.bring_to(State.READY)
    assert not [cycle for cycle in rig.log[before + 1 :] if cycle.drives[1].obeys_target]
    rig.run(0.1)
    before = len(rig.log)
    rig.enable()
    frames = [cycle.drives[1] for cycle in rig.log[before:] if cycle.drives[1].controlword == ENABLE_OPERATION]
    assert abs(frames[0].target - frames[0].position) <= 1
    assert rig.log[-1].drives[1].target == 20000
    assert rig.kinds.count(ReturningToRange) == 2


@pytest.mark.parametrize("cause", ["enabling_switch", "lease_ended", "halt"])
def test_without_permission_and_after_a_halt_no_joint_is_brought_back(
    new_rig: Callable[..., LoopRig], cause: str
) -> None:
    rig = enable_beyond(new_rig(with_switch()))
    rig.run(0.1)
    CAUSES[cause][0](rig)
    rig.bring_to(State.DISABLING, 0.02)
    before = len(rig.log)
    rig.bring_to(State.READY)
    assert not [cycle for cycle in rig.log[before + 1 :] if cycle.drives[1].obeys_target]
    assert rig.arm.drives[1].position > 2.01
    CAUSES[cause][1](rig)
    rig.run(0.5)
    assert rig.state is State.READY
    rig.enable()


def test_without_the_enabling_switch_nothing_is_enabled(new_rig: Callable[..., LoopRig]) -> None:
    rig = new_rig(with_switch()).start()
    rig.put(SWITCH_INPUT, False)
    rig.run(0.02)
    assert rig.send(Enable()).refusal == NotPermitted()
    assert rig.send(MoveGripper(open=True)).refusal == NotPermitted()
    assert rig.state is State.READY


def test_a_drive_that_leaves_while_its_joint_is_brought_back_is_a_fault(rig: LoopRig) -> None:
    enable_beyond(rig).run(0.1)
    assert rig.state is State.ENABLING
    rig.misunderstood[1, CONTROLWORD] = {ENABLE_OPERATION: 0}
    rig.bring_to(State.FAULT, 5 * PERIOD_S)
    assert (rig.kinds[-1], rig.last_of(DriveLeftEnabled).axis) == (DriveLeftEnabled, 1)


def test_a_false_position_is_judged_by_where_a_joint_beyond_its_range_is_and_not_by_the_edge(rig: LoopRig) -> None:
    rig.models[1].mechanics.position = 2.015
    end = falsify(until_enable_is_sent(rig, 1), axis=1, word=SWITCHED_ON, position=1.98)
    before = len(rig.log)
    rig.run(4 * PERIOD_S)
    end()
    assert {cycle.drives[1].target for cycle in rig.log[before:]} == {20150}
    falsify(rig, axis=1, word=SWITCHED_ON, position=1.98)
    rig.bring_to(State.FAULT, 2 * CONFIG.supervision.cycles * PERIOD_S)
    assert rig.kinds[-1] is PositionJumped
    assert rig.last == PositionJumped(1, about(1.98), about(2.015), about(BOUND))


def test_each_time_enabling_disabling_and_a_reset_take_as_long_as_the_first(rig: LoopRig) -> None:
    rig.start()
    lengths: list[tuple[int, ...]] = []
    for _ in range(3):
        at = [len(rig.log)]
        for command, state in ((Enable(), State.HOLDING), (Disable(), State.READY), (Enable(), State.HOLDING)):
            rig.do(command)
            rig.bring_to(state)
            at.append(len(rig.log))
        rig.models[1].inject_fault(UNDER_VOLTAGE)
        rig.bring_to(State.FAULT)
        rig.run(0.1)
        at.append(len(rig.log))
        rig.do(Reset())
        rig.bring_to(State.READY)
        at.append(len(rig.log))
        rig.run(0.1)
        lengths.append(tuple(after - before for before, after in pairwise(at)))
    assert lengths == [lengths[0]] * 3


def test_one_garbled_statusword_stops_a_holding_joint_with_its_torque(rig: LoopRig) -> None:
    rig.hold()
    end = falsify(rig, word=NO_STATE)
    rig.cycle()
    end()
    assert rig.state is State.FAULT
    assert [drive.controlword for drive in rig.log[-1].drives] == [QUICK_STOP, QUICK_STOP]
    rig.run(0.1)
    assert [model.powered for model in rig.models] == [True, True]
    rig.recover()
