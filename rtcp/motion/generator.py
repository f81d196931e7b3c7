"""Jerk-limited joint motion (ruckig): hold, move to a configuration, stop.

The commanded position is continuous whatever is asked: a new target starts from the state that was commanded last.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, Synchronization


class Motion(IntEnum):
    """What the generator is doing."""

    HOLD = 0
    MOVE = 1
    STOP = 2


class JointGenerator:
    """Set-points for `n` joints, one call of `update` a cycle.

    Args:
        period_s: the cycle, s.
        velocity, acceleration, jerk: bounds of each joint, shape (n,), rad/s, rad/s^2, rad/s^3.
    """

    def __init__(
        self, period_s: float, velocity: Sequence[float], acceleration: Sequence[float], jerk: Sequence[float]
    ) -> None:
        n = len(velocity)
        self._velocity_limit = list(velocity)
        self._otg = Ruckig(n, period_s)
        self._output = OutputParameter(n)
        self._move = InputParameter(n)
        self._stop = InputParameter(n)
        for given in (self._move, self._stop):
            given.max_velocity = list(velocity)
            given.max_acceleration = list(acceleration)
            given.max_jerk = list(jerk)
        self._stop.control_interface = ControlInterface.Velocity
        # Every joint stops as fast as it may: the path matters less than standing still.
        self._stop.synchronization = Synchronization.No
        self._zero = [0.0] * n
        self._active = self._move
        self.motion = Motion.HOLD
        self.position = [0.0] * n
        self.velocity = [0.0] * n
        self.duration_s = 0.0
        self.elapsed_s = 0.0

    def latch(self, position: Sequence[float]) -> None:
        """Hold at `position` (rad, shape (n,)) from now on, at rest. Only for standstill: enable, lost bus."""
        self.position = list(position)
        self.velocity = self._zero
        self.motion = Motion.HOLD

    def move_to(self, target: Sequence[float], speed: float) -> None:
        """Move to `target` (rad, shape (n,)), all joints arriving together.

        Args:
            target: inside the joint limits, which the caller has checked.
            speed: bound of every joint's speed, rad/s; each joint's own limit holds besides.
        """
        move = self._move
        self._carry_over(move)
        move.target_position = list(target)
        move.target_velocity = self._zero
        # A joint that is faster than the new bound (a slower move begins in motion) needs room to slow down.
        move.max_velocity = [
            max(min(speed, limit), abs(now))
            for speed, limit, now in zip([speed] * len(self._zero), self._velocity_limit, self.velocity, strict=True)
        ]
        self._active = move
        self.elapsed_s = 0.0
        self.motion = Motion.MOVE

    def stop(self) -> None:
        """Come to rest under the acceleration and jerk limits; does nothing at rest."""
        if self.motion is not Motion.MOVE:
            return
        self._carry_over(self._stop)
        self._stop.target_velocity = self._zero
        self._active = self._stop
        self.elapsed_s = 0.0
        self.motion = Motion.STOP

    def _carry_over(self, given: InputParameter) -> None:
        given.current_position = self.position
        given.current_velocity = self.velocity
        given.current_acceleration = self._output.new_acceleration if self.motion else self._zero
        given.target_acceleration = self._zero

    def update(self) -> bool:
        """Advance one cycle; return False when ruckig refuses (the set-points then stand where they were).

        `position` (rad) and `velocity` (rad/s) are the new set-points.
        """
        if not self.motion:
            return True
        output = self._output
        result = self._otg.update(self._active, output)
        if result < 0:
            return False
        self.position = output.new_position
        self.velocity = output.new_velocity
        self.duration_s = output.trajectory.duration
        self.elapsed_s = output.time
        if result == Result.Finished:
            self.velocity = self._zero
            self.motion = Motion.HOLD
        else:
            output.pass_to_input(self._active)
        return True
