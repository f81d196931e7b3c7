"""The power state machine of a CiA 402 drive as tables, from the drive's side (CiA 402-2 and ETG.6010)."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from types import MappingProxyType


class DriveState(IntEnum):
    """States of the power state machine (CiA 402-2, power drive system)."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class ControlCommand(IntEnum):
    """Commands of the controlword; switch on and disable operation share a bit pattern (CiA 402-2, object 0x6040)."""

    NONE = 0
    SHUTDOWN = 1
    SWITCH_ON = 2
    ENABLE_OPERATION = 3
    DISABLE_VOLTAGE = 4
    QUICK_STOP = 5
    FAULT_RESET = 6


class Status(IntFlag):
    """Statusword bits besides the state (CiA 402-2, object 0x6041)."""

    VOLTAGE_ENABLED = 0x0010
    WARNING = 0x0080
    REMOTE = 0x0200
    TARGET_REACHED = 0x0400
    INTERNAL_LIMIT = 0x0800
    MODE_SPECIFIC = 0x1000
    """Set-point acknowledged, speed zero, homing attained, or: the drive follows the command value."""
    MODE_ERROR = 0x2000
    """Following error or homing error."""


STATE_BITS = MappingProxyType({
    DriveState.NOT_READY_TO_SWITCH_ON: 0x00,
    DriveState.SWITCH_ON_DISABLED: 0x40,
    DriveState.READY_TO_SWITCH_ON: 0x21,
    DriveState.SWITCHED_ON: 0x23,
    DriveState.OPERATION_ENABLED: 0x27,
    DriveState.QUICK_STOP_ACTIVE: 0x07,
    DriveState.FAULT_REACTION_ACTIVE: 0x0F,
    DriveState.FAULT: 0x08,
})  # fmt: skip
"""Statusword bits 0..3, 5 and 6 of each state (CiA 402-2, object 0x6041)."""

_COMMANDS = (
    (0x87, 0x06, ControlCommand.SHUTDOWN),
    (0x8F, 0x07, ControlCommand.SWITCH_ON),
    (0x8F, 0x0F, ControlCommand.ENABLE_OPERATION),
    (0x82, 0x00, ControlCommand.DISABLE_VOLTAGE),
    (0x86, 0x02, ControlCommand.QUICK_STOP),
)
"""Mask and value of the controlword for each command (CiA 402-2, 0x6040), except the edge-triggered fault reset."""

TRANSITIONS = MappingProxyType({
    (DriveState.SWITCH_ON_DISABLED, ControlCommand.SHUTDOWN): (2, DriveState.READY_TO_SWITCH_ON),
    (DriveState.READY_TO_SWITCH_ON, ControlCommand.SWITCH_ON): (3, DriveState.SWITCHED_ON),
    # 0x0F in Ready To Switch On is transition 3 followed by an automatic transition 4.
    (DriveState.READY_TO_SWITCH_ON, ControlCommand.ENABLE_OPERATION): (3, DriveState.SWITCHED_ON),
    (DriveState.SWITCHED_ON, ControlCommand.ENABLE_OPERATION): (4, DriveState.OPERATION_ENABLED),
    (DriveState.OPERATION_ENABLED, ControlCommand.SWITCH_ON): (5, DriveState.SWITCHED_ON),
    (DriveState.SWITCHED_ON, ControlCommand.SHUTDOWN): (6, DriveState.READY_TO_SWITCH_ON),
    (DriveState.READY_TO_SWITCH_ON, ControlCommand.DISABLE_VOLTAGE): (7, DriveState.SWITCH_ON_DISABLED),
    (DriveState.READY_TO_SWITCH_ON, ControlCommand.QUICK_STOP): (7, DriveState.SWITCH_ON_DISABLED),
    (DriveState.OPERATION_ENABLED, ControlCommand.SHUTDOWN): (8, DriveState.READY_TO_SWITCH_ON),
    (DriveState.OPERATION_ENABLED, ControlCommand.DISABLE_VOLTAGE): (9, DriveState.SWITCH_ON_DISABLED),
    (DriveState.SWITCHED_ON, ControlCommand.DISABLE_VOLTAGE): (10, DriveState.SWITCH_ON_DISABLED),
    (DriveState.SWITCHED_ON, ControlCommand.QUICK_STOP): (10, DriveState.SWITCH_ON_DISABLED),
    (DriveState.OPERATION_ENABLED, ControlCommand.QUICK_STOP): (11, DriveState.QUICK_STOP_ACTIVE),
    (DriveState.QUICK_STOP_ACTIVE, ControlCommand.DISABLE_VOLTAGE): (12, DriveState.SWITCH_ON_DISABLED),
    (DriveState.FAULT, ControlCommand.FAULT_RESET): (15, DriveState.SWITCH_ON_DISABLED),
    (DriveState.QUICK_STOP_ACTIVE, ControlCommand.ENABLE_OPERATION): (16, DriveState.OPERATION_ENABLED),
})  # fmt: skip
"""(state, command) -> (number of the transition, next state) (CiA 402-2, power drive system).

The drive itself executes 0 and 1 (start, self-test), 12 (end of a quick stop that disables), 13 and 14 (fault, end of
the fault reaction)."""


def _decode(low_byte: int) -> ControlCommand:
    for mask, value, command in _COMMANDS:
        if low_byte & mask == value:
            return command
    return ControlCommand.NONE


_DECODED = tuple(_decode(low_byte) for low_byte in range(256))


class DriveStateMachine:
    """State of the drive, and the transitions that a controlword requests."""

    def __init__(self) -> None:
        self.state = DriveState.NOT_READY_TO_SWITCH_ON
        self._previous = 0

    def request(self, controlword: int) -> tuple[int, DriveState] | None:
        """Return the transition (its number, the next state) requested by `controlword`, or None.

        Call it for every controlword: the fault reset is the rising edge of bit 7 (CiA 402-2, object 0x6040).
        """
        rising = controlword & ~self._previous & 0x80
        self._previous = controlword
        command = ControlCommand.FAULT_RESET if rising else _DECODED[controlword & 0xFF]
        return TRANSITIONS.get((self.state, command))
