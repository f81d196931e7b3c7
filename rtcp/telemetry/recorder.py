"""The recorder: a process that observes the ring of cycle records and writes it to the disk.

It ends at SIGTERM, after `seconds`, with the platform, or when the disk fails or has only its reserve left. Its status
is a file in the runtime directory, which a restarted gateway finds.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import errno
import glob
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
from typing import Any, Protocol, get_args

from rtcp.api.feed import Feed, Records
from rtcp.config.model import ArmConfig, RecordingConfig, RecordingFormat
from rtcp.config.serialization import from_json, to_json
from rtcp.ipc.cycle_channels import McapFile, check_linked
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.recording import versions
from rtcp.ipc.schema import RecordSchema
from rtcp.ipc.session import identify
from rtcp.telemetry.channels import Channels, UnknownSignal, fields_of, urdf_of

FORMATS = get_args(RecordingFormat)
FLUSH_S = 0.5
"""Interval of flushes, s: a killed recorder loses at most this and one poll."""
_POLL_S = 0.1
_BATCH = 1024
"""Most records written at once: after a stall the whole ring is waiting."""
CSV_NAMES = {"actual_position": "pos", "actual_velocity": "vel", "actual_torque": "tor", "sent_position": "tpos"}
"""Columns of the thesis' logger: J1_pos.., J1_vel.., J1_tor.., J1_tpos.. ."""


@dataclass
class RecorderStatus:
    """Status of a recorder, the content of the file `recorder-PID.json` in the runtime directory."""

    pid: int
    identity: int
    files: list[str]
    """Present or last file of each format."""
    rotations: int = 0
    """Number of earlier files of each format."""
    records: int = 0
    missing: int = 0
    """Cycles that were overwritten in the ring before they were read."""
    bytes: int = 0
    seconds: float = 0.0
    ended: bool = False
    problem: str = ""


def status_file(directory: Path, pid: int) -> Path:
    """Return the status file of the recorder `pid`."""
    return directory / f"recorder-{pid}.json"


class Writer(Protocol):
    """Writes the consecutive files of one format."""

    path: Path | None
    """Present or last file."""

    def open(self, path: Path) -> None:
        """Begin a new file, after the former one was closed; raises OSError, ValueError."""

    def write(self, records: Records, chosen: Records) -> None:
        """Append the changes in the records, and the values of the chosen ones; raises OSError."""

    def flush(self) -> None:
        """Pass buffered data to the system; raises OSError."""

    def close(self) -> None:
        """Complete the file; raises OSError."""


class McapWriter:
    """A recording as MCAP.

    Args:
        channels: the channels to record.
        config: the arm; each file contains it.
        began_ns: CLOCK_REALTIME at its begin, ns; None: now.
    """

    def __init__(self, channels: Channels, config: ArmConfig, began_ns: int | None = None) -> None:
        self.path: Path | None = None
        self._channels, self._config, self._began_ns = channels, config, began_ns

    def open(self, path: Path) -> None:
        """Begin a file with metadata and configuration."""
        config = self._config
        self._file = McapFile(path, self._channels.context, about(config))
        self.path = path
        text = json.dumps(to_json(config), indent=1).encode()
        self._attach("configuration.json", "application/json", text)
        if config.arm is not None:
            self._attach("arm.urdf", "application/xml", urdf_of(config).encode())
        self._channels.describe(self._now())
        self.flush()

    def _attach(self, name: str, media_type: str, data: bytes) -> None:
        now = self._now()
        self._file.attach(log_time=now, create_time=now, name=name, media_type=media_type, data=data)

    def _now(self) -> int:
        """Return the time of the channels, which a change of the system's clock does not affect."""
        return self._channels.wall_ns(time.monotonic_ns()) if self._began_ns is None else self._began_ns

    def write(self, records: Records, chosen: Records) -> None:
        """Publish the records; the file receives all channels."""
        self._channels.publish(records, chosen)

    def flush(self) -> None:
        """End the chunk, so that it is readable."""
        self._file.commit()

    def close(self) -> None:
        """Write the index."""
        self._file.complete()


