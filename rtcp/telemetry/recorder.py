"""The recorder: a process that reads the ring of cycle records, as any onlooker may, and writes it to the disk.

It ends with SIGTERM, after `--seconds`, with the platform, or when the disk refuses. What it is doing stands in a file
of the runtime directory, so that a gateway that was started anew finds it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import errno
import io
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import IO, Any, Protocol

import foxglove
from foxglove.mcap import MCAPWriteOptions

from rtcp.config.model import ArmConfig
from rtcp.config.serialization import to_json
from rtcp.ipc.layout import PER_JOINT
from rtcp.ipc.names import Names
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.recording import ERROR, INFORMATION, WARNING, versions
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.session import SessionError, identify, read_session
from rtcp.telemetry.channels import Channels, Records, UnknownSignal, fields_of, urdf_of

FORMATS = ("mcap", "csv")
FLUSH_S = 0.5
"""What a killed recorder has not written yet is younger than this and one turn."""
_TURN_S = 0.1
CSV_NAMES = {"actual_position": "pos", "actual_velocity": "vel", "actual_torque": "tor", "sent_position": "tpos"}
"""The columns of the source's logger: J1_pos.., J1_vel.., J1_tor.., J1_tpos.. ."""


class RecorderError(Exception):
    """A recording cannot be begun or continued: a sentence with file and reason."""


