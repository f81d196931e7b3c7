"""Where the processes of one running platform meet: the runtime directory and what lies in it."""

from __future__ import annotations

import hashlib
import os
import socket
import stat
import tempfile
from pathlib import Path


class RuntimeDirectoryError(Exception):
    """The runtime directory cannot be used: a sentence that says why."""


def runtime_directory() -> Path:
    """Return the directory of the control socket and its companions, without making it.

    `RTCP_RUNTIME_DIR` chooses it; else `$XDG_RUNTIME_DIR/rtcp`, `/run/rtcp` for root, `rtcp-<uid>` in the temporary
    directory for anyone else. One platform runs in one such directory.
    """
    if chosen := os.environ.get("RTCP_RUNTIME_DIR"):
        return Path(chosen)
    if os.geteuid() == 0:
        return Path("/run/rtcp")
    if session := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(session) / "rtcp"
    return Path(tempfile.gettempdir()) / f"rtcp-{os.geteuid()}"


def prepare(directory: Path) -> None:
    """Make the directory, for its owner alone; one that exists already is left as it is.

    Raises:
        RuntimeDirectoryError: where it cannot be made, is another user's, or others may write to it.
    """
    try:
        if not directory.exists():
            directory.mkdir(mode=0o700, parents=True)
        found = directory.stat()
    except OSError as error:
        raise RuntimeDirectoryError(f"runtime directory {directory} cannot be made: {error.strerror}") from error
    if found.st_uid != os.geteuid():
        raise RuntimeDirectoryError(
            f"runtime directory {directory} belongs to user {found.st_uid}, not to user {os.geteuid()}: "
            "set RTCP_RUNTIME_DIR to one of your own"
        )
    if not stat.S_ISDIR(found.st_mode) or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise RuntimeDirectoryError(
            f"runtime directory {directory} is no directory, or one that others may write to "
            f"(mode {stat.S_IMODE(found.st_mode):04o}): set RTCP_RUNTIME_DIR to one of your own"
        )


def control_socket(directory: Path) -> Path:
    """Return the path of the control socket."""
    return directory / "control.sock"


def segment_control(directory: Path) -> Path:
    """Return the path of the virtual segment's control socket."""
    return directory / "segment.sock"


def free_segment_control(directory: Path) -> Path:
    """Return that path, or one with the number of this process in it where a living segment has it."""
    usual = segment_control(directory)
    return directory / f"segment-{os.getpid()}.sock" if listens(usual) else usual


def listens(path: Path) -> bool:
    """Whether a process listens at a Unix socket, whatever it says there."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            return False
        except OSError:
            pass  # a full queue, another kind of socket, another user's: somebody has it
    return True


def processes_file(directory: Path) -> Path:
    """Return the path of the file that names the processes."""
    return directory / "processes.json"


def starts_file(directory: Path) -> Path:
    """Return the path of the file that tells when each of those processes started."""
    return directory / "starts.json"


def stopping_mark(directory: Path) -> Path:
    """Return the path of the mark that a stop is under way: a loop that ends then ends as it was told."""
    return directory / "stopping"


def limits_file(directory: Path) -> Path:
    """Return the path of the file that keeps narrowed limits for a gateway that is started anew."""
    return directory / "limits.json"


def blackboard_file(directory: Path) -> Path:
    """Return the path of the blackboard: always in memory, so that a disk never holds up the cycle."""
    # A digest: two directories never share a name, however they are spelt.
    digest = hashlib.sha256(os.fsencode(directory.resolve())).hexdigest()[:16]
    return Path("/dev/shm") / f"rtcp-{os.geteuid()}-{digest}"
