"""The fault matrix: `python benchmarks/faults.py [--only WORD] [--activity NAME] [--json FILE]`; `make faults`.

Every fault of the virtual segment while the arm holds, moves in joint mode and is jogged: how it ended, the time until
every joint truly stood (by the segment's account), how far a joint went meanwhile as a part of what the ladder of stops
allows, the largest step of any target as a part of what the speed limit allows, the first sentence, what it took to use
the arm again. Ends with 1 where one did not end as it must.
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
from tests.faults.run import SHIPPED_MS, bench_of, columns, play

HEADS = ("fault", "while", "ends in", "stood after, s", "way", "largest step", "what is said first", "to go on")


def main() -> int:
    """Carry out the matrix and print it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    parser.add_argument("--activity", default="", help="holding, moving, jogging or stick alone")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    given = parser.parse_args()
    chosen = [
        (case, activity)
        for case in CASES
        for activity in case.activities
        if given.only in case.name and given.activity in ("", activity)
    ]
    rows: list[list[str]] = []
    failed = 0
    platform = Platform()
    try:
        platform.be_patient(SHIPPED_MS)
        platform.rtcp("start", "--detach")
        with bench_of(platform) as bench:
            for number, (case, activity) in enumerate(chosen, 1):
                outcome, wrong = play(bench, case, activity)
                failed += bool(wrong)
                rows.append(columns(case, activity, outcome, wrong))
                print(f"{number}/{len(chosen)}  " + "  |  ".join(rows[-1]), file=sys.stderr, flush=True)
            torn, records = bench.torn, bench.records
    finally:
        platform.end()
    table = Table(*HEADS, title=f"fault matrix, {date.today()}")
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 200).print(table)
    print(f"{len(rows)} trials, {failed} not as they must be; {records} cycles, {torn} records torn or lost")
    if given.json is not None:
        given.json.write_text(json.dumps({"heads": HEADS, "rows": rows}, indent=1))
    return 1 if failed or torn else 0


if __name__ == "__main__":
    sys.exit(main())
