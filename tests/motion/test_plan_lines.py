"""Plans of straight lines: refused with the place on the line, slowed down for the joints, carried out as planned."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from kinematics import forward
from rtcp.config.model import ArmConfig, Stop
from rtcp.motion.controllers.line import LineController
from rtcp.motion.limits import Limits
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.plan import KIND, LINE, Plan, PlanRefused

from .conftest import Drive, memory

PERIOD = 0.0005
Q = (0.0, 0.3, 1.2, 0.0, 0.8, 0.0)
Moved = Callable[..., Stop]
Planned = Callable[..., Plan]


@pytest.fixture
def plan(arm: ArmConfig, drive: Drive) -> Planned:
    return lambda stops, q=Q, **given: plan_lines(arm.arm, drive.limits, arm.cartesian, q, stops, **given)


@pytest.fixture
def moved(arm: ArmConfig) -> Moved:
    """The pose at Q, moved and turned."""
    at = forward(arm.arm, Q)
    return lambda *by, speed=None: Stop(
        tuple(a + b for a, b in zip((*at.position, *at.rpy), (*by, *(0.0,) * (6 - len(by))), strict=True)), None, speed
    )


def refusal(plan: Planned, stops: list[Stop], **given: Any) -> str:
    with pytest.raises(PlanRefused) as refused:
        plan(stops, **given)
    return str(refused.value)


def test_a_path_without_poses_is_refused(plan: Planned) -> None:
    assert refusal(plan, []) == "the path has no poses, at least one is needed"


def test_a_path_of_too_many_poses_is_refused(plan: Planned, moved: Moved) -> None:
    assert refusal(plan, [moved()] * 4097) == "the path has 4097 poses, at most 4096 are allowed"


@pytest.mark.parametrize(
    ("stop", "sentence"),
    [
        (Stop(None, None), "the line: either a pose or joint positions are needed"),
        (Stop((0.0,) * 6, (0.0,) * 6), "the line: either a pose or joint positions are needed"),
        (Stop((0.0,) * 5), "the line: found 5 numbers, 6 are needed"),
        (Stop((0.0, math.nan, 0.0, 0.0, 0.0, 0.0)), "the line: found nan in its end, numbers are needed"),
    ],
)
def test_a_stop_that_is_none_is_refused(plan: Planned, stop: Stop, sentence: str) -> None:
    assert refusal(plan, [stop]) == sentence


@pytest.mark.parametrize("speed", [0.3, 0.0, -0.1, math.nan])
def test_a_speed_that_is_not_allowed_is_refused(plan: Planned, moved: Moved, speed: float) -> None:
    allowed = f"found a speed of {speed:g} m/s, allowed is more than 0 and at most 0.25 m/s (cartesian.speed)"
    assert refusal(plan, [moved(0.0, 0.1), moved(0.0, 0.2, speed=speed)]) == f"the line to pose 2: {allowed}"
    assert refusal(plan, [moved(0.0, 0.1)], speed=speed) == f"the line: {allowed}"


def test_a_path_to_where_the_tool_is_already_is_refused(plan: Planned, moved: Moved) -> None:
    assert refusal(plan, [moved()]) == "the tool is already where the path leads, there is nothing to move"


def place(sentence: str, of_m: float) -> tuple[float, str]:
    """The distance along the line in a message, m, and the problem there."""
    where, problem = sentence.split(": ", 1)
    line, along = where.rsplit(" at ", 1)
    assert line == "the line"
    at, _, of = along.partition(" m of ")
    assert float(of.removesuffix(" m")) == pytest.approx(of_m, abs=1e-3)
    return float(at), problem


def test_a_line_out_of_reach_is_refused_with_where_it_ends(arm: ArmConfig, plan: Planned, moved: Moved) -> None:
    # 2 m up is out of reach.
    free = replace(arm.cartesian, singularity=replace(arm.cartesian.singularity, shoulder=0.0, elbow=0.0, wrist=0.0))
    sentence = refusal(lambda stops: plan_lines(arm.arm, Limits(arm), free, Q, stops), [moved(0.0, 0.0, 2.0)])
    at, problem = place(sentence, 2.0)
    assert 0.0 < at < 1.2
    assert "reach" in problem or "jump" in problem


def test_a_line_that_comes_too_near_to_a_singularity_is_refused(plan: Planned) -> None:
    # Joint 5 passes 0 on the line.
    sentence = refusal(plan, [Stop(None, (*Q[:4], -0.5, Q[5]))])
    place, reason = sentence.split(": ", 1)
    at, _, of = place.removeprefix("the line at ").partition(" m of ")
    assert 0.0 < float(at) < float(of.removesuffix(" m"))
    assert reason.startswith("the wrist is 0.07")
    assert reason.endswith(" rad from its singularity, allowed is at least 0.08 rad (cartesian.singularity.wrist)")


def test_a_line_beyond_a_limit_that_was_narrowed_is_refused(drive: Drive, plan: Planned, moved: Moved) -> None:
    drive.limits.low[0], drive.limits.high[0] = -0.1, 0.1
    at, problem = place(refusal(plan, [moved(0.0, 0.2)]), 0.2)
    assert 0.02 < at < 0.2
    assert problem.startswith("joint1 would be at ")
    assert problem.endswith("allowed is -0.1 to 0.1 rad")


def test_a_line_through_a_box_is_refused(arm: ArmConfig, plan: Planned, moved: Moved) -> None:
    y = forward(arm.arm, Q).position[1]

    def zone_at(q: Sequence[float]) -> str | None:
        return "the keep-out box cup" if forward(arm.arm, q).position[1] > y + 0.05 else None

    assert refusal(plan, [moved(0.0, 0.2)], zone_at=zone_at) == (
        "the line at 0.052 m of 0.200 m: the arm would be in the keep-out box cup"
    )


def test_a_turn_on_the_spot_is_refused_with_the_angle(arm: ArmConfig, plan: Planned, moved: Moved) -> None:
    sentence = refusal(plan, [moved(0.0, 0.0, 0.0, 0.3)], zone_at=lambda q: "the box" if q != Q else None)
    assert sentence == "the line at 0.000 rad of 0.300 rad: the arm would be in the box"


def test_joints_of_another_branch_are_refused(arm: ArmConfig, plan: Planned) -> None:
    # The wrist's other branch of a pose beside: joint 4 half a turn on, joint 5 mirrored.
    beside = (0.2, 0.3, 1.2, 0.0, 0.8, 0.0)
    flipped = (0.2, 0.3, 1.2, math.pi - 0.1, -0.8, math.pi - 0.1)
    assert plan([Stop(None, beside)]).end == pytest.approx(beside, abs=1e-6)
    sentence = refusal(plan, [Stop(None, flipped)])
    assert sentence.startswith("the line")
    assert "a straight line does not change the branch; move there by the joints" in sentence or "jump" in sentence


def test_rows_carry_length_speed_and_how_long_all_takes(arm: ArmConfig, plan: Planned, moved: Moved) -> None:
    made = plan([moved(0.0, 0.1, speed=0.05), moved(0.0, 0.1), moved(0.0, 0.1, 0.05)])
    assert len(made.rows) == 2
    first, second = made.rows
    assert (first[17], second[17], first[KIND]) == pytest.approx((0.1, 0.05, LINE))
    assert first[14] == pytest.approx(0.05 / 0.1)
    assert made.length_m == pytest.approx(0.15)
    assert made.duration_s == first[18] > second[18] > 0.0
    assert forward(arm.arm, made.end).position == pytest.approx(moved(0.0, 0.1, 0.05).pose[:3], abs=1e-9)


def test_a_line_is_slowed_down_until_the_joints_keep_their_limits(
    arm: ArmConfig, new_drive: Callable[..., Drive], moved: Moved
) -> None:
    drive = new_drive().at(Q)
    drive.limits.velocity[:] = [0.15] * 6
    made = plan_lines(arm.arm, drive.limits, arm.cartesian, Q, [moved(0.0, 0.2), moved()], speed=0.25)
    assert 0.1 < made.slowed < 0.9
    assert made.rows[0][14] <= made.slowed * 0.25 / 0.2 * 1.0001
    mode = drive.controller(LineController)
    assert drive.execute(mode, memory(made.rows), len(made.rows)) is None
    # The drive checks speed and acceleration of each joint in every cycle.
    assert drive.until_rest(mode) == pytest.approx(made.duration_s, abs=0.01)
    assert mode.ended is None
    assert drive.state.commanded == pytest.approx(made.end, abs=1e-9)
    fastest = max(max(abs(b - a) for a, b in zip(p, q, strict=True)) for p, q in pairwise(drive.path)) / PERIOD
    # The plan is no slower than the limits demand.
    assert fastest > 0.8 * 0.15


def test_a_line_is_accelerated_so_gently_that_the_joints_keep_their_limits(
    arm: ArmConfig, new_drive: Callable[..., Drive], moved: Moved
) -> None:
    drive = new_drive().at(Q)
    drive.limits.acceleration[:] = [0.3] * 6
    made = plan_lines(arm.arm, drive.limits, arm.cartesian, Q, [moved(0.0, 0.1)], speed=0.1)
    mode = drive.controller(LineController)
    assert drive.execute(mode, memory(made.rows), 1) is None
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(made.end, abs=1e-9)


def test_a_line_that_no_joint_hinders_keeps_its_speed(plan: Planned, moved: Moved) -> None:
    assert plan([moved(0.0, 0.0, -0.1)], speed=0.02).slowed == 1.0


@pytest.mark.parametrize("length", [0.001, 0.01, 0.02])
def test_a_line_whose_acceleration_is_only_just_reached_is_travelled(
    arm: ArmConfig, new_drive: Callable[..., Drive], moved: Moved, length: float
) -> None:
    """0.5 m/s^2 and 5 m/s^3 are both reached on 10 mm exactly, where ruckig finds no profile."""
    drive = new_drive().at(Q)
    made = plan_lines(arm.arm, drive.limits, arm.cartesian, Q, [moved(0.0, 0.0, -length)])
    mode = drive.controller(LineController)
    assert drive.execute(mode, memory(made.rows), 1) is None
    assert drive.until_rest(mode) == pytest.approx(made.duration_s, abs=0.01)
    assert drive.state.commanded == pytest.approx(made.end, abs=1e-6)
