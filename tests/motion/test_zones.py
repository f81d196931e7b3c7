"""Tool, wrist and elbow never enter a keep-out box, the tool never leaves its own; who begins inside may come out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import hypot, inf, nan
from random import Random

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.ipc.events import BoxReached
from rtcp.motion.guards.braking import touched
from rtcp.motion.guards.trajectory_guard import GuardResult
from rtcp.motion.guards.zones import ELBOW, TOOL, WRIST, Zones, inside, outside
from rtcp.motion.limits import Limits
from tests.arm_geometry import Point, depth, points
from tests.samples import SLOW, examples

from .guard_checker import ARM, MODEL, GuardChecker, with_boxes

WIDE = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)
Q = (0.3, -0.5, 1.2, 0.2, 0.7, -0.4)
CYCLES_S = st.sampled_from([0.002, 0.005, 0.02])
SIGN = st.sampled_from([-1.0, 0.0, 1.0])
DIRECTION = st.lists(st.one_of(SIGN, st.floats(-1.0, 1.0)), min_size=6, max_size=6)
JOINTS = st.tuples(*(st.floats(0.9 * joint.position.min, 0.9 * joint.position.max) for joint in ARM.joints))


def box_before(point: Point, axis: int, side: float, gap: float, shift: Sequence[float], size: float) -> list[float]:
    """A box one of whose faces is `gap` from the point; `shift` (-1 to 1) moves it along the face, corners included."""
    middle = [point[n] + shift[n % 2] * 1.1 * size for n in range(3)]
    middle[axis] = point[axis] + side * (gap + size)
    return [m - size for m in middle] + [m + size for m in middle]


def driven(
    checker: GuardChecker, direction: Sequence[float], cycles: int, tolerates_saturation: bool = True
) -> list[GuardResult]:
    """Ask for joint speeds in a direction, as parts of each joint's limit."""
    verdicts = []
    for _ in range(cycles):
        steps = [part * v * checker.dt for part, v in zip(direction, checker.limits.velocity, strict=True)]
        verdicts.append(
            checker.request(
                [q + way for q, way in zip(checker.state.commanded, steps, strict=True)], tolerates_saturation
            )
        )
    return verdicts


@given(q=JOINTS)
def test_the_points_that_are_watched_are_where_the_table_of_the_facts_puts_them(q: Sequence[float]) -> None:
    poses = frames(MODEL, q)
    for found, expected in zip((TOOL, WRIST, ELBOW), points(q), strict=True):
        assert poses[found].position == pytest.approx(expected, abs=1e-12)


@given(
    q=JOINTS,
    which=st.integers(0, 2),
    axis=st.integers(0, 2),
    side=st.sampled_from([-1.0, 1.0]),
    gap=st.sampled_from([0.0, 1e-7, 1e-4, 2e-3, 0.03]),
    shift=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    size=st.sampled_from([0.004, 0.03, 0.2]),
    dt=CYCLES_S,
    legs=st.lists(st.tuples(DIRECTION, st.integers(1, 40), st.booleans()), min_size=1, max_size=4),
)
@settings(max_examples=examples(250))
def test_who_began_free_never_enters_a_keep_out_box(
    q: Sequence[float],
    which: int,
    axis: int,
    side: float,
    gap: float,
    shift: Sequence[float],
    size: float,
    dt: float,
    legs: list[tuple[list[float], int, bool]],
) -> None:
    box = box_before(points(q)[which], axis, side, gap, shift, size)
    assume(max(depth(point, box) for point in points(q)) <= 0.0)
    checker = GuardChecker(with_boxes(WIDE, box), q, dt)
    for direction, cycles, tolerates_saturation in legs:
        driven(checker, direction, cycles, tolerates_saturation)
    checker.request([nan] * 6, tolerates_saturation=False)
    checker.stop()


@given(
    q=JOINTS,
    gaps=st.tuples(*[st.sampled_from([1e-6, 1e-3, 0.02, 0.5])] * 6),
    dt=CYCLES_S,
    legs=st.lists(st.tuples(DIRECTION, st.integers(1, 40), st.booleans()), min_size=1, max_size=4),
)
@settings(max_examples=examples(100))
def test_who_began_inside_its_box_never_leaves_it(
    q: Sequence[float], gaps: Sequence[float], dt: float, legs: list[tuple[list[float], int, bool]]
) -> None:
    tool = points(q)[0]
    box = [p - g for p, g in zip(tool, gaps[:3], strict=True)] + [p + g for p, g in zip(tool, gaps[3:], strict=True)]
    checker = GuardChecker(with_boxes(box), q, dt)
    for direction, cycles, tolerates_saturation in legs:
        driven(checker, direction, cycles, tolerates_saturation)


