"""Reads the CSV file that an oscilloscope exports, and finds the instants at which the measured output toggled.

The exports of Keysight, LeCroy, PicoScope, Rigol, Siglent and Tektronix begin with different header lines, and a
spreadsheet in a language with a decimal comma separates columns by semicolons. All of them end in a table of numbers,
which begins at the first line with numbers in all columns of the last one. A damaged line in the table is an error: no
sample is left out. The header gives the unit of the time, or the interval of the samples where the table has no time.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice, pairwise
from math import isfinite
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from rtcp.config.numbers import plain_number
from rtcp.telemetry.experiments.experiment import ExperimentFailed

Array = npt.NDArray[np.float64]

_SECONDS = {
    prefix + unit: seconds
    for short, long, seconds in (
        ("", "", 1.0), ("m", "milli", 1e-3), ("u", "micro", 1e-6), ("µ", "micro", 1e-6), ("n", "nano", 1e-9),
        ("p", "pico", 1e-12),
    )
    for prefix, units in ((short, ("s", "sec")), (long, ("second", "seconds")))
    for unit in units
}  # fmt: skip
"""Names of units of time in headers -> s."""
_TIME = re.compile(r"\b(?:time|zeit)\b")
"""Names of the column of time, in lower case."""
_UNIT_KEY = re.compile(r"(?:horizontal|time|x)[ _-]?units?")
"""Names of a header line that states the unit of the time, in lower case."""
_BRACKETS = re.compile(r"[(\[](.*?)[)\]]")
_LEFT_OUT = ' \t\r\n,;"'
"""A line of these characters alone is blank."""
_HEADER_BESIDE = 30
"""Lines of the table beside which older models of Tektronix write the header into columns of their own."""
_LEAST_SAMPLES = 3
_LOW, _HIGH = 0.3, 0.7
"""A level counts as low below, and as high above these parts of the signal's swing: noise between them is no edge."""
_MOST_BETWEEN = 0.3
"""Largest part of samples between low and high; noise alone, without an output that toggles, has more."""


class CaptureError(ExperimentFailed):
    """An oscilloscope's file cannot be evaluated.

    Attributes:
        kind: `unreadable`: the file cannot be read. `no_table`: it does not end in a table of numbers. `row`: a line of
            the table is damaged. `unit`: the unit of its time is unknown. `time`: its time does not rise, or the
            interval of its samples is no number. `channel`: it has no such channel. `no_edges`: fewer than two edges.
        path: the file.
        line: number of the line, from 1; 0: the whole file.
    """

    def __init__(
        self,
        kind: Literal["unreadable", "no_table", "row", "unit", "time", "channel", "no_edges"],
        path: Path,
        defect: str,
        line: int = 0,
    ) -> None:
        super().__init__(f"{path}:{line}: {defect}" if line else f"{path}: {defect}")
        self.kind = kind
        self.path = path
        self.line = line


@dataclass(frozen=True)
class Capture:
    """One channel of an oscilloscope: instants, shape (n,), s, and levels, shape (n,), V."""

    path: Path
    seconds: Array
    levels: Array

    @property
    def resolution_us(self) -> float:
        """Interval of the samples, us."""
        return 1e6 * float(np.median(np.diff(self.seconds)))


def read_capture(path: Path, channel: int = 1) -> Capture:
    """Return one channel of an exported file.

    Args:
        path: the file.
        channel: which column of levels, from 1.

    Raises:
        CaptureError: see its kinds.
    """
    try:
        text = _decoded(path.read_bytes()).rstrip("\0")
    except OSError as error:
        raise CaptureError("unreadable", path, f"the file cannot be read: {error.strerror}") from error
    # Not `splitlines`, which also splits at signs of Latin-1.
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    table = _find_table(path, lines)
    values_by_column = _values(path, lines, table)
    header = [_Cells(at, table.split(lines[at - 1])) for at in range(1, table.begin + 1) if _is_filled(lines[at - 1])]
    beside = [
        _Cells(at, table.split(lines[at - 1])[: table.columns[0]])
        for at in range(table.begin + 1, min(table.begin + _HEADER_BESIDE, len(lines)) + 1)
    ]
    names = _names(header, table.columns)
    time = _time_column(names)
    sampling = None if time is not None else _sampling(path, header, table)
    # A first column of whole numbers that rise counts the samples.
    first = values_by_column[0]
    counts = len(values_by_column) > 1 and bool((first == np.floor(first)).all() and (np.diff(first) > 0).all())
    if time is None and sampling is None and counts:
        needed = "the header names neither a column of time nor the interval of the samples"
        raise CaptureError("time", path, f"the first column counts the samples, but {needed}", table.begin + 1)
    if sampling is not None:
        levels = values_by_column[1:] if counts else values_by_column
        start_s, interval_s = sampling
        seconds: Array = start_s + interval_s * (first if counts else np.arange(len(first), dtype=np.float64))
    else:
        at = time or 0
        seconds = values_by_column[at] * _unit(path, at, names, header + beside)
        levels = values_by_column[at + 1 :]
    if not len(levels):
        raise CaptureError("no_table", path, "found one number in the last line, needed are time and level", table.end)
    falling = np.diff(seconds) <= 0
    if falling.any():
        line = table.line(lines, int(np.argmax(falling)) + 1)
        raise CaptureError("time", path, "the time does not rise from the line before", line)
    if not 1 <= channel <= len(levels):
        raise CaptureError("channel", path, f"found channel {channel}, allowed is 1 to {len(levels)}")
    return Capture(path, seconds, levels[channel - 1])


