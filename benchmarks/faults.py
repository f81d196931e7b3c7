"""The fault matrix: `python benchmarks/faults.py [--only WORD] [--workload NAME] [--bus KIND] [--json FILE]`;
`make faults`.

Every fault of the virtual segment while the arm holds, moves in joint mode and is jogged: the reaction, the time until
every joint was at standstill (ground truth of the segment), the travel of a joint as a fraction of its stopping bound,
the largest step of any target as a fraction of what its speed limit allows, the first message, and what the recovery
took. A second table has the same of an arm behind a virtual IRC5 that speaks EGM; there the largest speed is that of
the references on the wire, as a fraction of its limit. A third one has a cell of two such arms: what happens to one of
them at rest, in motion and in step, and what becomes of the other. Exit code 1 where a reaction is not the required
one.
"""

from __future__ import annotations

import argparse
import json
import sys
from datetime import date
from pathlib import Path

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.e2e.conftest import Platform
from tests.faults import cell, egm
from tests.faults.cases import CASES
from tests.faults.run import HOLD_MS, columns, harness_of, run_case

HEADS = ("fault", "while", "reaction", "standstill, s", "travel", "largest step", "first message", "recovery")


def main() -> int:
    """Run the matrix and print it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="only cases with this in their name")
    parser.add_argument("--workload", default="", help="only holding, moving, jogging or joystick")
    parser.add_argument("--bus", choices=("ethercat", "egm", "cell"), help="only this table")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    given = parser.parse_args()
    tables = {"ethercat": (HEADS, ethercat), "egm": (egm.HEADS, on_egm), "cell": (cell.HEADS, in_a_cell)}
    wrong, written = 0, {}
    for kind, (heads, run) in tables.items():
        if given.bus not in (None, kind):
            continue
        rows, failed, torn = run(given.only, given.workload)
        table = Table(*heads, title=f"fault matrix, {kind}, {date.today()}")
        for row in rows:
            table.add_row(*row)
        Console(width=None if sys.stdout.isatty() else 200).print(table)
        print(f"{len(rows)} trials, {failed} with another reaction; {torn} cycle records torn or lost")
        wrong += failed + torn
        written[kind] = {"heads": heads, "rows": rows}
    if given.json is not None:
        given.json.write_text(json.dumps(written, indent=1))
    return 1 if wrong else 0


def ethercat(only: str, workload: str) -> tuple[list[list[str]], int, int]:
    """Run the matrix on the virtual segment; return rows, trials with another reaction, and records torn or lost."""
    chosen = [(case, load) for case in CASES for load in case.workloads if only in case.name and workload in ("", load)]
    rows: list[list[str]] = []
    failed = 0
    if not chosen:
        return rows, 0, 0
    platform = Platform()
    try:
        platform.be_patient(HOLD_MS)
        platform.rtcp("start", "--detach")
        with harness_of(platform) as harness:
            for case, load in chosen:
                result, wrong = run_case(harness, case, load)
                failed += bool(wrong)
                _show(rows, columns(case, load, result, wrong), len(chosen))
            torn = harness.torn
    finally:
        platform.end()
    return rows, failed, torn


def on_egm(only: str, workload: str) -> tuple[list[list[str]], int, int]:
    """Run the matrix on the virtual IRC5; as `ethercat`."""
    chosen = [
        (case, load) for case in egm.CASES for load in case.workloads if only in case.name and workload in ("", load)
    ]
    rows: list[list[str]] = []
    failed = 0
    if not chosen:
        return rows, 0, 0
    trials = egm.Trials()
    try:
        for case, load in chosen:
            result, wrong = egm.run_case(trials, case, load)
            failed += bool(wrong)
            _show(rows, egm.columns(case, load, result, wrong), len(chosen))
    finally:
        trials.close()
    return rows, failed, trials.torn


def in_a_cell(only: str, workload: str) -> tuple[list[list[str]], int, int]:
    """Run the matrix of a cell of two virtual IRB 120; as `ethercat`."""
    chosen = [
        (case, kind) for case in cell.CASES for kind in cell.WORKLOADS if only in case.name and workload in ("", kind)
    ]
    rows: list[list[str]] = []
    failed = 0
    if not chosen:
        return rows, 0, 0
    trials = cell.Trials()
    try:
        trials.recover(killed=False)
        for case, kind in chosen:
            result = cell.run_case(trials, case, kind)
            failed += bool(result.problems)
            _show(rows, cell.columns(case, kind, result), len(chosen))
    finally:
        trials.close()
    return rows, failed, 0


def _show(rows: list[list[str]], row: list[str], count: int) -> None:
    rows.append(row)
    print(f"{len(rows)}/{count}  " + "  |  ".join(row), file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
