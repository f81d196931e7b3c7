"""From the error of the resistance to amperes, from amperes to the gate; and the setpoint over time.

The gate is on or off, so power is voltage times average current, and linear in it. Full current grows as heat capacity
with the rod's section: gains that are shares of the full current hold for rods of all diameters.
"""

from __future__ import annotations

from math import exp


class CurrentControl:
    """PID on the ratio of resistances, in A, and the gate that makes its average current.

    Args:
        period_s: the cycle, s.
        average_s: time constant of the exponential average, s.
        proportional: share of the full current by the error of the ratio.
        integral: the same, 1/s.
        derivative: the same, s; of the measured ratio, not of its setpoint.
    """

    def __init__(
        self, period_s: float, average_s: float, proportional: float, integral: float, derivative: float
    ) -> None:  # fmt: skip
        self._kp, self._ki, self._kd = proportional, integral, derivative
        self._period_s = period_s
        self._decay = exp(-period_s / average_s)
        self.average = 0.0
        """Exponential average of the current, A."""
        self.target = 0.0
        """Current that the average is held at, A."""
        self._integral = self._setpoint = self._ratio = self._slope = self._held_s = 0.0
        self.is_limited = False
        """Whether a limit holds the target."""

    def reset(self) -> None:
        """Restart; the average continues."""
        self.target = self._integral = self._setpoint = self._ratio = self._slope = self._held_s = 0.0
        self.is_limited = False

    def measure(self, current: float) -> None:
        """Average the current of a cycle, A."""
        self.average = current + (self.average - current) * self._decay

    def update(self, setpoint: float, ratio: float, full_current: float, limit: float) -> None:
        """Set the target for a cycle.

        Args:
            setpoint: wanted ratio.
            ratio: newest measured ratio.
            full_current: current with the gate on, A.
            limit: greatest average current, A.
        """
        error = setpoint - ratio
        self._held_s += self._period_s
        if ratio != self._ratio:
            self._slope = (ratio - self._ratio) / self._held_s if self._ratio else 0.0
            self._held_s = 0.0
        # The integral does not learn a ramp, whose current is too much at its end: the rod cannot be cooled.
        step = self._ki * error * self._period_s if setpoint == self._setpoint else 0.0
        self._ratio, self._setpoint = ratio, setpoint
        wanted = (self._kp * error + self._integral + step - self._kd * self._slope) * full_current
        self.target = min(max(wanted, 0.0), limit, full_current)
        self.is_limited = wanted != self.target
        # Anti-windup: an integral that drives further into the limit stands still.
        if not self.is_limited or (self.target <= 0.0) == (error > 0.0):
            self._integral += step

    @property
    def gate(self) -> bool:
        """Whether the gate has to be on in this cycle."""
        return self.average < self.target


class Ramp:
    """Setpoint of the temperature in the middle: a ramp, that waits for a rod too far behind, then the target."""

    LEAD_K = 40.0
    """The setpoint waits while the measured temperature is further behind, K."""
    REACHED_K = 3.0
    """The target counts as reached within this, K."""

    def __init__(self) -> None:
        self._rate = 0.0
        self.setpoint_c = self.target_c = 0.0

    def begin(self, start_c: float, target_c: float, ramp_k_s: float) -> None:
        """Begin at a temperature, C."""
        self.setpoint_c, self.target_c, self._rate = start_c, target_c, ramp_k_s

    def update(self, middle_c: float, passed_s: float) -> bool:
        """Move on by a time, s; return whether the measured temperature has reached the target."""
        if self.setpoint_c - middle_c < self.LEAD_K:
            self.setpoint_c = min(self.setpoint_c + self._rate * passed_s, self.target_c)
        return self.setpoint_c >= self.target_c and middle_c >= self.target_c - self.REACHED_K
