"""The exported C solver: the time of a call, and whether it gives what `kinematics` gives, on many poses.

    python benchmarks/moveit_solver.py --poses 1000000

A share of the poses is on or beside a singularity, and a share is out of reach.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from kinematics.forward import forward_batch
from kinematics.model import ArmModel
from rtcp.config import find_arm, load_kinematics
from tests.moveit.solver import CSolver, compare

AIM = 5.0
"""us for all solutions."""


def times(model: ArmModel, solver: CSolver, count: int) -> dict[str, np.ndarray]:
    """Times, us, of `count` calls of each function; each includes one reading of the clock."""
    random = np.random.default_rng(0)
    lower, upper = ([getattr(limit, side) for limit in model.limits] for side in ("lower", "upper"))
    q = random.uniform(lower, upper, (count, 6))
    positions, rotations = forward_batch(model, q)
    poses = np.hstack([positions, rotations.reshape(-1, 9)])
    near = q + random.uniform(-0.02, 0.02, q.shape)
    return {
        "all solutions": solver.many(poses, near)[2],
        "sorted from a seed": solver.many(poses, near, nearest=True)[2],
    }


def main() -> int:
    """Run the benchmark; exit code 1 where a solution differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=100_000, help="poses that are solved both ways")
    parser.add_argument("--calls", type=int, default=100_000, help="calls that are timed")
    parser.add_argument("--arm", action="append", help="file or name of an arm; repeatable")
    given = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} CPUs, Linux {platform.release()}")
    different = 0
    for name in given.arm or ("assistive_arm", "abb_irb120"):
        model = load_kinematics(find_arm(name))
        with tempfile.TemporaryDirectory() as scratch:
            solver = CSolver(model, Path(scratch))
            for task, us in times(model, solver, given.calls).items():
                median, late = np.median(us), np.percentile(us, 99)
                aim = f"; aim {AIM:g} us: {'met' if median <= AIM else 'missed'}" if task == "all solutions" else ""
                print(f"{model.name}: {task}: median {median:.2f} us, p99 {late:.2f} us{aim}")
            found = compare(model, solver, given.poses)
        different += found.different
        print(
            f"{model.name}: {found.poses} poses, {found.solutions} solutions, {found.singular} poses on a singularity, "
            f"{found.unreachable} out of reach: {found.different} different; largest difference {found.worst:.1e} rad"
        )
        if found.first:
            print(f"  {found.first}")
    return int(different > 0)


if __name__ == "__main__":
    sys.exit(main())