class CsvWriter:
    """A recording as CSV.

    Args:
        schema: schema of the records.
        names: fields in the order of the columns; none: those of the thesis.
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
        """Append a line for each chosen record, with its time from the first record, s."""
        if not len(chosen):
            return
        if self._began_ns is None:
            self._began_ns = int(chosen["time_ns"][0])
        columns = [((chosen["time_ns"] - self._began_ns) * 1e-9).tolist()]
        forms = ["%.9f"]
        for name in self._names:
            values = chosen[name]
            columns += values.T.tolist() if values.ndim == 2 else [values.tolist()]
            forms += ["%.9g" if values.dtype.kind == "f" else "%d"] * (len(columns) - len(forms))
        form = ",".join(forms) + "\n"
        self._file.write("".join(form % row for row in zip(*columns, strict=True)))

    def flush(self) -> None:
        """Pass buffered lines to the system."""
        check_linked(self._file)
        self._file.flush()

    def close(self) -> None:
        """End the file."""
        self._file.close()


def about(config: ArmConfig) -> dict[str, str]:
    """Return the metadata of a recording: arm, joints, cycle and versions."""
    return {
        "arm": config.name,
        "joints": ", ".join(joint.name for joint in config.joints),
        "period_us": f"{config.cycle.period_us:g}",
        **versions(),
    }


class Recorder:
    """Reads a blackboard and records it.

    Args:
        directory: the runtime directory.
        options: options of the recording, with `out`.

    Raises:
        RtcpError: it cannot be recorded; reasons and fields as in `Robot.record_start`.
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
        more = [key for key in fields_of(schema, options.signals) if key not in CSV_NAMES] if options.signals else []
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
        """Request the end of `run`; safe from a signal handler."""
        self._ended = True

    def run(self) -> int:
        """Record until the end; return the exit code."""
        status, began = self.status, time.monotonic()
        until = None if self._options.seconds is None else began + self._options.seconds
        try:
            while not self._ended and (until is None or time.monotonic() < until):
                self._write_new()
                status.seconds = time.monotonic() - began
                if self._feed.ended(_POLL_S):
                    break
            self._write_new()
        except Exception as error:
            self._failed(error)
        # Each separately: a disk that is full for one may have room for the index of the other.
        for writer in self._writers.values():
            try:
                writer.close()
            except Exception as error:
                self._failed(error)
        status.ended = True
        self._write_status()
        return 1 if status.problem else 0

    def _failed(self, error: Exception) -> None:
        """Store the reason of an early end; the first one stays."""
        if isinstance(error, OSError):
            error = _not_writable(error, self._stem)
        reason = str(error) if isinstance(error, RtcpError) else f"{type(error).__name__} {error}"
        self.status.problem = self.status.problem or f"the recording has ended: {reason}"

    def _write_new(self) -> None:
        """Write new records and messages."""
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
        """Flush the files; rotate them at their limits; raises RtcpError where the disk has only its reserve left."""
        self._flushed = time.monotonic()
        self._each(methodcaller("flush"))
        self._check_space()
        reached = (
            (max(self._sizes()) / 1e6, self._options.max_file_mb),
            (self._flushed - self._opened, self._options.max_file_seconds),
        )
        if any(limit is not None and value >= limit for value, limit in reached):
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
        """Refuse a path at which files of another rotating recording would follow."""
        for name in self._writers if self._rotates else ():
            for path in self._stem.parent.glob(f"{glob.escape(self._stem.name)}-[0-9]*.{name}"):
                raise FileExistsError(errno.EEXIST, "File exists", str(path))

    def _rotate(self) -> None:
        """Complete the files, begin the next ones, and remove the oldest beyond `keep`."""
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
        """Return the file of a format; numbers are zero-padded, so that names sort by age."""
        return self._stem.with_name(f"{self._stem.name}{f'-{number:06d}' if self._rotates else ''}.{name}")

    def _sizes(self) -> list[int]:
        return [writer.path.stat().st_size for writer in self._writers.values() if writer.path is not None]

    def _each(self, do: Callable[[Writer], None]) -> None:
        """Call `do` for the writer of every format; an error names its file."""
        for writer in self._writers.values():
            try:
                do(writer)
            except OSError as error:
                error.filename = error.filename or str(writer.path)
                raise

    def _write_status(self) -> None:
        """Write the status file, whole or not at all; a full disk there loses the status, not the recording."""
        status = self.status
        with contextlib.suppress(OSError):
            status.bytes = self._finished_bytes + sum(self._sizes())
        path = status_file(self._directory, status.pid)
        new = path.with_suffix(".new")
        with contextlib.suppress(OSError):
            new.write_text(json.dumps(dataclasses.asdict(status)))
            os.replace(new, path)


def _place(options: RecordingConfig) -> tuple[Path, tuple[str, ...]]:
    """Return the path without number and ending, and the formats: from the options, else the path's ending, or mcap.

    Raises:
        RtcpError: the ending of `out` contradicts the formats.
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
    """Run the recorder's process; it prints a line of JSON once it records, or with the error that prevents it."""
    parser = argparse.ArgumentParser(prog="rtcp.telemetry.recorder")
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--options", type=json.loads, required=True)
    options = parser.parse_args(arguments)
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
        Path("/proc/self/oom_score_adj").write_text("0")  # a lack of memory kills the recorder, not the loop
    try:
        recorder = Recorder(options.directory, from_json(RecordingConfig, options.options))
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
    """Print a line for the gateway, which may have exited meanwhile."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    sys.exit(main())
