"""The control law against its closed form, in simulated time."""

from __future__ import annotations

from cmath import exp as exp_complex
from math import cos, exp, pi, sin

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from tests.virtual.irc5.wire import PERIOD, pc

DEAD_TIME = 4 * PERIOD
"""14 ms, rounded up to whole periods, s."""
SPEED = 20.0
"""Speed of the ramps, degrees/s."""


def ramp_lags(gain: float, with_speed: bool) -> tuple[float, float]:
    """Lag of the planned and of the actual position behind a ramp of joint 1, s."""
    robot = pc(egm={"position_gain": gain})
    speed = (SPEED, 0, 0, 0, 0, 0) if with_speed else None
    for cycle in range(700):
        reference = SPEED * cycle * PERIOD
        state = robot.read((reference, 0, 0, 0, 0, 0), speed)
    return (reference - state.planned[0]) / SPEED, (reference - state.actual[0]) / SPEED


@pytest.mark.parametrize("gain", [5.0, 20.0])
def test_with_positions_alone_a_ramp_is_followed_1_over_k_late(gain: float) -> None:
    planned, actual = ramp_lags(gain, with_speed=False)
    assert planned == pytest.approx(1.0 / gain, abs=1.1 * PERIOD)
    assert actual == pytest.approx(1.0 / gain + DEAD_TIME, abs=1.1 * PERIOD)


def test_with_speed_references_only_the_dead_time_is_left() -> None:
    planned, actual = ramp_lags(5.0, with_speed=True)
    assert planned == pytest.approx(0.0, abs=1.1 * PERIOD)
    assert actual == pytest.approx(DEAD_TIME, abs=1.1 * PERIOD)


def test_a_step_of_position_is_an_exponential_of_k() -> None:
    robot = pc(egm={"position_gain": 5.0, "low_pass_hz": 0.0})
    for cycle in range(1, 100):
        planned = robot.read((10.0, 0, 0, 0, 0, 0)).planned[0]
        assert planned == pytest.approx(10.0 * (1.0 - (1.0 - 5.0 * PERIOD) ** cycle))


def test_a_step_of_speed_passes_the_low_pass() -> None:
    robot = pc(egm={"low_pass_hz": 20.0})
    for cycle in range(1, 20):
        robot.read(None, (10.0, 0, 0, 0, 0, 0))
        assert robot.unit.speeds[0] == pytest.approx(10.0 * (1.0 - exp(-2.0 * pi * 20.0 * cycle * PERIOD)))


def test_with_pos_corr_gain_0_positions_do_nothing() -> None:
    robot = pc(egm={"pos_corr_gain": 0.0})
    assert robot.wait(0.5, (10.0,) * 6).actual == [0.0] * 6


def test_the_actual_position_follows_the_planned_one_after_the_dead_time() -> None:
    robot = pc(egm={"low_pass_hz": 0.0})
    states = [robot.read(None, (10.0, 0, 0, 0, 0, 0)) for _ in range(20)]
    assert [state.actual for state in states[4:]] == [state.planned for state in states[:-4]]


def test_all_joints_are_scaled_alike_to_max_speed_deviation() -> None:
    robot = pc(egm={"max_speed_deviation": 5.0})
    robot.wait(0.5, None, (10.0, 20.0, 0, 0, -5.0, 0))
    assert robot.unit.speeds == pytest.approx([2.5, 5.0, 0, 0, -1.25, 0])


def test_abbs_default_lets_no_joint_exceed_1_degree_a_second() -> None:
    robot = pc(egm={"max_speed_deviation": 1.0})
    assert robot.wait(1.0, (90.0, 0, 0, 0, 0, 0)).planned[0] == pytest.approx(1.0, rel=0.02)


def test_a_joints_own_speed_limit_holds_above_max_speed_deviation() -> None:
    robot = pc()
    state = robot.wait(0.3, None, (375.0, 0, 0, 0, 0, 0))
    assert robot.unit.speeds[0] == pytest.approx(250.0)
    assert state.utilization == pytest.approx(150.0)


def test_max_pos_deviation_holds_from_where_the_session_began() -> None:
    robot = pc(egm={"max_pos_deviation": 3.0}, initial_position=(20.0, 0, 0, 0, 0, 0))
    assert robot.wait(2.0, (40.0, 0, 0, 0, 0, 0)).actual[0] == pytest.approx(23.0)


def test_the_contribution_grows_within_ramp_in_time() -> None:
    robot = pc(egm={"ramp_in_s": 1.0, "low_pass_hz": 0.0})
    robot.wait(0.5, None, (10.0, 0, 0, 0, 0, 0))
    assert robot.unit.speeds[0] == pytest.approx(5.0, abs=0.1)


def test_the_seventh_joint_follows_the_same_law() -> None:
    robot = pc(axes=7, egm={"position_gain": 5.0, "low_pass_hz": 0.0})
    state = robot.wait(50 * PERIOD, (0, 0, 0, 0, 0, 0, 10.0))
    assert state.planned[6] == pytest.approx(10.0 * (1.0 - (1.0 - 5.0 * PERIOD) ** 50))


def sine_response(gain: float, with_speed: bool, period: float = 2.0) -> complex:
    """Actual position over reference for a sine of joint 1 (10 degrees), by least squares over the last two periods."""
    omega = 2.0 * pi / period
    robot = pc(egm={"position_gain": gain})
    fit, cycles = 0j, round(2 * period / PERIOD)
    for cycle in range(3 * cycles):
        angle = omega * cycle * PERIOD
        speed = (10.0 * omega * cos(angle), 0, 0, 0, 0, 0) if with_speed else None
        state = robot.read((10.0 * sin(angle), 0, 0, 0, 0, 0), speed)
        if cycle >= 2 * cycles:
            fit += state.actual[0] * complex(cos(angle), -sin(angle))
    return fit * 2.0j / (10.0 * cycles)


@pytest.mark.parametrize("gain", [5.0, 20.0])
@pytest.mark.parametrize("with_speed", [False, True])
def test_a_sine_comes_out_as_the_transfer_function_says(gain: float, with_speed: bool) -> None:
    s = 1j * pi  # a period of 2 s
    low_pass = 1.0 / (1.0 + s / (2.0 * pi * 20.0))
    closed_loop = (gain + (s if with_speed else 0.0)) * low_pass / (s + gain * low_pass)
    # Low pass and integrator each take a reference for the whole of its cycle: half a period early.
    expected = closed_loop * exp_complex(-s * (DEAD_TIME - PERIOD))
    assert sine_response(gain, with_speed) == pytest.approx(expected, abs=0.004)
