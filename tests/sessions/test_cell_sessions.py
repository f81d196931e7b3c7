"""Random sessions of a cell of two arms: a correct cell passes, and the checks see what they are for."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

import pytest

from rtcp.ipc.commands import MoveJoints
from rtcp.ipc.states import State
from rtcp.testing.sessions.cell_session import CellSession
from rtcp.testing.sessions.checker import Kind
from rtcp.testing.sessions.run import run_session
from tests.samples import THOROUGH
from tests.sessions.reverted.sessions import a_cell

CELL, SEGMENTS = a_cell()
SESSIONS = 100 if THOROUGH else 2


@pytest.fixture
def session() -> Iterator[CellSession]:
    made = CellSession(Random(2), CELL, SEGMENTS)
    yield made
    made.close()


def kinds(session: CellSession) -> set[Kind]:
    return {violation.kind for arm in session.arms for violation in arm.commander.checker.violations}


@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", range(1, SESSIONS + 1))
def test_a_session_of_a_cell_passes_and_is_the_same_again(seed: int) -> None:
    first, again = (run_session(seed, CELL, 0.3, SEGMENTS) for _ in range(2))
    assert (first.outcome, first.violation) == ("passed", "")
    assert (again.cycles, again.commands, again.largest_step) == (first.cycles, first.commands, first.largest_step)


def test_arms_that_come_nearer_than_the_clearance_are_a_violation(session: CellSession) -> None:
    left, _ = session.arms
    while session.distance() > 0.0:
        for servo, sign in zip(left.commander.servos, session.towards(left), strict=True):
            servo.mechanics.position += 0.01 * sign
    session.simulation.run(0.5)
    assert Kind.PARTNER in kinds(session)


def test_an_arm_that_has_torque_after_a_partner_has_died_is_a_violation(session: CellSession) -> None:
    left, right = session.arms
    session.enable()
    assert right.state is State.HOLDING
    right.commander.simulation.loop.machine.partners = None  # it does not look at its partner
    session.kill(left)
    right.session.send(MoveJoints(tuple(right.session.commanded), 0.1, True))
    assert kinds(session) == {Kind.NOT_STOPPED}
