"""A mode without a loop: its targets reach the state through the guards, which have nothing to cut."""

from __future__ import annotations

import array
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import load
from rtcp.config.model import ArmConfig
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Controller, Phase, Setpoint

PERIOD = 0.0005


@dataclass
class Drive:
    """Runs modes one after another on one state and checks every cycle against the limits."""

    config: ArmConfig
    state: ArmState = field(default_factory=lambda: ArmState(6))
    period_s: float = PERIOD
    with_jerk: bool = False
    checked: bool = True
    path: list[list[float]] = field(default_factory=list)
    means: list[float] = field(default_factory=lambda: [0.0] * 6)
    cuts: int = 0

    def __post_init__(self) -> None:
        self.limits = Limits(self.config)
        self.guard = TrajectoryGuard(replace(self.config, arm=None), self.limits, self.period_s)

    def at(self, q: Sequence[float]) -> Drive:
        """Stand at `q`."""
        self.state.commanded = [float(angle) for angle in q]
        self.state.actual = list(self.state.commanded)
        self.guard.latch(self.state)
        return self

    def cycle(self, mode: Controller) -> None:
        """One cycle: continuous, inside range, speed and acceleration."""
        state, dt, limits = self.state, self.period_s, self.limits
        target = mode.update(state, dt)
        before = list(state.commanded)
        position, velocity = list(target.position), list(target.velocity)
        if mode.tolerates_saturation:
            self.clamped(mode, target, before)
            return
        acceleration = [(after - before) / dt for before, after in zip(state.commanded_velocity, velocity, strict=True)]
        for i in range(6 if self.checked else 0):
            where = (i, state.now_ns, mode.phase, mode.reason)
            assert math.isfinite(position[i]), where
            assert limits.low[i] - 1e-6 <= position[i] <= limits.high[i] + 1e-6, where
            assert abs(velocity[i]) <= limits.velocity[i] * (1 + 1e-6), where
            assert abs(acceleration[i]) <= limits.acceleration[i] * (1 + 1e-3) + 1e-6, where
            moved, expected = position[i] - state.commanded[i], 0.5 * (velocity[i] + state.commanded_velocity[i]) * dt
            assert abs(moved - expected) <= limits.acceleration[i] * dt * dt + 1e-9, where
            if self.with_jerk:
                change = abs(acceleration[i] - state.commanded_acceleration[i])
                assert change <= limits.jerk[i] * dt * 1.01 + 1e-4, where
        if self.checked:
            verdict = self.guard.apply(state, target, mode.tolerates_saturation)
            assert verdict is GuardResult.PASS, (
                state.now_ns,
                self.guard.code,
                self.guard.axis,
                self.guard.value,
                self.guard.limit,
            )
        else:
            state.commanded, state.commanded_velocity, state.commanded_acceleration = position, velocity, acceleration
        self._measured()

    def clamped(self, mode: Controller, target: Setpoint, before: Sequence[float]) -> None:
        """A mode that the guards may cut: what they make of it keeps to the limits, and they never have to stop it."""
        state, dt, limits = self.state, self.period_s, self.limits
        speeds = list(self.means)
        verdict = self.guard.apply(state, target, mode.tolerates_saturation)
        assert verdict in (GuardResult.PASS, GuardResult.CLAMPED), (state.now_ns, verdict)
        self.cuts += verdict is GuardResult.CLAMPED
        self.means = [(after - q) / dt for after, q in zip(state.commanded, before, strict=True)]
        for i, (mean, last) in enumerate(zip(self.means, speeds, strict=True)):
            where = (i, state.now_ns, mode.phase, mode.reason)
            assert limits.low[i] - 1e-6 <= state.commanded[i] <= limits.high[i] + 1e-6, where
            assert abs(mean) <= limits.velocity[i] * (1 + 1e-6), where
            assert abs(mean - last) <= limits.acceleration[i] * dt * (1 + 1e-3) + 1e-6, where
        self._measured()

    def _measured(self) -> None:
        state = self.state
        state.actual, state.actual_velocity = list(state.commanded), list(state.commanded_velocity)
        state.now_ns += round(self.period_s * 1e9)
        self.path.append(list(state.commanded))

    def run(self, mode: Controller, cycles: int) -> None:
        """So many cycles."""
        for _ in range(cycles):
            self.cycle(mode)

    def until_rest(self, mode: Controller, most_s: float = 60.0) -> float:
        """Run until the mode holds and return how long it took, s; at rest then."""
        began = self.state.now_ns
        while mode.phase is not Phase.HOLD:
            self.cycle(mode)
            assert (self.state.now_ns - began) * 1e-9 < most_s
        self.cycle(mode)
        assert max(map(abs, self.state.commanded_velocity)) < 1e-6
        return (self.state.now_ns - began) * 1e-9


@pytest.fixture(scope="session")
def arm() -> ArmConfig:
    return load(Path(__file__).parents[3] / "config" / "assistive_arm.yaml")


@pytest.fixture
def drive(arm: ArmConfig) -> Drive:
    return Drive(arm)


@pytest.fixture
def bounds(drive: Drive) -> Limits:
    return drive.limits


@pytest.fixture(scope="session")
def new_drive(arm: ArmConfig) -> Callable[..., Drive]:
    return lambda **given: Drive(arm, **given)


@pytest.fixture(scope="session")
def memory() -> Callable[[Iterable[Sequence[float]]], Any]:
    """Lay rows out as the plan area does."""
    return lambda rows: memoryview(array.array("d", [number for row in rows for number in row]))
