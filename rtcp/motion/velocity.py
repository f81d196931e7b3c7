"""Joint speeds with ramps; they have to be said again before they run out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, RuckigError, Synchronization

from rtcp.motion.room import allowed_acceleration, stoppable_speed
from rtcp.motion.state import MotionState, Phase, Reason, Target

if TYPE_CHECKING:
    from rtcp.motion.limits import Limits


class VelocityMode:
    """The mode `velocity`: each joint's speed, reached under its acceleration and jerk.

    Args:
        limits: of the joints; read in every cycle.
        period_s: the cycle, s.
    """

    def __init__(self, limits: Limits, period_s: float) -> None:
        n = len(limits.velocity)
        self._limits = limits
        self._otg = Ruckig(n, period_s)
        self._way, self._output = InputParameter(n), OutputParameter(n)
        self._way.control_interface = ControlInterface.Velocity
        self._way.synchronization = Synchronization.No
        self._way.target_acceleration = [0.0] * n
        self._target = Target(n)
        self._zero = [0.0] * n
        self._joints = range(n)
        self._wanted = [0.0] * n
        self._bounded = [0.0] * n
        self._said = [0.0] * n
        self._until_ns = 0
        self._holds = False
        self._last: list[float] = []
        self.clamps = True
        self.phase = Phase.HOLD
        self.reason = Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self.elapsed_s = self.duration_s = 0.0

    def start(self, state: MotionState) -> None:
        """Begin at `state`, with no speed asked for yet."""
        self.phase, self.reason = Phase.MOVE, Reason.NONE
        self.axis, self.value, self.limit = -1, 0.0, 0.0
        self._wanted = list(self._zero)
        self._until_ns = state.now_ns
        self._last = []

    def command(self, speeds: Sequence[float], hold_s: float, now_ns: int) -> None:
        """Ask for joint speeds, rad/s, of shape (n,), finite; they count for `hold_s` from `now_ns` on.

        While the mode stops they are not taken; a stop that has ended is begun anew with `start`.
        """
        if self.phase is not Phase.MOVE:
            return
        wanted, bounds = self._wanted, self._limits.velocity
        for i in self._joints:
            v, bound = speeds[i], bounds[i]
            wanted[i] = bound if v > bound else -bound if v < -bound else v
        self._until_ns = now_ns + round(hold_s * 1e9)

    def stop(self, state: MotionState) -> None:
        """Ramp down to rest."""
        if self.phase is Phase.MOVE:
            self.phase = Phase.STOP
            self._wanted = list(self._zero)

    def update(self, state: MotionState, dt: float) -> Target:
        """Return the set-points of the next cycle."""
        target = self._target
        if not self.phase:
            target.position, target.velocity = state.position, self._zero
            return target
        if self.phase is Phase.MOVE and state.now_ns > self._until_ns:
            if any(self._wanted):
                self.reason, self.value = Reason.COMMAND_ENDED, 0.0
            self.stop(state)
        way, output = self._way, self._output
        bounded = self._bound(state, dt)
        # What the guards changed, or what is asked for anew, begins at the state; else the ramp goes on.
        if bounded != self._said or state.position != self._last:
            self._said[:] = bounded
            way.target_velocity = bounded
            way.current_position = state.position
            way.current_velocity = state.velocity
            limits = self._limits
            way.max_acceleration, way.max_jerk = limits.acceleration, limits.jerk
            if state.position != self._last:
                way.current_acceleration = [
                    allowed_acceleration(
                        state.acceleration[i],
                        state.velocity[i],
                        limits.velocity[i],
                        limits.acceleration[i],
                        limits.jerk[i],
                    )
                    for i in self._joints
                ]
        try:
            result = self._otg.update(way, output)
        except (RuckigError, ValueError):
            result = Result.Error
        if result < 0:
            self.phase, self.reason = Phase.HOLD, Reason.GENERATOR
            target.position, target.velocity = state.position, self._zero
            return target
        target.position, target.velocity = output.new_position, output.new_velocity
        self._last = output.new_position
        output.pass_to_input(way)
        if self.phase is Phase.STOP and result == Result.Finished and not any(bounded):
            self.phase = Phase.HOLD
            target.velocity = self._zero
        return target

    def _bound(self, state: MotionState, dt: float) -> list[float]:
        """The speeds asked for, each no faster than it can still be slowed down from inside the joint's range."""
        bounded, limits = self._bounded, self._limits
        low, high, acceleration, jerk = limits.low, limits.high, limits.acceleration, limits.jerk
        position = state.position
        for i, v in enumerate(self._wanted):
            if v:
                room = high[i] - position[i] if v > 0.0 else position[i] - low[i]
                stops = stoppable_speed(room, acceleration[i], jerk[i])
                bounded[i] = stops if v > stops else -stops if v < -stops else v
            else:
                bounded[i] = 0.0
        return bounded
