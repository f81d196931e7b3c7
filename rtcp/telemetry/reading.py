"""Reads recordings of the recorder (MCAP, CSV) and of the black box, whole or part by part.

A truncated file, as of a killed recorder, is read up to its damage and marked as `truncated`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import chain, islice
from pathlib import Path
from re import fullmatch
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.records import Attachment, Chunk, Metadata
from numpy.lib.recfunctions import repack_fields

from rtcp.config.model import ArmConfig
from rtcp.config.serialization import from_json
from rtcp.ipc.cycle_channels import ABOUT
from rtcp.ipc.recording import Batch, ChunkDecoder, Moment, RecordingError, contents, cycle_type, is_complete, opened
from rtcp.ipc.schema import FLAG_ENABLED, PER_JOINT, Field, RecordSchema, SchemaError, arm_schema
from rtcp.telemetry.recorder import CSV_NAMES

Records = npt.NDArray[np.void]
_ALWAYS = ("number", "time_ns")
_CSV_ROWS, _CSV_HEADER = 20_000, 1 << 16


class Part(NamedTuple):
    """Consecutive records of a recording, and messages of its log."""

    records: Records
    log: list[Moment]


class Reader:
    """Reads a recording once, from its beginning, part by part: `for part in Reader(path): ...`.

    Args:
        path: MCAP of a recorder or of the black box, or CSV (`.csv`) of a recorder.
        signals: names of fields or patterns (`*_position`), none: all in the file; number and time_ns are always
            included.
        start_s: begin of the span, s from the first record; None: the first record.
        end_s: end of the span, s from the first record; None: the last record.

    Attributes:
        about: metadata of the file: arm, joints, period_us, versions; of a fault also `fault`.
        config: configuration of the recorded arm; None: not in the file, or of an incompatible version.
        signals, names: the chosen signals; the fields of the returned records.
        schema: schema of its records; joints: number of joints.
        first_ns: time_ns of the first record of the file.
        offset_ns: CLOCK_REALTIME minus time_ns; 0 in CSV, which has no date.
        truncated: whether its end is missing or a part is damaged; valid after all parts are read.

    Raises:
        RecordingError: the file is no recording, is empty or lacks a signal; during iteration: no record in the span.
    """

    def __init__(
        self, path: Path, signals: Sequence[str] = (), start_s: float | None = None, end_s: float | None = None
    ) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.config: ArmConfig | None = None
        self.schema = RecordSchema(())
        self.first_ns = self.offset_ns = 0
        self.truncated = False
        self.signals, self.names = signals, list[str]()
        self._start_s = -np.inf if start_s is None else start_s
        self._end_s = np.inf if end_s is None else end_s
        self._last_s = 0.0
        self._decoder = ChunkDecoder()
        self._parts = self._read()
        # Read the head now, for the attributes.
        self._first = next(self._parts, None)

    def __iter__(self) -> Iterator[Part]:
        """Return the parts, with the records and messages of the span."""
        count = 0
        for part in chain(() if self._first is None else (self._first,), self._parts):
            count += len(part.records)
            if len(part.records) or part.log:
                yield part
        if not count:
            span = f"{self._start_s:g} to {self._end_s:g} s"
            raise RecordingError("empty", self.path, f"it has no record from {span}; it ends at {self._last_s:.3f} s")

    @property
    def joints(self) -> int:
        """Number of joints of the arm."""
        return self.schema.joints

    @property
    def period_s(self) -> float:
        """Period of the cycle, s; 0: unknown."""
        with suppress(KeyError, ValueError):
            return float(self.about["period_us"]) * 1e-6
        return 0.0

    def at_s(self, moment: Moment) -> float:
        """Return the instant of a message, s from the first record."""
        return (moment.time_ns - self.offset_ns - self.first_ns) * 1e-9

    def _read(self) -> Iterator[Part]:
        early: list[Moment] = []
        batches = self._csv() if self.path.suffix.lower() == ".csv" else self._mcap()
        try:
            for batch in batches:
                early += batch.log
                if not self.names and not len(batch.cycles):
                    continue  # its time is unknown before the first cycle
                if not self.names:
                    self._begin(batch)
                yield self._cut(batch.cycles, early)
                early = []
        except RecordingError as error:
            if error.kind != "damaged" or not self.names:
                raise
            self.truncated = True
        if not self.names:
            raise RecordingError("empty", self.path, "the recording has no cycle")

    def _begin(self, batch: Batch) -> None:
        """Set the attributes that depend on the first records."""
        self.first_ns = int(batch.cycles["time_ns"][0])
        self.offset_ns = batch.time_ns - self.first_ns if batch.time_ns else 0
        recorded = batch.cycles.dtype.names or ()
        for signal in self.signals:
            if not any(fnmatchcase(name, signal) for name in recorded):
                defect = f"there is no signal {signal} in it; it has {', '.join(recorded)}"
                raise RecordingError("signals", self.path, defect, found=signal, allowed=recorded)
        wanted = (*self.signals, *_ALWAYS) if self.signals else ("*",)
        self.names = [name for name in recorded if any(fnmatchcase(name, pattern) for pattern in wanted)]

    def _cut(self, cycles: Records, log: list[Moment]) -> Part:
        seconds = (cycles["time_ns"] - self.first_ns) * 1e-9
        if len(seconds):
            self._last_s = float(seconds[-1])
        inside = cycles[(seconds >= self._start_s) & (seconds <= self._end_s)]
        # A copy, so that the other fields do not stay in memory.
        records = repack_fields(inside[self.names], align=True)
        return Part(records, [moment for moment in log if self._start_s <= self.at_s(moment) <= self._end_s])

    def _mcap(self) -> Iterator[Batch]:
        decoder = self._decoder
        with opened(self.path) as file:
            self.truncated = not is_complete(file)
            for record in contents(file):
                if isinstance(record, Metadata) and record.name == ABOUT:
                    self.about = _about(record.metadata)
                elif isinstance(record, Attachment) and record.name == "configuration.json":
                    with suppress(ValueError, TypeError):
                        self.config = from_json(ArmConfig, json.loads(record.data))
                elif isinstance(record, Chunk):
                    first = self.first_ns + self.offset_ns
                    if self.names and (record.message_start_time - first) * 1e-9 > self._end_s:
                        return
                    last_s = (record.message_end_time - first) * 1e-9
                    if self.names and last_s < self._start_s and decoder.log_channel >= 0:
                        self._last_s = last_s
                        continue
                    batch = decoder.decode(record)
                    self.schema = decoder.schema
                    yield batch

    def _csv(self) -> Iterator[Batch]:
        with opened(self.path) as file:
            header = file.readline(_CSV_HEADER).decode().rstrip("\r\n").split(",")
            self.schema, columns = _columns(header)
            dtype, count = cycle_type(self.schema), 0
            while lines := list(islice(file, _CSV_ROWS)):
                if not lines[-1].endswith(b"\n"):
                    self.truncated = True
                    lines.pop()
                    if not lines:
                        return
                values = np.loadtxt(lines, delimiter=",", ndmin=2)
                if values.shape[1] != len(header) or not np.isfinite(values).all():
                    raise ValueError(f"a row in the {len(lines)} after row {count} does not have {len(header)} numbers")
                rows = np.zeros(len(values), dtype)
                rows["number"] = np.arange(count, count + len(rows)) + 1
                rows["time_ns"] = np.round(values[:, 0] * 1e9)
                for name, indices in columns.items():
                    rows[name] = values[:, indices if rows[name].ndim == 2 else indices[0]]
                count += len(rows)
                yield Batch(rows, 0, [])


def _about(metadata: dict[str, str]) -> dict[str, str]:
    """Return the metadata, those of the black box converted to the recorder's names."""
    if "json" not in metadata:
        return metadata
    fault: dict[str, Any] = json.loads(metadata["json"])
    return {
        "arm": str(fault["arm"]),
        "joints": ", ".join(map(str, fault["joints"])),
        "period_us": f"{fault['period_ns'] * 1e-3:g}",
        "fault": str(fault["what"]),
        **{str(name): str(version) for name, version in fault["versions"].items()},
    }


