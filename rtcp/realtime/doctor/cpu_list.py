"""The kernel's lists of CPUs, as "0-2,5" (Documentation/admin-guide/kernel-parameters.rst, "cpu lists")."""

from __future__ import annotations

import re
from collections.abc import Iterable


def parse_cpus(text: str) -> frozenset[int]:
    """Return the CPUs of a list; an empty one and "(null)" are none.

    Raises:
        ValueError: it is no such list.
    """
    found: set[int] = set()
    if text in ("", "(null)"):
        return frozenset()
    for part in text.split(","):
        ends = re.fullmatch(r"([0-9]{1,4})(?:-([0-9]{1,4}))?", part)
        if ends is None:
            raise ValueError(f"{text[:40]!r} is no list of CPUs")
        found.update(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    return frozenset(found)


def format_cpus(cpus: Iterable[int]) -> str:
    """Return the list as the kernel writes it."""
    ordered = sorted(set(cpus))
    starts = [cpu for cpu in ordered if cpu - 1 not in ordered]
    ends = [cpu for cpu in ordered if cpu + 1 not in ordered]
    return ",".join(
        str(first) if first == last else f"{first}-{last}" for first, last in zip(starts, ends, strict=True)
    )


def named(cpus: Iterable[int]) -> str:
    """Return the CPUs in words: "no CPU", "CPU 3", "CPUs 0-2"."""
    ordered = sorted(set(cpus))
    if not ordered:
        return "no CPU"
    return f"CPU {ordered[0]}" if len(ordered) == 1 else f"CPUs {format_cpus(ordered)}"
