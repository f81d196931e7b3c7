"""Cycle records on disk: one MCAP file a fault, written whole or not at all; contents are checked when read.

Foxglove, PlotJuggler and `ros2 bag` open them. Topic `/cycle` has a message a cycle (`rtcp_msgs/msg/Cycle`, the fields
of `rtcp.ipc.schema`, in CDR), `/log` the messages of the loop (schema `foxglove.Log`); the metadata `rtcp/about` says
what happened, when, to which arm.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import math
import os
import platform
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Metadata, Schema
from mcap.stream_reader import StreamReader

import rtcp
from rtcp.config.serialization import from_json
from rtcp.config.zero import state_directory
from rtcp.ipc.cdr import ENCAPSULATION
from rtcp.ipc.cycle_channels import ABOUT, CYCLE, LOG, CycleChannels, McapFile
from rtcp.ipc.observer import INFORMATION, numpy_fields
from rtcp.ipc.schema import RecordSchema, arm_schema

FORMAT = 2
KEPT = 100
"""Most recordings that are kept, about 2 MB each (20 000 cycles of six joints)."""
_LAST = "last"
"""File with the last number in use: numbers are never used again, even if their files are removed."""
_NAME = re.compile(r"fault-(\d{1,12})-\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d\.mcap")
_LARGEST_RECORD, _LARGEST = 1 << 26, 1 << 28
"""Largest record of a file, and sum of all messages of a fault, bytes, unpacked: three rings of ten joints."""
_MAGIC = b"\x89MCAP0\r\n"
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
"""Opcode and length of a record in a chunk; channel, sequence, log and publish time before the data of a message."""
_NEEDED = ("number", "time_ns", "state", "wkc", "wkc_expected", "missed", "lost", "actual_position", "actual_torque",
           "commanded_position", "sent_position", "statusword", "flags")  # fmt: skip
"""Fields that the cycles of every recording of a fault have."""

Kind = Literal["refused", "damaged", "empty", "signals", "exists", "long", "gap", "disabled"]


class RecordingError(Exception):
    """A recording cannot be written or read; the message names file and defect.

    Attributes:
        kind: refused (by the system), damaged (cut off, or no recording), empty (no cycles, or none in the requested
            span), signals (there is none of that name), exists (it would be overwritten), long (for the request).
        path: of the file or the directory.
        fields: the values found and allowed, by name.
    """

    def __init__(self, kind: Kind, path: Path, defect: str, **fields: Any) -> None:
        super().__init__(f"{path}: {defect}")
        self.kind, self.path, self.fields = kind, path, fields


@dataclass(frozen=True)
class Moment:
    """A message of the loop and its instant, CLOCK_REALTIME ns; `level` as in `foxglove.Log`."""

    time_ns: int
    message: str
    level: int = INFORMATION


@dataclass(frozen=True)
class About:
    """The fault that a recording is of."""

    number: int
    """Number of the recording; 0: not written yet."""
    time_ns: int
    """Of the fault, CLOCK_REALTIME."""
    what: str
    """The message of the fault."""
    before: str
    """The machine's state in the cycle before."""
    arm: str
    bus: str
    period_ns: int
    joints: tuple[str, ...]
    versions: dict[str, str]
    began_ns: int
    """When the platform was started, CLOCK_MONOTONIC; together with `event` it identifies the fault."""
    event: int
    """Number of the event that began the fault; 0: the loop's process died or hung."""
    at: int
    """Index of the fault's cycle in the arrays; -1: there are no records."""
    notes: tuple[str, ...]
    """Missing parts, a sentence each."""
    timeline: tuple[Moment, ...]

    @property
    def when(self) -> datetime:
        """The fault's instant in local time."""
        return datetime.fromtimestamp(self.time_ns * 1e-9).astimezone()


@dataclass(frozen=True)
class FaultRecording:
    """A fault and the cycle records around it, oldest first, with their schema."""

    about: About
    records: npt.NDArray[np.void]
    schema: RecordSchema


