"""Cycle records on disk: the form of their files, read with distrust; one MCAP file a fault, whole or not at all.

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
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
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
from mcap.writer import CompressionType, Writer

import rtcp
from rtcp.config.model import MOST_AXES
from rtcp.config.zero import state_directory
from rtcp.ipc.observer import numpy_fields
from rtcp.ipc.schema import RecordSchema, arm_schema

FORMAT = 2
KEPT = 100
"""Files: more than anyone reads, of about 2 MB each (20 000 cycles of six joints)."""
ABOUT = "rtcp/about"
_CYCLE, _LOG = "/cycle", "/log"
_LAST = "last"
"""File with the last number that was given: none is given twice, also where its file was removed."""
_NAME = re.compile(r"fault-(\d{1,12})-\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d\.mcap")
_LARGEST_RECORD, _LARGEST = 1 << 26, 1 << 28
"""Bytes of one record of a file, and of all messages of a fault, unpacked: three times a whole ring of ten joints."""
_MAGIC = b"\x89MCAP0\r\n"
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
"""Opcode and length of a record in a chunk; channel, sequence, log and publish time before the data of a message."""
ENCAPSULATION = b"\x00\x01\x00\x00"
"""CDR, little endian (OMG DDSI-RTPS, 10.5)."""
LOG_SCHEMA = {
    "type": "object",
    "title": "foxglove.Log",
    "properties": {
        "timestamp": {
            "type": "object",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
    },
}
INFORMATION, WARNING, ERROR = 2, 3, 4
"""Levels of `foxglove.Log`."""
_NEEDED = ("number", "time_ns", "state", "wkc", "wkc_expected", "missed", "lost", "actual_position", "actual_torque",
           "commanded_position", "sent_position", "statusword", "flags")  # fmt: skip
"""What every recording of a fault has, whatever else its cycles hold."""

Records = dict[str, npt.NDArray[Any]]


Kind = Literal["refused", "damaged", "empty", "signals", "exists", "long", "gap", "disabled"]


class RecordingError(Exception):
    """A recording cannot be written or read; the message names file and defect.

    Attributes:
        kind: refused (by the system), damaged (cut off, or no recording), empty (no cycles, or none in the span asked
            for), signals (there is none of that name), exists (it would be overwritten), long (for what is asked).
        path: of the file or the directory.
        fields: what was found and what is allowed, by name.
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
    """What a recording is of."""

    number: int
    """0 until it is written."""
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
    """When the platform was started, CLOCK_MONOTONIC; together with `event` it says which fault this is."""
    event: int
    """Number of the event that began the fault; 0: the loop's process died or hung."""
    at: int
    """Index of the fault's cycle in the arrays; -1: there are no records."""
    notes: tuple[str, ...]
    """What is missing, a sentence each."""
    timeline: tuple[Moment, ...]

    @property
    def when(self) -> datetime:
        """The fault's instant in local time."""
        return datetime.fromtimestamp(self.time_ns * 1e-9).astimezone()


@dataclass(frozen=True)
class FaultRecording:
    """A fault: what it is, and the cycle records around it, oldest first, by field."""

    about: About
    records: Records
    schema: RecordSchema


@dataclass(frozen=True)
class Listed:
    """A file of the directory: what it is of, or why that cannot be read."""

    number: int
    path: Path
    about: About | None
    trouble: str
    seconds: float = 0.0
    """From its first cycle to its last."""


def faults_directory(state: Path | None = None) -> Path:
    """Return where the recordings are, without making it; None: in this process' state directory."""
    return (state or state_directory()) / "faults"


# -- writing --------------------------------------------------------------------------------------------------------


