"""How well the cycle holds: `python benchmarks/cycle.py [--seconds N] [--rounds N] [--json FILE]`.

In one run, alternating: cyclictest (Debian's rt-tests) with the loop's interval, priority and CPU, and the platform on
its virtual segment with six drives enabled and moving. Then the mean cycle and the average deviation for the ten cycle
targets of the thesis, beside the thesis' own. Medians over the rounds; the ratio is that of the medians.

`--skipped 500 250` counts the ticks that were skipped, holding and in each motion, beside cyclictest's wake-ups that
came later than half a period, and the ticks that went by until then; all in 1000 ticks.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from rtcp.api import Robot, RtcpError, connect
from rtcp.config.find import find_config
from rtcp.config.loader import load
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory
from rtcp.launch.launcher import Platform, StartOptions, start
from rtcp.realtime.scheduling import choose_cpu
from rtcp.realtime.statistics import percentiles
from rtcp.telemetry.square import SPEED_M_S, place

THESIS = {
    200: (218.1, 21.4),
    300: (274, 23),
    400: (372, 39),
    500: (463, 46),
    600: (558, 67),
    700: (654, 40),
    800: (758, 42),
    900: (843, 56),
    1000: (940, 60),
    2000: (1879, 120),
}
"""Cycle target -> mean cycle and average deviation of the thesis, us (facts of the machine, experiments)."""

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Round:
    """What one run of the platform gave; arrays of shape (cycles,), us."""

    wakeup: Array
    exchange: Array
    compute: Array
    period: Array
    offset: Array
    filtered: Array
    missed: int
    start_to_op_s: float
    rss_mb: float


def cyclictest(cpu: int, priority: int, interval_us: int, seconds: float) -> Array | None:
    """Run cyclictest; return its latencies, shape (N,), us, or None where it is not installed."""
    if shutil.which("cyclictest") is None:
        return None
    command = ["cyclictest", "-q", "-m", "-t1", f"-p{priority}", f"-i{interval_us}", f"-a{cpu}", f"-D{round(seconds)}",
               "-h", "20000"]  # fmt: skip
    printed = subprocess.run(command, capture_output=True, text=True, check=False)
    counts = [
        (int(bin_us), int(count)) for bin_us, count in re.findall(r"^(\d{6}) (\d+)", printed.stdout, re.MULTILINE)
    ]
    if not counts:
        return None
    overflows = re.search(r"^# Histogram Overflows: (\d+)", printed.stdout, re.MULTILINE)
    counts.append((20000, int(overflows.group(1)) if overflows else 0))
    return np.repeat([bin_us for bin_us, _ in counts], [count for _, count in counts]).astype(float)


def move_back_and_forth(robot: Robot, turn: int) -> None:
    """Move the arm between two joint positions."""
    poses = ([0.4, -0.3, 0.5, 0.2, -0.4, 0.3], [0.0] * 6)
    robot.move_joints(poses[turn % 2])


def drive_squares(robot: Robot, turn: int) -> None:
    """Drive the square of the thesis along straight lines, again and again."""
    square = place(load(find_config(None)), "xy")
    if turn == 0:
        robot.move_joints(square.start)
    robot.move_line(square.poses, SPEED_M_S)


def hold_joystick(robot: Robot, turn: int) -> None:
    """Hold the virtual joystick, forward and left, then backward and right, for a second each."""
    if turn == 0:
        robot.move_joints(place(load(find_config(None)), "xy").start)
        robot.mode("joystick")
        robot.joystick(byte=63)
        time.sleep(0.2)
    pressed = ["forward", "left"] if turn % 2 == 0 else ["backward", "right"]
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        robot.joystick(*pressed, hold_s=0.5)
        time.sleep(0.2)


ACTIVE: dict[str, Callable[[Robot, int], None]] = {
    "joint": move_back_and_forth,
    "cartesian": drive_squares,
    "joystick": hold_joystick,
}
"""Motion of the arm while the cycle is measured."""


def keep_moving(active: str, stop: threading.Event, moving: threading.Event) -> None:
    """Move the arm until `stop`; a motion that fails is reported and ends it."""
    turn = 0
    with connect("benchmark") as robot:
        while not stop.is_set():
            if turn == 1 or active == "joint":
                moving.set()
            try:
                ACTIVE[active](robot, turn)
            except RtcpError as error:
                sys.stderr.write(f"the arm stopped moving: {error.message}\n")
                moving.set()
                return
            turn += 1


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return int(found.group(1)) / 1024 if found else float("nan")


def timer_alone(directory: Path) -> Path:
    """Copy the default configuration to `directory`, without the waiting awake before a tick; return the arm's file."""
    copied = directory / "timer-alone"
    shutil.copytree(find_config(None).parent, copied)
    arm = copied / find_config(None).name
    arm.write_text(re.sub(r"spin_us: \d+", "spin_us: 0", arm.read_text()))
    return arm


