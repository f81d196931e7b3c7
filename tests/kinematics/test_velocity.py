"""Joint velocities for tool velocities, beside singularities and away from them."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from kinematics.jacobian import THRESHOLD, characteristic_length, jacobian, joint_velocity
from kinematics.model import ArmModel

REGULAR = [0.3, -0.4, 1.1, 0.4, 0.8, 0.2]
WRIST, ELBOW = [0.3, -0.4, 1.1, 0.4, 0.0, 0.2], [0.3, -0.4, 0.0, 0.4, 0.8, 0.2]
SHOULDER = [0.7, math.atan2(0.550 * math.sin(1.3), 0.440 + 0.550 * math.cos(1.3)), 1.3, 0.4, 0.8, 0.2]
UP = [0.0] * 6
TWIST = [0.05, -0.02, 0.03, 0.1, 0.2, -0.1]


def cases(model: ArmModel, count: int) -> list[tuple[list[float], list[float]]]:
    numbers = random.Random(3)
    return [
        (
            [numbers.uniform(limit.lower, limit.upper) for limit in model.limits],
            [numbers.gauss(0.0, size) for size in (0.1, 0.1, 0.1, 0.3, 0.3, 0.3)],
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("arm", ["assistive", "irb120"])
def test_away_from_singularities_the_tool_moves_exactly_as_wanted(arm, request):
    model = request.getfixturevalue(arm)
    regular = 0
    for q, twist in cases(model, 500):
        result = joint_velocity(model, q, twist, respect_limits=False)
        if result.damping == 0.0:
            regular += 1
            assert np.array(jacobian(model, q)) @ result.qd == pytest.approx(twist, abs=1e-9)
            assert result.lost == pytest.approx([0.0] * 6, abs=1e-9)
    assert regular > 300


def test_what_is_lost_is_the_wanted_minus_the_achieved_velocity(assistive):
    for q in (WRIST, ELBOW, SHOULDER, UP, REGULAR):
        for respect in (True, False):
            qd, lost, _, _ = joint_velocity(assistive, q, TWIST, respect_limits=respect)
            assert lost == pytest.approx(TWIST - np.array(jacobian(assistive, q)) @ qd, abs=1e-15)


@pytest.mark.parametrize("q", [WRIST, ELBOW, SHOULDER, UP])
def test_on_a_singularity_the_damping_is_full_and_the_loss_is_reported(q, assistive):
    result = joint_velocity(assistive, q, TWIST, respect_limits=False)
    assert result.damping == pytest.approx(THRESHOLD)
    assert math.hypot(*result.lost) > 0.001


@pytest.mark.parametrize("arm", ["assistive", "irb120"])
def test_the_joint_speed_is_bounded_everywhere(arm, request):
    model = request.getfixturevalue(arm)
    length = characteristic_length(model)
    extreme = [(q, twist) for q in (WRIST, ELBOW, SHOULDER, UP) for _, twist in cases(model, 20)]
    beside = [([angle + 1e-3 * k for angle in q], twist) for k, (q, twist) in enumerate(extreme)]
    for q, twist in [*cases(model, 300), *extreme, *beside]:
        size = math.hypot(*(value / length for value in twist[:3]), *twist[3:])
        qd = joint_velocity(model, q, twist, respect_limits=False).qd
        assert math.hypot(*qd) <= size / THRESHOLD * (1.0 + 1e-9)


def test_the_damping_grows_towards_the_singularity(assistive):
    dampings = [
        joint_velocity(assistive, [*REGULAR[:4], angle, 0.2], TWIST).damping for angle in (0.5, 0.05, 0.02, 0.01, 0.0)
    ]
    assert dampings[0] == 0.0
    assert dampings == sorted(set(dampings))


@pytest.mark.parametrize(("q", "joint"), [(WRIST, 4), (ELBOW, 2), (SHOULDER, 1)])
def test_the_joint_velocity_has_no_jump_on_the_way_through_a_singularity(q, joint, assistive):
    step = 1e-4
    previous = None
    dampings = set()
    for k in range(-4000, 4001):
        here = list(q)
        here[joint] += k * step
        qd, _, damping, _ = joint_velocity(assistive, here, TWIST, respect_limits=False)
        dampings.add(damping > 0.0)
        if previous is not None:
            # Bound of the slope: |qd| / threshold for each rad, times the largest derivative of the Jacobian (about 3).
            assert max(abs(a - b) for a, b in zip(qd, previous, strict=True)) < 0.05
        previous = qd
    assert dampings == {True, False}


@pytest.mark.parametrize("factor", [20.0, -20.0])
def test_a_speed_limit_slows_the_tool_down_without_turning_it(factor, assistive):
    fast = [factor * value for value in TWIST]
    result = joint_velocity(assistive, REGULAR, fast)
    assert 0.0 < result.scale < 1.0
    assert max(abs(speed) for speed in result.qd) == pytest.approx(0.5)
    assert np.array(jacobian(assistive, REGULAR)) @ result.qd == pytest.approx(np.multiply(result.scale, fast))
    assert result.lost == pytest.approx(np.multiply(1.0 - result.scale, fast))


def test_the_joint_nearest_to_its_own_limit_decides(assistive):
    free = joint_velocity(assistive, REGULAR, TWIST)
    assert free.scale == 1.0
    limits = list(assistive.limits)
    for joint, part in ((1, 0.9), (4, 0.25), (5, 0.6)):
        limits[joint] = replace(limits[joint], velocity=part * abs(free.qd[joint]))
    result = joint_velocity(replace(assistive, limits=tuple(limits)), REGULAR, TWIST)
    assert result.scale == pytest.approx(0.25)
    assert result.qd == pytest.approx([0.25 * speed for speed in free.qd])


def test_without_respect_for_limits_nothing_is_scaled(assistive):
    result = joint_velocity(assistive, REGULAR, [20.0 * value for value in TWIST], respect_limits=False)
    assert result.scale == 1.0
    assert max(abs(speed) for speed in result.qd) > 0.5


def test_no_wanted_velocity_moves_nothing(assistive):
    for q in (REGULAR, UP):
        assert joint_velocity(assistive, q, [0.0] * 6).qd == pytest.approx([0.0] * 6, abs=0.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_value_that_is_not_finite_is_named(bad, assistive):
    with pytest.raises(ValueError, match="wy"):
        joint_velocity(assistive, REGULAR, [*TWIST[:4], bad, 0.0])
    with pytest.raises(ValueError, match="joint3"):
        joint_velocity(assistive, [0.1, 0.1, bad, 0.1, 0.1, 0.1], TWIST)


@pytest.mark.parametrize("threshold", [0.0, -0.1, math.nan])
def test_a_threshold_that_would_not_bound_the_speed_is_refused(threshold, assistive):
    with pytest.raises(ValueError, match="threshold"):
        joint_velocity(assistive, REGULAR, TWIST, threshold=threshold)
