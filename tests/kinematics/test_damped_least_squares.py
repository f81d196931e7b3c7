"""Damped least squares: numeric inverse kinematics, and the nearest configuration where there is no solution."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from kinematics.damped_least_squares import NumericResult, damped_least_squares, solve_numeric
from kinematics.forward import forward
from kinematics.jacobian import characteristic_length
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import IDENTITY, Pose, Rotation
from kinematics.solution import six
from tests.kinematics.arms import count, random_configurations, with_general_rows


@pytest.fixture(scope="module")
def ur5(ur5: ArmModel) -> ArmModel:
    """With the manufacturer's limits, one revolution each way."""
    return replace(ur5, limits=(JointLimit(-2 * math.pi, 2 * math.pi, math.pi),) * 6)


@pytest.fixture(scope="module")
def general(ur5: ArmModel) -> ArmModel:
    """No parallel axes, no axes that meet."""
    return with_general_rows(ur5)


def inside(model: ArmModel, q: Sequence[float]) -> bool:
    return all(limit.lower <= angle <= limit.upper for angle, limit in zip(q, model.limits, strict=True))


def errors(model: ArmModel, pose: Pose, result: NumericResult) -> tuple[float, float]:
    """Position error, m, and rotation error, rad, computed differently from the solver."""
    reached = forward(model, result.q)
    deviation = np.reshape(pose.rotation, (3, 3)).T @ np.reshape(reached.rotation, (3, 3))
    chord = np.linalg.norm(deviation - np.eye(3)) / math.sqrt(8.0)
    return math.dist(reached.position, pose.position), 2.0 * math.asin(min(1.0, chord))


@pytest.mark.parametrize("arm", ["ur5", "general", "assistive", "irb120"])
def test_every_pose_within_reach_is_found_from_anywhere(arm: str, request: pytest.FixtureRequest) -> None:
    model = request.getfixturevalue(arm)
    for q, near in random_configurations(model, 2 * count(12, 100)).reshape(-1, 2, 6).tolist():
        pose = forward(model, q)
        result = solve_numeric(model, pose, near)
        assert result.converged
        assert max(errors(model, pose, result)) < 1e-9
        assert inside(model, result.q)


def test_from_nearby_the_nearby_solution_is_found(ur5: ArmModel) -> None:
    generator = np.random.default_rng(13)
    for q in generator.uniform(-2.0, 2.0, (20, 6)).tolist():
        q[2], q[4] = math.copysign(max(0.4, abs(q[2])), q[2]), math.copysign(max(0.4, abs(q[4])), q[4])
        near = (q + generator.uniform(-0.01, 0.01, 6)).tolist()
        pose = forward(ur5, q)
        assert solve_numeric(ur5, pose, near).q == pytest.approx(q, abs=1e-6)
        assert damped_least_squares(ur5, pose, near) == pytest.approx(q, abs=1e-6)


def test_damped_least_squares_give_up_on_a_pose_that_no_small_step_reaches(ur5: ArmModel) -> None:
    assert damped_least_squares(ur5, Pose((3.0, 0.0, 0.0), IDENTITY.rotation), [0.1] * 6) is None


def test_a_pose_that_is_already_reached_changes_no_joint(ur5: ArmModel) -> None:
    q = (0.3, -0.4, 1.1, 5.9, 0.8, -4.0)
    assert solve_numeric(ur5, forward(ur5, q), q) == (q, True, 0.0, pytest.approx(0.0, abs=1e-15), 0)


def test_each_joint_is_wrapped_to_the_value_nearest_to_q_near(ur5: ArmModel) -> None:
    q = [0.3, -0.4, 1.1, 0.4, 0.8, 0.2]
    near = [0.3 + 2 * math.pi, -0.4, 1.1 - 2 * math.pi, 0.4, 0.8 + 2 * math.pi, 0.2]
    # 0.8 + 2 pi is beyond the limit of 2 pi, and so is 0.3 + 2 pi; 1.1 - 2 pi is inside.
    assert solve_numeric(ur5, forward(ur5, q), near).q == pytest.approx([0.3, -0.4, near[2], 0.4, 0.8, 0.2], abs=1e-6)
    free = solve_numeric(ur5, forward(ur5, q), near, respect_limits=False)
    assert free.q == pytest.approx(near, abs=1e-6)


