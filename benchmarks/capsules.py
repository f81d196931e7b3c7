"""Distances of bodies beside those of coal: `python benchmarks/capsules.py [--count N]`, and what one costs.

Two IRB 120 face each other in random configurations, a random box beside them. Compared are the least distance of all
bodies of both, and each body's distance from the box; what overlaps a box has a depth that is defined in several
ways, so only its sign is. Instructions are counted as in `instructions.py`, which needs valgrind.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from math import pi
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from benchmarks.instructions import CAPSULES, NotCounted, marks, thousands
from kinematics.capsules import Placed, capsules, distance, from_box
from kinematics.compiled import BUILD
from kinematics.forward import frames
from kinematics.pose import Pose
from rtcp.config import find_arm, load_kinematics

OTHER = Pose.from_xyzrpy(0.65, 0.0, 0.0, 0.0, 0.0, pi)
"""Where the second arm stands; it faces the first one."""


class Comparison(NamedTuple):
    """How far both are from each other at most, m; and how many were compared."""

    arms: float
    boxes: float
    overlapping: int
    """Configurations in which the arms overlap."""
    in_boxes: int
    """Bodies that overlap a box."""
    ours_us: float
    theirs_us: float
    """Time for the least distance of two arms that are placed, us."""


def compare(count: int) -> Comparison:
    """Compare distances in `count` random configurations.

    Raises:
        ImportError: coal is not installed.
        AssertionError: only one of both says that a body overlaps a box.
    """
    import coal

    model = load_kinematics(find_arm("abb_irb120"))
    bodies = capsules(model)
    one, other = Placed(bodies), Placed(bodies)
    solids = [coal.Capsule(r, 2.0 * half) for r, half in zip(one.radii, one.halves, strict=True)]
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = 1e-9  # 1e-6 is its default

    def apart(first: object, at: object, second: object, there: object) -> float:
        result.clear()
        found: float = coal.distance(first, at, second, there, request, result)
        return found

    numbers = np.random.default_rng(32)
    low, high = (np.array([getattr(limit, end) for limit in model.limits]) for end in ("lower", "upper"))
    arms = boxes = ours = theirs = 0.0
    overlapping = in_boxes = 0
    for a, b in numbers.uniform(low, high, (count, 2, 6)).tolist():
        one.place(frames(model, a))
        other.place(frames(model, b), OTHER)
        began = time.perf_counter()
        least = distance(one, other)[0]
        ours += time.perf_counter() - began
        places = [_transforms(coal, placed) for placed in (one, other)]
        began = time.perf_counter()
        found = min(
            apart(first, at, second, there)
            for first, at in zip(solids, places[0], strict=True)
            for second, there in zip(solids, places[1], strict=True)
        )
        theirs += time.perf_counter() - began
        arms = max(arms, abs(least - found))
        overlapping += least < 0.0
        middle, half = numbers.uniform(-0.6, 0.9, 3), numbers.uniform(0.02, 0.3, 3)
        solid, there = coal.Box(*(2.0 * half)), coal.Transform3s(np.eye(3), middle)
        for which, (body, at) in enumerate(zip(solids, places[0], strict=True)):
            least, found = from_box(one, which, [*(middle - half), *(middle + half)])[0], apart(body, at, solid, there)
            if least > 0.0 or found > 0.0:
                boxes = max(boxes, abs(least - found))
            else:
                in_boxes += 1
    return Comparison(arms, boxes, overlapping, in_boxes, 1e6 * ours / count, 1e6 * theirs / count)


def _transforms(coal: object, placed: Placed) -> list[object]:
    """Where coal's capsules are, whose middle is their origin and whose axis is z."""
    made = []
    for start, along in np.reshape(placed.axes, (-1, 2, 3)):
        z = along / np.linalg.norm(along)
        x = np.cross(z, (1.0, 0.0, 0.0) if abs(z[0]) < 0.7 else (0.0, 1.0, 0.0))
        x /= np.linalg.norm(x)
        made.append(coal.Transform3s(np.column_stack([x, np.cross(z, x), z]), start + 0.5 * along))  # type: ignore[attr-defined]
    return made


def main() -> int:
    """Compare, count, and print a line a number."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="random configurations")
    given = parser.parse_args()
    try:
        found = compare(given.count)
        print(f"two arms  {given.count} configurations, {found.overlapping} overlap: {found.arms:.1e} m at most")
        print(f"boxes     {5 * given.count} bodies, {found.in_boxes} overlap: {found.boxes:.1e} m at most")
        print(f"two arms  {found.ours_us:.1f} us, coal from Python {found.theirs_us:.1f} us")
    except ImportError:
        print("coal is missing: make oracles", file=sys.stderr)
    try:
        with tempfile.TemporaryDirectory() as folder:
            library = marks(Path(folder))
            for way in ["source", "compiled"] if BUILD.is_used else ["source"]:
                for name, about in CAPSULES.items():
                    print(f"{way:9s} {thousands(name, way == 'source', library):6.2f} thousand: {about.__doc__}")
    except (NotCounted, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
