"""The soak: hours of an arm that works while faults come at random, and the account of what became of each."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import Any

from rtcp.ipc.errors import RtcpError
from rtcp.telemetry.trials.activities import ACTIVITIES
from rtcp.telemetry.trials.bench import Bench, TrialFailed
from rtcp.telemetry.trials.resources import Resources, grown, resources
from rtcp.telemetry.trials.trial import GOES_ON, LARGEST_STEP, Outcome, carry_out, shown
from rtcp.virtual.faults.client import SegmentAway, SegmentRefused

SETTLE_S = 60.0
"""A process's memory is looked at from then on: by that time all that it keeps has been allocated."""
_WATCH_S = 1.0
_ON_FRAMES = frozenset({"cable", "power", "loss", "delay", "duplicate", "reorder", "corrupt", "wkc", "noise"})
"""Faults that show in the working counter; of others a cycle without the right one says nothing."""
_STATIONS = ("loop", "gateway", "segment")
Report = Callable[[str], None]


def draw(random: Random, slaves: int, drives: tuple[int, ...]) -> dict[str, Any]:
    """Return a fault chosen at random, with its numbers.

    Args:
        random: chooses.
        slaves: how many there are.
        drives: positions of the drives.
    """
    slave, drive, cable = random.randint(1, slaves), random.choice(drives), random.randrange(slaves)
    often: dict[str, Any] = random.choice(
        ({"burst": random.randint(1, 200)}, {"rate": random.choice((0.002, 0.02, 0.2))})
    )
    seed = random.randrange(1 << 16)
    some: tuple[dict[str, Any], ...] = (
        {"fault": "cable", "after": cable},
        {"fault": "power", "slave": slave},
        {"fault": "al_fall", "slave": slave, "state": random.choice(("SAFE-OP", "PRE-OP"))},
        {"fault": "al_hang", "slave": slave},
        {"fault": "al_refuse", "slave": slave},
        {"fault": "sdo_late", "slave": drive, "ms": random.choice((20, 300))},
        {"fault": "sdo_abort", "slave": drive},
        {"fault": "loss", **often, "seed": seed},
        {"fault": "delay", "ms": random.choice((0.5, 3.0)), **often, "seed": seed},
        {"fault": "duplicate", **often, "seed": seed},
        {"fault": "reorder", **often, "seed": seed},
        {"fault": "corrupt", "after": cable, "way": random.choice(("out", "back")), **often, "seed": seed},
        {"fault": "wkc", "slave": slave, **often, "seed": seed},
        {
            "fault": "drive",
            "slave": drive,
            "error": random.choice(("over-current", "over-temperature", "following-error", "encoder")),
        },
        {"fault": "sync0", "slave": drive},
        {"fault": "clock_jump", "slave": slave, "us": random.choice((-300, 50, 300))},
        {"fault": "clock_drift", "slave": slave, "ppm": random.choice((-200, 200))},
        {"fault": "input", "number": random.choice((1, 9, 10)), "how": random.choice(("low", "bounce")), "ms": 20},
        {"fault": "stick_code", "value": random.randrange(64)},
        {"fault": "noise", "rate_hz": random.choice((50, 500))},
    )
    fault = random.choice(some)
    if fault["fault"] not in ("al_fall", "clock_jump"):
        fault["lasts"] = round(random.choice((0.02, 0.2, 1.0, 3.0)), 3)
    return fault


@dataclass
class Account:
    """What became of the faults of one kind."""

    injected: int = 0
    went_on: int = 0
    stopped: int = 0
    noticed: int = 0
    """Of which the platform said something, counted cycles without the right working counter, or stopped."""
    recovered: int = 0


@dataclass
class Summary:
    """What a soak gave."""

    seed: int
    minutes: float = 0.0
    accounts: dict[str, Account] = field(default_factory=dict)
    records: int = 0
    torn: int = 0
    largest_step: float = 0.0
    first: dict[str, Resources] = field(default_factory=dict)
    """What each process held after the first minute, or at the beginning of a shorter soak."""
    last: dict[str, Resources] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    """What must not have been, in sentences."""


