"""The fields of ROS-Industrial's RobotStatus, from a cycle record alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

from rtcp.ipc.events import EmergencyStopActivated, ProcessDataLost
from rtcp.ipc.schema import FLAG_EMERGENCY_STOP, FLAG_MOTION_ALLOWED, FLAG_SWITCHING
from rtcp.ipc.states import State

_AT_REST: Final = 0.01
"""Measured speed below which a joint stands, rad/s: drives report some counts of noise."""
_IN_ERROR = frozenset({State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT, State.RESETTING})
_IN_MOTION = frozenset({State.MOVING, State.STOPPING, State.HOMING})
_MOTION_POSSIBLE = frozenset({State.HOLDING, State.MOVING})
_STANDING = frozenset({State.HOLDING, State.STOPPED_BY_LIMIT})
"""States in which the setpoints stand: a joint that settles is not in motion."""
_MODES: Final[Mapping[int, Literal["manual", "auto"]]] = {1: "manual", 2: "auto"}


@dataclass(frozen=True)
class RobotStatus:
    """The fields of industrial_msgs/RobotStatus. None: unknown, because no slave tells, or no frame returns."""

    STALE_S: ClassVar[float] = 0.5
    """Age from which on measured values count as unknown, s: far beyond the stalls of a busy host."""

    mode: Literal["manual", "auto"] | None
    """Position of the robot controller's key; None: unknown, or a bus without a robot controller."""
    e_stopped: bool | None
    drives_powered: bool | None
    motion_possible: bool
    """Whether a motion that begins now would be accepted."""
    in_motion: bool | None
    in_error: bool
    """In a fault, after a stop by a limit, and while the emergency stop is pressed or not reset."""
    error_code: int
    """Number of the event behind the error (`docs/events.md`); 0: none."""

    @classmethod
    def of_record(cls, record: Mapping[str, Any], age_s: float = 0.0) -> RobotStatus:
        """Return the status of a cycle record: one of `rtcp.Feed`, or any mapping with its fields.

        Args:
            record: the record.
            age_s: age of its measured values, s; from 0.5 s on they are unknown.
        """
        state, flags = State(int(record["state"])), int(record["flags"])
        is_fresh = age_s < cls.STALE_S
        e_stopped = state is State.EMERGENCY_STOP or (_known(record["e_stopped"]) if is_fresh else None)
        in_motion: bool | None = None
        if state in _IN_MOTION or (is_fresh and state in _STANDING):
            in_motion = state in _IN_MOTION
        elif is_fresh:  # without torque somebody else may move the arm, and in a fault it may still decelerate
            in_motion = any(abs(speed) > _AT_REST for speed in record["actual_velocity"])
        in_error = state in _IN_ERROR
        code = (int(record["fault"]) or int(record["limit"])) if in_error else 0
        return cls(
            mode=_MODES.get(int(record["operating_mode"])) if is_fresh else None,
            e_stopped=e_stopped,
            drives_powered=_known(record["drives_powered"]) if is_fresh else None,
            motion_possible=is_fresh
            and state in _MOTION_POSSIBLE
            and bool(flags & FLAG_MOTION_ALLOWED)
            and not flags & (FLAG_SWITCHING | FLAG_EMERGENCY_STOP),
            in_motion=in_motion,
            in_error=in_error or bool(e_stopped),
            error_code=code or (EmergencyStopActivated.number if e_stopped else 0),
        )

    @classmethod
    def lost(cls) -> RobotStatus:
        """Return the status of an arm whose loop has ended."""
        return cls(None, None, None, False, None, True, ProcessDataLost.number)


def _known(value: Any) -> bool | None:
    """Return a tri-state field of the record: -1 is unknown."""
    return bool(value) if value >= 0 else None