def write(directory: Path, recording: FaultRecording) -> tuple[int, Path]:
    """Write a recording under the next number, remove the oldest beyond `KEPT`, and return number and file.

    Raises:
        RecordingError: the disk refuses; nothing of the file is left.
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


def _next_number(directory: Path) -> int:
    last = directory / _LAST
    given = [number for number, _ in files(directory)]
    with contextlib.suppress(OSError, ValueError):
        given.append(int(last.read_bytes()[:12]))
    number = max(given, default=0) + 1
    new = directory / f".{_LAST}.new"
    new.write_text(f"{number}\n")
    os.replace(new, last)
    return number


def _fill(path: Path, recording: FaultRecording) -> None:
    about = recording.about
    with open(path, "xb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2", f"rtcp {about.versions.get('rtcp', '')}")
        metadata = {"format": FORMAT, "seconds": _seconds(recording.records), **asdict(about)}
        writer.add_metadata(ABOUT, {"json": json.dumps(metadata)})
        _write_cycles(writer, recording)
        schema = writer.register_schema("foxglove.Log", "jsonschema", json.dumps(LOG_SCHEMA).encode())
        channel = writer.register_channel(_LOG, "json", schema)
        for moment in about.timeline:
            entry = json.dumps(log_entry(moment.time_ns, moment.message)).encode()
            writer.add_message(channel, moment.time_ns, entry, moment.time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
        file.flush()
        os.fsync(file.fileno())


def _write_cycles(writer: Writer, recording: FaultRecording) -> None:
    about, records = recording.about, recording.records
    messages = cycle_messages(records, cycle_type(recording.schema))
    schema = writer.register_schema("rtcp_msgs/msg/Cycle", "ros2msg", recording.schema.definition())
    channel = writer.register_channel(_CYCLE, "cdr", schema)
    # The record's clock is CLOCK_MONOTONIC; the file's is that of the fault's instant, CLOCK_REALTIME.
    offset_ns = about.time_ns - int(records["time_ns"][about.at]) if messages else 0
    for data, number, time_ns in zip(messages, records["number"], records["time_ns"], strict=True):
        when = max(int(time_ns) + offset_ns, 0)
        writer.add_message(channel, when, data, when, int(number) & 0xFFFF_FFFF)


def cycle_type(schema: RecordSchema) -> np.dtype[np.void]:
    """Return a cycle's message: CDR aligns each number to its size, as numpy's aligned types do."""
    return np.dtype(numpy_fields(schema), align=True)


def cycle_messages(
    records: Mapping[str, npt.NDArray[Any]] | npt.NDArray[np.void], kind: np.dtype[np.void]
) -> list[bytes]:
    """Return a message of the type `kind` (`cycle_type`) for each of some cycle records."""
    rows = np.zeros(len(records["number"]), dtype=kind)
    for name in rows.dtype.names or ():
        rows[name] = records[name]
    packed, size = rows.tobytes(), kind.itemsize
    return [ENCAPSULATION + packed[at : at + size] for at in range(0, len(packed), size)]


def log_entry(time_ns: int, message: str, level: int = INFORMATION) -> dict[str, Any]:
    """Return a message of `LOG_SCHEMA`; `time_ns`: CLOCK_REALTIME."""
    sec, nsec = divmod(time_ns, 1_000_000_000)
    return {"timestamp": {"sec": sec, "nsec": nsec}, "level": level, "message": message, "name": "rtcp"}


def versions() -> dict[str, str]:
    """Return the versions of what makes a recording."""
    return {
        "rtcp": rtcp.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "kernel": os.uname().release,
    }


def _seconds(records: Records) -> float:
    instants = records["time_ns"]
    return (int(instants[-1]) - int(instants[0])) * 1e-9 if len(instants) else 0.0


def _thin_out(directory: Path) -> None:
    for _, path in files(directory)[:-KEPT]:
        path.unlink(missing_ok=True)
        path.with_suffix(".png").unlink(missing_ok=True)  # its picture (`rtcp faults show`)
    # What an interrupted writer left: whoever holds the lock is the only one.
    for left in directory.glob(".fault-*.new"):
        left.unlink(missing_ok=True)


# -- reading --------------------------------------------------------------------------------------------------------


def listed(directory: Path) -> list[Listed]:
    """Return the recordings of a directory, the oldest first; none where there is no directory.

    Raises:
        RecordingError: the directory cannot be read.
    """
    found = []
    for number, path in files(directory):
        try:
            with opened(path) as file:
                about, seconds = next(_abouts(file), (None, 0.0))
                if about is None or not is_complete(file):
                    raise ValueError("it has no end" if about else f"it has no metadata {ABOUT}")
        except RecordingError as error:
            found.append(Listed(number, path, None, str(error)))
        else:
            found.append(Listed(number, path, about, "", seconds))
    return found


def read(path: Path) -> FaultRecording:
    """Read a recording.

    Raises:
        RecordingError: it is cut off, is none, or was written by another version.
    """
    with opened(path) as file:
        about, _ = next(_abouts(file), (None, 0.0))
        if about is None:
            raise ValueError(f"it has no metadata {ABOUT}")
        file.seek(0)
        schema, rows = _cycles(file)
        if lacking := [name for name in _NEEDED if name not in schema.names]:
            raise ValueError(f"its cycles lack {', '.join(lacking)}")
        if schema.joints != len(about.joints):
            raise ValueError(f"its cycles have {schema.joints} joints, {len(about.joints)} are named")
        if not (0 <= about.at < len(rows) or (about.at == -1 and not len(rows))):
            raise ValueError(f"it gives {about.at} as the cycle of the fault, and has {len(rows)} cycles")
    return FaultRecording(about, {name: np.ascontiguousarray(rows[name]) for name in schema.names}, schema)


def files(directory: Path) -> list[tuple[int, Path]]:
    """Return number and file of each recording, the oldest first, without a look into them.

    Raises:
        RecordingError: the directory cannot be read.
    """
    try:
        names = os.listdir(directory)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordingError("refused", directory, f"the directory cannot be read: {error.strerror}") from error
    found = [(int(match[1]), directory / match[0]) for match in map(_NAME.fullmatch, names) if match]
    return sorted(found)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a recording; whatever is raised about its contents becomes a `RecordingError` of the kind damaged."""
    try:
        with open(path, "rb") as file:
            yield file
    except OSError as error:
        raise RecordingError("refused", path, f"the file cannot be read: {error.strerror or error}") from error
    except RecordingError:
        raise
    except Exception as error:
        # The reader lets through whatever its parts, zstandard and json raise about bytes that are not theirs.
        defect = f"{type(error).__name__} {error}".rstrip()
        raise RecordingError("damaged", path, f"the file is cut off, damaged or no recording: {defect}") from error


