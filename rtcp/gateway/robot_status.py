"""The fields of ROS-Industrial's RobotStatus (industrial_msgs), derived from the machine's state and nothing else."""

from __future__ import annotations

from typing import Any

from rtcp.ipc.codes import MotionMode
from rtcp.ipc.layout import FLAG_EMERGENCY_STOP, FLAG_ENABLED, FLAG_MOTION_ALLOWED, FLAG_SWITCHING
from rtcp.ipc.machine import State

_IN_ERROR = frozenset({State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT, State.RESETTING})
_IN_MOTION = frozenset({State.MOVING, State.STOPPING, State.HOMING})
_POSSIBLE = frozenset({State.HOLDING, State.MOVING})


def robot_status(state: State, motion: int, flags: int, fault: int, limit: int) -> dict[str, Any]:
    """Return mode (manual, auto), e_stopped, drives_powered, motion_possible, in_motion, in_error, error_code.

    Args:
        state: the machine's.
        motion: a `MotionMode`: under the stick the arm is in manual mode (ISO 10218-1), otherwise in auto.
        flags: of the cycle record.
        fault: `Code` of the fault, 0: none.
        limit: `Reason` of a stop by a limit, 0: none; told as 100 and more, as the events have it.
    """
    in_error = state in _IN_ERROR
    return {
        "mode": "manual" if motion == MotionMode.JOYSTICK else "auto",
        "e_stopped": state is State.EMERGENCY_STOP or bool(flags & FLAG_EMERGENCY_STOP),
        "drives_powered": bool(flags & FLAG_ENABLED),
        "motion_possible": state in _POSSIBLE
        and bool(flags & FLAG_MOTION_ALLOWED)
        and not flags & (FLAG_SWITCHING | FLAG_EMERGENCY_STOP),
        "in_motion": state in _IN_MOTION,
        "in_error": in_error,
        "error_code": (fault or (100 + limit if limit else 0)) if in_error else 0,
    }
