"""Inverse kinematics of the two arms: every solution, nothing but solutions, and reasons where there are none."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import IDENTITY, Pose
from kinematics.solution import Singularity

COUNT = 100_000
BLOCK = 5_000
ACCURACY = 1e-9  # m and rad

angles = st.floats(-pi, pi)
lengths = st.floats(-1.5, 1.5)
poses = st.builds(Pose.from_xyzrpy, lengths, lengths, lengths, angles, angles, angles)
IN_REACH = Pose.from_xyzrpy(0.3, 0.1, 0.5, 0.4, 1.0, -0.3)


def reach(model: ArmModel, pose: Pose) -> tuple[float, float, float]:
    """From axis 2 to the wrist centre (m), and the shortest and longest that the arm allows, without lateral offset."""
    centre = np.subtract(pose.position, np.multiply(model.rows[5].d, pose.rotation[2::3]))
    upper, fore = model.rows[2].a, hypot(model.rows[3].a, model.rows[3].d)
    return float(np.linalg.norm(centre - [0.0, 0.0, model.rows[0].d])), abs(upper - fore), upper + fore


def matrix(pose: Pose) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = np.reshape(pose.rotation, (3, 3)), pose.position
    return result


def turns_apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The largest difference of a joint, turns of 2 pi aside."""
    return np.abs(np.remainder(one - other + pi, 2 * pi) - pi).max(axis=-1)


