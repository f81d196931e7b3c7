"""The Python API: `import rtcp; with rtcp.connect() as robot: robot.enable()` (`docs/api.md`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rtcp.api.results import (
    Arrival,
    EventRecord,
    GripperRest,
    Preview,
    Progress,
    RecorderStatus,
    Status,
    Streamed,
    Zero,
)
from rtcp.api.robot import Robot, connect
from rtcp.api.stream import Stream
from rtcp.ipc.errors import ConnectionLost, Faulted, Invalid, NotRunning, Refused, Replaced, RtcpError, TimedOut
from rtcp.ipc.schema import RecordSchema
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

if TYPE_CHECKING:
    from rtcp.api.async_robot import AsyncRobot, connect_async
    from rtcp.api.feed import Feed

__all__ = [
    "Arrival",
    "AsyncRobot",
    "ConnectionLost",
    "ControlMode",
    "DriveMode",
    "EventRecord",
    "Faulted",
    "Feed",
    "GripperRest",
    "Invalid",
    "JogFrame",
    "NotRunning",
    "Preview",
    "Progress",
    "RecordSchema",
    "RecorderStatus",
    "Refused",
    "Replaced",
    "Robot",
    "RtcpError",
    "State",
    "Status",
    "Stream",
    "Streamed",
    "TimedOut",
    "Zero",
    "connect",
    "connect_async",
]


def __getattr__(name: str) -> Any:
    # asyncio and numpy load slowly, and a command has no use for it.
    if name in ("AsyncRobot", "connect_async"):
        from rtcp.api import async_robot

        return getattr(async_robot, name)
    if name == "Feed":
        from rtcp.api.feed import Feed

        return Feed
    raise AttributeError(f"module 'rtcp.api' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
