"""The file of the virtual segment (`config/segment.yaml`): its slaves in the order of the cable, and their options."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, MaxLen, MinLen

from rtcp.config.document import Finding, read, shown
from rtcp.config.model import ConfigError
from rtcp.config.numbers import U16, U32, Name
from rtcp.config.validation import Checker, rule

_File = Annotated[str, MinLen(1), MaxLen(1024)]


@dataclass(frozen=True)
class NumberAsText:
    """Marks a text that may also be written as a whole number: in a type's `Annotated`, before its bounds."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return pydantic's schema: only a process that validates gets here, and has loaded pydantic."""
        from pydantic_core import core_schema

        def as_text(found: object) -> object:
            return str(found) if type(found) is int else found

        return core_schema.no_info_before_validator_function(as_text, handler(source))


@dataclass(frozen=True)
class SegmentSlave:
    """A virtual slave: of a model, or of a description. What models and behaviours there are is `rtcp.virtual`'s."""

    model: Name | None = None
    """Model of the slave; `rtcp segment` lists those that exist. One of `model`, `esi` and `sii` is given."""
    esi: _File | None = None
    """ESI file that describes the slave, relative to this file."""
    sii: _File | None = None
    """SII image (content of an EEPROM) that describes the slave, relative to this file."""
    product: U32 | None = None
    """Product code of the device in the ESI file; left out: the only one."""
    revision: U32 | None = None
    """Revision number of the device in the ESI file; left out: the one that no other replaces."""
    modules: tuple[U32 | None, ...] = ()
    """Ident of the module at each place of the device, from place 0 on; null leaves a place empty."""
    behaviour: Annotated[str, MinLen(1), MaxLen(256)] | None = None
    """What a described slave does: `cia402`, or `module:Class` of a module beside this file or installed; left out: it
    answers by its dictionary."""
    name: Name | None = None
    """Name of the slave, for `after`."""
    after: Annotated[str, NumberAsText(), MinLen(1), MaxLen(64)] | None = None
    """Slave behind which it hangs, by name or position from 1; left out: the one before it."""
    port: Literal[1, 2, 3] | None = None
    """Port of that slave; left out: 1, where it has none the lowest. Frames go to port 3 first, then 1, then 2: the
    list has this order."""
    drift_ppm: Annotated[float, Ge(-1000), Le(1000)] = 0.0
    """How much faster than the host its own clock runs, parts per million."""
    delay_ns: Annotated[int, Ge(0), Le(1_000_000)] | None = None
    """Propagation delay from the master, ns, along the frame's way; None: as on the real arm."""
    alias: U16 = 0
    """Station alias; 0: none."""
    options: dict[str, object] = field(default_factory=dict)
    """Texts, numbers and booleans by name."""

    @property
    def label(self) -> str:
        """What people call the slave: its name, model or file."""
        return self.name or self.model or self.esi or self.sii or ""


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
    given = [key for key in ("model", "esi", "sii") if getattr(slave, key) is not None]
    if len(given) != 1:
        yield (), f"found {' and '.join(given) or 'none of them'}, allowed is one of model, esi and sii"
    elif given != ["esi"]:
        for key in ("product", "revision"):
            if getattr(slave, key) is not None:
                yield (key,), "only a slave of an ESI file has this key"
        if slave.modules:
            yield ("modules",), "only a slave of an ESI file has this key"
    if given == ["model"] and slave.behaviour is not None:
        yield ("behaviour",), "a model has its own behaviour; only a slave of esi or sii has this key"
    for name, value in slave.options.items():
        if not isinstance(value, str) and not (isinstance(value, int | float) and isfinite(value)):
            yield ("options", name), f"found {shown(value)}, allowed is a text, a number, true or false"


def place_of(after: str, slaves: Sequence[SegmentSlave]) -> int | None:
    """Return the place, from 0, of the slave that `after` names or whose position it is; None: there is none."""
    if after.isdecimal():
        return int(after) - 1 if 1 <= int(after) <= len(slaves) else None
    return next((i for i, slave in enumerate(slaves) if slave.name == after), None)


@rule(SegmentFile, "slaves")
def _aliases(segment: SegmentFile) -> Iterator[Finding]:
    first: dict[int, int] = {}
    for i, slave in enumerate(segment.slaves):
        if slave.alias and first.setdefault(slave.alias, i) != i:
            text = f"found {slave.alias}, the alias of slaves[{first[slave.alias]}]; each needs its own, or 0 for none"
            yield ("slaves", i, "alias"), text


@rule(SegmentFile, "slaves")
def _names(segment: SegmentFile) -> Iterator[Finding]:
    first: dict[str, int] = {}
    for i, slave in enumerate(segment.slaves):
        if slave.name is not None and first.setdefault(slave.name, i) != i:
            text = f"found {shown(slave.name)}, the name of slaves[{first[slave.name]}]; each needs its own"
            yield ("slaves", i, "name"), text
        if slave.name is not None and slave.name.isdecimal():
            yield ("slaves", i, "name"), f"found {shown(slave.name)}, allowed is a text that is no number"
        if slave.after is not None and place_of(slave.after, segment.slaves[:i]) is None:
            earlier = [other.name for other in segment.slaves[:i] if other.name]
            names = f", or a name of these: {', '.join(earlier)}" if earlier else ""
            what = f"the position of a slave before it, 1 to {i}{names}" if i else "nothing: it is the first slave"
            yield ("slaves", i, "after"), f"found {slave.after}, allowed is {what}"


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