@given(
    q=JOINTS,
    which=st.integers(0, 2),
    depth_m=st.sampled_from([1e-6, 1e-3, 0.02, 0.09]),
    dt=CYCLES_S,
    legs=st.lists(st.tuples(DIRECTION, st.integers(1, 40)), min_size=1, max_size=4),
)
@settings(max_examples=examples(25))
def test_who_began_inside_a_keep_out_box_only_moves_outward(
    q: Sequence[float], which: int, depth_m: float, dt: float, legs: list[tuple[list[float], int]]
) -> None:
    # The checker finds every cycle in which a point is deeper than before.
    checker = GuardChecker(with_boxes(WIDE, box_before(points(q)[which], 0, 1.0, -depth_m, (0.0, 0.0), 0.1)), q, dt)
    for direction, cycles in legs:
        driven(checker, direction, cycles)


@pytest.mark.parametrize("dt", [0.002, 0.01])
@pytest.mark.parametrize("gap", [-0.03, -1e-3, 0.0, 1e-3])
@pytest.mark.parametrize("part", [1.0, 0.1])
def test_the_way_out_of_a_keep_out_box_is_not_hindered(dt: float, gap: float, part: float) -> None:
    q = (0.0, 0.6, 1.2, 0.0, 0.0, 0.0)
    tool = points(q)[0]
    away = [part, 0.0, 0.0, 0.0, 0.0, 0.0] if tool[0] > 0 else [-part, 0.0, 0.0, 0.0, 0.0, 0.0]
    # Joint 1 moves the tool along y; the box begins beside it.
    box = [tool[0] - 0.3, tool[1] - 0.2 - gap, tool[2] - 0.05, tool[0] + 0.3, tool[1] - gap, tool[2] + 0.05]
    checker = GuardChecker(with_boxes(WIDE, box), q, dt)
    while points(checker.state.commanded)[0][1] < box[4] + 0.01:
        assert driven(checker, away, 1)[0] <= GuardResult.CLAMPED
    # And the way back in ends before the box.
    while driven(checker, [-part for part in away], 1)[0] is not GuardResult.STOPPED:
        assert points(checker.state.commanded)[0][1] > box[4]
    assert isinstance(checker.guard.ended, BoxReached)
    assert checker.guard.ended.box == 0
    here = -depth(points(checker.state.commanded)[0], box)
    assert 0.0 <= here < 0.004


@pytest.mark.interpreted
def test_a_stop_is_looked_at_in_no_more_than_sixteen_places(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Sequence[float]] = []

    def counted(model: ArmModel, q: Sequence[float]) -> tuple[Pose, ...]:
        looked.append(q)
        return frames(model, q)

    monkeypatch.setattr("rtcp.motion.guards.braking.frames", counted)
    chance, most, dt = Random(1), 0, 0.0005
    for _ in range(3000):
        q = [chance.uniform(-1, 1), chance.uniform(0, 1), chance.uniform(0.8, 2), 0.3, 0.5, 0.1]
        tool, axis = points(q)[0], chance.randrange(3)
        low, high = [at - 0.5 for at in tool], [at + 0.5 for at in tool]
        high[axis] = tool[axis] - 10 ** chance.uniform(-4, -1)
        low[axis] = high[axis] - 0.3
        limits = Limits(with_boxes(WIDE, low + high))
        mean = [chance.choice((-1, 1)) * v for v in limits.velocity]
        after = [at + w * dt for at, w in zip(q, mean, strict=True)]
        looked.clear()
        touched(
            Zones(MODEL, limits),
            frames(MODEL, q),
            frames(MODEL, after),
            after, mean, limits.acceleration, dt,
        )  # fmt: skip
        most = max(most, len(looked))
    # A cycle has no time for more; seldom it would take three times as many, and then the stop counts as touching.
    assert most == 16


