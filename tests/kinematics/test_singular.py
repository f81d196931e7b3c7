"""On and beside singularities: no solution is missing, a free joint is held, and the singularity is named."""

from __future__ import annotations

from collections.abc import Sequence
from math import acos, atan2, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.solution import Singularity
from tests.kinematics.arms import as_pose, chain, count, stretched, with_row, worst_error, wrapped_difference

KINDS = ("wrist", "elbow", "shoulder")
APART = 0.05  # sine of joint 5 and of the elbow, where the singularity is not requested
FLAGS = {"wrist": Singularity.WRIST, "elbow": Singularity.ELBOW, "shoulder": Singularity.SHOULDER}

kinds = st.sets(st.sampled_from(KINDS), min_size=1)
distances = st.sampled_from([0.0, *(10.0**-exponent for exponent in range(3, 10))])
sides = st.sampled_from([-1.0, 1.0])
configurations = st.tuples(*(st.floats(-1.0, 1.0) for _ in range(6)))


def wrist_height_and_distance(model: ArmModel, q: list[float]) -> tuple[float, float]:
    """Wrist centre from axis 2 in the plane of the arm, m: along x of frame 1, and up."""
    pose = forward(model, [0.0, *q[1:]])
    x, _, z = np.subtract(pose.position, np.multiply(model.rows[5].d, pose.rotation[2::3]))
    return x, z - model.rows[0].d


def beside(model: ArmModel, shape: Sequence[float], kinds: set[str], distance: float, side: float) -> list[float]:
    """A configuration inside the limits at a distance (rad, or m from axis 1) from all named singularities."""
    q = [share * min(-limit.lower, limit.upper) for share, limit in zip(shape, model.limits, strict=True)]
    if "wrist" in kinds:
        q[4] = side * distance
    elif abs(sin(q[4])) < APART:
        q[4] = 0.5
    if "elbow" in kinds:
        q[2] = stretched(model) + side * distance
    elif abs(sin(q[2] - stretched(model))) < APART:
        q[2] = stretched(model) + 0.5
    if "shoulder" in kinds:
        # joint 2 rotates a rigid triangle about axis 2
        x, z = wrist_height_and_distance(model, [q[0], 0.0, *q[2:]])
        quarter, _ = wrist_height_and_distance(model, [q[0], pi / 2, *q[2:]])
        q[1] = atan2(quarter, x) + acos(side * distance / hypot(x, z))
        q[1] -= pi * round(q[1] / pi)
    elif abs(wrist_height_and_distance(model, q)[0]) < 0.02:
        q[1] += 0.5
    return q


def tolerance(kinds: set[str], distance: float) -> float:
    """How far (rad) the round-off of the pose, 1e-16, may move a solution at a distance from the named singularities.

    Distance from axis 1 divides it. At the edge of the workspace only the square of the bend is known: nearer than
    5e-7 the arm is stretched. The error of the forearm's direction is divided by the distance of the wrist.
    """
    if distance == 0.0:
        return 1e-12
    arm = 5e-15
    if "shoulder" in kinds:
        arm += 1e-15 / distance
    if "elbow" in kinds:
        arm += 5e-7 if distance < 5e-7 else 5e-15 / distance
    return 1e-12 + arm / (distance if "wrist" in kinds else APART)


@settings(max_examples=count(60, 400))
@given(shape=configurations, kinds=kinds, distance=distances, side=sides)
def test_no_solution_is_missing_beside_singularities(
    shape: Sequence[float], kinds: set[str], distance: float, side: float, either: ArmModel
) -> None:
    q = beside(either, shape, kinds, distance, side)
    matrix = chain(either, np.array([q]))[0]
    solved = [solution.q for solution in InverseKinematics(either).solve(as_pose(matrix), q).solutions]
    assert wrapped_difference(solved, q).min() < tolerance(kinds, distance)
    assert worst_error(either, matrix, solved) < 1e-9


@settings(max_examples=count(30, 100))
@given(shape=configurations, kinds=kinds, side=sides, free=st.floats(-1.0, 1.0))
def test_on_a_singularity_the_free_joints_stay_and_it_is_named(
    shape: Sequence[float], kinds: set[str], side: float, free: float, either: ArmModel
) -> None:
    q = beside(either, shape, kinds, 0.0, side)
    near = [free, q[1], q[2], -free, q[4], q[5]]
    solutions = InverseKinematics(either).solve(as_pose(chain(either, np.array([q]))[0]), near).solutions
    named = [solution for solution in solutions if FLAGS["wrist"] in solution.singularity]
    if kinds <= {"wrist", "elbow"} and "wrist" in kinds:
        assert named
        assert all(solution.q[3] == pytest.approx(-free, abs=1e-15) for solution in named)
    if "shoulder" in kinds:
        assert all(solution.q[0] == pytest.approx(free, abs=1e-15) for solution in solutions)
    for kind in {"shoulder", "elbow"} & kinds:
        assert all(FLAGS[kind] in solution.singularity for solution in solutions)


