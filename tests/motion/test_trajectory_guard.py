"""The commanded position keeps range, speed and acceleration for every target; a target within them passes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, nan
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcp.ipc.commands import MoveAtVelocity
from rtcp.ipc.events import JointLimitReached
from rtcp.motion.controllers import ControllerSetup
from rtcp.motion.controllers.velocity import VelocityController
from rtcp.motion.guards.braking import fastest_stoppable
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.joint_motion import JointMotion
from rtcp.motion.limits import Limits, Values
from rtcp.motion.state import Phase, Setpoint
from tests.samples import examples

from .conftest import near
from .guard_checker import JOINTS_ONLY, GuardChecker

CYCLES_S = st.sampled_from([0.0005, 0.002, 0.01])

# Targets for a joint, rad, from the checker and the number of the joint.
TARGETS: dict[str, Callable[[GuardChecker, int], float]] = {
    "stay": lambda c, i: c.state.commanded[i],
    "nan": lambda c, i: nan,
    "infinite": lambda c, i: inf,
    "minus infinite": lambda c, i: -inf,
    "far up": lambda c, i: 1e9,
    "far down": lambda c, i: -1e9,
    "upper edge": lambda c, i: c.limits.high[i],
    "lower edge": lambda c, i: c.limits.low[i],
    "over the edge": lambda c, i: c.limits.high[i] + 1e-8,
    "full acceleration up": lambda c, i: _at(c, i, c.mean[i] + c.limits.acceleration[i] * c.dt),
    "full acceleration down": lambda c, i: _at(c, i, c.mean[i] - c.limits.acceleration[i] * c.dt),
    "a bit too much": lambda c, i: _at(c, i, c.mean[i] + c.limits.acceleration[i] * c.dt * 1.00004),
    "too much": lambda c, i: _at(c, i, c.mean[i] + c.limits.acceleration[i] * c.dt * 1.001),
    "full speed": lambda c, i: _at(c, i, c.limits.velocity[i]),
    "as it goes": lambda c, i: _at(c, i, c.mean[i]),
    "creep up": lambda c, i: _at(c, i, 1e-7),
    "creep down": lambda c, i: _at(c, i, -4e-8),
    "brake a bit too little": lambda c, i: _at(c, i, c.mean[i] - c.limits.acceleration[i] * c.dt * 0.99996),
}
TARGET = st.sampled_from(sorted(TARGETS))
SHARES = st.floats(0.0, 1.0)


def _at(checker: GuardChecker, i: int, speed: float) -> float:
    return checker.state.commanded[i] + speed * checker.dt


def narrower(checker: GuardChecker, shares: Sequence[float]) -> Values:
    """Limits within the widest; shares of 1 leave them unchanged."""
    widest = checker.limits.widest
    a, b, c, d = shares
    return replace(
        widest,
        low=tuple(low * (0.02 + 0.98 * a) for low in widest.low),
        high=tuple(high * (0.02 + 0.98 * b) for high in widest.high),
        velocity=tuple(v * (0.02 + 0.98 * c) for v in widest.velocity),
        acceleration=tuple(rate * (0.05 + 0.95 * d) for rate in widest.acceleration),
    )


ACTION = st.one_of(
    st.tuples(st.just("want"), TARGET, TARGET, st.booleans(), st.integers(1, 40)),
    st.tuples(st.just("limits"), SHARES, SHARES, SHARES, SHARES),
)


@given(
    dt=CYCLES_S,
    start=st.tuples(st.one_of(SHARES, st.sampled_from([0.0, 1.0])), st.one_of(SHARES, st.sampled_from([0.0, 1.0]))),
    actions=st.lists(ACTION, min_size=1, max_size=15),
)
@settings(max_examples=examples(150))
def test_whatever_is_wanted_range_speed_and_acceleration_are_kept_and_the_guards_stop_rests_inside(
    dt: float, start: tuple[float, float], actions: list[tuple[Any, ...]]
) -> None:
    bounds = Limits(JOINTS_ONLY)
    at = [low + share * (high - low) for low, high, share in zip(bounds.low, bounds.high, start, strict=True)]
    checker = GuardChecker(JOINTS_ONLY, at, dt)
    for kind, *values in actions:
        if kind == "limits":
            checker.change(narrower(checker, values))
            continue
        first, second, tolerates_saturation, times = values
        for _ in range(times):
            checker.request([TARGETS[first](checker, 0), TARGETS[second](checker, 1)], tolerates_saturation)
    checker.request([nan, inf], tolerates_saturation=False)
    checker.stop()


@given(dt=CYCLES_S, velocity=st.lists(st.floats(width=64), min_size=2, max_size=2), position=st.floats(-0.5, 0.5))
def test_a_speed_that_does_not_go_with_the_position_is_not_commanded(
    dt: float, velocity: list[float], position: float
) -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], dt)
    for _ in range(30):
        checker.request([position, position], tolerates_saturation=True, velocity=velocity)


# -- targets within the limits pass ----------------------------------------------------------------------------------


@given(
    dt=st.sampled_from([0.0005, 0.004, 0.01]),
    legs=st.lists(st.tuples(SHARES, SHARES, st.floats(0.05, 1.5), st.booleans(), st.integers(1, 1500)), max_size=3),
    jerky=st.booleans(),
)
@settings(max_examples=examples(30))
def test_moves_at_full_acceleration_up_to_the_very_edge_pass_bit_for_bit(
    dt: float, legs: list[tuple[float, float, float, bool, int]], jerky: bool
) -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], dt)
    limits = checker.limits
    if jerky:
        # So that the whole move is made with the greatest acceleration there is.
        limits.jerk[:] = [1e4, 1e4]
    generator = JointMotion(dt, limits.velocity, limits.acceleration, limits.jerk)
    for a, b, speed, each, cycles in [*legs, (1.0, 0.0, 9.0, True, 10**6), (0.0, 1.0, 9.0, False, 10**6)]:
        # Shares beyond a half are the edges themselves.
        goal = [
            limits.high[0] if a > 0.5 else limits.low[0] * (1.0 - 2.0 * a),
            limits.high[1] if b > 0.5 else limits.low[1] * (1.0 - 2.0 * b),
        ]
        if not generator.move_to(checker.state, goal, speed, synchronized=not each):
            continue
        for _ in range(cycles):
            target = generator.update(checker.state)
            position, velocity = list(target.position), list(target.velocity)
            verdict = checker.request(position, tolerates_saturation=False, velocity=velocity)
            guard = checker.guard
            assert verdict is GuardResult.PASS, (guard.ended, checker.mean)
            assert (checker.state.commanded, checker.state.commanded_velocity) == (position, velocity)
            if generator.phase is Phase.HOLD:
                break
    assert checker.state.commanded == pytest.approx([limits.low[0], limits.high[1]], abs=1e-7)


@settings(max_examples=examples(40))
@given(start=st.floats(-0.29, 0.19), dt=CYCLES_S, seed=st.integers(0, 2**32))
def test_any_walk_that_keeps_to_the_limits_and_can_stop_passes_bit_for_bit(start: float, dt: float, seed: int) -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, start], dt)
    limits, position, mean, chance = checker.limits, [0.0, start], [0.0, 0.0], Random(seed)
    for _ in range(300):
        for i in range(2):
            u = limits.acceleration[i] * dt
            w = mean[i] + chance.choice([u, -u, 0.0, chance.uniform(-u, u)])
            bound = limits.velocity[i]
            top = fastest_stoppable(limits.high[i] - position[i], u, dt)
            bottom = -fastest_stoppable(position[i] - limits.low[i], u, dt)
            w = max(min(w, bound, top), -bound, bottom)
            mean[i] = min(max(w, mean[i] - u), mean[i] + u)
            position[i] += mean[i] * dt
        assert checker.request(position, tolerates_saturation=False) is GuardResult.PASS
        assert checker.state.commanded == position


# -- cuts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.001, 0.01])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wish_beyond_the_range_ends_exactly_at_its_edge(dt: float, sign: float) -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], dt)
    edge = checker.limits.high if sign > 0 else checker.limits.low
    for _ in range(round(12.0 / dt)):
        verdict = checker.request([sign * 1e3] * 2, tolerates_saturation=True)
    assert (verdict, checker.guard.held) == (GuardResult.CLAMPED, 0b11)
    assert checker.state.commanded == pytest.approx(edge, abs=1e-12)
    assert max(map(abs, checker.state.commanded_velocity)) < 1e-9


def test_a_velocity_mode_that_is_driven_into_a_limit_stops_before_it() -> None:
    checker = GuardChecker(JOINTS_ONLY, [3.0, 0.0], 0.001)
    mode = VelocityController(ControllerSetup(JOINTS_ONLY, checker.limits, checker.guard, checker.dt, [].__getitem__))
    for cycle in range(4000):
        if cycle % 100 == 0:
            assert mode.accept(MoveAtVelocity((0.5, -1.5), 1.0), checker.state, continues=cycle > 0) is None
        target = mode.update(checker.state)
        verdict = checker.request(list(target.position), mode.tolerates_saturation, list(target.velocity))
        assert verdict in (GuardResult.PASS, GuardResult.CLAMPED)
        checker.state.now_ns += 1_000_000
        assert checker.state.commanded[0] <= checker.limits.high[0] + 1e-7
        assert checker.state.commanded[1] >= checker.limits.low[1] - 1e-7
    assert checker.state.commanded == pytest.approx([checker.limits.high[0], checker.limits.low[1]], abs=1e-3)


@pytest.mark.parametrize("wish", [nan, inf, -inf])
def test_what_is_no_number_brakes(wish: float) -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], 0.001)
    for _ in range(100):
        checker.request([1.0, 0.2], tolerates_saturation=True)
    speeds = list(checker.mean)
    assert min(speeds) > 0.0
    assert checker.request([wish, wish], tolerates_saturation=True) is GuardResult.CLAMPED
    bounds = checker.limits.acceleration
    assert checker.mean == pytest.approx([v - a * 0.001 for v, a in zip(speeds, bounds, strict=True)], abs=1e-9)


def test_only_the_joint_that_asks_too_much_is_clamped() -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], 0.001)
    fits = 0.5 * checker.limits.acceleration[1] * 0.001**2
    assert checker.request([1.0, fits], tolerates_saturation=True) is GuardResult.CLAMPED
    assert checker.guard.held == 0b01
    assert checker.state.commanded[1] == fits


def test_a_cut_of_a_mode_that_cannot_live_with_it_is_a_stop_that_looks_at_no_target_until_it_rests() -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], 0.001)
    for _ in range(100):
        checker.request([1.0, 0.0], tolerates_saturation=True)
    assert checker.request([99.0, 0.0], tolerates_saturation=False) is GuardResult.STOPPING
    guard = checker.guard
    assert guard.ended == JointLimitReached(0, 99.0, checker.limits.high[0])
    speed = checker.state.commanded_velocity[0]
    cycles = 1
    while checker.request([checker.state.commanded[0] + 1e-6, 0.0], tolerates_saturation=True) is GuardResult.STOPPING:
        assert checker.state.commanded_velocity[0] < speed
        speed = checker.state.commanded_velocity[0]
        cycles += 1
    assert checker.state.commanded_velocity == [0.0, 0.0]
    assert cycles * 0.001 == pytest.approx(0.1, abs=0.003)
    assert checker.request([checker.state.commanded[0] + 1e-6, 0.0], tolerates_saturation=False) is GuardResult.PASS


def test_a_step_that_is_too_long_is_reported_as_a_speed() -> None:
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], 0.001)
    checker.request([0.0, 0.1], tolerates_saturation=False)
    guard = checker.guard
    assert guard.ended == JointLimitReached(1, near(100.0), near(0.7e-3))


@given(beyond=st.floats(0.0, 0.02), dt=CYCLES_S, outward=st.booleans())
@settings(max_examples=examples(30))
def test_a_joint_beyond_its_range_comes_back_and_never_goes_further_out(
    beyond: float, dt: float, outward: bool
) -> None:
    limits = Limits(JOINTS_ONLY)
    guard = TrajectoryGuard(JOINTS_ONLY, limits, dt)
    checker = GuardChecker(JOINTS_ONLY, [0.0, 0.0], dt)
    state = checker.state
    state.commanded = [limits.high[0] + beyond, limits.low[1] - beyond]
    guard.latch(state)
    target, farthest = Setpoint(2), list(state.commanded)
    for wish in ([9.0, -9.0] if outward else [0.0, 0.0], [0.0, 0.0]):
        for _ in range(round(1.0 / dt)):
            target.position, target.velocity = list(wish), [0.0, 0.0]
            guard.apply(state, target, tolerates_saturation=True)
            assert state.commanded[0] <= farthest[0] + 1e-12
            assert state.commanded[1] >= farthest[1] - 1e-12
            assert max(map(abs, state.commanded_velocity)) <= 1.5
            farthest[0] = min(farthest[0], max(state.commanded[0], limits.high[0]))
            farthest[1] = max(farthest[1], min(state.commanded[1], limits.low[1]))
    assert state.commanded[0] < limits.high[0]
    assert state.commanded[1] > limits.low[1]
