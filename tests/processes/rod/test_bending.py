"""A bend as one motion in step of the shipped cell."""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest

from kinematics import Pose, forward
from kinematics.pose import rotation_from_rpy
from rtcp.config.cell import CellConfig
from rtcp.config.cell_file import load_cell
from rtcp.config.find import default_config
from rtcp.config.model import KeepOut
from rtcp.ipc.errors import Invalid, Refused
from rtcp.processes import rod
from rtcp.processes.rod.bending import _check_between, _check_curves, _Holder, plan_approach


def roomy_cell() -> CellConfig:
    """Return the shipped cell with 1.2 m between the arms: at 0.914 m they bend a rod to one side only."""
    shipped = default_config().parent / "cell_shape_setting.yaml"
    text = re.sub(r"config: (\w)", rf"config: {shipped.parent}/\1", shipped.read_text())
    assert text.count("0.457, 0]") == 2
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cell.yaml"
        file.write_text(text.replace("0.457, 0]", "0.6, 0]"))
        return load_cell(file)


CELL = roomy_cell()
ROD = rod.Rod(0.3, 1e-3)
CHUCK = rod.Chuck(Pose.from_xyzrpy(0.0, 0.0, 0.12, 0.0, -pi / 2, 0.0), 0.02)
CHUCKS = {"left": CHUCK, "right": CHUCK}
HELD = Pose.from_xyzrpy(0.0, 0.0, 0.4, 0.0, 0.0, -pi / 2)
NEAR = {"left": (0.0, 0.0, 0.8, 0.0, -0.77, 0.0), "right": (0.0, 0.0, 0.8, 0.0, -0.77, 0.0)}
END = Pose((0.25, 0.05, 0.06), rotation_from_rpy(0.3, -0.3, 0.4))
LONG = rod.Chuck(Pose.from_xyzrpy(0.0, 0.0, 0.25, 0.0, -pi / 2, 0.0), 0.02)
SHORT_END = Pose((0.25 / 3.0, 0.05 / 3.0, 0.02), END.rotation)


def planned(end: Pose = END, cell: CellConfig = CELL, held: Pose = HELD, chuck: rod.Chuck = CHUCK) -> rod.BendingPlan:
    return rod.plan_bending(cell, {"left": chuck, "right": chuck}, ROD, end, held, NEAR)


@pytest.fixture(scope="module")
def plan() -> rod.BendingPlan:
    return planned()


def mouth(name: str, q: tuple[float, ...]) -> Pose:
    member = CELL.member(name)
    assert member.config.arm is not None
    return Pose.from_xyzrpy(*member.base.position, *member.base.rpy) @ forward(member.config.arm, q) @ CHUCK.pose


def test_it_begins_with_the_straight_rod_at_rest_and_ends_with_the_wanted_end_pose_at_rest(
    plan: rod.BendingPlan,
) -> None:
    for number, wanted in ((0, Pose((0.3, 0.0, 0.0), rotation_from_rpy(0.0, 0.0, 0.0))), (-1, END)):
        ends = {name: mouth(name, points[number].q) for name, points in plan.arms.items()}
        relative = ends["left"].inverse() @ ends["right"] @ Pose((0, 0, 0), rotation_from_rpy(0.0, 0.0, pi))
        assert relative.position == pytest.approx(wanted.position, abs=1e-8)
        assert relative.rotation == pytest.approx(wanted.rotation, abs=1e-8)
        assert not any(value for points in plan.arms.values() for value in (*points[number].v, *points[number].a))


def test_the_chucks_hold_the_ends_of_the_curve_at_each_step(plan: rod.BendingPlan) -> None:
    times = {name: [point.t for point in points] for name, points in plan.arms.items()}
    for name, node in (("left", 0), ("right", -1)):
        joints = np.array([point.q for point in plan.arms[name]])
        for t, curve in zip(plan.times, plan.curves, strict=True):
            q = tuple(float(np.interp(t, times[name], column)) for column in joints.T)
            assert np.linalg.norm(np.array(mouth(name, q).position) - curve[node]) < 1e-3


def test_the_middle_of_the_rod_stays_where_it_is_held(plan: rod.BendingPlan) -> None:
    assert np.abs(plan.curves[:, 30] - HELD.position).max() < 1e-12