def toggles(capture: Capture) -> tuple[Array, bool]:
    """Return the instants of all edges, s, and whether the first one rises.

    An edge is the crossing of 0.7 of the swing where the signal rises, and of 0.3 where it falls, interpolated between
    two samples.

    Raises:
        CaptureError: kind `no_edges`.
    """
    low, high = np.percentile(capture.levels, (5, 95))
    share = (capture.levels - low) / ((high - low) or 1.0)
    marks = np.where(share > _HIGH, 1, np.where(share < _LOW, -1, 0))
    known = np.flatnonzero(marks)
    if high == low or len(known) < (1 - _MOST_BETWEEN) * len(marks):
        raise CaptureError("no_edges", capture.path, "the signal has no two levels: is the probe at the output?")
    changes = known[1:][np.diff(marks[known]) != 0]
    if len(changes) < 2:
        raise CaptureError("no_edges", capture.path, f"found {len(changes)} edges, needed are at least 2")
    bound = np.where(marks[changes] > 0, _HIGH, _LOW)
    before, after = share[changes - 1], share[changes]
    earlier, later = capture.seconds[changes - 1], capture.seconds[changes]
    return earlier + (later - earlier) * (bound - before) / (after - before), bool(marks[changes[0]] > 0)


class _Cells(NamedTuple):
    """Cells of a line of the header, without spaces around them; the line counts from 1."""

    line: int
    cells: Sequence[str]


class _Table(NamedTuple):
    """Where the numbers are: `begin` and `end` of their lines, from 0, and their columns, from 0."""

    begin: int
    end: int
    columns: Sequence[int]
    delimiter: str

    def split(self, line: str) -> list[str]:
        """Return the cells of a line."""
        return _split(line, self.delimiter)

    def line(self, lines: Sequence[str], sample: int) -> int:
        """Return the number, from 1, of the line of a sample, which counts from 0."""
        filled = (at for at in range(self.begin, self.end) if _is_filled(lines[at]))
        return next(islice(filled, sample, None)) + 1


def _decoded(content: bytes) -> str:
    """Return the text of a file in UTF-8, in UTF-16 with its mark, or in Latin-1, where µ is no UTF-8."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _is_filled(line: str) -> bool:
    return bool(line.strip(_LEFT_OUT))


def _split(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line; a quotation mark that is not closed in the line is a part of its cell."""
    quotation_mark = None if line.count('"') % 2 else '"'
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, quotechar=quotation_mark), [])]
    except csv.Error:  # a cell of more than 131072 characters holds no number and no name
        return []


def _number(cell: str, delimiter: str) -> float | None:
    """Return the number in a cell, NaN and infinity too, which PicoScope writes as ∞; None: another text."""
    try:
        return plain_number((cell if delimiter == "," else cell.replace(",", ".")).replace("∞", "inf"))
    except ValueError:
        return None


def _is_finite(cell: str, delimiter: str) -> bool:
    number = _number(cell, delimiter)
    return number is not None and isfinite(number)


def _find_table(path: Path, lines: Sequence[str]) -> _Table:
    """Return the table that ends with the last line in which there is any number; below it are only remarks."""
    for last in range(len(lines) - 1, -1, -1):
        delimiter = next((mark for mark in ";\t" if mark in lines[last]), ",")
        columns = [at for at, cell in enumerate(_split(lines[last], delimiter)) if _number(cell, delimiter) is not None]
        if columns:
            break
    else:
        raise CaptureError("no_table", path, "found no line with a number, needed are lines of time and level")
    for begin in range(last + 1):
        cells = _split(lines[begin], delimiter)
        if all(at < len(cells) and _is_finite(cells[at], delimiter) for at in columns):
            return _Table(begin, last + 1, columns, delimiter)
    raise CaptureError("row", path, f"found {lines[last].strip()[:80]!r}, allowed are finite numbers", last + 1)


