"""A fixed part of the fault matrix; `make faults` carries out the whole."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rtcp.telemetry.trials.bench import Bench
from tests.e2e.conftest import Platform
from tests.faults.cases import CASES, HOLDING, JOGGING, MOVING, STICK, Case
from tests.faults.run import SHIPPED_MS, bench_of, play

pytestmark = pytest.mark.alone

PART = (
    ("cable: slave 3 to 4", MOVING),
    ("power: IO box (reference clock)", HOLDING),
    ("power: drive 3", JOGGING),
    ("falls and refuses OP", MOVING),
    ("frames lost: 20 in a row", MOVING),
    ("working counter wrong: always", JOGGING),
    ("drive: over-current", MOVING),
    ("emergency stop's input stuck at pressed", JOGGING),
    ("stick out of code", STICK),
)


def case_of(name: str, activity: str) -> Case:
    """Return the case of this name that has the activity."""
    return next(case for case in CASES if case.name == name and activity in case.activities)


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """A bench for all of them: each must leave the arm usable for the next."""
    platform = Platform()
    try:
        platform.be_patient(SHIPPED_MS)
        platform.rtcp("start", "--detach")
        with bench_of(platform) as made:
            yield made
    finally:
        platform.end()


@pytest.mark.parametrize(("name", "activity"), PART)
def test_a_fault_ends_as_the_matrix_says_and_the_arm_can_be_used_again(bench: Bench, name: str, activity: str) -> None:
    outcome, wrong = play(bench, case_of(name, activity), activity)
    assert not wrong, f"{wrong}\n{outcome}"


def test_no_record_of_a_cycle_was_torn_or_lost_meanwhile(bench: Bench) -> None:
    bench.follow()
    assert bench.records > 0
    assert bench.torn == 0


def test_every_kind_of_fault_is_in_the_matrix() -> None:
    from rtcp.config.faults import FAULTS, parse

    assert {fault["fault"] for case in CASES for fault in case.faults} == set(FAULTS)
    for case in CASES:
        for fault in case.faults:
            planned, findings = parse(dict(fault))
            assert planned is not None, (case.name, findings)
