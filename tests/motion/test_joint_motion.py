"""The generator of setpoints keeps its bounds and its continuity for every target."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcp.ipc.commands import MoveJoints
from rtcp.motion.controllers.joint_move import JointMoveController
from rtcp.motion.joint_motion import JointMotion
from rtcp.motion.state import ArmState, Phase
from tests.samples import examples

from .conftest import Drive

PERIOD = 0.0005
SPEED, ACCELERATION, JERK = [0.5] * 6, [2.0] * 6, [20.0] * 6


class Driven:
    """The generator with the state of the loop, without guards."""

    def __init__(self) -> None:
        self.motion = JointMotion(PERIOD, SPEED, ACCELERATION, JERK)
        self.state = ArmState(6)

    @property
    def phase(self) -> Phase:
        return self.motion.phase

    @property
    def position(self) -> list[float]:
        return self.state.commanded

    @property
    def velocity(self) -> list[float]:
        return self.state.commanded_velocity

    def move_to(self, target: list[float], speed: float, *, synchronized: bool = True) -> bool:
        return self.motion.move_to(self.state, target, speed, synchronized=synchronized)

    def stop(self) -> None:
        self.motion.stop(self.state)

    def update(self) -> bool:
        state = self.state
        target = self.motion.update(state)
        state.commanded_acceleration = [
            (new - old) / PERIOD for new, old in zip(target.velocity, state.commanded_velocity, strict=True)
        ]
        state.commanded, state.commanded_velocity = list(target.position), list(target.velocity)
        return not self.motion.failed


def test_a_move_arrives_exactly_and_all_joints_together() -> None:
    made = Driven()
    target = [1.0, -0.5, 0.25, 0.0, 0.1, -1.0]
    made.move_to(target, 0.5)
    still_moving = []
    while made.phase is Phase.MOVE:
        assert made.update()
        still_moving.append(sum(abs(v) > 1e-9 for v in made.velocity))
    assert max(abs(a - b) for a, b in zip(made.position, target, strict=True)) < 1e-12
    assert still_moving[len(still_moving) // 2] == 5


def test_each_joint_at_its_best_arrives_earlier_the_shorter_its_way() -> None:
    made = Driven()
    target = [1.0, -0.5, 0.25, 0.0, 0.1, -1.0]
    assert made.move_to(target, 0.5, synchronized=False)
    arrived = [0.0] * 6
    time = 0.0
    while made.phase is Phase.MOVE:
        assert made.update()
        time += PERIOD
        for i in range(6):
            if abs(made.position[i] - target[i]) > 1e-6:
                arrived[i] = time
    assert max(abs(a - b) for a, b in zip(made.position, target, strict=True)) < 1e-12
    assert arrived[4] < arrived[2] < arrived[1] < arrived[0]


def test_a_slower_speed_is_kept() -> None:
    made = Driven()
    made.move_to([1.0] * 6, 0.2)
    fastest = 0.0
    while made.phase is Phase.MOVE:
        made.update()
        fastest = max(fastest, *map(abs, made.velocity))
    assert 0.199 < fastest <= 0.2 + 1e-9


def test_a_stop_comes_to_rest_and_stays() -> None:
    made = Driven()
    made.move_to([2.0] * 6, 0.5)
    for _ in range(1000):
        made.update()
    made.stop()
    assert made.phase is Phase.STOP
    while made.phase is Phase.STOP:
        made.update()
    rest = list(made.position)
    made.update()
    assert made.position == rest
    assert made.velocity == [0.0] * 6


def test_a_stop_at_rest_changes_nothing() -> None:
    made = Driven()
    made.stop()
    assert made.phase is Phase.HOLD


def test_latching_holds_there() -> None:
    made = Driven()
    made.move_to([1.0] * 6, 0.5)
    for _ in range(500):
        made.update()
    made.state.commanded_velocity = [0.0] * 6
    made.state.commanded_acceleration = [0.0] * 6
    made.motion.hold()
    position = list(made.position)
    assert made.phase is Phase.HOLD
    made.update()
    assert made.position == position


angle = st.floats(-2.0, 2.0)
event = st.one_of(
    st.tuples(st.just("move"), st.lists(angle, min_size=6, max_size=6), st.floats(0.01, 0.5)),
    st.tuples(st.just("stop"), st.none(), st.none()),
)


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(st.tuples(event, st.integers(1, 400)), min_size=1, max_size=6))
def test_position_speed_and_acceleration_stay_bounded_under_any_sequence(
    script: list[tuple[tuple[str, list[float], float], int]],
) -> None:
    made = Driven()
    position, velocity = list(made.position), list(made.velocity)
    for (kind, target, speed), cycles in script:
        if kind == "move":
            made.move_to(target, speed)
        else:
            made.stop()
        for _ in range(cycles):
            assert made.update()
            for i in range(6):
                assert math.isfinite(made.position[i])
                assert abs(made.position[i] - position[i]) <= SPEED[i] * PERIOD * (1 + 1e-6)
                assert abs(made.velocity[i] - velocity[i]) <= ACCELERATION[i] * PERIOD * (1 + 1e-3) + 1e-9
            position, velocity = list(made.position), list(made.velocity)


def test_a_distance_on_the_border_of_two_profiles_is_planned_and_reached() -> None:
    # 2 a^3 / j^2: there ruckig finds no solution with exactly these bounds.
    border = 2 * ACCELERATION[0] ** 3 / JERK[0] ** 2
    for start in range(0, 5000, 37):
        made = Driven()
        made.state.commanded = [start * 1e-4] * 6
        target = [start * 1e-4 + border, *([start * 1e-4] * 5)]
        assert made.move_to(target, 0.5), start
        while made.phase is Phase.MOVE:
            assert made.update(), start
        assert abs(made.position[0] - target[0]) < 1e-9


def test_a_move_that_would_take_too_long_is_refused_and_nothing_moves() -> None:
    made = Driven()
    for speed in (1e-3, 1e-5, 1e-7, 1e-12):
        assert not made.move_to([1.0] * 6, speed)
        assert made.phase is Phase.HOLD
    assert made.move_to([1.0] * 6, 0.5)


@settings(max_examples=examples(200), deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.floats(1e-7, 0.5))
def test_no_target_and_no_speed_raises(target: list[float], speed: float) -> None:
    made = Driven()
    if made.move_to(target, speed):
        for _ in range(50):
            assert made.update()


@pytest.mark.parametrize("stopped", [False, True], ids=["replaced", "stopped"])
@pytest.mark.parametrize("cycles", range(1990, 2070, 8))
def test_a_move_that_ends_early_while_a_joint_brakes_for_the_end_of_its_range_is_cut_by_no_guard(
    new_drive: Callable[..., Drive], cycles: int, stopped: bool
) -> None:
    drive = new_drive(period_s=0.002).at([0.0] * 6)
    controller, end = drive.controller(JointMoveController), drive.limits.low[4]
    assert drive.command(controller, MoveJoints((0.0, 0.0, 0.0, 0.0, end, 0.0), 0.5, False)) is None
    drive.run(controller, cycles)
    if stopped:
        controller.stop(drive.state)
    else:
        assert drive.command(controller, MoveJoints((1.0, 0.0, 0.0, 0.0, end, 0.0), 0.2, True)) is None
    drive.until_rest(controller)