class Soak:
    """Carries out trials at random until its time is over.

    Args:
        bench: the platform.
        pids: process ids by name: loop, gateway, segment.
        seed: everything that is chosen follows from it.
        report: is told of each trial in a line.
    """

    def __init__(self, bench: Bench, pids: Mapping[str, int], seed: int, report: Report) -> None:
        self._bench = bench
        self._pids = {name: pids[name] for name in _STATIONS}
        self._random = Random(seed)
        self._report = report
        self._slaves = len(bench.config.slaves)
        wanted = {joint.slave for joint in bench.config.joints}
        self._drives = tuple(at for at, slave in enumerate(bench.config.slaves, 1) if slave.name in wanted)
        self.summary = Summary(seed)

    def run(self, minutes: float) -> Summary:
        """Run for so long; a trial that is under way is finished."""
        begun = time.monotonic()
        summary = self.summary
        summary.first = self._held()
        settled = False
        try:
            for number, (fault, activity) in enumerate(self._choices(), 1):
                if (passed := time.monotonic() - begun) > minutes * 60.0:
                    break
                if not settled and passed > SETTLE_S:
                    settled, summary.first = True, self._held()
                self._trial(number, fault, activity)
                if len(self._held()) < len(self._pids):
                    break
        finally:
            # Also of a soak that was interrupted.
            summary.minutes = (time.monotonic() - begun) / 60.0
            self._look_at_what_is_held(settled)
        return summary

    def _choices(self) -> Iterator[tuple[dict[str, Any], str]]:
        while True:
            yield draw(self._random, self._slaves, self._drives), self._random.choice(tuple(ACTIVITIES))

    def _trial(self, number: int, fault: dict[str, Any], activity: str) -> None:
        bench, summary = self._bench, self.summary
        account = summary.accounts.setdefault(str(fault["fault"]), Account())
        where = f"trial {number}, {shown([fault])}, while {activity}"
        before = bench.injected
        try:
            outcome = carry_out(bench, [fault], activity, _WATCH_S)
            bench.follow()
        except (TrialFailed, RtcpError, SegmentRefused, SegmentAway, OSError) as error:
            summary.failures.append(f"{where}: {error}")
            self._report(f"{where}: {error}")
            with contextlib.suppress(SegmentRefused, SegmentAway, OSError):
                bench.segment.clear()
            return
        finally:
            account.injected += bench.injected - before
        self._count(account, outcome, counted=fault["fault"] in _ON_FRAMES)
        summary.largest_step = max(summary.largest_step, outcome.largest_step)
        if outcome.largest_step > LARGEST_STEP:
            summary.failures.append(f"{where}: a target's step was {outcome.largest_step:.3f} of what is allowed")
        if outcome.way > 1.0:
            summary.failures.append(f"{where}: a joint went {outcome.way:.2f} times as far as its stop may be long")
        if outcome.by_itself:
            summary.failures.append(f"{where}: without a reset {outcome.by_itself}")
        if not outcome.recovered:
            summary.failures.append(f"{where}: not brought back: {outcome.refusal}")
        self._report(f"{where}: {outcome.state.replace('_', ' ')}; {outcome.sentence or 'nothing said'}")

    @staticmethod
    def _count(account: Account, outcome: Outcome, *, counted: bool) -> None:
        went_on = outcome.state in GOES_ON
        account.went_on += went_on
        account.stopped += not went_on
        account.noticed += bool(outcome.said) or (counted and outcome.wrong_cycles > 0) or not went_on
        account.recovered += outcome.recovered

    def _held(self) -> dict[str, Resources]:
        found = {name: resources(pid) for name, pid in self._pids.items()}
        return {name: held for name, held in found.items() if held is not None}

    def _look_at_what_is_held(self, settled: bool) -> None:
        summary = self.summary
        summary.last = self._held()
        summary.records, summary.torn = self._bench.records, self._bench.torn
        if summary.torn:
            summary.failures.append(f"{summary.torn} cycle records were torn or lost")
        summary.failures += grown(summary.first, summary.last, settled=settled)
