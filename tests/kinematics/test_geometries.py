"""Arms of other geometry than the two that ship: offsets, axes that are not parallel, oblique wrists, tools, bases."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, DhRow
from kinematics.pose import Pose
from kinematics.solution import Singularity

ARMS = 12
CONFIGURATIONS = 25


def turns_apart(one, other) -> np.ndarray:
    return np.abs(np.remainder(np.subtract(one, other) + pi, 2 * pi) - pi).max(axis=-1)


@pytest.mark.parametrize("wrist", ["right-angled", "oblique", "foldable"])
def test_every_configuration_is_found_and_every_solution_confirmed(
    build_arm, region, wrist, chain, pose_errors, as_pose, random_configurations
):
    for seed in range(ARMS):
        model = build_arm(seed, region, wrist)
        solver = InverseKinematics(model)
        configurations = random_configurations(model, CONFIGURATIONS, seed)
        for q, matrix in zip(configurations, chain(model, configurations), strict=True):
            found = np.array([solution.q for solution in solver.solve(as_pose(matrix)).solutions])
            position, rotation = pose_errors(np.repeat(matrix[None], len(found), axis=0), chain(model, found))
            assert max(position.max(), rotation.max()) < 1e-12
            assert turns_apart(found, q).min() < 1e-8
            near = solver.solve_near(as_pose(matrix), q.tolist())
            assert turns_apart(near.q, q) < 1e-8


def wrist_centres(model: ArmModel, chain, regional: np.ndarray) -> np.ndarray:
    """Of configurations (N, 3) of joints 1 to 3, m."""
    without_hand = replace(model, tool=Pose.from_xyzrpy(0.0, 0.0, -model.rows[5].d, 0.0, 0.0, 0.0))
    return chain(without_hand, np.hstack([regional, np.zeros_like(regional)]))[:, :3, 3]


def by_brute_force(model: ArmModel, chain, point: np.ndarray) -> np.ndarray:
    """All joints 1 to 3 for a wrist centre: Newton's method from many random starts."""
    regional = np.random.default_rng(2).uniform(-pi, pi, (400, 3))
    for _ in range(40):
        error = point - wrist_centres(model, chain, regional)
        columns = [
            (wrist_centres(model, chain, regional + step) - wrist_centres(model, chain, regional - step)) / 2e-6
            for step in 1e-6 * np.eye(3)
        ]
        damped = np.stack(columns, axis=2) + 1e-9 * np.eye(3)
        regional = regional + np.clip(np.linalg.solve(damped, error[:, :, None])[:, :, 0], -0.5, 0.5)
    reached = regional[np.linalg.norm(point - wrist_centres(model, chain, regional), axis=1) < 1e-9]
    return np.unique(np.round(np.remainder(reached + pi, 2 * pi) - pi, 5), axis=0)


def test_no_solution_of_the_first_three_joints_is_missing(build_arm, region, chain, as_pose, random_configurations):
    for seed in range(4):
        model = build_arm(seed, region, "right-angled")
        q = random_configurations(model, 1, seed)
        point = wrist_centres(model, chain, q[:, :3])[0]
        found = np.array([one.q[:3] for one in InverseKinematics(model).solve(as_pose(chain(model, q)[0])).solutions])
        expected = by_brute_force(model, chain, point)
        assert len(expected) >= 2
        for regional in expected:
            assert turns_apart(found, regional).min() < 1e-4


def on_a_fold(model: ArmModel, chain, seed: int) -> np.ndarray | None:
    """A configuration in which joints 1 to 3 move the wrist centre in two directions only, by bisection of joint 2."""

    def volume(leans: np.ndarray) -> np.ndarray:
        regional = np.array([[q[0], lean, q[2]] for lean in leans])
        columns = [
            (wrist_centres(model, chain, regional + step) - wrist_centres(model, chain, regional - step)) / 2e-5
            for step in 1e-5 * np.eye(3)
        ]
        return np.linalg.det(np.stack(columns, axis=2))

    q = np.random.default_rng(seed).uniform(-pi, pi, 6)
    q[4] = 0.8 - model.rows[4].offset
    grid = np.linspace(-pi, pi, 60)
    signs = np.sign(volume(grid))
    changes = np.flatnonzero(signs[1:] != signs[:-1])
    if not len(changes):
        return None
    lower, upper = grid[changes[0]], grid[changes[0] + 1]
    for _ in range(60):
        middle = 0.5 * (lower + upper)
        if volume(np.array([middle]))[0] * volume(np.array([lower]))[0] > 0.0:
            lower = middle
        else:
            upper = middle
    q[1] = lower
    return q