def platform_round(
    cycle_us: int, seconds: float, *, poll: bool, active: str | None, config: Path | None = None
) -> Round:
    """Start the platform, enable, let it run (moving or holding), stop; return what the cycle records tell."""
    options = StartOptions(config=config, cycle_us=float(cycle_us), poll=poll)
    running: Platform = start(options, lambda sentence: None)
    try:
        observer = Observer(blackboard_file(runtime_directory()))
        with connect("benchmark") as robot:
            robot.enable()
        stop, moving = threading.Event(), threading.Event()
        if active is not None:
            mover = threading.Thread(target=keep_moving, args=(active, stop, moving), daemon=True)
            mover.start()
            moving.wait(timeout=60.0)
        time.sleep(0.5)
        at, parts, lost = observer.head, [], 0
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            time.sleep(min(0.25, observer.records * cycle_us * 1e-6 / 4))
            records, missed = observer.since(at)
            at += len(records) + missed
            lost += missed
            parts.append(records)
        rss = resident_mb(running.processes.loop)
        stop.set()
        if active is not None:
            mover.join()
        observer.close()
    finally:
        running.stop()
    if lost:
        sys.stderr.write(f"{lost} cycle records were not read in time\n")
    records = np.concatenate(parts)
    return Round(
        wakeup=records["wakeup_ns"] / 1e3,
        exchange=records["exchange_ns"] / 1e3,
        compute=records["compute_ns"] / 1e3,
        period=np.diff(records["time_ns"]) / 1e3,
        offset=np.abs(records["dc_offset_ns"]) / 1e3,
        filtered=np.abs(records["dc_filtered_ns"]) / 1e3,
        missed=int(records["missed"][-1] - records["missed"][0]),
        start_to_op_s=float(running.facts.get("start_to_op_s") or 0.0),
        rss_mb=rss,
    )


def figures(samples: list[Array]) -> dict[str, float]:
    """Return the medians over the rounds of p50, p99, p99.9 and the largest of all."""
    each = [percentiles(sample) for sample in samples]
    return {
        "p50": statistics.median(one.p50 for one in each),
        "p99": statistics.median(one.p99 for one in each),
        "p99.9": statistics.median(one.p999 for one in each),
        "max": max(one.max for one in each),
    }


def spread(samples: list[Array], name: str) -> str:
    """Return the smallest and the largest of a percentile over the rounds."""
    values = [getattr(percentiles(sample), name) for sample in samples]
    return f"{min(values):.0f} to {max(values):.0f}"


