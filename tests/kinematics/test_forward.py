"""Forward kinematics, of one configuration and of many, against data sheets and products of matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf, nan, pi
from typing import Any

import numpy as np
import pytest

from kinematics.damped_least_squares import solve_numeric
from kinematics.forward import forward, forward_batch, frames, twist_batch
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import jacobian, joint_velocity
from kinematics.model import ArmModel
from kinematics.pose import IDENTITY, Pose, rpy_batch
from tests.kinematics.arms import Change, chain, matrix, random_configurations, with_general_rows, with_tool


@pytest.mark.parametrize("change", [replace, with_tool, with_general_rows])
def test_forward_forward_batch_and_frames_agree_with_the_product_of_matrices(change: Change, either: ArmModel) -> None:
    model = change(either)
    q = random_configurations(model, 300)
    expected = chain(model, q)
    positions, rotations = forward_batch(model, q)
    assert positions == pytest.approx(expected[:, :3, 3], abs=1e-14)
    assert rotations == pytest.approx(expected[:, :3, :3], abs=1e-14)
    for row, pose in zip(q.tolist(), expected, strict=True):
        assert matrix(forward(model, row)) == pytest.approx(pose, abs=1e-14)
        assert frames(model, row)[6] == forward(model, row)


def test_frames_are_the_products_up_to_each_joint(either: ArmModel) -> None:
    q = random_configurations(either, 1)[0].tolist()
    expected = IDENTITY
    for row, angle, frame in zip(either.rows, q, frames(either, q)[:6], strict=True):
        link = Pose.from_xyzrpy(row.a, 0.0, 0.0, row.alpha, 0.0, 0.0)
        expected = expected @ link @ Pose.from_xyzrpy(0.0, 0.0, row.d, 0.0, 0.0, angle + row.offset)
        assert matrix(frame) == pytest.approx(matrix(expected), abs=1e-14)


@pytest.mark.parametrize("function", [forward, frames])
@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_an_angle_that_is_not_finite_is_refused_with_its_joint(
    function: Callable[[ArmModel, list[float]], object], joint: int, value: float, assistive: ArmModel
) -> None:
    q = [0.0] * 6
    q[joint] = value
    with pytest.raises(ValueError, match=f"^joint{joint + 1} is {value}"):
        function(assistive, q)


@pytest.mark.parametrize("count", [0, 5, 7])
def test_a_wrong_count_of_angles_is_refused(count: int, assistive: ArmModel) -> None:
    with pytest.raises(ValueError, match=f"^{count} joint angles"):
        forward(assistive, [0.0] * count)


def test_a_pose_consists_of_plain_floats(irb120: ArmModel) -> None:
    pose = forward(irb120, (0, 0, 0, 0, 0, 0))
    assert {type(number) for number in (*pose.position, *pose.rotation)} == {float}


@pytest.mark.parametrize("count", [0, 1, 2047, 2048, 2049, 5000])
def test_a_batch_of_any_size_is_complete(count: int, irb120: ArmModel) -> None:
    q = random_configurations(irb120, count)
    positions, rotations = forward_batch(irb120, q)
    assert positions.shape == (count, 3)
    assert rotations.shape == (count, 3, 3)
    for index in {0, count // 2, count - 1} if count else ():
        pose = forward(irb120, q[index].tolist())
        assert positions[index] == pytest.approx(pose.position, abs=1e-13)
        assert rotations[index].ravel() == pytest.approx(pose.rotation, abs=1e-13)


def test_a_batch_may_be_a_list_or_an_array_of_any_layout_and_is_not_changed(assistive: ArmModel) -> None:
    q = random_configurations(assistive, 100)
    expected, kept = forward_batch(assistive, q)[0], q.copy()
    for given in (q.tolist(), np.asfortranarray(q), np.repeat(q, 2, axis=0)[::2]):
        assert np.array_equal(forward_batch(assistive, given)[0], expected)
    assert np.array_equal(q, kept)


@pytest.mark.parametrize("shape", [(6,), (4, 5), (6, 4), (2, 3, 6)])
def test_a_batch_of_another_shape_is_refused_with_the_shape(shape: tuple[int, ...], assistive: ArmModel) -> None:
    with pytest.raises(ValueError, match=str(shape).replace("(", r"\(").replace(")", r"\)")):
        forward_batch(assistive, np.zeros(shape))


@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_a_value_of_a_batch_that_is_not_finite_is_refused_with_its_place(value: float, assistive: ArmModel) -> None:
    q = random_configurations(assistive, 3000)
    q[2500, 4] = value
    with pytest.raises(ValueError, match=rf"q\[2500, 4\] is {value}"):
        forward_batch(assistive, q)


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64])
def test_angles_in_an_array_of_any_type_are_as_those_in_a_list(assistive: ArmModel, kind: type[np.number[Any]]) -> None:
    q, pose = np.array([1, 0, 1, -1, 1, 0], kind), forward(assistive, [1.0, 0.1, 1.0, -1.0, 1.0, 0.0])
    plain = [float(angle) for angle in q]
    inverse = InverseKinematics(assistive)
    functions: tuple[Callable[[Any], object], ...] = (
        lambda angles: forward(assistive, angles),
        lambda angles: frames(assistive, angles),
        lambda angles: jacobian(assistive, angles),
        lambda angles: joint_velocity(assistive, angles, angles),
        lambda angles: inverse.solve(pose, angles),
        lambda angles: inverse.solve_near(pose, angles),
        lambda angles: solve_numeric(assistive, pose, angles),
    )
    for function in functions:
        assert function(q) == function(plain)


@pytest.mark.parametrize("change", [replace, with_tool, with_general_rows])
def test_twist_batch_agrees_with_the_jacobian(change: Change, either: ArmModel) -> None:
    model = change(either)
    q, velocity = random_configurations(model, 300), np.random.default_rng(4).normal(0.0, 1.0, (300, 6))
    expected = [np.array(jacobian(model, row)) @ rates for row, rates in zip(q.tolist(), velocity, strict=True)]
    assert twist_batch(model, q, velocity) == pytest.approx(np.array(expected), abs=1e-13)


def test_a_velocity_that_is_not_finite_is_named_with_its_place(either: ArmModel) -> None:
    velocity = np.zeros((2, 6))
    velocity[1, 3] = nan
    with pytest.raises(ValueError, match=r"velocity\[1, 3\] is nan; a finite number is required"):
        twist_batch(either, np.zeros((2, 6)), velocity)


def test_rpy_batch_agrees_with_the_angles_of_each_pose_also_where_ry_is_a_right_angle(either: ArmModel) -> None:
    q = random_configurations(either, 300)
    poses = [forward(either, row) for row in q.tolist()]
    poses += [Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.3, sign * pi / 2, 0.4) for sign in (1, -1)]
    rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
    assert rpy_batch(rotations) == pytest.approx(np.array([pose.rpy for pose in poses]), abs=1e-12)
