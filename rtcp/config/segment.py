"""The file of the virtual segment (`config/segment.yaml`): its slaves in the order of the cable, and their options."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, MaxLen, MinLen

from rtcp.config.document import read
from rtcp.config.findings import Finding
from rtcp.config.model import ConfigError
from rtcp.config.numbers import U16, U32, Name
from rtcp.config.validation import Checker, repeated, rule

_File = Annotated[str, MinLen(1), MaxLen(1024)]


@dataclass(frozen=True)
class NumberAsText:
    """Marks a text that may also be written as a whole number: in a type's `Annotated`, before its bounds."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return pydantic's schema: called only by processes that validate and have loaded pydantic."""
        from pydantic_core import core_schema

        def as_text(value: object) -> object:
            return str(value) if type(value) is int else value

        return core_schema.no_info_before_validator_function(as_text, handler(source))


@dataclass(frozen=True)
class SegmentSlave:
    """A virtual slave: of a model, or of a description. `rtcp.virtual` defines the models and behaviours."""

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
    choice: Annotated[int, Ge(1)] | None = None
    """Which of several devices of this product code and revision, in the order of the ESI file, from 1."""
    modules: tuple[U32 | None, ...] = ()
    """Ident of the module at each place of the device, from place 0 on; null leaves a place empty."""
    behaviour: Annotated[str, MinLen(1), MaxLen(256)] | None = None
    """Behaviour of a described slave: `cia402`, or `module:Class` of a module beside this file or installed; left out:
    it answers by its dictionary."""
    name: Name | None = None
    """Name of the slave, for `after`."""
    after: Annotated[str, NumberAsText(), MinLen(1), MaxLen(64)] | None = None
    """Slave that it is connected to, by name or position from 1; left out: the one before it."""
    port: Literal[1, 2, 3] | None = None
    """Port of that slave; left out: 1, where it has none the lowest. Frames go to port 3 first, then 1, then 2: the
    list has this order."""
    drift_ppm: Annotated[float, Ge(-1000), Le(1000)] = 0.0
    """How much faster than the host its own clock runs, parts per million."""
    clock_bits: Literal[0, 32, 64] = 64
    """Size of its clock; one of 32 bits starts again at 0 every 4.29 s. 0: it measures delays, but has no system time
    that can be set (registers 0x0910 to 0x097F)."""
    delay_ns: Annotated[int, Ge(0), Le(1_000_000)] | None = None
    """Propagation delay from the master, ns, along the frame's path; None: as on the real arm."""
    alias: U16 = 0
    """Station alias; 0: none."""
    options: dict[str, object] = field(default_factory=dict)
    """Texts, numbers and booleans by name."""

    @property
    def label(self) -> str:
        """Name of the slave in messages: its name, model or file."""
        return self.name or self.model or self.esi or self.sii or ""


@dataclass(frozen=True)
class SegmentConfig:
    """The virtual slaves in the order of the cable, their file, and that of the arm that they move."""

    slaves: tuple[SegmentSlave, ...]
    source: Path
    arm: Path | None = None


@dataclass(frozen=True)
class SegmentFile:
    """The file of a segment."""

    slaves: Annotated[tuple[SegmentSlave, ...], MinLen(1)]
    """The slaves in the order of the cable."""
    arm: Name | None = None
    """File of the arm, beside this one, that the first six drives move: its `kinematics` give the weights of the links
    and the effect of a push at the tool; left out: each drive has its own load alone."""


@rule(SegmentSlave)
def _options(slave: SegmentSlave) -> Iterator[Finding]:
    sources = [key for key in ("model", "esi", "sii") if getattr(slave, key) is not None]
    if len(sources) != 1:
        keys = " and ".join(sources) or "none of them"
        yield Finding((), "one_of_keys", found=keys, allowed="model, esi and sii")
    elif sources != ["esi"]:
        for key in ("product", "revision", "choice", "modules"):
            if getattr(slave, key) not in (None, ()):
                yield Finding((key,), "key_of_esi")
    if sources == ["model"] and slave.behaviour is not None:
        yield Finding(("behaviour",), "behaviour_of_model")
    for name, value in slave.options.items():
        if not isinstance(value, str) and not (isinstance(value, int | float) and isfinite(value)):
            yield Finding(("options", name), "type", found=value, allowed="a text, a number, true or false")


def place_of(after: str, slaves: Sequence[SegmentSlave]) -> int | None:
    """Return the place, from 0, of the slave with the name or position `after`; None: there is none."""
    if after.isdecimal():
        return int(after) - 1 if 1 <= int(after) <= len(slaves) else None
    return next((i for i, slave in enumerate(slaves) if slave.name == after), None)


@rule(SegmentFile, "slaves")
def _aliases(segment: SegmentFile) -> Iterator[Finding]:
    aliases = ((("slaves", i, "alias"), slave.alias) for i, slave in enumerate(segment.slaves) if slave.alias)
    return repeated(aliases, "alias")


@rule(SegmentFile, "slaves")
def _names(segment: SegmentFile) -> Iterator[Finding]:
    named = ((("slaves", i, "name"), slave.name) for i, slave in enumerate(segment.slaves) if slave.name is not None)
    yield from repeated(named, "name")
    for i, slave in enumerate(segment.slaves):
        if slave.name is not None and slave.name.isdecimal():
            yield Finding(("slaves", i, "name"), "number", found=slave.name, allowed="a text that is no number")
        if slave.after is not None and place_of(slave.after, segment.slaves[:i]) is None:
            earlier = [before.name for before in segment.slaves[:i] if before.name]
            names = f", or a name of these: {', '.join(earlier)}" if earlier else ""
            allowed = f"the position of a slave before it, 1 to {i}{names}" if i else "nothing: it is the first slave"
            yield Finding(("slaves", i, "after"), "no_slave_before", found=slave.after, allowed=allowed)


_SEGMENT = Checker(SegmentFile)


def load_segment(path: Path) -> SegmentConfig:
    """Read the file of a virtual segment.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    document = read(path)
    file = _SEGMENT.read(document)
    arm = None if file.arm is None else path.parent / file.arm
    if arm is not None and not arm.is_file():
        raise ConfigError(document.placed([Finding(("arm",), "names_no_file", found=file.arm, file=arm)]))
    return SegmentConfig(file.slaves, path, arm)
