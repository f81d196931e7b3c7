"""What can go wrong on the virtual segment: one dataclass a fault, and the form in which commands and scripts name it.

A fault is a mapping: `fault` names it, `lasts` says for how many seconds (left out: until it is mended), the other
keys are the fault's own. `{fault: cable, after: 3, lasts: 1.5}` breaks the cable between slaves 3 and 4 for 1.5 s. In a
script (`faults:`, a list) each has `at` as well, seconds from the segment's start.

As `model`, this module imports nothing heavy. Positions count from 1, as on the cable; 0 is the master.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le

from rtcp.config.checking import Checker, shown, unknown_key
from rtcp.config.document import Finding, read
from rtcp.config.errors import ConfigError

Position = Annotated[int, Ge(1), Le(255)]
Cable = Annotated[int, Ge(0), Le(254)]
"""The cable behind this slave; 0: between the master and slave 1."""
Rate = Annotated[float, Gt(0), Le(1)]
Burst = Annotated[int, Ge(1), Le(100_000)]
Seed = Annotated[int, Ge(0), Le(0xFFFFFFFF)]
AlStateName = Literal["PRE-OP", "SAFE-OP", "OP"]
DriveError = Literal[
    "over-current", "over-voltage", "under-voltage", "over-temperature", "encoder", "over-speed", "following-error"
]
Protocol = Literal["arp", "ip", "lldp", "ethercat", "any"]
InputFault = Literal["high", "low", "bounce"]


@dataclass(frozen=True)
class CableFault:
    """The cable behind slave `after` is broken: frames turn round there, the slaves behind hear nothing."""

    name: ClassVar[str] = "cable"
    after: Cable


@dataclass(frozen=True)
class PowerFault:
    """A slave has no supply: no frame passes it. When it comes back its registers are those of power-on, in INIT."""

    name: ClassVar[str] = "power"
    slave: Position


@dataclass(frozen=True)
class AlRefuse:
    """A slave refuses to go to `state`, with AL status code `code`."""

    name: ClassVar[str] = "al_refuse"
    slave: Position
    state: AlStateName = "OP"
    code: Annotated[int, Ge(1), Le(0xFFFF)] = 0x0001


@dataclass(frozen=True)
class AlHang:
    """A slave hangs in its AL state: what is asked of it is neither done nor refused."""

    name: ClassVar[str] = "al_hang"
    slave: Position


@dataclass(frozen=True)
class AlFall:
    """A slave leaves OP by itself, once, to SAFE-OP or PRE-OP with the error flag and `code`."""

    name: ClassVar[str] = "al_fall"
    slave: Position
    state: Literal["PRE-OP", "SAFE-OP"] = "SAFE-OP"
    code: Annotated[int, Ge(1), Le(0xFFFF)] = 0x0001


@dataclass(frozen=True)
class SdoLate:
    """A slave answers each SDO `ms` later than it would."""

    name: ClassVar[str] = "sdo_late"
    slave: Position
    ms: Annotated[float, Gt(0), Le(60_000)]


@dataclass(frozen=True)
class SdoAbort:
    """A slave aborts each SDO service (of object `index` only, unless that is 0) with `code`."""

    name: ClassVar[str] = "sdo_abort"
    slave: Position
    code: Annotated[int, Ge(1), Le(0xFFFFFFFF)] = 0x08000020
    index: Annotated[int, Ge(0), Le(0xFFFF)] = 0


@dataclass(frozen=True)
class Loss:
    """Frames are lost: each with the probability `rate`, or the next `burst` of them and no more."""

    name: ClassVar[str] = "loss"
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Delay:
    """Answers come `ms` late."""

    name: ClassVar[str] = "delay"
    ms: Annotated[float, Gt(0), Le(1000)]
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Duplicate:
    """Answers come twice."""

    name: ClassVar[str] = "duplicate"
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Reorder:
    """An answer comes after the one that follows it."""

    name: ClassVar[str] = "reorder"
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Corrupt:
    """Frames are damaged on the cable behind slave `after`: their checksum is wrong from there on.

    The slaves before it have worked; the next one counts an error (0x0300), those behind it count a forwarded one
    (0x0308), and the master gets nothing.
    """

    name: ClassVar[str] = "corrupt"
    after: Cable
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class Garble:
    """`bits` bits of answers are turned over behind the last checksum: what no Ethernet card would notice."""

    name: ClassVar[str] = "garble"
    bits: Annotated[int, Ge(1), Le(1000)] = 1
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class WorkingCounter:
    """A slave takes part in process data but does not count itself in the working counter."""

    name: ClassVar[str] = "wkc"
    slave: Position
    rate: Rate | None = None
    burst: Burst | None = None
    seed: Seed = 0


@dataclass(frozen=True)
class DriveFault:
    """A drive meets an error, sends its emergency message and reacts as its fault reaction says.

    While the fault lasts a fault reset is refused; `lasts` left out: a single occurrence, which a reset clears.
    """

    name: ClassVar[str] = "drive"
    slave: Position
    error: DriveError


@dataclass(frozen=True)
class Sync0Lost:
    """A slave's SYNC0 stops."""

    name: ClassVar[str] = "sync0"
    slave: Position


