"""Jogging into limits, boxes and singularities and away from them: the mode stops by itself, the guards never cut."""

from __future__ import annotations

import math
import random

import pytest

from kinematics.forward import forward, frames
from kinematics.jacobian import jacobian
from rtcp.config import default_config, load
from rtcp.motion.controllers.jog_bounds import JogBounds
from rtcp.motion.controllers.jog_inverse import JogInverse
from rtcp.motion.guards.zones import ITSELF
from rtcp.motion.state import Phase
from tests.samples import some

from .conftest import Driven

ARM = load(default_config())
MODEL = ARM.arm
ZERO = [0.0] * 6
BENT = [0.3, 0.2, 1.5, 0.2, 0.9, 0.1]
NEAREST = (ARM.cartesian.singularity.shoulder, ARM.cartesian.singularity.elbow, ARM.cartesian.singularity.wrist)
STANDOFF = 0.008
WALLED = (-0.8, -0.7, -0.3, 0.7, 0.7, 1.0)
"""A box whose walls are all in reach, m."""
WALLS = [(0, -1), (1, 1), (2, -1), (0, 1), (1, -1), (2, 1)]


def along(axis: int, sign: float, speed: float = 0.25) -> list[float]:
    return [sign * speed if i == axis else 0.0 for i in range(6)]


def of_joints(q: list[float], speeds: list[float]) -> list[float]:
    """The tool velocity of joint speeds, scaled down to the limits of a jog."""
    twist = [sum(a * v for a, v in zip(row, speeds, strict=True)) for row in jacobian(MODEL, q)]
    part = min(1.0, 0.2 / (math.hypot(*twist[:3]) + 1e-9), 0.4 / (math.hypot(*twist[3:]) + 1e-9))
    return [part * component for component in twist]


def before_wall(axis: int, sign: int) -> tuple[Driven, float]:
    """The arm before a wall, far from everything else, and the coordinate of the wall, m."""
    chance = random.Random(10 * axis + sign)
    while True:
        q = [chance.uniform(0.7 * limit.lower, 0.7 * limit.upper) for limit in MODEL.limits]
        drive = Driven(q)
        drive.limits.box = WALLED
        wall = WALLED[axis + 3 if sign > 0 else axis]
        shoulder, elbow, wrist = drive.singularities
        if drive.distance() > 0.08 and abs(wall - drive.tool[axis]) < 0.2 and min(2 * shoulder, elbow, wrist) > 0.5:
            drive.guard.latch(drive.state)
            return drive, wall


@pytest.mark.parametrize(("speed", "axis", "sign"), some(((v, *wall) for v in (0.25, 0.05) for wall in WALLS), 4))
def test_before_each_wall_of_the_box_the_tool_stops_and_comes_away(axis: int, sign: int, speed: float) -> None:
    drive, wall = before_wall(axis, sign)
    drive.deflect(along(axis, sign, speed), 6.0)
    assert abs(wall - drive.tool[axis]) == pytest.approx(STANDOFF, abs=2e-4)
    assert drive.least_distance > STANDOFF - 2e-4
    drive.release()
    before = drive.tool
    drive.deflect(along(axis, -sign, speed), 0.7)
    assert (drive.tool[axis] - before[axis]) * -sign > 0.01
    drive.release()


@pytest.mark.parametrize(("speed", "axis", "sign"), some(((v, *wall) for v in (0.25, 0.1) for wall in WALLS), 4))
def test_along_each_wall_the_tool_slides_with_what_is_left_of_two_directions(
    axis: int, sign: int, speed: float
) -> None:
    drive, wall = before_wall(axis, sign)
    across = (axis + 1) % 3
    twist = along(axis, sign, speed)
    drive.deflect(twist, 3.0)
    before = drive.tool
    twist[across] = -0.05 if before[across] > 0.2 else 0.05
    drive.deflect(twist, 1.0)
    assert abs(drive.tool[across] - before[across]) > 0.02
    assert abs(wall - drive.tool[axis]) == pytest.approx(STANDOFF, abs=5e-4)
    drive.release()


