"""Input and output of a controller in a cycle: preallocated, plain floats."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

_FALSE: Final = 4
"""Number of torque samples in a row that may be false."""
_SAMPLES: Final = 2 * _FALSE + 1
_TREND: Final = 2.0
"""How far a torque may have continued beyond the samples before it, as a multiple of their range."""


class Phase(IntEnum):
    """Phase of a controller."""

    HOLD = 0
    """At rest."""
    MOVE = 1
    STOP = 2
    """Braking to rest under the limits."""


class ArmState:
    """State of the arm at the start of a cycle; lists have one number per joint: rad, rad/s, rad/s^2, Nm.

    `commanded`, `commanded_velocity`, `commanded_acceleration` are the values of the last cycle after the guards: a
    controller that continues from them is continuous despite a cut. `actual`, `actual_velocity`, `actual_torque` are
    measured.
    """

    __slots__ = (
        "_samples",
        "_taken",
        "actual",
        "actual_torque",
        "actual_velocity",
        "commanded",
        "commanded_acceleration",
        "commanded_velocity",
        "now_ns",
    )

    def __init__(self, joints: int) -> None:
        self.commanded = [0.0] * joints
        self.commanded_velocity = [0.0] * joints
        self.commanded_acceleration = [0.0] * joints
        self.actual = [0.0] * joints
        self.actual_velocity = [0.0] * joints
        self.actual_torque = [0.0] * joints
        self.now_ns = 0
        """Instant of the cycle, CLOCK_MONOTONIC or simulated time."""
        self._samples = [[0.0] * joints for _ in range(_SAMPLES)]
        self._taken = 0

    def keep_torques(self) -> None:
        """Keep the measured torques of this cycle for `proven_torque`."""
        kept = self._samples[self._taken % _SAMPLES]
        self._taken += 1
        for i, torque in enumerate(self.actual_torque):
            kept[i] = torque

    def proven_torque(self, i: int) -> float:
        """Return a joint's measured torque, Nm, no further from the samples before it than their course explains.

        It allocates, and is for the begin of a motion or of a drive mode: a false sample would stay in its torque.
        """
        torque, taken = self.actual_torque[i], self._taken
        if taken < _SAMPLES:
            return torque
        before = [self._samples[at % _SAMPLES][i] for at in range(taken - _SAMPLES, taken - _FALSE)]
        low, high = min(before), max(before)
        slack = _TREND * (high - low)
        return min(max(torque, low - slack), high + slack)


class Setpoint:
    """Setpoints of the next cycle: rad, rad/s; in CST also torques, Nm."""

    __slots__ = ("direct", "position", "torque", "velocity", "weight")

    def __init__(self, joints: int) -> None:
        self.position = [0.0] * joints
        self.velocity = [0.0] * joints
        self.torque = [0.0] * joints
        self.weight = [0.0] * joints
        """Part of `torque` that holds the arm still: the position loop of CST begins with it."""
        self.direct = False
        """True: `torque` is the whole torque of the joints, without the position loop of CST."""
