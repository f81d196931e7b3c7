"""The process table of the tests: which processes a test started and did not end."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import uuid
from pathlib import Path

import psutil

_MARK = ("RTCP_TESTS", str(uuid.uuid4()))
"""Environment variable of every process that the tests of this worker start."""
_SERVICES = ("multiprocessing.resource_tracker", "multiprocessing.forkserver", "tests.host")
"""Processes that serve the tests of a whole session."""


class FoundAtTheEnd(AssertionError):
    """What only the end of the session shows fails the run: a second try of the last test would show nothing."""


class Leftovers:
    """Finds processes that outlive the test that started them.

    The processes of a platform do not belong to the process tree of the tests, so they are found by the environment.
    """

    def __init__(self) -> None:
        os.environ.update([_MARK])
        self.shared: set[str] = set()
        """Runtime directories of platforms that several tests share: their processes may outlive a test."""
        self.services = set(_SERVICES)
        """Parts of the command lines of processes that serve several tests."""

    def running(self) -> set[int]:
        """Return the ids of all processes."""
        return _running()

    def end_new(self, before: set[int]) -> list[str]:
        """Kill the processes that were started since `before` and still run; return their command lines.

        A process whose parent is in `before`, or that belongs to a shared platform, is not one of them.
        """
        return [self._end(pid) for pid in self.running() - before if self._is_left(pid, before)]

    def end_all(self) -> list[str]:
        """As `end_new`, for all processes that tests of this worker started."""
        self.shared.clear()
        return self.end_new(set())

    def _is_left(self, pid: int, before: set[int]) -> bool:
        try:
            process = psutil.Process(pid)
            environment = _environment(pid)
            if environment.get(_MARK[0]) != _MARK[1] or process.status() == psutil.STATUS_ZOMBIE:
                return False
            if environment.get("RTCP_RUNTIME_DIR", "") in self.shared:
                return False
            command = " ".join(process.cmdline())
            parents = [parent.pid for parent in process.parents()]
            if os.getpid() in parents:
                parents = parents[: parents.index(os.getpid())]
            return not before.intersection(parents) - {1} and not any(service in command for service in self.services)
        except (psutil.Error, OSError):
            return False  # it has ended

    def _end(self, pid: int) -> str:
        try:
            process = psutil.Process(pid)
            command = " ".join(process.cmdline())
            process.kill()
        except psutil.Error:
            command = "ended by itself a moment later"
        return f"{pid}: {command}"


def mark() -> str:
    """Return what `end_marked` knows the processes of this worker by."""
    return _MARK[1]


def end_marked(mark: str) -> None:
    """Kill all processes that a worker has started, but this one; remove the files of its platforms."""
    from rtcp.ipc.runtime_directory import blackboard_file

    directories: set[Path] = set()
    for pid in _running() - {os.getpid()}:
        with contextlib.suppress(OSError):
            environment = _environment(pid)
            if environment.get(_MARK[0]) == mark:
                os.kill(pid, signal.SIGKILL)
                directories.add(Path(environment.get("RTCP_RUNTIME_DIR", "/nowhere")))
    for directory in directories:
        blackboard_file(directory).unlink(missing_ok=True)
        for made in (directory, directory.parent):
            if made.name.startswith("rtcp-e2e-"):
                shutil.rmtree(made, ignore_errors=True)


def _running() -> set[int]:
    return {int(name) for name in os.listdir("/proc") if name.isdigit()}


def _environment(pid: int) -> dict[str, str]:
    entries = Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
    return dict(entry.split("=", 1) for entry in entries if "=" in entry)
