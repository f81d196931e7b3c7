"""Random sessions of the product, read by the tests' own oracle, and what came of many of them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from random import Random
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from rtcp.config.model import ArmConfig
from rtcp.testing.sessions.checker import Bounds
from rtcp.testing.sessions.session import Session
from tests.leftovers import Leftovers
from tests.sessions.oracle import PERIODS_US, configuration, reading

if TYPE_CHECKING:
    from distributed import Client

    from rtcp.testing.sessions.cluster import Batch, SessionPlan

SECONDS = 3.0
SHOWN_ACTIONS = 12


@dataclass
class Outcome:
    """What came of a session, or of many."""

    sessions: int = 0
    cycles: int = 0
    checked: int = 0
    simulated_s: float = 0.0
    taken: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    step: float = 0.0
    acceleration: float = 0.0
    failures: list[tuple[int, list[str]]] = field(default_factory=list)
    """Seed and sentences."""

    def add(self, other: Outcome) -> None:
        """Add another's numbers."""
        self.sessions += other.sessions
        self.cycles += other.cycles
        self.checked += other.checked
        self.simulated_s += other.simulated_s
        for mine, its in (
            (self.taken, other.taken), (self.refused, other.refused), (self.faults, other.faults),
            (self.states, other.states),
        ):  # fmt: skip
            mine.update(its)
        self.step = max(self.step, other.step)
        self.acceleration = max(self.acceleration, other.acceleration)
        self.failures += other.failures


def session_of(seed: int, config: ArmConfig | None = None) -> Session:
    """Return the session of a seed, of the shipped arm or of another one."""
    its_reading = reading() if config is None else None
    return Session(Random(seed), config or configuration(), its_reading, periods_us=PERIODS_US, number=seed)


def run_session(seed: int, config: ArmConfig | None = None) -> Outcome:
    """Run the session of `seed`; a failure is in the outcome, with what was done before it."""
    session = session_of(seed, config)
    commander, checker = session.commander, session.commander.checker
    problems: list[str] = []
    try:
        session.run(SECONDS)
    except Exception as error:
        problems.append(f"{type(error).__name__}: {error}")
    finally:
        commander.close()
    problems += map(str, checker.violations[:4])
    return Outcome(
        1, checker.frames, checker.obeyed, commander.seconds, commander.taken, commander.refused, commander.faults,
        Counter({state.name: count for state, count in commander.states.items()}), checker.largest_step,
        checker.largest_acceleration,
        [(seed, [*problems, *map(str, commander.log[-SHOWN_ACTIONS:])])] if problems else [],
    )  # fmt: skip


# -- a planted violation --------------------------------------------------------------------------------------------


@contextmanager
def narrowed() -> Iterator[None]:
    """Give the checker a tenth of the speed limits that the loop has: what moves is a violation."""
    configured = Bounds.configured

    def narrow(config: Any) -> Bounds:
        bounds = configured(config)
        bounds.velocity[:] = [0.1 * velocity for velocity in bounds.velocity]
        return bounds

    with patch.object(Bounds, "configured", narrow):
        yield


def run_narrowed(plan: SessionPlan, seeds: Sequence[int]) -> Batch:
    """Run a batch in a worker whose checker is `narrowed`."""
    from rtcp.testing.sessions.cluster import run_batch

    with narrowed():
        return run_batch(plan, seeds)


def run_still(plan: SessionPlan, seeds: Sequence[int]) -> Batch:
    """Run a batch in a worker whose arms are never enabled."""
    from rtcp.ipc.commands import Enable
    from rtcp.testing.sessions.cluster import run_batch
    from rtcp.testing.sessions.commander import Commander

    send = Commander.send

    def refused(commander: Commander, command: Any, *arguments: Any) -> bool:
        return not isinstance(command, Enable) and send(commander, command, *arguments)

    with patch.object(Commander, "send", refused):
        return run_batch(plan, seeds)


@contextmanager
def two_workers(leftovers: Leftovers) -> Iterator[Client]:
    """A local cluster for the tests of a module: a worker that follows one that has ended begins during a test."""
    from rtcp.testing.sessions.cluster import cluster

    leftovers.services.add("multiprocessing.spawn")
    with patch.object(os, "sched_getaffinity", lambda pid: {0, 1}), cluster(None) as client:
        yield client
    leftovers.services.remove("multiprocessing.spawn")
