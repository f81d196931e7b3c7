"""Files that describe a motion, in YAML or CSV: `read_motion(path)` checks them whole.

A trajectory, by time and joints, or a path, by poses that straight lines lead to:

    trajectory:
      - {t: 0.0, q: [0, 0, 0, 0, 0, 0]}
      - {t: 2.0, q: [0, 0.3, pi/4, 0, 0.3, 0], v: [0, 0, 0, 0, 0, 0]}   # v, and a with it, for all points or for none

    speed: 0.1                                                           # m/s; left out: the configuration's
    path:
      - {pose: [-0.5, 0.1, 0.6, 0, 0, 0]}
      - {q: [0, 0.3, pi/2, 0, 0.3, 0], speed: 0.05}

The same in CSV, told by its header: `t,q1,..,q6` with `,v1,..,v6` and `,a1,..,a6` if given, or `x,y,z,rx,ry,rz` with
`,speed` if given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Annotated

from annotated_types import Gt, MaxLen

from rtcp.config.checking import Checker
from rtcp.config.document import Document, Finding, read, text_of
from rtcp.config.errors import ConfigError
from rtcp.config.motion_points import Point, Stop
from rtcp.config.plain_number import plain_number

MOST = 4096
"""Points or poses that a motion has at most."""
_POSE = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class MotionFile:
    """What a file says: either `trajectory` or `path` has entries. speed: m/s, of a path; None: the configuration's."""

    trajectory: Annotated[tuple[Point, ...], MaxLen(MOST)] = ()
    path: Annotated[tuple[Stop, ...], MaxLen(MOST)] = ()
    speed: Annotated[float, Gt(0)] | None = None


_FILE = Checker(MotionFile)


def read_motion(path: Path) -> MotionFile:
    """Return what a motion file says; its ending tells the form: `.csv`, or `.yaml` or `.yml`.

    Raises:
        ConfigError: one sentence a mistake, with its line.
    """
    if path.suffix.lower() == ".csv":
        return _read_csv(path)
    if path.suffix.lower() in (".yaml", ".yml"):
        return _read_yaml(path)
    raise ConfigError([f'{path}: the ending "{path.suffix}" says no form; allowed are .yaml, .yml and .csv'])


def _read_yaml(path: Path) -> MotionFile:
    document = read(path)
    motion, findings = _FILE.check(document.data)
    if motion is None:
        raise ConfigError(document.sentences(findings))
    findings = _form(motion, document) + _points(motion.trajectory) + _stops(motion.path)
    if findings:
        raise ConfigError(document.sentences(findings))
    return motion


def _form(motion: MotionFile, document: Document) -> list[Finding]:
    if not motion.trajectory and not motion.path:
        return [((), "neither trajectory nor path has entries; one of them is needed")]
    if motion.trajectory and motion.path:
        return [(("path",), "a file holds a trajectory or a path, found both; write two files")]
    if motion.trajectory and motion.speed is not None:
        return [(("speed",), "a speed is for a path; a trajectory's is in its times")]
    return []


def _points(points: Sequence[Point]) -> list[Finding]:
    """Mistakes between the points, and numbers that do not fit each other."""
    findings: list[Finding] = []
    for i, point in enumerate(points):
        where = ("trajectory", i)
        if i and not point.t > points[i - 1].t:
            found = f"found {point.t:g} after {points[i - 1].t:g}; times must rise"
            findings.append(((*where, "t"), found))
        for key, numbers in (("q", point.q), ("v", point.v), ("a", point.a)):
            if numbers is not None and len(numbers) != len(points[0].q):
                wanted = f"allowed are {len(points[0].q)}, as the first point has"
                findings.append(((*where, key), f"found {len(numbers)} numbers, {wanted}"))
        for key, has, first in (("v", point.v, points[0].v), ("a", point.a, points[0].a)):
            if (has is None) != (first is None):
                findings.append(((*where, key), f"{key} must be given for all points or for none"))
        if point.a is not None and point.v is None:
            findings.append(((*where, "a"), "a needs v beside it"))
    return findings


