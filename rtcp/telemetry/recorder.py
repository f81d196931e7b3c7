"""The recorder: a process that reads the ring of cycle records, as any onlooker may, and writes it to the disk.

It ends with SIGTERM, after `--seconds`, with the platform, or when the disk refuses. What it is doing stands in a file
of the runtime directory, so that a gateway that was started anew finds it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import foxglove
import numpy as np
import numpy.typing as npt
from foxglove.mcap import MCAPWriteOptions

import rtcp
from rtcp.config.model import ArmConfig
from rtcp.config.serialization import to_json
from rtcp.ipc.names import Names
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.session import SessionError, read_session
from rtcp.telemetry.channels import Channels, Records, UnknownSignal, fields_of, urdf_of

FORMATS = ("mcap", "csv")
FLUSH_S = 0.5
"""What a killed recorder has not written yet is younger than this and one turn."""
_TURN_S = 0.1
_WARNING, _INFORMATION = 3, 2
CSV_COLUMNS = ("actual_position", "actual_velocity", "actual_torque", "sent_position")
"""The columns of the source's logger: J1_pos.., J1_vel.., J1_tor.., J1_tpos.. ."""
_CSV_NAMES = {"actual_position": "pos", "actual_velocity": "vel", "actual_torque": "tor", "sent_position": "tpos"}
Row = npt.NDArray[np.void]


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

    def log(self, time_ns: int, message: str, level: int) -> None:
        """Append a message."""

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

    def log(self, time_ns: int, message: str, level: int) -> None:
        """Publish a message."""
        self._channels.log(time_ns, message, level)

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
        self._names = [name for name, _, _ in fields_of(signals)] if signals else list(CSV_COLUMNS)
        self._began_ns: int | None = None
        per_joint = {name for name, _, each in fields_of(()) if each}
        header = ["Time"]
        for name in self._names:
            short = _CSV_NAMES.get(name, name)
            header += [f"J{axis}_{short}" for axis in range(1, joints + 1)] if name in per_joint else [name]
        self._file.write(",".join(header) + "\n")

    def write(self, records: Records) -> None:
        """Append a line a record; times count from the first, s."""
        if not len(records):
            return
        if self._began_ns is None:
            self._began_ns = int(records["time_ns"][0])
        columns = [((records["time_ns"] - self._began_ns) * 1e-9).tolist()]
        for name in self._names:
            found = records[name]
            columns += found.T.tolist() if found.ndim == 2 else [found.tolist()]
        form = ",".join("%.9f" if at == 0 else "%.9g" for at in range(len(columns))) + "\n"
        self._file.write("".join(form % row for row in zip(*columns, strict=True)))

    def log(self, time_ns: int, message: str, level: int) -> None:
        """Nothing: the columns are the source's."""

    def flush(self) -> None:
        """Hand it to the system."""
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
        "rtcp": rtcp.__version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


@dataclass(frozen=True)
class Options:
    """What is recorded, and where to."""

    out: Path
    """A directory, or a file whose ending is that of its only format."""
    formats: tuple[str, ...] = ("mcap",)
    signals: tuple[str, ...] = ()
    every: int = 1
    """Each so many-th cycle."""
    seconds: float | None = None

    def paths(self) -> dict[str, Path]:
        """Return the new file of each format; raises RecorderError."""
        if self.out.suffix.removeprefix(".") in FORMATS:
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
        self._names = Names(config)
        self._at = self._observer.head
        self._event = self._observer.last_event
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._channels = Channels(config, self._offset_ns, options.signals)
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
        except OSError as error:
            raise RecorderError(_refused(error, options.out)) from error
        import psutil

        self.recording = Recording(os.getpid(), hash(psutil.Process()), [str(writer.path) for writer in self._writers])
        self._say()

    def end(self) -> None:
        """Ask for the end of `run`; from a signal handler too."""
        self._ended = True

    def run(self) -> int:
        """Record until the end; return the exit code."""
        made, began = self.recording, time.monotonic()
        until = None if self._options.seconds is None else began + self._options.seconds
        try:
            while not self._ended and self._loop_lives():
                self._turn()
                made.seconds = time.monotonic() - began
                if until is not None and time.monotonic() >= until:
                    break
                time.sleep(_TURN_S)
            self._turn()
            self._each(lambda writer: writer.close())
        except OSError as error:
            made.problem = f"the recording has ended: {_refused(error, self._options.out)}"
        made.ended = True
        self._say()
        return 1 if made.problem else 0

    def _loop_lives(self) -> bool:
        return Path(f"/proc/{self._observer.loop_pid}").exists()

    def _turn(self) -> None:
        """Write what is new."""
        records, missing = self._observer.since(self._at)
        if len(records) or missing:
            self._write(records, missing)
        for event in self._observer.events_since(self._event):
            self._event = event.number
            self._log(self._offset_ns + event.monotonic_ns, self._names.message(event.event), _INFORMATION)
        for text in self._observer.texts_since(self._text):
            self._text = text.number
            self._log(text.time_ns, text.sentence, _WARNING if text.is_problem else _INFORMATION)
        now = time.monotonic()
        if now - self._flushed >= FLUSH_S:
            self._flushed = now
            self._each(lambda writer: writer.flush())
            self._say()

    def _write(self, records: Records, missing: int) -> None:
        made = self.recording
        made.missing += missing
        first = self._at + 1
        self._at += len(records) + missing
        if missing:
            instant = int(records["time_ns"][0]) if len(records) else time.monotonic_ns()
            text = f"{missing} of the cycles from {first} to {self._at} are missing: they were not read in time"
            self._log(self._offset_ns + instant, text, _WARNING)
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

    def _log(self, time_ns: int, message: str, level: int) -> None:
        for writer in self._writers:
            writer.log(time_ns, message, level)

    def _say(self) -> None:
        """Write down what it is doing, whole or not at all; a full disk there loses the status, not the recording."""
        made = self.recording
        with contextlib.suppress(OSError):
            made.bytes = sum(writer.path.stat().st_size for writer in self._writers)
        path = status_file(self._directory, made.pid)
        new = path.with_suffix(".new")
        with contextlib.suppress(OSError):
            new.write_text(json.dumps(dataclasses.asdict(made)))
            os.replace(new, path)


def _refused(error: OSError, out: Path) -> str:
    return f"{error.filename or out} cannot be written: {error.strerror or error}"


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
    answer: Callable[[dict[str, Any]], None] = lambda line: print(json.dumps(line), flush=True)  # noqa: E731
    try:
        recorder = Recorder(given.directory, options)
    except (RecorderError, UnknownSignal, BlackboardError, SessionError) as error:
        answer({"error": str(error)})
        return 1

    def end(number: int, frame: FrameType | None) -> None:
        recorder.end()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    answer({"recording": dataclasses.asdict(recorder.recording)})
    return recorder.run()


if __name__ == "__main__":
    sys.exit(main())
