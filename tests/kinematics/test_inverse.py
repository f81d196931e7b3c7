"""All solutions of the two arms: complete, confirmed, named after their branch; and reasons where there are none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot, inf, nan, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import IDENTITY, Pose
from kinematics.solution import BRANCHES, Singularity
from tests.kinematics import arms

ACCURACY = 1e-9  # m and rad
COUNT, BLOCK = arms.count(2_000, 100_000), 1_000

angles = st.floats(-pi, pi)
lengths = st.floats(-1.5, 1.5)
poses = st.builds(Pose.from_xyzrpy, lengths, lengths, lengths, angles, angles, angles)
IN_REACH = Pose.from_xyzrpy(0.3, 0.1, 0.5, 0.4, 1.0, -0.3)


def reach(model: ArmModel, pose: Pose) -> tuple[float, float, float]:
    """From axis 2 to the wrist centre (m), and the shortest and longest of the arm, without lateral offset."""
    centre = np.subtract(pose.position, np.multiply(model.rows[5].d, pose.rotation[2::3]))
    upper, fore = model.rows[2].a, hypot(model.rows[3].a, model.rows[3].d)
    return float(np.linalg.norm(centre - [0.0, 0.0, model.rows[0].d])), abs(upper - fore), upper + fore


def distance_from_singularities(model: ArmModel, q: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Sine of joint 5, sine of the elbow and distance (m) from axis 1, multiplied, for arms without lateral offset.

    The determinant of the Jacobian is proportional to it.
    """
    upper, fore = model.rows[2].a, hypot(model.rows[3].a, model.rows[3].d)
    centre = poses[:, :3, 3] - model.rows[5].d * poses[:, :3, 2] - [0.0, 0.0, model.rows[0].d]
    bend = ((centre**2).sum(axis=1) - upper**2 - fore**2) / (2.0 * upper * fore)
    elbow = np.sqrt(np.maximum(0.0, 1.0 - bend**2))
    return np.abs(np.sin(q[:, 4])) * elbow * np.hypot(centre[:, 0], centre[:, 1])


