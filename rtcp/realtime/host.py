"""Facts about a Linux host: the files under /proc, /sys, /dev, /etc and /run, and its network drivers."""

from __future__ import annotations

import array
import errno
import fcntl
import os
import re
import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_LARGEST, _PIECE = 4 << 20, 64 << 10
"""Bytes read of a file, and at once: the kernel refuses to print a setting of /proc/sys into a large buffer."""
_SIOCETHTOOL = 0x8946
_ETHTOOL_GCOALESCE = 0x0E
_COALESCE_WORDS = 23
"""`struct ethtool_coalesce` of linux/ethtool.h: the command and 22 settings, 32 bits each."""
_ETHTOOL_REQUEST = struct.Struct("16sP16x")


class NotKnown(Exception):
    """A fact that the host does not report; the text names the file and the reason."""


@dataclass(frozen=True)
class Coalescing:
    """How long a network card waits for further frames before it reports one, us."""

    receive_us: int
    send_us: int
    adaptive: bool
    """The driver changes the times with the traffic."""


@dataclass(frozen=True)
class Host:
    """Reads a host's files; every path is given as on the host and looked up below `root`.

    Every method but `exists`, `names` and `text_or` raises `NotKnown` where the host does not report the fact.
    """

    root: Path = Path("/")
    wait: Callable[[float], None] = time.sleep
    """Called with seconds between two readings of a counter."""

    def text(self, path: str) -> str:
        """Return a file's text without the white space around it."""
        with _not_known(path):
            # Not blocking: the path may be a pipe that nobody writes to.
            descriptor = os.open(self._at(path), os.O_RDONLY | os.O_NONBLOCK)
            try:
                pieces = bytearray()
                while len(pieces) < _LARGEST and (piece := os.read(descriptor, _PIECE)):
                    pieces += piece
                return pieces.decode(errors="replace").strip()
            finally:
                os.close(descriptor)

    def text_or(self, path: str, default: str) -> str:
        """Return a file's text, or `default` where it cannot be read."""
        try:
            return self.text(path)
        except NotKnown:
            return default

    def word(self, path: str) -> str:
        """Return the text of a file that must not be empty."""
        text = self.text(path)
        if not text:
            raise NotKnown(f"{path} is empty")
        return text

    def integer(self, path: str) -> int:
        """Return the decimal number that is all of a file."""
        return whole(self.text(path), path)

    def cpus(self, path: str) -> frozenset[int]:
        """Return the CPUs of a kernel's list, as "0-2,5"; "(null)" is none."""
        try:
            return parse_cpus(self.text(path))
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
        """Return the last part of a symbolic link's target."""
        with _not_known(path):
            return os.path.basename(os.readlink(self._at(path)))

    def check_writable(self, path: str) -> None:
        """Open a file for writing and close it; nothing is written."""
        with _not_known(path):
            os.close(os.open(self._at(path), os.O_WRONLY | os.O_NONBLOCK))

    def fields(self, path: str) -> dict[str, str]:
        """Return the "name: value" lines of a file, as of /proc/self/status."""
        pairs = (line.split(":", 1) for line in self.text(path).splitlines() if ":" in line)
        return {name.strip(): value.strip() for name, value in pairs}

    def processes(self) -> dict[str, list[int]]:
        """Return the process ids by process name (at most 15 characters)."""
        pids: dict[str, list[int]] = {}
        for name in filter(str.isdecimal, self.names("/proc")):
            if comm := self.text_or(f"/proc/{name}/comm", ""):  # empty: it has ended meanwhile
                pids.setdefault(comm, []).append(int(name))
        return pids

    def coalescing(self, interface: str) -> Coalescing | None:
        """Return the coalescing of a network card, None where its driver has none; asks the running kernel."""
        words = array.array("I", [_ETHTOOL_GCOALESCE] + [0] * (_COALESCE_WORDS - 1))
        request = bytearray(_ETHTOOL_REQUEST.pack(interface.encode(), words.buffer_info()[0]))
        with _not_known(f"ethtool -c {interface}"), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            try:
                fcntl.ioctl(asking, _SIOCETHTOOL, request, True)
            except OSError as error:
                if error.errno == errno.EOPNOTSUPP:
                    return None
                raise
        return Coalescing(words[1], words[5], bool(words[10] or words[11]))

    def ipv4_address(self, interface: str) -> str | None:
        """Return an interface's IPv4 address, None where it has none; asks the running kernel."""
        import psutil  # here: it loads slowly

        with _not_known(f"the address of {interface}"):
            addresses = psutil.net_if_addrs().get(interface, [])
        return next((address.address for address in addresses if address.family == socket.AF_INET), None)

    def _at(self, path: str) -> str:
        return os.path.join(self.root, path.lstrip("/"))


@contextmanager
def _not_known(subject: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise NotKnown(f"{subject}: {os.strerror(error.errno) if error.errno else error}") from error


def whole(text: str, where: str, base: int = 10) -> int:
    """Return a whole number, or raise `NotKnown` with the place where it was expected."""
    try:
        return int(text, base)
    except ValueError as error:
        excerpt = text if len(text) <= 40 else f"{text[:40]}..."
        raise NotKnown(f"{where} holds {excerpt!r}, not a number") from error


# -- lists of CPUs (Documentation/admin-guide/kernel-parameters.rst, "cpu lists") -------------------------------


def parse_cpus(text: str) -> frozenset[int]:
    """Return the CPUs of a list as "0-2,5"; an empty one and "(null)" are none.

    Raises:
        ValueError: it is no such list.
    """
    cpus: set[int] = set()
    if text in ("", "(null)"):
        return frozenset()
    for part in text.split(","):
        ends = re.fullmatch(r"([0-9]{1,4})(?:-([0-9]{1,4}))?", part)
        if ends is None:
            raise ValueError(f"{text[:40]!r} is no list of CPUs")
        cpus.update(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    return frozenset(cpus)


def format_cpus(cpus: Iterable[int]) -> str:
    """Return the list as the kernel writes it."""
    ordered = sorted(set(cpus))
    starts = [cpu for cpu in ordered if cpu - 1 not in ordered]
    ends = [cpu for cpu in ordered if cpu + 1 not in ordered]
    return ",".join(
        str(first) if first == last else f"{first}-{last}" for first, last in zip(starts, ends, strict=True)
    )


def name_cpus(cpus: Iterable[int]) -> str:
    """Return the CPUs in words: "no CPU", "CPU 3", "CPUs 0-2"."""
    ordered = sorted(set(cpus))
    if not ordered:
        return "no CPU"
    return f"CPU {ordered[0]}" if len(ordered) == 1 else f"CPUs {format_cpus(ordered)}"
