"""What observers cost the cycle: `python benchmarks/observers.py [--seconds N] [--rounds N] [--ratio] [--json FILE]`.

In one run, alternating: the platform with its slave watcher nearly off (`bus.watch_ms: 1000`) and no reader; with the
watcher every 10 ms, a reader that copies every record from the blackboard, and `rtcp status --watch`; and, as the
watcher's worst case, with the last drive losing its supply for 50 ms every second. With the timer alone (`spin_us: 0`),
whose wake-up p99 observers could delay, and as shipped; the first two in joint motion. Medians over the rounds;
the ratio is that of the medians. Exit code 1 where it is above 1.2.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from datetime import date
from pathlib import Path

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parent))

from cycle import Round, figures, platform_round, spread

from rtcp.config.find import find_config
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory, segment_control
from rtcp.virtual.faults.control import SegmentAway, SegmentClient, SegmentRefused

WATCH_MS = {"alone": 1000, "observed": 10, "setting up": 10}
TURN_S = 0.01
AIM = 1.2


def configured(directory: Path, watch_ms: int, spin_us: int) -> Path:
    """Copy the default configuration with these two numbers; return the arm's file."""
    copied = directory / f"watch-{watch_ms}-{spin_us}"
    shutil.rmtree(copied, ignore_errors=True)
    shutil.copytree(find_config(None).parent, copied)
    arm = copied / find_config(None).name
    text = re.sub(r"spin_us: \d+", f"spin_us: {spin_us}", arm.read_text())
    arm.write_text(re.sub(r"(\n *lost_cycles:)", rf"\n  watch_ms: {watch_ms}\1", re.sub(r"\n *watch_ms:.*", "", text)))
    return arm


def read_everything() -> None:
    """Copy every record from the blackboard, for ever: what a recorder does."""
    observer = Observer(blackboard_file(runtime_directory()))
    at = observer.head
    while True:
        records, missed = observer.since(at)
        at += len(records) + missed
        time.sleep(TURN_S)


@contextlib.contextmanager
def observers() -> Iterator[None]:
    """Run a reader and `rtcp status --watch` once the blackboard exists."""
    script = (
        "import sys, time; sys.path.insert(0, sys.argv[1]); import observers; from pathlib import Path\n"
        "while not observers.blackboard_file(observers.runtime_directory()).exists(): time.sleep(0.1)\n"
        "time.sleep(1.0); observers.read_everything()"
    )
    watch = f"while :; do {sys.executable} -m rtcp.cli status --watch; sleep 0.2; done"
    quiet = subprocess.DEVNULL
    commands = ([sys.executable, "-c", script, str(Path(__file__).parent)], ["sh", "-c", watch])
    started = [
        subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
        for command in commands
    ]
    try:
        yield
    finally:
        for child in started:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()


@contextlib.contextmanager
def losses() -> Iterator[None]:
    """Take the last drive's supply away for 50 ms every second."""
    ended = threading.Event()

    def lose() -> None:
        while not (runtime_directory() / "started.json").exists() and not ended.wait(0.1):
            pass
        # By then the arm is enabled and measured.
        ended.wait(1.5)
        while not ended.wait(1.0):
            with (
                contextlib.suppress(SegmentAway, SegmentRefused, OSError),
                SegmentClient(segment_control(runtime_directory())) as segment,
            ):
                segment.fault({"fault": "power", "slave": 7, "lasts": 0.05})

    thread = threading.Thread(target=lose, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def measure(directory: Path, kind: str, spin_us: int, seconds: float) -> Round:
    """Run one round."""
    config = configured(directory, WATCH_MS[kind], spin_us)
    try:
        with contextlib.ExitStack() as around:
            if kind == "observed":
                around.enter_context(observers())
            elif kind == "setting up":
                around.enter_context(losses())
            active = None if kind == "setting up" else "joint"
            return platform_round(500, seconds, poll=False, active=active, config=config)
    finally:
        shutil.rmtree(config.parent)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="length of one measurement")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--ratio", action="store_true", help="only the two measurements that the ratio is made of")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    machine = (
        f"{platform.machine()}, {os.cpu_count()} CPUs, Linux {platform.release()}, Python {platform.python_version()}"
    )
    console = Console()
    console.print(f"{machine}, {date.today().isoformat()}")
    found: dict[str, object] = {"machine": machine, "date": date.today().isoformat()}
    with tempfile.TemporaryDirectory(prefix="rtcp-bench-") as directory:
        os.environ["RTCP_RUNTIME_DIR"] = os.environ["RTCP_STATE_DIR"] = directory
        spins, kinds = ((0,), ("alone", "observed")) if given.ratio else ((0, 40), tuple(WATCH_MS))
        runs: dict[tuple[str, int], list[Round]] = {(kind, spin): [] for spin in spins for kind in kinds}
        for turn in range(given.rounds):
            # To and fro: what the host does to whoever comes first hits each of them as often.
            for kind, spin in list(runs)[:: -1 if turn % 2 else 1]:
                runs[kind, spin].append(measure(Path(directory), kind, spin, given.seconds))
    table = Table(title=f"500 us cycle, {given.rounds} rounds of {given.seconds:g} s, joint motion; us")
    for heading in ("", "p50", "p99", "p99.9", "max", "p99 over the rounds"):
        table.add_column(heading, justify="left" if not heading else "right")
    for spin in spins:
        for what in ("wakeup", "exchange", "compute"):
            for kind in kinds:
                samples = [getattr(run, what) for run in runs[kind, spin]]
                numbers = figures(samples)
                found[f"{what}, {kind}, spin_us {spin}"] = numbers
                table.add_row(
                    f"{what}, spin_us {spin}, {kind}",
                    *(f"{numbers[key]:.1f}" for key in ("p50", "p99", "p99.9", "max")),
                    spread(samples, "p99"),
                )
    console.print(table)
    ratio = (
        figures([run.wakeup for run in runs["observed", 0]])["p99"]
        / figures([run.wakeup for run in runs["alone", 0]])["p99"]
    )
    found["ratio"] = ratio
    console.print(f"wake-up p99 with the timer alone, observed / alone: {ratio:.2f}")
    if given.json:
        given.json.write_text(json.dumps(found, indent=2))
    return 0 if ratio <= AIM else 1


if __name__ == "__main__":
    sys.exit(main())