def distance_from_singularities(model: ArmModel, q: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Sine of joint 5, sine of the elbow and distance (m) from axis 1, multiplied, for arms without lateral offset.

    The determinant of the Jacobian is this but for a constant factor.
    """
    upper, fore = model.rows[2].a, hypot(model.rows[3].a, model.rows[3].d)
    centre = poses[:, :3, 3] - model.rows[5].d * poses[:, :3, 2] - [0.0, 0.0, model.rows[0].d]
    bend = ((centre**2).sum(axis=1) - upper**2 - fore**2) / (2.0 * upper * fore)
    elbow = np.sqrt(np.maximum(0.0, 1.0 - bend**2))
    return np.abs(np.sin(q[:, 4])) * elbow * np.hypot(centre[:, 0], centre[:, 1])


def test_of_100000_configurations_each_is_found_among_eight_confirmed_solutions(
    either, chain, pose_errors, as_pose, random_configurations
):
    solver = InverseKinematics(either)
    lower = np.array([limit.lower for limit in either.limits])
    upper = np.array([limit.upper for limit in either.limits])
    for block in range(COUNT // BLOCK):
        true = random_configurations(either, BLOCK, seed=block)
        poses = chain(either, true)
        answers = [solver.solve(as_pose(pose)).solutions for pose in poses]
        assert {len(solutions) for solutions in answers} == {8}
        found = np.array([[solution.q for solution in solutions] for solutions in answers])
        position, rotation = pose_errors(np.repeat(poses, 8, axis=0), chain(either, found.reshape(-1, 6)))
        assert max(position.max(), rotation.max()) < ACCURACY
        # Round-off of the pose comes back multiplied beside a singularity, and only there
        tolerance = 1e-12 + 5e-15 / distance_from_singularities(either, true, poses)
        assert (turns_apart(found, true[:, None, :]).min(axis=1) < tolerance).all()
        flags = [[solution.within_limits for solution in solutions] for solutions in answers]
        assert (np.array(flags) == ((lower <= found) & (found <= upper)).all(axis=2)).all()
        assert np.any(flags, axis=1).all()


@settings(max_examples=300)
@given(pose=poses)
def test_no_solution_is_given_that_forward_does_not_confirm(pose, either, chain, pose_errors):
    for solution in InverseKinematics(either).solve(pose).solutions:
        position, rotation = pose_errors(matrix(pose)[None], chain(either, np.array([solution.q])))
        assert max(position[0], rotation[0]) < ACCURACY


@settings(max_examples=300)
@given(pose=poses)
def test_a_pose_has_solutions_or_a_reason_and_the_reason_says_by_how_much(pose, either):
    answer = InverseKinematics(either).solve(pose)
    distance, shortest, longest = reach(either, pose)
    beyond = max(distance - longest, shortest - distance)
    if beyond < 0.0:
        assert answer.solutions
        assert answer.reason is None
    elif beyond > 1e-9:
        assert answer.solutions == ()
        amount = float(answer.reason.removeprefix("out of reach by ").split(" m:")[0])
        assert amount == pytest.approx(beyond, rel=1e-5)


@settings(max_examples=200)
@given(pose=poses)
def test_no_solution_is_given_twice(pose, either):
    found = np.array([solution.q for solution in InverseKinematics(either).solve(pose).solutions]).reshape(-1, 6)
    for index, q in enumerate(found):
        assert (turns_apart(found[:index], q) > 1e-9).all()


@pytest.mark.parametrize("beyond", [1e-9, 1e-6, 1e-3, 0.1])
@pytest.mark.parametrize("side", ["longest", "shortest"])
def test_a_pose_just_out_of_reach_is_told_so_with_the_amount(beyond, side, either):
    solver = InverseKinematics(either)
    random = np.random.default_rng(5)
    for _ in range(20):
        direction = random.normal(size=3)
        _, shortest, longest = reach(either, IDENTITY)
        distance = longest + beyond if side == "longest" else max(0.0, shortest - beyond)
        turn = Pose.from_xyzrpy(0.0, 0.0, 0.0, *random.uniform(-pi, pi, 3))
        centre = direction / np.linalg.norm(direction) * distance + [0.0, 0.0, either.rows[0].d]
        position = centre + np.multiply(either.rows[5].d, turn.rotation[2::3])
        near = solver.solve_near(Pose(tuple(position.tolist()), turn.rotation), [0.0] * 6)
        expected = beyond if side == "longest" else min(beyond, shortest)
        assert near.q is None
        assert near.out_of_reach == pytest.approx(expected, rel=1e-6, abs=1e-15)
        assert near.reason.startswith(f"out of reach by {near.out_of_reach:.6g} m")


def test_a_pose_beyond_the_edge_by_round_off_only_is_reached(either):
    centre = np.array([reach(either, IN_REACH)[2] + 5e-11, 0.0, either.rows[0].d])
    pose = Pose(tuple((centre + np.multiply(either.rows[5].d, IN_REACH.rotation[2::3])).tolist()), IN_REACH.rotation)
    assert {one.singularity for one in InverseKinematics(either).solve(pose).solutions} == {Singularity.ELBOW}


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("place", range(12))
def test_a_pose_with_a_number_that_is_not_finite_is_refused_by_name(value, place, assistive):
    numbers = [*IN_REACH.position, *IN_REACH.rotation]
    numbers[place] = value
    pose = Pose(tuple(numbers[:3]), tuple(numbers[3:]))
    name = "xyz"[place] if place < 3 else rf"rotation\[{(place - 3) // 3}\]\[{place % 3}\]"
    solver = InverseKinematics(assistive)
    for call in (solver.solve, lambda pose: solver.solve_near(pose, [0.0] * 6)):
        with pytest.raises(ValueError, match=f"^{name} is {value}"):
            call(pose)


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("joint", range(6))
def test_a_configuration_to_be_near_that_is_not_finite_is_refused_by_its_joint(value, joint, assistive):
    near = [0.0] * 6
    near[joint] = value
    solver = InverseKinematics(assistive)
    for call in (solver.solve, solver.solve_near):
        with pytest.raises(ValueError, match=f"^joint{joint + 1} of q_near is {value}"):
            call(IN_REACH, near)


@pytest.mark.parametrize("count", [0, 5, 7])
def test_a_configuration_to_be_near_of_another_length_is_refused(count, assistive):
    with pytest.raises(ValueError, match=f"q_near has {count} joint angles; 6 are required"):
        InverseKinematics(assistive).solve_near(IN_REACH, [0.0] * count)


@pytest.mark.parametrize("size", [1e160, 1e300])
def test_a_pose_at_the_end_of_the_numbers_is_out_of_reach_like_any_other(size, either):
    near = InverseKinematics(either).solve_near(Pose((size, -size, size), IN_REACH.rotation), [0.0] * 6)
    assert near.q is None
    assert near.out_of_reach > size


@pytest.mark.parametrize("distance", [0.0, 5.0])
def test_a_pose_whose_rotation_is_none_is_refused(distance, assistive):
    solver = InverseKinematics(assistive)
    pose = Pose((0.3 + distance, 0.1, 0.5), (1.001, *IDENTITY.rotation[1:]))
    with pytest.raises(ValueError, match=r"the rotation of the pose is invalid: R R\^T differs from 1 by 0.002"):
        solver.solve(pose)
    with pytest.raises(ValueError, match="the rotation of the pose is invalid"):
        solver.solve_near(pose, [0.0] * 6)


@pytest.mark.parametrize(("lower", "upper"), [(6.5, 12.0), (-12.0, -6.5)])
def test_a_joint_is_given_in_the_turn_that_its_limits_allow(lower, upper, irb120):
    limits = (*irb120.limits[:5], JointLimit(lower, upper))
    solutions = InverseKinematics(replace(irb120, limits=limits)).solve(IN_REACH).solutions
    inside = [solution for solution in solutions if 5 not in solution.outside]
    assert len(solutions) == 8
    assert inside
    assert all(lower <= solution.q[5] <= upper for solution in inside)
    assert all(-pi < solution.q[5] <= pi for solution in solutions if solution not in inside)


def test_a_joint_that_round_off_has_put_beyond_its_limit_is_on_it(assistive, chain, as_pose):
    q = [limit.upper for limit in assistive.limits]
    found = InverseKinematics(assistive).solve(as_pose(chain(assistive, np.array([q]))[0])).solutions
    assert [solution.q for solution in found if solution.within_limits and max(solution.q) == 3.1] != []
    assert min(turns_apart(np.array(solution.q), np.array(q)) for solution in found if solution.within_limits) < 1e-12
