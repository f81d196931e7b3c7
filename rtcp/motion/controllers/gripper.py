"""Motion of a gripper with its own drive: open and close, stopping at a gripped object."""

from __future__ import annotations

from typing import Final

from rtcp.config.model import Joint
from rtcp.motion.joint_motion import JointMotion
from rtcp.motion.state import ArmState, Phase

_FIRM_CYCLES: Final = 5
"""Consecutive cycles at the torque limit that count as a grip; fewer are starting friction."""


class GripperMotion:
    """Setpoints of a gripper's joint, whose state the methods get: jerk-limited, one `update` a cycle.

    A torque at the joint's limit against the motion for 5 cycles is a grip: the setpoint stays, slightly inside the
    object. A drive pushes ever harder towards a setpoint it cannot reach, so while the torque is above the limit the
    setpoint yields under the joint's acceleration; otherwise the following error would become a fault. The output
    limiter bounds range and step.

    Attributes: `gripped`: True after a grip stopped it.
    """

    def __init__(self, joint: Joint, open_position: float, closed_position: float, period_s: float) -> None:
        """Positions are in rad, inside the range of `joint`; `period_s` is the cycle time."""
        self._motion = JointMotion(period_s, [joint.velocity], [joint.acceleration], [joint.jerk])
        self._period_s = period_s
        # A motion that begins at a cut setpoint uses the mean acceleration of the last cycle: margin for its error.
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
        """True while it moves or stops."""
        return self._motion.phase is not Phase.HOLD

    @property
    def stops(self) -> bool:
        """True during a stop."""
        return self._motion.phase is Phase.STOP

    def hold(self, state: ArmState) -> None:
        """Rest at the current setpoint."""
        state.commanded_velocity[0] = state.commanded_acceleration[0] = 0.0
        self._motion.hold()
        self._firm = 0

    def grip(self, state: ArmState, close: bool) -> bool:
        """Move to the closed or the open position, from any state; return False if ruckig finds no trajectory."""
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
        """Advance the setpoint by one cycle."""
        torque, before = state.actual_torque[0], state.commanded_velocity[0]
        # A drive pushes towards its setpoint: an obstacle shows as torque in that direction.
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
