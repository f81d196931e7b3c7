"""The way from any state to the first waypoint of a trajectory, under the joints' limits (ruckig)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ruckig import InputParameter, Ruckig, RuckigError, Trajectory

from rtcp.motion.controllers.room import allowed_acceleration
from rtcp.motion.planning.rows import KIND, LONGEST_S, QUINTIC, Refused, Wrong

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits

# ruckig finds no way where a distance is exactly a border between two profiles.
_JERK_SCALES = (1.0, 1.0 - 1e-4, 1.0 - 1e-2)
_INSIDE = 1.0 - 1e-9
_SLACK = 1e-6


class Approach:
    """A way to a waypoint that takes as long as the waypoint's time says, or longer where the limits demand it.

    Args:
        limits: of the joints; read in each `plan`.
    """

    def __init__(self, limits: Limits) -> None:
        n = len(limits.velocity)
        self._limits = limits
        self._otg = Ruckig(n, 0.001)
        self._way = InputParameter(n)
        # A way is planned beside the one that is gone, and takes over only when the plan succeeds.
        self._found, self._spare = Trajectory(n), Trajectory(n)
        self.duration_s = 0.0

    def at(self, time_s: float) -> tuple[list[float], list[float], list[float]]:
        """Return position, velocity and acceleration of each joint."""
        found: tuple[list[float], list[float], list[float]] = self._found.at_time(time_s)
        return found

    def plan(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        waypoint: Sequence[float],
    ) -> Refused | None:
        """Plan the way from a state (rad, rad/s, rad/s^2) to a waypoint; return why not, or None."""
        way, limits, n = self._way, self._limits, len(position)
        bounds = limits.acceleration
        way.current_position, way.current_velocity = list(position), list(velocity)
        way.current_acceleration = [
            allowed_acceleration(acceleration[i], velocity[i], limits.velocity[i], bounds[i], limits.jerk[i])
            for i in range(n)
        ]
        way.target_position, way.target_velocity = list(waypoint[1 : 1 + n]), list(waypoint[7 : 7 + n])
        # A cubic begins with any acceleration.
        wanted = waypoint[13 : 13 + n] if waypoint[KIND] == QUINTIC else [0.0] * n
        way.target_acceleration = [min(max(a, -b * _INSIDE), b * _INSIDE) for a, b in zip(wanted, bounds, strict=True)]
        way.max_velocity = [max(b, abs(v)) for b, v in zip(limits.velocity, velocity, strict=True)]
        way.max_acceleration = list(bounds)
        way.minimum_duration = waypoint[0]
        if not self._planned():
            return Refused(Wrong.UNREACHABLE, -1, waypoint[0], 0.0)
        extrema = self._spare.position_extrema
        for i in range(n):
            least, largest = extrema[i].min, extrema[i].max
            # What begins outside, as the guards let it for a rounding, has to be no further out.
            if least < min(limits.low[i], position[i]) - _SLACK:
                return Refused(Wrong.UNREACHABLE, i, least, limits.low[i])
            if largest > max(limits.high[i], position[i]) + _SLACK:
                return Refused(Wrong.UNREACHABLE, i, largest, limits.high[i])
        self._found, self._spare = self._spare, self._found
        self.duration_s = self._found.duration
        return None

    def _planned(self) -> bool:
        for scale in _JERK_SCALES:
            self._way.max_jerk = [scale * jerk for jerk in self._limits.jerk]
            try:
                if self._otg.calculate(self._way, self._spare) >= 0:
                    return bool(self._spare.duration <= LONGEST_S)
            except (RuckigError, ValueError):
                continue
        return False
