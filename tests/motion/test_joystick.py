from __future__ import annotations

from dataclasses import dataclass

import pytest

from rtcp.config.model import FrameName, JogConfig
from rtcp.motion.controllers.joystick import Joystick

SPEED, TURN = 0.1, 0.3
X, Y, Z, RX, RY, RZ = range(6)
TABLE = [
    (0, "forward", X, SPEED), (0, "backward", X, -SPEED), (0, "left", Y, SPEED), (0, "right", Y, -SPEED),
    (1, "forward", Z, -SPEED), (1, "backward", Z, SPEED), (1, "left", RZ, TURN), (1, "right", RZ, -TURN),
    (2, "forward", RX, TURN), (2, "backward", RX, -TURN), (2, "left", RY, TURN), (2, "right", RY, -TURN),
]  # fmt: skip


@dataclass
class Shown:
    forward: float = 0
    side: float = 0
    paddle: int = 0
    valid: bool = True


NEUTRAL = Shown()
PUSHED = {"forward": Shown(1), "backward": Shown(-1), "left": Shown(0, 1), "right": Shown(0, -1)}
UP, DOWN, NO_CODE = Shown(paddle=1), Shown(paddle=-1), Shown(valid=False)


def joystick_in(mode: int = 0, frame: FrameName = "base") -> Joystick:
    joystick = Joystick(JogConfig(SPEED, TURN, frame))
    joystick.update(NEUTRAL, True)
    for _ in range(mode):
        press(joystick, UP)
    assert joystick.mode == mode
    return joystick


def press(joystick: Joystick, paddle: Shown) -> None:
    for shown in (paddle, paddle, NEUTRAL, NEUTRAL):
        joystick.update(shown, True)


def at_rest(joystick: Joystick) -> bool:
    return joystick.twist == [0.0] * 6 and not joystick.moves and joystick.grip is None


@pytest.mark.parametrize(("mode", "deflection", "direction", "speed"), TABLE)
def test_each_direction_of_each_mode_is_the_one_of_the_table_for_as_long_as_it_is_held(
    mode: int, deflection: str, direction: int, speed: float
) -> None:
    joystick = joystick_in(mode)
    for _ in range(3):
        joystick.update(PUSHED[deflection], True)
        assert joystick.moves
        assert joystick.twist == [speed if i == direction else 0.0 for i in range(6)]
    joystick.update(NEUTRAL, True)
    assert at_rest(joystick)


def test_two_directions_at_once_are_both() -> None:
    joystick = joystick_in(1)
    joystick.update(Shown(-1, -1), True)
    assert joystick.twist == [0.0, 0.0, SPEED, 0.0, 0.0, -TURN]
    joystick.update(Shown(-1, 0), True)
    assert joystick.twist == [0.0, 0.0, SPEED, 0.0, 0.0, 0.0]


def test_the_frame_is_the_configured_one() -> None:
    assert joystick_in(0, "tool").frame == "tool"


def test_a_paddle_changes_the_mode_once_and_only_when_it_is_released() -> None:
    joystick = joystick_in(0)
    for _ in range(50):
        joystick.update(UP, True)
        assert joystick.mode == 0
        assert at_rest(joystick)
    for _ in range(50):
        joystick.update(NEUTRAL, True)
        assert joystick.mode == 1


def test_the_modes_wrap_around_in_both_directions() -> None:
    joystick = joystick_in(0)
    for mode in (3, 2, 1, 0, 3):
        press(joystick, DOWN)
        assert joystick.mode == mode
    for mode in (0, 1, 2, 3, 0):
        press(joystick, UP)
        assert joystick.mode == mode


def test_the_gripper_opens_forward_and_closes_backward_once_each() -> None:
    joystick = joystick_in(3)
    for shown, grip in (
        (PUSHED["forward"], True), (PUSHED["forward"], None), (NEUTRAL, None), (PUSHED["forward"], True),
        (PUSHED["backward"], False), (PUSHED["backward"], None), (PUSHED["left"], None), (PUSHED["right"], None),
    ):  # fmt: skip
        joystick.update(shown, True)
        assert joystick.grip is grip
        assert not joystick.moves
        assert joystick.twist == [0.0] * 6


