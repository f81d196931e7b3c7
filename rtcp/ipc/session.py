"""What the processes of one running platform know of each other: small files in the runtime directory."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import signal
import stat
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TypeVar

import rtcp
from rtcp.config.model import ArmConfig
from rtcp.ipc.paths import processes_file, starts_file

T = TypeVar("T")


class SessionError(Exception):
    """A file of the runtime directory is not there, damaged or another user's: a sentence."""


class Pid(int):
    """A process id and when its process started, ticks since boot: together they are no later process's."""

    started: int

    def __new__(cls, number: int, started: int = 0) -> Pid:
        """Make it of both; `identify` finds out when a process started."""
        made = super().__new__(cls, number)
        made.started = started
        return made


NONE = Pid(0)


def identify(number: int) -> Pid:
    """Return the pid of a process that is known to be there: a child, or the caller."""
    return Pid(number, _stat(number)[1])


@dataclass
class Processes:
    """Process ids; 0: there is none."""

    loop: Pid = NONE
    gateway: Pid = NONE
    segment: Pid = NONE

    def write(self, directory: Path) -> None:
        """Write `processes.json`, and beside it when each process started; each whole or not at all."""
        # Ids without their starts are nobody's: the starts come first.
        _replace(starts_file(directory), {str(pid): pid.started for pid in vars(self).values()})
        _replace(processes_file(directory), vars(self))


def read_processes(directory: Path) -> Processes:
    """Return the processes that the files name; none where they are absent or damaged."""
    try:
        numbers = json.loads(processes_file(directory).read_text())
        starts = json.loads(starts_file(directory).read_text())
        names = [field.name for field in fields(Processes)]
        return Processes(*(Pid(int(numbers[name]), int(starts.get(str(numbers[name]), 0))) for name in names))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return Processes()


def forget_processes(directory: Path) -> None:
    """Remove what `Processes.write` wrote."""
    for path in (processes_file(directory), starts_file(directory)):
        path.unlink(missing_ok=True)


def is_ours(pid: int) -> bool:
    """Whether the process lives (a zombie does not) and is the one that was written down, no later bearer of its id."""
    if not isinstance(pid, Pid) or pid <= 0:
        return False
    state, started = _stat(pid)
    return state not in "ZX" and started == pid.started


def end(pid: Pid, patience_s: float) -> bool:
    """End a process of ours by SIGTERM, after `patience_s` by SIGKILL; return whether it ended itself."""
    if not is_ours(pid):
        return True
    _signal(pid, signal.SIGTERM)
    if wait_gone(pid, patience_s):
        return True
    _signal(pid, signal.SIGKILL)
    wait_gone(pid, 2.0)
    return False


def wait_gone(pid: Pid, patience_s: float) -> bool:
    """Wait until the process is gone; return whether it is."""
    until = time.monotonic() + patience_s
    while is_ours(pid):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def _signal(pid: Pid, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        held = os.pidfd_open(pid)
        try:
            # What is held stays the same process from here on, whatever becomes of its id.
            if is_ours(pid):
                signal.pidfd_send_signal(held, number)
        finally:
            os.close(held)


def _stat(number: int) -> tuple[str, int]:
    """Return a process's state and start, ticks since boot (proc_pid_stat(5), fields 3 and 22); X where it is gone."""
    try:
        # Field 2, the name, may hold spaces and brackets.
        fields = Path(f"/proc/{number}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return fields[0], int(fields[19])
    except (OSError, IndexError):
        return "X", 0


def _replace(path: Path, content: dict[str, int]) -> None:
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps(content))
    fresh.replace(path)


@dataclass(frozen=True)
class Session:
    """What the launcher hands to the loop and the gateway, through a file that only their user can write."""

    config: ArmConfig
    bus: str
    interface: str
    segment_pid: int
    began_ns: int
    """When the start was asked for, CLOCK_MONOTONIC."""
    state: Path | None = None
    """Directory of what outlives a restart, whoever starts a gateway later; None: as its environment has it."""
    segment_control: Path | None = None
    """Control socket of the virtual segment that was started with it; None: there is none."""

    def write(self, path: Path) -> None:
        """Write the file, for its user alone: whoever reads it runs what it says."""
        path.unlink(missing_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        with open(descriptor, "wb") as file:
            file.write(pickle.dumps((_form(self), self)))


def read_session(path: Path) -> Session:
    """Read what `Session.write` wrote.

    Raises:
        SessionError: the file is not there, is damaged or of another version, or others may write it.
    """
    try:
        with open(path, "rb") as file:
            owned = os.fstat(file.fileno())
            if owned.st_uid not in (0, os.geteuid()) or owned.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                raise SessionError(f"{path} is another user's, or others may write to it: it is not read")
            found = pickle.load(file)
    except OSError as error:
        raise SessionError(f"{path} cannot be read: {error.strerror}") from error
    except SessionError:
        raise
    except Exception as error:
        # What a damaged pickle leads to is not told by its documentation.
        raise SessionError(f"{path} is damaged ({type(error).__name__}: {error})") from error
    form, session = found if isinstance(found, tuple) and len(found) == 2 else ("", found)
    if not isinstance(session, Session):
        raise SessionError(f"{path} holds no session")
    if form != _form(session):
        raise SessionError(f"{path} was written by another version of rtcp: it is not read by this one")
    return session


def _form(session: Session) -> str:
    """Return a digest of the version and all fields in it: pickle takes what an older class made without a word."""
    seen: dict[str, list[str]] = {}

    def look(value: object) -> None:
        if is_dataclass(value):
            kind = type(value)
            seen[f"{kind.__module__}.{kind.__qualname__}"] = [f"{one.name}: {one.type}" for one in fields(value)]
            for one in vars(value).values():
                look(one)
        elif isinstance(value, tuple | list | set | frozenset):
            for one in value:
                look(one)
        elif isinstance(value, Mapping):
            look(tuple(value.items()))

    look(session)
    return hashlib.sha256(json.dumps([rtcp.__version__, seen], sort_keys=True).encode()).hexdigest()


def read_json(path: Path, kind: type[T]) -> T:
    """Read a file of the runtime directory that holds a `kind` as JSON.

    Raises:
        SessionError: the file is not there or is damaged.
    """
    try:
        found = json.loads(path.read_text())
    except OSError as error:
        raise SessionError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SessionError(f"{path} is damaged: {error}") from error
    if not isinstance(found, kind):
        raise SessionError(f"{path} is damaged: found {type(found).__name__}, allowed is {kind.__name__}")
    return found