def _columns(header: Sequence[str]) -> tuple[RecordSchema, dict[str, list[int]]]:
    """Return the schema of a recorder's CSV, and the column indices of each field; raises ValueError.

    A CSV has no types: the types of an arm's fields are known, fields of devices are float64.
    """
    long_names, known = {short: name for name, short in CSV_NAMES.items()}, arm_schema(1)
    columns: dict[str, list[int]] = {}
    vectors: set[str] = set()
    for index, column in enumerate(header[1:], 1):
        of_joint = fullmatch(r"J\d+_(\w+)", column)
        name = long_names.get(of_joint[1], of_joint[1]) if of_joint else column
        columns.setdefault(name, []).append(index)
        if of_joint:
            vectors.add(name)
    joint_counts = {len(indices) for name, indices in columns.items() if name in PER_JOINT}
    try:
        if header[0] != "Time" or not set(columns) & set(known.names) or len(joint_counts) > 1:
            raise SchemaError
        fields = [known[name] for name in _ALWAYS]
        for name, indices in columns.items():
            if name not in _ALWAYS:
                field = known[name] if name in known.names else Field(name)
                fields.append(replace(field, shape=(len(indices),) if name in vectors else ()))
        return RecordSchema(tuple(fields)), columns
    except SchemaError as error:
        first_columns = ", ".join(header)[:60]
        raise ValueError(f"its columns begin with {first_columns}, those of a recording with Time, J1_pos") from error


