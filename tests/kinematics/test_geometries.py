"""Arms of other geometries: offsets, oblique axes and wrists, tools, bases; and poses out of reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, DhRow
from kinematics.pose import IDENTITY, Pose
from kinematics.solution import Singularity
from tests.kinematics import arms

PARALLEL = "parallel axes 2 and 3, offsets"


def solutions_of(model: ArmModel, wanted: np.ndarray, near: Sequence[float] | None = None) -> np.ndarray:
    return np.array([solution.q for solution in InverseKinematics(model).solve(arms.as_pose(wanted), near).solutions])


@pytest.mark.parametrize("wrist", arms.WRISTS)
def test_every_configuration_is_found_and_every_solution_is_confirmed(geometry: str, wrist: str) -> None:
    for seed in range(arms.count(4, 12)):
        model = arms.build_arm(seed, geometry, wrist)
        solver = InverseKinematics(model)
        configurations = arms.random_configurations(model, arms.count(8, 25), seed)
        for q, wanted in zip(configurations, arms.chain(model, configurations), strict=True):
            solutions = np.array([solution.q for solution in solver.solve(arms.as_pose(wanted)).solutions])
            assert arms.worst_error(model, wanted, solutions) < 1e-12
            assert arms.wrapped_difference(solutions, q).min() < 1e-8
            assert arms.wrapped_difference(solver.solve_near(arms.as_pose(wanted), q.tolist()).q, q) < 1e-8


def by_brute_force(model: ArmModel, point: np.ndarray) -> np.ndarray:
    """All angles of joints 1 to 3 for a wrist centre: Newton's method from many random starts."""
    arm = np.random.default_rng(2).uniform(-pi, pi, (400, 3))
    for _ in range(40):
        error = point - arms.wrist_centres(model, arm)
        columns = [
            (arms.wrist_centres(model, arm + step) - arms.wrist_centres(model, arm - step)) / 2e-6
            for step in 1e-6 * np.eye(3)
        ]
        damped = np.stack(columns, axis=2) + 1e-9 * np.eye(3)
        arm = arm + np.clip(np.linalg.solve(damped, error[:, :, None])[:, :, 0], -0.5, 0.5)
    reached = arm[np.linalg.norm(point - arms.wrist_centres(model, arm), axis=1) < 1e-9]
    return np.unique(np.round(np.remainder(reached + pi, 2 * pi) - pi, 5), axis=0)


def test_no_solution_of_joints_1_to_3_is_missing(geometry: str) -> None:
    for seed in range(arms.count(1, 4)):
        model = arms.build_arm(seed, geometry, "right-angled")
        q = arms.random_configurations(model, 1, seed)
        solutions = solutions_of(model, arms.chain(model, q)[0])
        expected = by_brute_force(model, arms.wrist_centres(model, q[:, :3])[0])
        assert len(expected) >= 2
        for arm in expected:
            assert arms.wrapped_difference(solutions[:, :3], arm).min() < 1e-4


def singular_configuration(model: ArmModel, seed: int) -> np.ndarray | None:
    """A configuration in which joints 1 to 3 move the wrist centre in two directions only, by bisection of joint 2."""
    q = np.random.default_rng(seed).uniform(-pi, pi, 6)
    q[4] = 0.8 - model.rows[4].offset

    def volume(leans: np.ndarray) -> np.ndarray:
        arm = np.array([[q[0], lean, q[2]] for lean in leans])
        columns = [
            (arms.wrist_centres(model, arm + step) - arms.wrist_centres(model, arm - step)) / 2e-5
            for step in 1e-5 * np.eye(3)
        ]
        return np.linalg.det(np.stack(columns, axis=2))

    lower, upper = -pi, pi
    for samples in (60, *[40] * 10):
        grid = np.linspace(lower, upper, samples)
        signs = np.sign(volume(grid))
        changes = np.flatnonzero(signs[1:] != signs[:-1])
        if not len(changes):
            return None if samples == 60 else q
        lower, upper = grid[changes[0]], grid[changes[0] + 1]
        q[1] = lower
    return q


