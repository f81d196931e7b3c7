"""The solution that continues a motion: the nearest inside the limits, in the right turn, or what is in the way."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import inf, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import Pose
from kinematics.solution import Singularity

shares = st.tuples(*(st.floats(-0.99, 0.99) for _ in range(6)))


def inside(model: ArmModel, shape) -> list[float]:
    """A configuration inside the limits, for six shares between -1 and 1."""
    return [
        0.5 * ((1.0 - share) * limit.lower + (1.0 + share) * limit.upper)
        for share, limit in zip(shape, model.limits, strict=True)
    ]


def largest(q, near) -> float:
    return float(np.abs(np.subtract(q, near)).max())


def smallest_move(model: ArmModel, pose: Pose, near) -> float:
    """By brute force: all solutions in all turns that are inside the limits."""
    moves = []
    for solution in InverseKinematics(model).solve(pose, near).solutions:
        turns = [
            [angle + 2 * pi * turn for turn in range(-3, 4) if limit.lower <= angle + 2 * pi * turn <= limit.upper]
            for angle, limit in zip(solution.q, model.limits, strict=True)
        ]
        moves += [largest(q, near) for q in product(*turns)]
    return min(moves, default=inf)


@given(shape=shares, step=st.floats(1e-6, 0.05), direction=shares)
def test_the_configuration_that_a_small_step_away_was_one_is_found(shape, step, direction, either):
    q = inside(either, shape)
    near = [angle + step * share for angle, share in zip(q, direction, strict=True)]
    found = InverseKinematics(either).solve_near(forward(either, q), near)
    assert found.reason == ""
    assert largest(found.q, near) <= 4.0 * step + 1e-3  # a joint that is free and held costs the others its step
    assert (found.out_of_reach, found.limited) == (0.0, -1)


@given(shape=shares, elsewhere=shares)
def test_no_other_solution_inside_the_limits_is_nearer(shape, elsewhere, either):
    pose, near = forward(either, inside(either, shape)), inside(either, elsewhere)
    found = InverseKinematics(either).solve_near(pose, near)
    assert largest(found.q, near) <= smallest_move(either, pose, near) + 1e-9


@given(shape=shares, elsewhere=st.tuples(*(st.floats(-40.0, 40.0) for _ in range(6))))
def test_from_anywhere_what_is_found_is_inside_the_limits_and_confirmed(shape, elsewhere, either, chain, pose_errors):
    q = inside(either, shape)
    found = InverseKinematics(either).solve_near(forward(either, q), elsewhere).q
    assert all(limit.lower <= angle <= limit.upper for angle, limit in zip(found, either.limits, strict=True))
    position, rotation = pose_errors(chain(either, np.array([q])), chain(either, np.array([found])))
    assert max(position[0], rotation[0]) < 1e-9


@pytest.mark.parametrize(("near", "expected"), [(6.2, 6.4), (-6.2, 6.4 - 4 * pi), (0.0, 6.4 - 2 * pi), (6.9, 6.4)])
def test_a_joint_that_may_turn_more_than_once_stays_in_its_turn(near, expected, irb120):
    q = [0.3, 0.2, 0.4, 0.5, 0.6, 6.4]
    found = InverseKinematics(irb120).solve_near(forward(irb120, q), [*q[:5], near])
    assert found.q == pytest.approx([*q[:5], expected], abs=1e-12)


def test_a_joint_at_its_limit_goes_back_by_a_turn(irb120):
    q = [0.3, 0.2, 0.4, 0.5, 0.6, 7.1]  # the limit is 6.98
    model = replace(irb120, limits=(*(JointLimit(angle - 0.1, angle + 0.1) for angle in q[:5]), irb120.limits[5]))
    found = InverseKinematics(model).solve_near(forward(model, q), [*q[:5], 6.95])
    assert found.q == pytest.approx([*q[:5], 7.1 - 2 * pi], abs=1e-12)


def test_where_the_continuing_branch_leaves_the_limits_another_is_taken(assistive):
    q = [0.3, 0.4, 0.5, 3.2, 0.6, 0.7]  # the limit of joint 4 is 3.1
    model = replace(
        assistive, limits=(*(JointLimit(angle - 0.1, angle + 0.1) for angle in q[:3]), *assistive.limits[3:])
    )
    found = InverseKinematics(model).solve_near(forward(model, q), [*q[:3], 3.09, *q[4:]])
    assert found.q == pytest.approx([0.3, 0.4, 0.5, 3.2 - pi, -0.6, 0.7 - pi], abs=1e-12)


@pytest.mark.parametrize(("joint", "beyond"), [(0, 0.2), (2, -0.3), (4, 0.25)])
def test_with_all_solutions_beyond_the_limits_the_joint_that_is_in_the_way_is_named(joint, beyond, assistive):
    q = [0.3, 0.4, 0.5, 0.6, 0.7, 0.8]
    limits = tuple(JointLimit(angle - 0.1, angle + 0.1) for angle in q)
    model = replace(assistive, limits=limits)
    moved = [*q[:joint], q[joint] + beyond, *q[joint + 1 :]]
    found = InverseKinematics(model).solve_near(forward(model, moved), q)
    limit = q[joint] + (0.1 if beyond > 0 else -0.1)
    assert found.q is None
    assert found.limited == joint
    assert found.out_of_reach == 0.0
    assert found.reason == (
        f"joint limit: joint{joint + 1} would have to be at {moved[joint]:.6g} rad, beyond its limit of {limit:.6g} rad"
    )


def test_a_limit_is_not_passed_by_round_off(assistive, random_configurations):
    solver = InverseKinematics(assistive)
    limit = assistive.limits[2].upper
    for q in random_configurations(assistive, 200).tolist():
        q[2] = limit
        found = solver.solve_near(forward(assistive, q), q).q
        assert found is not None
        assert found[2] <= limit


def test_at_a_wrist_singularity_joint_4_stays_and_joint_6_takes_the_turn(assistive):
    near = [0.3, 0.4, 0.5, 0.6, 0.0, 0.7]
    found = InverseKinematics(assistive).solve_near(forward(assistive, [0.3, 0.4, 0.5, 0.6, 0.0, 0.9]), near)
    assert found.q == pytest.approx([0.3, 0.4, 0.5, 0.6, 0.0, 0.9], abs=1e-12)
    assert found.singularity == Singularity.WRIST


@pytest.mark.parametrize("turn", [0.5, -0.5])
def test_at_a_wrist_singularity_joint_4_helps_where_joint_6_is_at_its_limit(turn, assistive):
    at_limit = 3.05 * np.sign(turn)
    near = [0.3, 0.4, 0.5, 0.6, 0.0, at_limit]
    pose = forward(assistive, [*near[:5], at_limit + turn])
    found = InverseKinematics(assistive).solve_near(pose, near).q
    assert found[5] == 3.1 * np.sign(turn)
    assert largest(found, near) < 0.5
    assert forward(assistive, found).rotation == pytest.approx(pose.rotation, abs=1e-12)


def test_the_answer_is_made_of_plain_floats(either):
    near = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    found = InverseKinematics(either).solve_near(forward(either, near), near).q
    assert [type(angle) for angle in found] == [float] * 6


def test_the_same_question_has_the_same_answer(either, random_configurations):
    solver = InverseKinematics(either)
    pairs = random_configurations(either, 40).reshape(20, 2, 6).tolist()
    questions = [(forward(either, q), near) for q, near in pairs]
    answers = [solver.solve_near(*question) for question in questions]
    assert [solver.solve_near(*question) for question in reversed(questions)] == answers[::-1]
