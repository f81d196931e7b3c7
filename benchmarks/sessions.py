"""Random sessions, checked by the bytes that went over the bus.

`python benchmarks/sessions.py --sessions 10000 --seed 1` runs the sessions of seeds 1 to 10000 on all CPUs, prints
what came of them and exits with 1 on a failure. A failing seed runs again by `--seed N --sessions 1`.

`python benchmarks/sessions.py --bus virtual --minutes 3 --seed 1` runs one on a real platform: its processes, its
control socket, and the frames that reached its segment, captured there and checked afterwards. `--bus egm` does the
same with a virtual IRC5 and its datagrams.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

# The sessions are the tests' own.
sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.sessions.egm_session import EgmOutcome, run_on_egm
from tests.sessions.session import Outcome, run_session
from tests.sessions.wire_session import run_on_the_wire


def table(title: str, counts: Counter[str]) -> None:
    print(f"{title}: " + ", ".join(f"{name} {count}" for name, count in counts.most_common()))


def show(outcome: Outcome, wall_s: float) -> None:
    print(f"sessions            {outcome.sessions}")
    print(f"cycles              {outcome.cycles}, of which with a drive enabled {outcome.checked}")
    print(f"simulated           {outcome.simulated_s:.0f} s in {wall_s:.0f} s")
    table("commands taken     ", outcome.taken)
    table("commands refused   ", outcome.refused)
    table("faults             ", outcome.faults)
    table("seen in states     ", outcome.states)
    print(f"largest step        {outcome.step:.4f} of what is allowed")
    print(f"largest acceleration {outcome.acceleration:.4f} of what is allowed")
    print(f"failures            {len(outcome.failures)}")
    for seed, sentences in outcome.failures[:10]:
        print(f"  seed {seed}:")
        for sentence in sentences:
            print(f"    {sentence}")


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1, help="of the first session; the others follow")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--stop", type=int, default=10, help="end after so many failures")
    parser.add_argument("--bus", choices=("inprocess", "virtual", "egm"), default="inprocess")
    parser.add_argument("--minutes", type=float, default=3.0, help="of the session on the bus virtual or egm")
    parser.add_argument("--period", type=int, default=2000, help="its cycle, us")
    parser.add_argument("--keep", type=Path, help="file in which its frames are kept")
    given = parser.parse_args()
    began = time.monotonic()
    if given.bus == "egm":
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        return show_egm(run_on_egm(given.seed, 60.0 * given.minutes, given.keep))
    if given.bus == "virtual":
        # However it ends, no platform stays behind.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        total = run_on_the_wire(given.seed, 60.0 * given.minutes, given.period, given.keep)
    else:
        total = run_inprocess(given)
    show(total, time.monotonic() - began)
    return 1 if total.failures else 0


def show_egm(outcome: EgmOutcome) -> int:
    """Print what came of a session on the virtual IRC5; return 1 on a failure."""
    for name in ("taken", "refused", "requests", "states"):
        counts = getattr(outcome, name)
        print(f"{name:<20}{', '.join(f'{key} {count}' for key, count in counts.most_common())}")
    print(f"replies             {outcome.replies}, the largest speed {outcome.largest_speed:.3f} of its limit")
    for failure in outcome.failures:
        print(f"FAILED: {failure}")
    return 1 if outcome.failures else 0


def run_inprocess(given: argparse.Namespace) -> Outcome:
    total = Outcome()
    shown = time.monotonic()
    seeds = range(given.seed, given.seed + given.sessions)
    # Ctrl-C ends it with what is known by then.
    with suppress(KeyboardInterrupt), multiprocessing.Pool(given.processes, initializer=_ignore_interrupts) as pool:
        for outcome in pool.imap_unordered(run_session, seeds, chunksize=4):
            total.add(outcome)
            if time.monotonic() - shown > 10:
                shown = time.monotonic()
                print(f"... {total.sessions} sessions, {len(total.failures)} failures", file=sys.stderr, flush=True)
            if len(total.failures) >= given.stop:
                break
    return total


if __name__ == "__main__":
    sys.exit(main())
