"""The way of a gripper with a drive: its limits, its grip, its stop."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.config.model import Joint, Range
from rtcp.motion.controllers.gripper import GripperMotion
from rtcp.motion.state import Setpoint

DT = 0.0005
JOINT = Joint("finger", "drive7", Range(-0.1, 1.5), velocity=1.0, acceleration=4.0, jerk=40.0, torque=2.0)
OPEN, CLOSED = 1.4, 0.0


@pytest.fixture
def motion() -> GripperMotion:
    motion = GripperMotion(JOINT, OPEN, CLOSED, DT)
    motion.latch(0.5)
    return motion


def run(motion: GripperMotion, seconds: float, torque: float = 0.0) -> list[float]:
    return [motion.update(torque) for _ in range(round(seconds / DT))]


def test_it_rests_where_it_is_latched(motion):
    assert set(run(motion, 0.1)) == {0.5}
    assert not motion.moving


@pytest.mark.parametrize(("close", "goal"), [(True, CLOSED), (False, OPEN)])
def test_it_goes_to_where_it_is_closed_or_open(motion, close, goal):
    assert motion.grip(close)
    assert motion.moving
    run(motion, 3.0)
    assert motion.position == pytest.approx(goal)
    assert not motion.moving
    assert not motion.gripped


@given(st.lists(st.tuples(st.sampled_from(["open", "close", "stop"]), st.integers(1, 800)), min_size=1, max_size=12))
def test_whatever_it_is_commanded_it_keeps_to_its_limits(orders):
    motion = GripperMotion(JOINT, OPEN, CLOSED, DT)
    motion.latch(0.5)
    path = [0.5] * 3
    for order, cycles in orders:
        motion.stop() if order == "stop" else motion.grip(order == "close")
        path += [motion.update(0.0) for _ in range(cycles)]
    speeds = [(b - a) / DT for a, b in itertools.pairwise(path)]
    assert max(map(abs, speeds)) <= JOINT.velocity * (1 + 1e-6)
    assert max(abs(b - a) / DT for a, b in itertools.pairwise(speeds)) <= JOINT.acceleration * (1 + 1e-3)
    changes = [(b - a) / DT for a, b in itertools.pairwise(speeds)]
    # The acceleration at the beginning of a way is known but for the jerk of a cycle.
    assert max(abs(b - a) / DT for a, b in itertools.pairwise(changes)) <= 3 * JOINT.jerk
    assert JOINT.position.min <= min(path) <= max(path) <= JOINT.position.max


@pytest.mark.parametrize(("close", "push"), [(True, -2.0), (False, 2.0)])
def test_what_it_holds_ends_the_motion_at_once(motion, close, push):
    motion.grip(close)
    run(motion, 0.3)
    before = motion.position
    run(motion, 4 * DT, push)
    assert not motion.gripped
    here = motion.update(push)
    assert motion.gripped
    assert not motion.moving
    assert abs(here - before) < 5 * DT * JOINT.velocity
    assert set(run(motion, 1.0, push)) == {here}


@pytest.mark.parametrize(("close", "side"), [(True, -1.0), (False, 1.0)])
def test_what_it_holds_with_more_than_its_torque_it_yields_to_until_it_does_not(motion, close, side):
    motion.grip(close)
    run(motion, 0.3)
    run(motion, 5 * DT, 3.0 * side)
    held = motion.position
    path = [held, *run(motion, 0.1, 2.1 * side)]
    step = JOINT.acceleration * DT * DT
    assert [(a - b) * side for a, b in itertools.pairwise(path)] == pytest.approx([step] * (len(path) - 1))
    assert set(run(motion, 0.1, 1.9 * side)) == {path[-1]}
    # A push from the other side is no force of its own.
    assert set(run(motion, 0.1, -5.0 * side)) == {path[-1]}
    assert motion.gripped


def test_it_yields_no_further_than_its_range(motion):
    motion.grip(False)
    run(motion, 0.3)
    run(motion, 5 * DT, 3.0)
    motion._state.commanded[0] = JOINT.position.min
    assert set(run(motion, 0.1, 3.0)) == {JOINT.position.min}


def test_a_stop_before_its_first_step_is_a_stop(motion):
    motion.grip(True)
    motion.stop()
    assert not motion.moving
    assert set(run(motion, 0.5)) == {0.5}


def test_a_command_that_is_repeated_changes_nothing(motion):
    other = GripperMotion(JOINT, OPEN, CLOSED, DT)
    other.latch(0.5)
    path = []
    other.grip(True)
    for _ in range(2000):
        assert motion.grip(True) or not motion.moving
        path.append((motion.update(0.0), other.update(0.0)))
    assert all(one == two for one, two in path[:1500])


@pytest.mark.interpreted
@pytest.mark.parametrize("wanted", [float("nan"), float("inf"), -float("inf"), 1e300, 5.0, -5.0, 0.51])
def test_no_set_point_passes_that_is_not_one_step_away(motion, monkeypatch, wanted):
    motion.grip(False)

    def astray(state):
        target = Setpoint(1)
        target.position[0] = wanted
        return target

    monkeypatch.setattr(motion._motion, "update", astray)
    path = [0.5, *run(motion, 2.0)]
    assert all(abs(b - a) <= JOINT.velocity * DT * (1 + 1e-9) for a, b in itertools.pairwise(path))
    assert JOINT.position.min <= min(path) <= max(path) <= JOINT.position.max


def test_a_torque_with_the_motion_is_no_grip(motion):
    motion.grip(True)
    run(motion, 0.3)
    run(motion, 3.0, +5.0)
    assert motion.position == pytest.approx(CLOSED)
    assert not motion.gripped


def test_a_short_blow_is_no_grip(motion):
    motion.grip(True)
    run(motion, 0.3)
    for _ in range(20):
        run(motion, 4 * DT, -3.0)
        run(motion, DT)
    assert motion.moving
    assert not motion.gripped


def test_it_lets_go_of_what_it_holds(motion):
    motion.grip(True)
    run(motion, 0.3)
    run(motion, 0.1, -2.0)
    held = motion.position
    assert motion.grip(False)
    assert not motion.gripped
    # The torque that held it is there for a while.
    assert run(motion, 0.05, -2.0)[-1] > held
    run(motion, 3.0)
    assert motion.position == pytest.approx(OPEN)


def test_it_can_be_stopped_on_its_way_and_go_on(motion):
    motion.grip(True)
    run(motion, 0.3)
    motion.stop()
    run(motion, 0.5)
    assert not motion.moving
    assert CLOSED < motion.position < 0.5
    motion.grip(True)
    run(motion, 3.0)
    assert motion.position == pytest.approx(CLOSED)


@pytest.mark.parametrize(("here", "there"), [(-0.3, -0.1), (1.7, 1.5), (0.7, 0.7)])
def test_outside_its_range_it_rests_at_the_edge(motion, here, there):
    motion.latch(here)
    assert motion.position == there
    assert motion.update(0.0) == there
