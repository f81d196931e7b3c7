"""Interface of an arm for the server."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from rtcp.fieldbus.simple_message.messages import Joints, Status


class Point(NamedTuple):
    """A point of a trajectory: rad, rad/s, rad/s^2, one number a joint; all points have the same fields."""

    time: float
    """s from the start. A first point at 0 is the arm's position; to a later one the arm moves within its time."""
    positions: Joints
    velocities: Joints | None = None
    accelerations: Joints | None = None


@dataclass(frozen=True)
class ArmState:
    """The arm at one instant."""

    stamp_ns: int
    """CLOCK_MONOTONIC of the sample."""
    positions: Joints
    """Actual positions, rad."""
    velocities: Joints
    """Actual velocities, rad/s; empty where the drives send none."""
    commanded: Joints
    """Commanded positions, rad: a motion begins there."""
    status: Status


class OpenTrajectory(Protocol):
    """A trajectory in progress to which points can be appended. Errors are `RtcpError`."""

    async def append(self, points: Sequence[Point]) -> None:
        """Append points; raises if the arm refuses them or the trajectory has ended."""

    async def finish(self) -> None:
        """End the trajectory at its last point."""

    async def wait(self) -> None:
        """Return when the arm rests at the last point, or has run out of points; raises if it ended otherwise."""


class Arm(Protocol):
    """An arm as the server commands it. Errors are `RtcpError`; a motion whose task is cancelled ends with a stop.

    A motion replaces the one in progress, whose call then soon returns or raises.
    """

    @property
    def state(self) -> ArmState | None:
        """The newest sample; None: the platform is not running."""

    @property
    def is_held_by_others(self) -> bool:
        """Whether another commander moves the arm."""

    async def run_trajectory(self, points: Sequence[Point]) -> None:
        """Run a trajectory; return at its end."""

    async def open_trajectory(self, points: Sequence[Point]) -> OpenTrajectory:
        """Begin a trajectory with an open end; return when it is accepted."""

    async def move_joints(self, positions: Joints) -> None:
        """Move to joint positions, rad; return on arrival."""

    async def halt(self) -> None:
        """Stop along the path; return at rest."""

    async def disable(self) -> None:
        """Remove the torque."""
