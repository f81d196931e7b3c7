"""What the loop computes in a cycle: `python benchmarks/compute.py [--rounds N] [--seconds N] [--probe] [--profile]`.

The whole loop on the bus `inprocess`, at 500 us, pinned to one CPU: holding, a joint move, straight lines, the
joystick; as source and compiled, alternating. A cycle is timed from the answer to its end. `--probe` times the least
of it beside, cycle by cycle: six drives unpacked, 34 trigonometric calls, six drives packed. `--profile` divides a
cycle by its parts, each without those that it calls.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import statistics
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import date
from math import cos, sin
from time import perf_counter_ns
from typing import Any

from rich.console import Console
from rich.table import Table

from kinematics.compiled import BUILD
from rtcp.config import default_config, load
from rtcp.config.model import Stop
from rtcp.ipc.commands import MotionCommand, MoveJoints, RunLines
from rtcp.ipc.states import State
from rtcp.motion.limits import Limits
from rtcp.motion.planning.lines import plan_lines
from rtcp.realtime.discipline import Discipline
from rtcp.telemetry.square import SPEED_M_S, place
from rtcp.testing.simulation import Simulation

PERIOD_US = 500.0
NEUTRAL, TOGGLE = 0x3F, 0x100
PRESSED = (0x3F & ~0b0101, 0x3F & ~0b1010)
"""Forward and left, backward and right: the joystick's contacts are active low."""
PRESSED_S = 1.0
START, TARGET = (0.3, 0.2, 0.9, 0.2, 0.6, 0.1), (1.3, -0.4, 1.5, 1.2, -0.4, 1.1)
PARTS = ("decode", "state", "controller", "guards", "encode", "record", "clock", "rest")
ACTIVITIES = ("hold", "joint", "cartesian", "joystick")
Step = Callable[[], None]


@dataclass(frozen=True)
class Activity:
    """An arm that is enabled, and what keeps it moving; `step` does one cycle of it."""

    simulation: Simulation
    step: Step


def _pairs(simulation: Simulation, there: MotionCommand, back: MotionCommand) -> Step:
    """Move to and fro."""
    turn = 0

    def step() -> None:
        nonlocal turn
        if simulation.state is State.HOLDING:
            refusal = simulation.send((there, back)[turn % 2]).refusal
            assert refusal is None, refusal
            turn += 1
        simulation.cycle()

    return step


