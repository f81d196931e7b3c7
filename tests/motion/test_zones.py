"""No body enters a keep-out box or another body, and the tool stays in its box; an arm that begins inside may leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import hypot, inf, nan
from pathlib import Path
from random import Random
from unittest.mock import Mock

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from kinematics.capsules import outside
from kinematics.forward import forward, frames
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.config import load
from rtcp.ipc.events import BoxReached, CollisionAhead, NotLeavingBox
from rtcp.motion.guards.braking import touched
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.guards.zones import ITSELF, TOOL, Zones, inside
from rtcp.motion.limits import Limits, corners
from rtcp.motion.state import ArmState, Setpoint
from tests.arm_geometry import CLEARANCE, RADIUS, Point, box_gaps, depth, own_gap, points
from tests.samples import THOROUGH, examples, some
from tests.two_tools import two_tools

from .guard_checker import ARM, MODEL, GuardChecker, with_boxes

WIDE = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)
Q = (0.3, -0.5, 1.2, 0.2, 0.7, -0.4)
CYCLES_S = st.sampled_from([0.002, 0.005, 0.02])
SIGN = st.sampled_from([-1.0, 0.0, 1.0])
BODY = RADIUS + CLEARANCE
DIRECTION = st.lists(st.one_of(SIGN, st.floats(-1.0, 1.0)), min_size=6, max_size=6)
JOINTS = st.tuples(*(st.floats(0.9 * joint.position.min, 0.9 * joint.position.max) for joint in ARM.joints))


def box_before(point: Point, axis: int, side: float, gap: float, shift: Sequence[float], size: float) -> list[float]:
    """A box with a face `gap` before the bodies that end at a point; `shift` (-1 to 1) moves it along the face."""
    middle = [point[n] + shift[n % 2] * 1.1 * size for n in range(3)]
    middle[axis] = point[axis] + side * (BODY + gap + size)
    return [m - size for m in middle] + [m + size for m in middle]


def driven(
    checker: GuardChecker, direction: Sequence[float], cycles: int, tolerates_saturation: bool = True
) -> list[GuardResult]:
    """Request joint speeds in a direction, as parts of each joint's limit."""
    verdicts = []
    for _ in range(cycles):
        steps = [part * v * checker.dt for part, v in zip(direction, checker.limits.velocity, strict=True)]
        verdicts.append(
            checker.request(
                [q + step for q, step in zip(checker.state.commanded, steps, strict=True)], tolerates_saturation
            )
        )
    return verdicts


@given(q=JOINTS)
def test_distances_are_those_of_the_table_of_the_facts(q: Sequence[float]) -> None:
    limits = Limits(ARM)
    zones, poses = Zones(MODEL, limits, CLEARANCE), frames(MODEL, q)
    assert zones.own_distance(poses)[0] == pytest.approx(own_gap(q), abs=1e-8)
    assert poses[TOOL].position == pytest.approx(points(q)[0], abs=1e-12)
    limits.box = None
    assert zones.box_distance(poses)[0] == pytest.approx(
        min(gap for box in limits.keep_out for gap in box_gaps(q, box)), abs=1e-8
    )


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
    assume(min(*box_gaps(q, box), own_gap(q)) >= -1e-12)
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


def towards_itself(q: Sequence[float]) -> list[float]:
    """The direction in which the arm's bodies come nearer to each other fastest, as parts of each joint's speed."""
    slopes = [
        own_gap([*q[:i], q[i] + 1e-3, *q[i + 1 :]]) - own_gap([*q[:i], q[i] - 1e-3, *q[i + 1 :]]) for i in range(6)
    ]
    most = max(map(abs, slopes)) or 1.0
    return [-slope / most for slope in slopes]


@given(q=JOINTS, dt=st.sampled_from([0.005, 0.02]), tolerates=st.booleans(), noise=DIRECTION, share=st.floats(0.0, 0.5))
@settings(max_examples=examples(30))
def test_an_arm_that_is_driven_at_itself_stops_before_it(
    q: Sequence[float], dt: float, tolerates: bool, noise: Sequence[float], share: float
) -> None:
    assume(own_gap(q) >= 0.0)
    checker = GuardChecker(with_boxes(None), q, dt)  # it checks every cycle
    for _ in range(round(3.0 / dt / 20)):
        direction = [a + share * b for a, b in zip(towards_itself(checker.state.commanded), noise, strict=True)]
        driven(checker, direction, 20, tolerates)
        if isinstance(checker.guard.ended, CollisionAhead):
            assert checker.guard.ended.distance >= 0.0
            return