def test_beside_a_singularity_of_joints_1_to_3_no_solution_is_missing(geometry: str) -> None:
    tried = 0
    for seed in range(arms.count(3, 30)):
        model = arms.build_arm(seed, geometry, "right-angled")
        singular = singular_configuration(model, seed)
        if singular is None:
            continue
        for distance in (0.0, *10.0 ** -np.arange(3.0, 10.0)):
            q = np.add(singular, [0.0, distance, 0.0, 0.0, 0.0, 0.0])
            wanted = arms.chain(model, q[None])[0]
            solutions = solutions_of(model, wanted, q.tolist())
            assert all(
                (arms.wrapped_difference(solutions[:index], own) > 1e-8).all() for index, own in enumerate(solutions)
            )
            # solutions nearer than 1e-6 rad coincide within the square root of round-off
            assert arms.wrapped_difference(solutions, q).min() < (1e-13 / distance if distance >= 1e-6 else 1e-5)
            assert arms.worst_error(model, wanted, solutions) < 1e-9
            tried += 1
    assert tried > arms.count(0, 40)


@pytest.mark.parametrize("amount", [1e-11, 1e-9, 1e-7, 1e-6, 1e-5, 1e-3])
def test_a_table_with_the_small_deviations_of_a_calibration_is_solved(amount: float, either: ArmModel) -> None:
    random = np.random.default_rng(8)
    for _ in range(arms.count(2, 6)):
        deviations = amount * random.uniform(-1.0, 1.0, (4, 3))
        rows = [
            DhRow(row.alpha + da, row.a + dl, row.d + dd, row.offset)
            for row, (da, dl, dd) in zip(either.rows[:4], deviations, strict=True)
        ]
        model = replace(either, rows=(*rows, *either.rows[4:]))
        assert InverseKinematics(model).method == "spherical wrist, general"
        configurations = random.uniform(-2.0, 2.0, (20, 6))
        configurations[:10, 2] = (-1.343 if either.name == "irb120" else 0.0) + random.uniform(-0.01, 0.01, 10)
        for q, wanted in zip(configurations, arms.chain(model, configurations), strict=True):
            solutions = solutions_of(model, wanted)
            assert arms.wrapped_difference(solutions, q).min() < 1e-4  # some are beside the edge of the workspace


