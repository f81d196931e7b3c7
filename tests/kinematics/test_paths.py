"""Continuous paths through singularities: `solve_near`, given its last answer, follows without a jump."""

from __future__ import annotations

from math import atan2, pi

import numpy as np
import pytest

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose

STRAIGHT_UP = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
EVEN = np.linspace(-0.3, 0.3, 601)
# As a move that brakes: towards zero and away from it in ever smaller steps, through every scale of round-off
BRAKING = np.concatenate([-(10.0 ** np.linspace(-0.8, -13.0, 400)), [0.0], 10.0 ** np.linspace(-13.0, -0.8, 400)])


def stretched(model: ArmModel) -> float:
    """Joint 3 with the elbow straight."""
    return -model.rows[2].offset - atan2(-np.sin(model.rows[3].alpha) * model.rows[3].d, model.rows[3].a)


def wrist_centre(model: ArmModel, q) -> np.ndarray:
    pose = forward(model, q)
    return np.subtract(pose.position, np.multiply(model.rows[5].d, pose.rotation[2::3]))


def above_axis_1(model: ArmModel, q: list[float]) -> list[float]:
    """With joint 2 turned so that the wrist centre is on axis 1."""
    at_zero, at_quarter = (wrist_centre(model, [0.0, lean, *q[2:]])[0] for lean in (0.0, pi / 2))
    lean = atan2(-at_zero, at_quarter)
    return [q[0], lean if abs(lean) < pi / 2 else lean - np.copysign(pi, lean), *q[2:]]


CENTRES = {
    "wrist": lambda model: [0.3, 0.4, 0.5, 0.6, 0.0, 0.2],
    "workspace edge": lambda model: [0.3, 0.4, stretched(model), 0.6, 0.7, 0.2],
    "shoulder": lambda model: above_axis_1(model, [0.2, 0.0, 0.9, 0.7, 0.6, -0.4]),
    "wrist and workspace edge": lambda model: [0.2, 0.5, stretched(model), 0.7, 0.0, -0.4],
    "wrist and shoulder": lambda model: above_axis_1(model, [0.2, 0.0, 0.9, 0.7, 0.0, -0.4]),
    "workspace edge and shoulder": lambda model: above_axis_1(model, [0.2, 0.0, stretched(model), 0.7, 0.6, -0.4]),
    "all three": lambda model: above_axis_1(model, [0.2, 0.0, stretched(model), 0.7, 0.0, -0.4]),
}


def follow(model: ArmModel, poses, start) -> np.ndarray:
    solver = InverseKinematics(model)
    followed = [tuple(start)]
    for pose in poses:
        near = solver.solve_near(pose, followed[-1])
        assert near.q is not None, near.reason
        followed.append(near.q)
    return np.array(followed)


def steps(path: np.ndarray) -> np.ndarray:
    """The largest move of a joint in each step, rad."""
    return np.abs(np.diff(path, axis=0)).max(axis=1)


def assert_reached(followed: np.ndarray, matrices: np.ndarray, model: ArmModel, chain, pose_errors) -> None:
    position, rotation = pose_errors(matrices, chain(model, followed))
    assert max(position.max(), rotation.max()) < 1e-9


@pytest.mark.parametrize("shares", [EVEN, BRAKING], ids=["even steps", "braking"])
@pytest.mark.parametrize("place", CENTRES)
def test_a_joint_path_through_a_singularity_is_followed_without_a_jump(
    place, shares, either, chain, pose_errors, as_pose
):
    centre = np.array(CENTRES[place](either))
    for seed in range(6):
        direction = np.random.default_rng(seed).uniform(-1.0, 1.0, 6)
        path = centre + shares[:, None] * direction
        matrices = chain(either, path)
        followed = follow(either, map(as_pose, matrices[1:]), path[0])
        assert_reached(followed, matrices, either, chain, pose_errors)
        # Through the edge the arm may come back bent to the other side: not the same path, and not a jump
        assert (steps(followed) < 4.0 * steps(path) + 1e-3).all()


