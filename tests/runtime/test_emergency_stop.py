"""The emergency path and the stop by a limit: the real classes and device models, cycle by cycle, as test_behaviour."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import pytest

from rtcp.config.operation import InputConfig
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.machine import Code, Command, Refusal, State
from rtcp.ipc.observer import Observer

from .bench import CONFIG, COUNTS, LONGEST_STEP, PERIOD_S, QUICK_STOP, SPEED, Bench, move_numbers

WITH_TORQUE = [State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.HOMING, State.STOPPED_BY_LIMIT]
PRESSED_SAYS = (
    "the emergency stop is pressed (inputs.emergency_stop in assistive_arm.yaml): release it, then `rtcp reset`"
)


# -- the button -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", WITH_TORQUE, ids=lambda state: state.name.lower())
def test_the_emergency_stop_ends_every_state_with_torque(bench: Bench, state: State) -> None:
    bench.bring_to(state)
    bench.press()
    assert bench.state is State.EMERGENCY_STOP
    bench.run(2.5)
    assert bench.arm.first_with_torque() == -1
    assert bench.arm.first_moving() == -1


def test_in_motion_the_drives_ramp_down_before_the_torque_goes_and_the_slaves_are_parked_last(bench: Bench) -> None:
    parked: list[int] = []
    bench.set_in_motion()
    bench.service.park = lambda: parked.append(bench.behaviour.cycle)  # type: ignore[method-assign]
    begun = len(bench.log)
    bench.press()
    bench.wait(lambda: bool(parked))
    seen = bench.log[begun:]
    moving = [n for n, cycle in enumerate(seen) if any(abs(said.velocity) > 200 for said in cycle.drives)]
    torque = [n for n, cycle in enumerate(seen) if any(said.has_torque for said in cycle.drives)]
    assert moving
    assert max(moving) < max(torque) < len(seen)
    assert parked == [bench.behaviour.cycle]
    assert bench.codes[-2:] == [Code.PRESSED, Code.PARKED]


def test_the_emergency_stop_makes_no_target_jump(bench: Bench) -> None:
    bench.set_in_motion()
    bench.press()
    bench.run(1.0)
    assert all(bench.longest_step(axis) <= LONGEST_STEP for axis in range(2))


def test_while_it_is_pressed_neither_reset_nor_enable_is_taken(bench: Bench) -> None:
    bench.hold().press()
    assert bench.refused(bench.order(Command.RESET)) == PRESSED_SAYS
    bench.run(2.0)
    assert bench.refused(bench.order(Command.RESET)) == PRESSED_SAYS
    bench.press(False)
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.press()
    assert bench.refused(bench.order(Command.ENABLE)) == PRESSED_SAYS


def test_released_while_the_parked_box_says_nothing_it_is_reset(bench: Bench) -> None:
    bench.hold().press()
    bench.run(1.0)
    bench.data.carries = False
    bench.run(0.1)
    bench.press(False)
    bench.do(Command.RESET)
    bench.data.carries = True
    bench.until(State.READY)
    bench.enable()


def test_still_pressed_when_the_parked_box_is_heard_again_it_is_an_emergency_stop_and_no_drive_is_enabled(
    bench: Bench,
) -> None:
    bench.hold().press()
    bench.run(1.0)
    bench.data.carries = False
    bench.run(0.1)
    at = len(bench.log)
    bench.do(Command.RESET)
    bench.data.carries = True
    bench.run(0.5)
    assert bench.state is State.EMERGENCY_STOP
    assert State.READY not in {cycle.state for cycle in bench.log[at:]}
    assert bench.refused(bench.order(Command.ENABLE))
    assert bench.arm.first_with_torque() == -1


def test_the_gripper_is_not_switched_while_it_is_pressed(bench: Bench) -> None:
    bench.start().press()
    assert "the emergency stop is pressed" in bench.refused(bench.order(Command.GRIPPER, [0.0]))


def test_released_it_moves_nothing_until_reset_and_enable(bench: Bench) -> None:
    bench.set_in_motion().press()
    bench.run(2.0)
    bench.press(False)
    bench.run(1.0)
    assert bench.state is State.EMERGENCY_STOP
    assert bench.arm.first_with_torque() == -1
    bench.do(Command.RESET)
    bench.until(State.READY)
    bench.run(0.1)
    assert bench.arm.first_with_torque() == -1
    bench.enable()
    bench.move(0.1, 0.1)
    bench.until(State.HOLDING)


def test_a_bounce_shorter_than_the_debounce_is_no_press(bench: Bench) -> None:
    bench.hold()
    for level in (False, True) * 5:
        bench.data.devices[0].set_input(9, level)
        bench.run(0.002)
    assert bench.state is State.HOLDING


def test_it_counts_while_frames_are_lost_as_soon_as_they_come_again(bench: Bench) -> None:
    bench.hold()
    bench.data.carries = False
    bench.run(0.01)
    bench.data.devices[0].set_input(9, False)
    bench.data.carries = True
    bench.run(0.02)
    assert bench.state is State.EMERGENCY_STOP


# -- what is measured -----------------------------------------------------------------------------------------------


def test_a_joint_that_is_pushed_beyond_its_speed_ends_in_the_emergency_stop(bench: Bench) -> None:
    bench.hold()
    bench.models[1].mechanics.external_torque = 400.0
    bench.until(State.EMERGENCY_STOP)
    assert bench.codes[-1] in (Code.OVER_SPEED, Code.FOLLOWING_ERROR)
    assert bench.events[-1].axis == 1
    assert abs(bench.events[-1].value) > bench.events[-1].limit


def test_a_joint_that_does_not_follow_ends_in_the_emergency_stop(bench: Bench) -> None:
    bench.hold()
    bench.data.deaf[1, 0x607A] = dict.fromkeys(range(-40000, 40000), 0)
    bench.do(Command.MOVE, move_numbers(0.0, 0.4, speed=SPEED))
    bench.until(State.EMERGENCY_STOP)
    assert (bench.codes[-1], bench.events[-1].axis) == (Code.FOLLOWING_ERROR, 1)
    assert "watch in assistive_arm.yaml" in bench.said[-1]


@pytest.mark.parametrize("cycles", [4, 5])
def test_a_torque_beyond_its_limit_counts_after_five_cycles_in_a_row(bench: Bench, cycles: int) -> None:
    bench.hold()
    drive = bench.arm.drives[0]
    decode = bench.arm.decode

    def too_much(data: object) -> None:
        decode(data)  # type: ignore[arg-type]
        bench.arm.state.actual_torque[0] = 1.6 * CONFIG.joints[0].torque

    bench.arm.decode = too_much  # type: ignore[method-assign]
    for _ in range(cycles):
        bench.cycle()
    bench.arm.decode = decode  # type: ignore[method-assign]
    bench.run(0.01)
    assert drive.name == "drive1"
    assert bench.state is (State.HOLDING if cycles < 5 else State.EMERGENCY_STOP)


# -- stopped by a limit ---------------------------------------------------------------------------------------------


def test_a_move_that_meets_a_limit_is_stopped_before_it_and_says_which(bench: Bench) -> None:
    bench.bring_to(State.STOPPED_BY_LIMIT)
    limit = bench.arm.limits.high[0]
    assert max(cycle.drives[0].target for cycle in bench.log) <= limit * COUNTS
    assert bench.codes[-2:] == [Code.ENDED + 3, Code.STOPPED]
    assert "joint1" in bench.said[-2]
    assert "`rtcp reset`" in bench.said[-2]
    assert all(bench.longest_step(axis) <= LONGEST_STEP for axis in range(2))


def test_stopped_by_a_limit_the_arm_holds_and_moves_again_only_after_reset(bench: Bench) -> None:
    bench.bring_to(State.STOPPED_BY_LIMIT)
    held = [cycle.target for cycle in bench.log[-1].drives]
    bench.run(0.2)
    assert [said.target for said in bench.log[-1].drives] == held
    assert bench.arm.first_not_enabled() == -1
    answer = bench.order(Command.MOVE, move_numbers(0.0, 0.0))
    assert answer.refusal == Refusal.NOT_IN_THIS_STATE
    assert bench.refused(answer).endswith("`rtcp reset` first")
    bench.do(Command.RESET)
    assert bench.state is State.HOLDING
    bench.move(0.0, 0.0)
    bench.until(State.HOLDING)
    assert bench.arm.drives[0].position == pytest.approx(0.0, abs=1e-3)


# -- homing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("beyond", [-0.05, 0.015, 0.019])
@pytest.mark.parametrize("speed", [0.1, 0.3, 0.5])
def test_a_move_right_after_a_homing_beyond_the_range_begins_as_any_other(
    bench: Bench, beyond: float, speed: float
) -> None:
    bench.hold()
    high = bench.arm.limits.high[0]
    bench.models[0].objects[0x6098, 0].value = 37
    bench.models[0].objects[0x607C, 0].value = round((high + beyond) * COUNTS)
    bench.do(Command.HOME, [0])
    bench.until(State.HOLDING)
    begun = len(bench.log) - 1
    bench.move(high - 0.8, bench.arm.drives[1].position, speed=speed)
    bench.run(1.2)
    targets = [cycle.drives[0].target for cycle in bench.log[begun:]]
    speeds = [(after - before) / COUNTS / PERIOD_S for before, after in pairwise(targets)]
    faster = max(abs(after - before) for before, after in pairwise(speeds))
    # The targets are whole counts.
    rounding = 2 / COUNTS / PERIOD_S
    assert faster <= CONFIG.joints[0].acceleration * PERIOD_S + rounding
    assert max(map(abs, speeds)) <= speed * 1.01 + rounding


def test_a_drive_is_homed_where_it_stands_and_the_others_hold(bench: Bench) -> None:
    bench.models[0].mechanics.position = 0.5
    bench.hold()
    bench.models[0].objects[0x6098, 0].value = 37
    bench.do(Command.HOME, [0])
    bench.until(State.HOLDING)
    bench.run(0.1)
    assert Code.HOMED in bench.codes
    assert bench.arm.drives[0].position == pytest.approx(0.0, abs=1e-3)
    assert bench.longest_step(1) <= 1
    bench.move(0.2, 0.0)
    bench.until(State.HOLDING)
    bench.run(0.2)
    assert bench.arm.drives[0].position == pytest.approx(0.2, abs=1e-3)


def test_a_homing_that_is_stopped_leaves_the_arm_holding(bench: Bench) -> None:
    bench.bring_to(State.HOMING)
    bench.run(0.2)
    bench.do(Command.STOP)
    bench.until(State.HOLDING)
    assert [said.mode_display for said in bench.log[-1].drives] == [8, 8]


def test_disabling_ends_a_homing_before_the_torque_goes(bench: Bench) -> None:
    bench.bring_to(State.HOMING)
    bench.run(0.2)
    bench.do(Command.DISABLE)
    bench.until(State.READY)
    assert bench.arm.first_with_torque() == -1


def test_frames_that_stay_away_while_a_homing_is_ended_by_disabling_are_a_fault(bench: Bench) -> None:
    bench.bring_to(State.HOMING)
    bench.run(0.1)
    bench.do(Command.DISABLE)
    bench.data.carries = False
    bench.run(1.0)
    assert bench.state is State.FAULT
    assert bench.codes[-2:] == [Code.BUS_LOST, Code.TORQUE_OFF]


def test_the_button_counts_while_a_homing_is_ended_by_disabling(bench: Bench) -> None:
    bench.bring_to(State.HOMING)
    bench.run(0.1)
    bench.do(Command.DISABLE)
    bench.press()
    assert bench.state is State.EMERGENCY_STOP


@pytest.mark.parametrize("command", [Command.DISABLE, Command.SHUTDOWN])
def test_a_joint_that_turns_on_after_its_homing_is_stopped_hard_whatever_ended_it(
    bench: Bench, command: Command
) -> None:
    bench.bring_to(State.HOMING)
    bench.run(0.1)
    turned = bench.models[0].mechanics
    turned.inertia, turned.velocity, turned.external_torque = 1e5, 0.015, 117.0
    bench.do(command)
    bench.run(3.2)
    assert Code.HOMING_RUNNING in bench.codes
    assert bench.log[-1].drives[0].controlword == QUICK_STOP


def test_a_drive_that_reads_a_place_outside_its_range_after_homing_is_a_fault(bench: Bench) -> None:
    bench.hold()
    bench.models[1].objects[0x6098, 0].value = 37
    bench.models[1].objects[0x607C, 0].value = 30000
    bench.do(Command.HOME, [1])
    bench.until(State.FAULT)
    assert (bench.codes[-1], bench.events[-1].axis) == (Code.LEFT_RANGE, 1)


# -- the enabling switch --------------------------------------------------------------------------------------------


@pytest.fixture
def held(bench_board: tuple[Blackboard, Observer]) -> Iterator[Bench]:
    """A bench with an enabling switch at input 11."""
    switch = InputConfig(11)
    made = Bench(*bench_board, config=replace(CONFIG, inputs=replace(CONFIG.inputs, enabling_switch=switch)))
    yield made
    bench_board[1].release(made.lease)


def permit(bench: Bench, pressed: bool) -> None:
    bench.data.devices[0].set_input(10, pressed)
    bench.run(0.01)


def test_without_the_enabling_switch_no_motion_begins(held: Bench) -> None:
    held.hold()
    answer = held.order(Command.MOVE, move_numbers(0.1, 0.1))
    assert held.refused(answer) == ("the enabling switch is not pressed (inputs.enabling_switch in assistive_arm.yaml)")
    assert held.state is State.HOLDING


def test_letting_go_of_the_enabling_switch_is_a_controlled_stop_and_pressing_it_again_moves_nothing(
    held: Bench,
) -> None:
    held.hold()
    permit(held, True)
    held.move(1.0, 1.0)
    held.run(0.5)
    permit(held, False)
    assert Code.NOT_PERMITTED in held.codes
    held.until(State.HOLDING)
    rest = [said.target for said in held.log[-1].drives]
    permit(held, True)
    held.run(0.5)
    assert [said.target for said in held.log[-1].drives] == rest
    assert all(held.longest_step(axis) <= LONGEST_STEP for axis in range(2))


# -- lamps and the gripper ------------------------------------------------------------------------------------------


def test_the_lamps_show_torque_and_motion_and_the_heartbeat_changes_each_cycle(bench: Bench) -> None:
    bench.start()
    assert bench.data.devices[0].outputs & 3 == 0
    bench.enable()
    bench.run(0.01)
    assert bench.data.devices[0].outputs & 3 == 1
    bench.move(0.3, 0.3)
    bench.run(0.1)
    assert bench.data.devices[0].outputs & 3 == 3
    beats = []
    for _ in range(6):
        bench.cycle()
        beats.append(bench.data.devices[0].outputs >> 2 & 1)
    assert beats in ([0, 1] * 3, [1, 0] * 3)


def test_the_gripper_opens_and_closes_on_its_output(bench: Bench) -> None:
    bench.hold()
    bench.do(Command.GRIPPER, [0])
    bench.run(0.005)
    assert bench.data.devices[0].outputs >> 3 & 1 == 1
    bench.do(Command.GRIPPER, [1])
    bench.run(0.005)
    assert bench.data.devices[0].outputs >> 3 & 1 == 0
