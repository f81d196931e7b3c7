"""Six by six linear algebra in plain floats, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from kinematics.linear import determinant, gram, inverse, product, smallest_singular_value, solve_positive

NUMBERS = np.random.default_rng(16)
FULL = [NUMBERS.normal(size=(6, 6)) for _ in range(20)]
# Zeros on the diagonal: without exchanges of rows elimination divides by zero.
SPARSE = [np.eye(6)[NUMBERS.permutation(6)] * NUMBERS.uniform(1.0, 2.0, 6) + np.diag([0.5] * 5, 1) for _ in range(20)]
MATRICES = [matrix for matrix in FULL + SPARSE if np.linalg.cond(matrix) < 1e3]
RIGHT = NUMBERS.normal(size=6)


def test_the_inverse_times_the_matrix_is_one():
    for matrix in MATRICES:
        assert np.array(inverse(matrix.tolist())) @ matrix == pytest.approx(np.eye(6), abs=1e-11)


def test_a_matrix_with_a_column_of_zeros_has_no_inverse():
    matrix = FULL[0].copy()
    matrix[:, 3] = 0.0
    assert inverse(matrix.tolist()) is None
    assert determinant(matrix.tolist()) == 0.0


def test_the_determinant_is_numpys_with_its_sign():
    for matrix in MATRICES:
        assert determinant(matrix.tolist()) == pytest.approx(np.linalg.det(matrix), rel=1e-10)


def test_products_are_numpys():
    for matrix in MATRICES:
        assert product(matrix.tolist(), RIGHT.tolist()) == pytest.approx(matrix @ RIGHT)
        assert np.array(gram(matrix.tolist())) == pytest.approx(matrix @ matrix.T)


@pytest.mark.parametrize("size", [6, 4, 1, 0])
def test_a_positive_definite_system_of_any_size_is_solved(size):
    for matrix in FULL:
        system = (matrix @ matrix.T + 0.1 * np.eye(6))[:size, :size]
        expected = np.linalg.solve(system, RIGHT[:size])
        assert solve_positive(system.tolist(), RIGHT[:size].tolist()) == pytest.approx(expected, rel=1e-8)


def test_a_system_that_is_not_positive_definite_is_refused():
    assert solve_positive([[1.0, 2.0], [2.0, 1.0]], [1.0, 1.0]) is None


def test_the_smallest_singular_value_keeps_its_digits_beside_zero():
    for matrix in FULL:
        left, _, right = np.linalg.svd(matrix)
        for smallest in (1.0, 1e-3, 1e-9):
            scaled = left @ np.diag([5.0, 4.0, 3.0, 2.0, 1.5, smallest]) @ right
            assert smallest_singular_value(scaled.tolist()) == pytest.approx(smallest, abs=1e-14)
    assert smallest_singular_value([[0.0] * 6] * 6) == 0.0
