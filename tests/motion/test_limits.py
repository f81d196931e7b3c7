"""Limits change as one transaction: refused with a reason, or applied whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.ipc.refusals import ImpossibleLimit, LimitsExcludeArm, LimitsExcludeJoint, LimitWidened, Refusal
from rtcp.motion.limits import Cone, Corners, Limits, Values, corners, read, rows
from rtcp.motion.planning.plan import COLUMNS
from tests.arm_geometry import points

from .conftest import memory, near
from .guard_checker import ARM, JOINTS_ONLY, GuardChecker, with_boxes

WIDEST = Values.configured(ARM)
STILL = [0.0] * 6


def full(plan: Sequence[Sequence[float]]) -> memoryview[float]:
    """The rows as the plan area holds them, filled up with zeros."""
    return memory([*row, *[0.0] * (COLUMNS - len(row))] for row in plan)


def of_first(values: Values, name: str, number: float) -> Values:
    """These values with another number for the first joint."""
    return replace(values, **{name: (number, *getattr(values, name)[1:])})


def check(new: Values, position: Sequence[float] = STILL, velocity: Sequence[float] = STILL) -> Refusal | None:
    return Limits(ARM).check(new, list(position), list(velocity))


def test_what_is_configured_is_taken() -> None:
    assert check(WIDEST) is None


@pytest.mark.parametrize(
    ("name", "number", "expected"),
    [
        ("low", -3.2, LimitWidened(0, -3.2, -3.1)),
        ("high", 3.2, LimitWidened(0, 3.2, 3.1)),
        ("low", -inf, ImpossibleLimit(0, -inf, -3.1)),
        ("high", -3.1, ImpossibleLimit(0, -3.1, -3.1)),
        ("velocity", 0.6, LimitWidened(0, 0.6, 0.5)),
        ("velocity", 0.0, ImpossibleLimit(0, 0.0, 0.0005)),
        ("velocity", 1e-300, ImpossibleLimit(0, 1e-300, 0.0005)),
        ("acceleration", 2.1, LimitWidened(0, 2.1, 2.0)),
        ("acceleration", -1.0, ImpossibleLimit(0, -1.0, 0.002)),
        ("jerk", inf, ImpossibleLimit(0, inf, 20.0)),
        ("torque", 50.0, LimitWidened(0, 50.0, 49.0)),
        ("high", -0.1, LimitsExcludeJoint(0, 0.0, -0.1)),
        ("low", 0.1, LimitsExcludeJoint(0, 0.0, 0.1)),
    ],
)
def test_a_joints_limit_that_cannot_be_is_refused_with_the_number_and_what_is_allowed(
    name: str, number: float, expected: Refusal
) -> None:
    assert check(of_first(WIDEST, name, number)) == expected


@pytest.mark.parametrize("name", ["low", "high", "velocity", "acceleration", "jerk", "torque"])
def test_no_number_is_no_limit(name: str) -> None:
    refused = check(of_first(WIDEST, name, nan))
    assert refused is not None
    assert isinstance(refused, ImpossibleLimit)


def test_a_joint_at_the_edge_or_at_full_speed_does_not_hinder_what_narrows_neither() -> None:
    edge = [WIDEST.high[0] + 1e-7, *STILL[1:]]
    fast = [WIDEST.velocity[0] * (1 + 1e-12), *STILL[1:]]
    for name in ("velocity", "jerk", "torque"):
        assert check(replace(WIDEST, **{name: tuple(0.9 * x for x in getattr(WIDEST, name))}), edge) is None
    assert check(of_first(WIDEST, "torque", 1.0), edge, fast) is None


def test_a_joint_that_would_come_to_rest_outside_refuses_the_range_and_one_that_is_too_fast_the_speed() -> None:
    moving = [0.4, *STILL[1:]]
    # From 0.4 rad/s with 2 rad/s^2 the stop takes 0.04 rad.
    assert check(of_first(WIDEST, "high", 0.041), velocity=moving) is None
    assert check(of_first(WIDEST, "high", 0.039), velocity=moving) == LimitsExcludeJoint(0, near(0.04), 0.039)
    slower = of_first(of_first(WIDEST, "high", 0.041), "acceleration", 1.0)
    assert check(slower, velocity=moving) == LimitsExcludeJoint(0, near(0.08), 0.041)
    assert check(of_first(WIDEST, "velocity", 0.3), velocity=moving) == ImpossibleLimit(0, 0.3, 0.4)


@pytest.mark.parametrize("which", ["box", "keep_out"])
@pytest.mark.parametrize("at", range(6))
def test_a_box_only_becomes_narrower_and_a_keep_out_box_only_wider(which: str, at: int) -> None:
    outward = (-0.01 if at < 3 else 0.01) * (1.0 if which == "box" else -1.0)

    def moved(by: float) -> Values:
        first, *others = WIDEST.keep_out
        walls = tuple(x + (by if n == at else 0.0) for n, x in enumerate(WIDEST.box if which == "box" else first))
        box = corners(walls[:3], walls[3:])
        return replace(WIDEST, box=box) if which == "box" else replace(WIDEST, keep_out=(box, *others))

    assert check(moved(-outward)) is None
    refused = check(moved(outward))
    assert refused is not None
    assert isinstance(refused, LimitWidened)
    for number in (nan, inf, -inf):
        assert check(moved(number)) is not None


def test_no_box_is_taken_away_or_added() -> None:
    assert check(replace(WIDEST, box=None)) == LimitWidened(-1, 0.0, 0.0)
    for boxes in (WIDEST.keep_out[:1], (*WIDEST.keep_out, WIDEST.keep_out[0])):
        assert check(replace(WIDEST, keep_out=boxes)) == ImpossibleLimit(-1, len(boxes), 2)


def test_other_joints_than_the_arms_are_refused() -> None:
    two = Values.configured(JOINTS_ONLY)
    assert check(two) == ImpossibleLimit(-1, 2, 6)


def test_whoever_holds_a_list_sees_the_change() -> None:
    limits = Limits(ARM)
    high = limits.high
    limits.apply(of_first(WIDEST, "high", 1.0))
    assert high is limits.high
    assert high[0] == 1.0
    assert limits.widest.high[0] == 3.1


# -- the arm in the boxes -------------------------------------------------------------------------------------------


def test_boxes_that_the_arm_stands_in_or_would_come_to_rest_in_are_refused() -> None:
    q = (0.3, -0.5, 1.2, 0.2, 0.7, -0.4)
    wide = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)
    checker = GuardChecker(with_boxes(wide), q, 0.002)
    tool = points(q)[0]

    def up_to(x: float) -> Values:
        return replace(checker.limits.widest, box=(*wide[:3], x, *wide[4:]))

    assert checker.guard.refusal_of(checker.state, up_to(tool[0] + 1e-4)) is None
    refused = checker.guard.refusal_of(checker.state, up_to(tool[0] - 1e-4))
    assert refused == LimitsExcludeArm(-1)
    sign = -1.0 if tool[1] > 0 else 1.0
    for _ in range(150):
        checker.request([checker.state.commanded[0] + sign * 0.5 * checker.dt, *q[1:]], tolerates_saturation=True)
    here = points(checker.state.commanded)[0][0]
    assert here > tool[0]
    assert checker.guard.refusal_of(checker.state, up_to(here + 0.2)) is None
    assert checker.guard.refusal_of(checker.state, up_to(here + 1e-3)) is not None
    assert checker.change(up_to(here + 0.03))
    for _ in range(300):
        checker.request([checker.state.commanded[0] + sign * 0.5 * checker.dt, *q[1:]], tolerates_saturation=True)


def test_an_arm_that_stands_in_a_box_already_may_still_be_slowed_down() -> None:
    q = (0.3, -0.5, 1.2, 0.2, 0.7, -0.4)
    tool = points(q)[0]
    checker = GuardChecker(with_boxes(None, [*(x - 0.1 for x in tool), *(x + 0.1 for x in tool)]), q, 0.002)
    assert checker.change(of_first(checker.limits.widest, "velocity", 0.1))
    first = checker.limits.keep_out[0]
    assert not checker.change(replace(checker.limits.widest, keep_out=((first[0] - 0.1, *first[1:]),)))


# -- as rows --------------------------------------------------------------------------------------------------------


NUMBER = st.floats(width=64)
JOINT = st.tuples(*[NUMBER] * 6)


@given(
    joints=st.lists(JOINT, min_size=1, max_size=6),
    box=st.none() | JOINT,
    keep_out=st.lists(JOINT, max_size=4),
    cones=st.lists(st.builds(Cone, st.integers(0, 2), NUMBER, NUMBER, NUMBER, NUMBER), max_size=3),
)
def test_limits_come_back_from_their_rows_as_they_were(
    joints: list[Corners], box: Corners | None, keep_out: list[Corners], cones: list[Cone]
) -> None:
    low, high, velocity, acceleration, jerk, torque = zip(*joints, strict=True)
    values = Values(low, high, velocity, acceleration, jerk, torque, box, tuple(keep_out), tuple(cones))
    plan = rows(values)
    assert repr(read(full(plan), len(plan))) == repr(values)


@pytest.mark.parametrize("count", [-1, 0, 1, 9, 11, 400])
def test_another_count_of_rows_is_none(count: int) -> None:
    plan = rows(WIDEST)
    assert len(plan) == 10
    assert read(full(plan), count) is None


@pytest.mark.parametrize("column", [0, 1, 2, 3])
@pytest.mark.parametrize("number", [nan, inf, -1.0, 0.5, 1e18, 7.0, 0.0])
def test_a_head_that_does_not_fit_the_rows_is_none(column: int, number: float) -> None:
    plan = rows(replace(WIDEST, cones=(Cone(2, 0.0, 0.0, 1.0, 1.0),)))
    assert read(full(plan), len(plan)) is not None
    plan[0][column] = number
    assert read(full(plan), len(plan)) is None


@given(plan=st.lists(st.lists(NUMBER, min_size=COLUMNS, max_size=COLUMNS), min_size=1, max_size=9), count=st.integers())
def test_whatever_is_in_memory_nothing_but_none_or_limits_comes_of_it(plan: list[list[float]], count: int) -> None:
    values = read(full(plan), count)
    if values is not None:
        check(values)
