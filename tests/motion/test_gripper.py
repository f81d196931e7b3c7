"""The motion of a gripper with a drive: its limits and its grip; what shares the arm's guards: tests/control."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.config.model import Joint, Range
from rtcp.motion.controllers.gripper import GripperMotion
from rtcp.motion.state import ArmState

DT = 0.0005
JOINT = Joint("finger", "drive7", Range(-0.1, 1.5), velocity=1.0, acceleration=4.0, jerk=40.0, torque=2.0)
OPEN, CLOSED = 1.4, 0.0


class Finger:
    """The motion and the joint that it moves, from 0.5 rad on."""

    def __init__(self) -> None:
        self.motion = GripperMotion(JOINT, OPEN, CLOSED, DT)
        self.state = ArmState(1)
        self.state.commanded[0] = 0.5

    @property
    def position(self) -> float:
        return self.state.commanded[0]

    def grip(self, close: bool) -> None:
        assert self.motion.grip(self.state, close)

    def run(self, seconds: float, torque: float = 0.0) -> list[float]:
        """Let time pass with this torque; return the setpoints."""
        self.state.actual_torque[0] = torque
        path = []
        for _ in range(round(seconds / DT)):
            self.motion.update(self.state)
            path.append(self.position)
        return path


@pytest.fixture
def finger() -> Finger:
    return Finger()


@given(st.lists(st.tuples(st.sampled_from(["open", "close", "stop"]), st.integers(1, 800)), min_size=1, max_size=12))
def test_whatever_it_is_commanded_it_keeps_to_its_limits(orders: list[tuple[str, int]]) -> None:
    finger = Finger()
    path = [0.5] * 3
    for order, cycles in orders:
        finger.motion.stop(finger.state) if order == "stop" else finger.grip(order == "close")
        path += finger.run(cycles * DT)
    speeds = [(b - a) / DT for a, b in itertools.pairwise(path)]
    assert max(map(abs, speeds)) <= JOINT.velocity * (1 + 1e-6)
    assert max(abs(b - a) / DT for a, b in itertools.pairwise(speeds)) <= JOINT.acceleration * (1 + 1e-3)
    changes = [(b - a) / DT for a, b in itertools.pairwise(speeds)]
    # The acceleration at the start of a motion is known but for the jerk of a cycle.
    assert max(abs(b - a) / DT for a, b in itertools.pairwise(changes)) <= 3 * JOINT.jerk
    assert JOINT.position.min <= min(path) <= max(path) <= JOINT.position.max


@pytest.mark.parametrize(("close", "push"), [(True, -2.0), (False, 2.0)])
def test_what_it_holds_ends_the_motion_at_once(finger: Finger, close: bool, push: float) -> None:
    finger.grip(close)
    finger.run(0.3)
    before = finger.position
    finger.run(4 * DT, push)
    assert not finger.motion.gripped
    (here,) = finger.run(DT, push)
    assert finger.motion.gripped
    assert not finger.motion.moving
    assert abs(here - before) < 5 * DT * JOINT.velocity
    assert set(finger.run(1.0, push)) == {here}


@pytest.mark.parametrize(("close", "side"), [(True, -1.0), (False, 1.0)])
def test_what_it_holds_with_more_than_its_torque_it_yields_to_until_it_does_not(
    finger: Finger, close: bool, side: float
) -> None:
    finger.grip(close)
    finger.run(0.3)
    finger.run(5 * DT, 3.0 * side)
    rest = finger.position
    path = [rest, *finger.run(0.1, 2.1 * side)]
    step = JOINT.acceleration * DT * DT
    assert [(a - b) * side for a, b in itertools.pairwise(path)] == pytest.approx([step] * (len(path) - 1))
    assert set(finger.run(0.1, 1.9 * side)) == {path[-1]}
    # A push from the other side is no force of its own.
    assert set(finger.run(0.1, -5.0 * side)) == {path[-1]}
    assert finger.motion.gripped


def test_a_command_that_is_repeated_changes_nothing(finger: Finger) -> None:
    other = Finger()
    other.grip(True)
    for _ in range(1000):
        finger.grip(True)
        assert finger.run(DT) == other.run(DT)
    assert finger.motion.moving


def test_a_torque_with_the_motion_is_no_grip(finger: Finger) -> None:
    finger.grip(True)
    finger.run(0.3)
    finger.run(3.0, +5.0)
    assert finger.position == pytest.approx(CLOSED)
    assert not finger.motion.gripped


def test_a_short_blow_is_no_grip(finger: Finger) -> None:
    finger.grip(True)
    finger.run(0.3)
    for _ in range(20):
        finger.run(4 * DT, -3.0)
        finger.run(DT)
    assert finger.motion.moving
    assert not finger.motion.gripped


def test_it_lets_go_of_what_it_holds(finger: Finger) -> None:
    finger.grip(True)
    finger.run(0.3)
    finger.run(0.1, -2.0)
    rest = finger.position
    finger.grip(False)
    assert not finger.motion.gripped
    # The gripping torque lasts for a while.
    assert finger.run(0.05, -2.0)[-1] > rest
    finger.run(3.0)
    assert finger.position == pytest.approx(OPEN)
