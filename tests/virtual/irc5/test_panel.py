"""Modes, enabling device, Motors On, and the stops' table."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.virtual.irc5.mechanical_unit import HAND_SPEED
from rtcp.virtual.irc5.panel import STOPPING_TIME_S
from rtcp.virtual.request_socket import RequestRefused
from tests.virtual.irc5.wire import PERIOD, Pc, pc

SPEED = (20.0, 0, 0, 0, 0, 0)
TABLE = [
    # circuit, mode, whether it acts, category
    ("emergency", "auto", True, 0),
    ("emergency", "hand", True, 0),
    ("automatic", "auto", True, 1),
    ("automatic", "hand", False, 1),
    ("general", "auto", True, 1),
    ("general", "hand", True, 1),
    ("superior", "auto", True, 1),
    ("superior", "hand", True, 1),
]


def ask(robot: Pc, do: str, **keys: Any) -> Any:
    return robot.controller.request({"do": do, **keys})


def moving(mode: str = "auto", **controller: Any) -> Pc:
    """A unit whose joint 1 turns."""
    robot = pc(controller={"mode": mode, **controller})
    if mode == "hand":
        ask(robot, "enabling", position="middle")
        ask(robot, "start_rapid")
    robot.wait(0.2, None, SPEED)
    assert robot.unit.speeds[0] == pytest.approx(SPEED[0], rel=0.01)
    return robot


def time_to_rest(robot: Pc) -> float:
    cycles = 0
    while any(robot.unit.speeds):
        robot.read()
        cycles += 1
    return cycles * PERIOD


@pytest.mark.parametrize(("circuit", "mode", "acts", "category"), TABLE)
def test_a_stop_acts_where_the_table_says_and_with_its_category(
    circuit: str, mode: str, acts: bool, category: int
) -> None:
    robot = moving(mode)
    ask(robot, "stop", circuit=circuit)
    state = robot.read(None, SPEED)
    assert state.motors_on == (not acts or category == 1)
    assert (state.mci, state.rapid_running) == (("stopped", False) if acts else ("running", True))
    if acts:
        assert time_to_rest(robot) == pytest.approx(STOPPING_TIME_S[category], abs=2 * PERIOD)
        assert not robot.wait(0.1).motors_on


def test_the_category_of_the_emergency_stop_can_be_1() -> None:
    robot = moving(emergency_stop_category=1)
    ask(robot, "stop", circuit="emergency")
    assert robot.read().motors_on
    assert time_to_rest(robot) == pytest.approx(STOPPING_TIME_S[1], abs=2 * PERIOD)


def test_a_stop_of_category_0_overtakes_one_of_category_1() -> None:
    robot = moving()
    ask(robot, "stop", circuit="general")
    robot.wait(0.05)
    ask(robot, "stop", circuit="emergency")
    assert time_to_rest(robot) <= STOPPING_TIME_S[0] + PERIOD


@pytest.mark.parametrize(("circuit", "mode"), list(product(["emergency", "general", "superior"], ["auto", "hand"])))
def test_closing_the_circuit_starts_nothing_and_motors_on_is_refused_before(circuit: str, mode: str) -> None:
    robot = moving(mode)
    ask(robot, "stop", circuit=circuit)
    robot.wait(0.6)
    with pytest.raises(RequestRefused, match=f"the {circuit} stop is open: close its circuit, then press Motors On"):
        ask(robot, "motors_on")
    ask(robot, "release", circuit=circuit)
    assert not robot.wait(0.1).motors_on
    if mode == "hand":
        ask(robot, "enabling", position="released")
        ask(robot, "enabling", position="middle")
        assert not robot.wait(0.1).motors_on, "the stop is still latched"
        ask(robot, "motors_on")
        ask(robot, "enabling", position="released")
        ask(robot, "enabling", position="middle")
    else:
        ask(robot, "motors_on")
    assert robot.read().motors_on


def test_by_default_corrections_go_on_after_motors_on_as_abb_says() -> None:
    robot = moving()
    ask(robot, "stop", circuit="emergency")
    robot.wait(0.5)
    ask(robot, "release", circuit="emergency")
    ask(robot, "motors_on")
    state = robot.read()
    assert (state.mci, state.rapid_running) == ("running", True)
    assert robot.unit.speeds == [0.0] * 6, "until a new reference comes"


def test_do_not_restart_after_motors_off_waits_for_program_start() -> None:
    robot = moving(do_not_restart_after_motors_off=True)
    ask(robot, "stop", circuit="emergency")
    robot.wait(0.5)
    ask(robot, "release", circuit="emergency")
    ask(robot, "motors_on")
    assert robot.wait(0.1).mci == "stopped"
    ask(robot, "start_rapid")
    assert robot.read().mci == "running"


def test_motors_on_waits_for_the_end_of_a_stop() -> None:
    robot = moving()
    ask(robot, "motors_off")
    with pytest.raises(RequestRefused, match="the robot is still stopping"):
        ask(robot, "motors_on")


@pytest.mark.parametrize("position", ["released", "through"])
def test_in_hand_motors_are_on_only_while_the_enabling_device_is_in_the_middle(position: str) -> None:
    robot = moving("hand")
    ask(robot, "enabling", position=position)
    assert time_to_rest(robot) <= STOPPING_TIME_S[1] + PERIOD
    assert not robot.wait(0.1).motors_on


def test_an_enabling_device_that_was_pressed_through_must_be_released_first() -> None:
    robot = moving("hand")
    ask(robot, "enabling", position="through")
    robot.wait(0.6)
    ask(robot, "enabling", position="middle")
    assert not robot.read().motors_on
    ask(robot, "enabling", position="released")
    ask(robot, "enabling", position="middle")
    assert robot.read().motors_on


def test_the_enabling_device_does_nothing_in_auto() -> None:
    robot = moving()
    for position in ("middle", "through", "released"):
        ask(robot, "enabling", position=position)
        assert robot.read(None, SPEED).mci == "running"


def test_motors_on_in_hand_switches_nothing_on() -> None:
    robot = pc(controller={"mode": "hand"})
    ask(robot, "motors_on")
    assert not robot.read().motors_on


@pytest.mark.parametrize(("before", "after"), [("auto", "hand"), ("hand", "auto")])
def test_turning_the_key_stops_and_starts_nothing(before: str, after: str) -> None:
    robot = moving(before)
    ask(robot, "mode", mode=after)
    assert time_to_rest(robot) <= STOPPING_TIME_S[1] + PERIOD
    assert not robot.wait(0.2).motors_on


def test_a_circuit_that_was_open_in_hand_stops_once_the_key_is_in_auto() -> None:
    robot = moving("hand")
    ask(robot, "stop", circuit="automatic")
    ask(robot, "mode", mode="auto")
    robot.wait(0.6)
    with pytest.raises(RequestRefused, match="the automatic stop is open"):
        ask(robot, "motors_on")


def test_in_hand_the_flange_moves_at_250_mm_s_at_most_and_in_auto_faster() -> None:
    path = {}
    for mode in ("hand", "auto"):
        robot = moving(mode)
        robot.wait(0.3, None, (80.0, 0, 0, 0, 0, 0))
        flange = [robot.read(None, (80.0, 0, 0, 0, 0, 0)).part(3, 2, 1) for _ in range(2)]
        path[mode] = sum((flange[1][i][0] - flange[0][i][0]) ** 2 for i in (1, 2, 3)) ** 0.5 / PERIOD
    assert path["hand"] == pytest.approx(HAND_SPEED, rel=0.01)
    assert path["auto"] > 2 * HAND_SPEED


def test_in_hand_the_seventh_joint_has_a_speed_limit_of_its_own() -> None:
    robot = pc(axes=7, controller={"mode": "hand"}, hand_joint_speed=25.0)
    ask(robot, "enabling", position="middle")
    ask(robot, "start_rapid")
    robot.wait(0.3, None, (0, 0, 0, 0, 0, 0, 100.0))
    assert robot.unit.speeds[6] == pytest.approx(25.0)
