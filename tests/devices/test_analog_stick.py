"""The analog stick: what its channels mean, and which values stop the arm."""

from __future__ import annotations

import math
from typing import Any

import pytest

from rtcp.config.model import (
    AnalogStickConfig,
    DeviceDescription,
    InputsConfig,
    JoystickConfig,
    Pdo,
    PdoEntry,
    SlaveConfig,
    StickAxisConfig,
)
from rtcp.devices import DeviceError
from rtcp.devices.driver import Driver
from rtcp.devices.io_box import AnalogStick, JoystickInput

CYCLE = 0.0005
RELEASED, PADDLE_UP, NO_CODE, FORWARD_LINE = 63, 47, 0, 62
REST, FULL = 2.5, 2.0
"""V: a stick from 0.5 to 4.5 V, whose cut wire reads 0 or 5 V."""


def converter() -> Driver:
    """The driver of an analog slave with the channels x and y."""
    channels = tuple(PdoEntry(0x6000, n, "float32", name) for n, name in enumerate("xy", 1))
    return Driver(SlaveConfig("adc", DeviceDescription("adc", "analog", 1, 2, (), (Pdo(0x1A00, channels),))), CYCLE)


class Stick:
    """An analog stick on a slave whose channels a test sets."""

    def __init__(self, debounce_ms: float = 0.0, **keys: Any) -> None:
        self.values = (driver := converter()).values
        config = AnalogStickConfig(StickAxisConfig("adc.y", REST, FULL), StickAxisConfig("adc.x", REST, -FULL), **keys)
        joystick = JoystickConfig(debounce_ms=debounce_ms, analog=config)
        self.lines = JoystickInput(InputsConfig(joystick=joystick), CYCLE)
        self.stick = AnalogStick(joystick, {"adc": driver}, CYCLE)
        self.at(REST)

    def at(self, y: float, x: float = REST, lines: int = RELEASED, cycles: int = 2) -> AnalogStick:
        self.values["y"], self.values["x"] = y, x
        for _ in range(cycles):
            self.lines.read(lines)
            self.stick.read(self.lines)
        return self.stick


@pytest.mark.parametrize(
    ("volts", "speed"),
    [(REST, 0.0), (2.69, 0.0), (2.7, 0.0), (3.6, 0.5), (4.5, 1.0), (4.65, 1.0), (1.4, -0.5), (0.5, -1.0)],
)
def test_the_speed_rises_from_the_edge_of_the_dead_zone_to_1_at_the_full_inclination(
    volts: float, speed: float
) -> None:
    stick = Stick(dead_zone=0.1).at(volts)
    assert stick.valid
    assert stick.forward == pytest.approx(speed)
    assert stick.side == 0.0


def test_an_axis_whose_value_falls_has_the_other_sign() -> None:
    assert Stick().at(REST, 0.5).side == 1.0
    assert Stick().at(REST, 4.5).side == -1.0


def test_the_curve_is_the_exponent_of_the_speed_on_both_sides() -> None:
    assert Stick(curve=2.0).at(3.6).forward == pytest.approx(0.25)
    assert Stick(curve=2.0).at(1.4).forward == pytest.approx(-0.25)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 0.0, 5.0])
@pytest.mark.parametrize("axis", ["y", "x"])
def test_a_value_that_is_no_number_or_of_a_cut_wire_is_not_valid_and_no_full_speed(axis: str, value: float) -> None:
    stick = Stick()
    stick.at(4.5, 4.5)
    volts = {"y": REST, "x": REST, axis: value}
    shown = stick.at(volts["y"], volts["x"])
    assert not shown.valid
    assert not shown.in_range
    assert not math.isnan(shown.forward + shown.side)


def test_the_paddles_are_those_of_the_lines_and_a_paddle_beside_an_inclination_is_not_valid() -> None:
    stick = Stick()
    assert stick.at(REST, lines=PADDLE_UP).valid
    assert stick.stick.paddle == 1
    assert not stick.at(4.5, lines=PADDLE_UP).valid
    assert stick.stick.in_range


def test_lines_that_are_no_code_are_not_valid_and_a_direction_on_them_moves_nothing() -> None:
    stick = Stick()
    assert not stick.at(4.5, lines=NO_CODE).valid
    shown = stick.at(REST, lines=FORWARD_LINE)
    assert (shown.valid, shown.forward, shown.side) == (True, 0.0, 0.0)


@pytest.mark.parametrize("value", [0.0, 0.6, 4.5, 5.0, math.nan])
def test_one_false_sample_within_the_debounce_time_changes_nothing(value: float) -> None:
    stick = Stick(debounce_ms=5.0)
    stick.at(REST, cycles=10)
    shown = stick.at(value, cycles=1)
    assert (shown.valid, shown.forward, shown.side) == (True, 0.0, 0.0)


def test_an_inclination_and_a_cut_wire_count_after_the_debounce_time() -> None:
    stick = Stick(debounce_ms=5.0)
    stick.at(REST, cycles=10)
    assert 0.0 < stick.at(4.5, cycles=5).forward < 1.0
    assert stick.at(4.5, cycles=5).forward == pytest.approx(1.0)
    assert stick.at(0.0, cycles=9).valid
    assert not stick.at(0.0, cycles=1).valid


def test_before_it_is_read_it_is_not_valid() -> None:
    assert not AnalogStick(
        JoystickConfig(analog=AnalogStickConfig(StickAxisConfig("adc.y"), StickAxisConfig("adc.x"))),
        {"adc": converter()},
        CYCLE,
    ).valid


def test_a_channel_that_no_slave_sends_is_refused() -> None:
    joystick = JoystickConfig(analog=AnalogStickConfig(StickAxisConfig("adc.y"), StickAxisConfig("adc.z")))
    with pytest.raises(DeviceError, match=r"adc\.z"):
        AnalogStick(joystick, {"adc": converter()}, CYCLE)