@dataclass(frozen=True)
class ClockJump:
    """A slave's clock jumps by `us`, once."""

    name: ClassVar[str] = "clock_jump"
    slave: Position
    us: Annotated[float, Ge(-1_000_000), Le(1_000_000)]


@dataclass(frozen=True)
class ClockDrift:
    """A slave's own clock runs fast by `ppm` more than it did."""

    name: ClassVar[str] = "clock_drift"
    slave: Position
    ppm: Annotated[float, Ge(-1000), Le(1000)] = 200.0


@dataclass(frozen=True)
class TerminalFault:
    """An input terminal of the IO box is stuck `high` or `low`, or bounces with a half period of `ms`."""

    name: ClassVar[str] = "input"
    number: Annotated[int, Ge(1), Le(16)]
    how: InputFault
    ms: Annotated[float, Gt(0), Le(1000)] = 2.0


@dataclass(frozen=True)
class StickCode:
    """The joystick's six inputs show `value`, whatever the stick does; 63 is neutral, most values mean nothing."""

    name: ClassVar[str] = "stick_code"
    value: Annotated[int, Ge(0), Le(63)]


@dataclass(frozen=True)
class Noise:
    """Frames of other protocols, and malformed ones of EtherCAT's type, `rate_hz` of them a second."""

    name: ClassVar[str] = "noise"
    rate_hz: Annotated[float, Gt(0), Le(10_000)] = 100.0
    protocol: Protocol = "any"
    seed: Seed = 0


Fault = (
    CableFault | PowerFault | AlRefuse | AlHang | AlFall | SdoLate | SdoAbort | Loss | Delay | Duplicate | Reorder
    | Corrupt | Garble | WorkingCounter | DriveFault | Sync0Lost | ClockJump | ClockDrift | TerminalFault | StickCode
    | Noise
)  # fmt: skip
_KINDS: tuple[type[Fault], ...] = (
    CableFault, PowerFault, AlRefuse, AlHang, AlFall, SdoLate, SdoAbort, Loss, Delay, Duplicate, Reorder, Corrupt,
    Garble, WorkingCounter, DriveFault, Sync0Lost, ClockJump, ClockDrift, TerminalFault, StickCode, Noise,
)  # fmt: skip
FAULTS = MappingProxyType({kind.name: kind for kind in _KINDS})
"""Every kind of fault by the name that commands and scripts give it."""
ONCE = (AlFall, ClockJump)
"""Faults that happen and are over: they do not last and cannot be mended."""
_BY_RATE = (Loss, Delay, Duplicate, Reorder, Corrupt, Garble, WorkingCounter)
_LONGEST_S = 86_400.0


