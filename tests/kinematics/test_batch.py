"""Forward kinematics of many configurations at once."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from kinematics.forward import forward, forward_batch
from kinematics.model import ArmModel, DhRow
from kinematics.pose import Pose


def with_tool(model: ArmModel) -> ArmModel:
    return replace(model, tool=Pose.from_xyzrpy(0.03, -0.02, 0.11, 0.4, -1.2, 2.1))


def with_general_rows(model: ArmModel) -> ArmModel:
    """No alpha is a quarter turn, and no length and no offset is zero."""
    numbers = random.Random(4)
    rows = tuple(DhRow(*(numbers.uniform(0.1, 1.4) for _ in range(4))) for _ in range(6))
    return replace(with_tool(model), rows=rows)


def unchanged(model: ArmModel) -> ArmModel:
    return model


def configurations(count: int) -> np.ndarray:
    return np.random.default_rng(5).uniform(-math.pi, math.pi, (count, 6))


@pytest.mark.parametrize("change", [unchanged, with_tool, with_general_rows])
@pytest.mark.parametrize("arm", ["assistive", "irb120"])
def test_every_pose_is_that_of_the_scalar_forward_kinematics(arm, change, request):
    model = change(request.getfixturevalue(arm))
    q = configurations(1000)
    positions, rotations = forward_batch(model, q)
    poses = [forward(model, row) for row in q.tolist()]
    assert positions == pytest.approx(np.array([pose.position for pose in poses]), abs=1e-13)
    assert rotations.reshape(-1, 9) == pytest.approx(np.array([pose.rotation for pose in poses]), abs=1e-13)


@pytest.mark.parametrize("count", [0, 1, 2047, 2048, 2049, 5000])
def test_any_number_of_poses_is_worked_on_whole(count, irb120):
    q = configurations(count)
    positions, rotations = forward_batch(irb120, q)
    assert positions.shape == (count, 3)
    assert rotations.shape == (count, 3, 3)
    for index in {0, count // 2, count - 1} if count else ():
        pose = forward(irb120, q[index].tolist())
        assert positions[index] == pytest.approx(pose.position, abs=1e-13)
        assert rotations[index].ravel() == pytest.approx(pose.rotation, abs=1e-13)


def test_lists_and_arrays_in_any_layout_are_taken_and_left_alone(assistive):
    q = configurations(100)
    expected = forward_batch(assistive, q)[0]
    kept = q.copy()
    assert np.array_equal(forward_batch(assistive, q.tolist())[0], expected)
    assert np.array_equal(forward_batch(assistive, np.asfortranarray(q))[0], expected)
    assert np.array_equal(forward_batch(assistive, np.repeat(q, 2, axis=0)[::2])[0], expected)
    assert np.array_equal(q, kept)


@pytest.mark.parametrize("shape", [(6,), (4, 5), (6, 4), (2, 3, 6)])
def test_another_shape_is_refused_with_the_shape(shape, assistive):
    with pytest.raises(ValueError, match=str(shape).replace("(", r"\(").replace(")", r"\)")):
        forward_batch(assistive, np.zeros(shape))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_not_finite_is_named_with_its_place(bad, assistive):
    q = configurations(3000)
    q[2500, 4] = bad
    with pytest.raises(ValueError, match=rf"q\[2500, 4\] is {bad}"):
        forward_batch(assistive, q)
