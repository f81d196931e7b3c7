"""The file of the virtual segment (`config/segment.yaml`): its slaves in the order of the cable, and their options."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le, MinLen

from rtcp.config.document import Finding, read, shown
from rtcp.config.model import ConfigError
from rtcp.config.numbers import U16, Name
from rtcp.config.validation import Checker, rule


@dataclass(frozen=True)
class SegmentSlave:
    """A virtual slave. Which models there are and which options they take is known to `rtcp.virtual.models` alone."""

    model: Name
    """Model of the slave; `rtcp segment` lists those that exist."""
    drift_ppm: Annotated[float, Ge(-1000), Le(1000)] = 0.0
    """How much faster than the host its own clock runs, parts per million."""
    delay_ns: Annotated[int, Ge(0), Le(1_000_000)] | None = None
    """Propagation delay from the master, ns; None: as on the real arm."""
    alias: U16 = 0
    """Station alias; 0: none."""
    options: dict[str, object] = field(default_factory=dict)
    """Texts, numbers and booleans by name."""


@dataclass(frozen=True)
class SegmentConfig:
    """The virtual slaves in the order of the cable, the file that lists them, and that of the arm that they turn."""

    slaves: tuple[SegmentSlave, ...]
    source: Path
    arm: Path | None = None


@dataclass(frozen=True)
class SegmentFile:
    """The file of a segment."""

    slaves: Annotated[tuple[SegmentSlave, ...], MinLen(1)]
    """The slaves in the order of the cable."""
    arm: Name | None = None
    """File of the arm, beside this one, that the first six drives turn: its `kinematics` give the weights of the links
    and what a push at the tool does; left out: each drive has its own load alone."""


@rule(SegmentSlave)
def _options(slave: SegmentSlave) -> Iterator[Finding]:
    for name, value in slave.options.items():
        if not isinstance(value, str) and not (isinstance(value, int | float) and isfinite(value)):
            yield ("options", name), f"found {shown(value)}, allowed is a text, a number, true or false"


@rule(SegmentFile, "slaves")
def _aliases(segment: SegmentFile) -> Iterator[Finding]:
    first: dict[int, int] = {}
    for i, slave in enumerate(segment.slaves):
        if slave.alias and first.setdefault(slave.alias, i) != i:
            text = f"found {slave.alias}, the alias of slaves[{first[slave.alias]}]; each needs its own, or 0 for none"
            yield ("slaves", i, "alias"), text


_SEGMENT = Checker(SegmentFile)


def load_segment(path: Path) -> SegmentConfig:
    """Read the file of a virtual segment.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    document = read(path)
    found = _SEGMENT.read(document)
    arm = None if found.arm is None else path.parent / found.arm
    if arm is not None and not arm.is_file():
        raise ConfigError(document.sentences([(("arm",), f"found {shown(found.arm)}, but there is no file {arm}")]))
    return SegmentConfig(found.slaves, path, arm)