@pytest.mark.parametrize(
    ("q", "axis", "sign"),
    [
        ([2.2, 0.3, 1.6, 0.1, 1.6, 0.0], 0, 1),
        ([2.0, 0.2, 1.9, 0.1, 1.0, 0.0], 0, 1),
        ([1.6, -0.6, 1.6, 0.0, 1.2, 0.0], 0, 1),
        ([1.6, -0.6, 1.6, 0.0, 1.2, 0.0], 1, -1),
        ([2.2, 0.1, 1.2, 0.1, 1.0, 0.0], 2, -1),
    ],
)
@pytest.mark.parametrize("speed", some([0.25, 0.1]))
def test_before_the_user_and_the_chair_the_arm_stops_and_comes_away(
    q: list[float], axis: int, sign: int, speed: float
) -> None:
    drive = Driven(q)
    assert drive.distance() > 0.02
    drive.deflect(along(axis, sign, speed), 6.0)
    assert drive.least_distance > STANDOFF - 2e-3
    drive.release()
    before = drive.tool
    drive.deflect(along(axis, -sign, speed), 1.0)
    assert (drive.tool[axis] - before[axis]) * -sign > 0.02


@pytest.mark.parametrize(("joint", "side"), some(((j, (-1) ** j * s) for s in (1, -1) for j in range(6)), 2))
def test_no_joint_passes_its_limit_and_each_comes_away_again(joint: int, side: int) -> None:
    q = list(BENT)
    limit = MODEL.limits[joint]
    q[joint] = (limit.upper if side > 0 else limit.lower) - 0.3 * side
    drive = Driven(q)
    drive.limits.box, drive.limits.keep_out = None, ()
    drive.guard.latch(drive.state)
    for _ in range(30):
        drive.deflect(of_joints(drive.state.commanded, [0.3 * side if i == joint else 0.0 for i in range(6)]), 0.1)
    drive.release()
    reached = drive.state.commanded[joint]
    assert limit.lower <= reached <= limit.upper
    drive.deflect(of_joints(drive.state.commanded, [-0.3 * side if i == joint else 0.0 for i in range(6)]), 0.7)
    assert (drive.state.commanded[joint] - reached) * -side > 0.02
    drive.release()


@pytest.mark.parametrize(
    ("which", "q", "axis", "sign"),
    [
        (0, [0.0, 0.6, 1.4, 0.0, 1.2, 0.0], 0, 1),
        (0, [0.2, 0.6, 1.4, 0.1, 1.2, 0.0], 0, 1),
        (1, BENT, 0, -1),
        (1, BENT, 2, 1),
        (2, [0.0, 0.2, 1.5, 0.0, 0.4, 0.1], 4, -1),
        (2, [0.0, 0.2, 1.5, 0.0, 0.4, 0.1], 2, 1),
        (2, [0.0, 0.2, 1.5, 0.0, -0.4, 0.1], 4, 1),
    ],
)
@pytest.mark.parametrize("speed", some([0.25, 0.1]))
def test_before_a_singularity_the_tool_halts_and_motion_away_is_free(
    which: int, q: list[float], axis: int, sign: int, speed: float
) -> None:
    drive = Driven(q).deflect(along(axis, sign, speed), 12.0)
    distances = drive.singularities
    assert all(distance > least - 1e-3 for distance, least in zip(distances, NEAREST, strict=True))
    assert drive.release() < 0.8
    before = drive.singularities
    assert before[which] == pytest.approx(NEAREST[which], abs=2e-3)
    drive.deflect(along(axis, -sign, speed), 0.7)
    assert drive.singularities[which] > before[which] + 0.002
    drive.release()


def test_where_it_stands_for_long_nothing_winds_up() -> None:
    drive = Driven(BENT).deflect(along(0, -1), 12.0)
    assert drive.still
    before = drive.tool
    drive.deflect(along(0, 1), 0.3)
    assert drive.tool[0] - before[0] > 5e-4


@pytest.mark.parametrize("sideways", [0.0, 0.03, -0.03])
def test_straight_up_where_all_three_are_singular_the_tool_comes_down(sideways: float) -> None:
    drive = Driven(ZERO).deflect(
        [sideways, 0.0, -0.1, 0.0, 0.0, 0.0], 2.5
    )  # then the upper arm comes near to the chair
    x, y, z = drive.tool
    assert z < 1.2
    assert abs(y) < 1e-9
    assert x * sideways >= 0.0
    assert abs(x) < 2e-5 or abs(x) > 0.02
    assert drive.release() < 0.8
    assert forward(MODEL, drive.state.commanded).rotation == pytest.approx((1, 0, 0, 0, 1, 0, 0, 0, 1), abs=1e-4)


