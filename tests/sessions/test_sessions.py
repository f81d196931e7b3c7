"""Random sessions, by fixed seeds and by hypothesis: no frame breaks a limit."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtcp.config.model import Cone
from rtcp.ipc.commands import Halt, SetControlMode
from rtcp.ipc.states import ControlMode, State
from rtcp.testing.sessions.coverage import PLATFORM_COMMANDS
from tests.samples import THOROUGH
from tests.sessions.oracle import configuration
from tests.sessions.session import Outcome, run_session, session_of

SESSIONS, BATCH = (100, 20) if THOROUGH else (2, 1)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(1, SESSIONS + 1, BATCH))
def test_no_frame_of_a_random_session_breaks_a_limit(first: int) -> None:
    failures = [failure for seed in range(first, first + BATCH) for failure in run_session(seed).failures]
    assert failures == []


@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(1, SESSIONS + 1, BATCH))
def test_no_frame_of_a_random_session_leads_the_tool_out_of_a_cone(first: int) -> None:
    shipped = configuration()
    cones = (Cone("away", (-1.0, 0.0, 0.0), 2.0), Cone("upright", (0.0, 0.0, 1.0), 1.7, "x"))
    config = replace(shipped, cartesian=replace(shipped.cartesian, cones=cones))
    failures = [failure for seed in range(first, first + BATCH) for failure in run_session(seed, config).failures]
    assert failures == []


@pytest.mark.long("test_no_frame_of_a_random_session_breaks_a_limit")
@pytest.mark.timeout(900)
def test_the_sessions_visit_every_state_and_send_every_command() -> None:
    total = Outcome()
    for seed in range(1000, 1030):
        total.add(run_session(seed))
    assert total.failures == []
    assert set(State.__members__) - set(total.states) <= {"OFF", "HOMING"}
    given = set(total.taken) | set(total.refused)
    assert {command.name for command in PLATFORM_COMMANDS} - given <= {"set_zero", "home"}


def test_plans_of_a_session_are_taken_and_move_the_arm() -> None:
    session = session_of(3)
    commander = session.commander
    try:
        commander.start()
        commander.enable()
        simulation = commander.simulation
        simulation.until(lambda: not simulation.loop.machine.changing_mode, 0.5)
        for mode, begin in (ControlMode.JOINT, session.trajectory), (ControlMode.CARTESIAN, session.line):
            commander.send(SetControlMode(mode))
            for _ in range(20):
                begin()
                if commander.state is State.MOVING:
                    break
                commander.enable()
            commander.send(Halt())
            commander.wait(1000)
        assert {"run_trajectory", "run_lines"} <= set(commander.taken)
    finally:
        commander.close()


ACTIONS = len(session_of(1).actions)


# Hypothesis shortens a session that breaks a limit.
@settings(max_examples=60 if THOROUGH else 3, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 1000),
    steps=st.lists(st.tuples(st.integers(0, ACTIONS - 1), st.integers(0, 10_000)), min_size=1, max_size=20),
)
def test_no_frame_of_a_session_that_hypothesis_draws_breaks_a_limit(seed: int, steps: list[tuple[int, int]]) -> None:
    session = session_of(seed)
    commander = session.commander
    try:
        commander.start()
        commander.enable()
        for action, number in steps:
            session.random.seed(number)
            session.actions[action][1]()
            commander.wait(50)
            assert commander.checker.violations == [], "\n".join(map(str, commander.log[-20:]))
    finally:
        commander.close()
