"""Files that describe a motion, in YAML or CSV: `read_motion(path)` checks them whole.

A trajectory, by time and joints, or a path, by poses that straight lines connect:

    trajectory:
      - {t: 0.0, q: [0, 0, 0, 0, 0, 0]}
      - {t: 2.0, q: [0, 0.3, pi/4, 0, 0.3, 0], v: [0, 0, 0, 0, 0, 0]}   # v, and a with it, for all points or for none

    speed: 0.1                                                           # m/s; left out: the configuration's
    path:
      - {pose: [-0.5, 0.1, 0.6, 0, 0, 0]}
      - {q: [0, 0.3, pi/2, 0, 0.3, 0], speed: 0.05}

Or a program: steps by named poses, with waits, inputs, outputs, the gripper and parts (`rtcp.api.program` runs it).

The same in CSV, recognized by its header: `t,q1,..,q6` with `,v1,..,v6` and `,a1,..,a6` if given, or `x,y,z,rx,ry,rz`
with `,speed` if given.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import rtcp.config.rules  # noqa: F401 its rules hold for motion files too
from rtcp.config.document import Document, read, text_of
from rtcp.config.findings import Finding
from rtcp.config.model import MOST_POINTS, ConfigError, MotionFile
from rtcp.config.numbers import plain_number
from rtcp.config.validation import Checker

_POSE = ["x", "y", "z", "rx", "ry", "rz"]
_FILE = Checker(MotionFile)


def read_motion(path: Path) -> MotionFile:
    """Return the motion in a file; its ending selects the form: `.csv`, or `.yaml` or `.yml`.

    Raises:
        ConfigError: one sentence per mistake, with its line.
    """
    return read_document(path)[1]


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of motion files in YAML."""
    return _FILE.json_schema()


def read_document(path: Path) -> tuple[Document, MotionFile]:
    """Return the motion with its document, for the lines of its keys; raises as `read_motion`."""
    ending = path.suffix.lower()
    if ending not in (".csv", ".yaml", ".yml"):
        raise ConfigError([Finding((), "ending", found=path.suffix).at(path)])
    document, problems = _read_csv(path) if ending == ".csv" else (read(path), [])
    return document, check(document, problems)


def check(document: Document, problems: Sequence[Finding] = ()) -> MotionFile:
    """Return the motion of a document.

    Raises:
        ConfigError: `problems`, and every mistake in the document, with its line.
    """
    motion, findings = _FILE.check(document.data)
    if motion is None or problems:
        raise ConfigError([*problems, *document.placed(findings)])
    return motion


def _read_csv(path: Path) -> tuple[Document, list[Finding]]:
    """Return the rows of a file in the form of YAML, and a finding for each row that is left out."""
    lines = [(number, line.strip()) for number, line in enumerate(text_of(path).splitlines(), 1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if not lines:
        raise ConfigError([Finding((), "empty_file", need="a header and rows of numbers are").at(path)])
    (first, head), rows = lines[0], lines[1:]
    header = [name.strip().lower() for name in head.split(",")]
    joints = _joints(header)
    if joints == 0 and header not in (_POSE, [*_POSE, "speed"]):
        raise ConfigError([Finding((), "header", found=_quoted(head)).at(path, first)])
    if len(rows) > MOST_POINTS:
        raise ConfigError([Finding((), "too_many_rows", found=len(rows), limit=MOST_POINTS).at(path)])
    if not rows:
        raise ConfigError([Finding((), "no_rows").at(path, first)])
    document = Document(path)
    key = "trajectory" if joints else "path"
    problems: list[Finding] = []
    entries: list[dict[str, object]] = []
    for number, line in rows:
        row = _numbers(line, header)
        if isinstance(row, Finding):
            problems.append(row.at(path, number))
            continue
        document.lines[key, len(entries)] = number
        entries.append(_entry(row, joints))
    if not entries:
        raise ConfigError(problems)
    document.data = {key: entries}
    return document, problems


def _quoted(text: str) -> str:
    """Return the start of a text in quotes, without characters that control a terminal."""
    return '"' + "".join(letter if letter.isprintable() else "?" for letter in text[:80]) + '"'


def _joints(header: Sequence[str]) -> int:
    """Return the number of joints of a trajectory's header; 0 for any other header."""
    for joints in range(1, 7):
        columns = ["t"]
        for letter in "qva":
            columns += [f"{letter}{i}" for i in range(1, joints + 1)]
            if header == columns:
                return joints
    return 0


def _numbers(line: str, header: Sequence[str]) -> list[float] | Finding:
    cells = [cell.strip() for cell in line.split(",")]
    if len(cells) != len(header):
        return Finding((), "columns", found=len(cells), allowed=len(header))
    row: list[float] = []
    for name, cell in zip(header, cells, strict=True):
        try:
            row.append(plain_number(cell))
        except ValueError:
            return Finding((name,), "no_number", found=_quoted(cell))
        if not isfinite(row[-1]):
            return Finding((name,), "range", found=row[-1], allowed="a finite number")
    return row


def _entry(row: list[float], joints: int) -> dict[str, object]:
    if joints == 0:
        return {"pose": row[:6], "speed": row[6]} if len(row) > 6 else {"pose": row}
    parts = {key: row[1 + k * joints : 1 + (k + 1) * joints] for k, key in enumerate("qva")}
    return {"t": row[0], **{key: numbers for key, numbers in parts.items() if numbers}}
