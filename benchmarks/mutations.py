"""Mutated frames, a million at the segment and a million at the master: nothing breaks, nothing grows, all recovers.

    python benchmarks/mutations.py --frames 1000000 --seed 1

The segment gets frames that pysoem and RegisterPort really send (tests/malformed/corpus.txt), mutated, in all states.
The master gets mutated answers: most over a real socket into SOEM's exchange of process data, a seventh into our own
parsers of registers, mailboxes and SDOs, a hundredth as process data into the real loop. Exits with 1 on a failure; the
part and the seed that it names fail again by `--part NAME --seed N --frames` with what it says.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

# What is played is the tests' own.
sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.malformed import mutated_answers, mutated_frames, mutated_loop
from tests.malformed.cable import answerer, master, report_of
from tests.malformed.mutated_frames import Outcome

A_JOB = 50_000
MOST_OBJECTS, MOST_KB = 20_000, 30_000
"""More than these at the end of a job than when all was warm, and something grows."""
EXCHANGES = 1.8
"""Exchanges for a mutated answer: every second one is, and the fence's frames beside them."""


def exchange(count: int, seed: int) -> Outcome:
    """Mutated answers over a real socket into SOEM; the last exchanges must be right again."""
    outcome = Outcome("master, SOEM on a socket")
    with answerer(seed) as pid:
        done = master(pid, "exchange", round(EXCHANGES * count))
    try:
        said = report_of(done)
    except AssertionError as failure:
        outcome.failures.append(str(failure))
        return outcome
    outcome.frames, outcome.seconds, outcome.kilobytes = said["mutated"], said["seconds"], said["kilobytes"]
    outcome.starts = int(said["recovered"])
    outcome.kinds.update(said["counters"])
    return outcome


class Part(NamedTuple):
    """What is played, which share of the frames it gets, and how many of them at a time."""

    play: Callable[[int, int], Outcome]
    share: float
    job: int


PARTS = {
    "segment": Part(mutated_frames.run, 1.0, A_JOB),
    "exchange": Part(exchange, 0.85, A_JOB),
    "parsers": Part(mutated_answers.run, 0.14, A_JOB // 5),
    "loop": Part(mutated_loop.run, 0.01, A_JOB // 50),
}


class Job(NamedTuple):
    """A part of a part."""

    part: str
    count: int
    seed: int


def run(job: Job) -> tuple[Job, Outcome]:
    """Play a job; what it has grown by or did not recover from is a failure like an exception."""
    os.nice(5)
    outcome = PARTS[job.part].play(job.count, job.seed)
    if not outcome.starts:
        outcome.failures.append("it did not recover")
    if outcome.objects > MOST_OBJECTS or outcome.kilobytes > MOST_KB:
        outcome.failures.append(f"it has grown by {outcome.objects} objects and {outcome.kilobytes} kB")
    return job, outcome


def jobs_of(names: list[str], frames: int, seed: int) -> list[Job]:
    """Share the frames out."""
    jobs = []
    for name in names:
        left = round(frames * PARTS[name].share)
        while left > 0:
            jobs.append(Job(name, min(left, PARTS[name].job), seed + len(jobs)))
            left -= jobs[-1].count
    return jobs


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000, help="for the segment, and for the master")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", choices=PARTS, help="this one alone")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    given = parser.parse_args()
    began = time.monotonic()
    totals = {name: Outcome(name) for name in ([given.part] if given.part else PARTS)}
    jobs = jobs_of(list(totals), given.frames, given.seed)
    # Each job has a process of its own: joining the answerer's namespace cannot be undone, and memory is told apart.
    with multiprocessing.get_context("spawn").Pool(given.processes, maxtasksperchild=1) as pool:
        for number, (job, outcome) in enumerate(pool.imap_unordered(run, jobs), 1):
            total = totals[job.part]
            total.name = outcome.name
            total.frames += outcome.frames
            total.seconds += outcome.seconds
            total.starts += outcome.starts
            total.kinds += outcome.kinds
            total.objects = max(total.objects, outcome.objects)
            total.kilobytes = max(total.kilobytes, outcome.kilobytes)
            total.failures += [f"{job}: {failure}" for failure in outcome.failures]
            print(f"... {number} of {len(jobs)} jobs", file=sys.stderr, flush=True)
    print(
        "part                      mutated frames  wall s  failures  objects  memory kB  recovered  what came of them"
    )
    for total in totals.values():
        kinds = ", ".join(f"{name} {count}" for name, count in total.kinds.most_common(4))
        print(f"{total.name:24}  {total.frames:12}  {total.seconds:7.0f}  {len(total.failures):8}  {total.objects:+7}"
              f"  {total.kilobytes:+9}  {total.starts:9}  {kinds}")  # fmt: skip
    print(f"in {time.monotonic() - began:.0f} s")
    failures = [failure for total in totals.values() for failure in total.failures]
    for failure in failures[:10]:
        print(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
