"""What one question asked of the host ends in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from rtcp.realtime.doctor.case import Case


class Severity(IntEnum):
    """How much it stands in the way; the larger number is the worse."""

    OK = 0
    NOTE = 1
    """Worth knowing, not known, or not asked of this host."""
    WARNING = 2
    """Cycles come late at times."""
    BAD = 3
    """The loop cannot keep its cycle, or not run at all."""


@dataclass(frozen=True)
class Verdict:
    """What a check found; `mend` is lines for a root shell, in their order, where something is to be mended."""

    severity: Severity
    found: str
    mend: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """A verdict with the name of its check and why that matters to the cycle."""

    key: str
    severity: Severity
    found: str
    why: str
    mend: tuple[str, ...]


@dataclass(frozen=True)
class Check:
    """One question; `look` returns None where it makes no sense on this host, and raises `NotKnown` for no answer."""

    key: str
    why: str
    look: Callable[[Case], Verdict | None]


def ok(found: str) -> Verdict:
    """Return that nothing is to be mended."""
    return Verdict(Severity.OK, found)


def note(found: str, *mend: str) -> Verdict:
    """Return what is worth knowing."""
    return Verdict(Severity.NOTE, found, mend)


def warning(found: str, *mend: str) -> Verdict:
    """Return what makes cycles late at times."""
    return Verdict(Severity.WARNING, found, mend)


def bad(found: str, *mend: str) -> Verdict:
    """Return what keeps the loop from its cycle."""
    return Verdict(Severity.BAD, found, mend)
