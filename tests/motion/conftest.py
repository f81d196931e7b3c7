"""Controllers without a loop: their setpoints reach the state through the guards, and every cycle is checked."""

from __future__ import annotations

import array
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import pytest

from kinematics.forward import forward, frames
from kinematics.jacobian import singularity_distances
from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, FrameName
from rtcp.ipc.commands import Command
from rtcp.ipc.refusals import Refusal
from rtcp.motion.controllers import Controller, ControllerSetup, JogController
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Phase, Setpoint
from tests.samples import THOROUGH

PERIOD = 0.0005
JOG_PERIOD = 0.0005 if THOROUGH else 0.002
SAMPLED = round(0.01 / JOG_PERIOD)
Rows = Callable[..., "tuple[memoryview[float], int]"]
"""Plans points; returns the rows and their count."""
C = TypeVar("C", bound=Controller)

ARM = load(default_config())
MODEL = ARM.arm
ZERO = [0.0] * 6


def no_plan(slot: int) -> memoryview[float]:
    raise LookupError(slot)


@dataclass
class Drive:
    """Runs controllers one after another on one state and checks every cycle against the limits."""

    config: ArmConfig
    state: ArmState = field(default_factory=lambda: ArmState(6))
    period_s: float = PERIOD
    with_jerk: bool = False
    checked: bool = True
    path: list[list[float]] = field(default_factory=list)
    means: list[float] = field(default_factory=lambda: [0.0] * 6)
    cuts: int = 0
    plans: list[memoryview[float]] = field(default_factory=lambda: [None, None])
    active: Controller | None = None

    def __post_init__(self) -> None:
        self.limits = Limits(self.config)
        self.guard = TrajectoryGuard(replace(self.config, arm=None), self.limits, self.period_s)

    def controller(self, kind: type[C], **changes: Any) -> C:
        """A controller of this arm, or of one whose configuration differs in `changes`."""
        config = replace(self.config, **changes)
        return kind(ControllerSetup(config, self.limits, self.guard, self.period_s, self.plans.__getitem__))

    def command(self, controller: Controller, command: Command) -> Refusal | None:
        """Send a command; the commander continues its own motion if this controller moves the arm."""
        continues = self.active is controller and controller.phase is Phase.MOVE
        refusal = controller.accept(command, self.state, continues)
        if refusal is None:
            self.active = controller
        return refusal

    def execute(self, controller: Controller, rows: memoryview[float], count: int) -> Refusal | None:
        """Put a plan into a slot and start it."""
        self.plans[0] = rows
        run: Callable[[int, int], Command] = controller.commands[0]
        return self.command(controller, run(0, count))

    def at(self, q: Sequence[float]) -> Drive:
        """Put the arm to rest at `q`, rad."""
        self.state.commanded = [float(angle) for angle in q]
        self.state.actual = list(self.state.commanded)
        self.guard.latch(self.state)
        return self

    def cycle(self, mode: Controller) -> None:
        """One cycle: continuous, inside range, speed and acceleration."""
        state, dt, limits = self.state, self.period_s, self.limits
        target = mode.update(state)
        before = list(state.commanded)
        position, velocity = list(target.position), list(target.velocity)
        if mode.tolerates_saturation:
            self.clamped(mode, target, before)
            return
        acceleration = [(after - before) / dt for before, after in zip(state.commanded_velocity, velocity, strict=True)]
        for i in range(6 if self.checked else 0):
            where = (i, state.now_ns, mode.phase, mode.ended)
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
            assert verdict is GuardResult.PASS, (state.now_ns, self.guard.ended)
        else:
            state.commanded, state.commanded_velocity, state.commanded_acceleration = position, velocity, acceleration
        self._measured()

    def clamped(self, mode: Controller, target: Setpoint, before: Sequence[float]) -> None:
        """One cycle of a controller that tolerates saturation: the guards may clamp its setpoint, never stop it."""
        state, dt, limits = self.state, self.period_s, self.limits
        speeds = list(self.means)
        verdict = self.guard.apply(state, target, mode.tolerates_saturation)
        assert verdict in (GuardResult.PASS, GuardResult.CLAMPED), (state.now_ns, verdict)
        self.cuts += verdict is GuardResult.CLAMPED
        self.means = [(after - q) / dt for after, q in zip(state.commanded, before, strict=True)]
        for i, (mean, last) in enumerate(zip(self.means, speeds, strict=True)):
            where = (i, state.now_ns, mode.phase, mode.ended)
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
        for _ in range(cycles):
            self.cycle(mode)

    def until_rest(self, mode: Controller, most_s: float = 60.0) -> float:
        """Run until the controller holds at rest; return the time, s."""
        began = self.state.now_ns
        while mode.phase is not Phase.HOLD:
            self.cycle(mode)
            assert (self.state.now_ns - began) * 1e-9 < most_s
        self.cycle(mode)
        assert max(map(abs, self.state.commanded_velocity)) < 1e-6
        return (self.state.now_ns - began) * 1e-9


