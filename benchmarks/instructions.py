"""What a cycle executes: `python benchmarks/instructions.py [hold joint cartesian joystick cell] [--source]`.

Instructions, counted by callgrind (Debian: apt install valgrind gcc) over 1000 cycles on the bus `inprocess`: the same
in every run, whatever else the host does. `loop` is a whole cycle less bus and device models; `probe` is the least that
a cycle must do in this interpreter: six drives unpacked, 34 trigonometric calls, six drives packed. The cycle runs as
source and, where it was compiled (`make fast`), compiled. `CALLGRIND_OUT=FILE` keeps the profile of the last run for
`callgrind_annotate`: of the compiled cycle it names the functions.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import os
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from math import cos, pi, sin
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.compute import ACTIVITIES, PERIOD_US, activity
from kinematics.capsules import Placed, capsules, distance, from_box, self_pairs
from kinematics.compiled import BUILD
from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.config import find_arm, load_kinematics
from rtcp.ipc.states import State
from tests.cell.random_steps import Pair, cell_of

CYCLES = 1000
_WARM_UP = 100
_MARKS = """#include <valgrind/callgrind.h>
void start(void) { CALLGRIND_START_INSTRUMENTATION; }
void stop(void) { CALLGRIND_STOP_INSTRUMENTATION; }
"""
_COUNT_PER_RAD = 1e4


class NotCounted(Exception):
    """Valgrind or the compiler is missing, or the counted process has failed: a sentence."""


def probe(cycles: int) -> None:
    """Do the least of a cycle."""
    inputs, outputs = struct.Struct("<HiiiB"), struct.Struct("<HiiiB")
    image, out = bytearray(6 * inputs.size), bytearray(6 * outputs.size)
    position, velocity, torque = [0.0] * 6, [0.0] * 6, [0.0] * 6
    factor = 1.0 / _COUNT_PER_RAD
    for _ in range(cycles):
        for i in range(6):
            _, q, v, effort, _ = inputs.unpack_from(image, i * inputs.size)
            position[i], velocity[i], torque[i] = q * factor, v * factor, effort * factor
        total = 0.0
        for i in range(17):
            angle = position[i % 6] + i
            total += sin(angle) * cos(angle)
        for i in range(6):
            counts = (
                int(position[i] * _COUNT_PER_RAD),
                int(velocity[i] * _COUNT_PER_RAD),
                int(torque[i] * _COUNT_PER_RAD),
            )
            outputs.pack_into(out, i * outputs.size, 15, *counts, 8)


@cache
def _two_arms() -> tuple[ArmModel, Placed, Placed, tuple[tuple[int, int], ...]]:
    """The model of an IRB 120, two of them facing each other, and the pairs of bodies of one that may collide."""
    model = load_kinematics(find_arm("abb_irb120"))
    one, other = Placed(capsules(model)), Placed(capsules(model))
    one.place(frames(model, [0.1, 0.2, 0.1, 0.3, 0.4, 0.5]))
    other.place(frames(model, [-0.1, 0.3, 0.2, 0.3, -0.4, 0.5]), Pose.from_xyzrpy(0.9, 0.0, 0.0, 0.0, 0.0, pi))
    return model, one, other, self_pairs(model)


def place(cycles: int) -> None:
    """frames and five bodies placed"""
    model, placed = _two_arms()[:2]
    q = [0.1, 0.2, 0.1, 0.3, 0.4, 0.5]
    for _ in range(cycles):
        placed.place(frames(model, q))


def between(cycles: int) -> None:
    """least distance of two arms, 25 pairs"""
    _, one, other, _ = _two_arms()
    for _ in range(cycles):
        distance(one, other)


def within(cycles: int) -> None:
    """least distance of one arm's bodies from each other, 5 pairs"""
    _, one, _, pairs = _two_arms()
    for _ in range(cycles):
        distance(one, one, pairs)


def box(cycles: int) -> None:
    """distance of a body from a box"""
    one = _two_arms()[1]
    for _ in range(cycles):
        from_box(one, 3, (0.4, -0.3, 0.2, 0.9, 0.3, 0.5))


CAPSULES: dict[str, Callable[[int], None]] = {"place": place, "between": between, "within": within, "box": box}
"""What `capsules.py` counts."""


