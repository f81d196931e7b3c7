"""The soak: random faults while the arm works, for hours, and the result for each kind of fault."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any

import psutil

from rtcp.api import RtcpError
from rtcp.telemetry.harness import Harness, TrialFailed
from rtcp.telemetry.trial import WORKLOADS, named, run_trial
from rtcp.virtual.request_socket import RequestRefused, ServerAway

SETTLE_S = 60.0
RECORDINGS = 8
"""Number of recorded stops after which, with the settling time, a process has allocated all that it keeps: then its
memory must not grow."""
READINGS = 5
"""Number of trials whose least memory counts: a recording takes some 30 MiB while it is written."""
GROWTH = 2 << 20
"""Largest growth of a process after that, bytes, that is noise of the allocator and not a leak."""
_WATCH_S = 1.0
_ON_FRAMES = frozenset({"cable", "power", "loss", "delay", "duplicate", "reorder", "corrupt", "wkc", "noise"})
"""Faults that affect the working counter; for others a wrong counter is not evaluated."""
_PROCESSES = ("loop", "gateway", "segment")
_VARIABLE = frozenset({"gateway"})
"""Processes whose threads and files vary with their connections, without a leak."""
Log = Callable[[str], None]


@dataclass(frozen=True)
class Resources:
    """Resources of a process."""

    rss: int
    """Resident memory, bytes."""
    threads: int
    files: int


def resources(pid: int) -> Resources | None:
    """Return the present resources of a process; None where it has ended or belongs to another user."""
    try:
        process = psutil.Process(pid)
        return Resources(process.memory_info().rss, process.num_threads(), process.num_fds())
    except psutil.Error:
        return None


def grown(first: Mapping[str, Resources], last: Mapping[str, Resources], *, settled: bool) -> list[str]:
    """Return a message for each resource of a process that has grown, and for each process that has ended.

    Args:
        first: process name -> first resources.
        last: process name -> present resources; a missing process has ended.
        settled: whether `first` was read after memory had settled, so that memory is compared too.
    """
    messages = []
    for name, before in first.items():
        now = last.get(name)
        if now is None:
            messages.append(f"the {name} has ended")
            continue
        if name not in _VARIABLE:
            for count, unit in (("threads", "threads"), ("files", "open files")):
                if getattr(now, count) > getattr(before, count):
                    messages.append(f"the {name} has {getattr(now, count)} {unit}, {getattr(before, count)} before")
        if settled and now.rss - before.rss > GROWTH:
            messages.append(f"the {name} uses {now.rss / 2**20:.1f} MiB, {before.rss / 2**20:.1f} at first")
    return messages


def least(readings: Iterable[Mapping[str, Resources]]) -> dict[str, Resources]:
    """Return the last reading, each process with the least memory of all readings."""
    readings = list(readings)
    return {
        name: replace(last, rss=min(reading[name].rss for reading in readings if name in reading))
        for name, last in readings[-1].items()
    }


def random_fault(random: Random, slaves: int, drives: tuple[int, ...]) -> dict[str, Any]:
    """Return a random fault with its parameters.

    Args:
        random: source of randomness.
        slaves: number of slaves.
        drives: positions of the drives.
    """
    slave, drive, cable = random.randint(1, slaves), random.choice(drives), random.randrange(slaves)
    often: dict[str, Any] = random.choice(
        ({"burst": random.randint(1, 200)}, {"rate": random.choice((0.002, 0.02, 0.2))})
    )
    seed = random.randrange(1 << 16)
    candidates: tuple[dict[str, Any], ...] = (
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
        {"fault": "joystick_code", "value": random.randrange(64)},
        {"fault": "noise", "rate_hz": random.choice((50, 500))},
    )
    fault = random.choice(candidates)
    if fault["fault"] not in ("al_fall", "clock_jump"):
        fault["lasts"] = round(random.choice((0.02, 0.2, 1.0, 3.0)), 3)
    return fault


@dataclass
class Counts:
    """Results of the trials with one kind of fault."""

    injected: int = 0
    noticed: int = 0
    """Trials with a message, with cycles without the expected working counter, or with a stop."""
    continued: int = 0
    stopped: int = 0
    recovered: int = 0


@dataclass
class Summary:
    """Result of a soak."""

    seed: int
    minutes: float = 0.0
    counts: dict[str, Counts] = field(default_factory=dict)
    records: int = 0
    torn: int = 0
    largest_step: float = 0.0
    first: dict[str, Resources] = field(default_factory=dict)
    """Resources of each process when its memory had settled, or at the beginning of a shorter soak."""
    last: dict[str, Resources] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    """A message for each violation."""


class Soak:
    """Runs random trials for a given time.

    Args:
        harness: the platform.
        pids: process ids by name: loop, gateway, segment.
        seed: seed of all random choices.
        log: receives a line for each trial.
    """

    def __init__(self, harness: Harness, pids: Mapping[str, int], seed: int, log: Log) -> None:
        self._harness = harness
        self._pids = {name: pids[name] for name in _PROCESSES}
        self._random = Random(seed)
        self._log = log
        slaves = harness.config.slaves
        driven = {joint.slave for joint in harness.config.joints}
        self._slaves = len(slaves)
        self._drives = tuple(at for at, slave in enumerate(slaves, 1) if slave.name in driven)
        self.summary = Summary(seed)

    def run(self, minutes: float) -> Summary:
        """Run for this time; the last trial is completed."""
        begun = time.monotonic()
        summary = self.summary
        summary.first = self._resources()
        readings = deque([summary.first], READINGS)
        settled, number, settles_at = False, 0, 0
        try:
            while (passed := time.monotonic() - begun) <= minutes * 60.0:
                stops = sum(counts.stopped for counts in summary.counts.values())
                if not settles_at and passed > SETTLE_S and stops >= RECORDINGS:
                    settles_at = number + READINGS
                if not settled and number == settles_at != 0:
                    settled, summary.first = True, least(readings)
                number += 1
                fault = random_fault(self._random, self._slaves, self._drives)
                self._trial(number, fault, self._random.choice(tuple(WORKLOADS)))
                readings.append(self._resources())
                if len(readings[-1]) < len(self._pids):
                    break
        finally:  # also after an interruption
            summary.minutes = (time.monotonic() - begun) / 60.0
            readings.append(self._resources())
            summary.last = least(readings)
            summary.records, summary.torn = self._harness.records, self._harness.torn
            if summary.torn:
                summary.failures.append(f"{summary.torn} cycle records were torn or lost")
            summary.failures += grown(summary.first, summary.last, settled=settled)
        return summary

    def _trial(self, number: int, fault: dict[str, Any], workload: str) -> None:
        harness, summary = self._harness, self.summary
        counts = summary.counts.setdefault(str(fault["fault"]), Counts())
        trial = f"trial {number}, {named([fault])}, while {workload}"
        before = harness.injected
        try:
            result = run_trial(harness, [fault], workload, _WATCH_S)
            harness.read_cycles()
        except (TrialFailed, RtcpError, RequestRefused, ServerAway, OSError) as error:
            summary.failures.append(f"{trial}: {error}")
            self._log(f"{trial}: {error}")
            with contextlib.suppress(RequestRefused, ServerAway, OSError):
                harness.segment.clear()
            return
        finally:
            counts.injected += harness.injected - before
        counts.continued += result.continued
        counts.stopped += not result.continued
        wrong_counter = fault["fault"] in _ON_FRAMES and result.wrong_cycles > 0
        counts.noticed += bool(result.messages) or wrong_counter or not result.continued
        counts.recovered += result.recovered
        summary.largest_step = max(summary.largest_step, result.largest_step)
        summary.failures += [f"{trial}: {violation}" for violation in result.violations]
        self._log(f"{trial}: {result.state.name.lower().replace('_', ' ')}; {result.message or 'no message'}")

    def _resources(self) -> dict[str, Resources]:
        readings = {name: resources(pid) for name, pid in self._pids.items()}
        return {name: reading for name, reading in readings.items() if reading is not None}
