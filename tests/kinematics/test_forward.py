"""Forward kinematics, against the documents' poses and against matrices."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan, pi

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.model import DhRow
from kinematics.pose import IDENTITY, Pose

TOOL = Pose.from_xyzrpy(0.03, -0.02, 0.11, 0.4, -1.2, 2.1)


def matrix(pose: Pose) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = np.reshape(pose.rotation, (3, 3)), pose.position
    return result


def test_the_assistive_arm_points_straight_up_at_zero(assistive):
    pose = forward(assistive, [0.0] * 6)
    assert pose.position == pytest.approx((0.0, 0.0, 1.300), abs=1e-15)
    assert pose.rotation == pytest.approx(IDENTITY.rotation, abs=1e-15)


def test_the_assistive_arm_with_its_elbow_at_a_right_angle_is_where_its_document_says(assistive):
    assert forward(assistive, [0.0, 0.0, pi / 2, 0.0, 0.0, 0.0]).position == pytest.approx((-0.690, 0.0, 0.610))


def test_the_irb_120_is_where_its_data_sheet_says_at_zero(irb120):
    pose = forward(irb120, [0.0] * 6)
    assert pose.position == pytest.approx((0.374, 0.0, 0.630), abs=1e-15)
    assert matrix(pose)[:3, 2] == pytest.approx((1.0, 0.0, 0.0), abs=1e-15)  # the flange looks forward


@pytest.mark.parametrize(
    ("joint", "direction"),
    [(0, (0, 1, 0)), (1, (1, 0, -1)), (2, (1, 0, -1)), (4, (0, 0, -1))],
    ids=["joint 1 turns left", "joint 2 leans forward", "joint 3 lowers the forearm", "joint 5 lowers the flange"],
)
def test_the_axes_of_the_irb_120_turn_the_way_they_are_drawn(joint, direction, irb120):
    q = [0.0] * 6
    q[joint] = 1e-3
    moved = np.subtract(forward(irb120, q).position, forward(irb120, [0.0] * 6).position)
    assert np.sign(np.where(abs(moved) < 1e-6, 0.0, moved)).tolist() == list(direction)


@pytest.mark.parametrize("tool", [IDENTITY, TOOL], ids=["flange", "tool"])
def test_forward_agrees_with_the_product_of_matrices(tool, either, chain, random_configurations):
    model = replace(either, tool=tool)
    configurations = random_configurations(model, 300)
    for q, expected in zip(configurations, chain(model, configurations), strict=True):
        assert matrix(forward(model, q.tolist())) == pytest.approx(expected, abs=1e-14)


def test_forward_agrees_for_a_table_without_right_angles(assistive, chain, random_configurations):
    random = np.random.default_rng(4)
    model = replace(assistive, rows=tuple(DhRow(*random.uniform(-1.0, 1.0, 4)) for _ in range(6)), tool=TOOL)
    configurations = random_configurations(model, 100)
    for q, expected in zip(configurations, chain(model, configurations), strict=True):
        assert matrix(forward(model, q.tolist())) == pytest.approx(expected, abs=1e-14)


def test_frames_are_the_products_up_to_each_joint_and_the_tool(either, random_configurations):
    model = replace(either, tool=TOOL)
    q = random_configurations(model, 1)[0].tolist()
    expected = IDENTITY
    for row, angle, frame in zip(model.rows, q, frames(model, q)[:6], strict=True):
        turn = Pose.from_xyzrpy(row.a, 0.0, 0.0, row.alpha, 0.0, 0.0)
        expected = expected @ turn @ Pose.from_xyzrpy(0.0, 0.0, row.d, 0.0, 0.0, angle + row.offset)
        assert matrix(frame) == pytest.approx(matrix(expected), abs=1e-14)
    assert frames(model, q)[6] == forward(model, q)


@pytest.mark.parametrize("function", [forward, frames])
@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_an_angle_that_is_not_finite_is_refused_with_its_joint(function, joint, value, assistive):
    q = [0.0] * 6
    q[joint] = value
    with pytest.raises(ValueError, match=f"^joint{joint + 1} is {value}"):
        function(assistive, q)


@pytest.mark.parametrize("count", [0, 5, 7])
def test_another_count_of_angles_is_refused(count, assistive):
    with pytest.raises(ValueError, match=f"^{count} joint angles"):
        forward(assistive, [0.0] * count)


def test_the_pose_is_made_of_plain_floats(irb120):
    pose = forward(irb120, (0, 0, 0, 0, 0, 0))
    assert {type(number) for number in (*pose.position, *pose.rotation)} == {float}
