"""The solution that continues a motion: the nearest inside the limits, without a jump, or what prevents it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product
from math import atan2, inf, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import Pose
from kinematics.solution import Singularity
from tests.kinematics import arms

shares = st.tuples(*(st.floats(-0.99, 0.99) for _ in range(6)))
Q = [0.3, 0.4, 0.5, 0.6, 0.7, 0.8]


def inside(model: ArmModel, shape: Sequence[float]) -> list[float]:
    """A configuration inside the limits, for six shares between -1 and 1."""
    return [
        0.5 * ((1.0 - share) * limit.lower + (1.0 + share) * limit.upper)
        for share, limit in zip(shape, model.limits, strict=True)
    ]


def narrow(model: ArmModel, q: Sequence[float], joints: Iterable[int] = range(6)) -> ArmModel:
    """The arm with limits of 0.1 rad around `q` for some joints."""
    limits = [JointLimit(q[i] - 0.1, q[i] + 0.1) if i in joints else limit for i, limit in enumerate(model.limits)]
    return replace(model, limits=tuple(limits))


def largest(q: ArrayLike, near: ArrayLike) -> float:
    return float(np.abs(np.subtract(q, near)).max())


def smallest_move(model: ArmModel, pose: Pose, near: Sequence[float]) -> float:
    """By brute force: all solutions at all multiples of 2 pi inside the limits."""
    moves = []
    for solution in InverseKinematics(model).solve(pose, near).solutions:
        turns = [
            [angle + 2 * pi * turn for turn in range(-3, 4) if limit.lower <= angle + 2 * pi * turn <= limit.upper]
            for angle, limit in zip(solution.q, model.limits, strict=True)
        ]
        moves += [largest(q, near) for q in product(*turns)]
    return min(moves, default=inf)


@settings(max_examples=arms.count(40, 100))
@given(shape=shares, elsewhere=shares)
def test_no_other_solution_inside_the_limits_is_nearer(
    shape: Sequence[float], elsewhere: Sequence[float], either: ArmModel
) -> None:
    pose, near = forward(either, inside(either, shape)), inside(either, elsewhere)
    answer = InverseKinematics(either).solve_near(pose, near)
    assert largest(answer.q, near) <= smallest_move(either, pose, near) + 1e-9


@settings(max_examples=arms.count(30, 100))
@given(shape=shares, elsewhere=st.tuples(*(st.floats(-40.0, 40.0) for _ in range(6))))
def test_from_anywhere_the_solution_is_inside_the_limits_and_confirmed(
    shape: Sequence[float], elsewhere: Sequence[float], either: ArmModel
) -> None:
    pose = forward(either, inside(either, shape))
    q = InverseKinematics(either).solve_near(pose, elsewhere).q
    assert all(limit.lower <= angle <= limit.upper for angle, limit in zip(q, either.limits, strict=True))
    assert arms.worst_error(either, arms.matrix(pose), [q]) < 1e-9


@pytest.mark.parametrize(("near", "expected"), [(6.2, 6.4), (-6.2, 6.4 - 4 * pi), (0.0, 6.4 - 2 * pi), (6.9, 6.4)])
def test_a_joint_with_a_range_above_a_turn_takes_the_nearest_multiple_of_2_pi(
    near: float, expected: float, irb120: ArmModel
) -> None:
    q = [0.3, 0.2, 0.4, 0.5, 0.6, 6.4]
    answer = InverseKinematics(irb120).solve_near(forward(irb120, q), [*q[:5], near])
    assert answer.q == pytest.approx([*q[:5], expected], abs=1e-12)


def test_a_joint_that_would_exceed_its_limit_goes_back_by_a_turn(irb120: ArmModel) -> None:
    q = [0.3, 0.2, 0.4, 0.5, 0.6, 7.1]  # the limit is 6.98
    model = narrow(irb120, q, range(5))
    answer = InverseKinematics(model).solve_near(forward(model, q), [*q[:5], 6.95])
    assert answer.q == pytest.approx([*q[:5], 7.1 - 2 * pi], abs=1e-12)


def test_another_branch_is_used_where_the_nearest_exceeds_the_limits(assistive: ArmModel) -> None:
    q = [0.3, 0.4, 0.5, 3.2, 0.6, 0.7]  # the limit of joint 4 is 3.1
    model = narrow(assistive, q, range(3))
    answer = InverseKinematics(model).solve_near(forward(model, q), [*q[:3], 3.09, *q[4:]])
    assert answer.q == pytest.approx([0.3, 0.4, 0.5, 3.2 - pi, -0.6, 0.7 - pi], abs=1e-12)


@pytest.mark.parametrize(("joint", "beyond"), [(0, 0.2), (2, -0.3), (4, 0.25)])
def test_with_all_solutions_beyond_the_limits_the_limiting_joint_is_named(
    joint: int, beyond: float, assistive: ArmModel
) -> None:
    model = narrow(assistive, Q)
    moved = [*Q[:joint], Q[joint] + beyond, *Q[joint + 1 :]]
    answer = InverseKinematics(model).solve_near(forward(model, moved), Q)
    limit = Q[joint] + (0.1 if beyond > 0 else -0.1)
    assert (answer.q, answer.limited, answer.out_of_reach) == (None, joint, 0.0)
    assert answer.reason == (
        f"joint limit: joint{joint + 1} would have to be at {moved[joint]:.6g} rad, beyond its limit of {limit:.6g} rad"
    )


def test_round_off_does_not_exceed_a_limit(assistive: ArmModel) -> None:
    solver = InverseKinematics(assistive)
    limit = assistive.limits[2].upper
    for q in arms.random_configurations(assistive, 200).tolist():
        q[2] = limit
        nearest = solver.solve_near(forward(assistive, q), q).q
        assert nearest[2] <= limit


def test_at_a_wrist_singularity_joint_4_stays_and_joint_6_takes_the_rotation(assistive: ArmModel) -> None:
    near = [0.3, 0.4, 0.5, 0.6, 0.0, 0.7]
    answer = InverseKinematics(assistive).solve_near(forward(assistive, [*near[:5], 0.9]), near)
    assert answer.q == pytest.approx([*near[:5], 0.9], abs=1e-12)
    assert answer.singularity == Singularity.WRIST


@pytest.mark.parametrize("rotation", [0.5, -0.5])
def test_at_a_wrist_singularity_joint_4_helps_when_joint_6_is_at_its_limit(
    rotation: float, assistive: ArmModel
) -> None:
    at_limit = 3.05 * np.sign(rotation)
    near = [0.3, 0.4, 0.5, 0.6, 0.0, at_limit]
    pose = forward(assistive, [*near[:5], at_limit + rotation])
    q = InverseKinematics(assistive).solve_near(pose, near).q
    assert q[5] == 3.1 * np.sign(rotation)
    assert largest(q, near) < 0.5
    assert forward(assistive, q).rotation == pytest.approx(pose.rotation, abs=1e-12)


def test_the_answer_consists_of_plain_floats_and_does_not_depend_on_earlier_calls(either: ArmModel) -> None:
    solver = InverseKinematics(either)
    pairs = arms.random_configurations(either, 40).reshape(20, 2, 6).tolist()
    questions = [(forward(either, q), near) for q, near in pairs]
    answers = [solver.solve_near(*question) for question in questions]
    assert [solver.solve_near(*question) for question in reversed(questions)] == answers[::-1]
    assert {type(angle) for answer in answers for angle in answer.q} == {float}


EVEN = np.linspace(-0.3, 0.3, arms.count(301, 601))
# A move that brakes at zero and leaves it again, in steps of every size down to round-off
_SCALES = 10.0 ** np.linspace(-13.0, -0.8, arms.count(200, 400))
BRAKING = np.concatenate([-_SCALES[::-1], [0.0], _SCALES])


def wrist_centre(model: ArmModel, q: Sequence[float]) -> np.ndarray:
    pose = forward(model, q)
    return np.subtract(pose.position, np.multiply(model.rows[5].d, pose.rotation[2::3]))


def above_axis_1(model: ArmModel, q: list[float]) -> list[float]:
    """With joint 2 moved so that the wrist centre is on axis 1."""
    at_zero, at_quarter = (wrist_centre(model, [0.0, lean, *q[2:]])[0] for lean in (0.0, pi / 2))
    lean = atan2(-at_zero, at_quarter)
    return [q[0], lean if abs(lean) < pi / 2 else lean - np.copysign(pi, lean), *q[2:]]


SINGULAR = {
    "wrist": lambda model: [0.3, 0.4, 0.5, 0.6, 0.0, 0.2],
    "workspace edge": lambda model: [0.3, 0.4, arms.stretched(model), 0.6, 0.7, 0.2],
    "shoulder": lambda model: above_axis_1(model, [0.2, 0.0, 0.9, 0.7, 0.6, -0.4]),
    "wrist and workspace edge": lambda model: [0.2, 0.5, arms.stretched(model), 0.7, 0.0, -0.4],
    "wrist and shoulder": lambda model: above_axis_1(model, [0.2, 0.0, 0.9, 0.7, 0.0, -0.4]),
    "workspace edge and shoulder": lambda model: above_axis_1(model, [0.2, 0.0, arms.stretched(model), 0.7, 0.6, -0.4]),
    "all three": lambda model: above_axis_1(model, [0.2, 0.0, arms.stretched(model), 0.7, 0.0, -0.4]),
    "all three, straight up": lambda model: above_axis_1(model, [0.0, 0.0, arms.stretched(model), 0.0, 0.0, 0.0]),
}


def track(model: ArmModel, poses: Iterable[Pose], start: Sequence[float]) -> np.ndarray:
    """The path of `solve_near` when each call starts from the last answer."""
    solver = InverseKinematics(model)
    path = [tuple(start)]
    for pose in poses:
        near = solver.solve_near(pose, path[-1])
        assert near.q is not None, near.reason
        path.append(near.q)
    return np.array(path)


def steps(path: np.ndarray) -> np.ndarray:
    """The largest move of a joint in each step, rad."""
    return np.abs(np.diff(path, axis=0)).max(axis=1)


@pytest.mark.parametrize("profile", [EVEN, BRAKING], ids=["even steps", "braking"])
@pytest.mark.parametrize("place", SINGULAR)
def test_a_joint_path_through_a_singularity_is_tracked_without_a_jump(
    place: str, profile: np.ndarray, either: ArmModel
) -> None:
    for seed in range(arms.count(1, 6)):
        path = np.array(SINGULAR[place](either)) + profile[:, None] * np.random.default_rng(seed).uniform(-1, 1, 6)
        matrices = arms.chain(either, path)
        tracked = track(either, map(arms.as_pose, matrices[1:]), path[0])
        assert np.max(arms.pose_errors(matrices, arms.chain(either, tracked))) < 1e-9
        # At the edge the elbow may bend to the other side: another path, but not a jump.
        assert (steps(tracked) < 4.0 * steps(path) + 1e-3).all()
        if place in ("wrist", "shoulder") and profile is EVEN:
            assert np.abs(tracked - path)[np.abs(EVEN) > 0.01].max() < 1e-6


@pytest.mark.parametrize("joint", range(6))
def test_a_single_joint_through_straight_up_is_tracked_exactly(joint: int, assistive: ArmModel) -> None:
    path = np.zeros((len(EVEN), 6))
    path[:, joint] = EVEN
    tracked = track(assistive, map(arms.as_pose, arms.chain(assistive, path)[1:]), path[0])
    # Joints 1, 4 and 6 rotate about one axis here: only their sum is visible in the pose.
    assert np.abs(tracked[:, [1, 2, 4]] - path[:, [1, 2, 4]]).max() < 1e-6
    assert np.abs(tracked[:, [0, 3, 5]].sum(axis=1) - path[:, [0, 3, 5]].sum(axis=1)).max() < 1e-6
    assert (steps(tracked) < 1.001 * (EVEN[1] - EVEN[0])).all()


def radial(model: ArmModel, radius: float) -> Pose:
    """The wrist centre at a distance from axis 2, forward and up, the tool in the same direction but rolled."""
    orientation = Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.0, 0.9, 0.0)
    centre = (
        Pose.from_xyzrpy(0.0, 0.0, model.rows[0].d, 0.0, 0.0, 0.0)
        @ orientation
        @ Pose.from_xyzrpy(0, 0, radius, 0, 0, 0)
    )
    return centre @ Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.7, 0.2, 0.4) @ Pose.from_xyzrpy(0, 0, model.rows[5].d, 0, 0, 0)


def test_a_line_to_the_edge_of_the_workspace_and_back_is_tracked_without_a_jump(either: ArmModel) -> None:
    longest = either.rows[2].a + np.hypot(either.rows[3].a, either.rows[3].d)
    # The bend is proportional to the square root of the remaining distance: it moves evenly when the tool brakes.
    poses = [radial(either, longest - 0.5 * share * share) for share in np.linspace(-0.3, 0.3, 601)]
    start = InverseKinematics(either).solve_near(poses[0], [0.0] * 6).q
    tracked = track(either, poses[1:], start)
    assert steps(tracked).max() < 0.01
    assert tracked[300, 2] == pytest.approx(arms.stretched(either), abs=1e-6)


def test_a_line_across_axis_1_is_tracked_without_a_jump(either: ArmModel) -> None:
    hand = Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.3, 0.2, 0.1) @ Pose.from_xyzrpy(0.0, 0.0, either.rows[5].d, 0.0, 0.0, 0.0)
    height = either.rows[0].d + 0.45
    poses = [Pose.from_xyzrpy(x, 0.0, height, 0.0, 0.0, 0.0) @ hand for x in np.linspace(0.2, -0.2, 801)]
    start = InverseKinematics(either).solve_near(poses[0], [0.0, 0.3, 0.3, 0.0, 0.3, 0.0]).q
    assert steps(track(either, poses[1:], start)).max() < 0.01
