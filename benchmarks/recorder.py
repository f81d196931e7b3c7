"""What a recorder costs: `python benchmarks/recorder.py [--seconds N] [--rounds N] [--minutes N] [--hold] [--json F]`.

In one run, alternating, beside one platform on its virtual segment with a cycle of 500 us: without and with a recording
of every signal of every cycle (MCAP), and with the live view and a client of it that asked for everything and reads
nothing. Medians of the wake-up over the rounds; the ratios are those of the medians of p99.
Then one recording of `--minutes` for the resident memory without what is shared: at its quarters, and its slope by
least squares in the second half. Exit code 1 where a ratio is above 1.1, the recorder takes more than 10 % of a core,
or cycles are missing in a file.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))

from cycle import Array, figures, keep_moving, spread

from rtcp.api import RtcpError, connect
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory
from rtcp.launch.launcher import StartOptions, start
from tests.viewer import Viewer

CYCLE_US = 500.0
AIM_RATIO, AIM_CPU_PERCENT = 1.1, 10.0
SAMPLE_S = 0.5
FILE_MB = 100
"""One file of this size stays: an hour of every signal would be several GB, and a file's index, which its writer holds,
would hide what grows for ever."""


@dataclass
class Cost:
    """What the recorders of one kind of round have taken."""

    cpu_percent: list[float]
    resident: list[tuple[float, float]]
    """Time since the recording began, s, and resident memory of the process' own, MB."""
    records: int = 0
    missing: int = 0
    megabytes: float = 0.0


@contextlib.contextmanager
def recorded(directory: Path, cost: Cost) -> Iterator[psutil.Process]:
    """Record while inside, and add what it cost."""
    with connect("benchmark: recorder") as robot:
        process = psutil.Process(robot.record_start(directory, max_file_mb=FILE_MB, keep=1).pid)
        began, before = time.monotonic(), process.cpu_times()
        yield process
        now, elapsed = process.cpu_times(), time.monotonic() - began
        cost.cpu_percent.append(100 * (now.user + now.system - before.user - before.system) / elapsed)
        (ended,) = robot.record_stop()
    if ended.problem:
        sys.stderr.write(f"{ended.problem}\n")
    cost.records += ended.records
    cost.missing += ended.missing
    cost.megabytes += ended.bytes / 1e6
    for path in directory.glob("recording-*"):
        path.unlink()


