"""What a cycle of the loop executes: `python benchmarks/instructions.py [hold joint cartesian joystick] [--source]`.

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
from math import cos, sin
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.compute import ACTIVITIES, PERIOD_US, activity
from kinematics.compiled import BUILD

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


def run_counted(name: str, library: str) -> None:
    """Warm up, switch counting on, run the cycles and switch it off."""
    marks = ctypes.CDLL(library)
    if name == "probe":
        probe(_WARM_UP)
        marks.start()
        probe(CYCLES)
        marks.stop()
        return
    with activity("hold" if name == "bus" else name) as running:
        for _ in range(_WARM_UP):
            running.step()
        gc.collect()
        gc.disable()
        if name != "bus":
            marks.start()
            for _ in range(CYCLES):
                running.step()
            marks.stop()
            return
        simulation = running.simulation
        data, now_ns = simulation.data, simulation.now_ns
        marks.start()
        for _ in range(CYCLES):
            now_ns += round(PERIOD_US * 1000)
            simulation.bus.advance_to(now_ns)
            data.send()
            data.receive()
        marks.stop()


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
    if unknown := set(given.activities) - set(ACTIVITIES):
        parser.error(f"found {', '.join(unknown)}, allowed are {', '.join(ACTIVITIES)}")
    try:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "mark.so"
            compiler = ["cc", "-O1", "-shared", "-fPIC", "-x", "c", "-", "-o", str(library)]
            subprocess.run(compiler, input=_MARKS, text=True, check=True)
            least = thousands("probe", True, library)
            print(f"probe {least:.0f} thousand instructions", flush=True)
            ways = ["source"] if given.source or not BUILD.is_used else ["source", "compiled"]
            for way in ways:
                bus = thousands("bus", way == "source", library)
                print(f"{way:9s} bus and device models {bus:.0f}", flush=True)
                for name in given.activities or ACTIVITIES:
                    loop = thousands(name, way == "source", library) - bus
                    print(f"{way:9s} {name:10s} loop {loop:.0f} = {loop / least:.1f} x the probe", flush=True)
    except (NotCounted, OSError, subprocess.CalledProcessError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
