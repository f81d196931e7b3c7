"""A fixed part of the fault matrix; `make faults` runs all of it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rtcp.telemetry.harness import Harness
from tests.e2e.conftest import Platform
from tests.faults.cases import CASES, HOLDING, JOGGING, JOYSTICK, MOVING, Case
from tests.faults.run import HOLD_MS, harness_of, run_case

pytestmark = pytest.mark.platform

PART = (
    ("cable: slave 3 to 4", MOVING),
    ("power: IO box (reference clock)", HOLDING),
    ("power: drive 3", JOGGING),
    ("falls and refuses OP", MOVING),
    ("frames lost: 20 in a row", MOVING),
    ("working counter wrong: always", JOGGING),
    ("drive: over-current", MOVING),
    ("emergency stop's input stuck at pressed", JOGGING),
    ("joystick out of code", JOYSTICK),
)


def case_of(name: str, workload: str) -> Case:
    """The case of this name that has the workload."""
    return next(case for case in CASES if case.name == name and workload in case.workloads)


@pytest.fixture(scope="module")
def harness() -> Iterator[Harness]:
    """One platform for all cases: each must leave the arm usable for the next."""
    platform = Platform()
    try:
        platform.be_patient(HOLD_MS)
        platform.rtcp("start", "--detach")
        with harness_of(platform) as made:
            yield made
    finally:
        platform.end()


@pytest.mark.parametrize(("name", "workload"), PART)
def test_a_fault_has_the_reaction_of_the_matrix_and_the_arm_recovers(
    harness: Harness, name: str, workload: str
) -> None:
    records, torn = harness.records, harness.torn
    result, wrong = run_case(harness, case_of(name, workload), workload)
    assert not wrong, f"{wrong}\n{result}"
    harness.read_cycles()
    assert harness.records > records
    assert harness.torn == torn, "a cycle record was torn, or overwritten before it was read"


def test_every_kind_of_fault_is_in_the_matrix() -> None:
    from rtcp.virtual.faults import shape_setter
    from rtcp.virtual.faults.registry import installed, parse

    # The heater's faults need its segment: tests/processes/shape_setting and tests/e2e/test_heater.py cause them.
    ours = {
        name
        for name, kind in installed().items()
        if kind.__module__.startswith("rtcp.") and kind.__module__ != shape_setter.__name__
    }
    assert {fault["fault"] for case in CASES for fault in case.faults} == ours
    for case in CASES:
        for fault in case.faults:
            planned, findings = parse(dict(fault))
            assert planned is not None, (case.name, findings)
