"""Jogging, cycle by cycle, behind the guards and without a loop."""

from __future__ import annotations

from math import dist, hypot, pi
from pathlib import Path

import pytest

from kinematics import forward, frames, singularity_distances
from rtcp.config import load
from rtcp.config.model import ArmConfig
from rtcp.motion.envelope import SetPointGuard, Verdict
from rtcp.motion.jog import JogMode
from rtcp.motion.limits import Limits
from rtcp.motion.nearness import nearness
from rtcp.motion.state import MotionState, Phase

DT = 0.0005
BENT = [0.3, -0.4, 1.4, 0.2, 0.9, 0.1]


class Bench:
    def __init__(self, config: ArmConfig, q: list[float]) -> None:
        assert config.arm is not None
        self.model = config.arm
        self.limits = Limits(config)
        self.guards = SetPointGuard(config, self.limits, DT)
        self.jog = JogMode(config, config.arm, self.limits, self.guards, DT)
        self.state = MotionState(6)
        self.state.position = list(q)
        self.guards.latch(self.state)
        self.jog.start(self.state)
        self.verdicts: set[Verdict] = set()

    def run(self, twist: list[float], seconds: float, frame: str = "base") -> list[list[float]]:
        path = []
        for _ in range(round(seconds / DT)):
            self.jog.command(twist, frame)
            target = self.jog.update(self.state, DT)
            self.verdicts.add(self.guards.apply(self.state, target, True))
            path.append(list(self.state.position))
        return path

    def tool(self) -> tuple[float, float, float]:
        return forward(self.model, self.state.position).position


@pytest.fixture
def config() -> ArmConfig:
    return load(Path("config/assistive_arm.yaml"))


def along(axis: int, speed: float) -> list[float]:
    return [speed if i == axis else 0.0 for i in range(6)]


def test_the_tool_keeps_to_a_straight_line(config: ArmConfig) -> None:
    bench = Bench(config, BENT)
    x, y, z = bench.tool()
    for q in bench.run(along(1, 0.05), 1.0):
        px, _, pz = forward(bench.model, q).position
        assert hypot(px - x, pz - z) < 1e-4
    assert bench.tool()[1] - y > 0.03


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_it_comes_to_rest_when_nothing_is_asked_for(config: ArmConfig, axis: int, sign: float) -> None:
    bench = Bench(config, BENT)
    bench.run(along(axis, sign * 0.1), 4.0)
    bench.run([0.0] * 6, 1.5)
    assert bench.jog.phase is Phase.HOLD
    assert max(map(abs, bench.state.velocity)) == 0.0


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_it_stays_out_of_singularities_and_boxes_and_comes_back(config: ArmConfig, axis: int, sign: float) -> None:
    bench = Bench(config, BENT)
    least = config.cartesian.singularity
    for q in bench.run(along(axis, sign * 0.1), 9.0)[::50]:
        shoulder, elbow, wrist = nearness(frames(bench.model, q))
        assert shoulder > least.shoulder - 1e-3
        assert elbow > least.elbow - 2e-3
        assert wrist > least.wrist - 2e-3
    bench.run([0.0] * 6, 1.5)
    before = bench.tool()
    bench.jog.start(bench.state)
    bench.run(along(axis, -sign * 0.1), 2.0)
    assert -sign * (bench.tool()[axis] - before[axis]) > 0.05
    assert not bench.verdicts & {Verdict.STOPPING, Verdict.STOPPED}


def test_from_straight_up_it_can_be_led_down(config: ArmConfig) -> None:
    bench = Bench(config, [0.0] * 6)
    bench.run(along(2, -0.1), 3.0)
    assert bench.tool()[2] < 1.25


def test_from_straight_up_it_does_not_move_where_it_cannot(config: ArmConfig) -> None:
    bench = Bench(config, [0.0] * 6)
    bench.run(along(2, 0.1), 1.0)
    assert dist(bench.tool(), (0.0, 0.0, 1.3)) < 1e-3


def test_a_stop_is_not_taken_back(config: ArmConfig) -> None:
    bench = Bench(config, BENT)
    bench.run(along(1, 0.05), 0.5)
    bench.jog.stop(bench.state)
    bench.run(along(1, 0.05), 1.0)
    assert bench.jog.phase is Phase.HOLD


def test_nearness_is_what_the_kinematics_says(config: ArmConfig) -> None:
    assert config.arm is not None
    for q in (BENT, [0.0] * 6, [0.0, 0.0, pi / 2, 0.0, 0.4, 0.0], [1.0, -1.0, -2.0, 0.5, -1.2, 2.0]):
        assert nearness(frames(config.arm, q)) == pytest.approx(singularity_distances(config.arm, q)[:3], abs=1e-9)