@pytest.mark.parametrize("sign", [-1, 1])
def test_straight_up_it_goes_sideways_in_the_plane_of_its_joints(sign: int) -> None:
    drive = Driven(ZERO).deflect(along(0, sign, 0.1), 2.0)
    assert drive.tool[0] * sign > 0.1
    drive.release()


@pytest.mark.parametrize(("axis", "sign"), [(2, 1), (1, 1), (1, -1), (3, 1)])
def test_straight_up_it_stands_where_it_cannot_go(axis: int, sign: int) -> None:
    drive = Driven(ZERO).deflect(along(axis, sign, 0.1), 1.0)
    assert math.dist(drive.tool, (0.0, 0.0, 1.3)) < 1e-6
    assert drive.release() < 0.1


@pytest.mark.parametrize("bend", [-0.04, -0.001, 1e-5, 0.001, 0.03])
def test_a_nearly_stretched_elbow_comes_in_again(bend: float) -> None:
    drive = Driven([0.2, -0.8, bend, 0.1, 0.7, 0.0])
    wrist = drive.guard.poses[4].position
    out = [w - s for w, s in zip(wrist, (0.0, 0.0, 0.17), strict=True)]
    drive.deflect([-0.1 * component for component in out] + [0.0] * 3, 2.0)
    assert drive.singularities[1] > 0.3


@pytest.mark.parametrize("change", ["position", "box", "keep-out box"])
def test_boundaries_are_looked_for_at_once_after_another_motion_and_when_a_box_has_changed(change: str) -> None:
    drive, _ = before_wall(1, 1)
    near, poses = drive.state.commanded, drive.guard.poses
    far = [*near]
    far[0] -= math.pi if near[0] > 0.0 else -math.pi
    inverse = JogInverse(MODEL)
    assert inverse.at(poses)
    bounds = JogBounds(drive.limits, drive.guard.zones, inverse, 0.5, 0.5, NEAREST, 0.002)
    x, y, z = drive.tool
    wall = (-9.0, -9.0, -9.0, 9.0, y + 0.02, 9.0)
    plate = (x - 0.1, y + 0.05, z - 0.1, x + 0.1, y + 0.06, z + 0.1)
    drive.limits.box, drive.limits.keep_out = None, (plate,) if change == "position" else ()
    begun = frames(MODEL, far) if change == "position" else poses
    bounds.update(begun, far if change == "position" else near, jumped=True)
    assert not [clearance for clearance in bounds.near if clearance.zone < ITSELF]
    if change == "box":
        drive.limits.box = wall
    elif change == "keep-out box":
        drive.limits.keep_out = (plate,)
    bounds.update(poses, near, jumped=change == "position")
    assert [clearance.zone for clearance in bounds.near if clearance.zone < ITSELF]


def stick(chance: random.Random) -> list[float]:
    kind = chance.random()
    if kind < 0.2:
        return list(ZERO)
    sizes = [0.25] * 3 + [0.5] * 3
    if kind < 0.7:
        kept = range(3) if kind < 0.5 else range(3, 6)
        return [chance.choice((-1, 0, 1)) * size if i in kept else 0.0 for i, size in enumerate(sizes)]
    return [chance.uniform(-1.0, 1.0) * size for size in sizes]


@pytest.mark.parametrize("seed", some(range(10)))
def test_a_random_joystick_never_needs_the_guards(seed: int) -> None:
    chance = random.Random(seed)
    drive = Driven(ZERO)
    while seed % 5 and not drive.distance() > 0.08:
        drive = Driven([chance.uniform(0.9 * limit.lower, 0.9 * limit.upper) for limit in MODEL.limits])
    for _ in range(12):
        drive.deflect(stick(chance), chance.choice((0.05, 0.3, 1.0, 2.0)), chance.choice(("base", "tool")))
    assert drive.least_distance > 0.003
    assert drive.release(1.5) < 1.5
    assert drive.jog.phase is Phase.HOLD