def is_complete(file: IO[bytes]) -> bool:
    """Whether an MCAP file has its end; the place in it is kept."""
    at = file.tell()
    file.seek(max(0, file.seek(0, os.SEEK_END) - len(_MAGIC)))
    end = file.read()
    file.seek(at)
    return end == _MAGIC


class _Stream(StreamReader):
    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode == Opcode.MESSAGE_INDEX:  # two thirds of the time, for what nobody needs who reads from the beginning
            self._stream.read(length)
            return None
        return super()._read_record(opcode, length)


def contents(file: IO[bytes]) -> Iterator[McapRecord]:
    """Return the records of a file, chunks as they are, none of them larger than allowed."""
    yield from _Stream(file, emit_chunks=True, validate_crcs=True, record_size_limit=_LARGEST_RECORD).records


class Batch(NamedTuple):
    """What a chunk has: cycles (`cycle_type`), the CLOCK_REALTIME of the first of them, ns, and log messages."""

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
        """Return what a chunk has; raises whatever its bytes cause.

        Args:
            chunk: checked before it is unpacked, and its CRC afterwards.
            allowed: its largest size, unpacked.
        """
        size = chunk.uncompressed_size
        packed = zstandard.frame_content_size(chunk.data) if chunk.compression == "zstd" else len(chunk.data)
        # -1: the frame does not say, as from a writer that streams.
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
        if at != size or {len(one) for one in cycles} - {self.kind.itemsize}:
            raise ValueError(f"a cycle of another size than {self.kind.itemsize} bytes, or cut off")
        return Batch(np.frombuffer(b"".join(cycles), self.kind) if cycles else np.empty(0, self.kind), first_ns, log)

    def _announce(self, channel: Channel) -> None:
        if channel.topic == _LOG:
            self.log_channel = channel.id
        elif channel.topic == _CYCLE:
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


def _abouts(file: IO[bytes]) -> Iterator[tuple[About, float]]:
    """Return what a file says about itself, and the seconds from its first cycle to its last."""
    for record in contents(file):
        if isinstance(record, Metadata) and record.name == ABOUT:
            metadata = json.loads(record.metadata["json"])
            if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
                raise ValueError(f"allowed is format {FORMAT}")
            yield _checked(metadata), float(_of(metadata, "seconds", float))


def _cycles(file: IO[bytes]) -> tuple[RecordSchema, npt.NDArray[np.void]]:
    """Return the schema and the cycles of a file, oldest first."""
    decoder, left, found = ChunkDecoder(), _LARGEST, []
    for record in contents(file):
        if isinstance(record, Chunk):
            found.append(decoder.decode(record, left).cycles)
            left -= record.uncompressed_size
    if not decoder.schema.fields:
        raise ValueError("no channel of cycles")
    return decoder.schema, np.concatenate([rows for rows in found if rows.dtype.names])


def _checked(metadata: Mapping[str, Any]) -> About:
    numbers = {key: _of(metadata, key, int) for key in ("number", "time_ns", "period_ns", "began_ns", "event", "at")}
    texts = {key: _of(metadata, key, str) for key in ("what", "before", "arm", "bus")}
    moments = [Moment(_of(one, "time_ns", int), _of(one, "message", str)) for one in _of(metadata, "timeline", list)]
    about = About(
        **numbers,
        **texts,
        joints=tuple(str(name) for name in _of(metadata, "joints", list)[:MOST_AXES]),
        versions={str(name): str(version) for name, version in _of(metadata, "versions", dict).items()},
        notes=tuple(str(note) for note in _of(metadata, "notes", list)),
        timeline=tuple(moments),
    )
    if about.period_ns <= 0 or not math.isfinite(about.when.timestamp()):
        raise ValueError("its cycle or its time is impossible")
    return about


def _of(metadata: Mapping[str, Any], key: str, kind: type) -> Any:
    if type(found := metadata[key]) is not kind:
        raise TypeError(f"{key} is {type(found).__name__}, allowed is {kind.__name__}")
    return found
