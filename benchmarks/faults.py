"""The fault matrix: `python benchmarks/faults.py [--only WORD] [--workload NAME] [--json FILE]`; `make faults`.

Every fault of the virtual segment while the arm holds, moves in joint mode and is jogged: the reaction, the time until
every joint was at standstill (ground truth of the segment), the travel of a joint as a fraction of its stopping bound,
the largest step of any target as a fraction of what its speed limit allows, the first message, and what the recovery
took. Exit code 1 where a reaction is not the required one.
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
from tests.faults.cases import CASES
from tests.faults.run import HOLD_MS, columns, harness_of, run_case

HEADS = ("fault", "while", "reaction", "standstill, s", "travel", "largest step", "first message", "recovery")


def main() -> int:
    """Run the matrix and print it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="only cases with this in their name")
    parser.add_argument("--workload", default="", help="only holding, moving, jogging or joystick")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    given = parser.parse_args()
    chosen = [
        (case, workload)
        for case in CASES
        for workload in case.workloads
        if given.only in case.name and given.workload in ("", workload)
    ]
    rows: list[list[str]] = []
    failed = 0
    platform = Platform()
    try:
        platform.be_patient(HOLD_MS)
        platform.rtcp("start", "--detach")
        with harness_of(platform) as harness:
            for number, (case, workload) in enumerate(chosen, 1):
                result, wrong = run_case(harness, case, workload)
                failed += bool(wrong)
                rows.append(columns(case, workload, result, wrong))
                print(f"{number}/{len(chosen)}  " + "  |  ".join(rows[-1]), file=sys.stderr, flush=True)
            torn, records = harness.torn, harness.records
    finally:
        platform.end()
    table = Table(*HEADS, title=f"fault matrix, {date.today()}")
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 200).print(table)
    print(f"{len(rows)} trials, {failed} with another reaction; {records} cycles, {torn} records torn or lost")
    if given.json is not None:
        given.json.write_text(json.dumps({"heads": HEADS, "rows": rows}, indent=1))
    return 1 if failed or torn else 0


if __name__ == "__main__":
    sys.exit(main())