def run_counted(name: str, library: str) -> None:
    """Warm up, switch counting on, run the cycles and switch it off."""
    counting = ctypes.CDLL(library)
    if run := {"probe": probe, **CAPSULES}.get(name):
        run(_WARM_UP)
        counting.start()
        run(CYCLES)
        counting.stop()
        return
    if name == "cell":
        count_in_a_cell(counting)
        return
    with activity("hold" if name == "bus" else name) as running:
        for _ in range(_WARM_UP):
            running.step()
        # A device model that works only while the arm moves, where `bus` is counted at rest.
        running.simulation.bus.segment.arm = None
        gc.collect()
        gc.disable()
        if name != "bus":
            counting.start()
            for _ in range(CYCLES):
                running.step()
            counting.stop()
            return
        simulation = running.simulation
        data, now_ns = simulation.data, simulation.now_ns
        counting.start()
        for _ in range(CYCLES):
            now_ns += round(PERIOD_US * 1000)
            simulation.bus.advance_to(now_ns)
            data.send()
            data.receive()
        counting.stop()


def count_in_a_cell(counting: ctypes.CDLL) -> None:
    """Count the cycles of one of two arms that move in step, 2 m apart."""
    pair = Pair(1, cell_of((PERIOD_US, PERIOD_US)))
    for arm in pair.simulation.arms.values():
        arm.on_frame = arm.bus.segment.arm = None
    motion = pair.begin()
    while motion.duration_s < 2.0 * CYCLES * PERIOD_US * 1e-6:
        pair.follow(motion, lambda: pair.rests_after(motion))  # noqa: B023
        motion = pair.begin()
    pair.simulation.until(lambda: pair.simulation.now_ns > motion.start_ns + 100_000_000, 5.0)
    left, right = pair.arm("left"), pair.arm("right")
    gc.collect()
    gc.disable()
    for _ in range(CYCLES):
        counting.start()
        left.cycle()
        counting.stop()
        right.cycle()
    assert left.state is right.state is State.MOVING


def thousands(name: str, source: bool, library: Path) -> float:
    """Return the thousands of instructions of a cycle; raises NotCounted."""
    environment = {key: value for key, value in os.environ.items() if key != "RTCP_PURE"} | {"PYTHONHASHSEED": "0"}
    if source:
        environment["RTCP_PURE"] = "1"
    out = os.environ.get("CALLGRIND_OUT", os.devnull)
    command = ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={out}"]
    command += [sys.executable, __file__, "--worker", name, "--library", str(library)]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise NotCounted("valgrind is missing: apt install valgrind") from error
    counted = re.search(r"Collected : (\d+)", done.stderr)
    if done.returncode or counted is None:
        raise NotCounted(done.stderr[-1500:])
    return int(counted[1]) / CYCLES / 1000


def marks(folder: Path) -> Path:
    """Return the library that switches counting on and off; raises NotCounted."""
    library = folder / "mark.so"
    compiler = ["cc", "-O1", "-shared", "-fPIC", "-x", "c", "-", "-o", str(library)]
    try:
        subprocess.run(compiler, input=_MARKS, text=True, check=True)
    except subprocess.CalledProcessError as error:
        raise NotCounted(str(error)) from error
    return library


def main() -> int:
    """Count, and print a line a number."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("activities", nargs="*", metavar="ACTIVITY", help=f"of {', '.join(ACTIVITIES)}")
    parser.add_argument("--source", action="store_true", help="the source only, also where it was compiled")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--library", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        run_counted(given.worker, given.library)
        return 0
    if unknown := set(given.activities) - {*ACTIVITIES, "cell"}:
        parser.error(f"found {', '.join(unknown)}, allowed are {', '.join((*ACTIVITIES, 'cell'))}")
    try:
        with tempfile.TemporaryDirectory() as folder:
            library = marks(Path(folder))
            least = thousands("probe", True, library)
            print(f"probe {least:.0f} thousand instructions", flush=True)
            ways = ["source"] if given.source or not BUILD.is_used else ["source", "compiled"]
            for way in ways:
                bus = thousands("bus", way == "source", library)
                print(f"{way:9s} bus and device models {bus:.0f}", flush=True)
                for name in given.activities or ACTIVITIES:
                    loop = thousands(name, way == "source", library) - bus
                    print(f"{way:9s} {name:10s} loop {loop:.0f} = {loop / least:.1f} x the probe", flush=True)
    except (NotCounted, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
