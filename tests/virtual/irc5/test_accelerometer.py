"""The accelerometer at the flange of a virtual IRB 120."""

from __future__ import annotations

from math import degrees, sin, tau

import pytest

from rtcp.config.find import find_arm
from rtcp.config.loader import load_mechanics
from rtcp.virtual.irc5.accelerometer import Accelerometer
from rtcp.virtual.irc5.geometry import Geometry

PERIOD_S = 0.004032
RADIUS_M = 0.374
"""Radius of the flange about joint 1, all joints at zero."""


@pytest.fixture
def accelerometer() -> Accelerometer:
    rows = load_mechanics(find_arm("abb_irb120")).rows
    return Accelerometer(Geometry([(row.alpha, row.a, row.d, row.offset) for row in rows]), PERIOD_S)


def test_a_sine_of_joint_1_is_felt_along_y_at_its_instant(accelerometer: Accelerometer) -> None:
    rate, amplitude = tau / 2.0, 0.01
    for i in range(500):
        angle = amplitude * sin(rate * i * PERIOD_S)
        accelerometer.sample((degrees(angle), 0, 0, 0, 0, 0), 7.0 + i * PERIOD_S)
    for stamp, _, y, _ in accelerometer.take():
        expected = -RADIUS_M * amplitude * rate**2 * sin(rate * (stamp - 7.0))
        assert y == pytest.approx(expected, abs=1e-4)


def test_a_constant_speed_of_joint_1_is_felt_towards_the_axis(accelerometer: Accelerometer) -> None:
    speed = 2.0
    for i in (-1, 0, 1):
        accelerometer.sample((degrees(speed * i * PERIOD_S), 0, 0, 0, 0, 0), 7.0)
    assert accelerometer.take() == [(7.0, pytest.approx(-RADIUS_M * speed**2, rel=1e-3), pytest.approx(0.0, abs=1e-9),
                                     pytest.approx(0.0, abs=1e-9))]  # fmt: skip


def test_samples_are_given_once(accelerometer: Accelerometer) -> None:
    for i in range(5):
        accelerometer.sample((0.0,) * 6, float(i))
    assert [stamp for stamp, *_ in accelerometer.take()] == [1.0, 2.0, 3.0]
    assert accelerometer.take() == []
