"""The way of a gripper that a drive moves: to where it is open or closed, and no further than what it grips allows."""

from __future__ import annotations

from typing import Final

from rtcp.config.model import Joint
from rtcp.motion.joint_motion import JointMotion
from rtcp.motion.state import ArmState, Phase

_FIRM_CYCLES: Final = 5
"""So many cycles in a row at the torque limit are a grip, and no friction when it starts."""


class GripperMotion:
    """Setpoints of a gripper's joint, whose state the methods get: jerk-limited, one `update` a cycle.

    While it moves, a torque at the joint's limit against the motion for 5 cycles means that it holds something: the
    setpoint stays, a little inside of what is held. A drive pushes ever harder towards a setpoint that it cannot
    reach: for as long as the torque is beyond the limit the setpoint yields, under the joint's acceleration. Nothing
    else ever ends in force: the drive's following error would be a fault. The output limiter keeps what is sent inside
    range and step.

    Attributes: `gripped` (it was stopped by what it holds).
    """

    def __init__(self, joint: Joint, open_position: float, closed_position: float, period_s: float) -> None:
        """Make the motion of `joint`; positions in rad inside its range, the cycle in s."""
        self._motion = JointMotion(period_s, [joint.velocity], [joint.acceleration], [joint.jerk])
        self._period_s = period_s
        # A way that begins where the setpoint was cut takes the last cycle's mean acceleration, and errs by so much.
        self._speed = max(joint.velocity - 0.5 * joint.acceleration * period_s, 0.5 * joint.velocity)
        self._firm_torque = joint.torque
        self._yielding = joint.acceleration * period_s * period_s
        self._direction = 0.0
        self._goals = {False: open_position, True: closed_position}
        self._firm = 0
        self._closing: bool | None = None
        self.gripped = False

    @property
    def moving(self) -> bool:
        """Whether it is on its way."""
        return self._motion.phase is not Phase.HOLD

    @property
    def stops(self) -> bool:
        """Whether it comes to rest on its way."""
        return self._motion.phase is Phase.STOP

    def hold(self, state: ArmState) -> None:
        """Rest at the setpoint from now on."""
        state.commanded_velocity[0] = state.commanded_acceleration[0] = 0.0
        self._motion.hold()
        self._firm = 0

    def grip(self, state: ArmState, close: bool) -> bool:
        """Go to where it is closed, or open, from whatever it does; return False where no way is found."""
        if close is self._closing and self._motion.phase is Phase.MOVE:
            return True
        if not self._motion.move_to(state, [self._goals[close]], self._speed):
            return False
        self._closing = close
        self._firm = 0
        self.gripped = False
        return True

    def stop(self, state: ArmState) -> None:
        """Come to rest under its limits."""
        self._motion.stop(state)

    def update(self, state: ArmState) -> None:
        """Move the setpoint on by one cycle."""
        torque, before = state.actual_torque[0], state.commanded_velocity[0]
        # A drive pushes in the direction of its setpoint: what resists shows as torque in that direction.
        firm = self.moving and (torque if before > 0.0 else -torque) >= self._firm_torque
        self._firm = self._firm + 1 if firm else 0
        if self._firm >= _FIRM_CYCLES:
            self.hold(state)
            self.gripped = True
            self._direction = 1.0 if before > 0.0 else -1.0
            return
        if self.gripped and torque * self._direction > self._firm_torque:
            state.commanded[0] -= self._direction * self._yielding
        target = self._motion.update(state)
        velocity = target.velocity[0]
        state.commanded[0] = target.position[0]
        state.commanded_velocity[0] = velocity
        state.commanded_acceleration[0] = (velocity - before) / self._period_s
