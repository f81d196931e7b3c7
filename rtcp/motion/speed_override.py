"""The speed override: the fraction of its speed at which the arm moves, whoever commands it.

One object of the loop, written by its command handler only; controllers read it every cycle. Each brings its motion to
that speed under the limits of the joints, also while it is under way.
"""

from __future__ import annotations

from typing import Final

LOWEST: Final = 0.01
"""Lowest speed override: at 0 a motion would never end, and `rtcp halt` is the stop."""


class SpeedOverride:
    """`fraction`: `LOWEST` to 1.0."""

    __slots__ = ("fraction",)

    def __init__(self) -> None:
        self.fraction = 1.0
