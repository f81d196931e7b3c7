"""Poses, and the three angles of a rotation."""

from __future__ import annotations

from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinematics.pose import Pose, orthonormality_error, rotation_from_rpy, rpy_from_rotation
from tests.kinematics.arms import matrix

angles = st.floats(-pi, pi)
beside_a_right_angle = st.builds(
    lambda side, exponent: side * (pi / 2 - 10**exponent), st.sampled_from([-1, 1]), st.floats(-12, -5)
)
lengths = st.floats(-2.0, 2.0)
poses = st.builds(Pose.from_xyzrpy, lengths, lengths, lengths, angles, angles, angles)


def about(axis: int, angle: float) -> np.ndarray:
    s, c = np.sin(angle), np.cos(angle)
    rotation = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation[i, i] = rotation[j, j] = c
    rotation[j, i], rotation[i, j] = s, -s
    return rotation


@given(angles, angles, angles)
def test_the_rotation_is_rx_ry_rz_in_this_order(rx: float, ry: float, rz: float) -> None:
    assert np.reshape(rotation_from_rpy(rx, ry, rz), (3, 3)) == pytest.approx(
        about(0, rx) @ about(1, ry) @ about(2, rz), abs=1e-15
    )


@given(angles, st.floats(-1.5, 1.5), angles)
def test_angles_away_from_the_singular_orientations_are_recovered(rx: float, ry: float, rz: float) -> None:
    recovered = rpy_from_rotation(rotation_from_rpy(rx, ry, rz))
    error = [abs(np.remainder(a - b + pi, 2 * pi) - pi) for a, b in zip(recovered, (rx, ry, rz), strict=True)]
    assert max(error) < 1e-13


@given(angles, angles | beside_a_right_angle, angles)
def test_the_angles_of_a_rotation_reproduce_it_also_beside_a_singular_one(rx: float, ry: float, rz: float) -> None:
    rotation = rotation_from_rpy(rx, ry, rz)
    assert rotation_from_rpy(*rpy_from_rotation(rotation)) == pytest.approx(rotation, abs=1e-14)


@pytest.mark.parametrize("side", [-1, 1])
def test_in_a_singular_orientation_rz_is_zero_and_rx_is_the_whole_angle(side: float) -> None:
    rx, ry, rz = rpy_from_rotation(rotation_from_rpy(0.4, side * pi / 2, 0.9))
    assert (rx, ry, rz) == (pytest.approx(0.4 + side * 0.9, abs=1e-15), pytest.approx(side * pi / 2), 0.0)


@given(poses, poses)
def test_poses_compose_as_their_matrices_do(one: Pose, other: Pose) -> None:
    assert matrix(one @ other) == pytest.approx(matrix(one) @ matrix(other), abs=1e-14)


@given(poses)
def test_a_pose_times_its_inverse_is_the_identity(pose: Pose) -> None:
    assert matrix(pose @ pose.inverse()) == pytest.approx(np.eye(4), abs=1e-14)
    assert matrix(pose.inverse() @ pose) == pytest.approx(np.eye(4), abs=1e-14)


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_a_value_that_is_not_finite_is_refused_by_name(index: int, value: float) -> None:
    numbers = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    numbers[index] = value
    with pytest.raises(ValueError, match=f"^{('x', 'y', 'z', 'rx', 'ry', 'rz')[index]} is {value}"):
        Pose.from_xyzrpy(*numbers)


@pytest.mark.parametrize("index", range(9))
def test_a_change_of_any_entry_is_an_orthonormality_error(index: int) -> None:
    rotation = np.array(rotation_from_rpy(0.3, 0.5, 0.7))
    rotation[index] += 1e-3
    assert orthonormality_error(tuple(rotation.tolist())) > 1e-4
