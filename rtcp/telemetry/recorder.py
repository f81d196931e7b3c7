"""The recorder: a process that reads the ring of cycle records, as any onlooker may, and writes it to the disk.

It ends with SIGTERM, after `seconds`, with the platform, or when the disk refuses or has only its reserve left. What it
is doing stands in a file of the runtime directory, so that a gateway that was started anew finds it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import errno
import glob
import io
import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path
from types import FrameType
from typing import IO, Any, Protocol, get_args

import foxglove
from foxglove.mcap import MCAPWriteOptions

from rtcp.api.feed import Feed, Records
from rtcp.config.model import ArmConfig, RecordingConfig, RecordingFormat
from rtcp.config.serialization import from_json, to_json
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.recording import versions
from rtcp.ipc.schema import RecordSchema
from rtcp.ipc.session import identify
from rtcp.telemetry.channels import Channels, UnknownSignal, fields_of, urdf_of

FORMATS = get_args(RecordingFormat)
FLUSH_S = 0.5
"""What a killed recorder has not written yet is younger than this and one turn."""
_TURN_S = 0.1
_BATCH = 1024
"""Records at a time: after a stall the whole ring is there."""
CSV_NAMES = {"actual_position": "pos", "actual_velocity": "vel", "actual_torque": "tor", "sent_position": "tpos"}
"""The columns of the source's logger: J1_pos.., J1_vel.., J1_tor.., J1_tpos.. ."""


@dataclass
class RecorderStatus:
    """What a recorder is doing; the file `recorder-PID.json` of the runtime directory has these fields."""

    pid: int
    identity: int
    files: list[str]
    """Those that are being written, or were written last: one a format."""
    rotations: int = 0
    """How many files of each format came before them."""
    records: int = 0
    missing: int = 0
    """Cycles that were overwritten in the ring before they were read."""
    bytes: int = 0
    seconds: float = 0.0
    ended: bool = False
    problem: str = ""


def status_file(directory: Path, pid: int) -> Path:
    """Return the file that says what the recorder `pid` is doing."""
    return directory / f"recorder-{pid}.json"


class Writer(Protocol):
    """The files of one format, one after the other."""

    path: Path | None
    """The file that is being written, or was last."""

    def open(self, path: Path) -> None:
        """Begin a new file, the one before it being closed; raises OSError, ValueError."""

    def write(self, records: Records, chosen: Records) -> None:
        """Append what changed in the records, and the numbers of the chosen ones; raises OSError."""

    def flush(self) -> None:
        """Hand over to the system what was written; raises OSError."""

    def close(self) -> None:
        """Complete the file; raises OSError."""