def test_a_pose_that_only_angles_beyond_the_limits_reach_is_reached_without_limits_only(assistive: ArmModel) -> None:
    narrow = replace(assistive, limits=(JointLimit(-0.5, 0.5),) * 6)
    pose = forward(assistive, [0.4, 1.2, 1.0, 0.3, -1.1, 0.2])
    result = solve_numeric(narrow, pose, [0.0] * 6)
    assert not result.converged
    assert inside(narrow, result.q)
    assert (result.position_error, result.rotation_error) == pytest.approx(errors(narrow, pose, result), abs=1e-9)
    assert solve_numeric(narrow, pose, [0.0] * 6, respect_limits=False).converged


def test_the_same_arguments_give_the_same_result(ur5: ArmModel) -> None:
    q, near = random_configurations(ur5, 2).tolist()
    pose = forward(ur5, q)
    far = Pose((3.0, 0.0, 0.0), pose.rotation)
    assert solve_numeric(ur5, pose, near) == solve_numeric(ur5, pose, near)
    assert solve_numeric(ur5, far, near) == solve_numeric(ur5, far, near)


@pytest.mark.parametrize("beyond", [1e-6, 1e-3, 0.1, 1.0])
def test_beyond_the_reach_the_arm_stretches_towards_the_pose(beyond: float, assistive: ArmModel) -> None:
    pose = Pose((0.0, 0.0, 1.300 + beyond), IDENTITY.rotation)
    result = solve_numeric(assistive, pose, [0.1, 0.2, 0.3, 0.1, 0.1, 0.1])
    assert not result.converged
    assert result.position_error == pytest.approx(beyond, abs=1e-8)
    assert result.rotation_error < 1e-4
    assert forward(assistive, result.q).position[2] == pytest.approx(1.300, abs=1e-6)


@pytest.mark.parametrize("arm", ["ur5", "irb120"])
def test_no_configuration_beside_the_result_is_nearer_to_a_pose_out_of_reach(
    arm: str, request: pytest.FixtureRequest
) -> None:
    model = request.getfixturevalue(arm)
    numbers = random.Random(15)
    length = characteristic_length(model)

    def cost(q: Sequence[float]) -> float:
        position, rotation = errors(model, pose, NumericResult(six(q), False, 0.0, 0.0, 0))
        return (position / length) ** 2 + rotation**2

    for _ in range(3):
        there = forward(model, [numbers.uniform(limit.lower, limit.upper) for limit in model.limits])
        x, y, z = (value * 1.8 / math.hypot(*there.position) for value in there.position)
        pose = Pose((x, y, z), there.rotation)
        result = solve_numeric(model, pose, [0.1] * 6)
        assert not result.converged
        least = cost(result.q)
        for size in (0.01, 0.1, 1.0):
            for _ in range(100):
                other = [angle + numbers.gauss(0.0, size) for angle in result.q]
                if inside(model, other):
                    assert cost(other) > least - 1e-5


def test_a_singular_pose_is_reached(assistive: ArmModel) -> None:
    result = solve_numeric(assistive, forward(assistive, [0.0] * 6), [0.5, -0.7, 1.3, 0.4, 0.9, 0.2])
    assert result.converged


@pytest.mark.parametrize("half_turn", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_a_tool_rotated_by_half_a_turn_has_an_error_of_pi(half_turn: tuple[int, int, int], assistive: ArmModel) -> None:
    fixed = replace(assistive, limits=(JointLimit(-1e-9, 1e-9),) * 6)
    x, y, z = half_turn
    rotation: Rotation = (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z)
    result = solve_numeric(fixed, Pose((0.0, 0.0, 1.300), rotation), [0.0] * 6)
    assert result.rotation_error == pytest.approx(math.pi, abs=1e-7)


@pytest.mark.parametrize("half_turn", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_a_pose_half_a_turn_away_is_reached(half_turn: tuple[int, int, int], ur5: ArmModel) -> None:
    q = [0.3, -1.4, 1.1, 0.4, 0.8, 0.2]
    here = forward(ur5, q)
    turned = np.reshape(here.rotation, (3, 3)) @ np.diag(half_turn)
    pose = Pose((0.35, 0.2, 0.3), tuple(turned.ravel().tolist()))
    result = solve_numeric(ur5, pose, q)
    assert result.converged
    assert max(errors(ur5, pose, result)) < 1e-9


def test_a_value_that_is_not_finite_is_refused_by_name(ur5: ArmModel) -> None:
    with pytest.raises(ValueError, match="joint2"):
        solve_numeric(ur5, IDENTITY, [0.0, math.nan, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="y is inf"):
        solve_numeric(ur5, Pose((0.0, math.inf, 0.0), IDENTITY.rotation), [0.0] * 6)


def test_an_invalid_rotation_is_refused(ur5: ArmModel) -> None:
    with pytest.raises(ValueError, match="rotation"):
        solve_numeric(ur5, Pose((0.3, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0)), [0.0] * 6)
