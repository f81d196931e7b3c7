"""Runs the suite several times in random order on a busy host, and lists every test whose verdict changed.

Beside the tests four processes burn CPU time, and one fills the page cache. `make test-flaky` calls this program; the
arguments after `--` go to pytest. Exits with 1 if a verdict changed or a run failed.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

BURNERS = 4
PAGE_CACHE_BYTES = 2 << 30
_BLOCK = bytes(1 << 20)


def burn(parent: int) -> None:
    """Use a whole CPU while the parent process runs."""
    while os.getppid() == parent:
        for _ in range(100_000):
            pass


def fill_page_cache(directory: str, parent: int) -> None:
    """Write and read a large file over and over while the parent process runs."""
    with tempfile.TemporaryFile(dir=directory) as file:
        while os.getppid() == parent:
            file.seek(0)
            for _ in range(PAGE_CACHE_BYTES // len(_BLOCK)):
                file.write(_BLOCK)
            file.seek(0)
            while file.read(len(_BLOCK)):
                pass


@contextlib.contextmanager
def busy_host() -> Iterator[None]:
    """Keep the host busy in this block."""
    with tempfile.TemporaryDirectory() as directory:
        load = [multiprocessing.Process(target=burn, args=(os.getpid(),), daemon=True) for _ in range(BURNERS)]
        load.append(multiprocessing.Process(target=fill_page_cache, args=(directory, os.getpid()), daemon=True))
        for process in load:
            process.start()
        try:
            yield
        finally:
            for process in load:
                process.kill()
                process.join()


def verdict(case: ElementTree.Element) -> str:
    """Return the verdict of a test in a report of pytest."""
    kinds = {child.tag: child.get("message", "") for child in case}
    if "inconclusive" in kinds.get("skipped", ""):
        return "inconclusive"
    return next((kind for kind in ("error", "failure", "skipped") if kind in kinds), "passed")


def main() -> int:
    """Run the suite and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32), help="of the first run")
    parser.add_argument("pytest", nargs="*")
    given = parser.parse_args()
    verdicts: dict[str, list[str]] = defaultdict(list)
    failed = False
    with tempfile.TemporaryDirectory() as reports, busy_host():
        for number in range(given.runs):
            report, began = Path(reports) / f"{number}.xml", time.monotonic()
            seed = (given.seed + number) % (1 << 32)
            options = [f"--randomly-seed={seed}", f"--junitxml={report}", "--fail-on-flaky", "-q", "--no-header"]
            done = subprocess.run([sys.executable, "-m", "pytest", *options, *given.pytest], check=False)
            failed = failed or done.returncode != 0
            print(f"run {number + 1} of {given.runs}, seed {seed}: {time.monotonic() - began:.0f} s", flush=True)
            for case in ElementTree.parse(report).iter("testcase"):
                verdicts[f"{case.get('classname')}::{case.get('name')}"].append(verdict(case))
    # An inconclusive measurement says nothing, so it changes nothing.
    judged = {name: set(found) - {"inconclusive"} for name, found in verdicts.items()}
    changed = {name: verdicts[name] for name, found in judged.items() if len(found) > 1}
    for name, found in sorted(changed.items()):
        print(f"{name}: {', '.join(found)}")
    inconclusive = sum("inconclusive" in found for found in verdicts.values())
    print(f"{len(verdicts)} tests, {given.runs} runs: {len(changed)} verdicts changed, {inconclusive} inconclusive")
    return int(failed or bool(changed))


if __name__ == "__main__":
    sys.exit(main())
