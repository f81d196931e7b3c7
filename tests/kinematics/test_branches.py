"""What the names of the branches say, seen in the frames of the arm."""

from __future__ import annotations

from math import sin

import numpy as np
import pytest

from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.solution import BRANCHES, Branch


def seen_from_the_side(model: ArmModel, q) -> tuple[np.ndarray, np.ndarray]:
    """Elbow and wrist centre from axis 2 in the arm's plane: along x of frame 1, and up."""
    _, second, third, _, centre = (np.array(frame.position) for frame in frames(model, q)[:5])
    forward_axis = np.array(frames(model, q)[0].rotation[0::3])
    return tuple(np.array([(point - second) @ forward_axis, (point - second)[2]]) for point in (third, centre))


def name_by_sight(model: ArmModel, q) -> str:
    """For arms without lateral and shoulder offset."""
    elbow, centre = seen_from_the_side(model, q)
    if centre[0] < 0.0:
        elbow, centre = elbow * [-1, 1], centre * [-1, 1]
        shoulder = "back"
    else:
        shoulder = "front"
    height_of_line = centre[1] * elbow[0] / centre[0]
    wrist = "no-flip" if sin(q[4] + model.rows[4].offset) >= 0.0 else "flip"
    return f"{shoulder}/{'up' if elbow[1] > height_of_line else 'down'}/{wrist}"


def test_a_branch_is_written_as_its_three_words():
    assert str(Branch("front", "up", "no-flip")) == "front/up/no-flip"
    assert len(set(map(str, BRANCHES))) == 8


def test_each_of_eight_solutions_has_a_name_of_its_own(either, random_configurations):
    for q in random_configurations(either, 300).tolist():
        solutions = InverseKinematics(either).solve(forward(either, q)).solutions
        assert {solution.branch for solution in solutions} == set(BRANCHES)


def test_the_names_say_what_is_seen_from_the_side(either, random_configurations):
    for q in random_configurations(either, 300).tolist():
        for solution in InverseKinematics(either).solve(forward(either, q)).solutions:
            assert str(solution.branch) == name_by_sight(either, solution.q)


@pytest.mark.parametrize(
    ("q", "name"),
    [
        ([0.0, 0.8, -0.9, 0.0, 0.5, 0.0], "front/up/no-flip"),
        ([0.0, 1.5, 0.9, 0.0, 0.5, 0.0], "front/down/no-flip"),
        ([0.0, -0.8, 0.9, 0.0, -0.5, 0.0], "back/up/flip"),
        ([0.0, -1.5, -0.9, 0.0, 0.5, 0.0], "back/down/no-flip"),
    ],
    ids=["leaning forward", "bent upwards in front", "leaning back", "bent upwards behind"],
)
def test_some_names_of_the_assistive_arm(q, name, assistive):
    # a guard against both this file and the solver changing their mind
    assert name == name_by_sight(assistive, q)
    own = [one for one in InverseKinematics(assistive).solve(forward(assistive, q)).solutions if np.allclose(one.q, q)]
    assert [str(one.branch) for one in own] == [name]


def test_a_name_stays_along_a_motion_that_meets_no_singularity(either):
    start, end = np.array([-1.0, 0.9, -0.6, -0.5, 0.4, -1.0]), np.array([1.0, 0.7, -0.3, 0.8, 1.2, 1.0])
    names = set()
    for share in np.linspace(0.0, 1.0, 50):
        q = ((1.0 - share) * start + share * end).tolist()
        solutions = InverseKinematics(either).solve(forward(either, q)).solutions
        names.add(min(solutions, key=lambda solution: np.abs(np.subtract(solution.q, q)).max()).branch)
    assert len(names) == 1
