"""The faults of a segment: kinds by name, their form in commands and scripts, and the active ones.

A fault is a mapping: `fault` is its kind, `lasts` its duration in s (default: until it is cleared), the other keys are
those of the kind. `{fault: cable, after: 3, lasts: 1.5}` breaks the cable between slaves 3 and 4 for 1.5 s. In a script
(`faults:`, a list) each also has `at`, s from the segment's start.
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

from rtcp.config.document import read
from rtcp.config.find import load_class, registered
from rtcp.config.findings import Finding
from rtcp.config.model import ConfigError, PluginError
from rtcp.config.validation import Checker, unknown
from rtcp.virtual.faults.fault import FOR_EVER, Fault, FaultRefused, Frames, Send
from rtcp.virtual.segment import Segment

ENTRY_POINTS = "rtcp.faults"
MOST_ACTIVE = 50
LONGEST_S = 86_400.0

Report = Callable[[str], None]


@cache
def installed() -> Mapping[str, type[Fault]]:
    """Return all kinds of faults by name.

    Raises:
        PluginError: an entry point is not a dataclass that extends `Fault`, or has another name than the fault.
    """
    kinds: dict[str, type[Fault]] = {}
    for entry in registered(ENTRY_POINTS).values():
        loaded = load_class(entry, Fault)
        if "__dataclass_fields__" not in vars(loaded):
            raise PluginError(entry, "is not a dataclass")
        if loaded.name != entry.name:
            raise PluginError(entry, f"has the `name` {loaded.name}: the two must be the same")
        kinds[entry.name] = loaded
    return MappingProxyType(kinds)


@dataclass(frozen=True)
class Planned:
    """A fault with its start: `at` s after that of the script (0 for a command), and its duration `lasts`."""

    fault: Fault
    at: float = 0.0
    lasts: float | None = None
    """Duration, s; None: until it is cleared, or to the end of a burst."""

    def as_mapping(self) -> dict[str, Any]:
        """Return the form for commands and scripts; the inverse of `parse`."""
        own = {key.name: getattr(self.fault, key.name) for key in self.fault.key_fields()}
        mapping = {"fault": self.fault.name, **{key: value for key, value in own.items() if value is not None}}
        if self.at:
            mapping["at"] = self.at
        if self.lasts is not None:
            mapping["lasts"] = self.lasts
        return mapping


def parse(mapping: object) -> tuple[Planned | None, list[Finding]]:
    """Return the fault of a mapping, or None and all mistakes with their keys."""
    if not isinstance(mapping, dict):
        wanted = "a mapping with the key `fault` and the fault's own"
        return None, [Finding((), "type", found=mapping, allowed=wanted)]
    own = dict(mapping)
    name = own.pop("fault", None)
    findings: list[Finding] = []
    times = {}
    for key, lowest in (("at", 0.0), ("lasts", 1e-3)):
        if (value := own.pop(key, None)) is None:
            continue
        sound = isinstance(value, int | float) and not isinstance(value, bool) and lowest <= value <= LONGEST_S
        if not sound:
            wanted = f"a number from {lowest:g} to {LONGEST_S:g}"
            findings.append(Finding((key,), "range", found=value, allowed=wanted))
        times[key] = value
    known = installed()
    if not isinstance(name, str) or name not in known:
        wrong_name = Finding(("fault",), "choice", found=name, allowed=f"one of {', '.join(known)}")
        if isinstance(name, str):
            wrong_name = unknown(("fault",), name, known, noun="fault")
        return None, [wrong_name, *findings]
    fault, wrong = _checker(name).check(own)
    findings += wrong
    if fault is not None:
        findings += fault.mistakes()
        if fault.once and "lasts" in times:
            findings.append(Finding(("lasts",), "once", text=f"{name} happens once and is over: it takes no lasts"))
    if findings or fault is None:
        return None, findings
    return Planned(fault, float(times.get("at", 0.0)), times.get("lasts")), []


@cache
def _checker(name: str) -> Checker[Fault]:
    """Return the checker of a kind; cached, as a running segment reads commands between frames."""
    return Checker(installed()[name])


def load_script(path: Path, slaves: int = 255) -> tuple[Planned, ...]:
    """Read a script: a mapping with the key `faults`, a list of faults with `at`; return them by time.

    `slaves`: number of slaves of the segment.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    document = read(path)
    data: Any = document.data
    entries = data.get("faults") if isinstance(data, dict) else None
    if not isinstance(entries, list):
        where = ("faults",) if isinstance(data, dict) and "faults" in data else ()
        finding = Finding(where, "no_script", text="a script is a mapping with the key `faults`, a list")
        raise ConfigError(document.placed([finding]))
    findings = [unknown((key,), key, ["faults"]) for key in data if key != "faults"]
    planned: list[Planned] = []
    for i, entry in enumerate(entries):
        plan, wrong = parse(entry)
        if plan is not None:
            planned.append(plan)
            wrong += _beyond(plan.fault, slaves)
        findings += [finding.below("faults", i) for finding in wrong]
    if findings:
        raise ConfigError(document.placed(findings))
    return tuple(sorted(planned, key=lambda plan: plan.at))


