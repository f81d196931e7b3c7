"""What a mode is told in a cycle and what it answers: preallocated, plain floats, one object of each for all modes."""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol


class Phase(IntEnum):
    """What a mode is doing."""

    HOLD = 0
    """At rest, and nothing to do."""
    MOVE = 1
    STOP = 2
    """On the way to rest under its limits, having been told to stop."""


class ArmState:
    """The arm as a mode sees it at the beginning of a cycle; lists have one number a joint, rad, rad/s, rad/s^2, Nm.

    `commanded`, `commanded_velocity`, `commanded_acceleration` are those of the last cycle, after the guards: a
    controller that continues from them is continuous whatever the guards did. `actual`, `actual_velocity`,
    `actual_torque` are measured.
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
    """What a mode wants of this cycle: set-points of the next, rad and rad/s; `torque`: Nm that is added in CST."""

    __slots__ = ("position", "torque", "velocity")

    def __init__(self, joints: int) -> None:
        self.position = [0.0] * joints
        self.velocity = [0.0] * joints
        self.torque = [0.0] * joints


class Reason(IntEnum):
    """Why a mode ended a motion by itself, or slows it; `rtcp.ipc.messages` says it."""

    NONE = 0
    STREAM_ENDED = 1
    """The sender fell silent."""
    NO_SOLUTION = 2
    """No inverse solution continues the motion: out of reach."""
    JOINT_LIMIT = 3
    """A joint's range ends the motion; `axis`."""
    SINGULARITY = 4
    """`axis`: 0 shoulder, 1 elbow, 2 wrist."""
    CODE = 5
    """The stick shows what is no code; `value`: the byte."""
    PLAN = 6
    """The plan in memory is damaged."""
    KEEP_OUT = 7
    """`axis`: which box, by its place in the configuration; -1: the Cartesian box."""
    JUMP = 8
    """The set-points would have had to jump."""
    COMMAND_ENDED = 9
    """A command that has to be renewed was not."""
    GENERATOR = 10
    """The trajectory generator refused its input: a defect."""


class Controller(Protocol):
    """A mode of motion. One `update` a cycle while it is the active one; nothing in it allocates without bound, blocks
    or logs. It is started by its own method from a `ArmState`, and begins at the state's position, velocity and
    acceleration.
    """

    phase: Phase
    reason: Reason
    """Why it is ending by itself; NONE otherwise, and at every start."""
    axis: int
    value: float
    limit: float
    """What the reason is about: joint or box (or -1), the number found and the one allowed."""
    elapsed_s: float
    duration_s: float
    """Progress; 0 and 0 where there is none to tell."""
    tolerates_saturation: bool
    """True where a guard that cuts the target is the way the mode works (jogging, velocity); False where it means that
    the motion cannot go on, and is stopped."""

    def update(self, state: ArmState, dt: float) -> Setpoint:
        """Return the set-points of the next cycle, `dt` s later. The target is the mode's own and used up at once."""

    def stop(self, state: ArmState) -> None:
        """Come to rest under the limits: phase STOP, then HOLD. Does nothing at rest."""
