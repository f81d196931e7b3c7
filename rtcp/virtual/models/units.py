"""The objects of an axis of a drive, and their units."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi

from rtcp.virtual.objects import Number, ObjectDictionary, bounds

AXIS_STRIDE = 0x800
"""Index offset between two axes of a drive: 0x6040 and 0x6840 (ETG.6010, CiA 402-2)."""
LIMITLESS = 0x7FFF_FFFF
"""Value for "unlimited"."""
_PROFILE = range(0x6000, 0x6800)
"""Objects of the first axis; lower ones belong to the whole device."""
_INCREMENT = 0xB5
_ANGLES = {0xB4: 2 * pi, 0xB6: 2 * pi / 60, 0x10: 1.0, 0x41: pi / 180}
"""Notation index of a numerator -> rad: revolution, revolution per minute, radian, degree (ETG.1004, CiA 303-2)."""
_TIMES = {0x03: 1.0, 0x47: 60.0, 0x57: 1.0}
"""Notation index of a denominator -> s: second, minute, second squared."""


def rate_unit(notation: int, increment: float, gear_ratio: float) -> float | None:
    """Return the size of a count at the joint, rad/s or rad/s^2, from 0x60A9 or 0x60AA; None: not such a unit.

    `increment`: size of a position count, rad. Angles in these units are `gear_ratio` times those of the joint.
    """
    exponent, above, below = (notation >> 24 & 0xFF ^ 0x80) - 0x80, notation >> 16 & 0xFF, notation >> 8 & 0xFF
    angle = increment if above == _INCREMENT else _ANGLES.get(above, 0.0) / gear_ratio
    return 10.0**exponent * angle / _TIMES[below] if angle and below in _TIMES else None


class Units:
    """Sizes of a count in SI units: rad, rad/s, rad/s^2, Nm; and encoder increments per rad."""

    __slots__ = ("acceleration", "increments", "position", "torque", "velocity")

    def __init__(self, position: float, velocity: float, acceleration: float, torque: float, increments: float) -> None:
        self.position = position
        self.velocity = velocity
        self.acceleration = acceleration
        self.torque = torque
        self.increments = increments


class AxisObjects:
    """The objects of an axis, by their indices of the first axis, and its units."""

    def __init__(self, objects: ObjectDictionary, units: Units, axis: int = 0) -> None:
        """`axis` counts from 0."""
        self.dictionary = objects
        self.units = units
        self._shift = AXIS_STRIDE * axis
        self._absent: dict[tuple[int, int], Number] = {}

    def __contains__(self, key: tuple[int, int]) -> bool:
        return self._key(*key) in self.dictionary

    def number(self, index: int, subindex: int = 0) -> Number:
        """Return an entry, or a placeholder if the drive lacks it."""
        key = self._key(index, subindex)
        if key in self.dictionary:
            return self.dictionary[key]
        return self._absent.setdefault(key, Number(0))

    def fill(self, defaults: Mapping[tuple[int, int], int]) -> None:
        """Set objects that are 0 or absent to a default."""
        for at, value in defaults.items():
            entry = self.number(*at)
            if not entry.value:
                low, high = self.bounds(*at)
                entry.value = min(max(value, low), high)

    def bounds(self, index: int, subindex: int = 0) -> tuple[int, int]:
        """Return the lowest and the highest number of an entry."""
        key = self._key(index, subindex)
        return bounds(self.dictionary[key]) if key in self.dictionary else (-LIMITLESS, 0xFFFF_FFFF)

    def _key(self, index: int, subindex: int) -> tuple[int, int]:
        return index + self._shift if index in _PROFILE else index, subindex
