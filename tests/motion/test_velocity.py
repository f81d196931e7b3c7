"""Joint velocities: ramps, limits, the edges of a range, and expiry."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruckig import ControlInterface, RuckigError

from rtcp.ipc.commands import MoveAtVelocity
from rtcp.ipc.events import CommandExpired
from rtcp.ipc.refusals import HoldTimeOutOfRange, JointSpeedOutOfRange, NotFinite, Refusal, WrongCount
from rtcp.motion.controllers.velocity import VelocityController
from rtcp.motion.state import Phase
from tests.samples import examples

from .conftest import Drive

PERIOD = 0.0005
NONE = [0.0] * 6


@pytest.fixture
def mode(drive: Drive) -> VelocityController:
    made: VelocityController = drive.controller(VelocityController)
    return made


def ramp(drive: Drive, mode: VelocityController, velocity: Sequence[float], hold_s: float) -> None:
    assert drive.command(mode, MoveAtVelocity(tuple(velocity), hold_s)) is None


def test_a_speed_is_reached_by_a_ramp_of_acceleration_and_jerk(new_drive: Callable[..., Drive]) -> None:
    drive = new_drive(with_jerk=True)
    mode = drive.controller(VelocityController)
    ramp(drive, mode, [0.4, -0.2, 0.0, 0.1, 0.3, -0.4], 1.0)
    # v / a + a / j = 0.4 / 2 + 2 / 20 s for the fastest.
    drive.run(mode, 598)
    assert drive.state.commanded_velocity[0] < 0.4
    drive.run(mode, 4)
    assert drive.state.commanded_velocity == pytest.approx([0.4, -0.2, 0.0, 0.1, 0.3, -0.4], abs=1e-9)
    # Half way up the ramp it has the whole acceleration, and no joint waits for another.
    before, here, after = (q[0] for q in drive.path[298:301])
    assert (after - 2.0 * here + before) / PERIOD**2 == pytest.approx(2.0, rel=1e-3)
    assert mode.phase is Phase.MOVE


@pytest.mark.parametrize(
    ("velocity", "hold_s", "refusal"),
    [
        ((0.0, 9.0, 0.0, 0.0, 0.0, 0.0), 0.5, JointSpeedOutOfRange(1, 9.0, 0.5)),
        ((0.1,) * 6, 0.0, HoldTimeOutOfRange(0.0, 1.0)),
        ((0.1,) * 6, 1.5, HoldTimeOutOfRange(1.5, 1.0)),
        ((0.1,) * 5, 0.5, WrongCount(5, 6)),
    ],
)
def test_a_command_that_is_out_of_range_is_refused(
    drive: Drive, mode: VelocityController, velocity: tuple[float, ...], hold_s: float, refusal: Refusal
) -> None:
    assert drive.command(mode, MoveAtVelocity(velocity, hold_s)) == refusal
    assert isinstance(drive.command(mode, MoveAtVelocity((nan,) * 6, 0.5)), NotFinite)
    assert mode.phase is Phase.HOLD


def test_a_velocity_that_is_not_renewed_ends_in_a_stop(drive: Drive, mode: VelocityController) -> None:
    for k in range(4):
        ramp(drive, mode, [0.3] * 6, 0.5)
        drive.run(mode, 600 + 100 * k)
        assert mode.phase is Phase.MOVE
    assert drive.state.commanded_velocity == pytest.approx([0.3] * 6)
    # 0.05 s are left of the last one, then the ramp: v / a + a / j.
    assert drive.until_rest(mode) == pytest.approx(0.05 + 0.3 / 2.0 + 2.0 / 20.0, abs=0.01)
    assert mode.ended == CommandExpired()


def test_at_rest_it_ends_without_an_event(drive: Drive, mode: VelocityController) -> None:
    ramp(drive, mode, NONE, 0.1)
    drive.run(mode, 300)
    assert (mode.phase, mode.ended) == (Phase.HOLD, None)
    assert drive.state.commanded == NONE


def test_a_stop_ramps_down_and_a_new_velocity_begins_anew(drive: Drive, mode: VelocityController) -> None:
    ramp(drive, mode, [0.5] * 6, 1.0)
    drive.run(mode, 1000)
    mode.stop(drive.state)
    assert drive.until_rest(mode) == pytest.approx(0.5 / 2.0 + 2.0 / 20.0, abs=0.005)
    assert mode.ended is None
    ramp(drive, mode, [-0.1] * 6, 1.0)
    drive.run(mode, 500)
    assert drive.state.commanded_velocity == pytest.approx([-0.1] * 6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("speed", [0.05, 0.5])
def test_a_joint_comes_to_rest_at_the_edge_of_its_range_and_leaves_it_again(
    drive: Drive, mode: VelocityController, sign: float, speed: float
) -> None:
    edges = drive.limits.high if sign > 0 else drive.limits.low
    start = [edge - sign * 0.1 for edge in edges]
    drive.at(start)
    for _ in range(25):
        ramp(drive, mode, [sign * speed] * 6, 0.5)
        drive.run(mode, 200)
    assert drive.state.commanded == pytest.approx(edges, abs=1e-6)
    assert max(map(abs, drive.state.commanded_velocity)) < 1e-6
    fastest = max(abs(b[0] - a[0]) / PERIOD for a, b in pairwise(drive.path))
    assert fastest <= speed * (1 + 1e-6)
    # It does not oscillate there, and the controller stops it, not the guard.
    joint = [sign * q[0] for q in drive.path]
    assert joint == sorted(joint)
    assert drive.cuts == 0
    assert mode.phase is Phase.MOVE
    ramp(drive, mode, [-sign * speed] * 6, 0.5)
    drive.run(mode, 1000)
    assert drive.state.commanded_velocity == pytest.approx([-sign * speed] * 6)


def test_the_ramp_continues_from_what_the_guards_have_cut(drive: Drive, mode: VelocityController) -> None:
    ramp(drive, mode, [0.4] * 6, 1.0)
    drive.run(mode, 400)
    # As after a stop before a box: at rest, a little behind the setpoint.
    drive.state.commanded_velocity, drive.state.commanded_acceleration = [0.0] * 6, [0.0] * 6
    drive.at([q - 0.01 for q in drive.state.commanded])
    before = list(drive.state.commanded)
    assert mode.update(drive.state).position == pytest.approx(before, abs=1e-6)


def test_the_other_joints_move_on_while_one_stands_at_its_edge(drive: Drive, mode: VelocityController) -> None:
    drive.at([3.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(6):
        ramp(drive, mode, [0.4] * 6, 0.5)
        drive.run(mode, 300)
    assert drive.state.commanded_velocity[1:] == pytest.approx([0.4] * 5)


def test_narrower_limits_count_from_the_next_cycle_on(drive: Drive, mode: VelocityController) -> None:
    drive.limits.high[0] = 0.1
    for _ in range(8):
        ramp(drive, mode, [0.5] * 6, 0.5)
        drive.run(mode, 250)
    assert drive.state.commanded[0] == pytest.approx(0.1, abs=1e-6)


class Failing:
    """A generator that finds no profile to a position."""

    def __init__(self, real: Any) -> None:
        self.real = real

    def update(self, parameters: Any, output: Any) -> Any:
        if ControlInterface.Position in parameters.per_dof_control_interface:
            raise RuckigError
        return self.real.update(parameters, output)


def test_where_no_way_to_an_edge_is_found_the_joints_ramp_down(drive: Drive, mode: VelocityController) -> None:
    mode._otg = Failing(mode._otg)
    drive.at([2.8, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(12):
        ramp(drive, mode, [0.4] * 6, 0.5)
        drive.run(mode, 200)
    assert mode.ended is None
    assert 2.9 < drive.state.commanded[0] < 3.1
    assert drive.cuts == 0


@settings(max_examples=examples(12))
@given(st.integers(0, 10**6))
def test_no_velocities_break_a_limit(new_drive: Callable[..., Drive], seed: int) -> None:
    chance, drive = random.Random(seed), new_drive()
    drive.at([chance.uniform(low, high) for low, high in zip(drive.limits.low, drive.limits.high, strict=True)])
    mode = drive.controller(VelocityController)
    for _ in range(25):
        ramp(drive, mode, [chance.uniform(-0.5, 0.5) for _ in range(6)], chance.choice((0.02, 0.5)))
        drive.run(mode, chance.randint(1, 300))
    mode.stop(drive.state)
    drive.until_rest(mode)
