"""Paths with arcs and blends: times beside those with rests, and random programs through the simulated loop.

    python benchmarks/paths.py --programs 200 --plans 10000 --seed 1

The table has one program of ten ways, with rests and with blends of several radii: its duration, the largest distance
of the blended path from the one with rests, and the share of the commanded speed at the slowest place. Random programs
run on the in-process bus; every frame that a drive gets is decoded and checked as in `tests/sessions`: limits of
position, velocity and acceleration, boxes, the arm itself. That takes minutes for each hundred, so `--plans` plans more
of them only, and samples what their rows make of every joint, 40 places between two rows.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections import Counter
from collections.abc import Sequence
from math import inf
from pathlib import Path
from random import Random

import numpy as np
from scipy.interpolate import BPoly

sys.path.insert(0, str(Path(__file__).parents[1]))

from kinematics.forward import forward, forward_batch, frames
from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.config.model import ArmConfig, Stop
from rtcp.ipc.commands import Halt, RunTrajectory
from rtcp.ipc.states import State
from rtcp.motion.guards.zones import Zones
from rtcp.motion.limits import Limits
from rtcp.motion.planning import preview
from rtcp.motion.planning.path import plan_path
from rtcp.motion.planning.plan import ACCELERATIONS, POSITIONS, VELOCITIES, Plan, PlanRefused
from tests.sessions.oracle import commander_of

HERE = (0.0, -0.2, 2.0, 0.0, 1.0, 0.0)


def ten_ways(config: ArmConfig, blend: float) -> list[Stop]:
    """Return eight lines, an arc and a joint move around `HERE`."""
    assert config.arm is not None
    start = forward(config.arm, HERE)
    x, y, z = start.position

    def at(dy: float, dz: float, dx: float = 0.0) -> Stop:
        return Stop((x + dx, y + dy, z + dz, *start.rpy), blend=blend, speed=0.1)

    corners = [(0.1, 0.0), (0.1, -0.1), (0.0, -0.1), (-0.1, -0.1), (-0.1, 0.0), (-0.1, 0.1), (0.0, 0.1)]
    arc = Stop((x + 0.1, y + 0.1, z + 0.1, *start.rpy), via=(x + 0.05, y + 0.05, z + 0.12), speed=0.1, blend=blend)
    return [*(at(*one) for one in corners), arc, at(0.05, 0.0, 0.05), Stop(q=HERE, by_joints=True)]


def table(config: ArmConfig) -> None:
    """Print durations and deviations by the radius."""
    assert config.arm is not None
    limits = Limits(config)
    places = {}
    print(
        "| radius, mm | duration, s | largest distance from the path with rests, mm | least part of the speed | rows |"
    )
    print("|---|---|---|---|---|")
    for radius in (0.0, 0.005, 0.01, 0.02, 0.03, 0.05):
        plan = plan_path(config.arm, limits, config.cartesian, HERE, ten_ways(config, radius))
        way = _dense(plan)
        places[radius] = forward_batch(config.arm, way)[0]
        apart = max(float(np.linalg.norm(places[0.0] - place, axis=1).min()) for place in places[radius])
        print(
            f"| {1e3 * radius:g} | {plan.duration_s:.2f} | {1e3 * apart:.2f} | {plan.slowed:.2f} | {len(plan.rows)} |"
        )


def _dense(plan: Plan) -> list[tuple[float, ...]]:
    preview.SAMPLES = 4000
    return preview.planned(plan, HERE, None)


def random_stop(random: Random, config: ArmConfig) -> Stop:
    """Return a stop around `HERE`: a line, an arc, a joint move, with or without a blend."""
    assert config.arm is not None
    start = forward(config.arm, HERE)

    def place() -> tuple[float, float, float]:
        x, y, z = start.position
        return x + random.uniform(-0.15, 0.15), y + random.uniform(-0.25, 0.25), z + random.uniform(-0.2, 0.2)

    turn = [one + random.uniform(-0.3, 0.3) for one in start.rpy]
    pose = (*place(), turn[0], turn[1], turn[2])
    blend = random.choice((0.0, 0.002, 0.01, 0.03, 0.1))
    kind = random.randrange(4)
    if kind == 0:
        return Stop(pose, via=place(), speed=random.uniform(0.02, 0.25), blend=blend)
    if kind == 1:
        q = tuple(at + random.uniform(-0.5, 0.5) for at in HERE)
        return Stop(q=q, by_joints=True, speed=random.uniform(0.1, 0.5), blend=blend)
    return Stop(pose, speed=random.uniform(0.02, 0.25), blend=blend)


def run_programs(config: ArmConfig, count: int, seed: int, minutes: float) -> None:
    """Run random programs, one of ten with a halt under way, and print what the frames showed."""
    assert config.arm is not None
    random, ends_at = Random(seed), time.monotonic() + 60.0 * minutes
    commander = commander_of(config, seed, HERE)
    simulation, limits, refused = commander.simulation, Limits(config), Counter[str]()
    zones = Zones(config.arm, limits, config.cartesian.clearance)
    arm = config.arm

    def zone_at(q: Sequence[float]) -> str | None:
        return "a box or itself" if zones.distance(frames(arm, q))[0] < 0.0 else None

    simulation.hold()
    done = halted = 0
    for number in range(count):
        if time.monotonic() > ends_at:
            break
        q = list(simulation.loop.arm.state.commanded)
        program = [random_stop(random, config) for _ in range(random.randint(1, 8))]
        try:
            plan = plan_path(arm, limits, config.cartesian, q, program, zone_at=zone_at)
        except PlanRefused as error:
            refused[str(error).split(":")[-1].split("would")[0].strip()[:40]] += 1
            if number % 3 == 0:
                continue
            plan = (
                plan_path(arm, limits, config.cartesian, q, [Stop(q=HERE, by_joints=True)], zone_at=zone_at)
                if _away(q)
                else None
            )
            if plan is None:
                continue
        sent = simulation.send(RunTrajectory(simulation.observer.write_plan(plan.rows), len(plan.rows)))
        assert sent.refusal is None, sent.refusal
        if random.random() < 0.1:
            simulation.run(random.uniform(0.0, plan.duration_s))
            simulation.send(Halt())
            halted += 1
        simulation.bring_to(State.HOLDING, plan.duration_s + 5.0)
        if commander.checker.violations:
            break
        done += 1
    checker = commander.checker
    print(f"{done} programs run, {halted} of them halted under way; {sum(refused.values())} refused before the start")
    print(f"{checker.frames} frames decoded, {len(checker.violations)} violations {checker.violations[:3]}")
    step, acceleration = checker.largest_step, checker.largest_acceleration
    print(f"largest step {step:.4f}, largest acceleration {acceleration:.4f} of the limits")
    commander.close()


def plan_programs(config: ArmConfig, count: int, seed: int, minutes: float) -> None:
    """Plan random programs, each from where the one before ends, and print how near their rows come to the limits."""
    assert config.arm is not None
    random, limits, ends_at = Random(seed), Limits(config), time.monotonic() + 60.0 * minutes
    low, high, fastest, strongest = (
        np.array(one) for one in (limits.low, limits.high, limits.velocity, limits.acceleration)
    )
    done = refused = rows = 0
    most, seconds = np.zeros(2), 0.0
    q = HERE
    for _ in range(count):
        if time.monotonic() > ends_at:
            break
        program = [random_stop(random, config) for _ in range(random.randint(1, 8))]
        try:
            plan = plan_path(config.arm, limits, config.cartesian, q, program)
        except PlanRefused:
            refused, q = refused + 1, HERE
            continue
        points = np.array(plan.rows)
        t, places = points[:, 0], [points[:, at : at + 6] for at in (POSITIONS, VELOCITIES, ACCELERATIONS)]
        curve = BPoly.from_derivatives(t, np.stack(places, axis=1))
        at = (t[:-1, None] + np.diff(t)[:, None] * np.linspace(0.0, 1.0, 41)).ravel()
        where, speed, change = (curve(at, nu) for nu in range(3))
        assert (where >= low - 1e-6).all()
        assert (where <= high + 1e-6).all()
        most = np.maximum(most, [(np.abs(speed) / fastest).max(), (np.abs(change) / strongest).max()])
        done, rows, seconds, q = done + 1, rows + len(points), seconds + plan.duration_s, plan.end
    print(f"{done} programs planned, {refused} refused, {rows} rows, {seconds / 3600:.1f} h of motion")
    print(f"largest velocity {most[0]:.4f}, largest acceleration {most[1]:.4f} of the limits; no position beyond them")


def _away(q: Sequence[float]) -> bool:
    return max(abs(a - b) for a, b in zip(q, HERE, strict=True)) > 1e-3


def main() -> None:
    """Print the table, then run random programs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plans", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=inf, help="longest time for each of both")
    given = parser.parse_args()
    config = load(default_config())
    print(f"{time.strftime('%Y-%m-%d')}, {platform.machine()}, Python {platform.python_version()}")
    table(config)
    plan_programs(config, given.plans, given.seed, given.minutes)
    run_programs(config, given.programs, given.seed, given.minutes)


if __name__ == "__main__":
    main()
