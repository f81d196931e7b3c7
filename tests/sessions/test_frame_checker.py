"""The checker finds nothing in a sound loop, and what is wrong in a broken one: one defect a check."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import pi

import pytest

from kinematics import forward
from rtcp.ipc.commands import Halt, MoveJoints, SetDriveMode
from rtcp.ipc.states import DriveMode, State
from tests.arm_geometry import depth, points
from tests.sessions.driver import Driver, configuration, is_free, with_start
from tests.sessions.frame_checker import CSP, CST, CSV, ENABLE_OPERATION, WIRE

PERIOD_US = 1000
START = [0.5, 0.3, 0.9, 0.2, 0.4, 0.1]
AXIS, SLOT = 2, 3

Fields = tuple[int, int, int, int, int]
Defect = Callable[[Fields, int], Fields]
"""(controlword, position, velocity, torque, mode), cycles since the defect began -> what is sent instead."""


@contextmanager
def driver_in(mode: str) -> Iterator[Driver]:
    driver = Driver(with_start(configuration(), PERIOD_US, mode), 1, START)
    try:
        yield driver
    finally:
        driver.close()


def spoil(driver: Driver, defect: Defect) -> None:
    """Let one joint's outputs be spoilt on their way from the loop to the bus from now on."""
    data, cycles = driver.simulation.data, [0]
    sound = data.set_output

    def spoilt(index: int, outputs: bytes) -> None:
        if index == SLOT:
            cycles[0] += 1
            outputs = WIRE.pack(*defect(WIRE.unpack(outputs), cycles[0]))
        sound(index, outputs)

    data.set_output = spoilt  # type: ignore[method-assign]


def enable(driver: Driver) -> None:
    driver.enable()
    assert driver.simulation.until(lambda: driver.state is State.HOLDING, 2.0)
    driver.wait(100)


def move(driver: Driver, by: float = 0.5, speed: float = 0.4) -> None:
    assert driver.send(MoveJoints(tuple(q + by for q in START), speed, True))
    driver.wait(700)


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_a_sound_loop_has_no_violation(mode: str) -> None:
    with driver_in(mode) as driver:
        enable(driver)
        move(driver)
        driver.lose(3, heard=False)
        driver.wait(20)
        driver.lose(3, heard=True)
        driver.wait(20)
        driver.send(Halt())
        driver.wait(500)
        assert driver.violations == []
        assert driver.checker.obeyed > 1000


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_an_enabling_that_brings_a_joint_back_into_its_range_has_no_violation(mode: str) -> None:
    config = with_start(configuration(), PERIOD_US, mode)
    driver = Driver(config, 1, [*START[:5], config.joints[5].position.max + 0.018])
    try:
        enable(driver)
        assert driver.violations == []
        assert driver.checker.obeyed > 400
    finally:
        driver.close()


def test_a_target_beyond_the_joints_range_is_found() -> None:
    with driver_in("csp") as driver:
        enable(driver)
        driver.bounds.high[AXIS] = START[AXIS] + 0.1
        move(driver)
        assert "joint 3: target" in driver.violations[0]
        assert "outside" in driver.violations[0]


@pytest.mark.parametrize("counts", [7, -7, 2_000_000_000])
def test_a_step_beyond_speed_times_cycle_is_found(counts: int) -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        return sent[0], sent[1] + (counts if cycle > 3 else 0), *sent[2:]

    with driver_in("csp") as driver:
        enable(driver)
        spoil(driver, defect)
        driver.wait(10)
        assert any("joint 3: step of" in violation for violation in driver.violations)


def test_a_motion_that_ends_without_slowing_down_is_found() -> None:
    held: list[int] = []

    def defect(sent: Fields, cycle: int) -> Fields:
        held.append(sent[1])
        return sent[0], held[0], *sent[2:]

    with driver_in("csp") as driver:
        enable(driver)
        move(driver)
        assert driver.violations == []
        spoil(driver, defect)
        driver.wait(40)
        assert "counts from straight" in driver.violations[0]


