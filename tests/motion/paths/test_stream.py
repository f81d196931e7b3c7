"""The mode `stream`: smooth between targets of any rate, those late or out of order dropped, at rest when they end."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcp.motion.controllers.stream import TIMEOUT_S, StreamController
from rtcp.motion.state import Phase, Reason

PERIOD = 0.0005
ZERO = [0.0] * 6


@pytest.fixture
def mode(bounds: Any) -> StreamController:
    return StreamController(bounds, PERIOD)


def stream(
    drive: Any,
    mode: StreamController,
    wanted: Callable[[float], list[float]],
    seconds: float,
    interval: float,
    jitter: float = 0.0,
) -> None:
    """Feed what the sender says every `interval` s, with a network that delays each by up to `jitter` s."""
    chance = random.Random(1)
    began = drive.state.now_ns
    due = [(k * interval + chance.uniform(0.0, jitter), k * interval) for k in range(round(seconds / interval))]
    due.sort()
    while due:
        now = (drive.state.now_ns - began) * 1e-9
        while due and due[0][0] <= now + 1e-9:
            stamp = due.pop(0)[1]
            mode.feed(wanted(stamp), 1000.0 + stamp, drive.state.now_ns)
        drive.cycle(mode)


def test_a_stream_is_followed_and_its_end_is_a_stop(drive: Any, mode: StreamController) -> None:
    mode.start(drive.state)
    stream(drive, mode, lambda t: [0.1 * (1.0 - math.cos(math.pi * t))] * 6, 2.0, 1 / 30)
    assert mode.phase is Phase.MOVE
    assert drive.until_rest(mode) < TIMEOUT_S + 0.5
    assert mode.reason is Reason.STREAM_ENDED
    assert (mode.accepted, mode.dropped) == (60, 0)
    assert drive.state.commanded == pytest.approx([0.0] * 6, abs=0.01)


def test_the_last_target_is_reached_and_not_passed_by_much(drive: Any, mode: StreamController) -> None:
    mode.start(drive.state)
    stream(drive, mode, lambda t: [0.3 * t] * 6, 1.0, 0.02)
    drive.until_rest(mode)
    # A stop from that speed takes v^2 / 2a + v a / 2j.
    assert max(q[0] for q in drive.path) < 0.3 * 0.98 + 0.3**2 / 4.0 + 0.3 * 0.05 + 0.005
    assert drive.state.commanded == pytest.approx([0.3 * 0.98] * 6, abs=0.04)


def test_one_target_is_moved_to_as_long_as_it_is_renewed(drive: Any, mode: StreamController) -> None:
    mode.start(drive.state)
    stream(drive, mode, lambda _: [0.2] * 6, 3.0, 0.1)
    assert drive.state.commanded == pytest.approx([0.2] * 6, abs=1e-9)


@pytest.mark.parametrize("interval", [0.001, 0.004, 0.0333, 0.1, 0.15])
def test_any_rate_is_followed_smoothly(new_drive: Any, interval: float) -> None:
    drive = new_drive(with_jerk=True)
    mode = StreamController(drive.limits, PERIOD)
    mode.start(drive.state)
    stream(drive, mode, lambda t: [0.1 * (1.0 - math.cos(0.5 * math.pi * t))] * 6, 6.0, interval)
    # What is behind by a time is behind by no more than that at the target's greatest speed.
    behind_s = 0.2 + 1.25 * interval
    errors = [
        abs(q[0] - 0.1 * (1.0 - math.cos(0.5 * math.pi * (k + 1) * PERIOD)))
        for k, q in enumerate(drive.path)
        if k >= 2000
    ]
    assert max(errors) < behind_s * 0.05 * math.pi
    assert mode.dropped == 0


def test_between_rare_targets_the_speed_hardly_changes(drive: Any, mode: StreamController) -> None:
    mode.start(drive.state)
    stream(drive, mode, lambda t: [0.2 * t] * 6, 4.0, 0.1)
    speeds = [(b[0] - a[0]) / PERIOD for a, b in pairwise(drive.path[4000:])]
    assert min(speeds) > 0.15
    assert max(speeds) < 0.25


def test_a_stream_has_ended_after_the_timeout_and_not_before(drive: Any, mode: StreamController) -> None:
    mode.start(drive.state)
    assert mode.feed(ZERO, 1.0, 0)
    drive.run(mode, round(TIMEOUT_S / PERIOD) + 1)
    assert (mode.phase, mode.reason) == (Phase.MOVE, Reason.NONE)
    drive.cycle(mode)
    assert (mode.phase, mode.reason) == (Phase.HOLD, Reason.STREAM_ENDED)
    assert (mode.value, mode.limit) == (pytest.approx(TIMEOUT_S + PERIOD), TIMEOUT_S)


@pytest.mark.parametrize("speed", [0.2, 0.02])
def test_jitter_of_the_network_hardly_changes_the_speed(drive: Any, mode: StreamController, speed: float) -> None:
    mode.start(drive.state)
    stream(drive, mode, lambda t: [speed * t] * 6, 3.0, 0.05, jitter=0.02)
    speeds = [(b[0] - a[0]) / PERIOD for a, b in pairwise(drive.path[3000:])]
    # Measured: 1.00 to 1.05.
    assert 0.9 * speed < min(speeds)
    assert max(speeds) < 1.1 * speed


def test_what_is_out_of_order_or_stamped_alike_is_dropped(drive: Any, mode: StreamController) -> None:
    mode.start(drive.state)
    assert mode.feed(ZERO, 5.0, 0)
    assert not mode.feed([0.1] * 6, 5.0, 1_000_000)
    assert not mode.feed([0.1] * 6, 4.5, 1_000_000)
    assert mode.late_s == pytest.approx(0.5)
    assert mode.feed(ZERO, 5.001, 1_000_000)
    assert (mode.accepted, mode.dropped) == (2, 2)


def test_what_comes_later_than_the_others_by_the_timeout_is_dropped(drive: Any, mode: StreamController) -> None:
    mode.start(drive.state)
    assert mode.feed(ZERO, 100.0, 0)
    assert mode.feed(ZERO, 100.1, 100_000_000)
    assert not mode.feed([0.1] * 6, 100.15, 400_000_000)
    assert mode.late_s == pytest.approx(0.25, abs=1e-3)
    assert mode.feed(ZERO, 100.39, 400_000_000)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3.2, -1e300])
def test_what_is_no_number_or_out_of_range_is_dropped(drive: Any, mode: StreamController, value: float) -> None:
    mode.start(drive.state)
    assert not mode.feed([value, *ZERO[1:]], 1.0, 0)
    assert not mode.feed([*ZERO[1:], value], 1.0, 0)
    assert mode.dropped == 2
    assert mode.late_s == 0.0
    drive.until_rest(mode)
    assert drive.state.commanded == ZERO


@pytest.mark.parametrize("stamp", [math.nan, math.inf])
def test_a_stamp_that_is_no_number_is_dropped(drive: Any, mode: StreamController, stamp: float) -> None:
    mode.start(drive.state)
    assert not mode.feed(ZERO, stamp, 0)


def test_nothing_is_taken_before_the_start_and_after_a_stop(drive: Any, mode: StreamController) -> None:
    assert not mode.feed(ZERO, 1.0, 0)
    mode.start(drive.state)
    assert mode.feed([0.3] * 6, 1.0, 0)
    drive.run(mode, 300)
    mode.stop(drive.state)
    assert not mode.feed([0.3] * 6, 1.1, drive.state.now_ns)
    drive.until_rest(mode)
    assert mode.reason is Reason.NONE


def test_a_stream_that_begins_in_motion_brings_the_arm_to_rest_until_a_target_comes(
    drive: Any, mode: StreamController
) -> None:
    mode.start(drive.state)
    stream(drive, mode, lambda t: [0.3 * t] * 6, 1.0, 0.02)
    assert drive.state.commanded_velocity[0] > 0.2
    mode.start(drive.state)
    drive.run(mode, 100)
    assert mode.feed([0.1] * 6, 1.0, drive.state.now_ns)
    drive.until_rest(mode)


def test_targets_at_the_edge_of_a_range_do_not_carry_a_joint_beyond(drive: Any, mode: StreamController) -> None:
    drive.at([2.8, 1.7, 2.1, 2.8, 1.7, 2.8])
    mode.start(drive.state)
    start, high = list(drive.state.commanded), drive.limits.high
    stream(drive, mode, lambda t: [min(q + 0.45 * t, h) for q, h in zip(start, high, strict=True)], 2.0, 0.05)
    assert drive.state.commanded == pytest.approx(high, abs=1e-6)
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(high, abs=1e-6)


def test_a_fast_stream_that_ends_beside_the_edge_leaves_room_to_stop(drive: Any, mode: StreamController) -> None:
    high = drive.limits.high
    drive.at([h - 0.8 for h in high])
    mode.start(drive.state)
    # 0.3 rad/s up to 5 mrad from the edge: to stop from that speed takes 37 mrad.
    stream(drive, mode, lambda t: [h - 0.8 + 0.3 * t for h in high], 2.66, 0.05)
    drive.until_rest(mode)
    assert mode.reason is Reason.STREAM_ENDED


def test_towards_the_edge_a_target_that_is_late_is_not_waited_for(drive: Any, mode: StreamController) -> None:
    high = drive.limits.high
    drive.at([h - 0.81 for h in high])
    mode.start(drive.state)
    # The last one is 45 mrad from the edge: what a stop takes is there, but nothing more.
    stream(drive, mode, lambda t: [h - 0.81 + 0.3 * t for h in high], 2.7, 0.15)
    drive.until_rest(mode)
    assert mode.reason is Reason.STREAM_ENDED


def test_a_run_up_that_would_leave_the_range_is_not_made(drive: Any, mode: StreamController) -> None:
    low = drive.limits.low[0]
    drive.at([low + 0.02, *ZERO[1:]])
    mode.start(drive.state)
    # To pass low + 0.01 at 0.3 rad/s the joint would have to start from below its range.
    for k in range(8):
        assert mode.feed([low + 0.001 + 0.009 * k / 7, *ZERO[1:]], 0.03 * k, drive.state.now_ns)
        drive.run(mode, 60)
    drive.until_rest(mode)
    assert mode.reason is Reason.STREAM_ENDED
    assert drive.state.commanded[0] == pytest.approx(low + 0.01, abs=2e-3)


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_no_stream_whatever_breaks_a_limit(new_drive: Any, seed: int) -> None:
    chance, drive = random.Random(seed), new_drive()
    mode = StreamController(drive.limits, PERIOD)
    mode.start(drive.state)
    stamp = 0.0
    for _ in range(40):
        stamp += chance.choice([0.001, 0.01, 0.05, -0.02, 0.3])
        target = [chance.uniform(low, high) for low, high in zip(drive.limits.low, drive.limits.high, strict=True)]
        mode.feed(target, stamp, drive.state.now_ns)
        drive.run(mode, chance.randint(1, 200))
        if chance.random() < 0.05:
            mode.stop(drive.state)
            drive.run(mode, chance.randint(1, 50))
            mode.start(drive.state)
    drive.until_rest(mode)


def lag(path: list[list[float]], amplitude: float, omega: float) -> tuple[float, float]:
    """Delay, s, and gain of a sampled sine, by its first harmonic over whole periods."""
    whole = round(2 * math.pi / omega / PERIOD)
    tail = [q[0] for q in path[-2 * whole :]]
    at = len(path) - len(tail)
    a = sum(q * math.sin(omega * (at + k + 1) * PERIOD) for k, q in enumerate(tail)) * 2 / len(tail)
    b = sum(q * math.cos(omega * (at + k + 1) * PERIOD) for k, q in enumerate(tail)) * 2 / len(tail)
    return -math.atan2(b, a) / omega, math.hypot(a, b) / amplitude


def test_a_sine_at_30_hz_comes_a_tenth_of_a_second_late_and_as_large(new_drive: Any) -> None:
    # pi/8 rad with a period of 2 s needs 1.23 rad/s and 3.9 rad/s^2.
    drive = new_drive()
    drive.limits.velocity[:], drive.limits.acceleration[:], drive.limits.jerk[:] = [2.0] * 6, [8.0] * 6, [100.0] * 6
    mode = StreamController(drive.limits, PERIOD)
    mode.start(drive.state)
    stream(drive, mode, lambda t: [math.pi / 8 * math.sin(math.pi * t)] * 6, 6.0, 1 / 30)
    behind, gain = lag(drive.path, math.pi / 8, math.pi)
    # Measured: 0.095 s, 1.013.
    assert 0.02 < behind < 0.12
    assert gain == pytest.approx(1.0, abs=0.03)
