"""Numbers are read as people write them, and nothing else is."""

from __future__ import annotations

import math

import pytest

from rtcp.config.numbers import angle, plain_number


@pytest.mark.parametrize(
    ("written", "number"), [("0.5", 0.5), ("-.5", -0.5), ("+1e-3", 1e-3), (" 2 ", 2.0), (3, 3.0), (0.25, 0.25)]
)
def test_a_number_is_accepted(written: object, number: float) -> None:
    assert plain_number(written) == number


@pytest.mark.parametrize("written", ["", "0_1", "\u0661", "one", "0x10", "1,5", None, [1]])
def test_what_is_no_number_is_refused(written: object) -> None:
    with pytest.raises(ValueError, match=r"number|convert"):
        plain_number(written)


@pytest.mark.parametrize(
    ("written", "number"),
    [
        ("pi", math.pi), ("-pi", -math.pi), ("+pi", math.pi), ("pi/2", math.pi / 2), ("-pi/2", -math.pi / 2),
        ("pi/4", math.pi / 4), ("3*pi/4", 3 * math.pi / 4), ("-11*pi/12", -math.radians(165)), ("2*pi", math.tau),
    ],
)  # fmt: skip
def test_a_fraction_of_pi_is_that_number(written: str, number: float) -> None:
    assert angle(written) == number


@pytest.mark.parametrize(
    "written",
    ["", "PI", "Pi", "pi ", " pi", "- pi", "--pi", "pi/0", "pi/-2", "0*pi", "pi*2", "pi/2/2", "pi+1", "2pi", "1.5*pi",
     "pi/2.0", "9999999*pi", "pi/9999999", "e", "math.pi", "__import__('os')", "pi\n", "π", "1١*pi"],
)  # fmt: skip
def test_any_other_text_is_no_angle(written: str) -> None:
    assert angle(written) == written