def test_an_acceleration_of_one_and_a_half_times_its_bound_is_found() -> None:
    bound = configuration().joints[AXIS].acceleration

    def defect(sent: Fields, cycle: int) -> Fields:
        seconds = cycle * PERIOD_US * 1e-6
        return sent[0], sent[1] + round(0.5 * 1.5 * bound * seconds * seconds * 1e4), *sent[2:]

    with driver_in("csp") as driver:
        enable(driver)
        spoil(driver, defect)
        driver.wait(150)
        assert "counts from straight" in driver.violations[0]


def test_a_first_target_that_is_not_where_the_joint_stands_is_found() -> None:
    with driver_in("csp") as driver:
        spoil(driver, lambda sent, cycle: (sent[0], sent[1] + 20, *sent[2:]))
        enable(driver)
        assert "joint 3: first target" in driver.violations[0]


def test_a_target_that_goes_on_while_the_drive_hears_nothing_is_found() -> None:
    with driver_in("csp") as driver:
        enable(driver)
        move(driver)
        # The loop believes that its frames were answered.
        simulation = driver.simulation
        simulation.data.lose(8, heard=False)
        expected = simulation.data.expected_wkc
        sound = simulation.data.receive
        simulation.data.receive = lambda: (sound(), expected)[1]  # type: ignore[method-assign]
        driver.wait(20)
        assert any("and heard" in violation for violation in driver.violations)


@pytest.mark.parametrize(
    ("mode", "what", "said"),
    [("csv", 2, "target velocity"), ("cst", 3, "target torque")],
)
def test_a_velocity_or_torque_beyond_its_bound_is_found(mode: str, what: int, said: str) -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        changed = list(sent)
        changed[what] = 600_000 if sent[0] == ENABLE_OPERATION else sent[what]
        return tuple(changed)  # type: ignore[return-value]

    with driver_in(mode) as driver:
        enable(driver)
        assert driver.violations == []
        spoil(driver, defect)
        driver.wait(5)
        assert f"joint 3: {said} 600000" in driver.violations[0]


def test_a_velocity_that_changes_faster_than_the_acceleration_allows_is_found() -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        return *sent[:2], sent[2] + (500 if cycle > 3 else 0), *sent[3:]  # type: ignore[return-value]

    with driver_in("csv") as driver:
        enable(driver)
        spoil(driver, defect)
        driver.wait(5)
        assert "joint 3: target velocity changes by" in driver.violations[0]


def test_a_set_point_that_jumps_on_the_change_of_the_mode_is_found() -> None:
    def defect(sent: Fields, cycle: int) -> Fields:
        return sent[0], sent[1] + (50 if sent[4] == CSP else 0), *sent[2:]

    with driver_in("csp") as driver:
        enable(driver)
        for wanted in (CST, CSP):
            if wanted == CSP:
                spoil(driver, defect)
            assert driver.send(SetDriveMode(DriveMode(wanted)))
            driver.wait(100)
        assert "after the change of mode" in driver.violations[0]


@pytest.mark.parametrize("mode", [CSP, CSV])
@pytest.mark.parametrize(("point", "ahead"), [(0, 0.4), (2, 0.3)])
def test_a_body_of_the_arm_in_a_keep_out_box_is_found(mode: int, point: int, ahead: float) -> None:
    with driver_in({CSP: "csp", CSV: "csv"}[mode]) as driver:
        enable(driver)
        there = points([q + ahead for q in START])[point]
        driver.bounds.keep_out.append((*(x - 0.02 for x in there), *(x + 0.02 for x in there)))
        assert is_free(driver.bounds, START)
        driver.checker.changed()
        move(driver, 0.3)
        driver.wait(700)
        assert any("keep-out box" in violation for violation in driver.violations)


def test_a_tool_that_leaves_the_box_is_found() -> None:
    with driver_in("csp") as driver:
        enable(driver)
        there = points(START)[0]
        driver.bounds.box = (*(x - 0.05 for x in there), *(x + 0.05 for x in there))
        driver.checker.changed()
        move(driver, 0.3)
        assert any("outside the box" in violation for violation in driver.violations)


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
