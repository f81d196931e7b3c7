"""Trajectories that are open at their end: the plan that points are appended to, and the controller that runs it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.config import default_config, load
from rtcp.config.model import MOST_AXES, Point
from rtcp.motion.limits import Limits
from rtcp.motion.planning.interpolation import beyond, cubic, derivative
from rtcp.motion.planning.plan import POSITIONS, VELOCITIES, PlanRefused, PlanTooFast
from rtcp.motion.planning.trajectories import OpenPlan

CONFIG = load(default_config())
LIMITS = Limits(CONFIG)
HERE = [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]
NAMES = [joint.name for joint in CONFIG.joints]


def plan() -> OpenPlan:
    return OpenPlan(LIMITS, HERE, names=NAMES)


def at(t: float, first: float, **more: float) -> Point:
    return Point(t, (first, *HERE[1:]), *[(speed, *[0.0] * 5) for speed in more.values()])


def of_first(rows: Sequence[Sequence[float]]) -> list[tuple[float, float, float]]:
    """Time, position and velocity of the first joint in each row."""
    return [(row[0], row[POSITIONS], row[VELOCITIES]) for row in rows]


def test_a_point_waits_for_the_one_behind_it_and_then_has_a_velocity() -> None:
    made = plan()
    assert of_first(made.append([at(1.0, 0.1), at(2.0, 0.2)])) == [(1.0, 0.1, pytest.approx(0.1))]
    assert made.waits
    assert of_first(made.append([at(3.0, 0.3)])) == [(2.0, 0.2, pytest.approx(0.1))]
    assert of_first(made.append((), rest=True)) == [(3.0, 0.3, 0.0)]
    assert not made.waits
    assert made.end == (0.3, *HERE[1:])
    assert of_first(made.append([at(4.0, 0.2), at(5.0, 0.1)])) == [(4.0, 0.2, pytest.approx(-0.1))]


def test_points_with_velocities_wait_for_nothing() -> None:
    rows = plan().append([at(1.0, 0.1, v=0.1), at(2.0, 0.2, v=0.1)])
    assert of_first(rows) == [(1.0, 0.1, 0.1), (2.0, 0.2, 0.1)]


@given(st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=12))
def test_between_points_the_joint_passes_neither_of_them(steps: list[float]) -> None:
    made, here, points = plan(), 0.0, []
    for number, step in enumerate(steps, 1):
        here += step
        points.append(at(2.0 * number, here))
    rows = [row for point in points for row in made.append([point])] + made.append((), rest=True)
    for (t0, q0, v0), (t1, q1, v1) in pairwise(of_first(rows)):
        piece = cubic(q0, v0, q1, v1, t1 - t0)
        assert beyond(piece, min(q0, q1) - 1e-9, max(q0, q1) + 1e-9) is None
        most = LIMITS.velocity[0] * (t1 - t0)
        assert beyond(derivative(piece), -most, most) is None


@pytest.mark.parametrize(
    ("points", "text"),
    [
        ([at(1.5, 0.1)], "point 3: its time is 1.5 s after 2 s"),
        ([at(3.0, 9.0)], "point 3: joint1 is at 9 rad"),
        ([at(2.01, 0.9)], "before point 3: joint1 would move at"),
        ([Point(3.0, (0.1,))], "point 3: it has 1 numbers for the position"),
        ([at(3.0, 0.1, v=0.1)], "velocities and accelerations must be given for all points or for none"),
        ([at(float("nan"), 0.1)], "point 3: its time is nan s"),
        ([at(3.0, float("nan"))], "point 3: the position of joint1 is nan rad"),
        ([at(3.0, 0.3), at(3.001, 0.9)], "before point 4: joint1 would move at"),
    ],
)
def test_points_that_are_refused_change_nothing(points: list[Point], text: str) -> None:
    made, same = plan(), plan()
    for trajectory in (made, same):
        trajectory.append([at(1.0, 0.1), at(2.0, 0.2)])
    with pytest.raises(PlanRefused, match=text):
        made.append(points)
    assert made.append([at(3.0, 0.25)]) == same.append([at(3.0, 0.25)])


def test_the_last_point_has_to_be_at_rest() -> None:
    made = plan()
    made.append([at(1.0, 0.1, v=0.1)])
    with pytest.raises(PlanRefused, match=r"the last point must be at rest, joint1 has 0\.1 rad/s"):
        made.append((), rest=True)


def test_a_point_that_no_velocity_makes_possible_is_refused_with_itself() -> None:
    made = plan()
    made.append([at(1.0, 0.1)])
    with pytest.raises(PlanTooFast, match="before point 2: joint1 would move at 40 rad/s on the mean"):
        made.append([at(1.01, 0.5)])


def test_a_moving_arm_is_not_led_back_to_where_it_was() -> None:
    made = OpenPlan(LIMITS, HERE, names=NAMES, moving=True)
    assert of_first(made.append([at(0.0, 0.0), at(1.0, 0.1), at(2.0, 0.2)]))[0][0] == 1.0


def test_rows_have_the_width_of_the_plan_area() -> None:
    (row,) = plan().append([at(1.0, sin(0.1))], rest=True)
    assert len(row) == 2 + 3 * MOST_AXES