def _joystick(simulation: Simulation) -> Step:
    box = simulation.box
    assert box is not None
    cycles = round(PRESSED_S * 1e6 / PERIOD_US)
    at = 0

    def step() -> None:
        nonlocal at
        contacts = PRESSED[at // cycles % 2] if at else NEUTRAL
        box.inputs = box.inputs & ~0x1FF | contacts | TOGGLE
        at += 1
        simulation.cycle()

    return step


@contextmanager
def activity(name: str) -> Iterator[Activity]:
    """Enable an arm and begin `name`: hold, joint, cartesian, joystick."""
    config = load(default_config())
    config = replace(config, cycle=replace(config.cycle, period_us=PERIOD_US))
    square = place(config, "xy")
    if name == "joystick":
        config = replace(config, control_mode="joystick")
    with Simulation(config, 1, positions=START if name == "joint" else square.start) as simulation:
        simulation.hold()
        if name == "joint":
            step = _pairs(simulation, MoveJoints(TARGET, 0.4, True), MoveJoints(START, 0.4, True))
        elif name == "cartesian":
            assert config.arm is not None
            stops = [Stop(pose=tuple(pose)) for pose in square.poses]
            plan = plan_lines(
                config.arm, Limits(config), config.cartesian, square.start, stops, speed=SPEED_M_S,
                zone_at=lambda q: None,
            )  # fmt: skip
            lines = RunLines(simulation.observer.write_plan(plan.rows), len(plan.rows))
            step = _pairs(simulation, lines, lines)
        else:
            step = _joystick(simulation) if name == "joystick" else simulation.cycle
        for _ in range(round(0.5e6 / PERIOD_US)):
            step()
        yield Activity(simulation, step)


def probe() -> Step:
    """Return the least that a cycle computes."""
    inputs, outputs = struct.Struct("<Hiihb"), struct.Struct("<Hiihb")
    images = [inputs.pack(0x1237, 1000 * axis, 10, 3, 8) for axis in range(6)]
    q = [0.0] * 6
    made = [b""] * 6

    def least() -> None:
        for axis, image in enumerate(images):
            _, position, _, _, _ = inputs.unpack(image)
            q[axis] = position * 1e-4
        total = 0.0
        for at in range(17):
            angle = q[at % 6]
            total += sin(angle) + cos(angle)
        for axis in range(6):
            made[axis] = outputs.pack(0x0F, round(q[axis] * 1e4), 0, 0, 8)

    return least


class Clock:
    """Times of the cycles' parts, ns: a part without the others that it calls.

    It puts a timer in the place of methods, which only the interpreter allows.
    """

    def __init__(self) -> None:
        self.parts = dict.fromkeys(PARTS, 0)
        self._inside: list[int] = []
        self._replaced: list[tuple[Any, str, Any]] = []

    def restore(self) -> None:
        """Put the methods back."""
        for owner, name, inner in self._replaced:
            setattr(owner, name, inner)

    def put(self, owner: Any, name: str, part: str) -> None:
        """Time a method of an object, or of a class, as a part."""
        inner = getattr(owner, name)
        parts, inside = self.parts, self._inside

        def timer(*arguments: Any) -> Any:
            inside.append(0)
            began = perf_counter_ns()
            try:
                return inner(*arguments)
            finally:
                took = perf_counter_ns() - began
                parts[part] += took - inside.pop()
                if inside:
                    inside[-1] += took

        self._replaced.append((owner, name, inner))
        setattr(owner, name, timer)


def compute_ns(activity: Activity, cycles: int, least: Step | None) -> tuple[list[int], list[int]]:
    """Return how long the loop computed in each cycle, and how long the probe took after it, ns."""
    data: Any = activity.simulation.data
    receive = data.receive
    answered = 0

    def timed_receive() -> int:
        nonlocal answered
        wkc: int = receive()
        answered = perf_counter_ns()
        return wkc

    data.receive = timed_receive
    computed, probed = [], []
    for _ in range(cycles):
        activity.step()
        computed.append(perf_counter_ns() - answered)
        if least is not None:
            began = perf_counter_ns()
            least()
            probed.append(perf_counter_ns() - began)
    data.receive = receive
    return computed, probed


def parts_ns(activity: Activity, cycles: int) -> dict[str, list[int]]:
    """Return how long each part took in each cycle, ns."""
    loop = activity.simulation.loop
    arm, clock = loop.arm, Clock()
    clock.put(arm, "decode", "decode")
    clock.put(loop.machine, "update", "state")
    for controller in arm.controllers.values():
        clock.put(controller, "update", "controller")
    clock.put(arm.trajectory_guard, "apply", "guards")
    clock.put(arm.output_limiter, "check", "guards")
    clock.put(arm, "encode", "encode")
    clock.put(loop, "_publish", "record")
    clock.put(Discipline, "observe", "clock")
    clock.put(Discipline, "next_wakeup", "clock")
    found: dict[str, list[int]] = {part: [] for part in (*PARTS, "all")}
    for _ in range(cycles):
        clock.parts.update(dict.fromkeys(PARTS, 0))
        computed, _ = compute_ns(activity, 1, None)
        rest = computed[0] - sum(clock.parts.values())
        for part, took in clock.parts.items():
            found[part].append(rest if part == "rest" else took)
        found["all"].append(computed[0])
    clock.restore()
    return found


def quantile(samples: list[int], hundredth: int) -> float:
    """Return a percentile, us."""
    return statistics.quantiles(samples, n=100)[hundredth - 1] * 1e-3


def profile(cycles: int, console: Console) -> None:
    """Print how long each part of a cycle takes."""
    table = Table(title="compute a cycle by part, median, us; the timers themselves included")
    for heading in ("", *PARTS, "all"):
        table.add_column(heading, justify="right" if heading else "left")
    for name in ACTIVITIES:
        with activity(name) as running:
            found = parts_ns(running, cycles)
        table.add_row(name, *(f"{quantile(found[part], 50):.1f}" for part in (*PARTS, "all")))
    console.print(table)


def measure(name: str, cycles: int, *, probing: bool) -> dict[str, float]:
    """Return the percentiles of an activity's cycles, us, and with the probe the ratio of the medians."""
    with activity(name) as running:
        computed, probed = compute_ns(running, cycles, probe() if probing else None)
    found = {f"p{hundredth}": quantile(computed, hundredth) for hundredth in (5, 50, 99)}
    found["p99 / p50"] = found["p99"] / found["p50"]
    if probing:
        found["probe p50"] = quantile(probed, 50)
        found["p50 / probe p50"] = found["p50"] / found["probe p50"]
    return found


def compare(given: argparse.Namespace, console: Console) -> None:
    """Print how long a cycle computes, as source and compiled, alternating; each figure in a process of its own."""
    ways = {"source": {"RTCP_PURE": "1"}}
    if BUILD.is_used:
        ways["compiled"] = {"RTCP_PURE": ""}
    else:
        console.print(f"the cycle compiled is not measured: {BUILD.reason}")
    found: dict[tuple[str, str], list[dict[str, float]]] = {(name, way): [] for name in ACTIVITIES for way in ways}
    for _ in range(given.rounds):
        for (name, way), rows in found.items():
            command = [sys.executable, __file__, "--one", name, "--seconds", str(given.seconds)]
            done = subprocess.run(
                [*command, "--probe"] if given.probe else command,
                env=os.environ | ways[way], stdout=subprocess.PIPE, text=True, check=True,
            )  # fmt: skip
            rows.append(json.loads(done.stdout))
    headings = list(found["hold", "source"][0])
    table = Table(title=f"compute a cycle, us: medians over {given.rounds} rounds of {given.seconds:g} s")
    for heading in ("", *headings, "over the rounds"):
        table.add_column(heading, justify="right" if heading else "left")
    for (name, way), rows in found.items():
        last = [row[headings[-1]] for row in rows]
        medians = [f"{statistics.median(row[heading] for row in rows):.1f}" for heading in headings]
        table.add_row(f"{name}, {way}", *medians, f"{min(last):.1f} to {max(last):.1f}")
    console.print(table)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="simulated time of each figure")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--probe", action="store_true", help="time the least of a cycle beside")
    parser.add_argument("--profile", action="store_true", help="divide a cycle by its parts")
    parser.add_argument("--one", choices=ACTIVITIES, help="measure this once, in this process; print JSON")
    given = parser.parse_args()
    cpu = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpu})
    gc.disable()
    cycles = round(given.seconds * 1e6 / PERIOD_US)
    if given.one:
        print(json.dumps(measure(given.one, cycles, probing=given.probe)))
        return 0
    console = Console()
    machine = f"{platform.machine()}, Linux {platform.release()}, Python {platform.python_version()}, CPU {cpu}"
    console.print(f"{machine}, {date.today().isoformat()}")
    if given.profile:
        profile(cycles, console)
    else:
        compare(given, console)
    return 0


if __name__ == "__main__":
    sys.exit(main())