def test_each_random_configuration_is_among_eight_confirmed_solutions(either: ArmModel) -> None:
    solver = InverseKinematics(either)
    lower = np.array([limit.lower for limit in either.limits])
    upper = np.array([limit.upper for limit in either.limits])
    for block in range(COUNT // BLOCK):
        true = arms.random_configurations(either, BLOCK, seed=block)
        poses = arms.chain(either, true)
        answers = [solver.solve(arms.as_pose(pose)).solutions for pose in poses]
        assert {len(solutions) for solutions in answers} == {8}
        solved = np.array([[solution.q for solution in solutions] for solutions in answers])
        errors = arms.pose_errors(np.repeat(poses, 8, axis=0), arms.chain(either, solved.reshape(-1, 6)))
        assert np.max(errors) < ACCURACY
        # The round-off of the pose is amplified beside a singularity, and only there
        tolerance = 1e-12 + 5e-15 / distance_from_singularities(either, true, poses)
        assert (arms.wrapped_difference(solved, true[:, None, :]).min(axis=1) < tolerance).all()
        flags = [[solution.within_limits for solution in solutions] for solutions in answers]
        assert (np.array(flags) == ((lower <= solved) & (solved <= upper)).all(axis=2)).all()
        assert np.any(flags, axis=1).all()


@settings(max_examples=arms.count(60, 300))
@given(pose=poses)
def test_a_pose_has_distinct_confirmed_solutions_or_a_reason_with_the_amount(pose: Pose, either: ArmModel) -> None:
    answer = InverseKinematics(either).solve(pose)
    solved = np.array([solution.q for solution in answer.solutions]).reshape(-1, 6)
    for index, q in enumerate(solved):
        assert arms.worst_error(either, arms.matrix(pose), [q]) < ACCURACY
        assert (arms.wrapped_difference(solved[:index], q) > 1e-9).all()
    distance, shortest, longest = reach(either, pose)
    beyond = max(distance - longest, shortest - distance)
    if beyond < 0.0:
        assert answer.solutions
        assert answer.reason is None
    elif beyond > 1e-9:
        assert answer.solutions == ()
        amount = float(answer.reason.removeprefix("out of reach by ").split(" m:")[0])
        assert amount == pytest.approx(beyond, rel=1e-5)


@pytest.mark.parametrize("beyond", [1e-9, 1e-6, 1e-3, 0.1])
@pytest.mark.parametrize("side", ["longest", "shortest"])
def test_a_pose_just_out_of_reach_is_refused_with_the_amount(beyond: float, side: str, either: ArmModel) -> None:
    solver = InverseKinematics(either)
    random = np.random.default_rng(5)
    for _ in range(20):
        direction = random.normal(size=3)
        _, shortest, longest = reach(either, IDENTITY)
        distance = longest + beyond if side == "longest" else max(0.0, shortest - beyond)
        orientation = Pose.from_xyzrpy(0.0, 0.0, 0.0, *random.uniform(-pi, pi, 3))
        centre = direction / np.linalg.norm(direction) * distance + [0.0, 0.0, either.rows[0].d]
        position = centre + np.multiply(either.rows[5].d, orientation.rotation[2::3])
        near = solver.solve_near(Pose(tuple(position.tolist()), orientation.rotation), [0.0] * 6)
        expected = beyond if side == "longest" else min(beyond, shortest)
        assert near.q is None
        assert near.out_of_reach == pytest.approx(expected, rel=1e-6, abs=1e-15)
        assert near.reason.startswith(f"out of reach by {near.out_of_reach:.6g} m")


def test_a_pose_beyond_the_edge_by_round_off_is_reached(either: ArmModel) -> None:
    centre = np.array([reach(either, IN_REACH)[2] + 5e-11, 0.0, either.rows[0].d])
    pose = Pose(tuple((centre + np.multiply(either.rows[5].d, IN_REACH.rotation[2::3])).tolist()), IN_REACH.rotation)
    assert {solution.singularity for solution in InverseKinematics(either).solve(pose).solutions} == {Singularity.ELBOW}


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("place", range(12))
def test_a_pose_with_a_value_that_is_not_finite_is_refused_with_its_name(
    value: float, place: int, assistive: ArmModel
) -> None:
    numbers = np.array([*IN_REACH.position, *IN_REACH.rotation])
    numbers[place] = value
    pose = Pose(tuple(numbers[:3].tolist()), tuple(numbers[3:].tolist()))
    name = "xyz"[place] if place < 3 else rf"rotation\[{(place - 3) // 3}\]\[{place % 3}\]"
    solver = InverseKinematics(assistive)
    for call in (solver.solve, lambda pose: solver.solve_near(pose, [0.0] * 6)):
        with pytest.raises(ValueError, match=f"^{name} is {value}"):
            call(pose)


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("joint", range(6))
def test_a_value_of_q_near_that_is_not_finite_is_refused_with_its_joint(
    value: float, joint: int, assistive: ArmModel
) -> None:
    near = [0.0] * 6
    near[joint] = value
    solver = InverseKinematics(assistive)
    for call in (solver.solve, solver.solve_near):
        with pytest.raises(ValueError, match=f"^joint{joint + 1} of q_near is {value}"):
            call(IN_REACH, near)


@pytest.mark.parametrize("number", [0, 5, 7])
def test_q_near_with_a_wrong_count_of_angles_is_refused(number: int, assistive: ArmModel) -> None:
    with pytest.raises(ValueError, match=f"q_near has {number} joint angles; 6 are required"):
        InverseKinematics(assistive).solve_near(IN_REACH, [0.0] * number)


@pytest.mark.parametrize("size", [1e160, 1e300])
def test_a_pose_whose_squares_overflow_is_out_of_reach_like_any_other(size: float, either: ArmModel) -> None:
    near = InverseKinematics(either).solve_near(Pose((size, -size, size), IN_REACH.rotation), [0.0] * 6)
    assert near.q is None
    assert near.out_of_reach > size


@pytest.mark.parametrize("arm", ["assistive", "ur5"])
@pytest.mark.parametrize("distance", [0.0, 5.0])
def test_a_pose_with_an_invalid_rotation_is_refused(distance: float, arm: str, request: pytest.FixtureRequest) -> None:
    solver = InverseKinematics(request.getfixturevalue(arm))
    pose = Pose((0.3 + distance, 0.1, 0.5), (1.001, *IDENTITY.rotation[1:]))
    for call in (solver.solve, lambda pose: solver.solve_near(pose, [0.0] * 6)):
        with pytest.raises(ValueError, match=r"the rotation of the pose is invalid: R R\^T differs from 1 by 0.002"):
            call(pose)


@pytest.mark.parametrize(("lower", "upper"), [(6.5, 12.0), (-12.0, -6.5)])
def test_a_joint_is_wrapped_into_its_limits(lower: float, upper: float, irb120: ArmModel) -> None:
    limits = (*irb120.limits[:5], JointLimit(lower, upper))
    solutions = InverseKinematics(replace(irb120, limits=limits)).solve(IN_REACH).solutions
    inside = [solution for solution in solutions if 5 not in solution.outside]
    assert len(solutions) == 8
    assert inside
    assert all(lower <= solution.q[5] <= upper for solution in inside)
    assert all(-pi < solution.q[5] <= pi for solution in solutions if solution not in inside)


def test_a_joint_beyond_its_limit_by_round_off_is_set_to_the_limit(assistive: ArmModel) -> None:
    q = [limit.upper for limit in assistive.limits]
    solutions = InverseKinematics(assistive).solve(arms.as_pose(arms.chain(assistive, np.array([q]))[0])).solutions
    assert [solution.q for solution in solutions if solution.within_limits and max(solution.q) == 3.1] != []
    assert min(arms.wrapped_difference(solution.q, q) for solution in solutions if solution.within_limits) < 1e-12


def name_by_sight(model: ArmModel, q: Sequence[float]) -> str:
    """The branch seen from the side, for arms without lateral and shoulder offset."""
    poses = frames(model, q)
    second, third, wrist = (np.array(poses[index].position) for index in (1, 2, 4))
    ahead = np.array(poses[0].rotation[0::3])
    elbow, centre = (np.array([(point - second) @ ahead, (point - second)[2]]) for point in (third, wrist))
    shoulder = "front"
    if centre[0] < 0.0:
        elbow, centre, shoulder = elbow * [-1, 1], centre * [-1, 1], "back"
    height_of_line = centre[1] * elbow[0] / centre[0]
    flip = "no-flip" if sin(q[4] + model.rows[4].offset) >= 0.0 else "flip"
    return f"{shoulder}/{'up' if elbow[1] > height_of_line else 'down'}/{flip}"


def test_each_of_eight_solutions_has_its_own_branch_as_seen_from_the_side(either: ArmModel) -> None:
    for q in arms.random_configurations(either, arms.count(50, 300)).tolist():
        solutions = InverseKinematics(either).solve(forward(either, q)).solutions
        assert {solution.branch for solution in solutions} == set(BRANCHES)
        for solution in solutions:
            assert str(solution.branch) == name_by_sight(either, solution.q)


@pytest.mark.parametrize(
    ("q", "name"),
    [
        ([0.0, 0.8, -0.9, 0.0, 0.5, 0.0], "front/up/no-flip"),
        ([0.0, 1.5, 0.9, 0.0, 0.5, 0.0], "front/down/no-flip"),
        ([0.0, -0.8, 0.9, 0.0, -0.5, 0.0], "back/up/flip"),
        ([0.0, -1.5, -0.9, 0.0, 0.5, 0.0], "back/down/no-flip"),
    ],
)
def test_known_configurations_of_the_assistive_arm_keep_their_branch(
    q: list[float], name: str, assistive: ArmModel
) -> None:
    # This fails when the solver and `name_by_sight` change together.
    assert name == name_by_sight(assistive, q)
    solutions = InverseKinematics(assistive).solve(forward(assistive, q)).solutions
    assert [str(solution.branch) for solution in solutions if np.allclose(solution.q, q)] == [name]