def test_beside_a_wall_at_the_shoulder_the_arm_moves_and_stops_before_the_wall() -> None:
    wall = (0.02, -2.0, -2.0, 1.0, 2.0, 2.0)  # m; the shoulder is at x = 0
    checker = GuardChecker(with_boxes(None, wall), [0.0, -0.5, 0.0, 0.0, 0.0, 0.0], 0.005)
    assert checker.guard.zone_at(checker.state.commanded) is None
    assert checker.guard.zone_at([0.0] * 6) == 0
    assert all(verdict <= GuardResult.CLAMPED for verdict in driven(checker, [0.0, -1.0, 0.0, 0.0, 0.0, 0.0], 100))
    driven(checker, [0.0, 1.0, 0.0, 0.0, 0.0, 0.0], 400)
    assert isinstance(checker.guard.ended, BoxReached)
    nearest = max(x for x, _, _ in points(checker.state.commanded))
    assert wall[0] - BODY - 0.01 < nearest < wall[0] - BODY + 1e-6


def test_a_stop_before_itself_names_the_links() -> None:
    q = [2.8, 1.6, -2.3, 0.4, -1.2, 0.1]
    assert 0.01 < own_gap(q) < 0.02
    checker = GuardChecker(with_boxes(None), q, 0.005)
    for _ in range(40):
        if not checker.guard.stopping:
            driven(checker, towards_itself(checker.state.commanded), 5)
    checker.stop()
    assert isinstance(checker.guard.ended, CollisionAhead)
    assert (checker.guard.ended.first, checker.guard.ended.second) in {(0, 3), (0, 5), (2, 5)}
    assert 0.0 <= own_gap(checker.state.commanded) < 0.02


def test_bodies_that_overlap_may_only_come_apart() -> None:
    q = [1.0, -1.9, 2.3, -2.9, -1.1, -0.2]
    assert -0.02 < own_gap(q) < -0.01
    checker = GuardChecker(with_boxes(None), q, 0.005)
    driven(checker, towards_itself(q), 40)
    assert isinstance(checker.guard.ended, NotLeavingBox)
    checker.stop()
    apart = [-part for part in towards_itself(checker.state.commanded)]
    for _ in range(400):
        assert driven(checker, apart, 1)[0] <= GuardResult.CLAMPED
        if own_gap(checker.state.commanded) > 0.005:
            return
    raise AssertionError("they do not come apart")


@pytest.mark.parametrize("gap", [-0.03, -1e-3, 0.0, 1e-3])
@pytest.mark.parametrize(("dt", "part"), some([(0.01, 1.0), (0.01, 0.1), (0.002, 1.0), (0.002, 0.1)], 4))
def test_the_way_out_of_a_keep_out_box_is_not_hindered(dt: float, gap: float, part: float) -> None:
    q = (0.0, 0.6, 1.2, 0.0, 0.0, 0.0)
    tool = points(q)[0]
    away = [part, 0.0, 0.0, 0.0, 0.0, 0.0] if tool[0] > 0 else [-part, 0.0, 0.0, 0.0, 0.0, 0.0]
    # Joint 1 moves the tool along y; the box begins beside it.
    face = tool[1] - BODY - gap
    box = [tool[0] - 0.3, face - 0.2, tool[2] - 0.05, tool[0] + 0.3, face, tool[2] + 0.05]
    checker = GuardChecker(with_boxes(WIDE, box), q, dt)
    while min(box_gaps(checker.state.commanded, box)) < 0.01:
        assert driven(checker, away, 1)[0] <= GuardResult.CLAMPED
    # The motion back ends before the box.
    while driven(checker, [-part for part in away], 1)[0] is not GuardResult.STOPPED:
        assert min(box_gaps(checker.state.commanded, box)) > 0.0
    assert isinstance(checker.guard.ended, BoxReached)
    assert checker.guard.ended.box == 0
    assert 0.0 <= min(box_gaps(checker.state.commanded, box)) < 0.004


@pytest.mark.interpreted
def test_a_stop_is_looked_at_in_no_more_than_sixteen_places(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Sequence[float]] = []

    def counted(model: ArmModel, q: Sequence[float]) -> tuple[Pose, ...]:
        looked.append(q)
        return frames(model, q)

    monkeypatch.setattr("rtcp.motion.guards.braking.frames", counted)
    chance, most, dt = Random(1), 0, 0.0005
    for _ in range(3000 if THOROUGH else 300):
        q = [chance.uniform(-1, 1), chance.uniform(0, 1), chance.uniform(0.8, 2), 0.3, 0.5, 0.1]
        tool, axis = points(q)[0], chance.randrange(3)
        low, high = [at - 0.5 for at in tool], [at + 0.5 for at in tool]
        high[axis] = tool[axis] - BODY - 10 ** chance.uniform(-4, -1)
        low[axis] = high[axis] - 0.3
        limits = Limits(with_boxes(WIDE, low + high))
        mean = [chance.choice((-1, 1)) * v for v in limits.velocity]
        after = [at + w * dt for at, w in zip(q, mean, strict=True)]
        looked.clear()
        touched(
            Zones(MODEL, limits, CLEARANCE),
            frames(MODEL, q),
            frames(MODEL, after),
            after, mean, limits.acceleration, dt,
        )  # fmt: skip
        most = max(most, len(looked))
    # More would take too long in a cycle; a stop that would need more counts as touching.
    assert most == 16