def compare(
    cycle_us: int, seconds: float, rounds: int, directory: Path, *, poll: bool, active: str, console: Console
) -> dict[str, object]:
    """Alternate cyclictest and the platform; print the table; return the figures."""
    config = load(find_config(None))
    cpu, priority = choose_cpu(config.cycle.cpu), config.cycle.priority
    sleeper = timer_alone(directory)
    reference, runs, sleeping = [], [], []
    for _ in range(rounds):
        measured = cyclictest(cpu, priority, cycle_us, seconds)
        if measured is not None:
            reference.append(measured)
        runs.append(platform_round(cycle_us, seconds, poll=poll, active=active))
        sleeping.append(platform_round(cycle_us, seconds, poll=poll, active=active, config=sleeper))
    table = Table(title=f"{cycle_us} us cycle, {rounds} rounds of {seconds:g} s, CPU {cpu}, priority {priority}; us")
    for heading in ("", "p50", "p99", "p99.9", "max", "p99 over the rounds"):
        table.add_column(heading, justify="left" if not heading else "right")
    rows = {
        "cyclictest wake-up": reference,
        f"loop wake-up (spin_us {config.cycle.spin_us:g})": [run.wakeup for run in runs],
        "loop wake-up (spin_us 0)": [run.wakeup for run in sleeping],
        "loop exchange": [run.exchange for run in runs],
        "loop compute": [run.compute for run in runs],
        "DC offset, raw": [run.offset for run in runs],
        "DC offset, filtered": [run.filtered for run in runs],
    }
    result: dict[str, object] = {}
    for name, samples in rows.items():
        if not samples:
            table.add_row(name, "not installed", "", "", "", "")
            continue
        found = figures(samples)
        result[name] = found
        table.add_row(name, *(f"{found[key]:.1f}" for key in ("p50", "p99", "p99.9", "max")), spread(samples, "p99"))
    console.print(table)
    if reference:
        ratios = [figures([run.wakeup for run in each])["p99"] / figures(reference)["p99"] for each in (runs, sleeping)]
        result["ratio"], result["ratio_timer_alone"] = ratios
        console.print(f"wake-up p99, loop / cyclictest: {ratios[0]:.2f}; with the timer alone: {ratios[1]:.2f}")
    periods = np.concatenate([run.period for run in runs])
    error = (periods.mean() - cycle_us) / cycle_us * 100
    cycles = sum(run.period.size for run in runs)
    ticks = cycles + sum(run.missed for run in runs)
    grid_error = (periods.sum() / ticks - cycle_us) / cycle_us * 100
    console.print(
        f"mean cycle {periods.mean():.4f} us (error {error:+.4f} %), of the grid, with the {ticks - cycles} ticks of "
        f"{ticks} that were skipped: error {grid_error:+.5f} %; "
        f"start to OP {statistics.median(r.start_to_op_s for r in runs):.2f} s; "
        f"loop process {max(r.rss_mb for r in runs):.0f} MB resident"
    )
    result |= {"mean_us": float(periods.mean()), "error_percent": float(error), "grid_error_percent": float(grid_error)}
    return result


def skipped(
    periods: list[int], seconds: float, rounds: int, *, poll: bool, holding: bool, console: Console
) -> dict[str, object]:
    """Alternate cyclictest and the platform, holding and moving; print how many ticks were skipped, by period."""
    config = load(find_config(None))
    cpu, priority = choose_cpu(config.cycle.cpu), config.cycle.priority
    table = Table(title=f"skipped ticks, {rounds} rounds of {seconds:g} s, CPU {cpu}, priority {priority}")
    for heading in ("cycle, us", "", "skipped", "of", "in 1000", "cyclictest: late",
                    "its ticks", "ratio", "compute p50", "p99, us"):  # fmt: skip
        table.add_column(heading, justify="right" if heading else "left")
    result: dict[str, object] = {}
    for cycle_us in periods:
        runs: dict[str, list[Round]] = {active: [] for active in ("hold", *(() if holding else ACTIVE))}
        late, lost, wakeups = dict.fromkeys(runs, 0), dict.fromkeys(runs, 0), dict.fromkeys(runs, 0)
        for _ in range(rounds):
            for active, done in runs.items():
                measured = cyclictest(cpu, priority, cycle_us, seconds)
                if measured is not None:
                    late[active] += int((measured > cycle_us / 2).sum())
                    # One late wake-up of cyclictest skips the ticks after it as well.
                    lost[active] += int(np.ceil(np.clip(measured / cycle_us - 0.5, 0, None)).sum())
                    wakeups[active] += measured.size
                try:
                    done.append(
                        platform_round(cycle_us, seconds, poll=poll, active=None if active == "hold" else active)
                    )
                except RtcpError as error:
                    console.print(f"{cycle_us} us, {active}: {error.message}")
        for active, done in runs.items():
            if not done:
                continue
            per_mille = [1000 * count[active] / max(wakeups[active] + lost[active], 1) for count in (late, lost)]
            missed = sum(run.missed for run in done)
            ticks = missed + sum(run.wakeup.size for run in done)
            share = 1000 * missed / ticks
            ratio = share / per_mille[1] if per_mille[1] else None
            compute = figures([run.compute for run in done])
            console.print(f"{cycle_us} us, {active}: {missed} of {ticks} ticks skipped")
            result[f"{cycle_us} {active}"] = {"share": share, "cyclictest": per_mille, "ratio": ratio}
            table.add_row(
                str(cycle_us), active, str(missed), str(ticks), f"{share:.2f}", f"{per_mille[0]:.2f}",
                f"{per_mille[1]:.2f}", "-" if ratio is None else f"{ratio:.1f}",
                f"{compute['p50']:.0f}", f"{compute['p99']:.0f}",
            )  # fmt: skip
    console.print(table)
    return result


