"""Polynomials between waypoints, their extremes, the spline through points, and turns between orientations."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics.pose import Rotation
from rtcp.motion.planning import interpolation
from tests.samples import examples

NUMBER = st.floats(-10.0, 10.0)


@given(NUMBER, NUMBER, NUMBER, NUMBER, st.floats(0.01, 20.0))
def test_a_cubic_has_what_is_asked_for_at_both_ends(q0: float, v0: float, q1: float, v1: float, t: float) -> None:
    c = interpolation.cubic(q0, v0, q1, v1, t)
    speed = interpolation.derivative(c)
    assert [interpolation.value(c, 0.0), interpolation.value(c, 1.0)] == pytest.approx([q0, q1], abs=1e-9)
    assert [interpolation.value(speed, 0.0) / t, interpolation.value(speed, 1.0) / t] == pytest.approx(
        [v0, v1], abs=1e-7
    )
    assert c[4:] == (0.0, 0.0)


@given(*[NUMBER] * 6, st.floats(0.01, 20.0))
def test_a_quintic_has_what_is_asked_for_at_both_ends(
    q0: float, v0: float, a0: float, q1: float, v1: float, a1: float, t: float
) -> None:
    c = interpolation.quintic(q0, v0, a0, q1, v1, a1, t)
    speed = interpolation.derivative(c)
    rise = interpolation.derivative(speed)
    assert [interpolation.value(c, 0.0), interpolation.value(c, 1.0)] == pytest.approx([q0, q1], abs=1e-8)
    assert [interpolation.value(speed, 0.0) / t, interpolation.value(speed, 1.0) / t] == pytest.approx(
        [v0, v1], abs=1e-6
    )
    assert [interpolation.value(rise, 0.0) / t**2, interpolation.value(rise, 1.0) / t**2] == pytest.approx(
        [a0, a1], abs=1e-4 + 1e-9 / t**2
    )


@settings(max_examples=examples(60))
@given(st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6))
def test_the_extremes_are_those_of_dense_samples(c: list[float]) -> None:
    samples = [interpolation.value(c, k / 2000) for k in range(2001)]
    least, at_least, largest, at_largest = interpolation.extremes(c)
    size = max(map(abs, c)) + 1.0
    # Between two samples a curve of this size rises by little: c'' is at most 54 sizes.
    between = 54 * size * (0.5 / 2000) ** 2 / 2
    assert min(samples) - between <= least <= min(samples) + 1e-12 * size
    assert max(samples) - 1e-12 * size <= largest <= max(samples) + between
    assert interpolation.value(c, at_least) == pytest.approx(least, abs=1e-9 * size)
    assert interpolation.value(c, at_largest) == pytest.approx(largest, abs=1e-9 * size)


@settings(max_examples=examples(60))
@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.floats(0.5, 6.0))
def test_what_lies_beyond_a_bound_is_found_whenever_a_sample_does(c: list[float], bound: float) -> None:
    samples = [interpolation.value(c, k / 500) for k in range(501)]
    extreme = interpolation.beyond(c, -bound, bound)
    if max(map(abs, samples)) > bound + 1e-9:
        assert extreme is not None
    if extreme is not None:
        assert abs(extreme[0]) > bound
        assert interpolation.value(c, extreme[1]) == pytest.approx(extreme[0], abs=1e-9)


def test_an_extreme_in_the_middle_of_a_piece_is_seen_to_the_last_digit() -> None:
    # x^2 (1 - x)^2 is 1/16 half way.
    c = [0.0, 0.0, 1.0, -2.0, 1.0, 0.0]
    assert interpolation.extremes(c)[2:] == pytest.approx((1 / 16, 0.5), abs=1e-14)
    assert interpolation.beyond(c, -1.0, 1 / 16 - 1e-12) is not None
    assert interpolation.beyond(c, -1.0, 1 / 16 + 1e-12) is None


def test_a_flat_extreme_is_found_too() -> None:
    # (x - 1/2)^4: all derivatives but the fourth vanish where it is least.
    assert interpolation.extremes([0.0625, -0.5, 1.5, -2.0, 1.0, 0.0])[:2] == pytest.approx((0.0, 0.5), abs=1e-12)


def test_a_spline_is_twice_differentiable_and_at_rest_at_its_ends() -> None:
    chance = random.Random(3)
    times, values = [0.0, 0.7, 1.1, 2.5, 3.0], [chance.uniform(-1.0, 1.0) for _ in range(5)]
    v = interpolation.spline_velocities(times, values)
    a = interpolation.spline_accelerations(times, values, v)
    assert (v[0], v[-1], a[0], a[-1]) == (0.0, 0.0, 0.0, 0.0)
    for i in range(1, 4):
        h = times[i] - times[i - 1]
        # From the left, by the end of the cubic; from the right by the function.
        left = (-6.0 * (values[i] - values[i - 1]) / h + 2.0 * v[i - 1] + 4.0 * v[i]) / h
        assert a[i] == pytest.approx(left)


def rotated(axis: tuple[float, float, float], angle: float) -> Rotation:
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return interpolation.turned_by(identity, axis, angle)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0, math.pi - 1e-7, math.pi])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
def test_a_turn_goes_the_short_way_and_comes_to_its_end(axis: tuple[float, float, float], angle: float) -> None:
    start = rotated((0.0, 0.6, 0.8), 0.7)
    end = interpolation.turned_by(start, axis, angle)
    about, turned = interpolation.turn_between(interpolation.quaternion(start), interpolation.quaternion(end))
    assert turned == pytest.approx(angle, abs=1e-7)
    assert interpolation.turned_by(start, about, turned) == pytest.approx(end, abs=1e-7)
    steps = [interpolation.quaternion(interpolation.turned_by(start, about, turned * k / 10)) for k in range(11)]
    for before, after in pairwise(steps):
        assert interpolation.turn_between(before, after)[1] == pytest.approx(angle / 10, abs=1e-7)


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: math.hypot(*q) > 0.1))
def test_a_quaternion_comes_back_from_its_rotation(q: list[float]) -> None:
    size = math.copysign(math.hypot(*q), q[0])
    same = interpolation.quaternion(interpolation.rotation(q))
    assert math.hypot(*same) == pytest.approx(1.0)
    unit = [c / size for c in q]
    difference = max(abs(a - b) for a, b in zip(unit, same, strict=True))
    opposite = max(abs(a + b) for a, b in zip(unit, same, strict=True))
    assert min(difference, opposite) < 1e-7
