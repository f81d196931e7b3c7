"""Jerk-limited joint motion (ruckig): hold, move to a configuration, stop.

The commanded position is continuous whatever is asked: a new target starts from the state that was commanded last.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

from ruckig import (
    ControlInterface,
    InputParameter,
    OutputParameter,
    Result,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

LONGEST_S = 600.0
"""A move that would take longer is refused: ruckig's own arithmetic ends at about 7600 s."""
# ruckig finds no solution where a distance is exactly a border between two profiles, as 2 a^3 / j^2: a little less jerk
# is not on the border any more.
_JERK_SCALES = (1.0, 1.0 - 1e-4, 1.0 - 1e-3, 1.0 - 1e-2)


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
        self._jerk_limit = list(jerk)
        self._otg = Ruckig(n, period_s)
        self._output = OutputParameter(n)
        self._plan = Trajectory(n)
        # A move is planned beside the one that runs, and takes over only when the plan succeeds.
        self._inputs = [InputParameter(n), InputParameter(n), InputParameter(n)]
        for given in self._inputs:
            given.max_velocity = list(velocity)
            given.max_acceleration = list(acceleration)
            given.max_jerk = list(jerk)
        self._stop = self._inputs[2]
        self._stop.control_interface = ControlInterface.Velocity
        # Every joint stops as fast as it may: the path matters less than standing still.
        self._stop.synchronization = Synchronization.No
        self._zero = [0.0] * n
        self._active = self._inputs[0]
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

    def move_to(self, target: Sequence[float], speed: float) -> bool:
        """Move to `target` (rad, shape (n,)), all joints arriving together; return False where no plan is found.

        Without a plan, or with one longer than `LONGEST_S`, what was under way goes on.

        Args:
            target: inside the joint limits, which the caller has checked.
            speed: bound of every joint's speed, rad/s; each joint's own limit holds besides.
        """
        move = self._inputs[1] if self._active is self._inputs[0] else self._inputs[0]
        self._carry_over(move)
        move.target_position = list(target)
        move.target_velocity = self._zero
        # A joint that is faster than the new bound (a slower move begins in motion) needs room to slow down.
        move.max_velocity = [
            max(min(speed, limit), abs(now))
            for limit, now in zip(self._velocity_limit, self.velocity, strict=True)
        ]  # fmt: skip
        if not self._planned(move):
            return False
        self._active = move
        self.elapsed_s = 0.0
        self.motion = Motion.MOVE
        return True

    def _planned(self, move: InputParameter) -> bool:
        for scale in _JERK_SCALES:
            move.max_jerk = [scale * jerk for jerk in self._jerk_limit]
            try:
                if self._otg.calculate(move, self._plan) >= 0:
                    return bool(self._plan.duration <= LONGEST_S)
            except (RuckigError, ValueError):
                # ruckig raises where its algorithm fails, and where its own result code is unknown to its binding.
                continue
        return False

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
        try:
            result = self._otg.update(self._active, output)
        except (RuckigError, ValueError):
            return False
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
