"""Against EAIK, an analytic solver that no one here wrote: the same solutions for the same poses."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from kinematics.forward import frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose

eaik = pytest.importorskip("eaik.IK_Homogeneous")

POSES = 2000


def with_offsets(model: ArmModel) -> ArmModel:
    """As a PUMA with a shoulder offset, and a tool."""
    rows = list(model.rows)
    rows[1] = replace(rows[1], a=0.08)
    rows[2] = replace(rows[2], d=0.12)
    return replace(model, rows=tuple(rows), tool=Pose.from_xyzrpy(0.03, -0.02, 0.11, 0.4, -1.2, 2.1))


def oracle(model: ArmModel):
    """EAIK's robot from the frames of the arm with all joints at zero."""
    zero = []
    for position, rotation in frames(model, [0.0] * 6):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.reshape(rotation, (3, 3)), position
        zero.append(matrix)
    return eaik.HomogeneousRobot(np.array(zero))


def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N, M): the largest difference of a joint between each of N and each of M configurations, turns aside."""
    return np.abs(np.remainder(one[:, None] - other[None] + pi, 2 * pi) - pi).max(axis=2)


@pytest.mark.parametrize("change", [lambda model: model, with_offsets], ids=["as it is", "with offsets and tool"])
def test_eaik_finds_the_same_solutions(change, either, chain, as_pose, random_configurations):
    model = change(either)
    solver, other = InverseKinematics(model), oracle(model)
    configurations = random_configurations(model, POSES, seed=7)
    compared = 0
    for matrix in chain(model, configurations):
        ours = np.array([solution.q for solution in solver.solve(as_pose(matrix)).solutions])
        answer = other.IK(matrix)
        theirs = np.array([q for q, is_approximate in zip(answer.Q, answer.is_LS, strict=True) if not is_approximate])
        distance = apart(ours, theirs)
        assert len(ours) == len(theirs)
        assert max(distance.min(axis=0).max(), distance.min(axis=1).max()) < 1e-9
        compared += len(theirs)
    assert compared > 4 * POSES
