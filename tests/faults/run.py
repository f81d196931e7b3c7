"""Carrying out cases of the fault matrix on a platform, and what is wrong with what came of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rtcp.ipc.session import read_session
from rtcp.telemetry.trials.bench import Bench, TrialFailed
from rtcp.telemetry.trials.trial import GOES_ON as GOING_ON
from rtcp.telemetry.trials.trial import LARGEST_STEP, Outcome, carry_out
from tests.e2e.conftest import Platform
from tests.faults.cases import GOES_ON, MOVING, STOPS, Case

SHIPPED_MS = 500
"""What the shipped configuration takes without frames on the virtual bus; the tests' lease is longer than the shipped
one alone, for a shared host at times lets a gateway wait."""


@contextlib.contextmanager
def bench_of(platform: Platform) -> Iterator[Bench]:
    """A bench for a platform that runs."""
    config = read_session(platform.directory).config
    with Bench(platform.directory, config) as bench:
        yield bench


def play(bench: Bench, case: Case, activity: str) -> tuple[Outcome | None, list[str]]:
    """Carry out a case; return what came of it (None where it could not be ended) and all that is wrong with that."""
    try:
        outcome = carry_out(bench, case.faults, activity, case.watch_s, reset_first=case.reset_is_refused)
    except TrialFailed as failure:
        bench.segment.clear()
        return None, [str(failure)]
    return outcome, faults_of(case, outcome)


def ended_in(outcome: Outcome) -> str:
    """Return in which of the ways that a case knows a trial has ended."""
    if outcome.state not in GOING_ON:
        return outcome.state
    return GOES_ON if outcome.standstill_s is None else STOPS


def faults_of(case: Case, outcome: Outcome) -> list[str]:
    """Return a sentence for everything that is not as the case says."""
    found = []
    end = ended_in(outcome)
    if end not in case.ends_in:
        found.append(f"it ended in {end}, not in {' or '.join(case.ends_in)}")
    if end not in (GOES_ON, STOPS) and not outcome.said:
        found.append("nothing was said")
    said = " | ".join(outcome.said).lower()
    found += [f"nobody said {words!r}" for words in case.words if words.lower() not in said]
    if outcome.way > 1.0:
        found.append(f"a joint went {outcome.way:.2f} times as far as its stop may be long")
    if outcome.by_itself:
        found.append(f"without a reset {outcome.by_itself}")
    if outcome.largest_step > LARGEST_STEP:
        found.append(f"a target's step was {outcome.largest_step:.4f} of what its speed limit allows")
    if case.reset_is_refused and not outcome.still_broken:
        found.append("a reset was not refused while the fault lasted")
    if not outcome.recovered:
        found.append(f"the arm could not be used again: {outcome.refusal}")
    return found


def columns(case: Case, activity: str, outcome: Outcome | None, wrong: list[str]) -> list[str]:
    """Return the row of a table: fault, activity, end, standstill, step, sentence, recovery."""
    if outcome is None:
        return [case.name, activity, "-", "-", "-", "-", "; ".join(wrong), "-"]
    still = "-"
    if outcome.standstill_s is not None:
        still = f"{outcome.standstill_s:.3f}" if activity == MOVING or outcome.standstill_s > 0 else "0"
    resets = f"{outcome.resets} reset{'s' if outcome.resets != 1 else ''}, {outcome.recovery_s:.1f} s"
    end = ended_in(outcome)
    if end == GOES_ON:
        resets = "none needed"
    return [
        case.name, activity, end.replace("_", " "), still, f"{outcome.way:.3f}", f"{outcome.largest_step:.3f}",
        "; ".join([outcome.sentence, *(f"WRONG: {sentence}" for sentence in wrong)]), resets,
    ]  # fmt: skip
