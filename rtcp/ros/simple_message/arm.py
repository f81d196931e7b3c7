"""What the server needs of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from rtcp.fieldbus.simple_message.messages import Joints, Status


class Point(NamedTuple):
    """A point of a trajectory: rad, rad/s, rad/s^2, one number a joint; all points have the same fields."""

    time: float
    """s from the start. A first point later than 0 says how long the way to it takes; one at 0 is where the arm is."""
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
    """Actual velocities, rad/s."""
    commanded: Joints
    """Commanded positions, rad: a motion begins there."""
    status: Status


class OpenTrajectory(Protocol):
    """A trajectory under way to which points are appended. Errors are `RtcpError`."""

    async def append(self, points: Sequence[Point]) -> None:
        """Add points behind the last one; raises what the arm refuses them with, or that it has ended."""

    async def finish(self) -> None:
        """Say that no more points come."""

    async def wait(self) -> None:
        """Return when the arm rests at the last point, or has run out of points; raises where it ended otherwise."""


class Arm(Protocol):
    """An arm as the server commands it. Errors are `RtcpError`; a motion whose task is cancelled ends with a stop.

    A motion takes the place of the one under way, whose call then ends soon, in whatever way.
    """

    @property
    def state(self) -> ArmState | None:
        """The newest sample; None: the platform is not there."""

    async def run_trajectory(self, points: Sequence[Point]) -> None:
        """Run a trajectory; return at its end."""

    async def open_trajectory(self, points: Sequence[Point]) -> OpenTrajectory:
        """Begin a trajectory whose end is open; return when it was accepted."""

    async def move_joints(self, positions: Joints) -> None:
        """Move to joint positions, rad; return on arrival."""

    async def halt(self) -> None:
        """Stop along the path; return at rest."""

    async def disable(self) -> None:
        """Remove the torque."""
