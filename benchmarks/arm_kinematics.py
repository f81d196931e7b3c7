"""Speed and accuracy of the kinematics: `python benchmarks/arm_kinematics.py [--rounds N] [--poses N] [--json FILE]`.

Alternates in one run between this project, EAIK (analytic, C++), the numeric solver of roboticstoolbox-python (`ik_LM`,
C++) and Pinocchio (C++, with a damped-least-squares loop in Python). Missing libraries are listed
(`pip install -e .[oracles,benchmark]`). Poses are those of random configurations inside the limits of each arm.

A time is the median over the poses of one round, then the median, smallest and largest over the rounds. Errors of the
reported solutions come from a separate forward kinematics in matrices; a pose is solved when both errors of a solution
are below 1e-6.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import gc
import importlib
import importlib.util
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

# Python puts the folder of the script first in sys.path; without this line `kinematics` could mean a file there.
sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != Path(__file__).resolve().parent]

import numpy as np
import numpy.typing as npt
from rich import box
from rich.console import Console
from rich.table import Table

from kinematics.damped_least_squares import NumericResult, solve_numeric
from kinematics.forward import forward, forward_batch, frames
from kinematics.gravity import gravity_torques
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import jacobian
from kinematics.model import ArmModel
from kinematics.pose import Pose
from kinematics.urdf import to_urdf
from rtcp.config import find_arm, load_kinematics

Array = npt.NDArray[np.float64]

SOLVED = 1e-6
"""Largest error of a solution, m and rad."""
STEP = 0.02
"""Largest joint motion to the next pose, rad."""
BATCH = 100_000
AIMS = {"near": (15.0, "us for the solution that continues a motion"), "all": (40.0, "us for all solutions")}

TASKS = {
    "near": "continue a motion",  # each joint within STEP
    "all": "all solutions",
    "cold": "from a distant start",
    "forward": "forward",
    "batch": f"forward, {BATCH} at once",  # time per pose
    "jacobian": "Jacobian",
    "gravity": "gravity",
}


@dataclass(frozen=True)
class Case:
    """An arm and the measured configurations `q`, shape (N, 6), rad; `near` are the preceding ones of a motion."""

    model: ArmModel
    q: Array
    near: Array
    poses: list[Pose]
    targets: Array
    """Matrices of the poses, shape (N, 4, 4)."""


@dataclass
class Contender:
    """A function to be timed: `solve(i)` handles configuration i; `joints` extracts the solutions from its answer."""

    task: str
    name: str
    solve: Callable[[int], Any]
    joints: Callable[[Any], Sequence[Sequence[float]]] | None = None
    per_call: int = 1
    medians: list[float] = field(default_factory=list)
    slow: list[float] = field(default_factory=list)
    answers: list[Any] = field(default_factory=list)


def matrices(model: ArmModel, q: Array) -> Array:
    """Return the tool poses, shape (N, 4, 4), independently of the measured code."""
    found = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for row, angle in zip(model.rows, q.T, strict=True):
        ca, sa = np.cos(row.alpha), np.sin(row.alpha)
        step = np.array([[1, 0, 0, row.a], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
        turn = np.zeros((len(q), 4, 4))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle + row.offset)
        turn[:, 1, 0] = np.sin(angle + row.offset)
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = turn[:, 3, 3] = 1.0
        turn[:, 2, 3] = row.d
        found = found @ step @ turn
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = np.reshape(model.tool.rotation, (3, 3)), model.tool.position
    return np.asarray(found @ tool)


def case_of(model: ArmModel, count: int, seed: int) -> Case:
    random = np.random.default_rng(seed)
    low, high = np.array([(limit.lower, limit.upper) for limit in model.limits]).T
    q = random.uniform(low, high, (count, 6))
    near = np.clip(q + random.uniform(-STEP, STEP, q.shape), low, high)
    return Case(model, q, near, [forward(model, one) for one in q.tolist()], matrices(model, q))


def ours(case: Case, batch: Array) -> list[Contender]:
    model, poses, q, near = case.model, case.poses, case.q.tolist(), case.near.tolist()
    inverse = InverseKinematics(model)
    solve, solve_near = inverse.solve, inverse.solve_near
    found = [
        Contender("near", "solve_near", lambda i: solve_near(poses[i], near[i]), lambda r: [r.q] if r.q else []),
        Contender("near", "solve_numeric", lambda i: solve_numeric(model, poses[i], near[i]), _converged),
        Contender("all", "solve", lambda i: solve(poses[i]), lambda r: [one.q for one in r.solutions]),
        Contender("forward", "forward", lambda i: forward(model, q[i])),
        Contender("batch", "forward_batch", lambda _: forward_batch(model, batch), per_call=len(batch)),
        Contender("jacobian", "jacobian", lambda i: jacobian(model, q[i])),
    ]
    if model.links:
        found.append(Contender("gravity", "gravity_torques", lambda i: gravity_torques(model, q[i])))
    return found


def _converged(answer: NumericResult) -> list[Sequence[float]]:
    return [answer.q] if answer.converged else []


def eaik(case: Case) -> list[Contender]:
    """EAIK takes axes and offsets at zero, and no tool rotation, which is removed from the targets beforehand."""
    robot_class = importlib.import_module("eaik.IK_HP").HPRobot
    zero = frames(case.model, [0.0] * 6)
    origins = np.array([(0.0, 0.0, 0.0), *(pose.position for pose in zero)])
    axes = np.array([pose.rotation[2::3] for pose in zero[:6]])
    robot = robot_class(axes, np.diff(origins, axis=0))
    targets = case.targets.copy()
    targets[:, :3, :3] = targets[:, :3, :3] @ np.reshape(zero[6].rotation, (3, 3)).T

    def joints(answer: Any) -> list[Sequence[float]]:
        return [q for q, fitted in zip(answer.Q, answer.is_LS, strict=True) if not fitted]

    return [
        Contender("all", "EAIK", lambda i: robot.IK(targets[i]), joints),
        Contender("forward", "EAIK", lambda i: robot.fwdKin(case.q[i])),
    ]


def toolbox(case: Case) -> list[Contender]:
    """`ik_LM` stops when half the squared error is below its `tol`: 1e-13 corresponds to about 4e-7."""
    rtb = importlib.import_module("roboticstoolbox")
    parts = []
    for row, limit in zip(case.model.rows, case.model.limits, strict=True):
        constant = ((rtb.ET.Rx, row.alpha), (rtb.ET.tx, row.a), (rtb.ET.Rz, row.offset))
        parts += [make(value) for make, value in constant if value]
        parts.append(rtb.ET.Rz(qlim=[limit.lower, limit.upper]))
        parts += [rtb.ET.tz(row.d)] if row.d else []
    parts += [rtb.ET.SE3(matrices_of(case.model.tool))] if case.model.tool != Pose.from_xyzrpy(0, 0, 0, 0, 0, 0) else []
    chain = rtb.ETS(parts)

    def joints(answer: Any) -> list[Sequence[float]]:
        return [answer.q] if answer.success else []

    return [
        Contender("near", "toolbox ik_LM", lambda i: chain.ik_LM(case.targets[i], q0=case.near[i], tol=1e-13), joints),
        Contender("cold", "toolbox ik_LM", lambda i: chain.ik_LM(case.targets[i], tol=1e-13), joints),
        Contender("forward", "toolbox fkine", lambda i: chain.fkine(case.q[i])),
        Contender("jacobian", "toolbox jacob0", lambda i: chain.jacob0(case.q[i])),
    ]


def matrices_of(pose: Pose) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(pose.rotation, (3, 3)), pose.position
    return matrix


def pinocchio(case: Case, batch: Array) -> list[Contender]:
    pin = importlib.import_module("pinocchio")
    model = pin.buildModelFromXML(to_urdf(case.model))
    data, tool, world = model.createData(), model.getFrameId("tool0"), pin.LOCAL_WORLD_ALIGNED
    targets = [pin.SE3(target) for target in case.targets]
    eye = 1e-8 * np.eye(6)

    def descend(i: int) -> Array | None:
        q = case.near[i].copy()
        for _ in range(50):
            pin.framesForwardKinematics(model, data, q)
            error = pin.log6(data.oMf[tool].actInv(targets[i])).vector
            if error @ error < 1e-20:
                return q
            matrix = pin.computeFrameJacobian(model, data, q, tool)
            q += matrix.T @ np.linalg.solve(matrix @ matrix.T + eye, error)
        return None

    def place(i: int) -> Any:
        pin.framesForwardKinematics(model, data, case.q[i])
        return data.oMf[tool]

    def one_by_one(_: int) -> None:
        for q in batch:
            pin.framesForwardKinematics(model, data, q)

    found = [
        Contender("near", "Pinocchio, DLS in Python", descend, lambda q: [] if q is None else [q]),
        Contender("forward", "Pinocchio", place),
        Contender("batch", "Pinocchio, one by one", one_by_one, per_call=len(batch)),
        Contender("jacobian", "Pinocchio", lambda i: pin.computeFrameJacobian(model, data, case.q[i], tool, world)),
    ]
    if case.model.links:
        gravity = pin.computeGeneralizedGravity
        found.append(Contender("gravity", "Pinocchio", lambda i: gravity(model, data, case.q[i])))
    return found


def contenders(case: Case) -> tuple[list[Contender], dict[str, str]]:
    """Return the contenders, and the reason for each that is missing."""
    batch = np.random.default_rng(1).uniform(-3.0, 3.0, (BATCH, 6))
    found, missing = ours(case, batch), {}
    others: tuple[tuple[str, str, Callable[[], list[Contender]]], ...] = (
        ("EAIK", "eaik", lambda: eaik(case)),
        ("roboticstoolbox-python", "roboticstoolbox", lambda: toolbox(case)),
        ("Pinocchio", "pinocchio", lambda: pinocchio(case, batch)),
    )
    for name, module, make in others:
        if importlib.util.find_spec(module) is None:
            missing[name] = "not installed"
            continue
        found += make()
    return sorted(found, key=lambda one: list(TASKS).index(one.task)), missing


def measure(one: Contender, count: int) -> None:
    """Time one round; keeps its answers."""
    calls = count if one.per_call == 1 else 3
    times, answers = [], []
    solve, clock = one.solve, time.perf_counter_ns
    for i in range(calls):
        begin = clock()
        answer = solve(i)
        times.append(clock() - begin)
        answers.append(answer)
    micro = np.array(times) / 1e3 / one.per_call
    one.medians.append(float(np.median(micro)))
    one.slow.append(float(np.percentile(micro, 99)))
    one.answers = answers


def judged(one: Contender, case: Case) -> dict[str, float]:
    """Return the share of poses solved, the solutions per pose, and the worst errors (m, rad) of the solutions."""
    if one.joints is None:
        return {}
    found = [one.joints(answer) for answer in one.answers]
    counts = [len(solutions) for solutions in found]
    result = {"solutions": sum(counts) / len(counts)}
    if not any(counts):
        return result | {"solved": 0.0}
    where = np.repeat(np.arange(len(counts)), counts)
    q = np.array([solution for solutions in found for solution in solutions], dtype=float)
    reached, wanted = matrices(case.model, q), case.targets[where]
    position = np.linalg.norm(reached[:, :3, 3] - wanted[:, :3, 3], axis=1)
    between = reached[:, :3, :3] - wanted[:, :3, :3]
    rotation = np.linalg.norm(between, axis=(1, 2)) / np.sqrt(2.0)  # 2 sin(angle / 2)
    good = (position < SOLVED) & (rotation < SOLVED)
    off = np.abs(np.remainder(q - case.q[where] + np.pi, 2 * np.pi) - np.pi).max(axis=1)
    limits = np.array([(limit.lower, limit.upper) for limit in case.model.limits])
    inside = ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=1)
    return result | {
        "solved": len(set(where[good])) / len(counts),
        "the configuration itself": len(set(where[good & (off < 1e-5)])) / len(counts),
        "inside the limits": len(set(where[good & inside])) / len(counts),
        "position error": float(position.max()),
        "rotation error": float(rotation.max()),
    }


def figures(one: Contender, case: Case) -> dict[str, Any]:
    return {
        "us": statistics.median(one.medians),
        "us over the rounds": [min(one.medians), max(one.medians)],
        "us p99": statistics.median(one.slow),
        **judged(one, case),
    }


def shown(found: dict[str, Any]) -> list[str]:
    def percent(key: str) -> str:
        return f"{100 * found[key]:.2f}" if key in found else ""

    low, high = found["us over the rounds"]
    digits = 1 if found["us"] >= 1 else 3
    errors = (f"{found[key]:.0e}" if key in found else "" for key in ("position error", "rotation error"))
    return [
        f"{found['us']:.{digits}f}",
        f"{low:.{digits}f} to {high:.{digits}f}",
        f"{found['us p99']:.{digits}f}",
        percent("solved"),
        percent("the configuration itself"),
        f"{found['solutions']:.1f}" if "solutions" in found else "",
        *errors,
    ]


def compare(model: ArmModel, rounds: int, count: int, console: Console) -> dict[str, Any]:
    """Measure every contender on one arm, print a table and return the figures."""
    case = case_of(model, count, seed=0)
    entries, missing = contenders(case)
    for one in entries:
        measure(one, min(count, 50))  # warm up
        one.medians.clear()
        one.slow.clear()
    gc.collect()
    gc.disable()  # as in the loop
    try:
        for _ in range(rounds):
            for one in entries:
                measure(one, count)
    finally:
        gc.enable()
    result: dict[str, Any] = {}
    table = Table(title=f"{model.name}: {count} poses, {rounds} rounds", box=box.SIMPLE_HEAD)
    for heading in ("", "us", "rounds", "p99", "solved %", "itself %", "found", "m", "rad"):
        table.add_column(heading, justify="left" if not heading else "right", no_wrap=True)
    for task, title in TASKS.items():
        of_task = [one for one in entries if one.task == task]
        if of_task:
            table.add_row(title, style="bold")
        for one in of_task:
            found = figures(one, case)
            result.setdefault(task, {})[one.name] = found
            table.add_row(f"  {one.name}", *shown(found))
    for name, reason in missing.items():
        table.add_row(name, reason)
    console.print(table)
    for task, (aim, what) in AIMS.items():
        found = next(iter(result[task].values()))["us"]
        console.print(f"aim: at most {aim:g} {what}; found {found:.1f}: {'met' if found <= aim else 'missed'}")
    speed = 1e6 / result["batch"]["forward_batch"]["us"]
    console.print(f"aim: 1e6 poses/s of forward_batch; found {speed:.2g}: {'met' if speed >= 1e6 else 'missed'}\n")
    return result


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="rounds of alternation")
    parser.add_argument("--poses", type=int, default=1000, help="random configurations of each arm")
    parser.add_argument("--arm", action="append", help="file or name of an arm; repeatable")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument("--out", type=Path, help="also write the output to this file")
    given = parser.parse_args()
    if given.rounds < 1 or given.poses < 1:
        parser.error("--rounds and --poses are at least 1")
    console = Console(record=True, width=None if sys.stdout.isatty() else 120)
    machine = (
        f"{platform.machine()}, {os.cpu_count()} CPUs, Linux {platform.release()}, Python {platform.python_version()}, "
        f"numpy {np.__version__}"
    )
    console.print(f"{machine}, {date.today().isoformat()}")
    found: dict[str, Any] = {"machine": machine, "date": date.today().isoformat(), "arms": {}}
    for name in given.arm or ("assistive_arm", "abb_irb120"):
        model = load_kinematics(find_arm(name))
        found["arms"][model.name] = compare(model, given.rounds, given.poses, console)
    if given.json:
        given.json.write_text(json.dumps(found, indent=2))
    if given.out:
        given.out.write_text(console.export_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
