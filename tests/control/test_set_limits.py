"""Limits change by a command: every part uses the new ones, or the command is refused and none changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import nan, pi
from unittest.mock import ANY

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import AbsoluteLimits, Cone
from rtcp.control.arm import Arm
from rtcp.ipc import refusals
from rtcp.ipc.commands import Disable, SetLimits
from rtcp.ipc.events import EnabledInBox, FollowingError, LimitsChanged, OverSpeed, OverTorque
from rtcp.ipc.names import Names
from rtcp.ipc.observer import Answer
from rtcp.ipc.schema import FIRST_CONE
from rtcp.ipc.states import State
from rtcp.motion.guards.zones import reported
from rtcp.motion.limits import Values, rows
from rtcp.motion.state import ArmState

from .rig import CONFIG, COUNTS, CST, PERIOD_S, LoopRig, about, move_to

WIDEST = Values.configured(CONFIG)


def of_first(name: str, number: float) -> Values:
    """The configured limits, with another number for the first joint."""
    return replace(WIDEST, **{name: (number, *getattr(WIDEST, name)[1:])})


def send_limits(rig: LoopRig, new: Values) -> Answer:
    """Send the command as the gateway does."""
    plan = rows(new)
    return rig.send(SetLimits(rig.observer.write_plan(plan), len(plan)))


def in_force(rig: LoopRig) -> Values:
    return rig.arm.limits.now


@pytest.mark.parametrize("state", [State.READY, State.HOLDING, State.MOVING, State.FAULT, State.EMERGENCY_STOP])
def test_narrower_limits_are_taken_and_reported(rig: LoopRig, state: State) -> None:
    rig.lead_to(state)
    new = of_first("high", 3.0)
    assert send_limits(rig, new).refusal is None
    assert in_force(rig) == new
    assert rig.kinds[-1] == LimitsChanged
    assert rig.state is state


def test_no_limit_changes_while_drives_brake_by_themselves(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.service.lost_slave = 3
    rig.cycle()
    assert rig.state is State.FAULT
    refusal = send_limits(rig, of_first("acceleration", 1.0)).refusal
    assert isinstance(refusal, refusals.NotAtStandstill)
    assert in_force(rig) == WIDEST
    rig.run(1.0)
    assert send_limits(rig, of_first("acceleration", 1.0)).refusal is None


def test_the_next_move_keeps_to_the_new_limits(rig: LoopRig) -> None:
    rig.hold()
    send_limits(rig, replace(of_first("high", 0.5), velocity=(0.1, 0.1)))
    assert rig.send(move_to(0.6, 0.0, speed=0.1)).refusal == refusals.PositionOutOfRange(0, 0.6, 0.5)
    assert rig.send(move_to(0.1, 0.0, speed=0.2)).refusal == refusals.SpeedOutOfRange(0.2, 0.1)
    rig.move(0.2, 0.2, speed=0.1)
    rig.bring_to(State.HOLDING)
    assert rig.longest_step(0) <= 0.1 * PERIOD_S * COUNTS + 1
    # With the configured limits the speed is possible again.
    assert send_limits(rig, WIDEST).refusal is None
    rig.log.clear()
    rig.move(-0.2, 0.2, speed=0.5)
    rig.bring_to(State.HOLDING)
    assert rig.longest_step(0) > 0.3 * PERIOD_S * COUNTS


def test_the_acceleration_of_the_next_move_is_the_new_one(rig: LoopRig) -> None:
    rig.hold()
    send_limits(rig, of_first("acceleration", 0.2))
    rig.move(1.0, 0.0)
    rig.run(0.5)
    assert 0.0 < rig.arm.state.commanded_velocity[0] <= 0.2 * 0.5


def test_the_last_clamp_before_the_drives_keeps_to_them_too(rig: LoopRig) -> None:
    rig.hold()
    send_limits(rig, of_first("velocity", 0.1))
    drive = rig.arm.drives[0]
    before = drive.target_position
    drive.target_position = before + 1.0
    rig.arm.output_limiter.check(rig.arm.drives)
    assert drive.target_position == pytest.approx(before + 0.1 * PERIOD_S, rel=1e-4)


def test_what_is_measured_is_compared_with_them_too(rig: LoopRig) -> None:
    rig.hold()
    send_limits(rig, of_first("velocity", 0.1))
    watched = ArmState(len(CONFIG.joints))
    watched.actual_velocity[0] = CONFIG.supervision.speed * 0.1 + 0.01
    seen = [rig.arm.supervision.check(watched) for _ in range(CONFIG.supervision.cycles)]
    assert seen[-1] == OverSpeed(0, watched.actual_velocity[0], CONFIG.supervision.speed * 0.1)


def test_the_thresholds_of_what_is_measured_change_with_them(rig: LoopRig) -> None:
    rig.hold()
    assert send_limits(rig, replace(WIDEST, supervision=(1.1, *WIDEST.supervision[1:]))).refusal is None
    watched = ArmState(len(CONFIG.joints))
    watched.actual_velocity[0] = 1.2 * CONFIG.joints[0].velocity
    seen = [rig.arm.supervision.check(watched) for _ in range(CONFIG.supervision.cycles)]
    assert seen[-1] == OverSpeed(0, watched.actual_velocity[0], about(1.1 * CONFIG.joints[0].velocity))
    refusal = send_limits(rig, replace(WIDEST, supervision=(1.7, *WIDEST.supervision[1:]))).refusal
    assert refusal == refusals.LimitWidened(-2, 1.7, CONFIG.supervision.speed)


def test_limits_are_widened_on_purpose_without_torque_and_the_drives_follow(new_rig: Callable[..., LoopRig]) -> None:
    fast = replace(CONFIG.joints[0], absolute=AbsoluteLimits(velocity=0.8))
    rig = new_rig(replace(CONFIG, joints=(fast, *CONFIG.joints[1:])))
    plan = rows(of_first("velocity", 0.8))

    def widen(plan: list[list[float]]) -> refusals.Refusal | None:
        return rig.send(SetLimits(rig.observer.write_plan(plan), len(plan), True)).refusal

    rig.hold()
    assert widen(plan) == refusals.TorquePresent()
    rig.send(Disable())
    rig.bring_to(State.READY)
    assert send_limits(rig, of_first("velocity", 0.8)).refusal == refusals.LimitWidened(0, 0.8, 0.5)
    assert widen(rows(of_first("velocity", 0.9))) == refusals.LimitWidened(0, 0.9, 0.8)
    assert widen(plan) is None
    assert rig.arm.drives[0].speed_limit == 0.8
    rig.hold()
    rig.log.clear()
    rig.move(1.5, 0.0, speed=0.8)
    rig.bring_to(State.HOLDING)
    assert rig.longest_step(0) > 0.75 * PERIOD_S * COUNTS
    # What was widened stays when something else is narrowed.
    assert send_limits(rig, replace(in_force(rig), jerk=tuple(0.5 * jerk for jerk in WIDEST.jerk))).refusal is None
    assert in_force(rig).velocity[0] == 0.8


def test_an_arm_that_is_enabled_outside_a_cone_is_told_by_how_much() -> None:
    arm = standing_arm()
    z = [arm.trajectory_guard.poses[6].rotation[2 + 3 * row] for row in range(3)]
    cone = Cone("cup", (z[1], -z[0], 0.0), 1.0)
    config = load(default_config())
    config = replace(config, cartesian=replace(config.cartesian, cones=(cone,)))
    arm = Arm(config, [], lambda slot: memoryview(b"").cast("d"))
    distance, zone = arm.trajectory_guard.nearest_box([0.3, -0.5, 1.2, 0.2, 0.7, -0.4])
    assert (zone, reported(zone, -distance)) == (FIRST_CONE, about(pi / 2 - 1.0))
    message = Names(config).message(EnabledInBox(zone, reported(zone, -distance)))
    assert message.startswith("the arm stands 0.570796 rad beyond the bounds of the cone cup (cartesian.cones[0] in")


def test_a_move_under_way_that_leads_beyond_the_new_limit_is_stopped_before_it(rig: LoopRig) -> None:
    rig.set_in_motion()
    high = rig.arm.state.commanded[0] + 0.1
    assert send_limits(rig, of_first("high", high)).refusal is None
    rig.bring_to(State.STOPPED_BY_LIMIT)
    rig.run(0.2)
    assert rig.arm.drives[0].position <= high + 1e-4


@pytest.mark.parametrize(
    ("new", "refusal"),
    [
        (of_first("high", 3.2), refusals.LimitWidened(0, 3.2, 3.1)),
        (of_first("high", -0.5), refusals.LimitsExcludeJoint(0, 0.0, -0.5)),
        (of_first("low", 3.1), refusals.ImpossibleLimit(0, 3.1, 3.1)),
        (of_first("velocity", nan), refusals.ImpossibleLimit(0, about(nan, nan_ok=True), ANY)),
    ],
    ids=["wider", "outside", "empty", "no number"],
)
def test_limits_that_cannot_be_are_refused_and_nothing_changes(
    rig: LoopRig, new: Values, refusal: refusals.Refusal
) -> None:
    rig.hold()
    assert send_limits(rig, new).refusal == refusal
    assert in_force(rig) == WIDEST
    assert LimitsChanged not in rig.kinds


def test_a_range_that_the_arm_would_run_out_of_or_a_speed_that_it_has_passed_is_refused(rig: LoopRig) -> None:
    rig.set_in_motion()
    here = rig.arm.state.commanded[0]
    # From 0.3 rad/s with 2 rad/s^2 the stop takes 0.0225 rad.
    assert isinstance(send_limits(rig, of_first("high", here + 0.02)).refusal, refusals.LimitsExcludeJoint)
    assert send_limits(rig, of_first("velocity", 0.1)).refusal == refusals.ImpossibleLimit(0, 0.1, about(0.3, rel=0.01))
    assert rig.state is State.MOVING
    assert in_force(rig) == WIDEST


@pytest.mark.parametrize(("slot", "count"), [(2, 3), (-1, 3), (0, 0), (0, 2), (0, 4096)])
def test_a_slot_or_a_count_that_is_none_is_refused(rig: LoopRig, slot: int, count: int) -> None:
    rig.hold()
    rig.observer.write_plan(rows(WIDEST))
    assert isinstance(rig.send(SetLimits(slot, count)).refusal, refusals.WrongRowCount)
    assert in_force(rig) == WIDEST


def standing_arm() -> Arm:
    """The arm of the default configuration, at rest away from its boxes."""
    arm = Arm(load(default_config()), [], lambda slot: memoryview(b"").cast("d"))
    arm.state.commanded[:] = [0.3, -0.5, 1.2, 0.2, 0.7, -0.4]
    arm.trajectory_guard.latch(arm.state)
    return arm


@pytest.mark.parametrize("name", ["user", "chair"])
def test_a_keep_out_box_that_the_arm_stands_in_is_refused(name: str) -> None:
    arm = standing_arm()
    which = [box.name for box in load(default_config()).cartesian.keep_out].index(name)
    # The box alone grows over the tool, to beyond the other side of the base of the arm and no further.
    tool, boxes = arm.trajectory_guard.poses[6].position, list(arm.limits.widest.keep_out)
    low, high = boxes[which][:3], boxes[which][3:]
    grown = [min(a, b - 0.05) for a, b in zip(low, tool, strict=True)]
    grown += [max(a, b + 0.05) for a, b in zip(high, tool, strict=True)]
    boxes[which] = tuple(grown)  # type: ignore[assignment]
    new = replace(arm.limits.widest, keep_out=tuple(boxes))
    assert arm.trajectory_guard.refusal_of(arm.state, new) == refusals.LimitsExcludeArm(which)


def leaned_on(rig: LoopRig) -> LoopRig:
    """Somebody leans on the first joint: its drive holds 5 Nm."""
    rig.hold()
    rig.models[0].mechanics.external_torque = 5.0
    rig.run(0.5)
    assert abs(rig.arm.state.actual_torque[0]) == pytest.approx(5.0, abs=WIDEST.torque[0] * 0.05)
    return rig


@pytest.fixture
def loaded(rig: LoopRig) -> LoopRig:
    return leaned_on(rig)


def test_less_torque_than_a_joint_holds_is_refused_and_nothing_changes(loaded: LoopRig) -> None:
    torque = abs(loaded.arm.state.actual_torque[0])
    assert send_limits(loaded, of_first("torque", 2.0)).refusal == refusals.TorqueLimitTooLow(0, torque, 2.0)
    assert in_force(loaded) == WIDEST
    assert LimitsChanged not in loaded.kinds


def test_a_threshold_below_what_is_measured_is_refused_and_nothing_changes(rig: LoopRig) -> None:
    rig.hold(CST)
    rig.models[0].mechanics.external_torque = 5.0
    rig.run(0.1)
    error = abs(rig.arm.samples.actual[0] - rig.arm.samples.commanded[0])
    assert error > 1e-3
    lower = replace(WIDEST, supervision=(*WIDEST.supervision[:2], 1e-3))
    refusal = send_limits(rig, lower).refusal
    assert isinstance(refusal, refusals.ThresholdTooLow)
    assert (refusal.axis, refusal.quantity, refusal.limit) == (0, 2, 1e-3)
    assert in_force(rig) == WIDEST


def test_less_torque_that_is_still_more_than_a_joint_holds_is_taken(loaded: LoopRig) -> None:
    new = of_first("torque", 10.0)
    assert send_limits(loaded, new).refusal is None
    assert in_force(loaded) == new


def test_a_torque_that_is_not_lowered_is_no_matter_whatever_is_held(new_rig: Callable[..., LoopRig]) -> None:
    config = replace(CONFIG, supervision=replace(CONFIG.supervision, torque=1.5))
    loaded, lower = leaned_on(new_rig(config)), of_first("torque", 10.0)
    lower = replace(lower, supervision=Values.configured(config).supervision)
    assert send_limits(loaded, lower).refusal is None
    loaded.models[0].mechanics.external_torque = 12.0
    loaded.run(0.3)
    assert abs(loaded.arm.state.actual_torque[0]) > 10.0
    assert send_limits(loaded, replace(lower, velocity=(0.2, 0.2))).refusal is None


@pytest.mark.parametrize("axis", [0, 1])
def test_a_joint_that_is_pushed_beyond_its_torque_limit_ends_in_pre_op_by_its_torque(rig: LoopRig, axis: int) -> None:
    rig.hold()
    # Almost all that the drive gives: the joint stands still.
    rig.models[axis].mechanics.external_torque = 49.9 - rig.arm.state.actual_torque[axis]
    rig.bring_to(State.EMERGENCY_STOP)
    (torque,) = [record.event for record in rig.events if isinstance(record.event, OverTorque)]
    assert torque.axis == axis
    assert WIDEST.torque[axis] < abs(torque.value) <= 50.0
    assert not {OverSpeed, FollowingError} & set(rig.kinds)


def test_without_torque_any_torque_limit_is_taken(loaded: LoopRig) -> None:
    loaded.do(Disable())
    loaded.bring_to(State.READY)
    # A drive without torque may show any value.
    loaded.arm.state.actual_torque[0] = 5.0
    new = of_first("torque", 2.0)
    assert send_limits(loaded, new).refusal is None
    assert in_force(loaded) == new
