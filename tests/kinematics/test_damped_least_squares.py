"""Numeric inverse kinematics, and the nearest pose where there is none."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from kinematics.damped_least_squares import NumericResult, solve_numeric
from kinematics.forward import forward
from kinematics.jacobian import characteristic_length
from kinematics.model import ArmModel, DhRow, JointLimit
from kinematics.pose import IDENTITY, Pose, Rotation
from kinematics.spherical import has_spherical_wrist


@pytest.fixture(scope="module")
def ur5(ur5) -> ArmModel:
    """With the maker's limits, a turn each way."""
    return replace(ur5, limits=(JointLimit(-2 * math.pi, 2 * math.pi, math.pi),) * 6)


@pytest.fixture(scope="module")
def general(ur5) -> ArmModel:
    """No parallel axes, no axes that meet."""
    numbers = random.Random(11)
    rows = tuple(DhRow(numbers.uniform(0.4, 1.5), *(numbers.uniform(0.05, 0.4) for _ in range(3))) for _ in range(6))
    return replace(ur5, name="general", rows=rows)


def inside(model: ArmModel, q) -> bool:
    return all(limit.lower <= angle <= limit.upper for angle, limit in zip(q, model.limits, strict=True))


def random_configuration(model: ArmModel, numbers: random.Random) -> list[float]:
    return [numbers.uniform(limit.lower, limit.upper) for limit in model.limits]


def errors(model: ArmModel, pose: Pose, result: NumericResult) -> tuple[float, float]:
    """Position error in m and rotation error in rad, by another way than the solver's."""
    found = forward(model, result.q)
    turn = np.reshape(pose.rotation, (3, 3)).T @ np.reshape(found.rotation, (3, 3))
    chord = np.linalg.norm(turn - np.eye(3)) / math.sqrt(8.0)
    return math.dist(found.position, pose.position), 2.0 * math.asin(min(1.0, chord))


@pytest.mark.parametrize("arm", ["ur5", "general", "assistive", "irb120"])
def test_every_pose_that_the_arm_can_take_is_found_from_anywhere(arm, request):
    model = request.getfixturevalue(arm)
    numbers = random.Random(12)
    for _ in range(100):
        pose = forward(model, random_configuration(model, numbers))
        result = solve_numeric(model, pose, random_configuration(model, numbers))
        assert result.converged
        assert max(errors(model, pose, result)) < 1e-9
        assert inside(model, result.q)


def test_the_ur5_has_no_spherical_wrist(ur5):
    assert not has_spherical_wrist(ur5)


def test_from_nearby_the_solution_is_the_one_nearby(ur5):
    numbers = random.Random(13)
    for _ in range(50):
        q = [numbers.uniform(-2.0, 2.0) for _ in range(6)]
        q[2], q[4] = math.copysign(max(0.4, abs(q[2])), q[2]), math.copysign(max(0.4, abs(q[4])), q[4])
        near = [angle + numbers.uniform(-0.01, 0.01) for angle in q]
        assert solve_numeric(ur5, forward(ur5, q), near).q == pytest.approx(q, abs=1e-6)


def test_where_the_tool_already_is_nothing_is_changed(ur5):
    q = (0.3, -0.4, 1.1, 5.9, 0.8, -4.0)
    assert solve_numeric(ur5, forward(ur5, q), q) == (q, True, 0.0, pytest.approx(0.0, abs=1e-15), 0)


def test_the_joints_are_in_the_turn_nearest_to_where_they_were(ur5):
    q = [0.3, -0.4, 1.1, 0.4, 0.8, 0.2]
    near = [0.3 + 2 * math.pi, -0.4, 1.1 - 2 * math.pi, 0.4, 0.8 + 2 * math.pi, 0.2]
    # 0.8 + 2 pi is beyond the limit of 2 pi, and so is 0.3 + 2 pi; 1.1 - 2 pi is inside.
    assert solve_numeric(ur5, forward(ur5, q), near).q == pytest.approx([0.3, -0.4, near[2], 0.4, 0.8, 0.2], abs=1e-6)
    free = solve_numeric(ur5, forward(ur5, q), near, respect_limits=False)
    assert free.q == pytest.approx(near, abs=1e-6)


def test_without_limits_no_joint_is_half_a_turn_from_where_it_was(ur5):
    numbers = random.Random(17)
    for _ in range(50):
        near = random_configuration(ur5, numbers)
        result = solve_numeric(ur5, forward(ur5, random_configuration(ur5, numbers)), near, respect_limits=False)
        assert max(abs(angle - before) for angle, before in zip(result.q, near, strict=True)) <= math.pi + 1e-12


