"""Input and output of a controller in a cycle: preallocated, plain floats."""

from __future__ import annotations

from enum import IntEnum


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