def test_a_stop_outside_a_box_is_never_reported_with_a_distance_inside() -> None:
    chance, stops = Random(5), 0
    while stops < (11 if THOROUGH else 2):
        q = [chance.uniform(-1, 1), chance.uniform(0, 1), chance.uniform(0.8, 2), 0.3, 0.5, 0.1]
        tool, axis = points(q)[0], chance.randrange(3)
        low, high = [at - 0.5 for at in tool], [at + 0.5 for at in tool]
        high[axis] = tool[axis] - BODY - chance.choice((0.01, 0.03, 0.06, 0.1))
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
        walls = tuple(t + 0.2 * share for t in tool)
        checker.change(replace(limits.widest, box=corners(WIDE[:3], walls)))


@pytest.mark.interpreted
def test_far_from_every_box_no_frames_are_computed_in_a_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Mock(side_effect=frames)
    monkeypatch.setattr("rtcp.motion.guards.trajectory_guard.frames", counted)
    checker = GuardChecker(with_boxes(WIDE, (5.0, 5.0, 5.0, 6.0, 6.0, 6.0)), [0.0] * 6, 0.001)
    driven(checker, [0.5] * 6, 200)
    assert counted.call_count <= 3
    assert checker.guard.poses == frames(MODEL, checker.state.commanded)


# -- what is remembered of earlier cycles ---------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("change", ["tool", "keep-out box", "box", "position"])
def test_room_from_before_a_change_is_not_used(tmp_path: Path, change: str, sign: float) -> None:
    config = load(two_tools(tmp_path))
    cartesian = replace(config.cartesian, box=None, keep_out=())
    limits = Limits(replace(config, cartesian=cartesian))
    guard, state, dt = TrajectoryGuard(config, limits, 0.002), ArmState(6), 0.002
    q = [0.0, 1.2, 0.0, 0.0, 0.0, 0.0]
    # Joint 1 moves the tool along y, towards a wall just beside the arm that is to be stopped there.
    tool = config.models[change == "tool"]
    x, y, z = forward(tool, q).position
    side = sign if x > 0.0 else -sign
    wall = y + sign * (BODY + 0.02)
    low, high = (x - 0.02, min(wall, wall + sign), z - 0.02), (x + 0.02, max(wall, wall + sign), z + 0.02)
    keep_out = corners(low, high)
    if change in ("tool", "position"):
        limits.keep_out = (keep_out,)

    def drive(cycles: int, speed: float) -> GuardResult:
        target = Setpoint(6)
        for _ in range(cycles):
            target.position = [state.commanded[0] + speed * dt, *state.commanded[1:]]
            target.velocity = [speed, *[0.0] * 5]
            result = guard.apply(state, target, tolerates_saturation=True)
        return result

    state.commanded = [q[0] + (2.0 if change == "position" else 0.0), *q[1:]]
    guard.latch(state)
    drive(5, 1e-3 * side)
    drive(20, 0.0)
    assert guard.poses == frames(config.models[0], state.commanded)
    if change == "tool":
        guard.use_tool(1)
    elif change == "keep-out box":
        limits.keep_out = (keep_out,)
    elif change == "box":
        limits.box = (-9.0, -9.0, -9.0, 9.0, y + 0.03, 9.0) if sign > 0.0 else (-9.0, y - 0.03, -9.0, 9.0, 9.0, 9.0)
    else:
        state.commanded = list(q)
        guard.latch(state)
    assert guard.poses == frames(tool, state.commanded)
    for _ in range(400):
        if drive(1, 0.5 * side) is GuardResult.STOPPED:
            break
    assert isinstance(guard.ended, BoxReached)
    assert guard.zones is not None
    assert 0.0 <= guard.zones.distance(frames(tool, state.commanded))[0] < 0.03


