"""Jogging far from all limits, in a simulated loop: the mode, then the guards, which never have to cut."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import pytest

from kinematics import Pose
from kinematics.forward import forward, frames
from kinematics.jacobian import jacobian, singularity_distances
from rtcp.config import default_config, load
from rtcp.config.model import FrameName
from rtcp.ipc.commands import Jog
from rtcp.ipc.events import NoSolution
from rtcp.ipc.states import JogFrame
from rtcp.motion.controllers import JogController
from rtcp.motion.controllers.jog_inverse import JogInverse
from rtcp.motion.state import Phase
from tests.samples import some

from .conftest import JOG_PERIOD, Drive, Driven

MODEL = load(default_config()).arm
ZERO = [0.0] * 6
BENT = [0.3, 0.2, 1.5, 0.2, 0.9, 0.1]
AXES = ("x", "y", "z", "rx", "ry", "rz")
DIRECTIONS = [sign + axis for axis in AXES for sign in "+-"]


def twist_of(directions: str, speed: float = 0.1, turning: float = 0.3) -> list[float]:
    twist = [0.0] * 6
    for direction in directions.split():
        axis = AXES.index(direction[1:])
        twist[axis] = (1.0 if direction[0] == "+" else -1.0) * (speed if axis < 3 else turning)
    return twist


def off_line(start: Sequence[float], direction: Sequence[float], point: Sequence[float]) -> float:
    size = math.hypot(*direction)
    along = sum((p - s) * d for p, s, d in zip(point, start, direction, strict=True)) / size
    return math.hypot(*(p - s - along * d / size for p, s, d in zip(point, start, direction, strict=True)))


def turned_between(first: Pose, second: Pose) -> float:
    trace = sum(a * b for a, b in zip(first.rotation, second.rotation, strict=True))
    return math.acos(max(-1.0, min(1.0, 0.5 * (trace - 1.0))))


@pytest.mark.parametrize(
    ("directions", "speed"), some(product(["+x", "-x", "+y", "-y", "+z", "-z", "+x +y", "-y -z"], [0.1, 0.25]))
)
def test_the_tool_keeps_to_its_straight_line_and_to_its_direction(directions: str, speed: float) -> None:
    drive = Driven(BENT)
    pose = forward(MODEL, BENT)
    twist = twist_of(directions, speed)
    drive.deflect(twist, 1.0)
    drive.release()
    drive.tools.append(drive.tool)
    assert math.dist(drive.tool, pose.position) > 0.09
    assert max(off_line(pose.position, twist[:3], point) for point in drive.tools) < 2e-6
    assert turned_between(pose, forward(MODEL, drive.state.commanded)) < 2e-6


@pytest.mark.parametrize(
    ("directions", "frame"), some(product(["+rx", "-rx", "+ry", "-ry", "+rz", "-rz", "+rx -rz"], ["base", "tool"]))
)
def test_a_turn_leaves_the_tool_where_it_is(directions: str, frame: FrameName) -> None:
    drive = Driven(BENT).deflect(twist_of(directions), 1.5, frame)
    drive.release()
    assert math.dist(drive.tool, forward(MODEL, BENT).position) < 2e-6
    assert turned_between(forward(MODEL, BENT), forward(MODEL, drive.state.commanded)) > 0.3


@pytest.mark.parametrize("axis", range(3))
def test_in_the_frame_of_the_tool_the_line_is_along_the_tools_axis(axis: int) -> None:
    drive = Driven(BENT)
    rotation = forward(MODEL, BENT).rotation
    start = drive.tool
    twist = [0.05 if i == axis else 0.0 for i in range(6)]
    drive.deflect(twist, 1.0, "tool")
    direction = [rotation[3 * row + axis] for row in range(3)]
    assert max(off_line(start, direction, point) for point in drive.tools) < 2e-6
    assert sum((b - a) * d for a, b, d in zip(start, drive.tool, direction, strict=True)) > 0.03


def test_at_full_deflection_the_tool_has_the_speed_that_is_asked_for() -> None:
    drive = Driven(BENT).deflect(twist_of("+z"), 1.0)
    before = drive.tool
    drive.deflect(twist_of("+z"), 0.1)
    assert math.dist(before, drive.tool) == pytest.approx(0.01, rel=1e-6)


def test_no_command_makes_the_tool_faster_than_250_mm_a_second() -> None:
    drive = Driven(BENT)
    fastest = 0.0
    for _ in range(120):
        before = drive.tool
        drive.deflect([0.25, 0.25, -0.25, 0.0, 0.0, 0.0], 0.01)
        fastest = max(fastest, math.dist(before, drive.tool) / 0.01)
    assert 0.1 < fastest < 0.2501


@pytest.mark.parametrize(("directions", "after"), some(product(DIRECTIONS, [0.02, 0.3, 1.5]), 5))
def test_released_it_comes_to_rest_within_eight_tenths_of_a_second(directions: str, after: float) -> None:
    drive = Driven(BENT).deflect(twist_of(directions, 0.25, 0.5), after)
    assert not drive.still
    assert drive.release() < 0.8


def test_a_stop_that_is_under_way_is_not_taken_back_by_a_command() -> None:
    drive = Driven(BENT).deflect(twist_of("+z"), 1.0)
    drive.jog.stop(drive.state)
    for _ in range(round(0.8 / JOG_PERIOD)):
        drive.jog.command(twist_of("+z"), in_tool_frame=False)
        drive.jog_cycle()
    assert drive.jog.phase is Phase.HOLD
    assert drive.jog.ended is None


def test_a_command_counts_until_its_instant_and_not_longer() -> None:
    drive = Driven(BENT)
    drive.jog.start()
    drive.jog.command(twist_of("+z"), in_tool_frame=False, until_ns=500_000_000)
    while drive.state.now_ns < 500_000_000:
        drive.jog_cycle()
    assert drive.jog.phase is Phase.MOVE
    for _ in range(round(0.6 / JOG_PERIOD)):
        drive.jog_cycle()
    assert drive.jog.phase is Phase.HOLD


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 1e300])
def test_a_command_that_is_no_number_stops(number: float) -> None:
    drive = Driven(BENT).deflect(twist_of("+z"), 0.5)
    drive.deflect([0.0, number, 0.0, 0.0, 0.0, 0.0], 1.0)
    assert drive.still


@pytest.mark.parametrize("direction", ["+x", "-x", "-z", "+ry"])
def test_started_while_the_arm_moves_it_goes_on_without_a_jump(direction: str) -> None:
    drive = Driven(BENT).deflect(twist_of(direction), 0.5)
    before = list(drive.state.commanded_velocity)
    drive.jog.start()
    drive.deflect(twist_of(direction), JOG_PERIOD)
    after = drive.state.commanded_velocity
    assert max(map(abs, before)) > 0.05
    assert after == pytest.approx(before, abs=2e-3)
    drive.deflect(twist_of(direction), 0.5)
    assert drive.cuts == 0


def test_the_inverse_and_the_distances_are_those_of_the_kinematics() -> None:
    chance = random.Random(3)
    inverse = JogInverse(MODEL)
    for _ in range(300):
        q = [chance.uniform(limit.lower, limit.upper) for limit in MODEL.limits]
        poses = frames(MODEL, q)
        assert inverse.at(poses)
        if any(inverse.locked):
            continue
        columns = list(zip(*jacobian(MODEL, q), strict=True))
        for i, row in enumerate(inverse.rows):
            for k, column in enumerate(columns):
                assert sum(a * b for a, b in zip(row, column, strict=True)) == pytest.approx(float(i == k), abs=1e-9)
        distances = singularity_distances(MODEL, q)[:3]
        assert inverse.distance[0] == pytest.approx(distances[0], abs=1e-12)
        assert min(inverse.distance[1], math.pi - inverse.distance[1]) == pytest.approx(distances[1], abs=1e-12)
        assert inverse.distance[2] == pytest.approx(distances[2], abs=1e-9)
        speeds = [chance.uniform(-1.0, 1.0) for _ in range(6)]
        twist = [sum(v * column[k] for v, column in zip(speeds, columns, strict=True)) for k in range(6)]
        rates = [sum(a * b for a, b in zip(row, twist, strict=True)) for row in inverse.rate]
        before = list(inverse.distance)
        inverse.at(frames(MODEL, [a + 1e-7 * v for a, v in zip(q, speeds, strict=True)]))
        for old, new, rate in zip(before, inverse.distance, rates, strict=True):
            assert (new - old) / 1e-7 == pytest.approx(rate, abs=1e-4)


def test_a_jog_of_a_tool_without_an_inverse_says_so_instead_of_a_distance_of_zero(drive: Drive) -> None:
    wrist = replace(MODEL.rows[4], a=0.1)
    model = replace(MODEL, rows=(*MODEL.rows[:4], wrist, *MODEL.rows[5:]))
    mode = drive.at(BENT).controller(JogController, arm=model)
    assert drive.command(mode, Jog((0.0, 0.0, 0.05, 0.0, 0.0, 0.0), JogFrame.BASE, 0.2)) is None
    drive.until_rest(mode)
    assert mode.ended == NoSolution()
    assert drive.state.commanded == BENT
