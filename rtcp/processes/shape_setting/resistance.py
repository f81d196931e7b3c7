"""The resistance of the rod from pairs of voltage and current, and the initial one from a few pulses."""

from __future__ import annotations

from math import inf, sqrt
from typing import Final

_LEAST_CURRENT: Final = 0.5
"""Least current of a measurement, A: far above the noise, far below the current of any rod; less is an open circuit."""


class ResistanceMeter:
    """Resistance of the rod, from the newest conversion during which the gate was on throughout.

    Args:
        period_s: the cycle, s.
        short: resistance of a short circuit, ohm.
        open_: resistance of an open circuit, ohm.
    """

    def __init__(self, period_s: float, short: float, open_: float) -> None:
        self._period_s, self._short, self._open = period_s, short, open_
        self._sample = -1.0
        self.resistance = 0.0
        """Newest resistance, ohm; 0: none yet."""
        self.voltage = self.current = 0.0
        """Voltage and current of the same conversion, V and A, with the gate on."""
        self.age_s = inf
        """Time since its conversion was received, s."""
        self.fresh = False
        """Whether the resistance is of this cycle."""
        self.seen = 0.0
        """Resistance of the newest conversion with the gate on, ohm, open and short circuits included."""
        self.is_open = self.is_short = False
        """Whether the conversion of this cycle shows an open or a short circuit; the resistance is held then."""

    def update(self, voltage: float, current: float, sample: float, gate_on: bool) -> None:
        """Receive the inputs of a cycle: V, A, the counter of conversions, the gate on throughout the conversion."""
        is_new = sample != self._sample
        self._sample = sample
        self.fresh = self.is_open = self.is_short = False
        self.age_s += self._period_s
        if not (is_new and gate_on):
            return
        self.seen = resistance = voltage / current if current > _LEAST_CURRENT else inf
        if not resistance < self._open:
            self.is_open = True
        elif resistance < self._short:
            self.is_short = True
        else:
            self.resistance, self.voltage, self.current = resistance, voltage, current
            self.age_s, self.fresh = 0.0, True

    def forget(self) -> None:
        """Drop the resistance: the circuit was opened."""
        self.age_s, self.fresh = inf, False


class InitialResistance:
    """Mean of a few pulses, with its standard uncertainty."""

    def __init__(self) -> None:
        self.value = self.uncertainty = 0.0
        """Initial resistance and its uncertainty, ohm; 0: not measured."""
        self.pulses = 0
        self._mean = self._squares = self._first = 0.0

    def forget(self) -> None:
        """Forget the measurement: another rod may be gripped."""
        self.value = self.uncertainty = 0.0

    def begin(self) -> None:
        """Begin a measurement."""
        self.forget()
        self.pulses, self._mean, self._squares = 0, 0.0, 0.0

    def add(self, resistance: float) -> None:
        """Add the resistance of a pulse, ohm."""
        self.pulses += 1
        if self.pulses == 1:
            self._first = resistance
        deviation = resistance - self._mean
        self._mean += deviation / self.pulses
        self._squares += deviation * (resistance - self._mean)
        self._last = resistance

    def finish(self) -> None:
        """Compute the mean of at least two pulses.

        The uncertainty is that of the mean (GUM, 4.2.3) and, as a rectangular distribution, that of the drift: each
        pulse heats the rod a little.
        """
        scatter = self._squares / (self.pulses - 1) / self.pulses
        drift = (self._last - self._first) ** 2 / 12.0
        self.value, self.uncertainty = self._mean, sqrt(scatter + drift)