def targets(seconds: float, *, poll: bool, console: Console) -> dict[str, object]:
    """Run each cycle target of the thesis; print mean and average deviation beside the thesis' own."""
    table = Table(title=f"cycle targets, holding, {seconds:g} s each; us")
    for heading in (
        "target",
        "mean",
        "error %",
        "average deviation",
        "skipped",
        "thesis: mean",
        "error %",
        "deviation",
    ):
        table.add_column(heading, justify="right")
    result: dict[str, object] = {}
    for target, (mean, deviation) in THESIS.items():
        run = platform_round(target, seconds, poll=poll, active=None)
        own = float(run.period.mean())
        own_deviation = float(np.abs(run.period - own).mean())
        result[str(target)] = {"mean": own, "deviation": own_deviation, "skipped": run.missed}
        table.add_row(
            str(target), f"{own:.2f}", f"{(own - target) / target * 100:+.3f}", f"{own_deviation:.1f}", str(run.missed),
            f"{mean:g}", f"{(mean - target) / target * 100:+.1f}", f"{deviation:g}",
        )  # fmt: skip
    console.print(table)
    return result


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of one measurement")
    parser.add_argument("--rounds", type=int, default=3, help="how often cyclictest and the platform alternate")
    parser.add_argument("--cycle-us", type=int, default=500)
    parser.add_argument("--poll", action="store_true", help="let the segment poll on its own CPU")
    parser.add_argument("--no-targets", action="store_true", help="leave out the ten cycle targets")
    parser.add_argument(
        "--skipped", type=int, nargs="+", metavar="US", help="count the skipped ticks of these cycles, and nothing else"
    )
    parser.add_argument("--holding", action="store_true", help="with --skipped: only while holding")
    parser.add_argument(
        "--active", choices=sorted(ACTIVE), default="joint", help="what moves the arm: joint moves, lines, the stick"
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    given = parser.parse_args()
    # So that a platform that was started is ended too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    machine = (
        f"{platform.machine()}, {os.cpu_count()} CPUs, Linux {platform.release()}, Python {platform.python_version()}"
    )
    console.print(f"{machine}, {date.today().isoformat()}, {given.active} motion")
    with tempfile.TemporaryDirectory(prefix="rtcp-bench-") as directory:
        os.environ["RTCP_RUNTIME_DIR"] = os.environ["RTCP_STATE_DIR"] = directory
        found: dict[str, object] = {"machine": machine, "date": date.today().isoformat()}
        if given.skipped:
            found |= skipped(
                given.skipped, given.seconds, given.rounds, poll=given.poll, holding=given.holding, console=console
            )
        else:
            found |= compare(
                given.cycle_us,
                given.seconds,
                given.rounds,
                Path(directory),
                poll=given.poll,
                active=given.active,
                console=console,
            )
        if not given.no_targets and not given.skipped:
            found["targets"] = targets(given.seconds / 2, poll=given.poll, console=console)
    if given.json:
        given.json.write_text(json.dumps(found, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