@pytest.mark.parametrize("distance", [0.0, 1e-9, 1e-8, 1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("end", [0.0, pi])
def test_beside_the_edge_of_an_oblique_wrist_no_solution_is_missing(end: float, distance: float) -> None:
    model = arms.build_arm(5, PARALLEL, "oblique")
    q = np.array([0.3, 0.4, 0.5, 0.6, end - model.rows[4].offset + distance, 0.7])
    solutions = InverseKinematics(model).solve(arms.as_pose(arms.chain(model, q[None])[0])).solutions
    own = [solution for solution in solutions if arms.wrapped_difference(solution.q[:3], q[:3]) < 1e-9]
    closest = min(arms.wrapped_difference(solution.q, q) for solution in own)
    assert closest < (1e-6 if distance < 1e-6 else 1e-14 / distance)
    assert len(own) == (1 if distance < 1e-7 else 2)
    assert {solution.singularity for solution in own} == {Singularity.WRIST if distance < 1e-7 else Singularity.NONE}


def test_where_an_oblique_wrist_aligns_axes_4_and_6_joint_4_is_held() -> None:
    model = arms.build_arm(5, PARALLEL, "foldable")
    aligned = 0.0 if model.rows[4].alpha == -model.rows[5].alpha else pi
    q = [0.3, 0.4, 0.5, 0.6, aligned - model.rows[4].offset, 0.7]
    near = [*q[:3], -0.8, *q[4:]]
    solutions = InverseKinematics(model).solve(forward(model, q), near).solutions
    (solution,) = [each for each in solutions if arms.wrapped_difference(each.q[:3], q[:3]) < 1e-9]
    assert solution.q[3] == pytest.approx(-0.8, abs=1e-15)
    assert solution.singularity == Singularity.WRIST
    assert arms.worst_error(model, arms.chain(model, np.array([q]))[0], [solution.q]) < 1e-9


@pytest.mark.parametrize(
    ("name", "method"),
    [
        (PARALLEL, "spherical wrist, parallel axes 2 and 3"),
        ("no parallel axes", "spherical wrist, general"),
        ("parallel axes 1 and 2", "spherical wrist, general"),
    ],
)
def test_the_method_follows_from_the_geometry(name: str, method: str) -> None:
    assert InverseKinematics(arms.build_arm(1, name, "oblique")).method == method


@pytest.mark.parametrize(
    "change",
    [
        {4: {"a": 0.01}},
        {4: {"d": 0.01}},
        {5: {"a": 0.01}},
        {5: {"alpha": 0.0}},
        {1: {"alpha": 0.0}},
        {1: {"alpha": 1e-8}, 2: {"alpha": 1.0}},
        {2: {"a": 0.0}},
    ],
    ids=[
        "a4",
        "d5",
        "a5",
        "axes 5 and 6 parallel",
        "axes 1 to 3 parallel",
        "axes 1 and 2 the same",
        "axes 2 and 3 the same",
    ],
)
def test_an_arm_without_a_closed_form_is_solved_numerically(
    change: dict[int, dict[str, float]], assistive: ArmModel
) -> None:
    model = assistive
    for number, values in change.items():
        model = arms.with_row(model, number, **values)
    solver = InverseKinematics(model)
    assert solver.method == "numeric"
    q = (0.5 * arms.random_configurations(model, 1)[0]).tolist()
    pose = forward(model, q)
    (solution,) = solver.solve(pose, q).solutions
    assert solution.branch is None
    assert solution.within_limits
    for angles in (solution.q, solver.solve_near(pose, [angle + 1e-3 for angle in q]).q):
        assert forward(model, angles).position == pytest.approx(pose.position, abs=1e-9)
        assert forward(model, angles).rotation == pytest.approx(pose.rotation, abs=2e-9)


def test_a_numeric_arm_reports_how_near_it_comes_to_a_pose_out_of_reach(ur5: ArmModel) -> None:
    solver = InverseKinematics(ur5)
    pose = Pose.from_xyzrpy(2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    near = solver.solve_near(pose, [0.1] * 6)
    assert near.q is None
    assert 0.9 < near.out_of_reach < 1.3
    assert f"{near.out_of_reach:.6g} m" in near.reason
    assert solver.solve(pose).solutions == ()
    assert "no solution found" in solver.solve(pose).reason


def hand_at(model: ArmModel, point: np.ndarray) -> Pose:
    """A tool pose with the wrist centre at a point."""
    orientation = Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.3, -0.8, 1.9)
    hand = orientation @ Pose((0.0, 0.0, model.rows[5].d), IDENTITY.rotation) @ model.tool
    return Pose(tuple(np.add(point, hand.position).tolist()), hand.rotation)


def test_far_out_of_reach_the_amount_is_the_distance_to_the_nearest_wrist_centre(geometry: str) -> None:
    for seed in range(arms.count(1, 4)):
        model = arms.build_arm(seed, geometry, "right-angled")
        centres = arms.wrist_centres(model, np.random.default_rng(1).uniform(-pi, pi, (arms.count(50_000, 200_000), 3)))
        middle, direction = centres.mean(axis=0), np.random.default_rng(seed).normal(size=3)
        point = middle + direction / np.linalg.norm(direction) * 2.5
        near = InverseKinematics(model).solve_near(hand_at(model, point), [0.0] * 6)
        nearest = np.linalg.norm(centres - point, axis=1).min()
        assert near.q is None
        assert nearest - 0.02 < near.out_of_reach <= nearest


def test_just_out_of_reach_the_amount_is_proportional_to_the_distance(geometry: str) -> None:
    for seed in range(arms.count(1, 4)):
        model = arms.build_arm(seed, geometry, "right-angled")
        solver = InverseKinematics(model)
        inside = arms.wrist_centres(model, np.random.default_rng(seed).uniform(-pi, pi, (1, 3)))[0]
        direction = np.array([1.0, 0.4, -0.7])
        reached, beyond = 0.0, 5.0
        while beyond - reached > 1e-12:
            middle = 0.5 * (reached + beyond)
            point, rotation = solver._arm.target(hand_at(model, inside + middle * direction))
            if solver._arm.solve(point, rotation, [0.0] * 6):
                reached = middle
            else:
                beyond = middle
        amounts = [
            solver.solve_near(hand_at(model, inside + (beyond + step) * direction), [0.0] * 6).out_of_reach
            for step in (1e-6, 2e-6, 4e-6)
        ]
        assert 0.0 < amounts[0] <= 1.3e-6
        assert np.divide(amounts, amounts[0]) == pytest.approx([1.0, 2.0, 4.0], rel=1e-2)


@pytest.mark.parametrize(("bend", "beyond"), [(0.0, 1e-6), (pi, -1e-6)], ids=["stretched", "folded"])
def test_beyond_a_stretched_or_folded_arm_with_lateral_offset_the_amount_is_exact(
    bend: float, beyond: float, assistive: ArmModel
) -> None:
    model = arms.with_row(assistive, 2, d=0.12)
    for lean in (0.3, 0.9, -1.4):
        edge = arms.wrist_centres(model, np.array([[0.0, lean, bend]]))[0]
        along = edge - [0.0, edge[1], model.rows[0].d]
        # perpendicular to the directions in which joints 1 and 2 move the wrist centre
        normal = np.add(along, [0.0, edge[1] * along[0] / edge[0], 0.0])
        normal /= np.linalg.norm(normal)
        near = InverseKinematics(model).solve_near(hand_at(model, edge + beyond * normal), [0.0] * 6)
        assert near.out_of_reach == pytest.approx(1e-6, rel=1e-3)


def test_inside_the_tube_of_a_lateral_offset_the_amount_is_the_distance_to_its_wall(assistive: ArmModel) -> None:
    model = arms.with_row(assistive, 2, d=0.12)
    near = InverseKinematics(model).solve_near(hand_at(model, np.array([0.0, 0.12 - 1e-6, 0.9])), [0.0] * 6)
    assert near.out_of_reach == pytest.approx(1e-6, rel=1e-6)


def test_an_orientation_out_of_reach_of_an_oblique_wrist_is_refused_with_the_angle(irb120: ArmModel) -> None:
    # Axis 6 is 0.05 to 0.65 rad from axis 4; the right-angled wrist finds all positions of the forearm.
    solver = InverseKinematics(arms.with_row(arms.with_row(irb120, 4, alpha=0.30), 5, alpha=-0.35))
    refused = 0
    for q in arms.random_configurations(irb120, 30):
        pose = forward(irb120, q.tolist())
        forearms = {frames(irb120, own.q)[3].rotation[2::3] for own in InverseKinematics(irb120).solve(pose).solutions}
        angles = np.arccos([np.dot(axis, pose.rotation[2::3]) for axis in forearms])
        missing = np.maximum(angles - 0.65, 0.05 - angles).min()
        near = solver.solve_near(pose, [0.0] * 6)
        if missing > 0.0:
            assert near.q is None
            assert near.reason.startswith(f"out of reach by {missing:.6g} rad")
            assert near.out_of_reach == 0.0
            refused += 1
        else:
            assert solver.solve(pose).solutions
    assert 5 < refused < 30
