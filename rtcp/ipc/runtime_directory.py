"""The runtime directory of one platform: its path, its files, its lock, and the logs of its processes."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

_LOCK_POLL_S = 0.02
_STDERR = 2
_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))
"""sd-daemon(3): the level at the beginning of a line becomes the entry's PRIORITY."""


class RuntimeDirectoryError(Exception):
    """The runtime directory cannot be used; the message says why."""


class LockHeld(Exception):
    """Another process holds the lock of the runtime directory."""


def runtime_directory(name: str | None = None) -> Path:
    """Return the directory of the control socket and its companions; do not create it.

    `RTCP_RUNTIME_DIR` selects it; else `$XDG_RUNTIME_DIR/rtcp`, `/run/rtcp` for root, `rtcp-<uid>` in the temporary
    directory for anyone else. One directory holds at most one running platform; one with a name has a directory in it.

    Args:
        name: of the platform; empty: the one without a name; None: `RTCP_NAME` of the environment.
    """
    return _unnamed() / (platform_name() if name is None else name)


def platform_name() -> str:
    """Return the name of the platform that the environment chooses by `RTCP_NAME`; empty: the one without a name."""
    return os.environ.get("RTCP_NAME", "")


def _unnamed() -> Path:
    if chosen := os.environ.get("RTCP_RUNTIME_DIR"):
        return Path(chosen)
    if os.geteuid() == 0:
        return Path("/run/rtcp")
    if session := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(session) / "rtcp"
    return Path(tempfile.gettempdir()) / f"rtcp-{os.geteuid()}"


def make_runtime_directory(directory: Path) -> None:
    """Create the directory with mode 0700; leave an existing one unchanged.

    Raises:
        RuntimeDirectoryError: it cannot be created, belongs to another user, or others may write to it.
    """
    try:
        if not directory.exists():
            directory.mkdir(mode=0o700, parents=True)
        status = directory.stat()
    except OSError as error:
        raise RuntimeDirectoryError(f"runtime directory {directory} cannot be made: {error.strerror}") from error
    if status.st_uid != os.geteuid():
        raise RuntimeDirectoryError(
            f"runtime directory {directory} belongs to user {status.st_uid}, not to user {os.geteuid()}: "
            "set RTCP_RUNTIME_DIR to one of your own"
        )
    if not stat.S_ISDIR(status.st_mode) or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise RuntimeDirectoryError(
            f"runtime directory {directory} is no directory, or one that others may write to "
            f"(mode {stat.S_IMODE(status.st_mode):04o}): set RTCP_RUNTIME_DIR to one of your own"
        )


# -- files ------------------------------------------------------------------------------------------------------


def control_socket(directory: Path) -> Path:
    """Return the path of the gateway's control socket."""
    return directory / "control.sock"


def segment_control(directory: Path) -> Path:
    """Return the path of the virtual segment's control socket."""
    return directory / "segment.sock"


def irc5_control(directory: Path) -> Path:
    """Return the path of the virtual IRC5's control socket."""
    return directory / "irc5.sock"


def free_control(usual: Path) -> Path:
    """Return `usual`, or a path with this process's id where a running device listens there already."""
    return usual.with_name(f"{usual.stem}-{os.getpid()}.sock") if is_listening(usual) else usual


def is_listening(path: Path) -> bool:
    """Return whether a process listens at a Unix socket of any type."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            return False
        except OSError:
            pass  # a full queue, another socket type or another user's socket: a process listens
    return True


def stop_marker(directory: Path) -> Path:
    """Return the path of the file that exists while a stop is under way; it marks an intentional stop."""
    return directory / "stopping"


def limits_file(directory: Path) -> Path:
    """Return the path of the file from which a restarted gateway restores narrowed limits."""
    return directory / "limits.json"


def blackboard_file(directory: Path) -> Path:
    """Return the path of the blackboard, which is always in memory: a slow disk must not delay the cycle."""
    # A digest: every directory has a name of its own, independent of its spelling.
    digest = hashlib.sha256(os.fsencode(directory.resolve())).hexdigest()[:16]
    return Path("/dev/shm") / f"rtcp-{os.geteuid()}-{digest}"


@contextlib.contextmanager
def exclusive(directory: Path, timeout_s: float = 0.0, on_wait: Callable[[], None] | None = None) -> Iterator[None]:
    """Hold the directory's lock, which every process that starts, stops or replaces platform processes takes.

    Args:
        directory: the runtime directory.
        timeout_s: how long to wait for the lock.
        on_wait: called once if the lock is not free at once.

    Raises:
        LockHeld: another process held it for all of `timeout_s`.
    """
    until = time.monotonic() + timeout_s
    descriptor = os.open(directory / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until:
                    raise LockHeld from None
            if on_wait is not None:
                on_wait()
                on_wait = None
            time.sleep(_LOCK_POLL_S)
        yield
    finally:
        os.close(descriptor)


# -- logs -------------------------------------------------------------------------------------------------------


def stderr_is_journal() -> bool:
    """Return whether standard error is connected to the systemd journal: systemd.exec(5), $JOURNAL_STREAM.

    The variable alone is not enough: a terminal opened by a desktop service inherits it.
    """
    try:
        status = os.fstat(_STDERR)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def open_log(path: Path) -> BinaryIO:
    """Open the log of a process for appending: the journal if standard error is connected to it, else the file."""
    if stderr_is_journal():
        path.unlink(missing_ok=True)
        return os.fdopen(os.dup(_STDERR), "wb")
    return open(path, "ab")


def log_location(path: Path) -> str:
    """Return where `open_log` writes, for messages."""
    return "the journal" if stderr_is_journal() else str(path)


def log_format() -> logging.Formatter:
    """Return the format of log lines: with the time in a file, with the priority in the journal."""
    return JournalFormat() if stderr_is_journal() else logging.Formatter("%(asctime)s %(message)s")


class JournalFormat(logging.Formatter):
    """Prefixes every line with its priority, also those of a traceback: the journal makes an entry of each line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a record."""
        priority = next(number for level, number in _PRIORITIES if record.levelno >= level)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())
