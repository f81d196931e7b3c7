"""Sessions until the first that does not pass; runs in the changed copy, with as many processes as there are CPUs."""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
from functools import partial

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.testing.sessions.session import Result, run_session

SECONDS = 2.0
"""Simulated time of a session, s."""


def run(config: ArmConfig, seed: int) -> Result:
    """Run the session of a seed."""
    return run_session(seed, config, SECONDS)


def main(kind: str, seed: int, count: int) -> None:
    """Print the number of sessions until the fault was found, or 0, and the violation or the error."""
    config = load(default_config())
    with multiprocessing.Pool(len(os.sched_getaffinity(0))) as pool:
        for number, result in enumerate(pool.imap(partial(run, config), range(seed, seed + count)), 1):
            if result.outcome != "passed":
                json.dump((number, f"seed {result.seed}: {result.violation}"), sys.stdout)
                return
    json.dump((0, f"in {count} sessions"), sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
