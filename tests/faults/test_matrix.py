"""A part of the fault matrix, of which `make test` runs each kind of reaction; `make faults` runs all of it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rtcp.telemetry.harness import Harness
from rtcp.virtual.faults import shape_setter
from rtcp.virtual.faults.registry import installed, parse
from tests.e2e.conftest import Platform
from tests.faults.cases import CASES, HOLDING, JOGGING, JOYSTICK, MOVING, Case
from tests.faults.run import HOLD_MS, harness_of, run_case
from tests.leftovers import Leftovers

PART = (
    ("cable: slave 3 to 4", MOVING),
    ("falls and refuses OP", JOGGING),
    ("frames lost: 20 in a row", MOVING),
    ("emergency stop's input stuck at pressed", JOGGING),
)
MORE = (
    ("power: IO box (reference clock)", HOLDING),
    ("power: drive 3", JOGGING),
    ("working counter wrong: always", JOGGING),
    ("drive: over-current", MOVING),
    ("joystick out of code", JOYSTICK),
)
LONG = pytest.mark.long("test_a_fault_has_the_reaction_of_the_matrix_and_the_arm_recovers")
"""Of `MORE`: these differ from `PART` in the cause alone, and tests/control causes each in simulated time."""


def case_of(name: str, workload: str) -> Case:
    """The case of this name that has the workload."""
    return next(case for case in CASES if case.name == name and workload in case.workloads)


@pytest.fixture(scope="module")
def harness(leftovers: Leftovers) -> Iterator[Harness]:
    """One platform for all cases: each must leave the arm usable for the next."""
    platform = Platform()
    try:
        platform.be_patient(HOLD_MS)
        leftovers.shared.add(str(platform.directory))
        platform.rtcp("start", "--detach")
        with harness_of(platform) as made:
            yield made
    finally:
        platform.end()
        leftovers.shared.discard(str(platform.directory))


@pytest.mark.platform
@pytest.mark.parametrize(("name", "workload"), [*PART, *(pytest.param(*case, marks=LONG) for case in MORE)])
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