@dataclass
class Recording:
    """What a recorder is doing; the file `recorder-PID.json` of the runtime directory has these fields."""

    pid: int
    identity: int
    files: list[str]
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
    """One file of a recording."""

    path: Path

    def write(self, records: Records) -> None:
        """Append records; raises OSError."""

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
        path: the new file.
        channels: what is published in their context.
        config: the arm; it goes into the file whole.
    """

    def __init__(self, path: Path, channels: Channels, config: ArmConfig) -> None:
        self.path = path
        self._channels = channels
        self._disk = _Disk(path)
        options = MCAPWriteOptions(profile="ros2", compression_level=1, compression_threads=0)
        self._writer = foxglove.open_mcap(self._disk, context=channels.context, writer_options=options)
        self._writer.write_metadata("rtcp/about", about(config))
        text = json.dumps(to_json(config), indent=1).encode()
        self._attach("configuration.json", "application/json", text)
        if config.arm is not None:
            self._attach("arm.urdf", "application/xml", urdf_of(config).encode())
        channels.describe(time.time_ns())
        self.flush()

    def _attach(self, name: str, media_type: str, data: bytes) -> None:
        now = time.time_ns()
        self._writer.attach(log_time=now, create_time=now, name=name, media_type=media_type, data=data)

    def write(self, records: Records) -> None:
        """Publish the records: the writer listens."""
        self._channels.publish(records)

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
    """A recording as CSV, in the source's columns, or those that were chosen.

    Args:
        path: the new file.
        joints: how many.
        signals: of the records; none: the source's.
    """

    def __init__(self, path: Path, joints: int, signals: Sequence[str]) -> None:
        self.path = path
        self._file = open(path, "x", newline="")  # noqa: SIM115
        self._names = fields_of(signals) if signals else list(CSV_NAMES)
        self._began_ns: int | None = None
        per_joint = {name for name, _ in PER_JOINT}
        header = ["Time"]
        for name in self._names:
            short = CSV_NAMES.get(name, name)
            header += [f"J{axis}_{short}" for axis in range(1, joints + 1)] if name in per_joint else [name]
        self._file.write(",".join(header) + "\n")

    def write(self, records: Records) -> None:
        """Append a line a record; times count from the first, s."""
        if not len(records):
            return
        if self._began_ns is None:
            self._began_ns = int(records["time_ns"][0])
        columns = [((records["time_ns"] - self._began_ns) * 1e-9).tolist()]
        forms = ["%.9f"]
        for name in self._names:
            found = records[name]
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


@dataclass(frozen=True)
class Options:
    """What is recorded, and where to."""

    out: Path
    """A directory, or a file whose ending is that of its only format."""
    formats: tuple[str, ...] = ("mcap",)
    signals: tuple[str, ...] = ()
    every: int = 1
    """N: every Nth cycle."""
    seconds: float | None = None

    def paths(self) -> dict[str, Path]:
        """Return the new file of each format; raises RecorderError."""
        if self.out.suffix.removeprefix(".") in FORMATS and not self.out.is_dir():
            if self.formats != (self.out.suffix[1:],):
                raise RecorderError(f"{self.out}: its ending is not that of the format {', '.join(self.formats)}")
            return {self.formats[0]: self.out}
        stem = time.strftime("recording-%Y-%m-%dT%H-%M-%S") + f"-{os.getpid()}"
        return {name: self.out / f"{stem}.{name}" for name in self.formats}


class Recorder:
    """Reads a blackboard and writes it down.

    Args:
        directory: the runtime directory.
        options: what is recorded.

    Raises:
        RecorderError: a file cannot be made.
        UnknownSignal: a signal that no record has.
        BlackboardError, SessionError: no platform runs there.
    """

    def __init__(self, directory: Path, options: Options) -> None:
        session = read_session(directory)
        self._directory, self._options, config = directory, options, session.config
        self._observer = Observer(blackboard_file(directory))
        self._loop = select.poll()
        try:
            self._loop.register(os.pidfd_open(self._observer.loop_pid), select.POLLIN)
        except OSError as error:
            raise BlackboardError(f"the loop (process {self._observer.loop_pid}) has ended") from error
        self._names = Names(config)
        self._at = self._observer.head
        self._event = self._observer.last_event
        self._channels = Channels(config, time.time_ns() - time.monotonic_ns(), options.signals)
        self._ended = False
        self._flushed = time.monotonic()
        self._writers: list[Writer] = []
        texts = self._observer.texts_since(0)
        self._text = texts[-1].number if texts else 0
        try:
            for name, path in options.paths().items():
                path.parent.mkdir(parents=True, exist_ok=True)
                self._writers.append(
                    McapWriter(path, self._channels, config)
                    if name == "mcap"
                    else CsvWriter(path, len(config.joints), options.signals)
                )
        except (OSError, ValueError) as error:
            for writer in self._writers:
                writer.path.unlink(missing_ok=True)
            raise RecorderError(_refused(error, options.out)) from error
        me = identify(os.getpid())
        self.recording = Recording(me, me.identity, [str(writer.path) for writer in self._writers])
        self._write_status()

    def end(self) -> None:
        """Ask for the end of `run`; from a signal handler too."""
        self._ended = True

    def run(self) -> int:
        """Record until the end; return the exit code."""
        made, began = self.recording, time.monotonic()
        until = None if self._options.seconds is None else began + self._options.seconds
        try:
            while not self._ended and (until is None or time.monotonic() < until):
                self._turn()
                made.seconds = time.monotonic() - began
                if self._loop.poll(_TURN_S * 1e3):
                    break  # the loop's process has ended
            self._turn()
        except Exception as error:
            self._failed(error)
        # Each by itself: a disk that is full for one may have room for the index of the other.
        for writer in self._writers:
            try:
                writer.close()
            except Exception as error:
                self._failed(error)
        made.ended = True
        self._write_status()
        return 1 if made.problem else 0

    def _failed(self, error: Exception) -> None:
        """Note why the recording ends early; the first reason counts."""
        reason = _refused(error, self._options.out) if isinstance(error, OSError) else f"{type(error).__name__} {error}"
        self.recording.problem = self.recording.problem or f"the recording has ended: {reason}"

    def _turn(self) -> None:
        """Write what is new."""
        records, missing = self._observer.since(self._at)
        if len(records) or missing:
            self._write(records, missing)
        for event in self._observer.events_since(self._event):
            self._event = event.number
            level = ERROR if type(event.event) in self._names.faults else INFORMATION
            self._log(event.monotonic_ns, self._names.message(event.event), level)
        for text in self._observer.texts_since(self._text):
            self._text = text.number
            # Its own time is the wall clock, which may have been set meanwhile.
            level = WARNING if text.is_problem else INFORMATION
            self._log(time.monotonic_ns(), text.sentence, level)
        now = time.monotonic()
        if now - self._flushed >= FLUSH_S:
            self._flushed = now
            self._each(lambda writer: writer.flush())
            self._write_status()

    def _write(self, records: Records, missing: int) -> None:
        made = self.recording
        made.missing += missing
        first = self._at + 1
        self._at += len(records) + missing
        if missing:
            instant = int(records["time_ns"][0]) if len(records) else time.monotonic_ns()
            text = f"{missing} of the cycles from {first} to {self._at} are missing: they were not read in time"
            self._log(instant, text, WARNING)
        chosen = records[records["number"] % self._options.every == 0] if self._options.every > 1 else records
        made.records += len(chosen)
        self._each(lambda writer: writer.write(chosen))

    def _each(self, do: Callable[[Writer], None]) -> None:
        """Do something with every file; an error names its file."""
        for writer in self._writers:
            try:
                do(writer)
            except OSError as error:
                error.filename = error.filename or str(writer.path)
                raise

    def _log(self, monotonic_ns: int, message: str, level: int) -> None:
        self._channels.log(self._channels.wall_ns(monotonic_ns), message, level)

    def _write_status(self) -> None:
        """Write down what it is doing, whole or not at all; a full disk there loses the status, not the recording."""
        made = self.recording
        with contextlib.suppress(OSError):
            made.bytes = sum(writer.path.stat().st_size for writer in self._writers)
        path = status_file(self._directory, made.pid)
        new = path.with_suffix(".new")
        with contextlib.suppress(OSError):
            new.write_text(json.dumps(dataclasses.asdict(made)))
            os.replace(new, path)


def _refused(error: OSError | ValueError, out: Path) -> str:
    where, why = (error.filename, error.strerror) if isinstance(error, OSError) else (None, None)
    return f"{where or out} cannot be written: {why or error}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the recorder's process: a line of JSON once it records, or with what stands in the way."""
    parser = argparse.ArgumentParser(prog="rtcp.telemetry.recorder")
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--options", type=json.loads, required=True)
    given = parser.parse_args(arguments)
    fields = given.options
    options = Options(
        Path(fields["out"]), tuple(fields["formats"]), tuple(fields["signals"]), fields["every"], fields["seconds"]
    )
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
        recorder = Recorder(given.directory, options)
    except UnknownSignal as error:
        _answer({"error": str(error), "kind": "invalid"})
        return 1
    except (RecorderError, BlackboardError, SessionError) as error:
        _answer({"error": str(error), "kind": "refused"})
        return 1
    if wanted:
        recorder.end()
    _answer({"recording": dataclasses.asdict(recorder.recording)})
    return recorder.run()


def _answer(line: dict[str, Any]) -> None:
    """Tell the gateway; it may have gone meanwhile."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    sys.exit(main())