def test_every_step_is_stable_and_the_rod_keeps_clear(plan: rod.BendingPlan) -> None:
    assert all(step.is_stable for step in plan.steps[1:])
    assert plan.clearance > CELL.clearance


def test_both_arms_have_the_same_times(plan: rod.BendingPlan) -> None:
    left, right = ([point.t for point in plan.arms[name]] for name in ("left", "right"))
    assert left == right
    assert left[0] == 0.0
    assert plan.duration_s == pytest.approx(left[-1])
    assert plan.begin == {name: points[0].q for name, points in plan.arms.items()}
    assert plan.trajectory["left"][1]["q"] == plan.arms["left"][1].q


def test_a_drawn_shape_is_planned_by_its_parameters() -> None:
    arcs = rod.pre_bend(ROD, (1.0, 0.0))
    wanted = rod.sample_equilibrium(ROD, rod.Form.ARC, np.random.default_rng(1))
    steps = (*arcs, *rod.follow_parameters(arcs[-1], wanted.a)[1:])
    plan = rod.plan_motion(CELL, CHUCKS, steps, HELD, NEAR)
    assert plan.steps[-1].a == pytest.approx(wanted.a)


def test_an_end_pose_at_which_the_rod_snaps_is_refused() -> None:
    with pytest.raises(Refused) as refused:
        planned(Pose((0.25, 0.08, 0.0), rotation_from_rpy(0.0, 0.0, 0.0)))
    assert refused.value.reason == "rod_unstable"


def test_a_rod_held_out_of_reach_is_refused_by_the_name_of_the_arm() -> None:
    with pytest.raises(Refused, match="left") as refused:
        planned(held=Pose.from_xyzrpy(0.0, -0.5, 0.4, 0.0, 0.0, -pi / 2))
    assert refused.value.reason == "arm_out_of_reach"
    assert refused.value.fields["arm"] == "left"


def test_a_rod_too_near_to_a_hand_is_refused() -> None:
    short = rod.Chuck(Pose.from_xyzrpy(0.0, 0.0, 0.06, 0.0, -pi / 2, 0.0), 0.02)
    with pytest.raises(Refused) as refused:
        planned(chuck=short)
    assert refused.value.reason == "rod_collision"
    assert refused.value.fields["s"] < 0.03


def test_chucks_that_would_come_nearer_than_the_clearance_are_refused() -> None:
    with pytest.raises(Refused, match="left and right") as refused:
        rod.plan_bending(
            replace(CELL, clearance=0.09), dict.fromkeys(NEAR, LONG), rod.Rod(0.1, 0.5e-3), SHORT_END, HELD, NEAR
        )
    assert refused.value.reason == "arms_too_near"


def test_a_step_at_which_an_arm_would_jump_is_refused() -> None:
    steps = rod.bend(ROD, END)
    with pytest.raises(Refused, match="jump") as refused:
        rod.plan_motion(CELL, CHUCKS, (steps[0], steps[-1]), HELD, NEAR)
    assert refused.value.reason == "arm_out_of_reach"


@pytest.mark.parametrize("number", [3, -1])
def test_an_unstable_step_is_refused(number: int) -> None:
    steps = list(rod.bend(ROD, END))
    jacobian = steps[number].jacobian.copy()
    jacobian[40:, 0] *= -1.0
    steps[number] = replace(steps[number], jacobian=jacobian)
    with pytest.raises(Refused) as refused:
        rod.plan_motion(CELL, CHUCKS, steps, HELD, NEAR)
    assert refused.value.reason == "rod_unstable"


def test_arms_that_leave_the_rod_no_equilibrium_between_two_steps_are_refused(plan: rod.BendingPlan) -> None:
    holders = {arm.name: _Holder(arm, CHUCK, CELL.clearance) for arm in CELL.arms}
    _check_between(holders, plan.arms, plan.steps, plan.times)
    pulled = [replace(point, q=(point.q[0], point.q[1] - 0.3, *point.q[2:])) for point in plan.arms["right"]]
    with pytest.raises(Refused) as refused:
        _check_between(holders, {**plan.arms, "right": tuple(pulled)}, plan.steps, plan.times)
    assert refused.value.reason == "rod_no_equilibrium"


