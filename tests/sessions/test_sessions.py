"""Random sessions, some by fixed seeds and some that hypothesis draws: no frame breaks a limit, whatever is done."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtcp.ipc.commands import Halt, SetControlMode
from rtcp.ipc.states import ControlMode, State
from tests.samples import SLOW
from tests.sessions.driver import KINDS
from tests.sessions.session import Outcome, Session, run_session

SESSIONS, BATCH = (100, 20) if SLOW else (4, 2)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(1, SESSIONS + 1, BATCH))
def test_no_frame_of_a_random_session_breaks_a_limit(first: int) -> None:
    failures = [failure for seed in range(first, first + BATCH) for failure in run_session(seed).failures]
    assert failures == []


@pytest.mark.skipif(not SLOW, reason="30 sessions: with RTCP_SLOW=1")
@pytest.mark.timeout(900)
def test_the_sessions_visit_every_state_and_send_every_command() -> None:
    total = Outcome()
    for seed in range(1000, 1030):
        total.add(run_session(seed))
    assert total.failures == []
    assert set(State.__members__) - set(total.states) <= {"OFF", "HOMING"}
    given = set(total.taken) | set(total.refused)
    assert {command.name for command in KINDS} - given <= {"set_zero", "home"}


def test_plans_of_a_session_are_taken_and_move_the_arm() -> None:
    session = Session(Random(3))
    driver = session.driver
    try:
        driver.enable()
        for mode, begin in (ControlMode.JOINT, session.trajectory), (ControlMode.CARTESIAN, session.line):
            driver.send(SetControlMode(mode))
            for _ in range(20):
                begin()
                if driver.state is State.MOVING:
                    break
                driver.enable()
            driver.send(Halt())
            driver.wait(1000)
        assert {"run_trajectory", "run_lines"} <= set(driver.taken)
    finally:
        driver.close()


def test_a_session_is_the_same_each_time_it_runs() -> None:
    assert run_session(77) == run_session(77)


ACTIONS = len(Session(Random(1)).actions)


# A session that breaks a limit is made as short as it can be.
@settings(max_examples=60 if SLOW else 3, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 1000),
    steps=st.lists(st.tuples(st.integers(0, ACTIONS - 1), st.integers(0, 10_000)), min_size=1, max_size=20),
)
def test_no_frame_of_a_session_that_hypothesis_draws_breaks_a_limit(seed: int, steps: list[tuple[int, int]]) -> None:
    session = Session(Random(seed))
    driver = session.driver
    try:
        driver.enable()
        for action, number in steps:
            session.random.seed(number)
            session.actions[action][1]()
            driver.wait(50)
            assert driver.violations == [], "\n".join(driver.log[-20:])
    finally:
        driver.close()
