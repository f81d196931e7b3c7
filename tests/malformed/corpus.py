"""Real frames, one of each kind: what pysoem and RegisterPort send while an arm starts up, runs and stops.

`python -m tests.malformed.corpus` records them anew into corpus.txt, hexadecimal, a frame a line.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from tests.malformed.cable import answerer, master, report_of

FILE = Path(__file__).with_name("corpus.txt")
_HEAD = "# What pysoem and RegisterPort send to a segment, one frame of each kind; made by tests/malformed/corpus.py.\n"


def frames() -> list[bytes]:
    """Return the frames."""
    lines = FILE.read_text(encoding="ascii").splitlines()
    return [bytes.fromhex(line) for line in lines if line and not line.startswith("#")]


def record() -> list[str]:
    """Run a master from the scan to the end; return the frames that it sent."""
    with tempfile.TemporaryDirectory() as folder, answerer(1) as pid:
        kept = Path(folder) / "frames"
        report_of(master(pid, "record", 200, str(kept)))
        return kept.read_text().split()


if __name__ == "__main__":
    FILE.write_text(_HEAD + "\n".join(sorted(record(), key=lambda line: (len(line), line))) + "\n", encoding="ascii")
