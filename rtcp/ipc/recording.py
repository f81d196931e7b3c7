"""A fault on disk: one `.npz` file of plain arrays, written whole or not at all, and read with distrust.

Each field of the cycle record is an array of its own, (n,) or (n, joints): `numpy.load(file)["position"]`. `about` is a
JSON text in bytes: what happened, when, to which arm. Nothing in it is a pickle.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import lzma
import math
import os
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from rtcp.config.zero import state_directory
from rtcp.ipc.layout import PER_JOINT, SCALARS, RecordLayout
from rtcp.ipc.observer import record_type

FORMAT = 1
KEPT = 100
"""Files: more than anyone reads, and with about 2 MB each (20 000 cycles of six joints) less disk than a film."""
_ABOUT = "about"
_LAST = "last"
"""File with the last number that was given: none is given twice, also where its file was removed."""
_NAME = re.compile(r"fault-(\d{1,12})-\d{4}-\d\d-\d\dT\d\d-\d\d-\d\d\.npz")
_LARGEST = 1 << 26
"""Bytes of one array, unpacked: three times a whole ring of four values for ten joints."""
_JOINTS_MAX = 10
_QUICK = 1
"""zlib's level: half the time of the usual one, a tenth more bytes."""

_DAMAGE = (ValueError, TypeError, SyntaxError, tokenize.TokenError, MemoryError, OverflowError, RecursionError)
"""What numpy and json make of bytes that are not theirs."""
_NO_ARCHIVE = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, NotImplementedError, RuntimeError, *_DAMAGE,
)  # fmt: skip
"""And zipfile, which lets through what its parts raise."""

Records = dict[str, npt.NDArray[Any]]


class RecordingError(Exception):
    """A recording cannot be written or read: a sentence."""


@dataclass(frozen=True)
class Moment:
    """A sentence of the loop and when it was said, CLOCK_REALTIME ns."""

    time_ns: int
    sentence: str


@dataclass(frozen=True)
class About:
    """What a recording is of."""

    number: int
    """0 until it is written."""
    time_ns: int
    """Of the fault, CLOCK_REALTIME."""
    what: str
    """The fault's first sentence."""
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
    """What is not in it, in sentences."""
    timeline: tuple[Moment, ...]

    @property
    def when(self) -> datetime:
        """The fault's instant in local time."""
        return datetime.fromtimestamp(self.time_ns * 1e-9).astimezone()


@dataclass(frozen=True)
class Recording:
    """A fault: what it is, and the cycle records around it, oldest first, by field."""

    about: About
    records: Records


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


def write(directory: Path, recording: Recording) -> tuple[int, Path]:
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
            path = directory / f"fault-{number:06d}-{about.when:%Y-%m-%dT%H-%M-%S}.npz"
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
        raise RecordingError(f"{directory}: no recording can be written there: {error.strerror or error}") from error
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


def _fill(path: Path, recording: Recording) -> None:
    about = json.dumps({"format": FORMAT, **asdict(recording.about)}).encode()
    arrays = {_ABOUT: np.frombuffer(about, dtype=np.uint8), **recording.records}
    with open(path, "xb") as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=_QUICK) as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    npy.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


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
            with _opened(path) as archive:
                about = _about(path, archive)
                instants = _instants(path, archive)
            seconds = (int(instants[-1]) - int(instants[0])) * 1e-9 if len(instants) else 0.0
        except RecordingError as error:
            found.append(Listed(number, path, None, str(error)))
        else:
            found.append(Listed(number, path, about, "", seconds))
    return found


def read(path: Path) -> Recording:
    """Read a recording.

    Raises:
        RecordingError: it is cut off, is none, or was written by another version.
    """
    with _opened(path) as archive:
        about = _about(path, archive)
        records = {name: _array(path, archive, name) for name, _ in (*SCALARS, *PER_JOINT)}
    cycles, joints = records["number"].size, len(about.joints)
    kinds = record_type(RecordLayout(joints))
    for name, array in records.items():
        wanted = (cycles, *kinds[name].shape)
        if array.shape != wanted or array.dtype != kinds[name].base:
            found = f"{name} is {array.dtype} of the shape {array.shape}"
            raise RecordingError(f"{path}: {found}, allowed is {kinds[name].base} of the shape {wanted}")
    if not (0 <= about.at < cycles or (about.at == -1 and cycles == 0)):
        raise RecordingError(f"{path}: the fault's cycle is said to be {about.at}, there are {cycles}")
    return Recording(about, records)


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
        raise RecordingError(f"{directory}: the directory cannot be read: {error.strerror}") from error
    found = [(int(match[1]), directory / match[0]) for match in map(_NAME.fullmatch, names) if match]
    return sorted(found)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except _NO_ARCHIVE as error:
        raise RecordingError(f"{path}: the file is cut off, damaged or no recording: {error}") from error
    except OSError as error:
        raise RecordingError(f"{path}: the file cannot be read: {error.strerror or error}") from error


def _array(path: Path, archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    try:
        member = archive.getinfo(f"{name}.npy")
        if member.file_size > _LARGEST:
            raise ValueError(f"{member.file_size} bytes, at most {_LARGEST} are allowed")
        with archive.open(member) as stream:
            found = npy.read_array(stream, allow_pickle=False)
    except KeyError:
        raise RecordingError(f"{path}: there is no {name} in it, it is no recording") from None
    except _DAMAGE as error:
        raise RecordingError(f"{path}: {name} is damaged: {error}") from error
    return found


def _instants(path: Path, archive: zipfile.ZipFile) -> npt.NDArray[np.int64]:
    found = _array(path, archive, "time_ns")
    if found.ndim != 1 or found.dtype != np.dtype("<i8"):
        raise RecordingError(f"{path}: time_ns is {found.dtype} of the shape {found.shape}, allowed is a row of int64")
    return found


def _about(path: Path, archive: zipfile.ZipFile) -> About:
    try:
        told = json.loads(_array(path, archive, _ABOUT).tobytes())
        if not isinstance(told, dict) or told.get("format") != FORMAT:
            raise ValueError(f"allowed is format {FORMAT}")
        return _checked(told)
    except (ValueError, KeyError, TypeError, OverflowError, OSError, RecursionError) as error:
        raise RecordingError(f"{path}: what it says about itself is not of this version: {error}") from error


def _checked(told: Mapping[str, Any]) -> About:
    numbers = {key: _of(told, key, int) for key in ("number", "time_ns", "period_ns", "began_ns", "event", "at")}
    texts = {key: _of(told, key, str) for key in ("what", "before", "arm", "bus")}
    moments = [Moment(_of(one, "time_ns", int), _of(one, "sentence", str)) for one in _of(told, "timeline", list)]
    about = About(
        **numbers,
        **texts,
        joints=tuple(str(name) for name in _of(told, "joints", list)[:_JOINTS_MAX]),
        versions={str(name): str(version) for name, version in _of(told, "versions", dict).items()},
        notes=tuple(str(note) for note in _of(told, "notes", list)),
        timeline=tuple(moments),
    )
    if about.period_ns <= 0 or not math.isfinite(about.when.timestamp()):
        raise ValueError("its cycle or its time is none")
    return about


def _of(told: Mapping[str, Any], key: str, kind: type) -> Any:
    if type(found := told[key]) is not kind:
        raise TypeError(f"{key} is {type(found).__name__}, allowed is {kind.__name__}")
    return found
