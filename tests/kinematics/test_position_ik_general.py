"""Roots of polynomials and of trigonometric equations with known roots: none is missing."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinematics.position_ik_general import product, real_roots, solve_linear, solve_quadratic

numbers = st.integers(-2000, 2000).map(lambda thousandths: thousandths / 1000.0)
angles = st.floats(-pi, pi)


@given(st.lists(numbers, min_size=1, max_size=4, unique=True), st.sampled_from([-3.0, 0.01, 1.0]))
def test_all_real_roots_are_found(roots: list[float], factor: float) -> None:
    computed = real_roots((factor * np.poly(roots)).tolist(), 1e-7)
    assert len(computed) >= len(roots)
    assert all(min(abs(value - root) for value in computed) < 1e-3 for root in roots)
    assert computed == sorted(computed)


@given(numbers, numbers, st.integers(1, 2000).map(lambda thousandths: thousandths / 1000.0))
def test_complex_roots_are_left_out(real: float, middle: float, height: float) -> None:
    quartic = np.polymul(np.poly([real, real + 1.0]), [1.0, -2.0 * middle, middle * middle + height * height])
    computed = real_roots(quartic.tolist(), 0.0)
    assert computed == pytest.approx([real, real + 1.0], abs=1e-5)


@pytest.mark.parametrize("gap", [0.0, 1e-12, -1e-12])
def test_a_double_root_is_found_despite_round_off(gap: float) -> None:
    quartic = np.polymul(np.poly([2.0, -1.0]), [1.0, -0.6, 0.09 + gap]).tolist()
    assert min(abs(root - 0.3) for root in real_roots(quartic, 1e-7)) < 1e-5


@given(angles, st.floats(-0.999, 0.999), st.floats(0.1, 3.0))
def test_a_linear_equation_has_both_its_roots(phase: float, level: float, size: float) -> None:
    form = (-level * size, size * cos(phase), size * sin(phase))
    roots = solve_linear(form)
    assert [form[0] + form[1] * cos(x) + form[2] * sin(x) for x in roots] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert roots[0] != roots[1]


@pytest.mark.parametrize("level", [1.01, -1.01, 5.0])
def test_a_linear_equation_beyond_its_amplitude_has_no_roots(level: float) -> None:
    assert solve_linear((level, 0.6, 0.8)) == []


def test_an_equation_of_zeros_has_no_roots() -> None:
    assert solve_linear((0.0, 0.0, 0.0)) == []
    assert solve_quadratic((0.0,) * 5) == []


def through(first: float, second: float) -> tuple[float, float, float]:
    """A linear form that is zero at two angles."""
    middle, half = 0.5 * (first + second), 0.5 * (first - second)
    return -cos(half), cos(middle), sin(middle)


@given(st.lists(st.integers(-31, 31).map(lambda tenths: tenths / 10.0), min_size=4, max_size=4, unique=True))
def test_a_quadratic_equation_has_all_its_four_roots(roots: list[float]) -> None:
    computed = solve_quadratic(product(through(*roots[:2]), through(*roots[2:])))
    for root in roots:
        assert min(abs(np.remainder(value - root + pi, 2 * pi) - pi) for value in computed) < 1e-7


@pytest.mark.parametrize("root", [pi, -pi, 0.75 * pi, 0.0])
def test_a_root_where_the_tangent_of_the_half_angle_is_infinite_is_found(root: float) -> None:
    computed = solve_quadratic(product(through(root, 1.0), (2.0, 0.3, -0.4)))
    assert len(computed) == 2
    assert min(abs(np.remainder(value - root + pi, 2 * pi) - pi) for value in computed) < 1e-12


def test_a_form_without_its_higher_terms_is_solved() -> None:
    computed = solve_quadratic((0.0, 0.0, 1.0, 0.0, 0.0))  # sin x = 0
    assert sorted(abs(np.remainder(root + 0.5 * pi, 2 * pi) - 0.5 * pi) for root in computed) == pytest.approx(
        [0.0, pi]
    )
