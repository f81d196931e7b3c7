"""A virtual accelerometer at the flange: true motion of the arm, independent of the controller's feedback."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from rtcp.virtual.irc5.geometry import MM_PER_M, Geometry

_KEPT = 1000
"""Buffered samples: 4 s."""
Sample = tuple[float, float, float, float]
"""CLOCK_MONOTONIC of the sample, s; acceleration along the axes of the base, m/s^2, without gravity."""


class Accelerometer:
    """One sample per period, from the true joint positions.

    Args:
        geometry: of the arm.
        period_s: sample period.
    """

    def __init__(self, geometry: Geometry, period_s: float) -> None:
        self._geometry = geometry
        self._period_s = period_s
        self._positions: deque[tuple[float, tuple[float, float, float]]] = deque(maxlen=3)
        self._samples: deque[Sample] = deque(maxlen=_KEPT)

    def sample(self, joints: Sequence[float], stamp_s: float) -> None:
        """Add a sample for the joints of this period, degrees."""
        self._positions.append((stamp_s, self._geometry.flange(joints).position))
        if len(self._positions) == 3:
            (_, first), (middle_s, middle), (_, last) = self._positions
            scale = 1.0 / (MM_PER_M * self._period_s**2)
            x, y, z = ((a - 2.0 * b + c) * scale for a, b, c in zip(first, middle, last, strict=True))
            self._samples.append((middle_s, x, y, z))

    def take(self) -> list[Sample]:
        """Return the samples since the last call, at most the newest 4 s."""
        samples = list(self._samples)
        self._samples.clear()
        return samples