def _values(path: Path, lines: Sequence[str], table: _Table) -> Array:
    """Return the numbers of the table, shape (columns, samples)."""

    def rows() -> Iterator[str]:
        for line in islice(lines, table.begin, table.end):
            if _is_filled(line):
                yield line if table.delimiter == "," else line.replace(",", ".")

    values: Array | None = None
    with suppress(ValueError):  # the line is looked for below
        values = np.loadtxt(
            rows(), delimiter=table.delimiter, usecols=table.columns, quotechar='"', comments=None, ndmin=2
        ).T
    if values is None or not np.isfinite(values).all():
        for at in range(table.begin, table.end):
            cells = table.split(lines[at])
            wrong = [
                column + 1
                for column in table.columns
                if column >= len(cells) or not _is_finite(cells[column], table.delimiter)
            ]
            if wrong and _is_filled(lines[at]):
                found = f"found {lines[at].strip()[:80]!r} in the table that begins at line {table.begin + 1}"
                column = f"allowed is a finite number in column {wrong[0]}"
                raise CaptureError("row", path, f"{found}, {column}", at + 1)
    if values is None or values.shape[1] < _LEAST_SAMPLES:
        count = f"needed are at least {_LEAST_SAMPLES} lines of numbers: time and level"
        raise CaptureError("no_table", path, f"it does not end in a table: {count}", table.end)
    return values


def _names(header: Sequence[_Cells], columns: Sequence[int]) -> list[_Cells]:
    """Return the names above the columns of the table, in lower case, the line nearest to the table first.

    A line further above with a number in one of the columns is a key with its value: `Time Base (us),5`. Directly above
    the table the number is the name of a channel.
    """
    names = []
    for row in reversed(header):
        cells = [_lower(row.cells[at]) if at < len(row.cells) else "" for at in columns]
        is_pair = row is not header[-1] and any(_number(cell, ";") is not None for cell in cells)
        if not is_pair and not _UNIT_KEY.fullmatch(cells[0]):
            names.append(_Cells(row.line, cells))
    return names


def _lower(cell: str) -> str:
    return cell.lower().replace("μ", "µ")  # the Greek letter, and the sign of Latin-1


def _units(cell: str) -> list[float]:
    return [_SECONDS[word] for word in re.findall(r"[a-zµ]+", cell) if word in _SECONDS]


def _time_column(names: Sequence[_Cells]) -> int | None:
    """Return which column of the table is named as time, from 0; the last one is none, because levels follow it."""
    for row in names:
        for at, cell in enumerate(row.cells[:-1]):
            if _TIME.search(cell) or _units(cell):
                return at
    return None


def _sampling(path: Path, header: Sequence[_Cells], table: _Table) -> tuple[float, float] | None:
    """Return start and interval of the samples, s; None: the header does not state them.

    Rigol writes them instead of the time: `X,CH1,Start,Increment` above `Sequence,Volt,-0.003,5e-07`, or, in newer
    models, `t0 = -0.003, tInc = 5e-07` beside the names of the channels.
    """

    def finite(row: _Cells, name: str, written: str) -> float:
        number = _number(written, table.delimiter)
        if number is None or not isfinite(number):
            raise CaptureError("time", path, f"{name}: found {written!r}, allowed is a finite number of s", row.line)
        return number

    for names, values in pairwise(header):
        found = dict(zip((name.lower() for name in names.cells), values.cells, strict=False))
        if found.get("increment"):
            return finite(values, "Start", found.get("start") or "0"), finite(values, "Increment", found["increment"])
    for row in header:
        marks = dict(re.findall(r"(t0|tInc)\s*=\s*(\S*)", "\n".join(row.cells)))
        if "tInc" in marks:
            return finite(row, "t0", marks.get("t0", "0")), finite(row, "tInc", marks["tInc"])
    return None


def _unit(path: Path, time: int, names: Sequence[_Cells], header: Sequence[_Cells]) -> float:
    """Return the unit of the time, s: of the name of its column, or of a line of the header; s where none states it.

    Args:
        path: the file.
        time: which column of the table it is, from 0.
        names: names of these columns, see `_names`.
        header: all lines of the header.

    Raises:
        CaptureError: kind `unit`.
    """
    allowed = f"allowed are {', '.join(_SECONDS)}"
    for row in names:
        cell = row.cells[time]
        if units := _units(cell):
            return units[0]
        bracket = _BRACKETS.search(cell)
        if bracket and (row is names[0] or bracket.group() == cell or _TIME.search(cell)):
            raise CaptureError("unit", path, f"unit of the time: found {bracket[1]!r}, {allowed}", row.line)
    for row in header:
        for key, value in pairwise(row.cells):
            if value and _UNIT_KEY.fullmatch(key.lower()):
                if units := _units(_lower(value)):
                    return units[0]
                raise CaptureError("unit", path, f"{key}: found {value!r}, {allowed}", row.line)
    return 1.0
