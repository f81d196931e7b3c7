"""The time law of a path: the fastest rate of its parameter, from rest to rest.

The parameter x of a path is its nominal time, s: the rate dx/dt = 1 is the commanded speed. Bounds of the rate and of
its derivatives are given on an even grid. A forward and a backward pass over the squared rate give the fastest
law with bounded acceleration (as in Bobrow, Dubowsky, Gibson, IJRR 4, 1985, with the joints' coupling bounded
beforehand); its mean over a window of time bounds the jerk. toppra does the first half with more exact limits, but has
no jerk limit and no wheels for aarch64.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PPoly

Array = npt.NDArray[np.float64]
_LEAST_WINDOW_S: Final = 0.004
LONGEST_WINDOW_S: Final = 1.0


@dataclass(frozen=True)
class Bounds:
    """Bounds along a path, at the points of an even grid that begins at 0: each (n,), greater than 0.

    pitch: of the grid, s of nominal time. rate: of dx/dt. acceleration, jerk: of its derivatives, 1/s, 1/s^2.
    """

    pitch: float
    rate: Array
    acceleration: Array
    jerk: Array


class TimeLaw:
    """The parameter of a path over the time, from rest to rest.

    Args:
        bounds: along the path.
    """

    def __init__(self, bounds: Bounds) -> None:
        window = float(np.clip((bounds.acceleration / bounds.jerk).max(), _LEAST_WINDOW_S, LONGEST_WINDOW_S))
        # The mean over the window mixes the rates of all places passed within half of it: each place keeps the bounds
        # of all of them. The law without this condition is faster, so it passes no fewer places.
        near = _times(_passes(bounds.rate, bounds.acceleration, bounds.pitch), bounds.pitch)
        rate, acceleration = (_least_near(bound, near, 0.5 * window) for bound in (bounds.rate, bounds.acceleration))
        rates = _passes(rate, acceleration, bounds.pitch)
        times = _times(rates, bounds.pitch)
        slopes = np.diff(rates) / np.diff(times)
        self._rate = PPoly(np.array([slopes, rates[:-1]]), times)
        self._place = self._rate.antiderivative()
        self._integral = self._place.antiderivative()
        self._window, self._end = window, float(times[-1])
        self._length = float(self._place(self._end))
        self._scale = bounds.pitch * (len(rates) - 1) / self._length
        self.duration_s = self._end + window
        """Duration from rest to rest, s."""

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return parameter, rate and derivative of the rate at times, (k,), s."""
        before = times - self._window
        scale = self._scale / self._window
        places = (self._integrals(times) - self._integrals(before)) * scale
        rates = (self._places(times) - self._places(before)) * scale
        return places, rates, (self._rates(times) - self._rates(before)) * scale

    def _rates(self, times: Array) -> Array:
        inside = (times >= 0.0) & (times <= self._end)
        return np.where(inside, self._rate(np.clip(times, 0.0, self._end)), 0.0)

    def _places(self, times: Array) -> Array:
        return np.asarray(self._place(np.clip(times, 0.0, self._end)))

    def _integrals(self, times: Array) -> Array:
        beyond = np.maximum(times - self._end, 0.0) * self._length
        return np.asarray(self._integral(np.clip(times, 0.0, self._end)) + beyond)


def _times(rates: Array, pitch: float) -> Array:
    """Return the time at each point of the grid, s."""
    return np.append(0.0, np.cumsum(2.0 * pitch / (rates[1:] + rates[:-1])))


def _least_near(values: Array, times: Array, within_s: float) -> Array:
    """Return for each point the least value among the points passed within `within_s` of it."""
    result, least = [0.0] * len(values), deque[int]()
    numbers, first, last = values.tolist(), np.searchsorted(times, times - within_s), 0
    after = np.searchsorted(times, times + within_s, side="right")
    for k, (low, high) in enumerate(zip(first.tolist(), after.tolist(), strict=True)):
        while last < high:
            while least and numbers[least[-1]] >= numbers[last]:
                least.pop()
            least.append(last)
            last += 1
        while least[0] < low:
            least.popleft()
        result[k] = numbers[least[0]]
    return np.array(result)


def _passes(rate: Array, acceleration: Array, pitch: float) -> Array:
    """Return the fastest rates from rest to rest within bounds of rate and acceleration."""
    energy = (0.5 * rate * rate).tolist()
    room = (np.minimum(acceleration[1:], acceleration[:-1]) * pitch).tolist()
    energy[0] = energy[-1] = 0.0
    for k, most in enumerate(room):
        energy[k + 1] = min(energy[k + 1], energy[k] + most)
    for k in range(len(room) - 1, -1, -1):
        energy[k] = min(energy[k], energy[k + 1] + room[k])
    speeds: Array = np.sqrt(2.0 * np.array(energy))
    return speeds