@pytest.mark.parametrize("mode", range(4))
@pytest.mark.parametrize("deflection", PUSHED)
def test_a_joystick_deflected_at_the_start_does_nothing_until_it_has_been_neutral(mode: int, deflection: str) -> None:
    joystick = Joystick(JogConfig(SPEED, TURN))
    joystick.mode = mode
    for _ in range(100):
        joystick.update(PUSHED[deflection], True)
        assert at_rest(joystick)
    joystick.update(NEUTRAL, True)
    joystick.update(PUSHED["forward"], True)
    assert joystick.moves or joystick.grip


def test_a_paddle_held_at_the_start_changes_no_mode() -> None:
    joystick = Joystick(JogConfig(SPEED, TURN))
    for shown in (UP, UP, NEUTRAL, NEUTRAL):
        joystick.update(shown, True)
    assert joystick.mode == 0


@pytest.mark.parametrize("between", [(NO_CODE, True), (PUSHED["forward"], False), (NEUTRAL, False), (NO_CODE, False)])
def test_what_is_no_code_or_not_for_the_arm_stops_at_once_and_neutral_comes_first(between: tuple[Shown, bool]) -> None:
    joystick = joystick_in(0)
    joystick.update(PUSHED["forward"], True)
    assert joystick.moves
    joystick.update(*between)
    assert at_rest(joystick)
    for _ in range(100):
        joystick.update(PUSHED["forward"], True)
        assert at_rest(joystick)
    joystick.update(NEUTRAL, True)
    joystick.update(PUSHED["forward"], True)
    assert joystick.moves


def test_neutral_while_the_joystick_is_the_wheelchairs_is_not_the_neutral_that_counts() -> None:
    joystick = joystick_in(0)
    joystick.update(NEUTRAL, False)
    joystick.update(PUSHED["left"], True)
    assert at_rest(joystick)


def test_a_joystick_pushed_while_the_paddle_is_released_waits_for_neutral() -> None:
    joystick = joystick_in(0)
    joystick.update(UP, True)
    for _ in range(100):
        joystick.update(PUSHED["forward"], True)
        assert at_rest(joystick)
    assert joystick.mode == 1
    joystick.update(NEUTRAL, True)
    joystick.update(PUSHED["forward"], True)
    assert joystick.twist[Z] == -SPEED


def test_a_paddle_that_ends_in_no_code_or_with_the_wheelchair_changes_no_mode() -> None:
    for between in ((NO_CODE, True), (UP, False)):
        joystick = joystick_in(0)
        joystick.update(UP, True)
        joystick.update(*between)
        joystick.update(NEUTRAL, True)
        joystick.update(NEUTRAL, True)
        assert joystick.mode == 0


def test_a_mode_that_was_left_comes_back_with_its_own_directions_and_nothing_of_another() -> None:
    joystick = joystick_in(0)
    joystick.update(Shown(1, 1), True)
    joystick.update(NEUTRAL, True)
    press(joystick, UP)
    joystick.update(PUSHED["left"], True)
    assert joystick.twist == [0.0, 0.0, 0.0, 0.0, 0.0, TURN]


@pytest.mark.parametrize("mode", range(4))
def test_it_begins_with_x_y_once_it_has_been_neutral(mode: int) -> None:
    joystick = joystick_in(mode)
    joystick.begin()
    joystick.update(PUSHED["forward"], True)
    assert at_rest(joystick)
    joystick.update(NEUTRAL, True)
    joystick.update(PUSHED["forward"], True)
    assert (joystick.mode, joystick.grip, joystick.twist[X]) == (0, None, SPEED)


def test_waiting_for_neutral_can_be_asked_for() -> None:
    joystick = joystick_in(3)
    joystick.update(PUSHED["forward"], True)
    joystick.wait_for_neutral()
    assert at_rest(joystick)
    joystick.update(PUSHED["forward"], True)
    assert at_rest(joystick)
