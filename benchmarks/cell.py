"""A cell on in-process buses: `python benchmarks/cell.py [--motions N] [--mishaps N] [--near N] [--seed S]`.

Two arms with cycles of 1 ms and 2 ms run random motions of twelve joints in step to their ends; then something happens
to one of them at a random instant. At last two arms that reach each other move at random, each by itself.
Every frame is decoded apart and checked against the limits. Exit code 1 for an arm
that begins alone, does not stop, leaves its path, does not come back, or a target outside a limit.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.cell.random_steps import Outcome, run_mishaps, run_motions, run_near

_EACH = 50
"""Motions with one cell; then a new one with the next seed."""


def main() -> int:
    """Run both and print what came of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--motions", type=int, default=100)
    parser.add_argument("--mishaps", type=int, default=100)
    parser.add_argument("--near", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    problems = 0
    for what, run, count in (("motions", run_motions, given.motions), ("mishaps", run_mishaps, given.mishaps)):
        began, total = time.perf_counter(), Outcome()
        for at in range(0, count, _EACH):
            found = run(given.seed + at // _EACH, min(_EACH, count - at))
            total.add(found)
            for one in found.problems:
                print(f"seed {given.seed + at // _EACH}: {one}", flush=True)
        problems += len(total.problems)
        print(f"{what}: {total.motions} in {time.perf_counter() - began:.0f} s, {len(total.problems)} problems")
        if what == "motions":
            begin, end = 1e-6 * total.begin_apart_ns, 1e-6 * total.end_apart_ns
            print(f"  begin apart at most {begin:.2f} ms, end {end:.2f} ms, on the way {1e3 * total.apart_s:.2f} ms")
            print(f"  goals missed by at most {total.off_goal:.1e} rad")
        else:
            rest_ms = 1e3 * total.rest_apart_s
            print(f"  off the path at most {total.off_path:.1e} rad, paths at rest apart {rest_ms:.4f} ms")
            for kind, longest in sorted(total.reaction_ns.items()):
                print(f"  {kind}: the other brakes after at most {1e-6 * longest:.1f} ms")
    least, stops, arrivals = math.inf, 0, 0
    for at in range(0, given.near, _EACH):
        near = run_near(given.seed + at // _EACH, min(_EACH, given.near - at))
        least, stops, arrivals = min(least, near.least_m), stops + near.stops, arrivals + near.arrivals
        problems += len(near.problems)
        for one in near.problems:
            print(f"seed {given.seed + at // _EACH}: {one}", flush=True)
    print(f"near each other: {stops} motions ended by the guard, {arrivals} arrived; least distance {least:.4f} m")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
