"""The checker finds nothing in a sound loop, and what is wrong in a broken one: one defect a check."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import pi

import pytest

from kinematics import forward
from rtcp.config.model import Cone
from rtcp.ipc.commands import Halt, MoveJoints, SetDriveMode
from rtcp.ipc.states import DriveMode, State
from rtcp.testing.sessions.checker import CSP, CST, CSV, ENABLE_OPERATION, Bounds, Kind, Violation, reading_of
from rtcp.testing.sessions.commander import Commander
from rtcp.testing.sessions.oracle import Shape
from tests.arm_geometry import depth, points
from tests.sessions.oracle import WIRE, commander_of, configuration, is_free, with_start

PERIOD_US = 1000
START = [0.5, 0.3, 0.9, 0.2, 0.4, 0.1]
AXIS, SLOT = 2, 3

Fields = tuple[int, int, int, int, int]
Defect = Callable[[Fields, int], Fields]
"""(controlword, position, velocity, torque, mode), cycles since the defect began -> what is sent instead."""


@contextmanager
def commander_in(mode: str) -> Iterator[Commander]:
    commander = commander_of(with_start(configuration(), PERIOD_US, mode), 1, START)
    try:
        yield commander
    finally:
        commander.close()


def spoil(commander: Commander, defect: Defect) -> None:
    """Let one joint's outputs be spoilt on their way from the loop to the bus from now on."""
    data, cycles = commander.simulation.data, [0]
    sound = data.set_output

    def spoilt(index: int, outputs: bytes) -> None:
        if index == SLOT:
            cycles[0] += 1
            outputs = WIRE.pack(*defect(WIRE.unpack(outputs), cycles[0]))
        sound(index, outputs)

    data.set_output = spoilt  # type: ignore[method-assign, assignment]


def first(commander: Commander) -> Violation:
    violation = commander.checker.violations[0]
    assert violation.joint == AXIS + 1
    return violation


def kinds(commander: Commander) -> set[Kind]:
    return {violation.kind for violation in commander.checker.violations}


def enable(commander: Commander) -> None:
    commander.enable()
    commander.simulation.bring_to(State.HOLDING, 2.0)
    commander.wait(100)


def move(commander: Commander, by: float = 0.5, speed: float = 0.4) -> None:
    assert commander.send(MoveJoints(tuple(q + by for q in START), speed, True))
    commander.wait(700)


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_a_sound_loop_has_no_violation(mode: str) -> None:
    with commander_in(mode) as commander:
        enable(commander)
        move(commander)
        commander.lose(3, heard=False)
        commander.wait(20)
        commander.lose(3, heard=True)
        commander.wait(20)
        commander.send(Halt())
        commander.wait(500)
        assert commander.checker.violations == []
        assert commander.checker.obeyed > 1000


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_an_enabling_that_brings_a_joint_back_into_its_range_has_no_violation(mode: str) -> None:
    config = with_start(configuration(), PERIOD_US, mode)
    commander = commander_of(config, 1, [*START[:5], config.joints[5].position.max + 0.018])
    try:
        enable(commander)
        assert commander.checker.violations == []
        assert commander.checker.obeyed > 400
    finally:
        commander.close()


def test_a_target_beyond_the_joints_range_is_found() -> None:
    with commander_in("csp") as commander:
        enable(commander)
        commander.bounds.high[AXIS] = START[AXIS] + 0.1
        move(commander)
        assert first(commander).kind is Kind.RANGE


@pytest.mark.parametrize("stop", ["press", "fall_silent", "halt"])
def test_an_arm_that_goes_on_after_what_stops_it_is_found(stop: str) -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        return ENABLE_OPERATION, sent[1] + 3 * cycle, *sent[2:]

    with commander_in("csp") as commander:
        enable(commander)
        spoil(commander, defect)
        stops: dict[str, Callable[[], object]] = {
            "press": lambda: commander.press(True), "halt": lambda: commander.send(Halt()),
            "fall_silent": commander.fall_silent,
        }  # fmt: skip
        stops[stop]()
        commander.wait(700)
        assert Kind.NOT_STOPPED not in kinds(commander)
        commander.checker.violations.clear()
        commander.wait(700)
        assert Kind.NOT_STOPPED in kinds(commander)


def test_an_arm_that_stops_has_stopped() -> None:
    with commander_in("csp") as commander:
        enable(commander)
        stops: list[Callable[[], object]] = [
            commander.fall_silent, lambda: commander.send(Halt()), lambda: commander.press(True)
        ]  # fmt: skip
        for stop in stops:
            commander.acquire()
            assert commander.send(MoveJoints(tuple(q + 0.5 for q in commander.commanded), 0.1, True))
            commander.wait(300)
            stop()
            commander.wait(1500)
        assert commander.checker.violations == []


