"""Runs cases of the fault matrix on a platform and checks the reactions."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rtcp.ipc.session import read_session
from rtcp.telemetry.harness import Harness, TrialFailed
from rtcp.telemetry.trial import TrialResult, run_trial
from tests.e2e.conftest import Platform
from tests.faults.cases import CONTINUES, MOVING, STOPS, Case

HOLD_MS = 500
"""Tolerated time without frames in the trials."""


@contextlib.contextmanager
def harness_of(platform: Platform) -> Iterator[Harness]:
    """A harness for a running platform."""
    with Harness(platform.directory, read_session(platform.directory).config) as harness:
        yield harness


def run_case(harness: Harness, case: Case, workload: str) -> tuple[TrialResult | None, list[str]]:
    """Run a case; return its result (None where it could not be finished) and a message for each violation."""
    try:
        result = run_trial(harness, case.faults, workload, case.watch_s, reset_first=case.reset_is_refused)
    except TrialFailed as failure:
        harness.segment.clear()
        return None, [str(failure)]
    return result, violations(case, result)


def reaction(result: TrialResult) -> str:
    """Return the reaction in the terms of a case."""
    if not result.continued:
        return result.state.name.lower()
    return CONTINUES if result.standstill_s is None else STOPS


def violations(case: Case, result: TrialResult) -> list[str]:
    """Return a message for each violation of the case."""
    problems = []
    end = reaction(result)
    if end not in case.ends_in:
        problems.append(f"it ended in {end}, not in {' or '.join(case.ends_in)}")
    if end not in (CONTINUES, STOPS) and not result.messages:
        problems.append("there was no message")
    messages = " | ".join(result.messages).lower()
    problems += [f"no message has {words!r}" for words in case.words if words.lower() not in messages]
    if case.reset_is_refused and not result.early_reset_refusal:
        problems.append("a reset was not refused while the fault was active")
    return problems + result.violations


def columns(case: Case, workload: str, result: TrialResult | None, wrong: list[str]) -> list[str]:
    """Return the row of a table: fault, workload, reaction, standstill, travel, step, message, recovery."""
    if result is None:
        return [case.name, workload, "-", "-", "-", "-", "; ".join(wrong), "-"]
    standstill = "-"
    if result.standstill_s is not None:
        standstill = f"{result.standstill_s:.3f}" if workload == MOVING or result.standstill_s > 0 else "0"
    resets = f"{result.resets} reset{'s' if result.resets != 1 else ''}, {result.recovery_s:.1f} s"
    end = reaction(result)
    return [
        case.name, workload, end.replace("_", " "), standstill, f"{result.travel:.3f}", f"{result.largest_step:.3f}",
        "; ".join([result.message, *(f"WRONG: {violation}" for violation in wrong)]),
        "none needed" if end == CONTINUES else resets,
    ]  # fmt: skip
