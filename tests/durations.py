"""Tests that take long, and how long: `make check` and `make test` leave them out (`--longest S`).

After `python -m pytest --junitxml=REPORT.xml`, `python -m tests.durations REPORT.xml ...` writes `durations.txt` anew.
"""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

FILE = Path(__file__).with_suffix(".txt")
LEAST_S = 0.5
"""Shorter tests are not listed."""
ALWAYS = tuple(f"tests/e2e/test_{name}.py" for name in ("breaking", "deaths", "platform", "sessions"))
"""Files whose tests are never left out of what runs in real time: what stops the arm when something dies, and that no
frame breaks a limit."""


def read() -> dict[str, float]:
    """Return how long the listed tests take, s, by their names."""
    lines = (line.partition(" ") for line in FILE.read_text().splitlines())
    return {name: float(seconds) for seconds, _, name in lines}


def main() -> None:
    """Write the file from reports of pytest."""
    cases = [case for report in sys.argv[1:] for case in ElementTree.parse(report).iter("testcase")]
    names = {f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}": case for case in cases}
    seconds = {name: float(case.get("time", 0.0)) for name, case in names.items() if not name.startswith(ALWAYS)}
    listed = sorted((name, duration) for name, duration in seconds.items() if duration >= LEAST_S)
    FILE.write_text("".join(f"{duration:.1f} {name}\n" for name, duration in listed))


if __name__ == "__main__":
    main()
