"""Limits change by a command: taken whole by everything that keeps them, or refused with nothing changed."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import pytest

from rtcp.config import default_config, load
from rtcp.control.arm import Arm
from rtcp.control.limit_orders import LimitOrders
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.machine import Code, Command, Refusal, State
from rtcp.ipc.messages import Sentences
from rtcp.ipc.observer import Answer, Observer
from rtcp.motion.limits import Values, rows

from .bench import CONFIG, COUNTS, PERIOD_S, Bench, move_numbers

WIDEST = Values.configured(CONFIG)


def of_first(name: str, number: float) -> Values:
    """What is configured, with another number for the first joint."""
    return replace(WIDEST, **{name: (number, *getattr(WIDEST, name)[1:])})


def give(bench: Bench, new: Values) -> Answer:
    """Give the command as the gateway does."""
    plan = rows(new)
    return bench.order(Command.LIMITS, [bench.observer.write_plan(plan), len(plan)])


def in_force(bench: Bench) -> Values:
    limits = bench.arm.limits
    lists = (limits.low, limits.high, limits.velocity, limits.acceleration, limits.jerk, limits.torque)
    return Values(*(tuple(one) for one in lists), limits.box, limits.keep_out)


@pytest.mark.parametrize("state", [State.READY, State.HOLDING, State.MOVING, State.FAULT, State.EMERGENCY_STOP])
def test_narrower_limits_are_taken_and_told(bench: Bench, state: State) -> None:
    bench.bring_to(state)
    new = of_first("high", 3.0)
    assert give(bench, new).refusal == Refusal.NONE
    assert in_force(bench) == new
    assert bench.codes[-1] == Code.LIMITS
    assert bench.state is state


def test_the_next_move_keeps_to_the_new_limits(bench: Bench) -> None:
    bench.hold()
    give(bench, replace(of_first("high", 0.5), velocity=(0.1, 0.1)))
    assert bench.order(Command.MOVE, move_numbers(0.6, 0.0, speed=0.1)).refusal == Refusal.POSITION_LIMIT
    assert bench.order(Command.MOVE, move_numbers(0.1, 0.0, speed=0.2)).refusal == Refusal.SPEED
    bench.move(0.2, 0.2, speed=0.1)
    bench.until(State.HOLDING)
    assert bench.longest_step(0) <= 0.1 * PERIOD_S * COUNTS + 1
    # Back to what is configured: the speed is there again.
    assert give(bench, WIDEST).refusal == Refusal.NONE
    bench.log.clear()
    bench.move(-0.2, 0.2, speed=0.5)
    bench.until(State.HOLDING)
    assert bench.longest_step(0) > 0.3 * PERIOD_S * COUNTS


def test_the_acceleration_of_the_next_move_is_the_new_one(bench: Bench) -> None:
    bench.hold()
    give(bench, of_first("acceleration", 0.2))
    bench.move(1.0, 0.0)
    bench.run(0.5)
    assert 0.0 < bench.arm.state.commanded_velocity[0] <= 0.2 * 0.5


def test_the_last_clamp_before_the_drives_keeps_to_them_too(bench: Bench) -> None:
    bench.hold()
    give(bench, of_first("velocity", 0.1))
    drive = bench.arm.drives[0]
    before = drive.target_position
    drive.target_position = before + 1.0
    bench.arm.output_limiter.check(bench.arm.drives)
    assert drive.target_position == pytest.approx(before + 0.1 * PERIOD_S, rel=1e-4)


def test_a_move_under_way_that_leads_beyond_the_new_limit_is_stopped_before_it(bench: Bench) -> None:
    bench.set_in_motion()
    high = bench.arm.state.commanded[0] + 0.1
    assert give(bench, of_first("high", high)).refusal == Refusal.NONE
    bench.until(State.STOPPED_BY_LIMIT)
    bench.run(0.2)
    assert bench.arm.drives[0].position <= high + 1e-4


@pytest.mark.parametrize(
    ("new", "refusal", "axis", "says"),
    [
        (of_first("high", 3.2), Refusal.LIMITS_NARROW, 0, "joint1: 3.2 is beyond what the configuration allows, 3.1"),
        (of_first("high", -0.5), Refusal.LIMITS_OUTSIDE, 0, "outside the new limit -0.5 rad: nothing was changed"),
        (of_first("velocity", nan), Refusal.LIMITS_WRONG, 0, "joint1: nan is no limit that can be set"),
        (of_first("low", 3.1), Refusal.LIMITS_WRONG, 0, "is no limit that can be set"),
    ],
    ids=["wider", "outside", "nan", "empty"],
)
def test_limits_that_cannot_be_are_refused_and_nothing_changes(
    bench: Bench, new: Values, refusal: Refusal, axis: int, says: str
) -> None:
    bench.hold()
    answer = give(bench, new)
    assert (answer.refusal, answer.axis) == (refusal, axis)
    assert says in bench.refused(answer)
    assert in_force(bench) == WIDEST
    assert Code.LIMITS not in bench.codes


def test_a_range_that_the_arm_would_run_out_of_or_a_speed_that_it_has_passed_is_refused(bench: Bench) -> None:
    bench.set_in_motion()
    here = bench.arm.state.commanded[0]
    # From 0.3 rad/s with 2 rad/s^2 the stop takes 0.0225 rad.
    assert give(bench, of_first("high", here + 0.02)).refusal == Refusal.LIMITS_OUTSIDE
    answer = give(bench, of_first("velocity", 0.1))
    assert (answer.refusal, answer.value, answer.limit) == (Refusal.LIMITS_WRONG, 0.1, pytest.approx(0.3, rel=0.01))
    assert bench.state is State.MOVING
    assert in_force(bench) == WIDEST


@pytest.mark.parametrize(
    "numbers", [[2, 3], [-1, 3], [0.5, 3], [nan, 3], [0, 0], [0, nan], [0, 2], [0, 4096], [0, 1e18]]
)
def test_a_place_or_a_count_that_is_none_is_refused(bench: Bench, numbers: list[float]) -> None:
    bench.hold()
    bench.observer.write_plan(rows(WIDEST))
    assert bench.order(Command.LIMITS, numbers).refusal == Refusal.LIMITS_WRONG
    assert in_force(bench) == WIDEST


def test_boxes_that_the_arm_stands_in_are_refused(bench_board: tuple[Blackboard, Observer]) -> None:
    config = load(default_config())
    arm = Arm(config, [])
    widest = arm.limits.widest
    arm.state.commanded[:] = [0.3, -0.5, 1.2, 0.2, 0.7, -0.4]
    arm.trajectory_guard.latch(arm.state)
    orders = LimitOrders(arm, bench_board[0])
    x = arm.trajectory_guard.poses[6].position[0]
    assert widest.box is not None
    for side, expected in (
        (x - 0.01, (Refusal.LIMITS_OUTSIDE, -1, pytest.approx(-0.01), -1.0)),
        (x + 0.01, (Refusal.NONE,)),
    ):
        new = replace(widest, box=(*widest.box[:3], side, *widest.box[4:]))
        plan = rows(new)
        assert orders.take(1, [bench_board[1].write_plan(plan), len(plan)]) == expected
    assert arm.limits.box == new.box


@pytest.mark.parametrize("name", ["user", "chair"])
def test_a_keep_out_box_that_the_arm_stands_in_is_refused_by_its_name(
    bench_board: tuple[Blackboard, Observer], name: str
) -> None:
    config = load(default_config())
    which = [box.name for box in config.cartesian.keep_out].index(name)
    arm = Arm(config, [])
    widest = arm.limits.widest
    arm.state.commanded[:] = [0.3, -0.5, 1.2, 0.2, 0.7, -0.4]
    arm.trajectory_guard.latch(arm.state)
    # The box alone grows over the tool, to beyond the other side of the arm's base and no further than it.
    tool = arm.trajectory_guard.poses[6].position
    boxes = list(widest.keep_out)
    low, high = boxes[which][:3], boxes[which][3:]
    grown = [min(a, b - 0.05) for a, b in zip(low, tool, strict=True)]
    grown += [max(a, b + 0.05) for a, b in zip(high, tool, strict=True)]
    boxes[which] = tuple(grown)  # type: ignore[assignment]
    plan = rows(replace(widest, keep_out=tuple(boxes)))
    answer = LimitOrders(arm, bench_board[0]).take(1, [bench_board[1].write_plan(plan), len(plan)])
    assert (answer[0], answer[1], answer[3]) == (Refusal.LIMITS_OUTSIDE, -1, float(which))
    assert Sentences(config).refusal(*answer) == (
        f"the tool, the wrist or the elbow would pass the new bounds of the keep-out box {name} "
        f"(cartesian.keep_out[{which}] in {config.source.name}): nothing was changed"
    )
    assert arm.limits.keep_out == widest.keep_out


@pytest.fixture
def loaded(bench: Bench) -> Bench:
    """Somebody leans on the first joint: its drive holds 5 Nm."""
    bench.hold()
    bench.models[0].mechanics.external_torque = 5.0
    bench.run(0.5)
    assert abs(bench.arm.state.actual_torque[0]) == pytest.approx(5.0, abs=WIDEST.torque[0] * 0.05)
    return bench


def test_less_torque_than_a_joint_holds_is_refused_and_nothing_changes(loaded: Bench) -> None:
    held = abs(loaded.arm.state.actual_torque[0])
    answer = give(loaded, of_first("torque", 2.0))
    assert (answer.refusal, answer.axis) == (Refusal.LIMITS_WEAK, 0)
    assert loaded.refused(answer) == (
        f"joint1 holds {held:.6g} Nm, more than the new limit of 2 Nm: it would sag, nothing was changed"
    )
    assert in_force(loaded) == WIDEST
    assert Code.LIMITS not in loaded.codes


def test_less_torque_that_is_still_more_than_a_joint_holds_is_taken(loaded: Bench) -> None:
    new = of_first("torque", 10.0)
    assert give(loaded, new).refusal == Refusal.NONE
    assert in_force(loaded) == new


def test_a_torque_that_is_not_lowered_is_no_matter_whatever_is_held(loaded: Bench) -> None:
    assert give(loaded, of_first("torque", 10.0)).refusal == Refusal.NONE
    loaded.models[0].mechanics.external_torque = 12.0
    loaded.run(0.3)
    assert abs(loaded.arm.state.actual_torque[0]) > 10.0
    assert give(loaded, replace(of_first("torque", 10.0), velocity=(0.2, 0.2))).refusal == Refusal.NONE


def test_without_torque_any_torque_limit_is_taken(loaded: Bench, bench_board: tuple[Blackboard, Observer]) -> None:
    loaded.do(Command.DISABLE)
    loaded.until(State.READY)
    # Whatever a drive without torque shows.
    loaded.arm.state.actual_torque[0] = 5.0
    new = of_first("torque", 2.0)
    plan = rows(new)
    assert LimitOrders(loaded.arm, bench_board[0]).take(1, [bench_board[1].write_plan(plan), len(plan)]) == (
        Refusal.NONE,
    )
    assert in_force(loaded) == new
