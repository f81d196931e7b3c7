"""The mode `trajectory`: continuous, inside the limits, cancelled without a jump."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcp.config.model import Point
from rtcp.ipc.commands import RunTrajectory
from rtcp.ipc.events import PlanDamaged
from rtcp.ipc.refusals import DamagedRow, PlanStartsElsewhere, PlanStartsMoving
from rtcp.motion.controllers.trajectory import TrajectoryController
from rtcp.motion.planning.plan import COLUMNS, KIND, VELOCITIES, PlanRefused
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.motion.state import ArmState, Phase
from tests.samples import examples

from .conftest import Drive, Rows, memory, near

PERIOD = 0.0005
ZERO = (0.0,) * 6
A, B, C = (0.3, 0.2, 0.5, 0.1, 0.2, -0.3), (0.5, 0.4, 0.9, 0.1, 0.5, -0.3), (0.2, -0.1, 0.4, 0.3, 0.1, 0.1)


@pytest.fixture
def mode(drive: Drive) -> TrajectoryController:
    made: TrajectoryController = drive.controller(TrajectoryController)
    return made


@pytest.fixture
def rows(drive: Drive) -> Rows:
    def planned(points: list[Point], q: Sequence[float] = ZERO) -> tuple[memoryview[float], int]:
        plan = plan_trajectory(points, drive.limits, q)
        return memory(plan.rows), len(plan.rows)

    return planned


def test_every_point_is_passed_at_its_time(drive: Drive, mode: TrajectoryController, rows: Rows) -> None:
    assert drive.execute(mode, *rows([Point(0.0, ZERO), Point(2.0, A), Point(4.0, B), Point(6.0, C)])) is None
    assert (mode.duration_s, mode.tolerates_saturation, mode.phase) == (6.0, False, Phase.MOVE)
    assert drive.until_rest(mode) == pytest.approx(6.0, abs=2 * PERIOD)
    for time, point in ((2.0, A), (4.0, B), (6.0, C)):
        assert drive.path[round(time / PERIOD) - 1] == pytest.approx(point, abs=1e-6)
    assert mode.elapsed_s == pytest.approx(6.0)
    assert mode.ended is None


def test_points_with_velocities_are_joined_by_cubics(drive: Drive, mode: TrajectoryController, rows: Rows) -> None:
    speed = (0.1,) * 6
    points = [Point(0.0, ZERO, ZERO), Point(2.0, (0.1,) * 6, speed), Point(4.0, (0.2,) * 6, ZERO)]
    drive.execute(mode, *rows(points))
    # The Hermite cubic 3 d x^2 - 2 d x^3 + T v (x^3 - x^2) half way.
    drive.run(mode, 2000)
    assert drive.state.commanded[0] == pytest.approx(0.1 * (0.75 - 0.25) - 2.0 * 0.1 * 0.125)
    drive.run(mode, 2000)
    assert drive.state.commanded_velocity == pytest.approx(speed)
    drive.until_rest(mode)


def test_points_with_accelerations_are_joined_by_quintics(drive: Drive, mode: TrajectoryController, rows: Rows) -> None:
    points = [Point(0.0, ZERO, ZERO, ZERO), Point(2.0, (0.2,) * 6, ZERO, ZERO)]
    drive.execute(mode, *rows(points))
    drive.run(mode, 1000)
    x = 0.25
    assert drive.state.commanded[3] == pytest.approx(0.2 * x**3 * (10 - 15 * x + 6 * x * x))


def test_a_first_piece_leads_to_a_first_point_that_is_later(
    drive: Drive, mode: TrajectoryController, rows: Rows
) -> None:
    assert drive.execute(mode, *rows([Point(2.0, A), Point(4.0, B)])) is None
    drive.run(mode, 4000)
    assert drive.state.commanded == pytest.approx(A, abs=1e-6)
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(B, abs=1e-9)


def test_a_small_rest_at_the_start_fades_out_without_a_jump(
    drive: Drive, mode: TrajectoryController, rows: Rows
) -> None:
    plan = rows([Point(0.0, ZERO), Point(3.0, A)])
    drive.at([9e-4, -9e-4, 0.0, 5e-4, 0.0, 9e-4])
    assert drive.execute(mode, *plan) is None
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(A, abs=1e-9)


@pytest.mark.parametrize(("axis", "off"), [(0, 1.1e-3), (5, -0.5)])
def test_a_plan_that_begins_elsewhere_is_refused_and_what_runs_goes_on(
    drive: Drive, mode: TrajectoryController, rows: Rows, axis: int, off: float
) -> None:
    plan = rows([Point(0.0, ZERO), Point(3.0, A)])
    drive.execute(mode, *plan)
    drive.state.commanded[axis] += off
    refused = drive.execute(mode, *plan)
    assert refused == PlanStartsElsewhere(axis, 0.0, off)
    drive.state.commanded[axis] -= off
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(A, abs=1e-9)


def test_a_plan_at_time_0_is_refused_in_motion(drive: Drive, mode: TrajectoryController, rows: Rows) -> None:
    plan = rows([Point(0.0, ZERO), Point(3.0, A)])
    drive.state.commanded_velocity[2] = 0.1
    refused = drive.execute(mode, *plan)
    assert refused == PlanStartsMoving(2, 0.0, 0.1)


@pytest.mark.parametrize("after_s", [0.0005, 0.2, 0.9, 1.5, 2.0, 2.7, 3.9, 3.9995])
def test_a_stop_brakes_along_the_path(drive: Drive, mode: TrajectoryController, rows: Rows, after_s: float) -> None:
    plan = rows([Point(0.0, ZERO), Point(2.0, A), Point(4.0, B)])
    drive.execute(mode, *plan)
    drive.run(mode, round(after_s / PERIOD))
    whole = drive.controller(TrajectoryController)
    whole.accept(RunTrajectory(0, plan[1]), ArmState(6), continues=False)
    mode.stop(drive.state)
    assert mode.phase is not Phase.MOVE
    took = drive.until_rest(mode)
    assert took < 1.0
    # Where it stands the undisturbed motion passes too.
    whole._go_to(mode.elapsed_s)
    assert drive.state.commanded == pytest.approx(whole._position, abs=1e-9)
    mode.stop(drive.state)
    assert mode.phase is Phase.HOLD


def test_a_stop_uses_what_the_joints_accelerations_allow(drive: Drive, mode: TrajectoryController, rows: Rows) -> None:
    drive.execute(mode, *rows([Point(0.0, ZERO), Point(2.0, (0.4,) * 6)]))
    drive.run(mode, 2000)
    speed = drive.state.commanded_velocity[0]
    mode.stop(drive.state)
    # Down with a, and a ramp of a / j before and after.
    assert drive.until_rest(mode) < speed / 2.0 + 2.0 * 2.0 / 20.0 + 0.05


@settings(max_examples=examples(25))
@given(st.integers(0, 10**6))
def test_plans_that_interrupt_each_other_never_jump(new_drive: Callable[..., Drive], seed: int) -> None:
    chance, drive = random.Random(seed), new_drive()
    mode = drive.controller(TrajectoryController)
    for _ in range(4):
        points, time = [], chance.uniform(0.5, 3.0)
        for _ in range(chance.randint(1, 4)):
            points.append(Point(time, tuple(chance.uniform(-1.0, 1.0) for _ in range(6))))
            time += chance.uniform(0.5, 4.0)
        try:
            plan = plan_trajectory(points, drive.limits, drive.state.commanded)
        except PlanRefused:
            continue
        drive.execute(mode, memory(plan.rows), len(plan.rows))
        drive.run(mode, chance.randint(1, 4000))
        if chance.random() < 0.5:
            mode.stop(drive.state)
            drive.run(mode, chance.randint(1, 400))
    mode.stop(drive.state)
    drive.until_rest(mode)


DAMAGES = [
    (0, math.nan),
    (0, 1.0),
    (0, math.inf),
    (0, -1.0),
    (3, math.nan),
    (4, 99.0),
    (VELOCITIES + 2, 5.0),
    (KIND, 4.0),
]


@pytest.mark.parametrize(("column", "value"), DAMAGES)
def test_a_waypoint_that_is_damaged_ends_the_motion_in_a_stop(
    drive: Drive, mode: TrajectoryController, rows: Rows, column: int, value: float
) -> None:
    plan, count = rows([Point(0.0, ZERO), Point(2.0, A), Point(4.0, B), Point(6.0, C)])
    drive.execute(mode, plan, count)
    drive.run(mode, 3000)
    plan[2 * COLUMNS + column] = value
    drive.until_rest(mode)
    assert isinstance(mode.ended, PlanDamaged)
    assert mode.ended.row == 2
    assert mode.elapsed_s < 2.1


@pytest.mark.parametrize(("column", "value"), [(0, math.nan), (0, -1.0), (5, math.inf), (5, 9.0), (KIND, 0.0)])
@pytest.mark.parametrize("row", [0, 1])
def test_a_plan_whose_ends_are_damaged_is_not_started(
    drive: Drive, mode: TrajectoryController, rows: Rows, row: int, column: int, value: float
) -> None:
    plan, count = rows([Point(0.0, ZERO), Point(2.0, A)])
    plan[row * COLUMNS + column] = value
    refused = drive.execute(mode, plan, count)
    assert isinstance(refused, DamagedRow)
    assert refused.row == row
    assert mode.phase is Phase.HOLD


def test_a_plan_that_does_not_end_at_rest_is_brought_to_rest(
    drive: Drive, mode: TrajectoryController, rows: Rows
) -> None:
    plan, count = rows([Point(0.0, ZERO, ZERO), Point(2.0, A, ZERO)])
    plan[COLUMNS + VELOCITIES] = 0.2
    drive.execute(mode, plan, count)
    drive.until_rest(mode)
    assert mode.ended == PlanDamaged(1, near(0.2))