@settings(max_examples=count(30, 100))
@given(shape=configurations, kinds=kinds, side=sides)
def test_a_thousandth_away_no_singularity_is_named_and_all_eight_solutions_are_found(
    shape: Sequence[float], kinds: set[str], side: float, either: ArmModel
) -> None:
    q = beside(either, shape, kinds, 1e-3, side)
    solutions = InverseKinematics(either).solve(as_pose(chain(either, np.array([q]))[0])).solutions
    assert len(solutions) == 8
    own = min(solutions, key=lambda solution: wrapped_difference(solution.q, q))
    assert own.singularity == Singularity.NONE


@pytest.mark.parametrize(
    ("kinds", "count"),
    [({"elbow"}, 4), ({"shoulder"}, 4), ({"shoulder", "elbow"}, 2)],
    ids=["elbow", "shoulder", "both"],
)
def test_solutions_that_coincide_are_returned_once(kinds: set[str], count: int, either: ArmModel) -> None:
    q = beside(either, (0.2, 0.3, 0.4, 0.5, 0.6, 0.7), kinds, 0.0, 1.0)
    solutions = InverseKinematics(either).solve(as_pose(chain(either, np.array([q]))[0]), q).solutions
    assert len(solutions) == count


@pytest.mark.parametrize(("arm", "count"), [("assistive", 2), ("irb120", 1)])
def test_both_wrist_solutions_coincide_where_the_forearm_points_along_axis_6(
    arm: str, count: int, request: pytest.FixtureRequest
) -> None:
    # Without an elbow offset, half a turn of joint 1 and leaning back gives the same forearm.
    model = request.getfixturevalue(arm)
    q = beside(model, (0.2, 0.3, 0.4, 0.5, 0.6, 0.7), {"wrist"}, 0.0, 1.0)
    solutions = InverseKinematics(model).solve(as_pose(chain(model, np.array([q]))[0]), q).solutions
    assert [solution.singularity for solution in solutions].count(Singularity.WRIST) == count
    assert len(solutions) == 8 - count


def equal_lengths(model: ArmModel) -> ArmModel:
    """The upper arm as long as the forearm, which can fold onto axis 2."""
    return with_row(model, 2, a=hypot(model.rows[3].a, model.rows[3].d))


@pytest.mark.parametrize("opened", [0.0, 5e-11, 1e-3])
def test_with_the_wrist_centre_on_axis_2_joint_2_is_held(opened: float, assistive: ArmModel) -> None:
    model = equal_lengths(assistive)
    folded = pi + stretched(model)
    q = [0.4, 0.7, folded - 2 * pi * round(folded / (2 * pi)) - opened, 0.3, 0.6, 0.1]
    near = [0.4, 0.9, 0.0, 0.3, 0.6, 0.1]
    pose = forward(model, q)
    solutions = InverseKinematics(model).solve(pose, near).solutions
    is_held = opened < 1e-10
    assert solutions
    assert all((solution.q[1] == pytest.approx(0.9, abs=1e-15)) == is_held for solution in solutions)
    assert all((Singularity.ELBOW in solution.singularity) == is_held for solution in solutions)
    assert all(forward(model, own.q).position == pytest.approx(pose.position, abs=1e-9) for own in solutions)


@pytest.mark.parametrize("distance", [0.0, 1e-9, 1e-7, 1e-5, 1e-3])
def test_beside_the_tube_of_a_lateral_offset_no_solution_is_missing(distance: float, assistive: ArmModel) -> None:
    model = with_row(assistive, 2, d=0.12)
    q = beside(assistive, (0.2, 0.3, 0.4, 0.5, 0.6, 0.7), {"shoulder"}, distance, 1.0)
    solutions = InverseKinematics(model).solve(as_pose(chain(model, np.array([q]))[0])).solutions
    assert min(wrapped_difference(solution.q, q) for solution in solutions) < (
        1e-6 if distance < 1e-6 else 1e-14 / distance
    )
    nearest = min(solutions, key=lambda solution: wrapped_difference(solution.q, q))
    assert (Singularity.SHOULDER in nearest.singularity) == (distance < 1e-8)
    assert len(solutions) == (4 if distance < 1e-8 else 8)
