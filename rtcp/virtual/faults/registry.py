"""The faults of a segment: the kinds by their names, the form that commands and scripts give them, those now active.

A fault is written as a mapping: `fault` names it, `lasts` says for how many seconds (left out: until it is cleared),
the other keys are the fault's own. `{fault: cable, after: 3, lasts: 1.5}` breaks the cable between slaves 3 and 4 for
1.5 s. In a script (`faults:`, a list) each has `at` as well, seconds from the segment's start.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rtcp.config.document import Finding, dotted, read, shown
from rtcp.config.find import load_class, registered
from rtcp.config.model import ConfigError, PluginError
from rtcp.config.validation import Checker, unknown_key
from rtcp.virtual.faults.fault import FOR_EVER, Fault, FaultRefused, Frames, Send
from rtcp.virtual.segment import Segment

ENTRY_POINTS = "rtcp.faults"
MOST_ACTIVE = 50
LONGEST_S = 86_400.0

Report = Callable[[str], None]


@cache
def installed() -> Mapping[str, type[Fault]]:
    """Return every kind of fault by its name.

    Raises:
        PluginError: an entry point is not a dataclass that extends `Fault`, or its name differs from the fault's.
    """
    found: dict[str, type[Fault]] = {}
    for entry in registered(ENTRY_POINTS).values():
        loaded = load_class(entry, Fault)
        if "__dataclass_fields__" not in vars(loaded):
            raise PluginError(entry, "is not a dataclass")
        if loaded.name != entry.name:
            raise PluginError(entry, f"has the `name` {loaded.name}: the two must be the same")
        found[entry.name] = loaded
    return MappingProxyType(found)


@dataclass(frozen=True)
class Planned:
    """A fault with its time: `at` seconds from the start of the script (0 for a command), and how long it `lasts`."""

    fault: Fault
    at: float = 0.0
    lasts: float | None = None
    """s; None: until it is cleared (for a burst: until it has passed)."""

    def as_mapping(self) -> dict[str, Any]:
        """Return the form that commands and scripts give it; `parse` makes the same of it again."""
        own = {key.name: getattr(self.fault, key.name) for key in self.fault.key_fields()}
        found = {"fault": self.fault.name, **{key: value for key, value in own.items() if value is not None}}
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
        sound = isinstance(value, int | float) and not isinstance(value, bool) and lowest <= value <= LONGEST_S
        if not sound:
            findings.append(((key,), f"found {shown(value)}, allowed is a number from {lowest:g} to {LONGEST_S:g}"))
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
        findings += fault.mistakes()
        if fault.once and "lasts" in times:
            findings.append((("lasts",), f"{name} happens once and is over: it takes no lasts"))
    if findings or fault is None:
        return None, findings
    return Planned(fault, float(times.get("at", 0.0)), times.get("lasts")), []


def sentence_of(finding: Finding) -> str:
    """Return the sentence of a mistake that `parse` has found."""
    where, text = finding
    return f"{dotted(where)}{': ' if where else ''}{text}"


@cache
def _checker(name: str) -> Checker[Fault]:
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
        if made is not None:
            planned.append(made)
            wrong += _beyond(made.fault, slaves)
        findings += [(("faults", i, *where), text) for where, text in wrong]
    if findings:
        raise ConfigError(document.sentences(findings))
    return tuple(sorted(planned, key=lambda each: each.at))


def _beyond(fault: Fault, slaves: int) -> list[Finding]:
    """Return the mistake of a fault whose place the cable does not have."""
    for key, last in (("slave", slaves), ("after", slaves - 1)):
        if (place := getattr(fault, key, 0)) > last:
            return [((key,), f"found {place}, the segment has {slaves} slaves: allowed is at most {last}")]
    return []


class ActiveFault:
    """A fault that has begun; instants in ns. A call ends it, once."""

    def __init__(self, planned: Planned, segment: Segment, frames: Frames, t: int) -> None:
        """Let the fault begin at instant `t`, whatever its `at` says; raises FaultRefused."""
        self.planned = planned
        self.since = t
        self.until = FOR_EVER if planned.lasts is None else t + round(planned.lasts * 1e9)
        self._segment = segment
        # A plan may run more than once, each time with a state of its own.
        self._fault = copy(planned.fault)
        self._fault.prepare(t)
        self._catch_up(t)
        self._end = self._fault.start(segment, frames, t)
        if self._fault.once_unless_it_lasts and planned.lasts is None:
            self(t)
        segment.look_at(t)

    @property
    def over(self) -> bool:
        """Whether the fault has passed: it happened once, its burst is at its end, or it was ended."""
        return self._end is None or self._fault.over

    @property
    def counts(self) -> dict[str, int]:
        """What was done to frames."""
        return dict(self._fault.counts)

    def __call__(self, t: int) -> None:
        """End the fault at instant `t`."""
        over = self.over
        end, self._end = self._end, None
        if end is not None and not over:
            self._catch_up(t)
            end(t)
            self._segment.look_at(t)

    def _catch_up(self, t: int) -> None:
        """What is due before `t` happens before what is to come."""
        if self._segment.next_event <= t:
            self._segment.tick(t)


class FaultRegistry:
    """Begins and ends faults. Nothing happens by itself: `tick` is to be called when `due` has come.

    `send` puts a frame on the cable to the master. The times of `script` count from instant `t`; what a segment refuses
    of it is told to `report`. Instants are ns, CLOCK_MONOTONIC.
    """

    def __init__(self, segment: Segment, send: Send, t: int, script: Sequence[Planned] = (),
                 report: Report = print) -> None:  # fmt: skip
        self.frames = Frames(send)
        """What happens to frames; look at its `active` before each of them."""
        self.due = FOR_EVER
        """Instant of the next call of `tick` that is needed."""
        self._segment = segment
        self._report = report
        self._active: dict[int, ActiveFault] = {}
        self._last = 0
        self._script = deque((t + round(planned.at * 1e9), planned) for planned in script)
        self._look_ahead()

    def begin(self, planned: Planned, t: int) -> int:
        """Let a fault begin at instant `t`, whatever its `at` says; return its number.

        Raises:
            FaultRefused: a fault that this segment cannot have, or too many at once.
        """
        self._drop_passed()
        if len(self._active) >= MOST_ACTIVE:
            raise FaultRefused(f"{MOST_ACTIVE} faults are active already: clear some of them first")
        begun = ActiveFault(planned, self._segment, self.frames, t)
        self._last += 1
        if not begun.over:
            self._active[self._last] = begun
        self._look_ahead()
        return self._last

    def clear(self, number: int | None, t: int) -> list[int]:
        """End a fault, or all that are active when None; return the numbers of those that were.

        Raises:
            FaultRefused: no active fault has this number.
        """
        self._drop_passed()
        if number is not None and number not in self._active:
            if 0 < number <= self._last:
                raise FaultRefused(f"fault {number} is not active any more")
            known = ", ".join(map(str, self._active)) or "none"
            raise FaultRefused(f"there was no fault {number}; active now: {known}")
        cleared = list(self._active) if number is None else [number]
        # The last one first: each finds the segment as it was when it began.
        for each in reversed(cleared):
            self._active.pop(each)(t)
        self._look_ahead()
        return cleared

    def tick(self, now: int) -> None:
        """End the faults whose time is over, begin those of the script that are due, send the frames that are due."""
        self._drop_passed()
        for number in reversed([number for number, each in self._active.items() if each.until <= now]):
            self._active.pop(number)(now)
        while self._script and self._script[0][0] <= now:
            _, planned = self._script.popleft()
            try:
                self.begin(planned, now)
            except FaultRefused as error:
                self._report(f"the script's fault {planned.fault.name} at {planned.at:g} s is left out: {error}")
        if self.frames.due <= now:
            self.frames.tick(now)
        self._look_ahead()

    def answers(self, frame: bytes, t: int) -> None:
        """Send, keep or lose the answer to a frame that came at `t`."""
        self.frames.answers(frame, t)
        self.due = min(self.due, self.frames.due)

    def listing(self, t: int) -> list[dict[str, Any]]:
        """Return the active faults: number, mapping, how long for and for how long to come, what each has done."""
        self._drop_passed()
        return [
            {
                "id": number,
                "fault": each.planned.as_mapping(),
                "since_s": (t - each.since) * 1e-9,
                "left_s": None if each.until == FOR_EVER else max(0, each.until - t) * 1e-9,
                "counts": each.counts,
            }
            for number, each in self._active.items()
        ]

    def _drop_passed(self) -> None:
        """Forget bursts that have passed."""
        for number in [number for number, each in self._active.items() if each.over]:
            del self._active[number]

    def _look_ahead(self) -> None:
        script = (self._script[0][0],) if self._script else ()
        self.due = min(self.frames.due, *script, *(each.until for each in self._active.values()), FOR_EVER)