def _beyond(fault: Fault, slaves: int) -> list[Finding]:
    """Return the mistake of a fault at a position beyond the segment."""
    for key, last in (("slave", slaves), ("after", slaves - 1)):
        if (place := getattr(fault, key, 0)) > last:
            text = f"found {place}, the segment has {slaves} slaves: allowed is at most {last}"
            return [Finding((key,), "no_such_place", text=text, found=place, high=last)]
    return []


class ActiveFault:
    """An active fault; instants in ns. The first call ends it."""

    def __init__(self, planned: Planned, segment: Segment, frames: Frames, t: int) -> None:
        """Begin the fault at instant `t`, regardless of its `at`; raises FaultRefused."""
        self.planned = planned
        self.since = t
        self.until = FOR_EVER if planned.lasts is None else t + round(planned.lasts * 1e9)
        self._segment = segment
        # A plan may run several times, each with its own state.
        self._fault = copy(planned.fault)
        self._fault.prepare(t)
        self._catch_up(t)
        self._end = self._fault.start(segment, frames, t)
        if self._fault.once_unless_it_lasts and planned.lasts is None:
            self(t)
        segment.wake_at(t)

    @property
    def over(self) -> bool:
        """Whether the fault is over: a single event, a complete burst, or ended."""
        return self._end is None or self._fault.over

    @property
    def counts(self) -> dict[str, int]:
        """Number of affected frames."""
        return dict(self._fault.counts)

    def __call__(self, t: int) -> None:
        """End the fault at instant `t`."""
        over = self.over
        end, self._end = self._end, None
        if end is not None and not over:
            self._catch_up(t)
            end(t)
            self._segment.wake_at(t)

    def _catch_up(self, t: int) -> None:
        """Handle events due before `t` first."""
        if self._segment.next_event <= t:
            self._segment.tick(t)


class FaultRegistry:
    """Begins and ends faults; call `tick` at `due`.

    `send` sends a frame to the master. The times of `script` count from instant `t`; `report` receives the refusals of
    its faults. Instants are ns, CLOCK_MONOTONIC.
    """

    def __init__(self, segment: Segment, send: Send, t: int, script: Sequence[Planned] = (),
                 report: Report = print) -> None:  # fmt: skip
        self.frames = Frames(send)
        """Faults of frames; check its `active` before each frame."""
        self.due = FOR_EVER
        """Instant of the next call of `tick` that is needed."""
        self._segment = segment
        self._report = report
        self._active: dict[int, ActiveFault] = {}
        self._last = 0
        self._script = deque((t + round(planned.at * 1e9), planned) for planned in script)
        self._look_ahead()

    def begin(self, planned: Planned, t: int) -> int:
        """Begin a fault at instant `t`, regardless of its `at`; return its number.

        Raises:
            FaultRefused: the fault is impossible on this segment, or too many are active.
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
        """End a fault, or all for None; return the numbers of those that were active.

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
        # In reverse order: each one finds the segment as at its beginning.
        for fault in reversed(cleared):
            self._active.pop(fault)(t)
        self._look_ahead()
        return cleared

    def tick(self, now: int) -> None:
        """End expired faults, begin due faults of the script, send due frames."""
        self._drop_passed()
        for number in reversed([number for number, fault in self._active.items() if fault.until <= now]):
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
        """Send, retain or drop the answer to a frame that arrived at `t`."""
        self.frames.answers(frame, t)
        self.due = min(self.due, self.frames.due)

    def listing(self, t: int) -> list[dict[str, Any]]:
        """Return the active faults: number, mapping, elapsed and remaining time, affected frames."""
        self._drop_passed()
        return [
            {
                "id": number,
                "fault": fault.planned.as_mapping(),
                "since_s": (t - fault.since) * 1e-9,
                "left_s": None if fault.until == FOR_EVER else max(0, fault.until - t) * 1e-9,
                "counts": fault.counts,
            }
            for number, fault in self._active.items()
        ]

    def _drop_passed(self) -> None:
        """Remove complete bursts."""
        for number in [number for number, fault in self._active.items() if fault.over]:
            del self._active[number]

    def _look_ahead(self) -> None:
        script = (self._script[0][0],) if self._script else ()
        self.due = min(self.frames.due, *script, *(fault.until for fault in self._active.values()), FOR_EVER)
