"""What the environment of a session does to the arm, and what it says about that."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from random import Random
from typing import Any

import pytest

from rtcp.ipc.commands import MoveJoints
from rtcp.ipc.states import State
from rtcp.testing.sessions.commander import Commander
from rtcp.testing.sessions.environment import Environment
from rtcp.testing.sessions.session import with_enabling_switch
from rtcp.testing.simulation import Frame
from tests.sessions.oracle import configuration, reading, with_start

START = [0.0, -0.5, 1.8, 0.0, 1.2, 0.0]
PERIOD_US = 4000
LONG_S = 2.0
"""Time after which nothing that the environment has begun still acts, s."""


@pytest.fixture
def commander() -> Iterator[Commander]:
    made = Commander(with_start(with_enabling_switch(configuration()), PERIOD_US, "csp"), 1, START, reading())
    made.enable()
    assert made.simulation.until(lambda: made.state is State.HOLDING, 1.0)
    made.simulation.run(0.5)
    yield made
    made.close()


def seeded(commander: Commander, seed: int) -> Environment:
    """Return the commander's environment with random numbers of a seed."""
    commander.environment._random = Random(seed)
    return commander.environment


def watched(commander: Commander, values: Callable[[], Any]) -> list[Any]:
    """Run for a while; return what `values` gave after each cycle."""
    found = []
    see = commander.simulation.on_frame
    assert see is not None

    def watch(frame: Frame) -> None:
        see(frame)
        found.append(values())

    commander.simulation.on_frame = watch
    commander.simulation.run(LONG_S)
    return found


def test_a_hand_pushes_for_a_while_and_lets_go(commander: Commander) -> None:
    mechanics = [servo.mechanics for servo in commander.servos]
    before = [each.external_torque for each in mechanics]
    environment = seeded(commander, 1)
    environment.hand()
    pushed = watched(commander, lambda: dict(environment.pushed))
    assert not pushed[0] or pushed[0] == pushed[1]
    ((axis, torque),) = max(pushed, key=len).items()
    assert 0.0 < abs(torque) <= 0.6 * commander.simulation.config.joints[axis].torque
    assert environment.idle
    assert [each.external_torque for each in mechanics] == pytest.approx(before, abs=0.05)
    assert commander.simulation.now_ns - environment.last_disturbed_ns < LONG_S * 1e9


def test_a_load_weighs_on_the_joints_until_it_is_taken_off(commander: Commander) -> None:
    shoulder = commander.servos[1].mechanics
    before = shoulder.external_torque
    commander.environment.carry(1.0)
    commander.simulation.run(0.1)
    assert commander.environment.payload_kg == 1.0
    assert abs(shoulder.external_torque - before) > 1.0
    commander.environment.carry(0.0)
    commander.simulation.run(0.1)
    assert (commander.environment.payload_kg, commander.environment.idle) == (0.0, True)
    assert shoulder.external_torque == pytest.approx(before, abs=0.05)


@pytest.mark.parametrize("begin", [Environment.falsify, Environment.freeze, Environment.delay])
def test_the_loop_gets_other_inputs_than_the_frames_show_and_then_the_true_ones(
    commander: Commander, begin: Callable[[Environment], None]
) -> None:
    simulation = commander.simulation
    slots = range(len(simulation.data.inputs))
    # Late values of a moving joint are others.
    assert commander.send(MoveJoints((0.3, -0.8, 1.5, 0.3, 0.9, 0.3), 0.03, True))
    differed = 0
    for seed in range(8):
        environment = seeded(commander, seed)
        began_ns = simulation.now_ns
        begin(environment)
        given = watched(commander, lambda: list(map(simulation.data.input, slots)) != simulation.data.inputs)
        differed += any(given)
        assert not given[-1]
        assert began_ns < environment.false_until_ns < simulation.now_ns
        assert environment.idle
    assert differed > 1


def test_frames_are_lost_in_bursts(commander: Commander) -> None:
    missed = commander.simulation.data.missed
    seeded(commander, 3).burst()
    commander.simulation.run(LONG_S)
    assert commander.simulation.data.missed - missed > 1
    assert commander.environment.idle


def test_the_enabling_switch_is_released_and_an_arm_without_one_is_left_alone(commander: Commander) -> None:
    loop = commander.simulation.loop
    assert loop.operator.permitted
    commander.switch(False)
    commander.simulation.run(0.1)
    assert (loop.operator.permitted, commander.environment.permitted) == (False, False)
    commander.switch(True)
    commander.simulation.run(0.1)
    assert loop.operator.permitted
    without = Commander(with_start(configuration(), PERIOD_US, "csp"), 1, START, reading())
    try:
        assert not without.environment.switch(False)
        assert without.environment.permitted
    finally:
        without.close()


def test_a_lasting_fault_prevents_the_reset_until_its_cause_has_ended(commander: Commander) -> None:
    environment = seeded(commander, 5)
    environment.lasting_fault()
    assert commander.simulation.until(lambda: commander.state is State.FAULT, 0.5)
    assert not environment.idle
    commander.simulation.run(LONG_S)
    assert environment.idle
    commander.enable()
    assert commander.simulation.until(lambda: commander.state in (State.READY, State.HOLDING), 3.0)


def test_a_configured_enabling_switch_stays_where_it_is() -> None:
    once = with_enabling_switch(configuration())
    switch = once.inputs.enabling_switch
    assert switch is not None
    assert switch.number not in (9, 10, *range(1, 7))
    assert with_enabling_switch(once) == once
    bare = replace(configuration(), inputs=replace(configuration().inputs, emergency_stop=None))
    assert with_enabling_switch(bare) == bare
