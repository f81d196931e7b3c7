"""The speed override: every motion follows it under the limits of the joints, on its path, and at 1 not at all."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import hypot

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinematics.forward import forward
from rtcp.config.model import Point, Stop
from rtcp.ipc.commands import Jog, MoveAtVelocity, MoveJoints, RunInStep
from rtcp.ipc.refusals import SpeedOverridden
from rtcp.ipc.states import JogFrame
from rtcp.motion.controllers import Controller, JogController
from rtcp.motion.controllers.in_step import InStepController
from rtcp.motion.controllers.joint_move import JointMoveController
from rtcp.motion.controllers.line import LineController
from rtcp.motion.controllers.trajectory import TrajectoryController
from rtcp.motion.controllers.velocity import VelocityController
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.motion.speed_override import TimeScale
from tests.samples import examples

from .conftest import Drive, memory

PERIOD = 0.0005
ZERO = (0.0,) * 6
HERE = (0.0, 0.3, 1.57, 0.0, 0.5, 0.0)
A, B = (0.3, 0.2, 0.5, 0.1, 0.2, -0.3), (0.5, 0.4, 0.9, 0.1, 0.5, -0.3)
SOME = st.tuples(st.integers(0, 10**6), st.sampled_from([0.001, 0.01]))
"""Seed, and probability of a change of the override in a cycle."""


def override(controller: Controller, fraction: float) -> None:
    controller.speed_override.fraction = fraction


def change(controller: Controller, chance: random.Random, share: float) -> None:
    """Change the override at random: to a bound, to a value between them, or to 0 and back."""
    if chance.random() < share:
        # 0: a pause.
        stops = [0.0] if controller.pausable and controller.speed_override.fraction > 0.0 else []
        override(controller, chance.choice([*stops, 0.01, 1.0, chance.uniform(0.01, 1.0)]))


def trajectory(drive: Drive, points: list[Point], q: Sequence[float] = ZERO) -> TrajectoryController:
    made: TrajectoryController = drive.controller(TrajectoryController)
    plan = plan_trajectory(points, drive.limits, q)
    assert drive.execute(made, memory(plan.rows), len(plan.rows)) is None
    return made


def line(drive: Drive, speed: float = 0.1) -> LineController:
    """A line of 0.15 m and a third of it back."""
    drive.at(HERE)
    model, config = drive.config.arm, drive.config
    x, y, z = forward(model, HERE).position
    tool = forward(model, HERE).rpy
    stops = [Stop((x, y + 0.15, z, *tool)), Stop((x, y + 0.1, z, *tool))]
    plan = plan_lines(model, drive.limits, config.cartesian, HERE, stops, speed=speed)
    made: LineController = drive.controller(LineController)
    assert drive.execute(made, memory(plan.rows), len(plan.rows)) is None
    return made


def accelerations(drive: Drive, cycle: Callable[[], None]) -> list[float]:
    before = list(drive.state.commanded_velocity)
    cycle()
    return [(v - u) / PERIOD for u, v in zip(before, drive.state.commanded_velocity, strict=True)]


# -- how fast ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.05, 0.5])
def test_a_joint_move_takes_the_fraction_of_its_speed(drive: Drive, fraction: float) -> None:
    mode = drive.controller(JointMoveController)
    override(mode, fraction)
    assert drive.command(mode, MoveJoints((0.4, *ZERO[1:]), 0.4, True)) is None
    assert drive.until_rest(mode) == pytest.approx(mode.duration_s / fraction, rel=0.05)
    assert max(b[0] - a[0] for a, b in pairwise(drive.path)) / PERIOD == pytest.approx(0.4 * fraction)
    assert drive.state.commanded == pytest.approx((0.4, *ZERO[1:]), abs=1e-12)
    assert mode.elapsed_s == mode.duration_s


def test_a_joint_move_under_way_slows_down_and_speeds_up_again(new_drive: Callable[..., Drive]) -> None:
    drive = new_drive(with_jerk=True)
    mode = drive.controller(JointMoveController)
    drive.command(mode, MoveJoints((1.0, *ZERO[1:]), 0.5, True))
    drive.run(mode, 1000)
    assert drive.state.commanded_velocity[0] == pytest.approx(0.5)
    override(mode, 0.2)
    drive.run(mode, 1000)
    assert drive.state.commanded_velocity[0] == pytest.approx(0.1)
    override(mode, 1.0)
    drive.run(mode, 1000)
    assert drive.state.commanded_velocity[0] == pytest.approx(0.5)
    drive.until_rest(mode)
    assert drive.state.commanded[0] == pytest.approx(1.0, abs=1e-12)


def test_what_follows_a_slowed_move_begins_as_it_is(drive: Drive) -> None:
    mode = drive.controller(JointMoveController)
    override(mode, 0.5)
    drive.command(mode, MoveJoints((1.0, *ZERO[1:]), 0.5, True))
    drive.run(mode, 400)  # while it accelerates
    assert drive.command(mode, MoveJoints((-0.2, 0.1, *ZERO[2:]), 0.5, True)) is None
    drive.run(mode, 400)
    mode.stop(drive.state)
    assert drive.until_rest(mode) < 0.5


def test_a_line_under_way_slows_down_and_speeds_up_again(drive: Drive) -> None:
    mode = line(drive)
    fastest, places = 0.15 * mode._piece[14], []
    for fraction, cycles in ((1.0, 700), (0.1, 1400), (1.0, 1200)):
        override(mode, fraction)
        drive.run(mode, cycles)
        places.append([forward(drive.config.arm, q).position for q in drive.path[-2:]])
    speeds = [hypot(*(b - a for a, b in zip(*two, strict=True))) / PERIOD for two in places]
    assert speeds == pytest.approx([fastest, 0.1 * fastest, fastest], rel=1e-3)
    drive.until_rest(mode)
    assert mode.ended is None
    assert mode.elapsed_s == pytest.approx(mode.duration_s, abs=0.01)


@pytest.mark.parametrize("fraction", [0.1, 0.3])
def test_the_time_of_a_trajectory_passes_at_the_fraction(drive: Drive, fraction: float) -> None:
    mode = trajectory(drive, [Point(0.0, ZERO), Point(1.0, (0.1,) * 6), Point(2.0, (0.0,) * 6)])
    override(mode, fraction)
    # The override falls from 1 while the arm leaves its start, which takes less than 0.4 s.
    assert drive.until_rest(mode, 200.0) == pytest.approx(2.0 / fraction, abs=0.4 / fraction)
    assert mode.ended is None


def test_a_trajectory_under_way_slows_down_and_comes_back_to_exactly_1(new_drive: Callable[..., Drive]) -> None:
    drive = new_drive(with_jerk=True)
    mode = trajectory(drive, [Point(0.0, ZERO), Point(4.0, A), Point(8.0, B)])
    drive.run(mode, 2000)
    override(mode, 0.25)
    drive.run(mode, 2000)
    before = mode.elapsed_s
    drive.run(mode, 400)
    assert mode.elapsed_s - before == pytest.approx(0.25 * 400 * PERIOD, rel=1e-9)
    override(mode, 1.0)
    drive.run(mode, 2000)
    before = mode.elapsed_s
    drive.run(mode, 1)
    assert mode.elapsed_s == before + PERIOD
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(B, abs=1e-9)


def test_velocities_and_jogs_are_scaled_and_follow_a_change(drive: Drive) -> None:
    mode = drive.controller(VelocityController)
    for fraction in (1.0, 0.1, 0.5):
        override(mode, fraction)
        drive.command(mode, MoveAtVelocity((0.4, -0.2, 0.0, 0.0, 0.0, 0.1), 1.0))
        drive.run(mode, 1200)
        wanted = [fraction * v for v in (0.4, -0.2, 0.0, 0.0, 0.0, 0.1)]
        assert drive.state.commanded_velocity == pytest.approx(wanted, abs=1e-9)
    assert drive.cuts == 0


@pytest.mark.parametrize("frame", [JogFrame.BASE, JogFrame.TOOL])
def test_a_jog_of_the_tool_is_scaled(drive: Drive, frame: JogFrame) -> None:
    drive.at(HERE)
    mode = drive.controller(JogController)
    for fraction in (1.0, 0.1, 0.5):
        override(mode, fraction)
        for _ in range(4):
            assert drive.command(mode, Jog((0.0, 0.04, 0.0, 0.0, 0.0, 0.0), frame, 0.5)) is None
            drive.run(mode, 400)
        a, b = (forward(drive.config.arm, q).position for q in drive.path[-2:])
        assert hypot(*(y - x for x, y in zip(a, b, strict=True))) / PERIOD == pytest.approx(0.04 * fraction, rel=1e-3)


# -- within the limits, on the path -----------------------------------------------------------------------------------


@settings(max_examples=examples(5))
@given(SOME)
def test_joint_moves_keep_acceleration_and_jerk_and_arrive(
    new_drive: Callable[..., Drive], given: tuple[int, float]
) -> None:
    seed, share = given
    chance, drive = random.Random(seed), new_drive()
    mode = drive.controller(JointMoveController)
    target = tuple(chance.uniform(-0.5, 0.5) for _ in range(6))
    drive.command(mode, MoveJoints(target, chance.uniform(0.1, 0.5), chance.random() < 0.7))
    before = [0.0] * 6
    for _ in range(3000):
        change(mode, chance, share)
        change_of_speed = accelerations(drive, lambda: drive.cycle(mode))
        for i, (a, b) in enumerate(zip(before, change_of_speed, strict=True)):
            # The move has the whole jerk itself, the override half of it; and a step to 99 % of the acceleration.
            assert abs(b - a) <= 1.7 * drive.limits.jerk[i] * PERIOD + 0.011 * drive.limits.acceleration[i]
        before = change_of_speed
    override(mode, 1.0)
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(target, abs=1e-9)
    assert mode.ended is None
    for i, end in enumerate(target):  # no joint goes back: the move's path is kept
        places = [q[i] if end > 0.0 else -q[i] for q in drive.path]
        assert all(b >= a - 1e-12 for a, b in pairwise(places))


@settings(max_examples=examples(5))
@given(SOME)
def test_trajectories_keep_acceleration_and_jerk_and_their_path(
    new_drive: Callable[..., Drive], given: tuple[int, float]
) -> None:
    seed, share = given
    chance, drive, whole = random.Random(seed), new_drive(with_jerk=True), new_drive()
    points, time = [Point(0.0, ZERO)], 0.0
    for _ in range(chance.randint(1, 3)):
        time += chance.uniform(4.0, 6.0)
        points.append(Point(time, tuple(chance.uniform(-0.6, 0.6) for _ in range(6))))
    mode, undisturbed = trajectory(drive, points), trajectory(whole, points)
    for at in range(3000):
        change(mode, chance, share)
        drive.cycle(mode)
        assert 0.0 <= mode._time_scale.speed <= 1.0
        if at % 100 == 0:
            undisturbed._go_to(mode.elapsed_s)
            assert drive.state.commanded == pytest.approx(undisturbed._position, abs=1e-9)
    override(mode, 1.0)
    drive.until_rest(mode)
    assert drive.state.commanded == pytest.approx(points[-1].q, abs=1e-9)
    assert mode.ended is None


@settings(max_examples=examples(4))
@given(SOME)
def test_trajectories_at_their_limits_keep_acceleration_and_stop(
    new_drive: Callable[..., Drive], given: tuple[int, float]
) -> None:
    seed, share = given
    chance, drive, whole = random.Random(seed), new_drive(), new_drive()
    # 0.53 rad in 2 s: 98 % of the speed; the accelerations change by steps.
    points = [Point(0.0, ZERO, ZERO), Point(1.6, (0.52, -0.5, *ZERO[2:]), ZERO), Point(3.2, ZERO, ZERO)]
    mode, undisturbed = trajectory(drive, points), trajectory(whole, points)
    for _ in range(chance.randint(1, 6000)):
        change(mode, chance, share)
        drive.cycle(mode)
    mode.stop(drive.state)
    assert drive.until_rest(mode) < 1.0
    undisturbed._go_to(mode.elapsed_s)
    assert drive.state.commanded == pytest.approx(undisturbed._position, abs=1e-9)


@settings(max_examples=examples(4))
@given(SOME)
def test_lines_keep_accelerations_and_stay_on_the_line(
    new_drive: Callable[..., Drive], given: tuple[int, float]
) -> None:
    seed, share = given
    chance, drive = random.Random(seed), new_drive()
    mode = line(drive)
    x, _, z = forward(drive.config.arm, HERE).position
    for at in range(2000):
        change(mode, chance, share)
        drive.cycle(mode)
        if at % 100 == 0:
            here = forward(drive.config.arm, drive.state.commanded).position
            assert (here[0], here[2]) == pytest.approx((x, z), abs=1e-6)
    if chance.random() < 0.5:
        mode.stop(drive.state)
    override(mode, 1.0)
    drive.until_rest(mode)
    assert mode.ended is None


@settings(max_examples=examples(4))
@given(SOME)
def test_jogs_and_velocities_keep_accelerations(new_drive: Callable[..., Drive], given: tuple[int, float]) -> None:
    seed, share = given
    chance, drive = random.Random(seed), new_drive()
    drive.at(HERE)
    mode = drive.controller(JogController)
    for _ in range(10):
        frame = chance.choice([JogFrame.BASE, JogFrame.TOOL])
        twist = [chance.uniform(-0.03, 0.03) for _ in range(3)] + [chance.uniform(-0.2, 0.2) for _ in range(3)]
        drive.command(mode, Jog(tuple(twist), frame, 0.5))
        for _ in range(200):
            change(mode, chance, share)
            drive.cycle(mode)
    drive.until_rest(mode)
    assert drive.cuts == 0


# -- what is not slowed -----------------------------------------------------------------------------------------------


def test_at_1_a_trajectory_is_the_same_to_the_bit(new_drive: Callable[..., Drive]) -> None:
    paths = []
    for touched in (False, True):
        drive = new_drive()
        mode = trajectory(drive, [Point(0.0, ZERO), Point(2.0, A), Point(4.0, B)])
        if touched:
            override(mode, 1.0)
        drive.until_rest(mode)
        paths.append(drive.path)
    assert paths[0] == paths[1]


def test_a_motion_in_step_is_refused_below_1(drive: Drive) -> None:
    mode = drive.controller(InStepController)
    command = RunInStep(0, 1, 1, 0, drive.state.now_ns + 10**9, 1, 0.1)
    override(mode, 0.5)
    assert mode.accept(command, drive.state, continues=False) == SpeedOverridden(0.5)


def test_joints_that_want_opposite_changes_keep_the_rate() -> None:
    scale = TimeScale()
    scale.begin(0.8)
    # The first joint cannot become slower so fast, the second cannot become faster: after a motion was replaced.
    bounds = ([1.0, 1.0], [1.0, 0.5], [2.0, 2.0], [1000.0, 1000.0])
    assert scale.step(0.5, *bounds, 0.001) == 0.8
    assert scale.rate == 0.0


def test_from_rest_a_trajectory_begins_at_the_override(new_drive: Callable[..., Drive]) -> None:
    drive = new_drive()
    made: TrajectoryController = drive.controller(TrajectoryController)
    override(made, 0.01)
    points = [Point(0.0, ZERO, ZERO), Point(2.0, (0.3, *ZERO[1:]), ZERO)]
    plan = plan_trajectory(points, drive.limits, ZERO)
    assert drive.execute(made, memory(plan.rows), len(plan.rows)) is None
    fastest = 0.0
    for _ in range(400):
        drive.cycle(made)
        fastest = max(fastest, abs(drive.state.commanded_velocity[0]))
    assert 0.0 < fastest <= 0.01 * 1.5 * 0.3 / 2.0 + 1e-9
