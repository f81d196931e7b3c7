"""The smallest value of a function of an angle: how far a point is from a curve that bounds the workspace."""

from __future__ import annotations

from collections.abc import Callable
from math import tau

_SAMPLES = 48
_VALLEYS = 2
_GOLDEN = 0.6180339887498949
_STEPS = 46  # of golden section, down to 1e-10 rad: a distance of 1e-6 m is then exact to 1e-8 of it


def smallest_of_turn(function: Callable[[float], float]) -> float:
    """The smallest value of a function of an angle (rad) over one turn.

    From samples, then by golden section in the two lowest valleys between them.
    """
    step = tau / _SAMPLES
    values = [function(index * step) for index in range(_SAMPLES)]
    valleys = sorted(
        (value, index)
        for index, value in enumerate(values)
        if value <= values[index - 1] and value <= values[(index + 1) % _SAMPLES]
    )
    return min(_narrow(function, (index - 1) * step, (index + 1) * step) for _, index in valleys[:_VALLEYS])


def _narrow(function: Callable[[float], float], lower: float, upper: float) -> float:
    left, right = upper - _GOLDEN * (upper - lower), lower + _GOLDEN * (upper - lower)
    at_left, at_right = function(left), function(right)
    for _ in range(_STEPS):
        if at_left < at_right:
            upper, right, at_right = right, left, at_left
            left = upper - _GOLDEN * (upper - lower)
            at_left = function(left)
        else:
            lower, left, at_left = left, right, at_right
            right = lower + _GOLDEN * (upper - lower)
            at_right = function(right)
    return min(at_left, at_right)
