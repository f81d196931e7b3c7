"""An answerer and masters against it, each in a process of its own."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
CONFIG = HERE.parents[1] / "config" / "segment.yaml"


@contextlib.contextmanager
def answerer(seed: int) -> Iterator[int]:
    """Run an answerer with the shipped segment meanwhile; yield its process id."""
    process = subprocess.Popen(
        [sys.executable, str(HERE / "answerer.py"), str(CONFIG), str(seed)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        yield json.loads(process.stdout.readline())["pid"]
    finally:
        process.stdin.close()
        process.wait()
        process.stdout.close()


def master(pid: int, scenario: str, amount: int, *further: str) -> subprocess.CompletedProcess[str]:
    """Run a scenario of master_child.py against the answerer `pid`."""
    command = [sys.executable, str(HERE / "master_child.py"), str(pid), scenario, str(amount), *further]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def report_of(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """Return the report of a master; assert that it ended normally."""
    assert done.returncode == 0, f"ended with {done.returncode}: {done.stderr[-3000:]}"
    report: dict[str, Any] = json.loads(done.stdout)
    return report
