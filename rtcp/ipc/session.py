"""The processes of one running platform and their session: JSON files in the runtime directory.

The loop's process reads the session and writes its exit report; psutil is loaded only to look processes up.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import rtcp
from rtcp.config.cell import CellConfig
from rtcp.config.model import ArmConfig
from rtcp.config.serialization import from_json, to_json

if TYPE_CHECKING:
    import psutil

T = TypeVar("T")

EXIT_INCOMPLETE = 3
"""Exit code of a loop that ended by itself but could not leave every slave in INIT with its drive disabled."""
_KILL_TIMEOUT_S = 2.0
_POLL_S = 0.01


class SessionError(Exception):
    """A file of the runtime directory is missing, damaged or writable by others; the message names it."""


# -- beginning --------------------------------------------------------------------------------------------------


def launch_arguments(program: str) -> tuple[Path, int]:
    """Return the runtime directory and the pipe for reports from the command line of loop or gateway.

    With `--wait`: once the launcher has written a byte to standard input; where it has ended, exit with 1.
    """
    import argparse  # here: clients read sessions too

    parser = argparse.ArgumentParser(prog=program)
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--ready-fd", type=int, required=True)
    parser.add_argument("--wait", action="store_true", help="begin with a byte from standard input")
    arguments = parser.parse_args()
    if arguments.wait and not sys.stdin.buffer.read(1):
        raise SystemExit(1)
    return arguments.directory, arguments.ready_fd


# -- processes --------------------------------------------------------------------------------------------------


class Pid(int):
    """A process id with psutil's identity of its process, which a later process with the same id does not share."""

    identity: int

    def __new__(cls, number: int, identity: int = 0) -> Pid:
        """Combine both; `identify` looks the identity up."""
        pid = super().__new__(cls, number)
        pid.identity = identity
        return pid


NO_PROCESS = Pid(0)


def identify(number: int) -> Pid:
    """Return the identity of a process that exists: a child, or the caller."""
    import psutil  # here and below: the loop's process must not load it

    try:
        # The hash of (id, start since boot), numbers alone: the same in every process, and no step of the wall clock
        # changes it. `create_time()` needs /proc/stat, which the service does not see.
        return Pid(number, hash(psutil.Process(number)))
    except psutil.Error:
        return Pid(number)


def is_running(pid: int) -> bool:
    """Return whether this very process runs; a zombie, or a later process with the same id, does not count."""
    return _find(pid) is not None


def terminate(pid: Pid, timeout_s: float) -> bool:
    """Send SIGTERM, after `timeout_s` SIGKILL; return whether SIGTERM was enough. Never signals another process."""
    process = _find(pid)
    if process is None:
        return True
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        process.terminate()
        if wait_for_exit(pid, timeout_s):
            return True
        process.kill()
        wait_for_exit(pid, _KILL_TIMEOUT_S)
        return False
    return True


def wait_for_exit(pid: Pid, timeout_s: float) -> bool:
    """Wait until the process has exited; return whether it has. Does not reap it: its exit code stays its parent's."""
    until = time.monotonic() + timeout_s
    while is_running(pid):
        if time.monotonic() > until:
            return False
        time.sleep(_POLL_S)
    return True


def _find(pid: int) -> psutil.Process | None:
    if not isinstance(pid, Pid) or pid <= 0:
        return None
    import psutil

    try:
        process = psutil.Process(pid)
        ended = process.status() in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
        return None if ended or hash(process) != pid.identity else process
    except psutil.Error:
        return None


@dataclass
class Processes:
    """The platform's processes; `NO_PROCESS` where there is none."""

    loop: Pid = NO_PROCESS
    gateway: Pid = NO_PROCESS
    segment: Pid = NO_PROCESS

    def write(self, directory: Path) -> None:
        """Replace `processes.json`, whole or not at all."""
        identities = {name: pid.identity for name, pid in vars(self).items()}
        _replace(processes_file(directory), {**vars(self), "identities": identities})


def processes_file(directory: Path) -> Path:
    """Return the path of the file that names the processes: `{"loop": 12, ..., "identities": {"loop": 3, ...}}`."""
    return directory / "processes.json"


def read_processes(directory: Path) -> Processes:
    """Return the processes that `processes.json` names; none where it is missing or damaged."""
    try:
        content = json.loads(processes_file(directory).read_text())
        identities = content["identities"]
        return Processes(*(Pid(int(content[role.name]), int(identities[role.name])) for role in fields(Processes)))
    except (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError):
        return Processes()