@contextlib.contextmanager
def hanging_viewer() -> Iterator[None]:
    """Serve the live view, while inside, to a client that does not read."""
    command = [sys.executable, "-m", "rtcp.cli", "live", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            with Viewer(process.stdout.readline().partition(": ")[0]):
                yield
        finally:
            process.terminate()


def wakeups(seconds: float) -> Array:
    """Return the wake-up latencies of the cycle for a while, us."""
    with contextlib.closing(Observer(blackboard_file(runtime_directory()))) as observer:
        at, parts, lost, until = observer.head, [], 0, time.monotonic() + seconds
        while time.monotonic() < until:
            time.sleep(SAMPLE_S)
            records, missing = observer.since(at)
            at, lost = at + len(records) + missing, lost + missing
            parts.append(records["wakeup_ns"] / 1e3)
    if lost:
        sys.stderr.write(f"{lost} cycle records were not read in time\n")
    return np.concatenate(parts)


def rounds(directory: Path, seconds: float, count: int, cost: Cost) -> dict[str, list[Array]]:
    """Alternate without anybody, with a recording, with a live view; return the wake-ups of each round."""
    beside: dict[str, Callable[[], contextlib.AbstractContextManager[object]]] = {
        "without": contextlib.nullcontext,
        "recording": lambda: recorded(directory, cost),
        "live view": hanging_viewer,
    }
    found: dict[str, list[Array]] = {kind: [] for kind in beside}
    for turn in range(count):
        # To and fro: what the host does to whoever comes first hits each of them as often.
        for kind in list(found)[:: -1 if turn % 2 else 1]:
            with beside[kind]():
                found[kind].append(wakeups(seconds))
    return found


def watch_memory(directory: Path, minutes: float, cost: Cost) -> None:
    """Record for a while; note the resident memory."""
    with recorded(directory, cost) as process:
        began = time.monotonic()
        while (elapsed := time.monotonic() - began) < minutes * 60:
            memory = process.memory_info()
            # Shared is the ring, page by page as it is read for the first time, and belongs to the platform.
            cost.resident.append((elapsed, (memory.rss - memory.shared) / 1e6))
            time.sleep(SAMPLE_S)


def slope_mb_per_hour(resident: list[tuple[float, float]]) -> float:
    """Return the slope of the resident memory in the second half, MB/h."""
    times, sizes = np.array(resident[len(resident) // 2 :]).T
    return float(np.polyfit(times / 3600, sizes, 1)[0])


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seconds",
        type=float,
        default=8.0,
        help="of a round; a client that hangs is dropped at 10",
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=2.0, help="length of the recording for the memory")
    parser.add_argument("--hold", action="store_true", help="the arm holds; else it moves by its joints")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    machine = (
        f"{platform.machine()}, {os.cpu_count()} CPUs, Linux {platform.release()}, Python {platform.python_version()}"
    )
    load = f"load {os.getloadavg()[0]:.1f} before"
    console = Console()
    console.print(f"{machine}, {date.today().isoformat()}, {load}")
    short, long = Cost([], []), Cost([], [])
    with tempfile.TemporaryDirectory(prefix="rtcp-bench-") as name:
        os.environ["RTCP_RUNTIME_DIR"] = os.environ["RTCP_STATE_DIR"] = name
        running = start(StartOptions(cycle_us=CYCLE_US), lambda sentence: None)
        stop, moving = threading.Event(), threading.Event()
        mover = threading.Thread(target=keep_moving, args=("joint", stop, moving), daemon=True)
        try:
            with connect("benchmark") as robot:
                robot.enable()
            if not given.hold:
                mover.start()
                moving.wait(timeout=60.0)
            found = rounds(Path(name) / "out", given.seconds, given.rounds, short)
            watch_memory(Path(name) / "out", given.minutes, long)
            stop.set()
            if not given.hold:
                mover.join()
        except RtcpError as error:
            sys.stderr.write(f"{error.message}\n")
            return 1
        finally:
            running.stop()
    wakeup = {kind: figures(samples) for kind, samples in found.items()}
    how = "holding" if given.hold else "joint motion"
    table = Table(title=f"wake-up, {CYCLE_US:g} us cycle, {given.rounds} rounds of {given.seconds:g} s, {how}; us")
    for heading in ("", "p50", "p99", "p50 over the rounds", "p99 over the rounds"):
        table.add_column(heading, justify="left" if not heading else "right")
    for kind, samples in found.items():
        medians = [f"{wakeup[kind][key]:.1f}" for key in ("p50", "p99")]
        table.add_row(kind, *medians, spread(samples, "p50"), spread(samples, "p99"))
    console.print(table)
    ratios = {kind: one["p99"] / wakeup["without"]["p99"] for kind, one in wakeup.items() if kind != "without"}
    cpu = statistics.median(short.cpu_percent)
    missing, records = short.missing + long.missing, short.records + long.records
    slope = slope_mb_per_hour(long.resident)
    quarters = [long.resident[min(part * len(long.resident) // 4, len(long.resident) - 1)][1] for part in range(5)]
    console.print(
        f"wake-up p99, ratio to that without: {', '.join(f'{kind} {one:.2f}' for kind, one in ratios.items())}"
        f" (aim {AIM_RATIO:g})\n"
        f"CPU of the recorder: {cpu:.1f} % of a core, {long.cpu_percent[0]:.1f} % over {given.minutes:g} min"
        f" (aim {AIM_CPU_PERCENT:g} %); {1e6 * long.megabytes / max(long.records, 1):.0f} bytes a cycle\n"
        f"resident memory of its own: {', '.join(f'{one:.1f}' for one in quarters)} MB at the quarters,"
        f" slope {slope:+.1f} MB/h\n"
        f"cycles missing: {missing} of {records + missing}"
    )
    if given.json:
        result = {"machine": machine, "date": date.today().isoformat(), "load": load, "motion": how, "wakeup": wakeup,
                  "ratios": ratios, "cpu_percent": short.cpu_percent, "cpu_percent_long": long.cpu_percent[0],
                  "resident_mb": quarters, "slope_mb_per_hour": slope, "resident": long.resident,
                  "records": records, "missing": missing}  # fmt: skip
        given.json.write_text(json.dumps(result, indent=2))
    return 0 if max(ratios.values()) <= AIM_RATIO and cpu <= AIM_CPU_PERCENT and not missing else 1


if __name__ == "__main__":
    sys.exit(main())
