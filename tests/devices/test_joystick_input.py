from __future__ import annotations

from typing import Any

import pytest

from rtcp.config.model import EmergencyStopConfig, InputConfig, InputsConfig, JoystickConfig, NamedTerminal
from rtcp.devices.io_box import JoystickInput

CYCLE = 0.0005
NEUTRAL = 63
TABLE = {
    63: (0, 0, 0),
    62: (1, 0, 0),
    61: (-1, 0, 0),
    59: (0, 1, 0),
    55: (0, -1, 0),
    47: (0, 0, 1),
    31: (0, 0, -1),
    58: (1, 1, 0),
    54: (1, -1, 0),
    57: (-1, 1, 0),
    53: (-1, -1, 0),
}  # the facts' rows, then two directions at once


def stick_of(debounce_ms: float = 0.0, **others: Any) -> JoystickInput:
    return JoystickInput(InputsConfig(joystick=JoystickConfig(debounce_ms=debounce_ms), **others), CYCLE)


def shown(stick: JoystickInput) -> tuple[float, float, int]:
    return stick.forward, stick.side, stick.paddle


def read(stick: JoystickInput, levels: int, cycles: int) -> JoystickInput:
    for _ in range(cycles):
        stick.read(levels)
    return stick


@pytest.mark.parametrize(("code", "meaning"), TABLE.items())
def test_each_code_of_the_table_means_what_it_says(code: int, meaning: tuple[int, int, int]) -> None:
    stick = read(stick_of(), code, 1)
    assert stick.valid
    assert stick.code == code
    assert shown(stick) == meaning


@pytest.mark.parametrize("first", [1, 3, 8, 9, 17])
def test_the_lines_may_begin_at_any_terminal_and_the_others_of_their_bytes_are_no_code(first: int) -> None:
    forward, backward, left, right, up, down = range(first, first + 6)
    joystick = JoystickConfig(
        forward=forward, backward=backward, left=left, right=right, mode_up=up, mode_down=down, debounce_ms=0.0
    )
    for code, meaning in TABLE.items():
        stick = read(JoystickInput(InputsConfig(joystick=joystick), CYCLE), code << first - 1, 1)
        assert (stick.valid, shown(stick)) == (True, meaning)
    bytes_of_lines = range((first - 1) // 8 * 8, (first + 4) // 8 * 8 + 8)
    for other in range(24):
        stick = read(JoystickInput(InputsConfig(joystick=joystick), CYCLE), NEUTRAL << first - 1 ^ 1 << other, 1)
        is_line, is_checked = first - 1 <= other < first + 5, other in bytes_of_lines
        assert stick.valid is (is_line or not is_checked), other


def test_an_input_beside_the_joysticks_that_has_a_name_leaves_its_code_as_it_is() -> None:
    stick = read(stick_of(named=(NamedTerminal("part", 8),)), 62 | 1 << 7, 1)
    assert (stick.valid, shown(stick)) == (True, TABLE[62])
    assert not read(stick_of(), 62 | 1 << 7, 1).valid


def test_of_the_256_bytes_only_those_of_the_table_are_codes() -> None:
    stick = stick_of()
    valid = set()
    for byte in range(256):
        read(stick, byte, 2)
        if stick.valid:
            valid.add(byte)
        else:
            assert shown(stick) == (0, 0, 0)
        assert stick.code == byte
    assert valid == set(TABLE)


@pytest.mark.parametrize(
    ("of_stick", "of_switch", "is_here"), [(None, "io", True), ("io", None, True), ("io", "desk", False)]
)
def test_a_switch_in_the_joysticks_byte_is_no_part_of_the_code_unless_it_is_at_another_box(
    of_stick: str | None, of_switch: str | None, is_here: bool
) -> None:
    switch, joystick = InputConfig(7, box=of_switch), JoystickConfig(debounce_ms=0.0, box=of_stick)
    stick = read(JoystickInput(InputsConfig(joystick=joystick, arm_toggle=switch), CYCLE), NEUTRAL | 1 << 6, 1)
    assert stick.valid is is_here


@pytest.mark.parametrize("code", [60, 51, 15, 46, 0, 255, 127], ids=lambda code: f"code {code}")
def test_contradictory_lines_and_strange_ones_are_no_code(code: int) -> None:
    stick = read(stick_of(), 62, 3)
    read(stick, code, 1)
    assert not stick.valid
    assert shown(stick) == (0, 0, 0)
    read(stick, NEUTRAL, 1)
    assert stick.valid


def test_before_the_first_level_has_lasted_nothing_is_valid() -> None:
    stick = stick_of(debounce_ms=5.0)
    assert not stick.valid
    read(stick, 62, 10)
    assert not stick.valid
    read(stick, 62, 1)
    assert stick.valid
    assert shown(stick) == (1, 0, 0)


def test_a_change_counts_after_it_has_lasted_and_a_shorter_one_never() -> None:
    stick = read(stick_of(debounce_ms=5.0), NEUTRAL, 20)
    read(stick, 62, 10)
    assert shown(stick) == (0, 0, 0)
    read(stick, NEUTRAL, 20)
    assert shown(stick) == (0, 0, 0)
    read(stick, 62, 11)
    assert shown(stick) == (1, 0, 0)
    read(stick, NEUTRAL, 10)
    assert shown(stick) == (1, 0, 0)
    read(stick, NEUTRAL, 1)
    assert shown(stick) == (0, 0, 0)


def test_lines_that_never_come_to_rest_do_not_keep_the_last_direction() -> None:
    stick = read(stick_of(debounce_ms=5.0), 62, 20)
    for cycle in range(60):
        stick.read(NEUTRAL if cycle & 1 else 62)
    assert not stick.valid
    assert shown(stick) == (0, 0, 0)
    read(stick, NEUTRAL, 11)
    assert stick.valid


def test_other_inputs_with_a_meaning_and_other_bytes_do_not_disturb_it() -> None:
    stick = stick_of(
        arm_toggle=InputConfig(7), emergency_stop=EmergencyStopConfig(8, "low"), enabling_switch=InputConfig(12)
    )
    read(stick, 0xFF00 | 0xC0 | 62, 1)
    assert stick.valid
    assert shown(stick) == (1, 0, 0)


def test_a_stick_that_is_active_high_is_neutral_at_zero() -> None:
    stick = JoystickInput(InputsConfig(joystick=JoystickConfig(active="high", debounce_ms=0.0)), CYCLE)
    read(stick, 0, 1)
    assert stick.valid
    assert shown(stick) == (0, 0, 0)
    read(stick, 0b000101, 1)
    assert shown(stick) == (1, 1, 0)


def test_a_stick_may_sit_on_the_upper_byte() -> None:
    joystick = JoystickConfig(9, 10, 11, 12, 13, 14, debounce_ms=0.0)
    stick = JoystickInput(InputsConfig(joystick=joystick), CYCLE)
    read(stick, 59 << 8 | 0xAA, 1)
    assert stick.valid
    assert stick.code == 59
    assert shown(stick) == (0, 1, 0)


def test_where_there_is_no_stick_nothing_is_ever_valid() -> None:
    stick = read(JoystickInput(InputsConfig(), CYCLE), NEUTRAL, 100)
    assert not stick.valid
    assert shown(stick) == (0, 0, 0)
