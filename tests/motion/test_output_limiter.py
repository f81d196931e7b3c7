"""Nothing outside a limit passes the guard."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rtcp.config.model import Joint, Range
from rtcp.motion.guards.output_limiter import BACK_RAD_S, OutputLimiter
from rtcp.motion.limits import Limits

from .guard_checker import ARM

PERIOD = 0.0005
JOINT = Joint("shoulder", "drive", Range(-1.0, 2.0), velocity=0.5, acceleration=2.0, jerk=20.0, torque=10.0)
CONFIG = replace(ARM, joints=(JOINT,), arm=None)
TWO = replace(ARM, joints=(JOINT, JOINT), arm=None)
STEP = 0.5 * PERIOD


@dataclass
class Drive:
    """The fields of a drive that a drive writer reads and writes."""

    position: float = 0.0
    velocity: float = 0.0
    torque: float = 0.0
    mode_display: int = 0
    target_position: float = 0.0
    target_velocity: float = 0.0
    target_torque: float = 0.0


CHANGE = 2.0 * PERIOD
"""Largest change of a target velocity in a cycle, rad/s."""


def guarded(last: float, drive: Drive) -> tuple[Drive, int]:
    guard = OutputLimiter(Limits(CONFIG), PERIOD)
    guard.latch(0, last)
    guard.check([drive])
    return drive, guard.held


def settled(last: float, drive: Drive) -> tuple[Drive, int]:
    """The targets after a velocity was requested until its change no longer bounds it."""
    guard = OutputLimiter(Limits(CONFIG), PERIOD)
    guard.latch(0, last)
    wanted = drive.target_velocity
    for _ in range(1000):
        drive.target_velocity = wanted
        guard.check([drive])
    return drive, guard.held


@pytest.mark.parametrize(
    ("last", "wanted", "passed"),
    [
        (0.0, STEP / 2, STEP / 2),
        (0.0, 1.0, STEP),
        (0.0, -1.0, -STEP),
        (2.0, 2.1, 2.0),
        (-1.0, -1.1, -1.0),
        (0.3, math.nan, 0.3),
        (0.3, math.inf, 0.3 + STEP),
    ],
)
def test_a_target_is_held_inside_range_and_step(last: float, wanted: float, passed: float) -> None:
    drive, clamped = guarded(last, Drive(target_position=wanted))
    assert drive.target_position == pytest.approx(passed, abs=1e-9)
    assert clamped == (0 if wanted == passed else 1)


@pytest.mark.parametrize(("wanted", "passed"), [(0.4, 0.4), (9.0, 0.5), (-9.0, -0.5), (math.nan, 0.0)])
def test_a_speed_is_held_inside_its_bound(wanted: float, passed: float) -> None:
    assert settled(0.0, Drive(target_velocity=wanted))[0].target_velocity == passed


@pytest.mark.parametrize(("wanted", "passed"), [(4.0, 4.0), (99.0, 10.0), (-99.0, -10.0), (math.nan, 0.0)])
def test_a_torque_is_held_inside_its_bound(wanted: float, passed: float) -> None:
    assert guarded(0.0, Drive(target_torque=wanted))[0].target_torque == passed


@pytest.mark.parametrize("outward", [1.0, -1.0])
@pytest.mark.parametrize("field", ["target_velocity", "target_torque"])
def test_beyond_the_range_speed_and_torque_only_lead_back_each_joint_by_itself(field: str, outward: float) -> None:
    edge = 2.0 if outward > 0.0 else -1.0
    guard = OutputLimiter(Limits(TWO), PERIOD)
    for beyond in range(2):
        for wanted, passed in ((0.3 * outward, 0.0), (-0.3 * outward, -0.3 * outward)):
            drives = [Drive(target_position=0.0), Drive(target_position=0.0)]
            drives[beyond] = Drive(position=edge + 0.01 * outward, target_position=edge)
            for axis, drive in enumerate(drives):
                guard.latch(axis, drive.target_position)
            for _ in range(700):
                for drive in drives:
                    setattr(drive, field, wanted)
                guard.check(drives)
            assert getattr(drives[beyond], field) == pytest.approx(passed)
            assert getattr(drives[1 - beyond], field) == pytest.approx(wanted)
            assert guard.held == (0 if passed else 1 << beyond)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_that_is_latched_begins_at_rest_again(sign: float) -> None:
    guard, drive = OutputLimiter(Limits(CONFIG), PERIOD), Drive(target_velocity=sign * 0.3)
    for _ in range(100):
        drive.target_velocity = sign * 0.3
        guard.check([drive])
    guard.latch(0, 0.0)
    drive.target_velocity = sign * 0.3
    guard.check([drive])
    assert drive.target_velocity == pytest.approx(sign * CHANGE)
    outside = 2.02 if sign > 0.0 else -1.02
    for _ in range(2):
        guard.latch(0, outside)
        drive = Drive(position=outside, target_position=outside)
        guard.check([drive])
        assert drive.target_position == pytest.approx(outside, abs=1e-12)
        for _ in range(20):
            guard.check([drive])
        assert abs(drive.target_position) < abs(outside)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=50), st.floats(-1.0, 2.0))
def test_whatever_is_asked_targets_stay_in_range_and_in_steps(wanted: list[float], start: float) -> None:
    guard, drive, before = OutputLimiter(Limits(CONFIG), PERIOD), Drive(), start
    guard.latch(0, start)
    for target in wanted:
        drive.target_position = target
        guard.check([drive])
        assert -1.0 <= drive.target_position <= 2.0
        assert abs(drive.target_position - before) <= STEP * (1 + 1e-5)
        before = drive.target_position


def test_limits_that_change_are_those_that_count_from_then_on() -> None:
    limits = Limits(CONFIG)
    guard, drive = OutputLimiter(limits, PERIOD), Drive(target_position=9.0)
    guard.latch(0, 1.0)
    limits.apply(replace(limits.widest, high=(0.9,), velocity=(0.1,), acceleration=(1.0,), torque=(2.0,)))
    guard.take(limits)
    drive.target_velocity = drive.target_torque = 99.0
    guard.check([drive])
    assert drive.target_velocity == pytest.approx(0.5 * CHANGE)
    assert drive.target_torque == 2.0
    for _ in range(200):
        drive.target_velocity = 99.0
        guard.check([drive])
    assert drive.target_velocity == 0.1
    # Slowly back into the range.
    assert 1.0 - 200 * BACK_RAD_S * PERIOD <= drive.target_position <= 1.0 - 70 * BACK_RAD_S * PERIOD
    limits.apply(replace(limits.widest, low=(-0.5,), velocity=(0.01,)))
    guard.take(limits)
    guard.latch(0, -0.6)
    for _ in range(200):
        guard.check([drive])
    assert -0.6 < drive.target_position <= -0.6 + 200 * 0.01 * PERIOD


def led_back(last: float, wanted: float, velocity: float = 0.5) -> list[float]:
    """The targets from `last`, outside the range, until they are inside."""
    limits = Limits(CONFIG)
    limits.apply(replace(limits.widest, velocity=(velocity,)))
    guard, drive, targets = OutputLimiter(limits, PERIOD), Drive(position=last), [last]
    guard.latch(0, last)
    while not -1.0 <= targets[-1] <= 2.0:
        drive.target_position = wanted
        guard.check([drive])
        targets.append(drive.target_position)
        assert len(targets) < 10_000
    return targets


@pytest.mark.parametrize("wanted", [2.0, 2.02, 0.5, math.nan])
@pytest.mark.parametrize(("last", "edge"), [(2.018, 2.0), (2.00001, 2.0), (-1.018, -1.0)])
def test_a_target_beyond_the_range_begins_where_it_is_and_is_led_back_to_the_edge(
    last: float, edge: float, wanted: float
) -> None:
    targets = led_back(last, wanted)
    assert targets[1] == pytest.approx(last, abs=1e-12)
    assert targets[-1] == edge
    # The distance at full return speed, and the time to reach and to leave that speed.
    assert (len(targets) - 2) * PERIOD <= abs(last - edge) / BACK_RAD_S + BACK_RAD_S / JOINT.acceleration + 2 * PERIOD


@pytest.mark.parametrize(("velocity", "bound"), [(0.5, BACK_RAD_S), (0.02, 0.02)])
@given(st.floats(0.0, 0.05, exclude_min=True), st.booleans())
def test_a_target_is_led_back_no_faster_than_gently_or_than_its_joint_may_and_under_its_acceleration(
    velocity: float, bound: float, beyond: float, above: bool
) -> None:
    targets = led_back(2.0 + beyond if above else -1.0 - beyond, 2.0, velocity)
    speeds = [0.0, *((after - before) / PERIOD for before, after in pairwise(targets)), 0.0]
    assert max(map(abs, speeds)) <= bound + 1e-9
    assert max(abs(after - before) for before, after in pairwise(speeds)) <= CHANGE + 1e-9


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=50))
@example([0.01] * 20 + [0.0] * 3)
@example([-0.01] * 20 + [0.0] * 3)
def test_a_target_velocity_changes_by_no_more_than_acceleration_x_cycle(wanted: list[float]) -> None:
    guard, drive = OutputLimiter(Limits(CONFIG), PERIOD), Drive()
    before = 0.0
    for speed in wanted:
        drive.target_velocity = speed
        guard.check([drive])
        assert abs(drive.target_velocity - before) <= CHANGE * (1 + 1e-9)
        assert abs(drive.target_velocity) <= 0.5
        before = drive.target_velocity
