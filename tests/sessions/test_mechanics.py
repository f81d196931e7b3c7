"""The checker of the mechanics finds nothing in a sound loop, and each thing that a joint itself does wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from kinematics import forward
from rtcp.config.model import ControlModeName
from rtcp.ipc.commands import ApplyTorque, Halt, MoveJoints
from rtcp.ipc.events import Arrived
from rtcp.ipc.states import State
from rtcp.testing.sessions.checker import Kind
from rtcp.testing.sessions.commander import Commander
from rtcp.testing.sessions.mechanics import REST_S, REST_WHERE_COMPLIANT_S, SETTLED_S, MechanicsChecker
from tests.sessions.oracle import commander_of, configuration, with_start
from tests.sessions.test_frame_checker import AXIS, START, kinds, spoil

PERIOD_US = 2000


@contextmanager
def holding(mode: str, control_mode: ControlModeName = "joint") -> Iterator[Commander]:
    config = replace(with_start(configuration(), PERIOD_US, mode), control_mode=control_mode)
    commander = commander_of(config, 1, START)
    try:
        commander.enable()
        commander.simulation.bring_to(State.HOLDING, 2.0)
        seconds(commander, 2.0 * SETTLED_S)
        yield commander
    finally:
        commander.close()


def seconds(commander: Commander, time_s: float) -> None:
    commander.wait(round(time_s * 1e6 / PERIOD_US))


def move(commander: Commander, by: float = 0.4) -> None:
    assert commander.send(MoveJoints(tuple(q + by for q in START), 0.4, True))


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_a_sound_loop_has_no_violation(mode: str) -> None:
    with holding(mode) as commander:
        move(commander)
        commander.simulation.bring_to(State.HOLDING, 5.0)
        commander.push(AXIS, 15.0)
        seconds(commander, 0.2)
        commander.push(AXIS, 0.0)
        seconds(commander, 0.5)
        move(commander, 0.0)
        seconds(commander, 0.4)
        for heard in (True, False):
            commander.lose(5, heard)
            seconds(commander, 0.1)
        commander.send(Halt())
        seconds(commander, 2.0 + REST_WHERE_COMPLIANT_S)
        assert commander.checker.violations == []


def test_a_torque_motion_that_a_hand_helps_has_no_violation() -> None:
    with holding("cst", "torque") as commander:
        for torque in (4.0, 0.0):
            assert commander.send(ApplyTorque((0.0, 0.0, torque, 0.0, 0.0, 0.0), 0.0, 0.2, 0.5))
            commander.push(1, -torque)
            seconds(commander, 0.4)
        assert max(abs(servo.mechanics.velocity) for servo in commander.servos) > 0.0
        assert commander.checker.violations == []


def test_a_joint_that_is_faster_than_its_limit_is_found() -> None:
    with holding("csp") as commander:
        move(commander)
        seconds(commander, 0.4)
        commander.bounds.velocity[AXIS] = 0.2
        commander.checker.changed()
        seconds(commander, 0.02)
        assert Kind.TRUE_SPEED in kinds(commander)


def test_a_joint_that_is_accelerated_beyond_its_limit_is_found() -> None:
    with holding("csp") as commander:
        move(commander)
        commander.bounds.acceleration[AXIS] = 0.1
        seconds(commander, 0.3)
        assert Kind.TRUE_ACCELERATION in kinds(commander)


def test_a_joint_that_is_driven_faster_without_a_command_is_found() -> None:
    with holding("csp") as commander:
        seconds(commander, 2.0 * SETTLED_S)
        commander.servos[1].mechanics.velocity = 0.3
        commander.wait(1)
        assert Kind.ENERGY in kinds(commander)


@pytest.mark.parametrize("helped", [True, False])
def test_a_torque_motion_that_nobody_drives_and_that_gains_speed_is_found(helped: bool) -> None:
    """The weight of a load that is carried with the wrong torque grows slower than a hand begins to push."""
    with holding("cst", "torque") as commander:
        assert commander.send(ApplyTorque((0.0,) * 6, 0.0, 0.0, 1.0))
        for _ in range(200):
            commander.servos[AXIS].mechanics.external_torque += 0.1
            if helped:
                commander.environment.pushed[AXIS] = commander.environment.pushed.get(AXIS, 0.0) + 0.1
            commander.wait(1)
        assert commander.servos[AXIS].mechanics.velocity > 0.1
        assert (Kind.ENERGY in kinds(commander)) is not helped


def test_a_joint_that_creeps_where_nothing_moves_is_found() -> None:
    commander = commander_of(with_start(configuration(), PERIOD_US, "csp"), 1, START)
    try:
        assert commander.state is State.READY
        seconds(commander, SETTLED_S + REST_S)
        for _ in range(100):
            commander.servos[AXIS].mechanics.position += 1e-4
            commander.wait(1)
        assert kinds(commander) == {Kind.MOVED}
    finally:
        commander.close()


@pytest.mark.parametrize("stop", ["halt", "switch"])
def test_a_joint_that_still_moves_after_a_stop_is_found(stop: str) -> None:
    with holding("csp") as commander:
        move(commander, 0.8)
        if stop == "halt":
            commander.checker.rest_from_ns = commander.simulation.now_ns
        else:
            commander.environment.permitted = False
        seconds(commander, 1.8)
        assert commander.state is State.MOVING
        assert Kind.NOT_AT_REST in kinds(commander)


def test_a_motion_that_is_accepted_without_the_enabling_switch_is_found() -> None:
    with holding("csp") as commander:
        commander.environment.permitted = False
        seconds(commander, 0.2)
        move(commander, 0.0)
        assert kinds(commander) == {Kind.NOT_PERMITTED}


def test_a_motion_that_is_called_complete_elsewhere_is_found() -> None:
    with holding("csp") as commander:
        move(commander)
        seconds(commander, 0.4)
        commander.mechanics.event(Arrived(), commander.simulation.now_ns)
        assert kinds(commander) == {Kind.NOT_ARRIVED}


def test_a_step_of_the_target_torque_is_found() -> None:
    with holding("cst") as commander:
        spoil(commander, lambda sent, cycle: (*sent[:3], sent[3] + (60_000 if cycle == 3 else 0), sent[4]))
        seconds(commander, 0.02)
        assert commander.checker.violations[0].kind is Kind.TORQUE_STEP
        assert commander.checker.violations[0].joint == AXIS + 1


@pytest.mark.parametrize("lost", [3, 12])
def test_frames_that_are_lost_without_a_fault_are_found(lost: int) -> None:
    with holding("csp") as commander:
        config = commander.simulation.config
        few = replace(config, bus=replace(config.bus, lost_cycles=8))
        commander.mechanics = MechanicsChecker(commander.checker, few, commander.servos)
        commander.lose(lost, heard=False)
        commander.wait(lost + 2)
        assert kinds(commander) == ({Kind.LOST_FRAMES} if lost > 10 else set())


def test_a_body_that_is_pushed_into_a_box_in_torque_mode_is_found() -> None:
    with holding("cst", "torque") as commander:
        assert commander.send(ApplyTorque((0.0,) * 6, 0.0, 0.0, 1.0))
        seconds(commander, 0.1)
        x, y, z = forward(configuration().arm, START).position
        # Of the checker alone: the loop has the boxes of the configuration.
        commander.bounds.keep_out = ((x - 0.05, y - 0.05, z - 0.05, x + 0.05, y + 0.05, z + 0.05),)
        seconds(commander, 0.5)
        assert Kind.BODY in kinds(commander)