def _replace(path: Path, content: object) -> None:
    fresh = path.with_suffix(".new")
    with _naming(fresh):
        fresh.write_text(json.dumps(content))
    fresh.replace(path)


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file in an error of the disk, which a write does not."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


# -- the session ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Session:
    """Settings that the launcher passes to the loop and the gateway."""

    config: ArmConfig
    bus: str
    interface: str
    segment_pid: int
    began_ns: int
    """When the start was requested, CLOCK_MONOTONIC."""
    state: Path | None = None
    """Directory of persistent state, also for a gateway that is started later; None: from its environment."""
    segment_control: Path | None = None
    """Control socket of the platform's virtual segment; None: it has none."""
    cell: CellConfig | None = None
    """The cell that the arm belongs to."""
    name: str = ""
    """Name of the platform; that of the arm in the cell."""

    @property
    def partners(self) -> tuple[str, ...]:
        """Names of the other arms of the cell."""
        members = () if self.cell is None else self.cell.members
        return tuple(member.name for member in members if member.name != self.name)

    def write(self, directory: Path) -> None:
        """Write the session file with mode 0600."""
        path = session_file(directory)
        path.unlink(missing_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        with _naming(path), open(descriptor, "w") as file:
            json.dump({"version": rtcp.__version__, "session": to_json(self)}, file)


def session_file(directory: Path) -> Path:
    """Return the path of the session file."""
    return directory / "session.json"


def read_session(directory: Path) -> Session:
    """Read the session file.

    Raises:
        SessionError: the file is missing, damaged or of another version, or others may write to it.
    """
    path = session_file(directory)
    try:
        owner = path.stat()
    except OSError as error:
        raise SessionError(f"{path} cannot be read: {error.strerror}") from error
    if owner.st_uid not in (0, os.geteuid()) or owner.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise SessionError(f"{path} is another user's, or others may write to it: it is not read")
    content = read_json(path, dict)
    if content.get("version") != rtcp.__version__:
        raise SessionError(f"{path} was written by another version of rtcp: it is not read by {rtcp.__version__}")
    try:
        return from_json(Session, content.get("session"))
    except ValueError as error:
        raise SessionError(f"{path} is damaged: {error}") from error


def read_json(path: Path, kind: type[T]) -> T:
    """Read a JSON file of the runtime directory whose outermost value is a `kind`.

    Raises:
        SessionError: the file is missing or damaged.
    """
    try:
        content = json.loads(path.read_text())
    except OSError as error:
        raise SessionError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SessionError(f"{path} is damaged: {error}") from error
    if not isinstance(content, kind):
        raise SessionError(f"{path} is damaged: found {type(content).__name__}, allowed is {kind.__name__}")
    return content


# -- the loop's exit report -------------------------------------------------------------------------------------


def _exit_report(directory: Path) -> Path:
    return directory / "ended.json"


def remove_exit_report(directory: Path) -> None:
    """Remove the report of an earlier loop, before a new one starts."""
    _exit_report(directory).unlink(missing_ok=True)


def write_exit_report(directory: Path, pid: int, problems: Sequence[str]) -> None:
    """Record that the loop `pid` has left the bus, and its problems with that."""
    path = _exit_report(directory)
    try:
        _replace(path, {"pid": pid, "left": list(problems)})
    except OSError as error:
        # Without a report the end counts as a crash, which is safe.
        with contextlib.suppress(OSError):
            sys.stderr.write(f"{path} cannot be written: {error.strerror}\n")


def exit_problems(directory: Path, loop: Pid, was_running: bool) -> tuple[str, ...]:
    """Return, in sentences, drives that a loop left enabled and slaves that it left in another state than INIT.

    Args:
        directory: the runtime directory.
        loop: the loop's process; `NO_PROCESS`: there was none.
        was_running: whether it ran when its end was requested.
    """
    if not loop:
        return ()
    with contextlib.suppress(SessionError):
        report = read_json(_exit_report(directory), dict)
        left = report.get("left")
        if report.get("pid") == loop and isinstance(left, list):
            return tuple(str(sentence) for sentence in left)
    if is_running(loop):
        return (f"the loop (process {loop}) does not end, also not by SIGKILL: its drives were left to their watchdog",)
    fate = "did not end in time and was killed" if was_running else "had ended before, and not in order"
    return (f"the loop (process {loop}) {fate}: its drives were left to their watchdog",)
