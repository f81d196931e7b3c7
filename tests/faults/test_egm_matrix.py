"""A part of the fault matrix of an arm behind a controller that speaks EGM; `make faults` runs all of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.virtual.irc5.controller import _FAULTS
from tests.faults import egm_wire
from tests.faults.cases import HOLDING, MOVING
from tests.faults.egm import CASES, LIMITS, Trials, run_case
from tests.leftovers import Leftovers
from tests.virtual.irc5.wire import sensor

PART = (
    ("messages to the PC: none", MOVING),
    ("Hand: enabling device released", MOVING),
    ("loop: killed", MOVING),
)
MORE = (
    ("controller: stopped for 2 s", MOVING),
    ("messages to the PC: 1 in 5 an old one", MOVING),
    ("replies: none", MOVING),
    ("replies: all twice", MOVING),
    ("emergency stop", MOVING),
    ("RAPID stopped", HOLDING),
    ("collision", MOVING),
    ("session begins anew", MOVING),
)
LONG = pytest.mark.long("test_a_fault_has_the_reaction_of_the_matrix_and_the_arm_recovers")
"""Of `MORE`: tests/fieldbus/test_egm.py has what the loop is shown after each, without a platform."""


@pytest.fixture(scope="module")
def trials(leftovers: Leftovers) -> Iterator[Trials]:
    """One platform for all cases: each must leave the arm usable for the next."""
    made = Trials()
    leftovers.shared.add(str(made.platform.directory))
    yield made
    made.close()
    leftovers.shared.discard(str(made.platform.directory))


@pytest.mark.platform
@pytest.mark.parametrize(("name", "workload"), [*PART, *(pytest.param(*case, marks=LONG) for case in MORE)])
def test_a_fault_has_the_reaction_of_the_matrix_and_the_arm_recovers(trials: Trials, name: str, workload: str) -> None:
    case = next(case for case in CASES if case.name == name and workload in case.workloads)
    result, wrong = run_case(trials, case, workload)
    assert not wrong, f"{wrong}\n{result}"


def test_every_fault_of_the_virtual_controller_is_in_the_matrix() -> None:
    assert {request["fault"] for case in CASES for request in case.requests if request["do"] == "fault"} == set(_FAULTS)


def test_a_reference_outside_the_limits_is_found(tmp_path: Path) -> None:
    at = [0.0] * 6
    sound = [(0, at, at), (4_032_000, [0.1] * 6, [20.0] * 6)]
    defects = {
        "position": (8_064_000, [LIMITS.high[0] + 0.1, *at[1:]], at),
        "speed": (8_064_000, at, [LIMITS.speed[0] + 0.1, *at[1:]]),
        "step": (8_064_000, [1.0, *at[1:]], [20.0, *at[1:]]),
    }
    for word, defect in ({"": None} | defects).items():
        tap = tmp_path / "tap"
        with tap.open("wb") as file:
            for seqno, (time_ns, position, speed) in enumerate([*sound, *([defect] if defect else [])]):
                payload = sensor(seqno, position, speed)
                file.write(egm_wire.HEAD.pack(time_ns, True, len(payload)) + payload)
        violations = egm_wire.check(tap, replace(LIMITS), 0.004032).violations
        assert violations.pop().startswith("3 replies to 0" if defect else "2 replies to 0")
        assert any(word in violation for violation in violations) if defect else violations == []