class _Disk(io.RawIOBase):
    """A file for the MCAP writer, which goes back to the beginning of a chunk when it ends one.

    Only whole chunks reach the disk, by `commit`: the file can be read at any time, after a kill and on a full disk.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115
        self._pending = io.BytesIO()
        self._written = 0

    def write(self, data: Any) -> int:
        return self._pending.write(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._written + self._pending.seek(offset - self._written if whence == os.SEEK_SET else offset, whence)

    def commit(self) -> None:
        """Write what has come since the last time; raises OSError, and leaves the file as it was."""
        data = memoryview(self._pending.getvalue())
        check_linked(self._file)
        try:
            left = data
            while len(left):
                left = left[self._file.write(left) or 0 :]
        except OSError:
            self._file.truncate(self._written)
            raise
        self._written += len(data)
        self._pending = io.BytesIO()

    def close(self) -> None:
        self._file.close()
        super().close()


def check_linked(file: IO[Any]) -> None:
    """Raise OSError where a file has been removed: what is written to it is for nobody."""
    if os.fstat(file.fileno()).st_nlink == 0:
        raise OSError(errno.ENOENT, "it has been removed")


class McapWriter:
    """A recording as MCAP.

    Args:
        channels: what is published in their context.
        config: the arm; it goes into each file whole.
        began_ns: CLOCK_REALTIME at its beginning; None: now.
    """

    def __init__(self, channels: Channels, config: ArmConfig, began_ns: int | None = None) -> None:
        self.path: Path | None = None
        self._channels, self._config, self._began_ns = channels, config, began_ns

    def open(self, path: Path) -> None:
        """Begin a file with all that explains it."""
        self._disk = _Disk(path)
        self.path = path
        config, options = self._config, MCAPWriteOptions(profile="ros2", compression_level=1, compression_threads=0)
        self._writer = foxglove.open_mcap(self._disk, context=self._channels.context, writer_options=options)
        self._writer.write_metadata("rtcp/about", about(config))
        text = json.dumps(to_json(config), indent=1).encode()
        self._attach("configuration.json", "application/json", text)
        if config.arm is not None:
            self._attach("arm.urdf", "application/xml", urdf_of(config).encode())
        self._channels.describe(self._now())
        self.flush()

    def _attach(self, name: str, media_type: str, data: bytes) -> None:
        now = self._now()
        self._writer.attach(log_time=now, create_time=now, name=name, media_type=media_type, data=data)

    def _now(self) -> int:
        """Return the time as the channels have it: setting the clock does not reach the next file either."""
        return self._channels.wall_ns(time.monotonic_ns()) if self._began_ns is None else self._began_ns

    def write(self, records: Records, chosen: Records) -> None:
        """Publish the records: the writer listens."""
        self._channels.publish(records, chosen)

    def flush(self) -> None:
        """End the chunk, so that a reader finds all of it."""
        self._writer.flush()
        self._disk.commit()

    def close(self) -> None:
        """Write the index."""
        self._writer.close()
        try:
            self._disk.commit()
        finally:
            self._disk.close()


class CsvWriter:
    """A recording as CSV.

    Args:
        schema: of the records.
        names: of the records' fields, in the order of the columns; none: those of the source.
    """

    def __init__(self, schema: RecordSchema, names: Sequence[str] = ()) -> None:
        self.path: Path | None = None
        self._schema = schema
        self._names = list(names or CSV_NAMES)
        self._began_ns: int | None = None

    def open(self, path: Path) -> None:
        """Begin a file with its header."""
        self._file = open(path, "x", newline="")  # noqa: SIM115
        self.path = path
        header = ["Time"]
        for name in self._names:
            field, short = self._schema[name], CSV_NAMES.get(name, name)
            header += [f"J{axis}_{short}" for axis in range(1, field.count + 1)] if field.shape else [name]
        self._file.write(",".join(header) + "\n")

    def write(self, records: Records, chosen: Records) -> None:
        """Append a line a chosen record; times count from the first of the recording, s."""
        if not len(chosen):
            return
        if self._began_ns is None:
            self._began_ns = int(chosen["time_ns"][0])
        columns = [((chosen["time_ns"] - self._began_ns) * 1e-9).tolist()]
        forms = ["%.9f"]
        for name in self._names:
            found = chosen[name]
            columns += found.T.tolist() if found.ndim == 2 else [found.tolist()]
            forms += ["%.9g" if found.dtype.kind == "f" else "%d"] * (len(columns) - len(forms))
        form = ",".join(forms) + "\n"
        self._file.write("".join(form % row for row in zip(*columns, strict=True)))

    def flush(self) -> None:
        """Hand it to the system."""
        check_linked(self._file)
        self._file.flush()

    def close(self) -> None:
        """End the file."""
        self._file.close()


def about(config: ArmConfig) -> dict[str, str]:
    """Return what a recording says about itself: arm, joints, cycle and versions."""
    return {
        "arm": config.name,
        "joints": ", ".join(joint.name for joint in config.joints),
        "period_us": f"{config.cycle.period_us:g}",
        **versions(),
    }


class Recorder:
    """Reads a blackboard and writes it down.

    Args:
        directory: the runtime directory.
        options: what is recorded; `out` is given.

    Raises:
        RtcpError: it cannot be recorded; reasons and fields are those of `Robot.record_start`.
        UnknownSignal: a signal that no record has.
        NotRunning: no platform runs there.
    """

    def __init__(self, directory: Path, options: RecordingConfig) -> None:
        self._directory, self._options = directory, options
        self._feed = Feed(directory)
        config = self._feed.config
        schema = self._feed.schema
        self._channels = Channels(config, schema, time.time_ns() - time.monotonic_ns(), options.signals)
        self._ended = False
        self._rotates = options.max_file_mb is not None or options.max_file_seconds is not None
        if options.keep is not None and not self._rotates:
            message = f"keep: found {options.keep} without max_file_mb or max_file_seconds, which begin new files"
            raise RtcpError("invalid", message, "keep_without_limit", {"keep": options.keep})
        self._stem, formats = _place(options)
        more = [one for one in fields_of(schema, options.signals) if one not in CSV_NAMES] if options.signals else []
        self._writers: dict[str, Writer] = {
            name: McapWriter(self._channels, config) if name == "mcap" else CsvWriter(schema, [*CSV_NAMES, *more])
            for name in formats
        }
        me = identify(os.getpid())
        self.status = RecorderStatus(me, me.identity, [])
        self._finished_bytes = 0
        try:
            self._stem.parent.mkdir(parents=True, exist_ok=True)
            self._check_space()
            self._check_place()
            self._open()
        except (OSError, ValueError) as error:
            for writer in self._writers.values():
                if writer.path is not None:
                    writer.path.unlink(missing_ok=True)
            raise _not_writable(error, self._stem) from error
        self._write_status()

    def end(self) -> None:
        """Ask for the end of `run`; from a signal handler too."""
        self._ended = True

    def run(self) -> int:
        """Record until the end; return the exit code."""
        made, began = self.status, time.monotonic()
        until = None if self._options.seconds is None else began + self._options.seconds
        try:
            while not self._ended and (until is None or time.monotonic() < until):
                self._turn()
                made.seconds = time.monotonic() - began
                if self._feed.ended(_TURN_S):
                    break
            self._turn()
        except Exception as error:
            self._failed(error)
        # Each by itself: a disk that is full for one may have room for the index of the other.
        for writer in self._writers.values():
            try:
                writer.close()
            except Exception as error:
                self._failed(error)
        made.ended = True
        self._write_status()
        return 1 if made.problem else 0

    def _failed(self, error: Exception) -> None:
        """Note why the recording ends early; the first reason counts."""
        if isinstance(error, OSError):
            error = _not_writable(error, self._stem)
        reason = str(error) if isinstance(error, RtcpError) else f"{type(error).__name__} {error}"
        self.status.problem = self.status.problem or f"the recording has ended: {reason}"

    def _turn(self) -> None:
        """Write what is new."""
        records, missing = self._feed.records()
        self.status.missing += missing
        for begin in range(0, len(records), _BATCH):
            part = records[begin : begin + _BATCH]
            chosen = part[part["number"] % self._options.every == 0] if self._options.every > 1 else part
            self._each(methodcaller("write", part, chosen))
            self.status.records += len(chosen)
        for instant, message, level in self._feed.messages():
            self._channels.log(self._channels.wall_ns(instant), message, level)
        if time.monotonic() - self._flushed >= FLUSH_S:
            self._flush()

    def _flush(self) -> None:
        """Hand over what was written; go on in new files where these are full, end where the disk is nearly."""
        self._flushed = time.monotonic()
        self._each(methodcaller("flush"))
        self._check_space()
        reached = (
            (max(self._sizes()) / 1e6, self._options.max_file_mb),
            (self._flushed - self._opened, self._options.max_file_seconds),
        )
        if any(limit is not None and found >= limit for found, limit in reached):
            self._rotate()
        self._write_status()

    def _check_space(self) -> None:
        place, reserve = self._stem.parent, self._options.reserve_mb
        free = shutil.disk_usage(place).free / 1e6
        if free < reserve:
            message = f"{place}: {free:.0f} MB are free, less than the reserve of {reserve} MB (reserve_mb): free some"
            fields = {"directory": str(place), "free_mb": round(free), "reserve_mb": reserve}
            raise RtcpError("refused", message, "disk_reserve", fields)

    def _check_place(self) -> None:
        """Refuse a place where files of another rotating recording would be met later."""
        for name in self._writers if self._rotates else ():
            for path in self._stem.parent.glob(f"{glob.escape(self._stem.name)}-[0-9]*.{name}"):
                raise FileExistsError(errno.EEXIST, "File exists", str(path))

    def _rotate(self) -> None:
        """Complete the files, begin the next ones, and remove the oldest beyond those that are kept."""
        self._each(methodcaller("close"))
        self._finished_bytes += sum(self._sizes())
        self.status.rotations += 1
        self._open()
        if self._options.keep is not None and (oldest := self.status.rotations - self._options.keep) >= 0:
            for name in self._writers:
                self._path(name, oldest).unlink(missing_ok=True)

    def _open(self) -> None:
        for name, writer in self._writers.items():
            writer.open(self._path(name, self.status.rotations))
        self.status.files = [str(writer.path) for writer in self._writers.values()]
        self._opened = self._flushed = time.monotonic()

    def _path(self, name: str, number: int) -> Path:
        """Return the file of a format; numbers have a width, so that names sort by age."""
        return self._stem.with_name(f"{self._stem.name}{f'-{number:06d}' if self._rotates else ''}.{name}")

    def _sizes(self) -> list[int]:
        return [writer.path.stat().st_size for writer in self._writers.values() if writer.path is not None]

    def _each(self, do: Callable[[Writer], None]) -> None:
        """Do something with the file of every format; an error names its file."""
        for writer in self._writers.values():
            try:
                do(writer)
            except OSError as error:
                error.filename = error.filename or str(writer.path)
                raise

    def _write_status(self) -> None:
        """Write down what it is doing, whole or not at all; a full disk there loses the status, not the recording."""
        made = self.status
        with contextlib.suppress(OSError):
            made.bytes = self._finished_bytes + sum(self._sizes())
        path = status_file(self._directory, made.pid)
        new = path.with_suffix(".new")
        with contextlib.suppress(OSError):
            new.write_text(json.dumps(dataclasses.asdict(made)))
            os.replace(new, path)


def _place(options: RecordingConfig) -> tuple[Path, tuple[str, ...]]:
    """Return the files' path without number and ending, and the formats: those given, else the file's ending, or mcap.

    Raises:
        RtcpError: the ending of `out` and the formats are not the same.
    """
    assert options.out is not None
    out, formats = Path(options.out), tuple(dict.fromkeys(options.formats))
    ending = out.suffix.removeprefix(".")
    if ending not in FORMATS or os.path.isdir(out):  # False where the folder may not be read
        stem = time.strftime("recording-%Y-%m-%dT%H-%M-%S") + f"-{os.getpid()}"
        return out / stem, formats or FORMATS[:1]
    if formats not in ((), (ending,)):
        message = f"{out}: its ending is not that of the format {', '.join(formats)}"
        raise RtcpError("invalid", message, "format_mismatch", {"file": str(out), "formats": list(formats)})
    return out.with_suffix(""), (ending,)


def _not_writable(error: OSError | ValueError, place: Path) -> RtcpError:
    where, why = (error.filename, error.strerror) if isinstance(error, OSError) else (None, None)
    fields = {"file": str(where or place), "error": str(why or error)}
    return RtcpError("refused", f"{fields['file']} cannot be written: {fields['error']}", "not_writable", fields)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the recorder's process: a line of JSON once it records, or with what stands in the way."""
    parser = argparse.ArgumentParser(prog="rtcp.telemetry.recorder")
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--options", type=json.loads, required=True)
    given = parser.parse_args(arguments)
    recorder: Recorder | None = None
    wanted = False

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal wanted
        wanted = True
        if recorder is not None:
            recorder.end()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("0")  # memory that runs short costs the recording, not the loop
    try:
        recorder = Recorder(given.directory, from_json(RecordingConfig, given.options))
    except UnknownSignal as error:
        fields = {"signal": error.signal, "allowed": error.allowed}
        return _refuse(RtcpError("invalid", str(error), "unknown_signal", fields))
    except RtcpError as error:
        return _refuse(error)
    if wanted:
        recorder.end()
    _answer({"recording": dataclasses.asdict(recorder.status)})
    return recorder.run()


def _refuse(error: RtcpError) -> int:
    _answer({"error": error.message, "kind": error.kind, "reason": error.reason, "fields": error.fields})
    return 1


def _answer(line: dict[str, Any]) -> None:
    """Tell the gateway; it may have gone meanwhile."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    sys.exit(main())
