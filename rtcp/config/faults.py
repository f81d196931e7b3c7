"""What can go wrong on the virtual segment: the form in which commands and scripts name a fault, and its reader.

A fault is a mapping: `fault` names it, `lasts` says for how many seconds (left out: until it is cleared), the other
keys are the fault's own. `{fault: cable, after: 3, lasts: 1.5}` breaks the cable between slaves 3 and 4 for 1.5 s. In a
script (`faults:`, a list) each has `at` as well, seconds from the segment's start.

As `model`, this module imports nothing heavy. The kinds are those of `fault_kinds`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rtcp.config.document import Finding, dotted, read, shown
from rtcp.config.fault_kinds import (
    FAULTS,
    ONCE,
    AlFall,
    AlHang,
    AlRefuse,
    CableFault,
    ClockDrift,
    ClockJump,
    Corrupt,
    Delay,
    DriveFault,
    Duplicate,
    Fault,
    Garble,
    InputsFrozen,
    Loss,
    Noise,
    PowerFault,
    Reorder,
    SdoAbort,
    SdoLate,
    StickCode,
    Sync0Lost,
    TerminalFault,
    WorkingCounter,
    installed,
)
from rtcp.config.model import ConfigError
from rtcp.config.validation import Checker, unknown_key

__all__ = [
    "FAULTS", "ONCE", "AlFall", "AlHang", "AlRefuse", "CableFault", "ClockDrift", "ClockJump", "Corrupt", "Delay",
    "DriveFault", "Duplicate", "Fault", "Garble", "InputsFrozen", "Loss", "Noise", "Planned", "PowerFault", "Reorder",
    "SdoAbort", "SdoLate", "StickCode", "Sync0Lost", "TerminalFault", "WorkingCounter", "installed", "load_script",
    "parse", "sentence_of",
]  # fmt: skip

_BY_RATE = (Loss, Delay, Duplicate, Reorder, Corrupt, Garble, WorkingCounter)
_LONGEST_S = 86_400.0


@dataclass(frozen=True)
class Planned:
    """A fault with its time: `at` seconds from the start of the script (0 for a command), and how long it `lasts`."""

    fault: Fault
    at: float = 0.0
    lasts: float | None = None
    """s; None: until it is cleared (for a burst: until it has passed)."""

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
    known = installed()
    if not isinstance(name, str) or name not in known:
        text = f"found {shown(name)}, allowed is one of {', '.join(known)}"
        if isinstance(name, str):
            text = unknown_key(name, list(known), what="fault")
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


def sentence_of(finding: Finding) -> str:
    """Return the sentence of a mistake that `parse` has found."""
    where, text = finding
    return f"{dotted(where)}{': ' if where else ''}{text}"


@cache
def _checker(name: str) -> Checker[Any]:
    """Return the checker of a kind: made once, a segment that runs reads its commands between frames."""
    return Checker(installed()[name])


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