@dataclass(frozen=True)
class Listed:
    """A file of the directory: its fault, or why it cannot be read."""

    number: int
    path: Path
    about: About | None
    trouble: str
    seconds: float = 0.0
    """Time from its first cycle to its last."""


def faults_directory(state: Path | None = None) -> Path:
    """Return the directory of the recordings, which may not exist; None: in this process' state directory."""
    return (state or state_directory()) / "faults"


# -- writing --------------------------------------------------------------------------------------------------------


def write(directory: Path, recording: FaultRecording) -> tuple[int, Path]:
    """Write a recording under the next number, remove the oldest beyond `KEPT`, and return number and file.

    Raises:
        RecordingError: the file cannot be written; no part of it is left.
    """
    try:
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            # Instances of the service share the directory.
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            number = _next_number(directory)
            about = replace(recording.about, number=number)
            path = directory / f"fault-{number:06d}-{about.when:%Y-%m-%dT%H-%M-%S}.mcap"
            new = directory / f".{path.name}.new"
            try:
                _fill(new, replace(recording, about=about))
                os.replace(new, path)
            finally:
                new.unlink(missing_ok=True)
            os.fsync(descriptor)
            _thin_out(directory)
        finally:
            os.close(descriptor)
    except OSError as error:
        defect = f"no recording can be written there: {error.strerror or error}"
        raise RecordingError("refused", directory, defect) from error
    return number, path


def write_new(path: Path, recording: FaultRecording) -> None:
    """Write a recording as a file of its own, which does not exist yet.

    Raises:
        RecordingError: the file exists or cannot be written; no part of it is left.
    """
    try:
        _fill(path, recording)
    except FileExistsError as error:
        raise RecordingError("exists", path, "there is such a file; it is not overwritten") from error
    except OSError as error:
        path.unlink(missing_ok=True)
        raise RecordingError(
            "refused", path, f"no recording can be written there: {error.strerror or error}"
        ) from error


def _next_number(directory: Path) -> int:
    last = directory / _LAST
    numbers = [number for number, _ in files(directory)]
    with contextlib.suppress(OSError, ValueError):
        numbers.append(int(last.read_bytes()[:12]))
    number = max(numbers, default=0) + 1
    new = directory / f".{_LAST}.new"
    new.write_text(f"{number}\n")
    os.replace(new, last)
    return number


def _fill(path: Path, recording: FaultRecording) -> None:
    about, records = recording.about, recording.records
    # The record's clock is CLOCK_MONOTONIC; the file's is that of the fault's instant, CLOCK_REALTIME.
    instants = records["time_ns"]
    offset_ns = max(about.time_ns - int(instants[about.at]), -int(instants[0])) if len(records) else 0
    seconds = float(instants[-1] - instants[0]) * 1e-9 if len(records) else 0.0
    channels = CycleChannels(recording.schema, offset_ns)
    metadata = {"format": FORMAT, "seconds": seconds, **asdict(about)}
    file = McapFile(path, channels.context, {"json": json.dumps(metadata)})
    try:
        channels.publish(records)
        for moment in about.timeline:
            channels.log(moment.time_ns, moment.message)
    finally:
        file.complete(durable=True)


def cycle_type(schema: RecordSchema) -> np.dtype[np.void]:
    """Return the type of a cycle's message: CDR aligns each number to its size, as numpy's aligned types do."""
    return np.dtype(numpy_fields(schema), align=True)


def versions() -> dict[str, str]:
    """Return the versions of the software that makes a recording."""
    return {
        "rtcp": rtcp.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "kernel": os.uname().release,
    }


def _thin_out(directory: Path) -> None:
    for _, path in files(directory)[:-KEPT]:
        path.unlink(missing_ok=True)
        path.with_suffix(".png").unlink(missing_ok=True)  # its picture (`rtcp faults show`)
    # Left by an interrupted writer: the lock excludes others.
    for left in directory.glob(".fault-*.new"):
        left.unlink(missing_ok=True)


# -- reading --------------------------------------------------------------------------------------------------------