# -- exactly at a face, and thin plates ---------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("kept_in", [False, True])
def test_with_a_point_exactly_on_a_face_any_single_joint_may_be_asked_for(axis: int, kept_in: bool) -> None:
    x, y, z = frames(MODEL, Q)[6].position
    face = x + BODY
    box = (*WIDE[:3], x, *WIDE[4:]) if kept_in else (face, y - 0.1, z - 0.1, face + 0.2, y + 0.1, z + 0.1)
    checker = GuardChecker(with_boxes(box) if kept_in else with_boxes(WIDE, box), Q, 0.001)
    for sign in (1.0, -1.0):
        for _ in range(60):
            step = [sign * 0.5 * checker.dt if i == axis else 0.0 for i in range(6)]
            verdict = checker.request(
                [q + w for q, w in zip(checker.state.commanded, step, strict=True)], tolerates_saturation=True
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
    # Joint 1 moves the tool along y, by this step in the first cycle from rest.
    step = abs(x) * ARM.joints[0].acceleration * dt * dt
    low = y + BODY + gap
    checker = GuardChecker(with_boxes(WIDE, (x - 0.3, low, z - 0.3, x + 0.3, low + part * step, z + 0.3)), q, dt)
    speed = ARM.joints[0].velocity if x > 0 else -ARM.joints[0].velocity
    for _ in range(50):
        checker.request([checker.state.commanded[0] + speed * dt, *q[1:]], tolerates_saturation=True)
        assert frames(MODEL, checker.state.commanded)[6].position[1] <= low - BODY + 1e-9


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
    zones = Zones(MODEL, limits, CLEARANCE)
    poses = frames(MODEL, q)
    clearances = zones.clearances(poses, inf)
    assert [clearance.distance for clearance in clearances] == sorted(clearance.distance for clearance in clearances)
    assert clearances[0].distance == pytest.approx(zones.distance(poses)[0], abs=1e-12)
    for clearance in clearances:
        x, y, z = (p + 1e-6 * n for p, n in zip(clearance.place, clearance.normal, strict=True))
        if 0 <= clearance.zone < ITSELF:
            further = outside(x, y, z, limits.keep_out[clearance.zone]) - BODY - clearance.distance
            assert further == pytest.approx(1e-6, rel=1e-3)
    assert zones.clearances(poses, min(zones.room(poses), 0.0)) == []


@given(q=JOINTS)
@settings(max_examples=examples(50))
def test_every_gap_is_measured_again_between_the_bodies_where_it_was_found(q: Sequence[float]) -> None:
    zones = Zones(MODEL, Limits(ARM), CLEARANCE)
    poses = frames(MODEL, q)
    gaps = zones.gaps(poses, 9.0, 9.0)
    zones.after.place(poses)
    assert [zones.remeasure(gap, poses) for gap in gaps] == pytest.approx([gap.distance for gap in gaps], abs=1e-12)
    pairs = [gap for gap in gaps if gap.zone >= ITSELF]
    assert len({gap.zone for gap in pairs}) == len(pairs) > 1
    assert all(gap.bend > zones._shares[gap.body] for gap in pairs), "both bodies of a pair bend"


@given(q=JOINTS, direction=DIRECTION)
@settings(max_examples=examples(60))
def test_no_point_moves_further_than_the_reach_of_each_joint_says(q: Sequence[float], direction: list[float]) -> None:
    zones = Zones(MODEL, Limits(ARM), CLEARANCE)
    step = 1e-4
    moved = [angle + step * part for angle, part in zip(q, direction, strict=True)]
    bound = sum(step * abs(part) * reach for part, reach in zip(direction, zones.reach, strict=True))
    for before, after in zip(points(q), points(moved), strict=True):
        assert hypot(*(a - b for a, b in zip(after, before, strict=True))) <= bound * (1 + 1e-6) + 1e-12
    bound = sum(step * abs(part) * reach for part, reach in zip(direction, zones.pair_reach, strict=True))
    assert abs(own_gap(moved) - own_gap(q)) <= bound * (1 + 1e-6) + 1e-8
    assert list(zones.reach) == sorted(zones.reach, reverse=True)


def test_a_box_that_a_fast_stop_would_jump_over_is_seen() -> None:
    # A plate of 2 mm beside the tool, at many distances: at full speed a cycle's step is longer.
    q = (0.0, 0.6, 1.2, 0.0, 0.0, 0.0)
    tool = points(q)[0]
    for gap, sign in product([0.004 * n for n in range(1, 20, 1 if THOROUGH else 6)], [1.0, -1.0]):
        y = tool[1] + sign * (BODY + gap + 0.001)
        box = [tool[0] - 0.3, y - 0.001, tool[2] - 0.3, tool[0] + 0.3, y + 0.001, tool[2] + 0.3]
        checker = GuardChecker(with_boxes(WIDE, box), q, 0.01)
        side = -sign if tool[0] > 0 else sign
        driven(checker, [side, 0.0, 0.0, 0.0, 0.0, 0.0], 80)
        driven(checker, [-side, 0.0, 0.0, 0.0, 0.0, 0.0], 80)
        here = points(checker.state.commanded)[0][1]
        assert sign * here < sign * y, (gap, sign)