def _stops(stops: Sequence[Stop]) -> list[Finding]:
    findings: list[Finding] = []
    for i, stop in enumerate(stops):
        if (stop.pose is None) == (stop.q is None):
            found = "neither" if stop.pose is None else "both"
            findings.append((("path", i), f"found {found} of pose and q; one of them is needed"))
    return findings


def _read_csv(path: Path) -> MotionFile:
    lines = [(number, line.strip()) for number, line in enumerate(text_of(path).splitlines(), 1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if not lines:
        raise ConfigError([f"{path}: the file is empty; a header and rows of numbers are expected"])
    first, head = lines[0]
    header = [name.strip().lower() for name in head.split(",")]
    joints = _joints(header)
    with_speed = header == [*_POSE, "speed"]
    if joints == 0 and not with_speed and header != list(_POSE):
        wanted = "t,q1,..,q6 (and v1,..,v6 and a1,..,a6) or x,y,z,rx,ry,rz (and speed)"
        raise ConfigError([f"{path}:{first}: found the header {_shown(head)}, allowed is {wanted}"])
    if len(lines) - 1 > MOST:
        raise ConfigError([f"{path}: the file has {len(lines) - 1} rows, at most {MOST} are allowed"])
    if len(lines) == 1:
        raise ConfigError([f"{path}:{first}: the file has a header and no rows"])
    problems: list[str] = []
    rows: list[list[float]] = []
    for number, line in lines[1:]:
        row = _numbers(line, header, f"{path}:{number}", problems)
        if row is not None:
            if joints and row[0] < 0.0:
                problems.append(f"{path}:{number}: t: found {row[0]:g}, allowed is at least 0")
            if joints and rows and not row[0] > rows[-1][0]:
                problems.append(f"{path}:{number}: t: found {row[0]:g} after {rows[-1][0]:g}; times must rise")
            if with_speed and not row[6] > 0.0:
                problems.append(f"{path}:{number}: speed: found {row[6]:g}, allowed is greater than 0")
            rows.append(row)
    if problems:
        raise ConfigError(problems)
    if joints:
        return MotionFile(trajectory=tuple(_point(row, joints) for row in rows))
    return MotionFile(path=tuple(Stop(tuple(row[:6]), None, row[6] if with_speed else None) for row in rows))


def _shown(text: str) -> str:
    """Return some of a text in quotes, with nothing in it that a terminal would obey."""
    return '"' + "".join(letter if letter.isprintable() else "?" for letter in text[:80]) + '"'


def _joints(header: Sequence[str]) -> int:
    """Return of how many joints a header names the columns; 0 where it is no trajectory's."""
    for joints in range(1, 7):
        columns = ["t"]
        for letter in "qva":
            columns += [f"{letter}{i}" for i in range(1, joints + 1)]
            if header == columns:
                return joints
    return 0


def _numbers(line: str, header: Sequence[str], where: str, problems: list[str]) -> list[float] | None:
    cells = [cell.strip() for cell in line.split(",")]
    if len(cells) != len(header):
        problems.append(f"{where}: found {len(cells)} columns, the header has {len(header)}")
        return None
    row: list[float] = []
    for name, cell in zip(header, cells, strict=True):
        try:
            number = plain_number(cell)
        except ValueError:
            problems.append(f"{where}: {name}: found the text {_shown(cell)}, allowed is a number")
            return None
        if not isfinite(number):
            problems.append(f"{where}: {name}: found {cell}, allowed is a finite number")
            return None
        row.append(number)
    return row


def _point(row: Sequence[float], joints: int) -> Point:
    parts = [tuple(row[1 + k * joints : 1 + (k + 1) * joints]) for k in range(3)]
    return Point(row[0], parts[0], parts[1] or None, parts[2] or None)
