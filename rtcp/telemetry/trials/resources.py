"""What a process holds: memory, threads, open files; and whether that grew."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

GROWTH = 2 << 20
"""Bytes that a process may hold more after the first minute: the allocator's noise, and no leak."""
_BREATHES = frozenset({"gateway"})
"""Serves connections and writes files on threads of its own: how many there are says nothing about a leak."""
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Resources:
    """At one moment."""

    rss: int
    """Resident memory, bytes."""
    threads: int
    files: int


def resources(pid: int) -> Resources | None:
    """Return what a process holds now, None where it is gone or another user's."""
    process = Path("/proc") / str(pid)
    try:
        pages = int((process / "statm").read_text().split()[1])
        return Resources(pages * _PAGE, len(list((process / "task").iterdir())), len(list((process / "fd").iterdir())))
    except (OSError, ValueError, IndexError):
        return None


def grown(first: Mapping[str, Resources], last: Mapping[str, Resources], *, settled: bool) -> list[str]:
    """Return a sentence for everything that a process holds more of than before, and for each that has ended.

    Args:
        first: what each process held, by its name.
        last: what each holds now; one that is missing has ended.
        settled: `first` is from after the first minute: by then all that a process keeps has been allocated.
    """
    found = []
    for name, before in first.items():
        now = last.get(name)
        if now is None:
            found.append(f"the {name} has ended")
            continue
        fixed = name not in _BREATHES
        if fixed and now.threads > before.threads:
            found.append(f"the {name} has {now.threads} threads, {before.threads} before")
        if fixed and now.files > before.files:
            found.append(f"the {name} has {now.files} open files, {before.files} before")
        if settled and now.rss - before.rss > GROWTH:
            found.append(f"the {name} holds {now.rss / 2**20:.1f} MiB, {before.rss / 2**20:.1f} after the first minute")
    return found
