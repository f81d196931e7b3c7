"""The machine's states and modes, as all processes name them. `rtcp.control.machine` leads from one to another."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """State of the machine."""

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


class DriveState(IntEnum):
    """State of a drive, by CiA 402-2, clause 8, for drives of every kind."""

    NOT_READY_TO_SWITCH_ON = 0
    """Also of a drive that has not sent yet."""
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7
    UNKNOWN = 8
    """A statusword that the standard does not define."""

    @property
    def words(self) -> str:
        """Return the name in words, as the standard has it."""
        return self.name.lower().replace("_", " ")


WITH_TORQUE = frozenset({DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE})
"""States in which a drive applies torque."""


class Missing(IntEnum):
    """Condition that a drive behind a robot controller lacks to track targets; only a person there can provide it."""

    NOTHING = 0
    CONNECTION = 1
    """No message comes from the controller."""
    MOTORS = 2
    """Its motors are off."""
    PROGRAM = 3
    """Its program does not run."""
    CONTROL = 4
    """Its program does not accept references now."""
    CLEARANCE = 5
    """It reports a fault, as after a collision."""
    PACE = 6
    """Its messages come at another interval than configured."""


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
    """Frame that the six velocities of a jog command refer to."""

    BASE = 0
    TOOL = 1
    JOINTS = 2
