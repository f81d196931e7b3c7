"""A fault lasts: every drive is told to hold by a quick stop, or to give up its torque, whether or not it is heard."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.operator import Operator
from rtcp.control.standstill import Standstill
from rtcp.devices.cia402 import TargetState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code

if TYPE_CHECKING:
    from rtcp.control.behaviour import Behaviour

_DEAF_S = 2.0
"""The watcher brings back sooner what merely left OP, also what does so twice, which it lets wait for a second."""


class Faulted:
    """Led once a cycle while the machine is in fault, or cannot yet be reset.

    Args:
        behaviour: the machine's state, and whether the torque is off.
        arm: the joints.
        operator: whether there is a button.
        blackboard: where it is told that the torque goes.
        config: how long a quick stop takes, and the cycle.
    """

    def __init__(
        self, behaviour: Behaviour, arm: Arm, operator: Operator, blackboard: Blackboard, config: ArmConfig
    ) -> None:
        self._behaviour = behaviour
        self._arm = arm
        self._operator = operator
        self._blackboard = blackboard
        self._standstill = Standstill(config, arm)
        self._deaf_cycles = round(_DEAF_S / (config.cycle.period_us * 1e-6))
        self._deaf = 0
        """Cycles in a row in which the emergency stop could not have been heard."""
        self.off_at_rest = False
        """Whether the torque goes when the joints stand."""

    def begin(self, off_at_rest: bool) -> None:
        """Begin with a fault; `off_at_rest`: the torque goes when the joints stand, as it was to go before."""
        self._deaf = 0
        self._standstill.begin()
        self.off_at_rest = off_at_rest

    def lead(self, good: bool) -> None:
        """Do the cycle's part; `good`: the drives have answered."""
        behaviour, arm = self._behaviour, self._arm
        if not behaviour.torque_off and ((self.off_at_rest and self._standstill.reached(good)) or self._is_deaf(good)):
            behaviour.torque_off = True
            self._blackboard.event(Code.TORQUE_OFF)
        # Also without frames that come back: slaves that still hear must not go on with the last speed or torque.
        arm.lead(TargetState.TORQUE_OFF if behaviour.torque_off else TargetState.QUICK_STOPPED)
        if good:
            arm.follow()

    def _is_deaf(self, good: bool) -> bool:
        """Whether the emergency stop has not been heard for too long: it counts as pressed, as its broken wire does."""
        if good or not self._operator.has_button or self._behaviour.box_in_op:
            self._deaf = 0
            return False
        self._deaf += 1
        if self._deaf <= self._deaf_cycles:
            return False
        self._blackboard.event(Code.BUTTON_UNHEARD, -1, _DEAF_S)
        return True
