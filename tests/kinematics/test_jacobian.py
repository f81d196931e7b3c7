"""The geometric Jacobian, and the distances from the singularities."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.jacobian import (
    characteristic_length,
    jacobian,
    manipulability,
    scaled_rows,
    singularity_distances,
)
from kinematics.model import ArmModel, DhRow
from kinematics.pose import Pose
from kinematics.spherical import has_spherical_wrist

TOOL = Pose.from_xyzrpy(0.03, -0.02, 0.11, 0.4, -1.2, 2.1)


def with_tool(model: ArmModel) -> ArmModel:
    return replace(model, tool=TOOL)


def with_lateral_offset(model: ArmModel) -> ArmModel:
    """As a PUMA: the arm's plane passes beside axis 1."""
    rows = list(model.rows)
    rows[2] = replace(rows[2], d=0.12)
    return replace(model, rows=tuple(rows))


def with_skewed_forearm(model: ArmModel) -> ArmModel:
    """Upper arm and forearm both have a part along axis 2, which turns with neither."""
    rows = list(with_lateral_offset(model).rows)
    rows[3] = replace(rows[3], alpha=-1.2)
    return replace(model, rows=tuple(rows))


def without_spherical_wrist(model: ArmModel) -> ArmModel:
    rows = list(model.rows)
    rows[4] = replace(rows[4], d=0.09)
    return replace(model, rows=tuple(rows))


def configurations(model: ArmModel, count: int, seed: int = 1) -> list[list[float]]:
    numbers = random.Random(seed)
    return [[numbers.uniform(limit.lower, limit.upper) for limit in model.limits] for _ in range(count)]


@pytest.mark.parametrize("change", [with_tool, with_lateral_offset, without_spherical_wrist])
@pytest.mark.parametrize("arm", ["assistive", "irb120"])
def test_the_jacobian_is_the_derivative_of_the_tool_pose(arm, change, request):
    model = change(request.getfixturevalue(arm))
    step = 1e-6
    for q in configurations(model, 20):
        columns = np.array(jacobian(model, q)).T
        for joint in range(6):
            before, after = list(q), list(q)
            before[joint] -= step
            after[joint] += step
            a, b = forward(model, before), forward(model, after)
            linear = np.subtract(b.position, a.position) / (2 * step)
            turn = np.reshape(b.rotation, (3, 3)) @ np.reshape(a.rotation, (3, 3)).T / (2 * step)
            angular = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
            assert columns[joint] == pytest.approx([*linear, *np.divide(angular, 2)], abs=1e-8)


def test_the_rows_are_plain_floats(assistive):
    rows = jacobian(assistive, [0.1] * 6)
    assert [len(row) for row in rows] == [6] * 6
    assert {type(value) for row in rows for value in row} == {float}


@pytest.mark.parametrize("arm", ["assistive", "irb120"])
def test_manipulability_is_the_root_of_the_determinant_of_j_j_transposed(arm, request):
    model = request.getfixturevalue(arm)
    for q in configurations(model, 50):
        j = np.array(jacobian(model, q))
        # The root loses half the digits.
        assert manipulability(model, q) == pytest.approx(math.sqrt(max(0.0, np.linalg.det(j @ j.T))), abs=1e-8)


@pytest.mark.parametrize(
    ("arm", "change", "upper", "fore"),
    [
        ("assistive", with_tool, 0.440, 0.550),
        ("assistive", with_lateral_offset, 0.440, 0.550),
        ("assistive", with_skewed_forearm, 0.440, 0.550 * math.sin(1.2)),
        ("irb120", with_tool, 0.270, math.hypot(0.070, 0.302)),
        ("irb120", with_lateral_offset, 0.270, math.hypot(0.070, 0.302)),
    ],
)
def test_the_three_distances_are_the_factors_of_the_determinant(arm, change, upper, fore, request):
    model = change(request.getfixturevalue(arm))
    for q in configurations(model, 100):
        shoulder, elbow, wrist, _ = singularity_distances(model, q)
        expected = upper * fore * shoulder * math.sin(elbow) * math.sin(wrist)
        assert manipulability(model, q) == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_the_wrist_distance_is_the_angle_of_joint_5(assistive):
    for angle in (0.0, 1e-12, -1e-6, 0.3, -1.2, 1.5):
        distances = singularity_distances(assistive, [0.3, -0.4, 1.1, 0.4, angle, 0.2])
        assert distances.wrist == pytest.approx(abs(angle), rel=1e-9, abs=1e-15)


