"""The arm of the default configuration, jogged in a simulated loop."""

from __future__ import annotations

import pytest

from kinematics.forward import forward, frames
from kinematics.jacobian import singularity_distances
from rtcp.config import default_config, load
from rtcp.motion.controllers.jog import JogController
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Phase

ARM = load(default_config())
MODEL = ARM.arm
PERIOD = ARM.cycle.period_us * 1e-6
ZERO = [0.0] * 6


class Driven:
    """The mode with its guards; every cycle is checked."""

    def __init__(self, q: list[float]) -> None:
        self.limits = Limits(ARM)
        self.trajectory_guard = TrajectoryGuard(ARM, self.limits, PERIOD)
        self.jog = JogController(ARM, MODEL, self.limits, self.trajectory_guard, PERIOD)
        self.state = ArmState(6)
        self.state.commanded[:] = q
        self.trajectory_guard.latch(self.state)
        self.path: list[tuple[float, float, float]] = []
        self.least_distance = 1e9

    @property
    def tool(self) -> tuple[float, float, float]:
        return forward(MODEL, self.state.commanded).position

    @property
    def still(self) -> bool:
        return not any(self.state.commanded_velocity)

    @property
    def singularities(self) -> tuple[float, float, float]:
        return singularity_distances(MODEL, self.state.commanded)[:3]

    def cycle(self) -> None:
        state, limits = self.state, self.limits
        before, speed = list(state.commanded), list(state.commanded_velocity)
        target = self.jog.update(state, PERIOD)
        verdict = self.trajectory_guard.apply(state, target, self.jog.tolerates_saturation)
        assert verdict is GuardResult.PASS, (
            verdict,
            self.trajectory_guard.held,
            self.trajectory_guard.code,
            self.trajectory_guard.value,
            before,
            speed,
        )
        for i, (old, new, v, w) in enumerate(
            zip(before, state.commanded, speed, state.commanded_velocity, strict=True)
        ):
            assert abs(w) <= limits.velocity[i] * (1.0 + 1e-6)
            assert abs(w - v) <= limits.acceleration[i] * PERIOD * (1.0 + 1e-6)
            assert abs(new - old - w * PERIOD) < 1e-12
            assert limits.low[i] <= new <= limits.high[i] or abs(new - old) < 1e-9
        if self.jog.phase is Phase.HOLD:
            assert self.still
        state.now_ns += ARM.cycle.period_us * 1000

    def run(self, twist: list[float], seconds: float, frame: str = "base") -> Driven:
        for cycle in range(round(seconds / PERIOD)):
            if self.jog.phase is Phase.HOLD and any(twist):
                self.jog.start(self.state)
            self.jog.command(twist, frame)
            self.cycle()
            if cycle % 20 == 0:
                self.path.append(self.tool)
                self.least_distance = min(self.least_distance, self.distance())
        return self

    def distance(self) -> float:
        return self.trajectory_guard.zones.distance(frames(MODEL, self.state.commanded))[0]

    def until_rest(self, at_most_s: float = 1.0) -> float:
        """Release the stick; return how long it takes to HOLD."""
        start = self.state.now_ns
        while self.jog.phase is not Phase.HOLD:
            self.jog.command(ZERO, "base")
            self.cycle()
            assert self.state.now_ns - start < at_most_s * 1e9, self.state.commanded_velocity
        return (self.state.now_ns - start) * 1e-9


@pytest.fixture
def jogged() -> type[Driven]:
    return Driven
