"""The fields of ROS-Industrial's RobotStatus, from a cycle record alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from rtcp.ipc.events import EmergencyStopActivated, ProcessDataLost
from rtcp.ipc.schema import FLAG_EMERGENCY_STOP, FLAG_ENABLED, FLAG_MOTION_ALLOWED, FLAG_SWITCHING
from rtcp.ipc.states import ControlMode, State

_IN_ERROR = frozenset({State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT, State.RESETTING})
_IN_MOTION = frozenset({State.MOVING, State.STOPPING, State.HOMING})
_MOTION_POSSIBLE = frozenset({State.HOLDING, State.MOVING})


@dataclass(frozen=True)
class RobotStatus:
    """The fields of industrial_msgs/RobotStatus."""

    mode: Literal["manual", "auto"]
    """Under the joystick the arm is in manual mode (ISO 10218-1)."""
    e_stopped: bool
    drives_powered: bool
    motion_possible: bool
    """Whether a motion that begins now would be accepted."""
    in_motion: bool
    in_error: bool
    """In a fault, after a stop by a limit, and while the emergency stop is pressed or not reset."""
    error_code: int
    """Number of the event behind the error (`docs/events.md`); 0: none."""

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> RobotStatus:
        """Return the status of a cycle record: one of `rtcp.Feed`, or any mapping with its fields."""
        state, flags = State(int(record["state"])), int(record["flags"])
        e_stopped = state is State.EMERGENCY_STOP or bool(flags & FLAG_EMERGENCY_STOP)
        in_error = state in _IN_ERROR
        code = (int(record["fault"]) or int(record["limit"])) if in_error else 0
        return cls(
            mode="manual" if int(record["control_mode"]) == ControlMode.JOYSTICK else "auto",
            e_stopped=e_stopped,
            drives_powered=bool(flags & FLAG_ENABLED),
            motion_possible=state in _MOTION_POSSIBLE
            and bool(flags & FLAG_MOTION_ALLOWED)
            and not flags & (FLAG_SWITCHING | FLAG_EMERGENCY_STOP),
            in_motion=state in _IN_MOTION,
            in_error=in_error or e_stopped,
            error_code=code or (EmergencyStopActivated.number if e_stopped else 0),
        )

    @classmethod
    def lost(cls, control_mode: int) -> RobotStatus:
        """Return the status of an arm whose loop has ended: its drives' watchdogs have stopped them."""
        mode: Literal["manual", "auto"] = "manual" if control_mode == ControlMode.JOYSTICK else "auto"
        return cls(mode, False, False, False, False, True, ProcessDataLost.number)
