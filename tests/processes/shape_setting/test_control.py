"""PID to ampere, average, gate, ramp."""

from __future__ import annotations

from math import exp

import pytest

from rtcp.processes.shape_setting.control import CurrentControl, Ramp

PERIOD_S = 0.0005


def control(proportional: float = 100.0, integral: float = 0.0, derivative: float = 0.0) -> CurrentControl:
    return CurrentControl(PERIOD_S, 0.01, proportional, integral, derivative)


def test_the_average_is_exponential_with_its_time_constant() -> None:
    pid = control()
    for _ in range(20):
        pid.measure(30.0)
    assert pid.average == pytest.approx(30.0 * (1.0 - exp(-1.0)))


def test_the_gate_is_on_while_the_average_is_below_the_target() -> None:
    pid = control()
    pid.update(1.001, 1.0, 30.0, 100.0)
    assert pid.target == pytest.approx(3.0)
    on = 0
    for _ in range(4000):
        pid.measure(30.0 if pid.gate else 0.0)
        on += pid.gate
    # Each cycle of 30 A adds at most 1.5 A to the average.
    assert 3.0 <= 30.0 * on / 4000 <= 4.5


def test_the_target_is_a_share_of_the_full_current() -> None:
    pid = control()
    pid.update(1.002, 1.0, 8.0, 100.0)
    thin = pid.target
    pid.update(1.002, 1.0, 114.0, 100.0)
    assert pid.target / thin == pytest.approx(114.0 / 8.0)


@pytest.mark.parametrize(("setpoint", "target"), [(1.5, 5.0), (0.5, 0.0)])
def test_limits_hold_the_target(setpoint: float, target: float) -> None:
    pid = control()
    pid.update(setpoint, 1.0, 30.0, 5.0)
    assert pid.target == target
    assert pid.is_limited


def test_the_integral_does_not_wind_up_in_a_limit() -> None:
    pid = control(integral=1000.0)
    for _ in range(1000):
        pid.update(1.1, 1.0, 30.0, 5.0)
    pid.update(1.1, 1.1, 30.0, 5.0)
    assert pid.target == pytest.approx(0.0, abs=1e-9)


def test_the_integral_stands_still_while_the_setpoint_moves() -> None:
    pid, setpoint = control(integral=10.0), 1.0
    for _ in range(100):
        setpoint += 1e-5
        pid.update(setpoint, setpoint - 1e-3, 30.0, 30.0)
    assert pid.target == pytest.approx(3.0)
    for _ in range(100):
        pid.update(setpoint, setpoint - 1e-3, 30.0, 30.0)
    assert pid.target == pytest.approx(3.0 + 30.0 * 10.0 * 1e-3 * 100 * PERIOD_S)


def test_after_a_reset_nothing_of_the_heating_before_remains_but_the_average() -> None:
    used, new = control(integral=10.0, derivative=0.01), control(integral=10.0, derivative=0.01)
    for i in range(100):
        used.measure(30.0)
        new.measure(30.0)
        used.update(1.005, 1.0 + 1e-6 * i, 30.0, 30.0)
    used.update(1.005, 1.0, 30.0, 3.0)
    used.reset()
    assert (used.target, used.is_limited, used.average) == (0.0, False, new.average)
    for ratio in (1.001, 1.001, 1.0011, 1.0013):
        used.update(1.005, ratio, 30.0, 30.0)
        new.update(1.005, ratio, 30.0, 30.0)
        assert used.target == new.target > 0.0


def test_the_derivative_is_of_the_measured_ratio() -> None:
    pid = control(derivative=1.0)
    for _ in range(200):
        pid.update(1.005, 1.0, 30.0, 30.0)
    before = pid.target
    pid.update(1.015, 1.0098, 30.0, 30.0)
    assert pid.target - before == pytest.approx(30.0 * (100.0 * 0.0002 - 1.0 * 0.098))


@pytest.mark.parametrize("limit", [2.0, 30.0])
def test_after_a_reset_the_next_heating_is_the_first_one_again(limit: float) -> None:
    first, second = control(10.0, 100.0, 0.1), control(10.0, 100.0, 0.1)
    for n in range(300):
        second.update(1.02, 1.0 + 1e-5 * (n // 7), 30.0, limit)
    second.reset()
    assert (second.target, second.is_limited) == (0.0, False)
    for n in range(300):
        for pid in (first, second):
            pid.update(1.02, 1.012 + 1e-5 * (n // 5), 30.0, 30.0)
        assert (first.target, first.is_limited) == (second.target, second.is_limited)


def test_below_zero_the_integral_learns_what_leads_back() -> None:
    pid = control(integral=100.0)
    for _ in range(100):
        pid.update(1.0, 1.01, 30.0, 30.0)
    pid.update(1.01, 1.01, 30.0, 30.0)
    assert pid.target == 0.0
    for _ in range(50):
        pid.update(1.01, 1.009, 30.0, 30.0)
    # The error of 0.001, and 50 steps of the integral, which stood still below zero.
    assert pid.target == pytest.approx(30.0 * (100.0 * 0.001 + 100.0 * 0.001 * 50 * PERIOD_S), rel=0.05)


def test_a_ramp_rises_at_its_rate_and_ends_at_the_target() -> None:
    ramp = Ramp()
    ramp.begin(20.0, 120.0, 50.0)
    for _ in range(2000):
        ramp.update(ramp.setpoint_c, PERIOD_S)
    assert ramp.setpoint_c == pytest.approx(70.0)
    for _ in range(3000):
        reached = ramp.update(ramp.setpoint_c, PERIOD_S)
    assert (ramp.setpoint_c, reached) == (120.0, True)
    assert not ramp.update(120.0 - 2 * Ramp.REACHED_K, PERIOD_S)


def test_a_ramp_waits_for_a_rod_that_is_far_behind() -> None:
    ramp = Ramp()
    ramp.begin(20.0, 500.0, 100.0)
    for _ in range(10_000):
        ramp.update(20.0, PERIOD_S)
    assert ramp.setpoint_c == pytest.approx(20.0 + Ramp.LEAD_K, abs=0.1)