def test_a_stop_outside_a_box_is_never_reported_with_a_distance_inside() -> None:
    chance, stops = Random(5), 0
    for _ in range(60):
        q = [chance.uniform(-1, 1), chance.uniform(0, 1), chance.uniform(0.8, 2), 0.3, 0.5, 0.1]
        tool, axis = points(q)[0], chance.randrange(3)
        low, high = [at - 0.5 for at in tool], [at + 0.5 for at in tool]
        high[axis] = tool[axis] - chance.choice((0.01, 0.03, 0.06, 0.1))
        low[axis] = high[axis] - 0.2
        checker = GuardChecker(with_boxes(WIDE, low + high), q, 0.002)
        if checker.guard.zone_at(q) is not None:
            continue
        direction = [chance.uniform(-1, 1) for _ in range(6)]
        for _ in range(400):
            driven(checker, direction, 1)
            if checker.guard.stopping:
                break
        if checker.guard.stopping and isinstance(checker.guard.ended, BoxReached):
            stops += 1
            assert checker.guard.nearest_box(checker.state.commanded)[0] >= 0.0
            assert checker.guard.ended.distance >= 0.0
    assert stops > 10


def test_a_stop_before_the_tools_own_box_names_it() -> None:
    tool = points(Q)[0]
    checker = GuardChecker(with_boxes([t - 0.05 for t in tool] + [t + 0.05 for t in tool]), Q, 0.002)
    verdicts = driven(checker, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], 400)
    assert GuardResult.STOPPED in verdicts
    assert isinstance(checker.guard.ended, BoxReached)
    assert checker.guard.ended.box == -1
    assert -0.05 < points(checker.state.commanded)[0][0] - tool[0] < 0.05


@given(shares=st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4), direction=DIRECTION, dt=CYCLES_S)
@settings(max_examples=examples(20))
def test_boxes_that_close_in_are_kept_or_refused(shares: list[float], direction: list[float], dt: float) -> None:
    checker = GuardChecker(with_boxes(WIDE, (5.0, 5.0, 5.0, 6.0, 6.0, 6.0)), Q, dt)
    limits = checker.limits
    for share in shares:
        driven(checker, direction, 30)
        tool = points(checker.state.commanded)[0]
        walls = [t + 0.2 * share for t in tool]
        checker.change(replace(limits.widest, box=(*WIDE[:3], *walls)))


@pytest.mark.interpreted
def test_far_from_every_box_no_frames_are_computed_in_a_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = []
    monkeypatch.setattr(
        "rtcp.motion.guards.trajectory_guard.frames", lambda *given: counted.append(1) or frames(*given)
    )
    checker = GuardChecker(with_boxes(WIDE, (5.0, 5.0, 5.0, 6.0, 6.0, 6.0)), Q, 0.001)
    driven(checker, [0.5] * 6, 200)
    assert len(counted) <= 1
    assert checker.guard.poses == frames(MODEL, checker.state.commanded)


# -- exactly at a face, and thin plates ---------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("kept_in", [False, True])
def test_with_a_point_exactly_on_a_face_any_single_joint_may_be_asked_for(axis: int, kept_in: bool) -> None:
    x, y, z = frames(MODEL, Q)[6].position
    box = (*WIDE[:3], x, *WIDE[4:]) if kept_in else (x, y - 0.1, z - 0.1, x + 0.2, y + 0.1, z + 0.1)
    checker = GuardChecker(with_boxes(box) if kept_in else with_boxes(WIDE, box), Q, 0.001)
    for sign in (1.0, -1.0):
        for _ in range(60):
            way = [sign * 0.5 * checker.dt if i == axis else 0.0 for i in range(6)]
            verdict = checker.request(
                [q + w for q, w in zip(checker.state.commanded, way, strict=True)], tolerates_saturation=True
            )
            if axis == 5:
                assert verdict <= GuardResult.CLAMPED
        checker.request([float("nan")] * 6, tolerates_saturation=False)
        checker.stop()


