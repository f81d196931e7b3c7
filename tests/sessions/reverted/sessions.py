"""The sessions that do not pass; runs in the changed copy, with as many processes as there are CPUs."""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import pi

from rtcp.config import default_config, load
from rtcp.config.cell import Base, CellConfig, Member
from rtcp.config.model import ArmConfig
from rtcp.config.segment import SegmentConfig, load_segment
from rtcp.testing.sessions.run import Segment, run_session
from rtcp.testing.sessions.session import Result

SECONDS = 2.0
"""Simulated time of a session, s."""
PERIOD_US = 2000.0
"""Cycle of the arms, us: a quarter of the shipped arm's cycles take a quarter of the time."""


def an_arm() -> tuple[ArmConfig, SegmentConfig]:
    """Return the shipped arm and its slaves."""
    config = load(default_config())
    # The same time without answers is a fault.
    lost = round(config.bus.lost_cycles * config.cycle.period_us / PERIOD_US)
    cycle, bus = replace(config.cycle, period_us=PERIOD_US), replace(config.bus, lost_cycles=lost)
    config = replace(config, cycle=cycle, bus=bus)
    return config, load_segment(config.source.parent / config.bus.segment)


def a_cell() -> tuple[CellConfig, Mapping[str, SegmentConfig]]:
    """Return two of the shipped arms that face each other, and their slaves."""
    config, segment = an_arm()
    left, right = Member("left", config, Base()), Member("right", config, Base((-1.5, 0.0, 0.0), (0.0, 0.0, pi)))
    return CellConfig("two", silence_s=0.1, arms=(left, right)), {"left": segment, "right": segment}


def configured(kind: str) -> tuple[ArmConfig | CellConfig, Segment]:
    """Return what a session of this kind, `arm` or `cell`, is of."""
    return a_cell() if kind == "cell" else an_arm()


def run(config: ArmConfig | CellConfig, segment: Segment, seed: int) -> Result:
    """Run the session of a seed."""
    return run_session(seed, config, SECONDS, segment)


def main(kind: str, seed: int, count: int) -> None:
    """Print a line of JSON for each session that does not pass: its seed, and the violation or the error."""
    config, segment = configured(kind)
    with multiprocessing.Pool(len(os.sched_getaffinity(0))) as pool:
        for result in pool.imap(partial(run, config, segment), range(seed, seed + count)):
            if result.outcome != "passed":
                print(json.dumps((result.seed, result.violation)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