def test_a_drive_in_a_mode_that_nobody_checks_is_found() -> None:
    with commander_in("csp") as commander:
        enable(commander)
        spoil(commander, lambda sent, cycle: (*sent[:4], 1))
        commander.wait(3)
        assert first(commander).kind is Kind.MODE


def test_a_speed_that_a_single_step_hides_in_its_rounding_is_found() -> None:
    limit = round(configuration().joints[AXIS].velocity * PERIOD_US * 1e-6 * 1e4)

    def defect(sent: Fields, cycle: int) -> Fields:
        # Faster by a count a cycle, at last by one more than the limit has.
        return 0x1F, sent[1] + sum(min(n // 4, limit + 1) for n in range(cycle)), *sent[2:]

    with commander_in("csp") as commander:
        # The drive gives all its torque, which is no emergency stop here.
        arm = commander.simulation.loop.arm
        arm.limits.supervision = (1.5, 1.5, 1.0)
        arm.supervision.take(arm.limits)
        enable(commander)
        spoil(commander, defect)
        commander.wait(4 * limit + 40)
        assert first(commander).kind is Kind.ACCELERATION
        commander.checker.violations.clear()
        commander.wait(10)
        assert kinds(commander) == {Kind.VELOCITY}


def test_limits_that_are_changed_are_those_of_the_check() -> None:
    half_of_the_old = round(0.5 * configuration().joints[AXIS].velocity * PERIOD_US * 1e-6 * 1e4)

    def defect(sent: Fields, cycle: int) -> Fields:
        return sent[0], sent[1] + half_of_the_old * cycle, *sent[2:]

    with commander_in("csp") as commander:
        enable(commander)
        assert commander.set_limits(
            replace(commander.limits, velocity=tuple(0.1 * v for v in commander.limits.velocity))
        )
        commander.wait(3)
        spoil(commander, defect)
        commander.wait(10)
        assert Kind.STEP in kinds(commander)


@pytest.mark.parametrize("counts", [7, -7, 2_000_000_000])
def test_a_step_beyond_speed_times_cycle_is_found(counts: int) -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        return sent[0], sent[1] + (counts if cycle > 3 else 0), *sent[2:]

    with commander_in("csp") as commander:
        enable(commander)
        spoil(commander, defect)
        commander.wait(10)
        assert Kind.STEP in kinds(commander)


def test_a_motion_that_ends_without_slowing_down_is_found() -> None:
    held: list[int] = []

    def defect(sent: Fields, cycle: int) -> Fields:
        held.append(sent[1])
        return sent[0], held[0], *sent[2:]

    with commander_in("csp") as commander:
        enable(commander)
        move(commander)
        assert commander.checker.violations == []
        spoil(commander, defect)
        commander.wait(40)
        assert first(commander).kind is Kind.ACCELERATION


def test_an_acceleration_of_one_and_a_half_times_its_bound_is_found() -> None:
    bound = configuration().joints[AXIS].acceleration

    def defect(sent: Fields, cycle: int) -> Fields:
        seconds = cycle * PERIOD_US * 1e-6
        return sent[0], sent[1] + round(0.5 * 1.5 * bound * seconds * seconds * 1e4), *sent[2:]

    with commander_in("csp") as commander:
        enable(commander)
        spoil(commander, defect)
        commander.wait(150)
        assert first(commander).kind is Kind.ACCELERATION


def test_a_first_target_that_is_not_where_the_joint_stands_is_found() -> None:
    with commander_in("csp") as commander:
        spoil(commander, lambda sent, cycle: (sent[0], sent[1] + 20, *sent[2:]))
        enable(commander)
        assert first(commander).kind is Kind.FIRST_TARGET


def test_a_target_that_goes_on_while_the_drive_hears_nothing_is_found() -> None:
    with commander_in("csp") as commander:
        enable(commander)
        move(commander)
        # The loop believes that its frames were answered.
        simulation = commander.simulation
        simulation.data.lose(8, heard=False)
        expected = simulation.data.expected_wkc
        sound = simulation.data.receive
        simulation.data.receive = lambda: (sound(), expected)[1]  # type: ignore[method-assign]
        commander.wait(20)
        assert Kind.RECEIVED_STEP in kinds(commander)


@pytest.mark.parametrize(
    ("mode", "what", "kind"),
    [("csv", 2, Kind.VELOCITY), ("cst", 3, Kind.TORQUE)],
)
def test_a_velocity_or_torque_beyond_its_bound_is_found(mode: str, what: int, kind: Kind) -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        changed = list(sent)
        changed[what] = 600_000 if sent[0] == ENABLE_OPERATION else sent[what]
        return tuple(changed)  # type: ignore[return-value]

    with commander_in(mode) as commander:
        enable(commander)
        assert commander.checker.violations == []
        spoil(commander, defect)
        commander.wait(5)
        assert (first(commander).kind, first(commander).found) == (kind, pytest.approx(60.0))


def test_a_velocity_that_changes_faster_than_the_acceleration_allows_is_found() -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        return *sent[:2], sent[2] + (500 if cycle > 3 else 0), *sent[3:]

    with commander_in("csv") as commander:
        enable(commander)
        spoil(commander, defect)
        commander.wait(5)
        assert first(commander).kind is Kind.VELOCITY_STEP


def test_a_set_point_that_jumps_on_the_change_of_the_mode_is_found() -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        return sent[0], sent[1] + (50 if sent[4] == CSP else 0), *sent[2:]

    with commander_in("csp") as commander:
        enable(commander)
        for wanted in (CST, CSP):
            if wanted == CSP:
                spoil(commander, defect)
            assert commander.send(SetDriveMode(DriveMode(wanted)))
            commander.wait(100)
        assert first(commander).kind is Kind.MODE_STEP


@pytest.mark.parametrize("mode", [CSP, CSV])
@pytest.mark.parametrize(("point", "ahead"), [(0, 0.4), (2, 0.3)])
def test_a_body_of_the_arm_in_a_keep_out_box_is_found(mode: int, point: int, ahead: float) -> None:
    with commander_in({CSP: "csp", CSV: "csv"}[mode]) as commander:
        enable(commander)
        there = points([q + ahead for q in START])[point]
        x, y, z = there
        commander.bounds.keep_out += ((x - 0.02, y - 0.02, z - 0.02, x + 0.02, y + 0.02, z + 0.02),)
        assert is_free(commander.bounds, START)
        commander.checker.changed()
        move(commander, 0.3)
        commander.wait(700)
        assert Kind.ZONE in kinds(commander)


def test_a_tool_that_leaves_the_box_is_found() -> None:
    with commander_in("csp") as commander:
        enable(commander)
        there = points(START)[0]
        x, y, z = there
        commander.bounds.box = (x - 0.05, y - 0.05, z - 0.05, x + 0.05, y + 0.05, z + 0.05)
        commander.checker.changed()
        move(commander, 0.3)
        assert Kind.ZONE in kinds(commander)


def test_a_tool_that_turns_out_of_its_cone_is_found() -> None:
    config = configuration()
    shape = Shape(config.models, 0, config.cartesian.clearance)
    here, there = (shape.tilt(q, 2, (0.0, 0.0, 1.0)) for q in (START, [q + 0.3 for q in START]))
    sign = 1.0 if there > here else -1.0
    cone = Cone("up", (0.0, 0.0, sign), (here if sign > 0.0 else pi - here) + 0.5 * abs(there - here))
    around = reading_of(replace(config, cartesian=replace(config.cartesian, cones=(cone,)))).workspaces[0]
    assert around is not None
    bounds = replace(Bounds.configured(config), box=None, keep_out=(), cones=(cone.angle,))
    assert around.deepest(bounds, START) < 0.0 < around.deepest(bounds, [q + 0.3 for q in START])


# -- its own geometry -----------------------------------------------------------------------------------------------


def test_its_geometry_is_that_of_the_facts() -> None:
    assert points([0.0] * 6)[0] == pytest.approx((0.0, 0.0, 1.300))
    assert points([0.0, 0.0, pi / 2, 0.0, 0.0, 0.0])[0] == pytest.approx((-0.690, 0.0, 0.610))


def test_its_geometry_is_that_of_the_platform() -> None:
    arm = configuration().arm
    assert arm is not None
    pose = forward(arm, START)
    assert points(START)[0] == pytest.approx(tuple(pose.position))


def test_the_depth_in_a_box_is_the_way_to_its_nearest_face() -> None:
    box = (0.0, 0.0, 0.0, 1.0, 2.0, 3.0)
    assert depth((0.1, 1.0, 1.0), box) == pytest.approx(0.1)
    assert depth((1.5, 1.0, 1.0), box) == pytest.approx(-0.5)