@pytest.mark.parametrize("dt", [0.0005, 0.01, 0.1])
@pytest.mark.parametrize("gap", [0.0, 1e-7, 1e-5])
@pytest.mark.parametrize("part", [0.01, 0.3, 0.99])
def test_a_plate_that_the_first_cycle_would_cross_is_not_crossed(dt: float, gap: float, part: float) -> None:
    q = (0.0, 0.6, 1.2, 0.0, 0.0, 0.0)
    x, y, z = frames(MODEL, q)[6].position
    # Joint 1 moves the tool along y; so far it comes in a cycle from rest.
    way = abs(x) * ARM.joints[0].acceleration * dt * dt
    low = y + gap
    checker = GuardChecker(with_boxes(WIDE, (x - 0.3, low, z - 0.3, x + 0.3, low + part * way, z + 0.3)), q, dt)
    speed = ARM.joints[0].velocity if x > 0 else -ARM.joints[0].velocity
    for _ in range(50):
        checker.request([checker.state.commanded[0] + speed * dt, *q[1:]], tolerates_saturation=True)
        assert frames(MODEL, checker.state.commanded)[6].position[1] <= low + 1e-9


# -- distances ------------------------------------------------------------------------------------------------------


POINT = st.tuples(*[st.floats(-2.0, 2.0)] * 3)


@given(point=POINT)
def test_outside_is_the_distance_to_the_nearest_point_of_the_box_and_inside_the_depth(point: Point) -> None:
    box = (-1.0, -0.5, -0.2, 0.5, 0.5, 0.4)
    nearest = [min(max(x, a), d) for x, a, d in zip(point, box[:3], box[3:], strict=True)]
    away = hypot(*(x - n for x, n in zip(point, nearest, strict=True)))
    expected = away if away > 0.0 else -depth(point, box)
    assert outside(*point, box) == pytest.approx(expected, abs=1e-12)
    assert inside(*point, box) == pytest.approx(depth(point, box), abs=1e-12)


@given(q=JOINTS)
@settings(max_examples=examples(50))
def test_clearances_are_sorted_and_lead_out(q: Sequence[float]) -> None:
    limits = Limits(ARM)
    zones = Zones(MODEL, limits)
    poses = frames(MODEL, q)
    found = zones.clearances(poses, inf)
    assert [one.distance for one in found] == sorted(one.distance for one in found)
    assert len(found) == 6 + 3 * len(limits.keep_out)
    assert found[0].distance == zones.distance(poses)[0]
    for one in found:
        moved = tuple(p + 1e-6 * n for p, n in zip(poses[one.point].position, one.normal, strict=True))
        if one.box >= 0:
            further = outside(*moved, limits.keep_out[one.box]) - one.distance
            assert further == pytest.approx(1e-6, rel=1e-3)
    assert zones.clearances(poses, found[0].distance) == []


@given(q=JOINTS, direction=DIRECTION)
@settings(max_examples=examples(60))
def test_no_point_moves_further_than_the_reach_of_each_joint_says(q: Sequence[float], direction: list[float]) -> None:
    zones = Zones(MODEL, Limits(ARM))
    step = 1e-4
    moved = [angle + step * part for angle, part in zip(q, direction, strict=True)]
    bound = sum(step * abs(part) * reach for part, reach in zip(direction, zones.reach, strict=True))
    for before, after in zip(points(q), points(moved), strict=True):
        assert hypot(*(a - b for a, b in zip(after, before, strict=True))) <= bound * (1 + 1e-6) + 1e-12
    assert list(zones.reach) == sorted(zones.reach, reverse=True)


def test_a_box_that_a_fast_stop_would_jump_over_is_seen() -> None:
    # A plate 2 mm thin beside the tool, at each of many distances: a stop from full speed passes it in a cycle.
    q = (0.0, 0.6, 1.2, 0.0, 0.0, 0.0)
    tool = points(q)[0]
    for gap, sign in product([0.004 * n for n in range(1, 20, 1 if SLOW else 3)], [1.0, -1.0]):
        y = tool[1] + sign * (gap + 0.001)
        box = [tool[0] - 0.3, y - 0.001, tool[2] - 0.3, tool[0] + 0.3, y + 0.001, tool[2] + 0.3]
        checker = GuardChecker(with_boxes(WIDE, box), q, 0.01)
        side = -sign if tool[0] > 0 else sign
        driven(checker, [side, 0.0, 0.0, 0.0, 0.0, 0.0], 200)
        driven(checker, [-side, 0.0, 0.0, 0.0, 0.0, 0.0], 200)
        here = points(checker.state.commanded)[0][1]
        assert sign * here < sign * y, (gap, sign)