def test_beside_a_singularity_of_the_first_three_joints_nothing_is_missing(
    build_arm, region, chain, as_pose, pose_errors
):
    tried = 0
    for seed in range(30):
        model = build_arm(seed, region, "right-angled")
        fold = on_a_fold(model, chain, seed)
        if fold is None:
            continue
        for distance in (0.0, *10.0 ** -np.arange(3.0, 10.0)):
            q = np.add(fold, [0.0, distance, 0.0, 0.0, 0.0, 0.0])
            matrix = chain(model, q[None])
            solutions = InverseKinematics(model).solve(as_pose(matrix[0]), q.tolist()).solutions
            found = np.array([solution.q for solution in solutions])
            assert all((turns_apart(found[:index], one) > 1e-8).all() for index, one in enumerate(found))
            # nearer than 1e-6 rad two solutions are one to the square root of round-off
            assert turns_apart(found, q).min() < (1e-13 / distance if distance >= 1e-6 else 1e-5)
            position, rotation = pose_errors(np.repeat(matrix, len(found), axis=0), chain(model, found))
            assert max(position.max(), rotation.max()) < 1e-9
            tried += 1
    assert tried > 40


@pytest.mark.parametrize("amount", [1e-11, 1e-9, 1e-7, 1e-6, 1e-5, 1e-3])
def test_a_table_with_the_small_amounts_that_a_calibration_gives_is_solved(amount, either, chain, as_pose):
    random = np.random.default_rng(8)
    for _ in range(6):
        rows = [
            DhRow(row.alpha + da, row.a + dl, row.d + dd, row.offset)
            for row, (da, dl, dd) in zip(either.rows, amount * random.uniform(-1.0, 1.0, (6, 3)), strict=True)
        ]
        model = replace(either, rows=(*rows[:4], *either.rows[4:]))
        solver = InverseKinematics(model)
        assert solver.method == "spherical wrist, general"
        configurations = random.uniform(-2.0, 2.0, (40, 6))
        configurations[:10, 2] = (-1.343 if either.name == "irb120" else 0.0) + random.uniform(-0.01, 0.01, 10)
        for q, matrix in zip(configurations, chain(model, configurations), strict=True):
            found = [one.q for one in solver.solve(as_pose(matrix)).solutions]
            assert turns_apart(np.array(found), q).min() < 1e-4  # some are beside the edge of the workspace


@pytest.mark.parametrize("distance", [0.0, 1e-9, 1e-8, 1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("end", [0.0, pi])
def test_beside_the_edge_of_an_oblique_wrist_nothing_is_missing(end, distance, build_arm, chain, as_pose):
    model = build_arm(5, "parallel axes 2 and 3, offsets", "oblique")
    q = np.array([0.3, 0.4, 0.5, 0.6, end - model.rows[4].offset + distance, 0.7])
    solutions = InverseKinematics(model).solve(as_pose(chain(model, q[None])[0])).solutions
    own = [one for one in solutions if turns_apart(one.q[:3], q[:3]) < 1e-9]
    assert turns_apart(np.array([one.q for one in own]), q).min() < (1e-6 if distance < 1e-6 else 1e-14 / distance)
    assert len(own) == (1 if distance < 1e-7 else 2)
    assert {one.singularity for one in own} == {Singularity.WRIST if distance < 1e-7 else Singularity.NONE}


@pytest.mark.parametrize(
    ("region", "method"),
    [
        ("parallel axes 2 and 3, offsets", "spherical wrist, parallel axes 2 and 3"),
        ("no parallel axes", "spherical wrist, general"),
        ("parallel axes 1 and 2", "spherical wrist, general"),
    ],
)
def test_the_method_follows_from_the_geometry(build_arm, region, method):
    assert InverseKinematics(build_arm(1, region, "oblique")).method == method


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
def test_an_arm_without_a_closed_form_is_solved_numerically(change, assistive, random_configurations):
    rows = [replace(row, **change.get(number, {})) for number, row in enumerate(assistive.rows)]
    model = replace(assistive, rows=tuple(rows))
    solver = InverseKinematics(model)
    assert solver.method == "numeric"
    q = (0.5 * random_configurations(model, 1)[0]).tolist()
    pose = forward(model, q)
    (solution,) = solver.solve(pose, q).solutions
    assert solution.branch is None
    assert solution.within_limits
    for found in (solution.q, solver.solve_near(pose, [angle + 1e-3 for angle in q]).q):
        assert forward(model, found).position == pytest.approx(pose.position, abs=1e-9)
        assert forward(model, found).rotation == pytest.approx(pose.rotation, abs=2e-9)


def test_a_numeric_arm_says_how_near_it_comes_to_what_it_cannot_reach(ur5):
    solver = InverseKinematics(ur5)
    pose = Pose.from_xyzrpy(2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    near = solver.solve_near(pose, [0.1] * 6)
    assert near.q is None
    assert 0.9 < near.out_of_reach < 1.3
    assert f"{near.out_of_reach:.6g} m" in near.reason
    assert solver.solve(pose).solutions == ()
    assert "no solution found" in solver.solve(pose).reason
