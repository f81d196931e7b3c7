"""The host's own account of itself: the files under /proc, /sys, /dev, /etc and /run, below one root."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rtcp.realtime.doctor.cpu_list import parse_cpus

_LARGEST, _PIECE = 4 << 20, 64 << 10
"""What is read of a file, and at once: the kernel refuses to print a setting of /proc/sys into a large buffer."""


class NotKnown(Exception):
    """The host does not say; the text names the file and the reason."""


@dataclass(frozen=True)
class Host:
    """Reads a host's files; every path is given as on the host and looked up below `root`.

    Every method but `exists` and `names` raises `NotKnown` where a file is missing, unreadable or malformed.
    """

    root: Path = Path("/")
    wait: Callable[[float], None] = time.sleep
    """Lets seconds pass between two readings of a counter."""

    def text(self, path: str) -> str:
        """Return a file's text without the white space around it."""
        try:
            # Not blocking: what should be a file may be a pipe that nobody writes to.
            descriptor = os.open(self._at(path), os.O_RDONLY | os.O_NONBLOCK)
            try:
                return _all_of(descriptor).decode(errors="replace").strip()
            finally:
                os.close(descriptor)
        except OSError as error:
            raise NotKnown(f"{path}: {error.strerror or error}") from error

    def word(self, path: str) -> str:
        """Return the text of a file that holds something."""
        text = self.text(path)
        if not text:
            raise NotKnown(f"{path} is empty")
        return text

    def integer(self, path: str) -> int:
        """Return the decimal number that is all of a file."""
        return whole(self.text(path), path)

    def cpus(self, path: str) -> frozenset[int]:
        """Return the CPUs of a kernel's list, as "0-2,5"; "(null)" is none."""
        text = self.text(path)
        try:
            return parse_cpus(text)
        except ValueError as error:
            raise NotKnown(f"{path}: {error}") from error

    def exists(self, path: str) -> bool:
        """Return whether there is such a file or folder."""
        return os.path.exists(self._at(path))

    def names(self, path: str) -> list[str]:
        """Return the names in a folder, sorted; none where there is no such folder."""
        try:
            return sorted(os.listdir(self._at(path)))
        except OSError:
            return []

    def target(self, path: str) -> str:
        """Return the last part of what a symbolic link leads to."""
        try:
            return os.path.basename(os.readlink(self._at(path)))
        except OSError as error:
            raise NotKnown(f"{path}: {error.strerror or error}") from error

    def may_write(self, path: str) -> None:
        """Return where a file can be opened for writing; nothing is written."""
        try:
            os.close(os.open(self._at(path), os.O_WRONLY | os.O_NONBLOCK))
        except OSError as error:
            raise NotKnown(f"{path}: {error.strerror or error}") from error

    def fields(self, path: str) -> dict[str, str]:
        """Return the "name: value" lines of a file, as of /proc/self/status."""
        pairs = (line.split(":", 1) for line in self.text(path).splitlines() if ":" in line)
        return {name.strip(): value.strip() for name, value in pairs}

    def processes(self) -> dict[str, list[int]]:
        """Return the numbers of the processes by their name, of at most 15 letters."""
        found: dict[str, list[int]] = {}
        for name in self.names("/proc"):
            if not name.isdecimal():
                continue
            try:
                found.setdefault(self.text(f"/proc/{name}/comm"), []).append(int(name))
            except NotKnown:
                continue  # it has ended meanwhile
        return found

    def _at(self, path: str) -> str:
        return os.path.join(self.root, path.lstrip("/"))


def _all_of(descriptor: int) -> bytes:
    pieces = bytearray()
    while len(pieces) < _LARGEST and (piece := os.read(descriptor, _PIECE)):
        pieces += piece
    return bytes(pieces)


def whole(text: str, where: str) -> int:
    """Return a decimal number, or raise `NotKnown` with where it was to stand."""
    try:
        return int(text)
    except ValueError as error:
        shown = text if len(text) <= 40 else f"{text[:40]}..."
        raise NotKnown(f"{where} holds {shown!r}, not a number") from error
