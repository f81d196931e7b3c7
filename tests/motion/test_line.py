"""The mode `cartesian`: straight, with slerp, at rest at each pose, braking along the line."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from kinematics import Pose, forward
from kinematics.jacobian import singularity_distances
from kinematics.solution import Near, Singularity
from rtcp.config.model import ArmConfig, SingularityLimits, Stop
from rtcp.ipc.events import JointLimitReached, NoSolution, OutOfReach, PlanDamaged, SetpointJump, SingularityReached
from rtcp.ipc.refusals import DamagedRow, PathNeedsRest, PathStartsElsewhere
from rtcp.motion.controllers.line import LineController
from rtcp.motion.planning.interpolation import quaternion, turn_between
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.plan import COLUMNS, KIND
from rtcp.motion.state import Phase

from .conftest import Drive, Rows, memory

PERIOD = 0.0005
ANYWHERE = SingularityLimits(shoulder=0.0, elbow=0.0, wrist=0.0)
Q = (0.0, 0.3, 1.2, 0.0, 0.8, 0.0)


Moved = Callable[..., Stop]


@pytest.fixture
def mode(arm: ArmConfig, drive: Drive) -> LineController:
    made: LineController = drive.controller(LineController, cartesian=replace(arm.cartesian, singularity=ANYWHERE))
    return made


@pytest.fixture
def moved(arm: ArmConfig) -> Moved:
    """The pose at Q, moved and turned."""
    at = forward(arm.arm, Q)
    x, y, z = at.position
    rx, ry, rz = at.rpy
    return lambda dx=0.0, dy=0.0, dz=0.0, drx=0.0, dry=0.0, drz=0.0, speed=None: Stop(
        (x + dx, y + dy, z + dz, rx + drx, ry + dry, rz + drz), None, speed
    )


@pytest.fixture
def rows(arm: ArmConfig, drive: Drive) -> Rows:
    def planned(stops: list[Stop], q: Sequence[float] = Q, speed: float | None = None) -> tuple[memoryview[float], int]:
        plan = plan_lines(arm.arm, drive.limits, arm.cartesian, q, stops, speed=speed)
        return memory(plan.rows), len(plan.rows)

    return planned


def off_line(start: Sequence[float], end: Sequence[float], point: Sequence[float]) -> float:
    direction = [b - a for a, b in zip(start, end, strict=True)]
    length = math.hypot(*direction)
    along = sum((p - a) * w for p, a, w in zip(point, start, direction, strict=True)) / length
    return math.dist(point, [a + along * w / length for a, w in zip(start, direction, strict=True)])


def test_the_tool_stays_on_the_line_and_rests_at_each_pose(
    arm: ArmConfig, drive: Drive, mode: LineController, rows: Rows, moved: Moved
) -> None:
    stops = [moved(dy=0.2), moved(dy=0.2, dz=0.1), moved()]
    drive.at(Q)
    assert drive.execute(mode, *rows(stops)) is None
    rests, corner = [], 0
    while mode.phase is not Phase.HOLD:
        drive.cycle(mode)
        if corner < 3 and math.dist(forward(arm.arm, drive.state.commanded).position, stops[corner].pose[:3]) < 1e-9:
            rests.append(max(map(abs, drive.state.commanded_velocity)))
            corner += 1
    assert corner == 3
    assert max(rests) < 1e-3
    corners = [forward(arm.arm, Q).position, *(stop.pose[:3] for stop in stops)]
    worst = 0.0
    for q in drive.path[::20]:
        point = forward(arm.arm, q).position
        worst = max(worst, min(off_line(a, b, point) for a, b in pairwise(corners)))
    assert worst < 1e-9
    assert mode.ended is None
    assert mode.elapsed_s == pytest.approx(mode.duration_s, abs=0.01)


def test_the_tool_keeps_to_speed_and_acceleration(
    arm: ArmConfig, drive: Drive, mode: LineController, rows: Rows, moved: Moved
) -> None:
    drive.at(Q)
    drive.execute(mode, *rows([moved(dz=-0.2)], speed=0.05))
    drive.until_rest(mode)
    points = [forward(arm.arm, q).position for q in drive.path[::2]]
    speeds = [math.dist(a, b) / (2 * PERIOD) for a, b in pairwise(points)]
    assert max(speeds) == pytest.approx(0.05, rel=1e-6)
    steps = [abs(b - a) / (2 * PERIOD) for a, b in pairwise(speeds)]
    assert max(steps) < arm.cartesian.acceleration * 1.001


def test_a_turn_is_about_one_axis_and_ends_where_it_should(
    arm: ArmConfig, drive: Drive, mode: LineController, rows: Rows, moved: Moved
) -> None:
    goal = moved(drx=0.4, dry=-0.3, drz=0.2)
    drive.at(Q)
    start, end = forward(arm.arm, Q), Pose.from_xyzrpy(*goal.pose)
    axis, angle = turn_between(quaternion(start.rotation), quaternion(end.rotation))
    drive.execute(mode, *rows([goal]))
    drive.until_rest(mode)
    done = 0.0
    for q in drive.path[::50]:
        here = forward(arm.arm, q)
        assert math.dist(here.position, start.position) < 1e-9
        about, turned = turn_between(quaternion(start.rotation), quaternion(here.rotation))
        assert turned >= done - 1e-9
        done = turned
        if turned > 0.01:
            assert about == pytest.approx(axis, abs=1e-6)
    assert done == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("after_s", [0.0005, 0.1, 0.5, 1.0, 1.4])
def test_a_stop_brakes_along_the_line(
    arm: ArmConfig, drive: Drive, mode: LineController, rows: Rows, moved: Moved, after_s: float
) -> None:
    goal = moved(dy=0.2, drz=0.2)
    drive.at(Q)
    drive.execute(mode, *rows([goal]))
    drive.run(mode, round(after_s / PERIOD))
    mode.stop(drive.state)
    drive.until_rest(mode, 1.0)
    start = forward(arm.arm, Q).position
    assert max(off_line(start, goal.pose[:3], forward(arm.arm, q).position) for q in drive.path[1:]) < 1e-9
    assert mode.ended is None
    assert math.dist(forward(arm.arm, drive.state.commanded).position, goal.pose[:3]) > 1e-3


def test_a_small_rest_at_the_start_fades_out_without_a_jump(
    arm: ArmConfig, drive: Drive, mode: LineController, rows: Rows, moved: Moved
) -> None:
    plan = rows([moved(dy=0.2)])
    drive.at([q + 3e-4 for q in Q])
    assert drive.execute(mode, *plan) is None
    drive.until_rest(mode)
    assert math.dist(forward(arm.arm, drive.state.commanded).position, moved(dy=0.2).pose[:3]) < 1e-9


def test_a_line_that_begins_elsewhere_is_refused(drive: Drive, mode: LineController, rows: Rows, moved: Moved) -> None:
    plan = rows([moved(dy=0.2)])
    drive.at([q + 3e-3 for q in Q])
    refused = drive.execute(mode, *plan)
    assert isinstance(refused, PathStartsElsewhere)
    assert mode.phase is Phase.HOLD


def test_a_line_in_motion_is_refused_and_what_runs_goes_on(
    arm: ArmConfig, drive: Drive, mode: LineController, rows: Rows, moved: Moved
) -> None:
    first, second = rows([moved(dy=0.1)]), rows([moved(dz=-0.1)])
    drive.at(Q)
    drive.execute(mode, *first)
    drive.run(mode, 1000)
    refused = drive.execute(mode, *second)
    assert isinstance(refused, PathNeedsRest)
    assert refused.velocity == drive.state.commanded_velocity[refused.axis]
    assert abs(refused.velocity) > 0.01
    drive.until_rest(mode)
    assert math.dist(forward(arm.arm, drive.state.commanded).position, moved(dy=0.1).pose[:3]) < 1e-9
    # At rest the refusal names the start of the plan.
    refused = drive.execute(mode, *second)
    assert isinstance(refused, PathStartsElsewhere)


def test_lines_stopped_and_begun_anew_never_jump(arm: ArmConfig, new_drive: Callable[..., Drive]) -> None:
    for seed in range(4):
        chance, drive = random.Random(seed), new_drive().at(Q)
        mode = drive.controller(LineController)
        for _ in range(3):
            q = drive.state.commanded
            at = forward(arm.arm, q)
            goal = (*(c + chance.uniform(-0.08, 0.08) for c in at.position), *at.rpy)
            plan = plan_lines(arm.arm, drive.limits, arm.cartesian, q, [Stop(goal)])
            assert drive.execute(mode, memory(plan.rows), 1) is None
            drive.run(mode, chance.randint(1, 800))
            mode.stop(drive.state)
            drive.until_rest(mode)


@pytest.mark.parametrize(
    ("place", "rates", "checked", "kind"),
    [
        # The first setpoint is out of reach.
        (200.0, (1e6, 1e8, 1e9), True, OutOfReach),
        # At the edge of the reach the speed of the elbow grows without bound.
        (1.5, (0.1, 0.2, 2.0), True, SetpointJump),
        # A plan that was not slowed down for the joints: the tool keeps its bounds, a joint does not.
        (None, (5.0, 0.9, 5.0), False, SetpointJump),
    ],
    ids=["out of reach", "stretches the arm", "too fast for a joint"],
)
def test_a_line_that_cannot_be_followed_ends_in_a_stop_that_says_why(
    drive: Drive,
    mode: LineController,
    rows: Rows,
    moved: Moved,
    place: float | None,
    rates: Any,
    checked: bool,
    kind: Any,
) -> None:
    plan, count = rows([moved(dy=0.4 if place is None else 0.2)])
    plan[8] = plan[8] if place is None else place
    plan[14], plan[15], plan[16] = rates
    drive.checked = checked
    drive.at(Q)
    assert drive.execute(mode, plan, count) is None
    drive.until_rest(mode)
    assert isinstance(mode.ended, kind)
    if kind is OutOfReach:
        assert mode.ended.distance > 1.0
        assert drive.state.commanded == list(Q)
    else:
        assert abs(mode.ended.value) > mode.ended.limit


@pytest.mark.interpreted
def test_a_line_to_a_pose_in_reach_without_a_solution_does_not_name_a_distance_of_zero(
    drive: Drive, mode: LineController, rows: Rows, moved: Moved
) -> None:
    drive.at(Q)
    assert drive.execute(mode, *rows([moved(dy=0.2)])) is None
    mode._inverse = SimpleNamespace(solve_near=lambda *_: Near(None, "", Singularity.NONE, 0.0, -1))  # type: ignore[assignment]
    drive.until_rest(mode)
    assert mode.ended == NoSolution()


def test_a_line_that_comes_near_a_singularity_after_all_ends_in_a_stop_before_it(
    arm: ArmConfig, drive: Drive, rows: Rows, moved: Moved
) -> None:
    plan, count = rows([moved(dy=0.2)])
    plan[8], plan[14], plan[15], plan[16] = 1.5, 0.03, 0.1, 1.0
    # Far enough from the stretched elbow that no joint is too fast there.
    near = replace(arm.cartesian.singularity, elbow=0.6)
    mode = drive.controller(LineController, cartesian=replace(arm.cartesian, singularity=near))
    drive.at(Q)
    assert drive.execute(mode, plan, count) is None
    drive.until_rest(mode)
    ended = mode.ended
    assert isinstance(ended, SingularityReached)
    assert (ended.which, ended.limit) == (1, 0.6)
    assert 0.93 * 0.6 < ended.value < 0.95 * 0.6
    elbow = singularity_distances(arm.arm, drive.state.commanded).elbow
    assert elbow is not None
    assert 0.5 < elbow < ended.value


def test_a_line_into_a_joints_range_ends_in_a_stop_that_says_which(
    arm: ArmConfig, drive: Drive, rows: Rows, moved: Moved
) -> None:
    plan, count = rows([moved(dy=0.2)])
    model = replace(
        arm.arm,
        limits=(replace(arm.arm.limits[0], lower=-0.1, upper=0.1), *arm.arm.limits[1:]),
    )
    mode = drive.controller(LineController, arm=model)
    drive.at(Q)
    assert drive.execute(mode, plan, count) is None
    drive.until_rest(mode)
    assert isinstance(mode.ended, JointLimitReached)
    assert mode.ended.axis == 0


@pytest.mark.parametrize(
    ("column", "value"),
    [(0, math.nan), (3, 2.0), (9, math.inf), (14, 0.0), (14, -1.0), (15, math.nan), (18, -1.0), (KIND, 3.0)],
)
def test_a_damaged_piece_is_not_started_and_ends_what_runs(
    drive: Drive, mode: LineController, rows: Rows, moved: Moved, column: int, value: float
) -> None:
    plan, count = rows([moved(dy=0.1), moved()])
    drive.at(Q)
    drive.execute(mode, plan, count)
    drive.run(mode, 100)
    plan[COLUMNS + column] = value
    drive.until_rest(mode)
    assert isinstance(mode.ended, PlanDamaged)
    assert mode.ended.row == 1
    plan[column] = value
    refused = drive.execute(mode, plan, count)
    assert isinstance(refused, DamagedRow)
    assert refused.row == 0


def test_a_piece_that_begins_elsewhere_than_the_last_ended_is_damaged(
    drive: Drive, mode: LineController, rows: Rows, moved: Moved
) -> None:
    plan, count = rows([moved(dy=0.1), moved()])
    plan[COLUMNS + 2] += 0.01
    drive.at(Q)
    drive.execute(mode, plan, count)
    drive.until_rest(mode)
    assert isinstance(mode.ended, PlanDamaged)
    assert mode.ended.row == 1
