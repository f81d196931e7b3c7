"""Paths with arcs, blends and joint moves: joints and tool along the rows, sampled finely."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import dist, pi
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics import Pose, forward
from kinematics.forward import forward_batch
from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.config.model import Stop
from rtcp.motion.limits import Limits
from rtcp.motion.planning.interpolation import derivative, quintic, value
from rtcp.motion.planning.path import plan_path
from rtcp.motion.planning.plan import ACCELERATIONS, POSITIONS, VELOCITIES, Plan, PlanRefused
from tests.samples import examples

Array = npt.NDArray[np.float64]
CONFIG = load(default_config())
assert CONFIG.arm is not None
ARM, LIMITS, CARTESIAN = CONFIG.arm, Limits(CONFIG), CONFIG.cartesian
HERE = (0.0, -0.2, 2.0, 0.0, 1.0, 0.0)
"""A place where no joint limits the tool to less than 0.1 m/s."""
START = forward(ARM, HERE)
STEP_S = 0.001


@dataclass
class Motion:
    """A plan sampled every millisecond."""

    plan: Plan
    q: Array
    v: Array
    places: Array

    @property
    def speeds(self) -> Array:
        """Speeds of the tool, m/s."""
        return np.asarray(np.linalg.norm(np.gradient(self.places, STEP_S, axis=0), axis=1))


def motion_of(plan: Plan) -> Motion:
    q, v = [], []
    row = 0
    for t in np.arange(0.0, plan.duration_s, STEP_S):
        while plan.rows[row + 1][0] < t:
            row += 1
        a, b = plan.rows[row], plan.rows[row + 1]
        pieces = [
            quintic(*[end[at + i] for end in (a, b) for at in (POSITIONS, VELOCITIES, ACCELERATIONS)] + [b[0] - a[0]])
            for i in range(6)
        ]
        x = (t - a[0]) / (b[0] - a[0])
        q.append([value(piece, x) for piece in pieces])
        v.append([value(derivative(piece), x) / (b[0] - a[0]) for piece in pieces])
    return Motion(plan, np.array(q), np.array(v), forward_batch(ARM, q)[0])


def planned(*stops: Stop, **options: Any) -> Motion:
    return motion_of(plan_path(ARM, LIMITS, CARTESIAN, HERE, stops, **options))


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0, **keys: Any) -> Stop:
    px, py, pz = START.position
    return Stop((px + x, py + y, pz + z, *START.rpy), speed=keys.pop("speed", 0.1), **keys)


def place(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> tuple[float, float, float]:
    px, py, pz = START.position
    return px + x, py + y, pz + z


def assert_within_limits(motion: Motion) -> None:
    """No joint exceeds its limits between two samples either: by differences of position and velocity."""
    for i in range(6):
        assert np.abs(motion.v[:, i]).max() <= LIMITS.velocity[i]
        assert np.abs(np.diff(motion.v[:, i])).max() <= LIMITS.acceleration[i] * STEP_S * (1.0 + 1e-6)
        assert np.abs(np.diff(motion.q[:, i]) - motion.v[:-1, i] * STEP_S).max() < 2e-6
    assert not motion.v[0].any()
    assert np.abs(motion.v[-1]).max() < 5e-3
    first, last = motion.plan.rows[0], motion.plan.rows[-1]
    assert first[POSITIONS : POSITIONS + 6] == HERE
    assert not any(last[VELOCITIES : VELOCITIES + 6])


def test_a_circle_is_one_motion_at_its_speed_and_on_the_circle() -> None:
    motion = planned(at(z=-0.2, via=place(y=0.1, z=-0.1), angle=2 * pi))
    assert_within_limits(motion)
    assert motion.plan.length_m == pytest.approx(2 * pi * 0.1, rel=1e-9)
    centre = np.array(place(z=-0.1))
    assert np.abs(np.linalg.norm(motion.places - centre, axis=1) - 0.1).max() < 1e-6
    assert np.abs(motion.places[:, 0] - centre[0]).max() < 1e-6
    assert motion.speeds.max() < 0.1001
    whole = motion.speeds[400:-400]
    assert whole.min() > 0.098
    assert motion.plan.end == pytest.approx(HERE, abs=1e-6)


@pytest.mark.parametrize("angle", [None, pi / 2, -pi / 2, 4 * pi])
def test_an_arc_goes_through_its_places_or_by_its_angle(angle: float | None) -> None:
    motion = planned(at(y=0.1, z=-0.1, via=place(y=0.1 * 2**-0.5, z=-0.1 * (1.0 - 2**-0.5)), angle=angle))
    assert_within_limits(motion)
    assert np.abs(np.linalg.norm(motion.places - place(z=-0.1), axis=1) - 0.1).max() < 1e-6
    end = {None: place(y=0.1, z=-0.1), pi / 2: place(y=0.1, z=-0.1), -pi / 2: place(y=-0.1, z=-0.1)}
    assert forward(ARM, motion.plan.end).position == pytest.approx(end.get(angle, place()), abs=1e-6)


def test_an_arc_turns_the_tool_evenly() -> None:
    px, py, pz = place(y=0.1, z=-0.1)
    rx, ry, rz = START.rpy
    goal = Pose.from_xyzrpy(px, py, pz, rx, ry + 0.3, rz)
    motion = planned(Stop((px, py, pz, rx, ry + 0.3, rz), speed=0.1, via=place(y=0.07, z=-0.03)))
    assert forward(ARM, motion.plan.end).rotation == pytest.approx(goal.rotation, abs=1e-6)


@pytest.mark.parametrize("radius", [0.002, 0.01, 0.03])
def test_a_corner_is_rounded_within_its_radius_and_without_a_rest(radius: float) -> None:
    stops = [at(y=0.1, blend=radius), at(y=0.1, z=-0.1, blend=radius), at(z=-0.1)]
    motion, resting = planned(*stops), planned(*[replace(stop, blend=0.0) for stop in stops])
    assert_within_limits(motion)
    assert motion.speeds[300:-300].min() > 0.01
    assert motion.speeds.max() < 0.101
    # A radius that is small for the speed slows the tool more than a rest does.
    assert motion.plan.duration_s < resting.plan.duration_s or radius < 0.005
    for corner in (place(y=0.1), place(y=0.1, z=-0.1)):
        near = np.linalg.norm(motion.places - corner, axis=1)
        assert 0.1 * radius < near.min() < radius
    on_the_way = np.linalg.norm(motion.places - place(y=0.05), axis=1).min()
    assert on_the_way < 1e-4


@pytest.mark.parametrize(("radius", "turns"), [(0.05, 2.0), (0.003, 5.0), (0.02, 1.9)])
def test_a_blend_takes_no_turn_of_an_arc_away_and_small_turns_are_round(radius: float, turns: float) -> None:
    motion = planned(
        at(y=radius, z=-radius, via=place(y=0.7071 * radius, z=-0.2929 * radius), angle=2 * pi * turns, blend=0.01),
        at(y=-0.1),
    )
    travelled = np.linalg.norm(np.diff(motion.places, axis=0), axis=1).sum()
    assert travelled == pytest.approx(motion.plan.length_m, rel=0.05, abs=0.012)
    centre = place(z=-radius)
    whole = motion.places[: len(motion.places) // 3]
    assert np.abs(np.linalg.norm(whole - centre, axis=1) - radius).max() < 0.02 * radius


def test_narrow_limits_of_jerk_are_kept_up_to_some_tenths() -> None:
    narrow = Limits(CONFIG)
    for jerk in (2.0, 0.2):
        narrow.jerk[:] = [jerk] * 6
        motion = motion_of(plan_path(ARM, narrow, CARTESIAN, HERE, [at(y=0.1, blend=0.02), at(y=0.1, z=-0.1)]))
        change = np.diff(motion.v, n=2, axis=0)[20:-20] / STEP_S**2
        assert np.abs(change).max() < 1.7 * jerk


def test_lines_in_one_direction_with_a_blend_are_one_line() -> None:
    motion = planned(at(y=0.05, blend=0.01), at(y=0.1))
    assert np.abs(motion.speeds[400:-400] - 0.1).max() < 1e-4
    assert np.abs(motion.places[:, 2] - START.position[2]).max() < 1e-6


def test_two_speeds_go_over_into_each_other() -> None:
    motion = planned(at(y=0.1, blend=0.01), at(y=0.2, speed=0.05))
    assert_within_limits(motion)
    assert np.median(motion.speeds[: len(motion.speeds) // 4][300:]) == pytest.approx(0.1, rel=0.01)
    assert np.median(motion.speeds[-len(motion.speeds) // 4 : -400]) == pytest.approx(0.05, rel=0.01)


def test_lines_arcs_and_joint_moves_are_blended_with_each_other() -> None:
    motion = planned(
        at(y=0.1, blend=0.02),
        at(y=0.1, z=-0.2, via=place(y=0.2, z=-0.1), blend=0.02),
        Stop(q=(0.2, 0.6, 1.6, 0.1, 0.8, 0.2), by_joints=True, blend=0.03),
        at(y=-0.1, blend=0.01),
        Stop(q=HERE, by_joints=True, speed=0.3),
    )
    assert_within_limits(motion)
    assert motion.speeds[400:-400].min() > 0.01
    assert motion.plan.end == pytest.approx(HERE)


def test_a_stop_without_blend_is_a_rest() -> None:
    motion = planned(at(y=0.1, blend=0.02), at(y=0.1, z=-0.1), at(z=-0.1, blend=0.02), at())
    rest = np.linalg.norm(motion.places - place(y=0.1, z=-0.1), axis=1).argmin()
    assert motion.speeds[rest] < 1e-3


def test_a_blend_takes_at_most_half_of_a_way() -> None:
    motion = planned(at(y=0.02, blend=1.0), at(y=0.02, z=-0.1, blend=1.0), at(z=-0.1))
    assert_within_limits(motion)
    assert np.linalg.norm(motion.places - place(y=0.01), axis=1).min() < 1e-4


def test_a_stop_where_the_arm_is_already_is_passed_over() -> None:
    assert planned(at(), at(y=0.1), at(y=0.1)).plan.length_m == pytest.approx(0.1, rel=1e-6)
    with pytest.raises(PlanRefused, match="nothing to move"):
        planned(at(blend=0.01))


@pytest.mark.parametrize(
    ("stop", "words"),
    [
        (at(y=0.1, via=place(y=0.05)), "on one line"),
        (at(via=place(y=0.1)), "on one line or not three places"),
        (at(y=1e-6, via=place(y=0.1, z=-0.1), angle=2 * pi), "not three places at least 1 mm apart"),
        (at(y=0.1, z=-0.1, via=place(y=1e-4, z=1e-4)), "not three places at least 1 mm apart"),
        (at(y=0.1, speed=1e-9, blend=0.01), "at most 86400 s are allowed"),
        (at(y=0.1, speed=1e-300, blend=0.01), "at most 86400 s are allowed"),
        (Stop(q=(0.1, *HERE[1:]), by_joints=True, speed=1e-300), "at most 86400 s are allowed"),
        (at(y=0.1, blend=1e-9), "a blend of 1e-09 m, allowed is 0 or at least 0.0001 m"),
        (at(y=0.4, via=place(y=0.2, z=-0.2), angle=600.0), "too long to be planned whole"),
        (at(y=0.1, via=place(z=-0.1), angle=0.0), "an angle of 0 rad"),
        (at(y=0.1, via=place(z=-0.1), angle=1e9), "an angle of 1e\\+09 rad"),
        (at(y=0.1, via=(float("nan"), 0.0, 0.0)), "on one line or not three places"),
        (at(y=0.1, via=place(z=-0.1), speed=1.0), "a speed of 1 m/s, allowed is more than 0 and at most 0.25"),
        (at(x=-2.0, blend=0.1), "at 0.000 m of 2.000 m|of 2.000 m"),
        (Stop(q=(9.0, *HERE[1:]), by_joints=True), "joint1 would be at 9.0000 rad"),
        (Stop(q=(0.1, *HERE[1:]), by_joints=True, speed=9.0), "a speed of 9 rad/s"),
        (Stop((5.0, 0.0, 0.0, 0.0, 0.0, 0.0), by_joints=True), "reach"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(stop: Stop, words: str) -> None:
    with pytest.raises(PlanRefused, match=words):
        planned(stop)


def test_what_leads_through_a_box_is_refused() -> None:
    with pytest.raises(PlanRefused, match="would be in the box"):
        planned(
            at(y=0.1, blend=0.02),
            at(y=0.1, z=-0.1),
            zone_at=lambda q: "the box" if dist(forward(ARM, q).position, place(y=0.1, z=-0.05)) < 0.01 else None,
        )


PLACES = st.tuples(*[st.floats(-0.1, 0.1)] * 3)


@st.composite
def stops(draw: st.DrawFn) -> Stop:
    x, y, z = draw(PLACES)
    keys: dict[str, Any] = {
        "blend": draw(st.sampled_from([0.0, 0.001, 0.01, 0.05])),
        "speed": draw(st.floats(0.01, 0.25)),
    }
    kind = draw(st.sampled_from(["line", "arc", "joints"]))
    if kind == "arc":
        keys["via"] = place(*draw(PLACES))
    elif kind == "joints":
        return Stop(at(x, y, z).pose, by_joints=True, **keys)
    return at(x, y, z, **keys)


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(stops(), min_size=1, max_size=6))
def test_random_paths_keep_every_limit_or_are_refused(program: list[Stop]) -> None:
    try:
        motion = planned(*program)
    except PlanRefused:
        return
    assert_within_limits(motion)
    assert motion.speeds.max() < 0.26 or any(stop.by_joints for stop in program)