@dataclass(frozen=True)
class Recorded:
    """A recording, or a span of it, in memory.

    Attributes:
        path, about, config, truncated: as in `Reader`.
        records: structured array of the chosen fields, oldest first; SI units.
        seconds: instants of the records, s from the first record of the file.
        period_s: interval of consecutive records, s: N periods of the cycle where every Nth is recorded.
        missing: number of missing records, from gaps in their numbers.
        log: messages and their levels.
        log_s: their instants, s from the first record of the file.
    """

    path: Path
    about: dict[str, str]
    config: ArmConfig | None
    records: Records
    seconds: npt.NDArray[np.float64]
    period_s: float
    missing: int
    log: tuple[Moment, ...]
    log_s: tuple[float, ...]
    truncated: bool

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, base to tool; CSV has none."""
        return tuple(self.about["joints"].split(", ")) if "joints" in self.about else ()

    def column(self, name: str) -> npt.NDArray[np.float64]:
        """Return a field of the records, shape (records,) or (records, joints), as floats."""
        return self.records[name].astype(np.float64)


def read(path: Path, signals: Sequence[str] = (), start_s: float | None = None, end_s: float | None = None) -> Recorded:
    """Read a recording; arguments and errors as in `Reader`. Only the chosen fields are held in memory."""
    reader = Reader(path, signals, start_s, end_s)
    parts = list(reader)
    records = np.concatenate([part.records for part in parts])
    log = tuple(moment for part in parts for moment in part.log)
    seconds = (records["time_ns"] - reader.first_ns) * 1e-9
    steps = np.diff(records["number"].astype(np.int64))
    stride = max(1, int(steps.min())) if len(steps) else 1
    period_s = reader.period_s * stride or (float(np.median(np.diff(seconds))) if len(steps) else 0.0)
    return Recorded(
        path, reader.about, reader.config, records, seconds, period_s, int((steps // stride - 1).sum()), log,
        tuple(map(reader.at_s, log)), reader.truncated,
    )  # fmt: skip


def target_steps(
    records: Mapping[str, npt.NDArray[Any]] | npt.NDArray[np.void],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return the steps of the targets between consecutive cycles with enabled drives.

    Without enabled drives a target only repeats the position.

    Returns:
        The index of each step's second cycle, shape (n,), and its size for each joint, shape (n, joints), rad.
    """
    numbers = records["number"].astype(np.int64)
    enabled = (records["flags"] & FLAG_ENABLED) != 0
    pairs = np.flatnonzero((np.diff(numbers) == 1) & enabled[1:] & enabled[:-1])
    targets = records["sent_position"]
    return pairs + 1, np.abs(targets[pairs + 1] - targets[pairs])
