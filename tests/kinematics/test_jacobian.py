"""The geometric Jacobian, the distances from the singularities, and joint velocities for tool velocities."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.jacobian import (
    THRESHOLD,
    characteristic_length,
    determinant,
    gram,
    jacobian,
    joint_velocity,
    manipulability,
    scaled_rows,
    singular_values,
    singularity_distances,
    solve_positive,
)
from kinematics.model import ArmModel
from kinematics.spherical import has_spherical_wrist
from tests.kinematics.arms import Change, random_configurations, with_row, with_tool

REGULAR = [0.3, -0.4, 1.1, 0.4, 0.8, 0.2]
WRIST, ELBOW = [0.3, -0.4, 1.1, 0.4, 0.0, 0.2], [0.3, -0.4, 0.0, 0.4, 0.8, 0.2]
SHOULDER = [0.7, math.atan2(0.550 * math.sin(1.3), 0.440 + 0.550 * math.cos(1.3)), 1.3, 0.4, 0.8, 0.2]
UP = [0.0] * 6
TWIST = [0.05, -0.02, 0.03, 0.1, 0.2, -0.1]


def with_lateral_offset(model: ArmModel) -> ArmModel:
    """As in a PUMA: the plane of the arm passes beside axis 1."""
    return with_row(model, 2, d=0.12)


def with_skewed_forearm(model: ArmModel) -> ArmModel:
    """Upper arm and forearm both have an offset along axis 2."""
    return with_row(with_lateral_offset(model), 3, alpha=-1.2)


def without_spherical_wrist(model: ArmModel) -> ArmModel:
    return with_row(model, 4, d=0.09)


def configurations(model: ArmModel, count: int) -> list[list[float]]:
    return random_configurations(model, count).tolist()


@pytest.mark.parametrize("change", [with_tool, with_lateral_offset, without_spherical_wrist])
@pytest.mark.parametrize("arm", ["assistive", "irb120"])
def test_the_jacobian_is_the_derivative_of_the_tool_pose(
    arm: str, change: Change, request: pytest.FixtureRequest
) -> None:
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
            rotation = np.reshape(b.rotation, (3, 3)) @ np.reshape(a.rotation, (3, 3)).T / (2 * step)
            angular = [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
            assert columns[joint] == pytest.approx([*linear, *np.divide(angular, 2)], abs=1e-8)


def test_the_jacobian_consists_of_six_rows_of_plain_floats(assistive: ArmModel) -> None:
    rows = jacobian(assistive, [0.1] * 6)
    assert [len(row) for row in rows] == [6] * 6
    assert {type(value) for row in rows for value in row} == {float}


@pytest.mark.parametrize("arm", ["assistive", "irb120"])
def test_manipulability_is_the_root_of_the_determinant_of_j_j_transposed(
    arm: str, request: pytest.FixtureRequest
) -> None:
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
def test_the_three_distances_are_the_factors_of_the_determinant(
    arm: str, change: Change, upper: float, fore: float, request: pytest.FixtureRequest
) -> None:
    model = change(request.getfixturevalue(arm))
    for q in configurations(model, 100):
        shoulder, elbow, wrist, _ = singularity_distances(model, q)
        expected = upper * fore * shoulder * math.sin(elbow) * math.sin(wrist)
        assert manipulability(model, q) == pytest.approx(expected, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-12, -1e-6, 0.3, -1.2, 1.5])
def test_wrist_and_elbow_distance_are_the_angles_of_joint_5_and_from_stretched(
    angle: float, assistive: ArmModel
) -> None:
    wrist = singularity_distances(assistive, [*REGULAR[:4], angle, 0.2]).wrist
    elbow = singularity_distances(assistive, [0.3, -0.4, angle, *REGULAR[3:]]).elbow
    assert wrist == pytest.approx(abs(angle), rel=1e-9, abs=1e-15)
    assert elbow == pytest.approx(abs(angle), rel=1e-3, abs=1e-15)


def test_the_elbow_distance_is_zero_where_an_offset_elbow_is_stretched_or_folded(irb120: ArmModel) -> None:
    stretched = -math.atan2(0.302, 0.070)  # upper arm and wrist centre in one line
    for angle in (stretched, stretched + math.pi):
        q = [0.3, -0.4, angle, 0.4, 0.8, 0.2]
        assert singularity_distances(irb120, q).elbow == pytest.approx(0.0, abs=1e-15)
        assert manipulability(irb120, q) == pytest.approx(0.0, abs=1e-17)


def test_the_shoulder_distance_is_the_distance_of_the_wrist_centre_from_axis_1(irb120: ArmModel) -> None:
    for q in configurations(irb120, 50):
        x, y, _ = frames(irb120, q)[4].position
        assert singularity_distances(irb120, q).shoulder == pytest.approx(math.hypot(x, y), abs=1e-14)


@pytest.mark.parametrize("change", [with_tool, without_spherical_wrist])
def test_the_smallest_singular_value_matches_numpy(change: Change, irb120: ArmModel) -> None:
    model = change(irb120)
    for q in [*configurations(model, 50), UP]:
        scaled = np.array(scaled_rows(jacobian(model, q), 1.0 / characteristic_length(model)))
        smallest = np.linalg.svd(scaled, compute_uv=False)[-1]
        assert singularity_distances(model, q).smallest == pytest.approx(smallest, abs=1e-14)


def test_an_arm_without_a_spherical_wrist_has_only_the_smallest_singular_value(irb120: ArmModel) -> None:
    model = without_spherical_wrist(irb120)
    assert has_spherical_wrist(irb120)
    assert not has_spherical_wrist(model)
    assert singularity_distances(model, [0.2] * 6)[:3] == (None, None, None)


def test_an_arm_whose_axes_2_and_3_are_not_parallel_has_only_the_wrist_distance(irb120: ArmModel) -> None:
    shoulder, elbow, wrist, _ = singularity_distances(with_row(irb120, 2, alpha=math.pi / 2), [0.2] * 6)
    assert (shoulder, elbow) == (None, None)
    assert wrist == pytest.approx(0.2)


def test_the_characteristic_length_is_half_the_reach_from_axis_2(assistive: ArmModel) -> None:
    assert characteristic_length(assistive) == pytest.approx((0.440 + 0.550 + 0.140) / 2)


def test_an_angle_that_is_not_finite_is_refused_with_its_joint(assistive: ArmModel) -> None:
    q = [0.0] * 6
    q[3] = math.nan
    for function in (jacobian, manipulability, singularity_distances):
        with pytest.raises(ValueError, match="joint4"):
            function(assistive, q)


def cases(model: ArmModel, count: int) -> list[tuple[list[float], list[float]]]:
    """Configurations and tool velocities."""
    twists = np.random.default_rng(3).normal(0.0, (0.1, 0.1, 0.1, 0.3, 0.3, 0.3), (count, 6))
    return list(zip(configurations(model, count), twists.tolist(), strict=True))


def test_away_from_singularities_the_tool_moves_exactly_as_commanded(either: ArmModel) -> None:
    regular = 0
    for q, twist in cases(either, 200):
        result = joint_velocity(either, q, twist, respect_limits=False)
        if result.damping == 0.0:
            regular += 1
            assert np.array(jacobian(either, q)) @ result.qd == pytest.approx(twist, abs=1e-9)
            assert result.lost == pytest.approx([0.0] * 6, abs=1e-9)
    assert regular > 120


def test_the_lost_velocity_is_the_commanded_minus_the_achieved_one(assistive: ArmModel) -> None:
    for q in (WRIST, ELBOW, SHOULDER, UP, REGULAR):
        for respect in (True, False):
            qd, lost, _, _ = joint_velocity(assistive, q, TWIST, respect_limits=respect)
            assert lost == pytest.approx(TWIST - np.array(jacobian(assistive, q)) @ qd, abs=1e-15)


@pytest.mark.parametrize("q", [WRIST, ELBOW, SHOULDER, UP])
def test_on_a_singularity_the_damping_is_full_and_the_loss_is_reported(q: list[float], assistive: ArmModel) -> None:
    result = joint_velocity(assistive, q, TWIST, respect_limits=False)
    assert result.damping == pytest.approx(THRESHOLD)
    assert math.hypot(*result.lost) > 0.001


def test_the_joint_speed_is_bounded_everywhere(either: ArmModel) -> None:
    length = characteristic_length(either)
    extreme = [(q, twist) for q in (WRIST, ELBOW, SHOULDER, UP) for _, twist in cases(either, 20)]
    beside = [([angle + 1e-3 * k for angle in q], twist) for k, (q, twist) in enumerate(extreme)]
    for q, twist in [*cases(either, 100), *extreme, *beside]:
        size = math.hypot(*(value / length for value in twist[:3]), *twist[3:])
        qd = joint_velocity(either, q, twist, respect_limits=False).qd
        assert math.hypot(*qd) <= size / THRESHOLD * (1.0 + 1e-9)


def test_the_damping_grows_towards_the_singularity(assistive: ArmModel) -> None:
    dampings = [
        joint_velocity(assistive, [*REGULAR[:4], angle, 0.2], TWIST).damping for angle in (0.5, 0.05, 0.02, 0.01, 0.0)
    ]
    assert dampings[0] == 0.0
    assert dampings == sorted(set(dampings))


@pytest.mark.parametrize(("q", "joint"), [(WRIST, 4), (ELBOW, 2), (SHOULDER, 1)])
def test_the_joint_velocity_is_continuous_through_a_singularity(
    q: list[float], joint: int, assistive: ArmModel
) -> None:
    step = 2e-4
    previous = None
    dampings = set()
    for k in range(-1500, 1501):
        here = list(q)
        here[joint] += k * step
        qd, _, damping, _ = joint_velocity(assistive, here, TWIST, respect_limits=False)
        dampings.add(damping > 0.0)
        if previous is not None:
            # Bound of the slope: |qd| / threshold per rad, times the largest derivative of the Jacobian (about 3).
            assert max(abs(a - b) for a, b in zip(qd, previous, strict=True)) < 0.1
        previous = qd
    assert dampings == {True, False}


@pytest.mark.parametrize("factor", [20.0, -20.0])
def test_a_speed_limit_scales_the_tool_velocity_and_keeps_its_direction(factor: float, assistive: ArmModel) -> None:
    fast = [factor * value for value in TWIST]
    result = joint_velocity(assistive, REGULAR, fast)
    assert 0.0 < result.scale < 1.0
    assert max(abs(speed) for speed in result.qd) == pytest.approx(0.5)
    assert np.array(jacobian(assistive, REGULAR)) @ result.qd == pytest.approx(np.multiply(result.scale, fast))
    assert result.lost == pytest.approx(np.multiply(1.0 - result.scale, fast))


def test_the_joint_nearest_to_its_speed_limit_sets_the_scale(assistive: ArmModel) -> None:
    free = joint_velocity(assistive, REGULAR, TWIST)
    assert free.scale == 1.0
    limits = list(assistive.limits)
    for joint, part in ((1, 0.9), (4, 0.25), (5, 0.6)):
        limits[joint] = replace(limits[joint], velocity=part * abs(free.qd[joint]))
    result = joint_velocity(replace(assistive, limits=tuple(limits)), REGULAR, TWIST)
    assert result.scale == pytest.approx(0.25)
    assert result.qd == pytest.approx([0.25 * speed for speed in free.qd])


def test_a_tool_velocity_of_zero_moves_no_joint(assistive: ArmModel) -> None:
    for q in (REGULAR, UP):
        assert joint_velocity(assistive, q, [0.0] * 6).qd == pytest.approx([0.0] * 6, abs=0.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_twist_or_angle_that_is_not_finite_is_refused_by_name(bad: float, assistive: ArmModel) -> None:
    with pytest.raises(ValueError, match="wy"):
        joint_velocity(assistive, REGULAR, [*TWIST[:4], bad, 0.0])
    with pytest.raises(ValueError, match="joint3"):
        joint_velocity(assistive, [0.1, 0.1, bad, 0.1, 0.1, 0.1], TWIST)


@pytest.mark.parametrize("threshold", [0.0, -0.1, math.nan])
def test_a_threshold_that_is_not_positive_is_refused(threshold: float, assistive: ArmModel) -> None:
    with pytest.raises(ValueError, match="threshold"):
        joint_velocity(assistive, REGULAR, TWIST, threshold=threshold)


NUMBERS = np.random.default_rng(16)
MATRICES = [NUMBERS.normal(size=(6, 6)) for _ in range(20)]


@pytest.mark.parametrize("size", [6, 4, 1, 0])
def test_a_positive_definite_system_of_any_size_is_solved(size: int) -> None:
    right = NUMBERS.normal(size=size)
    for matrix in MATRICES:
        assert np.array(gram(matrix.tolist())) == pytest.approx(matrix @ matrix.T)
        system = (matrix @ matrix.T + 0.1 * np.eye(6))[:size, :size]
        expected = np.linalg.solve(system, right)
        assert solve_positive(system.tolist(), right.tolist()) == pytest.approx(expected, rel=1e-8)


def test_a_system_that_is_not_positive_definite_has_no_solution() -> None:
    assert solve_positive([[1.0, 2.0], [2.0, 1.0]], [1.0, 1.0]) is None


def test_the_determinant_matches_numpy_also_where_rows_must_be_exchanged() -> None:
    exchanged = [np.eye(6)[NUMBERS.permutation(6)] + np.diag([0.5] * 5, 1) for _ in range(20)]
    for matrix in MATRICES + exchanged:
        assert determinant(matrix.tolist()) == pytest.approx(np.linalg.det(matrix), rel=1e-10, abs=1e-14)
    assert determinant([[0.0] * 6] * 6) == 0.0


def test_singular_values_keep_their_digits_close_to_zero() -> None:
    for matrix in MATRICES:
        left, _, right = np.linalg.svd(matrix)
        for smallest in (1.0, 1e-3, 1e-9, 0.0):
            scaled = left @ np.diag([5.0, 4.0, 3.0, 2.0, 1.5, smallest]) @ right
            assert min(singular_values(scaled.tolist())) == pytest.approx(smallest, abs=1e-14)