@dataclass(frozen=True)
class Planned:
    """A fault with its time: `at` seconds from the start of the script (0 for a command), and how long it `lasts`."""

    fault: Fault
    at: float = 0.0
    lasts: float | None = None
    """s; None: until it is mended (for a burst: until it has passed)."""

    def as_mapping(self) -> dict[str, Any]:
        """Return the form that commands and scripts give it; `parse` makes the same of it again."""
        own = {key: value for key, value in asdict(self.fault).items() if value is not None}
        found: dict[str, Any] = {"fault": self.fault.name, **own}
        if self.at:
            found["at"] = self.at
        if self.lasts is not None:
            found["lasts"] = self.lasts
        return found


def parse(mapping: object) -> tuple[Planned | None, list[Finding]]:
    """Make a fault of the mapping that names it; return None and every mistake, with its key, where it is wrong."""
    if not isinstance(mapping, dict):
        return None, [((), f"found {shown(mapping)}, allowed is a mapping with the key `fault` and the fault's own")]
    own = dict(mapping)
    name = own.pop("fault", None)
    findings: list[Finding] = []
    times = {}
    for key, lowest in (("at", 0.0), ("lasts", 1e-3)):
        if (value := own.pop(key, None)) is None:
            continue
        sound = isinstance(value, int | float) and not isinstance(value, bool) and lowest <= value <= _LONGEST_S
        if not sound:
            findings.append(((key,), f"found {shown(value)}, allowed is a number from {lowest:g} to {_LONGEST_S:g}"))
        times[key] = value
    if not isinstance(name, str) or name not in FAULTS:
        text = f"found {shown(name)}, allowed is one of {', '.join(FAULTS)}"
        if isinstance(name, str):
            text = unknown_key(name, list(FAULTS)).replace("this key is", "this fault is")
        return None, [(("fault",), text), *findings]
    fault, wrong = _checker(name).check(own)
    findings += wrong
    if fault is not None:
        if isinstance(fault, _BY_RATE) and (fault.rate is None) == (fault.burst is None):
            findings.append((("rate",), "give either rate (the probability for each frame) or burst (how many frames)"))
        if isinstance(fault, ONCE) and "lasts" in times:
            findings.append((("lasts",), f"{name} happens once and is over: it takes no lasts"))
    if findings or fault is None:
        return None, findings
    return Planned(fault, float(times.get("at", 0.0)), times.get("lasts")), []


@cache
def _checker(name: str) -> Checker[Any]:
    """Return the checker of a kind: made once, a segment that runs reads its commands between frames."""
    return Checker(FAULTS[name])


def load_script(path: Path, slaves: int = 255) -> tuple[Planned, ...]:
    """Read a script of faults: a mapping with the key `faults`, a list of faults with `at`; return them in their order.

    `slaves` is how many the segment has.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    document = read(path)
    data: Any = document.data
    entries = data.get("faults") if isinstance(data, dict) else None
    if not isinstance(entries, list):
        where = ("faults",) if isinstance(data, dict) and "faults" in data else ()
        raise ConfigError(document.sentences([(where, "a script is a mapping with the key `faults`, a list")]))
    findings: list[Finding] = [
        ((key,), unknown_key(str(key), ["faults"])) for key in data if key != "faults"
    ]  # fmt: skip
    planned: list[Planned] = []
    for i, entry in enumerate(entries):
        made, wrong = parse(entry)
        findings += [(("faults", i, *where), text) for where, text in wrong]
        if made is not None:
            planned.append(made)
            findings += [(("faults", i, *where), text) for where, text in _beyond(made.fault, slaves)]
    if findings:
        raise ConfigError(document.sentences(findings))
    return tuple(sorted(planned, key=lambda each: each.at))


def _beyond(fault: Fault, slaves: int) -> list[Finding]:
    """Return the mistake of a fault whose place the cable does not have."""
    for key, last in (("slave", slaves), ("after", slaves - 1)):
        if (place := getattr(fault, key, 0)) > last:
            return [((key,), f"found {place}, the segment has {slaves} slaves: allowed is at most {last}")]
    return []