@pytest.mark.parametrize("shares", [EVEN, BRAKING], ids=["even steps", "braking"])
def test_a_joint_path_through_straight_up_is_followed_without_a_jump(shares, assistive, chain, pose_errors, as_pose):
    for seed in range(10):
        path = np.array(STRAIGHT_UP) + shares[:, None] * np.random.default_rng(seed).uniform(-1.0, 1.0, 6)
        matrices = chain(assistive, path)
        followed = follow(assistive, map(as_pose, matrices[1:]), path[0])
        assert_reached(followed, matrices, assistive, chain, pose_errors)
        assert (steps(followed) < 4.0 * steps(path) + 1e-3).all()
        assert followed[np.flatnonzero(shares == 0.0)[0], 1:3] == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("joint", range(6))
def test_one_joint_that_moves_through_straight_up_is_followed_exactly(joint, assistive, as_pose, chain):
    path = np.zeros((601, 6))
    path[:, joint] = EVEN
    followed = follow(assistive, map(as_pose, chain(assistive, path)[1:]), path[0])
    # Joints 1, 4 and 6 turn about one axis here: only their sum is seen in the pose
    same = [joint] if joint in (1, 2, 4) else []
    assert np.abs(followed[:, [1, 2, 4]] - path[:, [1, 2, 4]]).max() < 1e-6
    assert np.abs(followed[:, same] - path[:, same]).max(initial=0.0) < 1e-6
    assert np.abs(followed[:, [0, 3, 5]].sum(axis=1) - path[:, [0, 3, 5]].sum(axis=1)).max() < 1e-6
    assert (steps(followed) < 1.001e-3).all()


@pytest.mark.parametrize("place", ["wrist", "shoulder"])
def test_after_a_single_singularity_the_branch_is_the_one_from_before(place, either, chain, as_pose):
    centre = np.array(CENTRES[place](either))
    for seed in range(6):
        path = centre + EVEN[:, None] * np.random.default_rng(seed).uniform(-1.0, 1.0, 6)
        followed = follow(either, map(as_pose, chain(either, path)[1:]), path[0])
        away = np.abs(EVEN) > 0.01
        assert np.abs(followed - path)[away].max() < 1e-6


def radial(model: ArmModel, radius: float) -> Pose:
    """The wrist centre at a distance from axis 2, forward and up, the tool in the same direction but rolled."""
    turn = Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.0, 0.9, 0.0)
    centre = Pose.from_xyzrpy(0.0, 0.0, model.rows[0].d, 0.0, 0.0, 0.0) @ turn @ Pose.from_xyzrpy(0, 0, radius, 0, 0, 0)
    return centre @ Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.7, 0.2, 0.4) @ Pose.from_xyzrpy(0, 0, model.rows[5].d, 0, 0, 0)


def test_a_straight_line_to_the_edge_of_the_workspace_and_back_is_followed_without_a_jump(either):
    longest = either.rows[2].a + np.hypot(either.rows[3].a, either.rows[3].d)
    # The bend of the elbow goes with the root of what is left: it moves evenly when the tool brakes so
    poses = [radial(either, longest - 0.5 * share * share) for share in EVEN]
    start = InverseKinematics(either).solve_near(poses[0], [0.0] * 6).q
    followed = follow(either, poses[1:], start)
    assert steps(followed).max() < 0.01
    assert followed[300, 2] == pytest.approx(stretched(either), abs=1e-6)


def test_a_straight_line_over_axis_1_is_followed_without_a_jump(either):
    hand = Pose.from_xyzrpy(0.0, 0.0, 0.0, 0.3, 0.2, 0.1) @ Pose.from_xyzrpy(0.0, 0.0, either.rows[5].d, 0.0, 0.0, 0.0)
    height = either.rows[0].d + 0.45
    poses = [Pose.from_xyzrpy(x, 0.0, height, 0.0, 0.0, 0.0) @ hand for x in np.linspace(0.2, -0.2, 801)]
    start = InverseKinematics(either).solve_near(poses[0], [0.0, 0.3, 0.3, 0.0, 0.3, 0.0]).q
    followed = follow(either, poses[1:], start)
    assert steps(followed).max() < 0.01


def test_a_joint_path_is_followed_through_turns_beyond_pi(irb120, as_pose, chain):
    path = np.tile([0.3, 0.2, 0.4, 0.5, 0.6, 0.0], (500, 1))
    path[:, 5] = np.linspace(-6.9, 6.9, 500)
    followed = follow(irb120, map(as_pose, chain(irb120, path)[1:]), path[0])
    assert np.abs(followed - path).max() < 1e-12
