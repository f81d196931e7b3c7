"""Numbers are taken as people write them, and nothing else is."""

from __future__ import annotations

import pytest

from rtcp.config.numbers import plain_number


@pytest.mark.parametrize(
    ("written", "number"), [("0.5", 0.5), ("-.5", -0.5), ("+1e-3", 1e-3), (" 2 ", 2.0), (3, 3.0), (0.25, 0.25)]
)
def test_a_number_is_taken(written: object, number: float) -> None:
    assert plain_number(written) == number


@pytest.mark.parametrize("written", ["", "0_1", "\u0661", "one", "0x10", "1,5", None, [1]])
def test_what_is_no_number_is_refused(written: object) -> None:
    with pytest.raises(ValueError, match=r"number|convert"):
        plain_number(written)