def listed(directory: Path) -> list[Listed]:
    """Return the recordings of a directory, the oldest first; none where there is no directory.

    Raises:
        RecordingError: the directory cannot be read.
    """
    entries = []
    for number, path in files(directory):
        try:
            with opened(path) as file:
                about, seconds = _about_of(file)
                if not is_complete(file):
                    raise ValueError("it has no end")
        except RecordingError as error:
            entries.append(Listed(number, path, None, str(error)))
        else:
            entries.append(Listed(number, path, about, "", seconds))
    return entries


def read(path: Path) -> FaultRecording:
    """Read a recording.

    Raises:
        RecordingError: it is cut off, is no recording, or was written by another version.
    """
    with opened(path) as file:
        about, _ = _about_of(file)
        file.seek(0)
        decoder, left, parts = ChunkDecoder(), _LARGEST, []
        for record in contents(file):
            if isinstance(record, Chunk):
                parts.append(decoder.decode(record, left).cycles)
                left -= record.uncompressed_size
        # The writer leaves out the channel of the cycles where there is none.
        schema = decoder.schema if decoder.schema.fields else arm_schema(max(len(about.joints), 1))
        rows = np.concatenate([np.empty(0, cycle_type(schema)), *(part for part in parts if part.dtype.names)])
        if not (0 <= about.at < len(rows) or (about.at == -1 and not len(rows))):
            raise ValueError(f"it gives {about.at} as the cycle of the fault, and has {len(rows)} cycles")
        if lacking := [name for name in _NEEDED if len(rows) and name not in schema.names]:
            raise ValueError(f"its cycles lack {', '.join(lacking)}")
        if len(rows) and schema.joints != len(about.joints):
            raise ValueError(f"its cycles have {schema.joints} joints, {len(about.joints)} are named")
    return FaultRecording(about, rows, schema)