@pytest.fixture(scope="session")
def arm() -> ArmConfig:
    return load(Path(__file__).parents[2] / "config" / "assistive_arm.yaml")


@pytest.fixture
def drive(arm: ArmConfig) -> Drive:
    return Drive(arm)


@pytest.fixture(scope="session")
def new_drive(arm: ArmConfig) -> Callable[..., Drive]:
    return lambda **given: Drive(arm, **given)


def memory(rows: Iterable[Sequence[float]]) -> memoryview[float]:
    """The rows as the plan area holds them."""
    return memoryview(bytearray(array.array("d", [number for row in rows for number in row]))).cast("d")


def near(value: float) -> Any:
    """A number that equals every float near to it, as a field of an event or a refusal."""
    return pytest.approx(value)


class Driven(Drive):
    """A jog from `q` with all guards; every cycle is checked."""

    def __init__(self, q: list[float]) -> None:
        super().__init__(ARM, period_s=JOG_PERIOD)
        self.guard = TrajectoryGuard(ARM, self.limits, JOG_PERIOD)
        self.jog = self.controller(JogController)
        self.tools: list[tuple[float, float, float]] = []
        self.least_distance = 1e9
        self.at(q)

    @property
    def tool(self) -> tuple[float, float, float]:
        return forward(MODEL, self.state.commanded).position

    @property
    def still(self) -> bool:
        return not any(self.state.commanded_velocity)

    @property
    def singularities(self) -> tuple[float, float, float]:
        return singularity_distances(MODEL, self.state.commanded)[:3]

    def jog_cycle(self) -> None:
        state = self.state
        before = list(state.commanded)
        self.cycle(self.jog)
        for old, new, w in zip(before, state.commanded, state.commanded_velocity, strict=True):
            assert abs(new - old - w * JOG_PERIOD) < 1e-12
        assert self.still or self.jog.phase is not Phase.HOLD

    def deflect(self, twist: list[float], seconds: float, frame: FrameName = "base") -> Driven:
        for cycle in range(round(seconds / JOG_PERIOD)):
            if self.jog.phase is Phase.HOLD and any(twist):
                self.jog.start()
            self.jog.command(twist, in_tool_frame=frame == "tool")
            self.jog_cycle()
            if cycle % SAMPLED == 0:
                self.tools.append(self.tool)
                self.least_distance = min(self.least_distance, self.distance())
        return self

    def distance(self) -> float:
        return self.guard.zones.distance(frames(MODEL, self.state.commanded))[0]

    def release(self, at_most_s: float = 1.0) -> float:
        """Return the time from the release of the joystick to HOLD, s."""
        start = self.state.now_ns
        while self.jog.phase is not Phase.HOLD:
            self.jog.command(ZERO, in_tool_frame=False)
            self.jog_cycle()
            assert self.state.now_ns - start < at_most_s * 1e9, self.state.commanded_velocity
        return (self.state.now_ns - start) * 1e-9
