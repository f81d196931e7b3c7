"""Real-time control platform for EtherCAT robot arms.

    import rtcp

    with rtcp.connect() as robot:
        robot.enable()
        robot.move_joints([0.0, 0.3, 1.2, 0.0, 0.4, 0.0])

These names are those of `rtcp.api`, which is imported when the first of them is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import kinematics.compiled  # noqa: F401  first: it says whether the modules of the cycle are imported compiled

if TYPE_CHECKING:
    from rtcp.api import (
        AsyncRobot,
        ConnectionLost,
        Faulted,
        Feed,
        Invalid,
        NotRunning,
        Program,
        ProgramFile,
        Refused,
        Replaced,
        Robot,
        RobotStatus,
        RtcpError,
        State,
        Stream,
        TimedOut,
        connect,
        connect_async,
    )

__version__ = "0.2.0"
__all__ = [
    "AsyncRobot",
    "Cell",
    "ConnectionLost",
    "Faulted",
    "Feed",
    "Invalid",
    "NotRunning",
    "Program",
    "ProgramFile",
    "Refused",
    "Replaced",
    "Robot",
    "RobotStatus",
    "RtcpError",
    "State",
    "Stream",
    "TimedOut",
    "connect",
    "connect_async",
    "connect_cell",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'rtcp' has no attribute {name!r}")
    import rtcp.api

    return getattr(rtcp.api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