def test_the_approach_is_a_straight_motion_of_all_joints_within_its_speed(plan: rod.BendingPlan) -> None:
    now = {name: tuple(q - 0.2 for q in begin) for name, begin in plan.begin.items()}
    approach = plan_approach(CELL, CHUCKS, now, plan.begin, 0.1)
    assert approach is not None
    for name, points in approach.items():
        assert points[0]["q"] == pytest.approx(now[name])
        assert points[-1]["q"] == pytest.approx(plan.begin[name])
        assert all(np.ptp(np.array(point["q"]) - now[name]) < 1e-9 for point in points)
        assert max(abs(v) for point in points for v in point["v"]) == pytest.approx(0.1, rel=0.02)
    assert plan_approach(CELL, CHUCKS, plan.begin, plan.begin, 0.1) is None


def test_an_approach_on_which_the_chucks_would_meet_is_refused_though_the_bare_arms_would_pass(
    plan: rod.BendingPlan,
) -> None:
    apart = {name: (q[0], q[1] - 0.3, *q[2:]) for name, q in plan.begin.items()}
    near = {name: (q[0], q[1] + 0.6, q[2] - 0.6, *q[3:]) for name, q in plan.begin.items()}
    bare = rod.Chuck(Pose.from_xyzrpy(0.0, 0.0, 0.03, 0.0, -pi / 2, 0.0), 0.02)
    assert plan_approach(CELL, dict.fromkeys(CHUCKS, bare), apart, near, 0.3) is not None
    with pytest.raises(Refused, match="left and right") as refused:
        plan_approach(CELL, CHUCKS, apart, near, 0.3)
    assert refused.value.reason == "arms_too_near"


def with_box(low: tuple[float, float, float], high: tuple[float, float, float]) -> CellConfig:
    """Return the cell with a keep-out box at the left arm, in the frame of its base."""
    arms = tuple(
        arm
        if arm.name != "left"
        else replace(
            arm,
            config=replace(
                arm.config, cartesian=replace(arm.config.cartesian, keep_out=(KeepOut("bench", low, high),))
            ),
        )
        for arm in CELL.arms
    )
    return replace(CELL, arms=arms)


@pytest.mark.parametrize(
    ("height", "words"), [(0.0, "the rod, .* from the keep-out box bench of left"), (-0.1, "chuck of left")]
)
def test_a_keep_out_box_at_the_rod_or_at_a_chuck_is_refused(plan: rod.BendingPlan, height: float, words: str) -> None:
    left = CELL.member("left").base
    back = Pose.from_xyzrpy(*left.position, *left.rpy).inverse()
    place = tuple(plan.curves[-1][30 if height == 0.0 else 0].tolist())
    x, y, z = (back @ Pose(place, rotation_from_rpy(0.0, 0.0, 0.0))).position
    z += height
    cell = with_box((x - 0.03, y - 0.03, z - 0.03), (x + 0.03, y + 0.03, z + 0.03))
    with pytest.raises(Refused, match=words):
        planned(cell=cell)


def test_a_rod_that_would_touch_itself_is_refused() -> None:
    angle = np.linspace(0.0, 2.2 * pi, 61)
    flat = np.stack([0.04 * np.cos(angle), 0.04 * np.sin(angle), np.zeros(61)], axis=1)
    with pytest.raises(Refused, match="touch itself") as refused:
        _check_curves(CELL, np.array([flat]), 1e-3)
    assert refused.value.reason == "rod_collision"
    flat[:, 2] = 0.002 * angle
    _check_curves(CELL, np.array([flat]), 1e-3)


def test_arms_that_the_cell_does_not_have_are_invalid() -> None:
    with pytest.raises(Invalid, match="left, right"):
        rod.plan_motion(CELL, {"left": CHUCK, "middle": CHUCK}, rod.bend(ROD, END), HELD, NEAR)
    with pytest.raises(Invalid):
        rod.plan_motion(CELL, {"left": CHUCK}, rod.bend(ROD, END), HELD, NEAR)


def test_near_has_a_number_for_each_joint() -> None:
    with pytest.raises(Invalid, match="near of left: found 1 numbers, allowed are 6"):
        rod.plan_motion(CELL, CHUCKS, rod.bend(ROD, END), HELD, {**NEAR, "left": (1.0,)})
