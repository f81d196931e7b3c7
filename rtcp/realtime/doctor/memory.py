"""Memory: what may be taken away or moved under the loop."""

from __future__ import annotations

import re

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.finding import Check, Verdict, note, ok
from rtcp.realtime.doctor.host import NotKnown
from rtcp.realtime.doctor.mending import at_boot

_HUGE = "/sys/kernel/mm/transparent_hugepage/enabled"


def swap(case: Case) -> Verdict:
    """Ask whether memory can be swapped out."""
    lines = case.host.word("/proc/swaps").splitlines()[1:]
    areas = [line.split()[0] for line in lines if line.strip()]
    if not areas:
        return ok("no swap is in use")
    return note(
        f"swap is on ({', '.join(areas)}): locked memory stays, but the gateway and other programs may be slow",
        "swapoff -a",
        "sed -i '/\\sswap\\s/s/^[^#]/#&/' /etc/fstab   # kept after a restart",
    )


def huge_pages(case: Case) -> Verdict | None:
    """Ask whether the kernel merges pages behind a program's back."""
    if not case.host.exists(_HUGE):
        return None
    text = case.host.text(_HUGE)
    chosen = re.search(r"\[(\w+)\]", text)
    if chosen is None:
        raise NotKnown(f"{_HUGE} holds {text[:40]!r}, no choice in brackets")
    if chosen[1] != "always":
        return ok(f"transparent huge pages: {chosen[1]}")
    return note(
        "transparent huge pages: always",
        f"echo madvise > {_HUGE}",
        at_boot(_HUGE, "madvise"),
    )


CHECKS = (
    Check("swap", "what was swapped out comes back from a disk, milliseconds later", swap),
    Check(
        "huge-pages",
        "the kernel stops a program while it copies its pages together into large ones",
        huge_pages,
    ),
)
