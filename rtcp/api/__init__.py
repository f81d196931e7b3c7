"""The Python API: `import rtcp; with rtcp.connect() as robot: robot.enable()` (`docs/api.md`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rtcp.api.results import (
    Arrival,
    AxisStatus,
    Buffered,
    Channel,
    EventRecord,
    GripperRest,
    HomingMethod,
    JointLimits,
    Levels,
    Payload,
    Preview,
    Progress,
    RecorderStatus,
    Status,
    Streamed,
    Terminals,
    Zero,
)
from rtcp.api.robot import Robot, connect
from rtcp.ipc.errors import ConnectionLost, Faulted, Invalid, NotRunning, Refused, Replaced, RtcpError, TimedOut
from rtcp.ipc.robot_status import RobotStatus
from rtcp.ipc.schema import RecordSchema
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

if TYPE_CHECKING:
    from rtcp.api.async_robot import AsyncRobot, connect_async
    from rtcp.api.cell import Cell, connect_cell
    from rtcp.api.feed import Feed
    from rtcp.api.program import Program
    from rtcp.api.stream import Stream
    from rtcp.config.program_file import ProgramFile

__all__ = [
    "Arrival",
    "AsyncRobot",
    "AxisStatus",
    "Buffered",
    "Cell",
    "Channel",
    "ConnectionLost",
    "ControlMode",
    "DriveMode",
    "EventRecord",
    "Faulted",
    "Feed",
    "GripperRest",
    "HomingMethod",
    "Invalid",
    "JogFrame",
    "JointLimits",
    "Levels",
    "NotRunning",
    "Payload",
    "Preview",
    "Program",
    "ProgramFile",
    "Progress",
    "RecordSchema",
    "RecorderStatus",
    "Refused",
    "Replaced",
    "Robot",
    "RobotStatus",
    "RtcpError",
    "State",
    "Status",
    "Stream",
    "Streamed",
    "Terminals",
    "TimedOut",
    "Zero",
    "connect",
    "connect_async",
    "connect_cell",
]


def __getattr__(name: str) -> Any:
    # asyncio and numpy load slowly, and a command has no use for it.
    if name in ("AsyncRobot", "connect_async"):
        from rtcp.api import async_robot

        return getattr(async_robot, name)
    if name in ("Cell", "connect_cell"):
        from rtcp.api import cell

        return getattr(cell, name)
    if name == "Feed":
        from rtcp.api.feed import Feed

        return Feed
    if name == "Program":
        from rtcp.api.program import Program

        return Program
    if name == "ProgramFile":
        from rtcp.config.program_file import ProgramFile

        return ProgramFile
    if name == "Stream":
        from rtcp.api.stream import Stream

        return Stream
    raise AttributeError(f"module 'rtcp.api' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
