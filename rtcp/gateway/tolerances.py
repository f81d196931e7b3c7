"""Tolerances of a trajectory, for all its cycle records and for its end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtcp.gateway.command_channel import CommandChannel
from rtcp.ipc.errors import RtcpError


@dataclass(frozen=True)
class Tolerances:
    """Largest deviations of a trajectory: rad a joint, infinite: unlimited; s."""

    path: Sequence[float]
    """Largest distance of the measured from the commanded position in every cycle."""
    goal: Sequence[float]
    """Largest distance of the measured position from the last point, at the end."""
    time_s: float
    """Largest delay until the arm is within `goal`, s, at a speed override of 1."""


class Violation(Exception):
    """A tolerance was exceeded."""

    def __init__(self, error: RtcpError) -> None:
        super().__init__(str(error))
        self.error = error


class Tracking:
    """Compares every record of a motion with its tolerances."""

    def __init__(
        self, channel: CommandChannel, tolerances: Tolerances, duration_s: float, end: Sequence[float]
    ) -> None:
        self._channel = channel
        self._tolerances = tolerances
        self._end = end
        self._at = channel.observer.head
        self._left_s = duration_s + tolerances.time_s
        self._time_ns = int(channel.record()["time_ns"])

    def check(self) -> None:
        """Compare the new records; raises Violation off the path, or after the latest end."""
        records, _ = self._channel.observer.since(self._at)
        if len(records):
            self._at = int(records["number"][-1])
            # The speed override scales the elapsed time.
            self._left_s -= 1e-9 * float(np.diff(records["time_ns"], prepend=self._time_ns) @ records["speed_override"])
            self._time_ns = int(records["time_ns"][-1])
            off = np.abs(records["actual_position"] - records["commanded_position"]).max(axis=0)
            self._compare("path_tolerance_violated", off.tolist(), self._tolerances.path, "on its way")
        if self._left_s < 0.0:
            positions = self._channel.joints("actual_position")
            off = [abs(a - b) for a, b in zip(positions, self._end, strict=True)]
            self._compare("goal_tolerance_violated", off, self._tolerances.goal, "when its time was up")

    def arrived(self, positions: Sequence[float]) -> bool:
        """Whether the arm is within the goal's tolerances."""
        return all(
            abs(a - b) <= most for a, b, most in zip(positions, self._end, self._tolerances.goal, strict=True)
        )  # fmt: skip

    def _compare(self, reason: str, off: Sequence[float], most: Sequence[float], when: str) -> None:
        for axis, (error, allowed) in enumerate(zip(off, most, strict=True)):
            if error > allowed:
                joint = self._channel.names.joint(axis)
                message = f"the trajectory: {joint} was {error:.4g} rad off {when}, allowed is {allowed:g} rad"
                fields = {"axis": axis, "error": error, "limit": allowed}
                raise Violation(RtcpError("fault", message, reason, fields))
