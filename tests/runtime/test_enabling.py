"""Enabling: what a drive shows meanwhile that is not so, what is measured meanwhile, and who leaves it again."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest

from rtcp.ipc.machine import Code, Command, Refusal, State

from .bench import (
    CONFIG,
    CONTROLWORD,
    COUNTS,
    ENABLE_OPERATION,
    LONGEST_STEP,
    PERIOD_S,
    QUICK_STOP,
    SWITCH_ON,
    Bench,
    move_numbers,
)

_INPUTS = struct.Struct("<Hiiib")
ENABLED, SWITCHED_ON, NO_STATE = 0x0237, 0x0233, 0x0213
"""Statuswords; the last is none that the standard defines."""


def falsify(bench: Bench, axis: int = 0, word: int | None = None, position: float | None = None) -> Callable[[], None]:
    """Let all frames from now on carry a false statusword or position (rad) of a drive; return what ends it."""
    real = bench.data.input

    def read(slot: int) -> bytes:
        data = real(slot)
        if slot != axis + 1:
            return data
        values = list(_INPUTS.unpack(data))
        values[0] = values[0] if word is None else word
        values[1] = values[1] if position is None else round(position * COUNTS)
        return _INPUTS.pack(*values)

    bench.data.input = read  # type: ignore[method-assign]

    def end() -> None:
        bench.data.input = real  # type: ignore[method-assign]

    return end


def until_told_to_enable(bench: Bench, axis: int = 0) -> Bench:
    """Enable, up to the cycle in which the drive has been told to and does not show it yet."""
    bench.start().do(Command.ENABLE)
    bench.wait(lambda: bench.log[-1].drives[axis].controlword == ENABLE_OPERATION)
    assert bench.log[-1].drives[axis].statusword & 0x6F == 0x23
    return bench


def largest_way(bench: Bench, seconds: float) -> float:
    """Run; return the largest distance of the first joint from 0, where it began, rad."""
    found = 0.0
    for _ in range(round(seconds / PERIOD_S)):
        bench.cycle()
        found = max(found, abs(bench.models[0].mechanics.position))
    return found


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("position", [0.05, 0.1, -0.14])
def test_no_joint_follows_a_false_position_while_its_drive_is_being_enabled(
    bench: Bench, position: float, frames: int
) -> None:
    end = falsify(until_told_to_enable(bench), word=SWITCHED_ON, position=position)
    bench.run(frames * PERIOD_S)
    end()
    assert largest_way(bench, 0.5) < 1e-4
    assert bench.state is State.HOLDING
    assert {said.drives[0].target for said in bench.log if said.drives[0].controlword == ENABLE_OPERATION} == {0}


def test_a_position_that_stays_false_while_enabling_is_a_fault_that_names_both_places(bench: Bench) -> None:
    falsify(until_told_to_enable(bench), word=SWITCHED_ON, position=0.1)
    bench.run((CONFIG.watch.cycles - 1) * PERIOD_S)
    assert bench.state is State.ENABLING
    bench.cycle()
    assert (bench.state, bench.codes[-1]) == (State.FAULT, Code.POSITION_JUMPED)
    assert bench.said[-1].startswith("joint1 was followed to 0 rad while being enabled and is suddenly at 0.1 rad")
    assert largest_way(bench, 0.5) < 1e-4


def test_false_positions_that_do_not_follow_each_other_are_not_added_up(bench: Bench) -> None:
    bench.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    until_told_to_enable(bench)
    for _ in range(2 * CONFIG.watch.cycles):
        end = falsify(bench, axis=1, position=0.1)
        bench.cycle()
        end()
        bench.cycle()
    bench.data.deaf.clear()
    bench.until(State.HOLDING)


def test_a_joint_that_sags_while_its_brake_opens_is_followed_and_enabled(bench: Bench) -> None:
    bench.start().do(Command.ENABLE)
    model = bench.models[1].mechanics
    while bench.log[-1].drives[1].statusword & 0x6F != 0x27:
        model.position -= 0.4 * PERIOD_S
        bench.cycle()
    bench.until(State.HOLDING)
    assert bench.longest_step(1) <= LONGEST_STEP


def test_a_joint_that_runs_away_before_all_drives_are_enabled_is_an_emergency(bench: Bench) -> None:
    bench.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    bench.start().do(Command.ENABLE)
    bench.wait(lambda: bench.log[-1].drives[0].statusword & 0x6F == 0x27)
    turned = bench.models[0].mechanics
    turned.inertia, turned.velocity = 1e5, 0.9
    bench.until(State.EMERGENCY_STOP, (CONFIG.watch.cycles + 3) * PERIOD_S)
    assert bench.codes[-1] is Code.OVER_SPEED


def test_a_drive_that_leaves_operation_enabled_while_others_are_on_their_way_is_not_enabled_again(
    bench: Bench,
) -> None:
    bench.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: SWITCH_ON}
    bench.start().do(Command.ENABLE)
    bench.wait(lambda: bench.log[-1].drives[0].statusword & 0x6F == 0x27)
    bench.run(0.02)
    bench.data.deaf[0, CONTROLWORD] = {ENABLE_OPERATION: 0}
    bench.until(State.FAULT, 5 * PERIOD_S)
    assert (bench.codes[-1], bench.events[-1].axis) == (Code.DRIVE_LEFT_ENABLED, 0)
    bench.data.deaf.clear()
    bench.run(0.3)
    assert bench.words(0).count(ENABLE_OPERATION) == 1
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.enable()


def enable_beyond(bench: Bench, beyond: float = 0.018) -> Bench:
    """Enable with the second joint so far beyond its range, up to the cycle in which all drives are enabled."""
    bench.models[1].mechanics.position = CONFIG.joints[1].position.max + beyond
    bench.start().do(Command.ENABLE)
    bench.wait(lambda: all(said.statusword & 0x6F == 0x27 for said in bench.log[-1].drives))
    return bench


@pytest.mark.parametrize(("velocity", "told"), [(0.5, 0.05), (0.02, 0.02)])
def test_a_joint_that_is_brought_back_into_its_range_is_told_with_how_far_and_how_fast(
    bench: Bench, velocity: float, told: float
) -> None:
    limits = bench.arm.limits
    limits.velocity[1] = velocity
    bench.arm.output_limiter.take(limits)
    enable_beyond(bench).until(State.HOLDING)
    assert bench.codes[-2:] == [Code.LED_BACK, Code.ENABLED]
    assert bench.said[-2] == (
        "joint2 stands 0.018 rad beyond its range (joints[1].position in assistive_arm.yaml, or `rtcp limits`): "
        f"it is brought back to the edge at {told} rad/s"
    )


def test_what_a_joint_at_the_edge_sags_is_made_good_without_a_word(bench: Bench) -> None:
    enable_beyond(bench, 0.0005).until(State.HOLDING)
    assert Code.LED_BACK not in bench.codes
    assert bench.log[-1].drives[1].target == 20000


def test_no_motion_begins_before_a_joint_beyond_its_range_is_back(bench: Bench) -> None:
    enable_beyond(bench)
    began = len(bench.log)
    while bench.state is State.ENABLING:
        answer = bench.order(Command.MOVE, move_numbers(0.0, 1.0))
    # The last was taken in the cycle that ended it.
    assert (len(bench.log) - began) * PERIOD_S == pytest.approx(0.018 / 0.05, abs=0.04)
    assert answer.refusal == Refusal.NOT_IN_THIS_STATE
    assert bench.log[-1].drives[1].target == 20000
    bench.move(0.0, 1.0)
    bench.until(State.HOLDING)
    assert bench.log[-1].drives[1].target == 10000


def test_a_joint_that_is_brought_back_stands_when_it_is_disabled_and_begins_anew_where_it_is(bench: Bench) -> None:
    enable_beyond(bench)
    bench.run(0.1)
    assert 20100 < bench.log[-1].drives[1].target < 20180
    before = len(bench.log)
    bench.do(Command.DISABLE)
    bench.until(State.READY)
    assert not [cycle for cycle in bench.log[before + 1 :] if cycle.drives[1].obeys_target]
    bench.run(0.1)
    before = len(bench.log)
    bench.enable()
    said = [cycle.drives[1] for cycle in bench.log[before:] if cycle.drives[1].controlword == ENABLE_OPERATION]
    assert abs(said[0].target - said[0].position) <= 1
    assert bench.log[-1].drives[1].target == 20000
    assert bench.codes.count(Code.LED_BACK) == 2


def test_a_drive_that_leaves_while_its_joint_is_brought_back_is_a_fault(bench: Bench) -> None:
    enable_beyond(bench).run(0.1)
    assert bench.state is State.ENABLING
    bench.data.deaf[1, CONTROLWORD] = {ENABLE_OPERATION: 0}
    bench.until(State.FAULT, 5 * PERIOD_S)
    assert (bench.codes[-1], bench.events[-1].axis) == (Code.DRIVE_LEFT_ENABLED, 1)


def test_a_false_position_is_judged_by_where_a_joint_beyond_its_range_is_and_not_by_the_edge(bench: Bench) -> None:
    bench.models[1].mechanics.position = 2.015
    end = falsify(until_told_to_enable(bench, 1), axis=1, word=SWITCHED_ON, position=1.98)
    before = len(bench.log)
    bench.run(4 * PERIOD_S)
    end()
    assert {cycle.drives[1].target for cycle in bench.log[before:]} == {20150}
    falsify(bench, axis=1, word=SWITCHED_ON, position=1.98)
    bench.until(State.FAULT, 2 * CONFIG.watch.cycles * PERIOD_S)
    assert bench.codes[-1] is Code.POSITION_JUMPED
    assert bench.said[-1].startswith("joint2 was followed to 2.015 rad while being enabled and is suddenly at 1.98 rad")


def test_one_garbled_statusword_stops_a_holding_joint_with_its_torque(bench: Bench) -> None:
    bench.hold()
    end = falsify(bench, word=NO_STATE)
    bench.cycle()
    end()
    assert bench.state is State.FAULT
    assert [said.controlword for said in bench.log[-1].drives] == [QUICK_STOP, QUICK_STOP]
    bench.run(0.1)
    assert [model.powered for model in bench.models] == [True, True]
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.enable()
