"""The machine's states and modes, as all processes name them. `rtcp.control.machine` leads from one to another."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """What the arm is doing."""

    OFF = 0
    STARTING = 1
    READY = 2
    ENABLING = 3
    HOLDING = 4
    MOVING = 5
    STOPPING = 6
    DISABLING = 7
    FAULT = 8
    RESETTING = 9
    CLOSING = 10
    STOPPED_BY_LIMIT = 11
    EMERGENCY_STOP = 12
    HOMING = 13

    @property
    def words(self) -> str:
        """Return the name in words."""
        return self.name.lower().replace("_", " ")


class DriveMode(IntEnum):
    """Modes of operation that the cycle uses (CiA 402-2, object 0x6060)."""

    CSP = 8
    CSV = 9
    CST = 10


class ControlMode(IntEnum):
    """Which motion commands the arm accepts."""

    JOINT = 1
    CARTESIAN = 2
    JOYSTICK = 3
    VELOCITY = 4
    TORQUE = 5


class JogFrame(IntEnum):
    """The axes that the six velocities of a jog command refer to."""

    BASE = 0
    TOOL = 1
    JOINTS = 2