def test_the_elbow_distance_is_the_angle_from_stretched(assistive):
    for angle in (0.0, 1e-12, -1e-6, 0.3, -1.2, 1.5):
        distances = singularity_distances(assistive, [0.3, -0.4, angle, 0.4, 0.8, 0.2])
        assert distances.elbow == pytest.approx(abs(angle), rel=1e-3, abs=1e-15)


def test_the_elbow_distance_is_zero_where_an_offset_elbow_is_stretched_or_folded(irb120):
    stretched = -math.atan2(0.302, 0.070)  # the forearm's line to the wrist centre turned into that of the upper arm
    for angle in (stretched, stretched + math.pi):
        q = [0.3, -0.4, angle, 0.4, 0.8, 0.2]
        assert singularity_distances(irb120, q).elbow == pytest.approx(0.0, abs=1e-15)
        assert manipulability(irb120, q) == pytest.approx(0.0, abs=1e-17)


def test_the_shoulder_distance_is_that_of_the_wrist_centre_from_axis_1(irb120):
    for q in configurations(irb120, 50):
        x, y, _ = frames(irb120, q)[4].position
        assert singularity_distances(irb120, q).shoulder == pytest.approx(math.hypot(x, y), abs=1e-14)


def test_the_shoulder_distance_is_zero_with_the_wrist_centre_over_axis_1(assistive):
    bend = 1.3
    lean = math.atan2(0.550 * math.sin(bend), 0.440 + 0.550 * math.cos(bend))
    q = [0.7, lean, bend, 0.4, 0.8, 0.2]
    assert singularity_distances(assistive, q).shoulder == pytest.approx(0.0, abs=1e-15)
    q[1] += 1e-6
    height = frames(assistive, q)[4].position[2] - 0.170
    assert singularity_distances(assistive, q).shoulder == pytest.approx(1e-6 * height, rel=1e-6)


def test_all_distances_are_zero_straight_up(assistive):
    assert singularity_distances(assistive, [0.0] * 6) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-15)


@pytest.mark.parametrize("change", [with_tool, without_spherical_wrist])
def test_the_smallest_singular_value_is_numpys(change, irb120):
    model = change(irb120)
    for q in [*configurations(model, 50), [0.0] * 6]:
        scaled = np.array(scaled_rows(jacobian(model, q), 1.0 / characteristic_length(model)))
        smallest = np.linalg.svd(scaled, compute_uv=False)[-1]
        assert singularity_distances(model, q).smallest == pytest.approx(smallest, abs=1e-14)


def test_an_arm_without_a_spherical_wrist_has_only_the_smallest_singular_value(irb120):
    model = without_spherical_wrist(irb120)
    assert has_spherical_wrist(irb120)
    assert not has_spherical_wrist(model)
    assert singularity_distances(model, [0.2] * 6)[:3] == (None, None, None)


def test_an_arm_whose_axes_2_and_3_are_not_parallel_has_only_the_wrist_distance(irb120):
    rows = list(irb120.rows)
    rows[2] = DhRow(math.pi / 2, 0.270, 0.0)
    shoulder, elbow, wrist, _ = singularity_distances(replace(irb120, rows=tuple(rows)), [0.2] * 6)
    assert (shoulder, elbow) == (None, None)
    assert wrist == pytest.approx(0.2)


def test_the_characteristic_length_is_half_the_reach_from_axis_2(assistive):
    assert characteristic_length(assistive) == pytest.approx((0.440 + 0.550 + 0.140) / 2)


def test_an_angle_that_is_not_finite_is_named(assistive):
    q = [0.0] * 6
    q[3] = math.nan
    for function in (jacobian, manipulability, singularity_distances):
        with pytest.raises(ValueError, match="joint4"):
            function(assistive, q)