def files(directory: Path) -> list[tuple[int, Path]]:
    """Return number and file of each recording, the oldest first, without reading them.

    Raises:
        RecordingError: the directory cannot be read.
    """
    try:
        names = os.listdir(directory)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordingError("refused", directory, f"the directory cannot be read: {error.strerror}") from error
    recordings = [(int(match[1]), directory / match[0]) for match in map(_NAME.fullmatch, names) if match]
    return sorted(recordings)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a recording; any exception about its contents becomes a `RecordingError` of the kind damaged."""
    try:
        with open(path, "rb") as file:
            yield file
    except OSError as error:
        raise RecordingError("refused", path, f"the file cannot be read: {error.strerror or error}") from error
    except RecordingError:
        raise
    except Exception as error:
        # The reader passes on all that its parts, zstandard and json raise for invalid bytes.
        defect = f"{type(error).__name__} {error}".rstrip()
        raise RecordingError("damaged", path, f"the file is cut off, damaged or no recording: {defect}") from error


def is_complete(file: IO[bytes]) -> bool:
    """Whether an MCAP file has its end; the file position is kept."""
    at = file.tell()
    file.seek(max(0, file.seek(0, os.SEEK_END) - len(_MAGIC)))
    end = file.read()
    file.seek(at)
    return end == _MAGIC


class _Stream(StreamReader):
    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode == Opcode.MESSAGE_INDEX:  # two thirds of the time; not needed when reading from the beginning
            self._stream.read(length)
            return None
        return super()._read_record(opcode, length)


def contents(file: IO[bytes]) -> Iterator[McapRecord]:
    """Return the records of a file, chunks as they are, none of them larger than allowed."""
    yield from _Stream(file, emit_chunks=True, validate_crcs=True, record_size_limit=_LARGEST_RECORD).records


class Batch(NamedTuple):
    """Content of a chunk: cycles (`cycle_type`), the CLOCK_REALTIME of the first of them, ns, and log messages."""

    cycles: npt.NDArray[np.void]
    time_ns: int
    log: list[Moment]


class ChunkDecoder:
    """Decodes the chunks of one file in turn: each may announce channels for those that follow.

    Attributes:
        schema: of a cycle.
        kind: of a cycle; without fields until the channel of the cycles is announced.
        cycle_channel, log_channel: their numbers; -1: not announced.
    """

    def __init__(self) -> None:
        self.schema = RecordSchema(())
        self.kind: np.dtype[np.void] = np.dtype([])
        self._schemas: dict[int, bytes] = {}
        self.cycle_channel = self.log_channel = -1

    def decode(self, chunk: Chunk, allowed: int = _LARGEST_RECORD) -> Batch:
        """Return the content of a chunk; raises any exception that its bytes cause.

        Args:
            chunk: its size is checked before it is unpacked, its CRC afterwards.
            allowed: largest size, unpacked, bytes.
        """
        size = chunk.uncompressed_size
        packed = zstandard.frame_content_size(chunk.data) if chunk.compression == "zstd" else len(chunk.data)
        # -1: the frame lacks its size, as from a writer that streams.
        if packed not in (size, -1) or size > allowed or chunk.compression not in ("zstd", ""):
            raise ValueError(f"a chunk of {packed} bytes, {size} announced, {allowed} allowed")
        data = (
            zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
            if chunk.compression
            else chunk.data
        )
        if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise ValueError("a chunk has another size or CRC than announced")
        cycles, log, first_ns, at = [], [], 0, 0
        while at < size:
            opcode, length = _RECORD.unpack_from(data, at)
            begin = at + _RECORD.size
            at = begin + length
            if opcode == Opcode.MESSAGE:
                channel, _, time_ns, _ = _MESSAGE.unpack_from(data, begin)
                if channel == self.cycle_channel:
                    first_ns = first_ns or time_ns
                    cycles.append(data[begin + _MESSAGE.size + len(ENCAPSULATION) : at])
                elif channel == self.log_channel:
                    entry = json.loads(data[begin + _MESSAGE.size : at])
                    log.append(Moment(time_ns, str(entry["message"]), int(entry["level"])))
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(io.BytesIO(data[begin:at])))
                self._schemas[schema.id] = schema.data
            elif opcode == Opcode.CHANNEL:
                self._announce(Channel.read(ReadDataStream(io.BytesIO(data[begin:at]))))
        if at != size or {len(cycle) for cycle in cycles} - {self.kind.itemsize}:
            raise ValueError(f"a cycle of another size than {self.kind.itemsize} bytes, or cut off")
        return Batch(np.frombuffer(b"".join(cycles), self.kind) if cycles else np.empty(0, self.kind), first_ns, log)

    def _announce(self, channel: Channel) -> None:
        if channel.topic == LOG:
            self.log_channel = channel.id
        elif channel.topic == CYCLE:
            schema = RecordSchema.from_definition(self._schemas[channel.schema_id])
            if lacking := {"number", "time_ns"} - set(schema.names):
                raise ValueError(f"its cycles lack {', '.join(sorted(lacking))}")
            known = arm_schema(max(schema.joints, 1))
            for field in schema.fields:
                if field.name in known.names:
                    wanted = known[field.name]
                    if (field.type, field.shape) != (wanted.type, wanted.shape):
                        raise ValueError(
                            f"{field.name} is {field.type} {field.shape}, not {wanted.type} {wanted.shape}"
                        )
            if self.cycle_channel >= 0 and schema != self.schema:
                raise ValueError("it has cycles of two kinds")
            self.schema, self.kind, self.cycle_channel = schema, cycle_type(schema), channel.id


def _about_of(file: IO[bytes]) -> tuple[About, float]:
    """Return the metadata of a file, and the seconds from its first cycle to its last."""
    for record in contents(file):
        if isinstance(record, Metadata) and record.name == ABOUT:
            content = json.loads(record.metadata["json"])
            if content["format"] != FORMAT:
                raise ValueError(f"allowed is format {FORMAT}")
            # Moments of former versions have no level.
            content["timeline"] = [{"level": INFORMATION, **moment} for moment in content["timeline"]]
            about = from_json(About, {field.name: content[field.name] for field in fields(About)})
            if about.period_ns <= 0 or not math.isfinite(about.when.timestamp()):
                raise ValueError("its cycle or its time is impossible")
            return about, float(content["seconds"])
    raise ValueError(f"it has no metadata {ABOUT}")
