"""What the processes of one running platform know of each other: two small files in the runtime directory."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from rtcp.config.model import ArmConfig
from rtcp.runtime.paths import processes_file


@dataclass
class Processes:
    """Process ids; 0: there is none."""

    loop: int = 0
    gateway: int = 0
    segment: int = 0

    def write(self, directory: Path) -> None:
        """Write `processes.json`, whole or not at all."""
        path = processes_file(directory)
        fresh = path.with_suffix(".new")
        fresh.write_text(json.dumps(asdict(self)))
        fresh.replace(path)


def read_processes(directory: Path) -> Processes:
    """Return the processes that the file names; none where it is absent or damaged."""
    try:
        found = json.loads(processes_file(directory).read_text())
        return Processes(int(found["loop"]), int(found["gateway"]), int(found["segment"]))
    except (OSError, ValueError, KeyError, TypeError):
        return Processes()


def is_ours(pid: int) -> bool:
    """Whether the process lives (a zombie does not) and is one of this platform's, not a later bearer of its number."""
    if pid <= 0:
        return False
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
    except (OSError, IndexError):
        return False
    return state not in "ZX" and b"rtcp." in command


def end(pid: int, patience_s: float) -> bool:
    """End a process of ours by SIGTERM, after `patience_s` by SIGKILL; return whether it ended itself."""
    if not is_ours(pid):
        return True
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGTERM)
    if wait_gone(pid, patience_s):
        return True
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    wait_gone(pid, 2.0)
    return False


def wait_gone(pid: int, patience_s: float) -> bool:
    """Wait until the process is gone; return whether it is."""
    until = time.monotonic() + patience_s
    while is_ours(pid):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


@dataclass(frozen=True)
class Session:
    """What the launcher hands to the loop and the gateway, through a file that only their user can write."""

    config: ArmConfig
    bus: str
    interface: str
    segment_pid: int
    began_ns: int
    """When the start was asked for, CLOCK_MONOTONIC."""

    def write(self, path: Path) -> None:
        """Write the file."""
        path.write_bytes(pickle.dumps(self))


def read_session(path: Path) -> Session:
    """Read what `Session.write` wrote."""
    found = pickle.loads(path.read_bytes())
    if not isinstance(found, Session):
        raise TypeError(f"{path} holds no session")
    return found
