"""Plans of trajectories: every refusal in a sentence, and what is planned is carried out inside the limits."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from rtcp.config.model import MOST_AXES, ArmConfig, Point
from rtcp.motion.controllers.trajectory import TrajectoryController
from rtcp.motion.planning.plan import ACCELERATIONS, CUBIC, KIND, QUINTIC, VELOCITIES, Plan, PlanRefused
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.motion.state import Phase

from .conftest import Drive, memory

PERIOD = 0.0005
ZERO = (0.0,) * 6
NAMES = [f"j{i}" for i in range(1, 7)]
Planned = Callable[..., Plan]

UNUSED = (0.0,) * (MOST_AXES - 6)


def at(*first: float) -> tuple[float, ...]:
    return (*first, *ZERO[len(first) :])


@pytest.fixture
def plan(drive: Drive) -> Planned:
    def planned(points: Sequence[Point], q: Sequence[float] = ZERO, **given: Any) -> Plan:
        return plan_trajectory(points, drive.limits, q, names=NAMES, **given)

    return planned


REFUSALS = [
    ([], "the trajectory has no points, at least one is needed"),
    ([Point(0.001 * k, ZERO) for k in range(4097)], "the trajectory has 4097 points, at most 4096 are allowed"),
    ([Point(math.nan, ZERO)], "point 1: its time is nan s, allowed is 0 to 86400 s"),
    ([Point(-1.0, ZERO)], "point 1: its time is -1.0 s, allowed is 0 to 86400 s"),
    ([Point(1e6, ZERO)], "point 1: its time is 1000000.0 s, allowed is 0 to 86400 s"),
    (
        [Point(2.0, ZERO), Point(1.0, ZERO)],
        "point 2: its time is 1 s after 2 s, times must rise by at least 0.001 s",
    ),
    ([Point(2.0, ZERO[:5])], "point 1: it has 5 numbers for the position, 6 are needed"),
    ([Point(2.0, ZERO, ZERO[:4])], "point 1: it has 4 numbers for the velocity, 6 are needed"),
    ([Point(2.0, at(0.0, math.nan))], "point 1: the position of j2 is nan rad, a number is needed"),
    ([Point(2.0, ZERO, at(math.inf))], "point 1: the velocity of j1 is inf rad/s, a number is needed"),
    (
        [Point(0.0, ZERO, ZERO), Point(2.0, ZERO)],
        "point 2: velocities and accelerations must be given for all points or for none",
    ),
    ([Point(2.0, ZERO, None, ZERO)], "point 1: an acceleration needs a velocity too"),
    (
        [Point(0.0, ZERO, at(0.6)), Point(0.0, at(1.0), at(0.6))],
        "point 1: j1 moves at 0.6 rad/s, allowed is at most 0.5 rad/s",
    ),
    (
        [Point(0.0, at(0.0, 0.2)), Point(2.0, ZERO)],
        "point 1: at time 0 s j2 must be where it is, at 0.0000 rad (within 0.001 rad), found 0.2000 rad; "
        "give the point a later time and the arm is led there",
    ),
    (
        [Point(0.0, ZERO, at(0.1)), Point(2.0, ZERO, ZERO)],
        "point 1: at time 0 s j1 must be at rest, found 0.1 rad/s",
    ),
    (
        [Point(0.0, ZERO, ZERO), Point(2.0, ZERO, at(0.0, 0.0, 0.1))],
        "point 2: the last point must be at rest, j3 has 0.1 rad/s",
    ),
    ([Point(9.0, at(3.2))], "point 1: j1 is at 3.2 rad, allowed is -3.1 to 3.1 rad"),
    (
        [Point(0.5, at(1.0))],
        "point 1: its time is 0.5 s, the way there from where the arm is takes 2.350 s at least",
    ),
    (
        [Point(5.0, ZERO, at(0.7), ZERO), Point(9.0, ZERO, ZERO, ZERO)],
        "point 1: j1 moves at 0.7 rad/s, allowed is at most 0.5 rad/s",
    ),
    (
        [Point(5.0, ZERO, ZERO, at(3.0)), Point(9.0, ZERO, ZERO, ZERO)],
        "point 1: j1 accelerates with 3 rad/s^2, allowed is at most 2 rad/s^2",
    ),
    (
        [Point(0.0, ZERO, ZERO), Point(2.0, at(0.92), ZERO)],
        "between points 1 and 2: j1 would move at 0.69 rad/s at 1.000 s, allowed is at most 0.5 rad/s",
    ),
    (
        [Point(0.0, ZERO, ZERO), Point(0.5, at(0.0, 0.13), ZERO)],
        "between points 1 and 2: j2 would accelerate with 3.12 rad/s^2 at 0.000 s, allowed is at most 2 rad/s^2",
    ),
]


@pytest.mark.parametrize(("points", "sentence"), REFUSALS, ids=range(len(REFUSALS)))
def test_a_plan_that_cannot_be_is_refused_in_a_sentence(plan: Planned, points: list[Point], sentence: str) -> None:
    with pytest.raises(PlanRefused) as refused:
        plan(points)
    assert str(refused.value) == sentence


def test_a_joint_that_swings_beyond_its_range_between_two_points_is_refused(plan: Planned) -> None:
    # Both points are inside; with these speeds the cubic is T v / 4 = 0.1 rad beyond both half way.
    points = [
        Point(9.0, at(3.05), ZERO),
        Point(11.0, at(3.05), at(0.4)),
        Point(12.0, at(3.05), at(-0.4)),
        Point(14.0, at(3.05), ZERO),
    ]
    with pytest.raises(PlanRefused) as refused:
        plan(points, at(3.05))
    expected = "between points 2 and 3: j1 would be at 3.15 rad at 11.500 s, allowed is -3.1 to 3.1 rad"
    assert str(refused.value) == expected


@pytest.mark.parametrize(
    ("points", "where"),
    [
        ([Point(0.0, ZERO), Point(4.0, at(0.8))], "between points 1 and 2"),
        ([Point(4.0, at(0.8)), Point(8.0, at(0.8))], "on the way to point 1"),
    ],
)
def test_a_plan_through_a_box_is_refused(plan: Planned, points: list[Point], where: str) -> None:
    with pytest.raises(PlanRefused, match=rf"^{where}: the arm would be in the keep-out box user at 2\.\d+ s$"):
        plan(points, zone_at=lambda q: "the keep-out box user" if 0.4 < q[0] < 0.45 else None)


def at_the_limits(goal: Sequence[float], interval_s: float) -> list[Point]:
    """A move from rest at 0 whose slowest joint keeps exactly 2 rad/s^2 and 0.5 rad/s, sampled as MoveIt samples it."""
    size = max(map(abs, goal))
    rate, most = 2.0 / size, min(0.5 / size, math.sqrt(2.0 / size))
    ramp_s = most / rate
    end_s = ramp_s + 1.0 / most
    points = []
    for t in [*(interval_s * k for k in range(int(end_s / interval_s - 1e-6) + 1)), end_s]:
        left_s = end_s - t
        if t < ramp_s:
            s, speed, change = rate * t * t / 2, rate * t, rate
        elif left_s > ramp_s:
            s, speed, change = most * (t - ramp_s / 2), most, 0.0
        else:
            s, speed, change = 1.0 - rate * left_s * left_s / 2, rate * left_s, -rate
        points.append(Point(t, *(tuple(factor * q for q in goal) for factor in (s, speed, change))))
    return points


@pytest.mark.parametrize("interval_s", [0.1, 0.01])
@pytest.mark.parametrize("given", ["qva", "qv", "q"])
@pytest.mark.parametrize("goal", [at(1.0), (0.8, -0.1, 0.3, 0.5, 0.4, -0.7), at(0.05)], ids=["one", "all", "short"])
def test_a_motion_that_is_sampled_at_the_limits_is_planned_and_driven(
    drive: Drive, plan: Planned, goal: Sequence[float], given: str, interval_s: float
) -> None:
    points = [
        Point(p.t, p.q, p.v if "v" in given else None, p.a if "a" in given else None)
        for p in at_the_limits(goal, interval_s)
    ]
    made = plan(points)
    # Velocities say what the motion is; the spline through positions alone is faster at a change of acceleration.
    assert made.slowed == 1.0 if "v" in given else 1.0 / 1.15 <= made.slowed <= 1.0
    assert made.duration_s == pytest.approx(points[-1].t / made.slowed)
    passed = {round(row[0], 9): row[1:7] for row in made.rows}
    assert all(passed[round(p.t / made.slowed, 9)] == pytest.approx(p.q, abs=1e-12) for p in points)
    mode = drive.controller(TrajectoryController)
    assert drive.execute(mode, memory(made.rows), len(made.rows)) is None
    drive.until_rest(mode)  # every cycle is inside the limits
    assert drive.state.commanded == pytest.approx(goal, abs=1e-9)


def test_a_motion_at_its_limits_with_more_rows_than_a_plan_has_is_refused(plan: Planned) -> None:
    samples = at_the_limits(at(1.0), 0.1)
    points = [*samples[:-1], *(Point(samples[-1].t + 0.002 * k, at(1.0), ZERO, ZERO) for k in range(4096 - 23))]
    with pytest.raises(PlanRefused, match=r"^the motion needs 4\d\d\d rows at its limits, at most 4096 fit"):
        plan(points)


@pytest.mark.parametrize(
    ("points", "least_s", "most_s"),
    [
        ([Point(0.0, at(0.5))], 1.25, 1.5),  # a trapezoid takes 1.25 s
        ([Point(0.0, at(0.5), ZERO)], 1.25, 1.5),
        ([Point(0.0, at(0.5), at(0.1))], 5.0, 5.2),
        ([Point(0.0, ZERO), Point(0.0, at(0.25)), Point(0.0, at(0.5))], 1.25, 2.0),
        ([Point(0.0, ZERO, ZERO), Point(0.0, at(0.25), at(0.2)), Point(0.0, at(0.5), ZERO)], 2.5, 3.2),
        ([Point(0.0, at(0.1 * k, 0.1 * (k % 2))) for k in range(6)], 1.25, 6.0),
        ([Point(0.0, ZERO)], 0.0, 0.1),  # already there
    ],
)
def test_points_without_times_are_executed_in_sequence_at_a_default_speed_or_the_given_one(
    drive: Drive, plan: Planned, points: list[Point], least_s: float, most_s: float
) -> None:
    made = plan(points)
    assert least_s <= made.duration_s <= most_s
    passed = [row[1:7] for row in made.rows]
    assert all(any(row == pytest.approx(p.q, abs=1e-12) for row in passed) for p in points)
    mode = drive.controller(TrajectoryController)
    assert drive.execute(mode, memory(made.rows), len(made.rows)) is None
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(points[-1].q, abs=1e-9)


def test_points_without_times_replace_a_motion(plan: Planned) -> None:
    made = plan([Point(0.0, at(0.2)), Point(0.0, at(0.5))], moving=True)
    assert made.rows[0][0] > 0.0
    assert (made.rows[0][1], made.end) == (0.2, at(0.5))


def test_rows_have_times_numbers_and_kind(plan: Planned) -> None:
    made = plan([Point(0.0, ZERO, ZERO), Point(2.0, at(0.4), ZERO)])
    assert made.rows[1] == (2.0, *at(0.4), *UNUSED, *ZERO, *UNUSED, *ZERO, *UNUSED, CUBIC)
    assert (made.duration_s, made.slowed, made.length_m, made.end) == (2.0, 1.0, 0.0, at(0.4))
    made = plan([Point(0.0, ZERO), Point(2.0, at(0.4)), Point(4.0, ZERO)])
    assert [row[KIND] for row in made.rows] == [QUINTIC] * 3
    # The spline through a hat is level at its top.
    assert made.rows[1][VELOCITIES] == pytest.approx(0.0)
    assert made.rows[1][ACCELERATIONS] == pytest.approx(-6 * 0.4 / 4)


def test_an_arm_of_fewer_joints_is_planned_for_too(arm: ArmConfig, drive: Drive) -> None:
    made = plan_trajectory([Point(0.0, (0.0, 0.0)), Point(2.0, (0.2, -0.1))], drive.limits, (0.0, 0.0))
    assert made.rows[1][:7] == (2.0, 0.2, -0.1, 0.0, 0.0, 0.0, 0.0)


def test_what_was_planned_is_driven_to_its_end_inside_the_limits(new_drive: Callable[..., Drive]) -> None:
    chance, driven = random.Random(7), 0
    for _ in range(40):
        drive = new_drive()
        time, points = 0.0, []
        for k in range(chance.randint(1, 4)):
            time += chance.uniform(0.6, 3.0)
            v = ZERO if k == 3 or chance.random() < 0.3 else tuple(chance.uniform(-0.2, 0.2) for _ in range(6))
            points.append(Point(time, tuple(chance.uniform(-0.6, 0.6) for _ in range(6)), v))
        points.append(Point(time + 2.0, points[-1].q, ZERO))
        if chance.random() < 0.5:
            points = [Point(p.t, p.q) for p in points]
        try:
            plan = plan_trajectory(points, drive.limits, ZERO)
        except PlanRefused:
            continue
        mode = drive.controller(TrajectoryController)
        assert drive.execute(mode, memory(plan.rows), len(plan.rows)) is None
        drive.until_rest(mode)
        assert mode.phase is Phase.HOLD
        assert drive.state.commanded == pytest.approx(plan.end, abs=1e-9)
        driven += 1
        if driven == 4:
            return
    raise AssertionError(f"only {driven} of 40 could be planned")


def test_a_first_point_at_time_0_may_be_as_far_from_the_arm_as_the_start_tolerance_allows(plan: Planned) -> None:
    here, points = at(0.1, -0.2), [Point(0.0, at(0.109, -0.209)), Point(2.0, ZERO)]
    assert plan(points, here, start_tolerance=0.01) == plan([Point(0.0, here), points[1]], here)
    for tolerance, shown in ((0.008, "within 0.008 rad"), (0.0, "within 0.001 rad")):
        with pytest.raises(PlanRefused, match=rf"at time 0 s j1 must be where it is, at 0.1000 rad \({shown}\)"):
            plan(points, here, start_tolerance=tolerance)