def test_a_pose_that_only_forbidden_angles_reach_is_reached_without_limits_only(assistive):
    narrow = replace(assistive, limits=(JointLimit(-0.5, 0.5),) * 6)
    pose = forward(assistive, [0.4, 1.2, 1.0, 0.3, -1.1, 0.2])
    result = solve_numeric(narrow, pose, [0.0] * 6)
    assert not result.converged
    assert inside(narrow, result.q)
    assert (result.position_error, result.rotation_error) == pytest.approx(errors(narrow, pose, result), abs=1e-9)
    assert solve_numeric(narrow, pose, [0.0] * 6, respect_limits=False).converged


def test_the_same_arguments_give_the_same_result(ur5):
    numbers = random.Random(14)
    for _ in range(5):
        pose = forward(ur5, random_configuration(ur5, numbers))
        far = Pose((3.0, 0.0, 0.0), pose.rotation)
        near = random_configuration(ur5, numbers)
        assert solve_numeric(ur5, pose, near) == solve_numeric(ur5, pose, near)
        assert solve_numeric(ur5, far, near) == solve_numeric(ur5, far, near)


@pytest.mark.parametrize("beyond", [1e-6, 1e-3, 0.1, 1.0])
def test_beyond_the_reach_the_arm_stretches_towards_the_pose(beyond, assistive):
    pose = Pose((0.0, 0.0, 1.300 + beyond), IDENTITY.rotation)
    result = solve_numeric(assistive, pose, [0.1, 0.2, 0.3, 0.1, 0.1, 0.1])
    assert not result.converged
    assert result.position_error == pytest.approx(beyond, abs=1e-8)
    assert result.rotation_error < 1e-4
    assert forward(assistive, result.q).position[2] == pytest.approx(1.300, abs=1e-6)


@pytest.mark.parametrize("arm", ["ur5", "irb120"])
def test_no_configuration_beside_the_result_is_nearer_to_a_pose_out_of_reach(arm, request):
    model = request.getfixturevalue(arm)
    numbers = random.Random(15)
    length = characteristic_length(model)

    def cost(q) -> float:
        found = errors(model, pose, NumericResult(tuple(q), False, 0.0, 0.0, 0))
        return (found[0] / length) ** 2 + found[1] ** 2

    for _ in range(3):
        there = forward(model, random_configuration(model, numbers))
        pose = Pose(
            tuple(value * 1.8 / math.dist(there.position, (0.0,) * 3) for value in there.position), there.rotation
        )
        result = solve_numeric(model, pose, [0.1] * 6)
        assert not result.converged
        least = cost(result.q)
        for size in (0.01, 0.1, 1.0):
            for _ in range(200):
                other = [angle + numbers.gauss(0.0, size) for angle in result.q]
                if inside(model, other):
                    assert cost(other) > least - 1e-5


def test_a_singular_pose_is_reached(assistive):
    result = solve_numeric(assistive, forward(assistive, [0.0] * 6), [0.5, -0.7, 1.3, 0.4, 0.9, 0.2])
    assert result.converged


@pytest.mark.parametrize("half_turn", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_half_a_turn_of_the_tool_is_an_error_of_pi(half_turn, assistive):
    fixed = replace(assistive, limits=(JointLimit(-1e-9, 1e-9),) * 6)
    x, y, z = half_turn
    rotation: Rotation = (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z)
    result = solve_numeric(fixed, Pose((0.0, 0.0, 1.300), rotation), [0.0] * 6)
    assert result.rotation_error == pytest.approx(math.pi, abs=1e-7)


@pytest.mark.parametrize("half_turn", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_a_pose_half_a_turn_away_is_reached(half_turn, ur5):
    q = [0.3, -1.4, 1.1, 0.4, 0.8, 0.2]
    here = forward(ur5, q)
    turned = np.reshape(here.rotation, (3, 3)) @ np.diag(half_turn)
    pose = Pose((0.35, 0.2, 0.3), tuple(turned.ravel().tolist()))
    result = solve_numeric(ur5, pose, q)
    assert result.converged
    assert max(errors(ur5, pose, result)) < 1e-9


def test_numbers_that_are_not_finite_are_named(ur5):
    with pytest.raises(ValueError, match="joint2"):
        solve_numeric(ur5, IDENTITY, [0.0, math.nan, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="y is inf"):
        solve_numeric(ur5, Pose((0.0, math.inf, 0.0), IDENTITY.rotation), [0.0] * 6)


def test_a_rotation_that_is_none_is_refused(ur5):
    with pytest.raises(ValueError, match="rotation"):
        solve_numeric(ur5, Pose((0.3, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0)), [0.0] * 6)
