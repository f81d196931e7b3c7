"""A fault lasts: every drive is told to hold by a quick stop, or to give up its torque, whether or not it is heard."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtcp.devices.cia402 import DriveGoal
from rtcp.runtime.arm import Arm
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.codes import Code
from rtcp.runtime.operator import Operator

if TYPE_CHECKING:
    from rtcp.runtime.behaviour import Behaviour

_FIRST_CYCLES = 10
"""What a drive shows is older than what it was told: so many cycles pass before standstill counts."""
_RAMP_S = 0.5
"""Where nobody hears whether the joints stand: a quick stop has long ended by then."""
_DEAF_S = 1.0
"""The watcher brings back in a fraction of it what merely left OP."""


class Faulted:
    """Led once a cycle while the machine is in fault, or cannot yet be reset.

    Args:
        behaviour: the machine's state, and whether the torque is off.
        arm: the joints.
        operator: whether there is a button.
        blackboard: where it is told that the torque goes.
        period_s: the cycle, s.
    """

    def __init__(
        self, behaviour: Behaviour, arm: Arm, operator: Operator, blackboard: Blackboard, period_s: float
    ) -> None:
        self._behaviour = behaviour
        self._arm = arm
        self._operator = operator
        self._blackboard = blackboard
        self._ramp_cycles = round(_RAMP_S / period_s)
        self._deaf_cycles = round(_DEAF_S / period_s)
        self._cycles = 0
        self._deaf = 0
        """Cycles in a row in which the emergency stop could not have been heard."""
        self._off_at_rest = False

    def begin(self, off_at_rest: bool) -> None:
        """Begin with a fault; `off_at_rest`: the torque goes when the joints stand, as it was to go before."""
        self._cycles = self._deaf = 0
        self._off_at_rest = off_at_rest

    def lead(self, good: bool) -> None:
        """Do the cycle's part; `good`: the drives have answered."""
        behaviour, arm = self._behaviour, self._arm
        self._cycles += 1
        if not behaviour.torque_off and (self._rests(good) or self._is_deaf()):
            behaviour.torque_off = True
            self._blackboard.event(Code.TORQUE_OFF)
        # Also without frames that come back: slaves that still hear must not go on with the last speed or torque.
        arm.lead(DriveGoal.TORQUE_OFF if behaviour.torque_off else DriveGoal.QUICK_STOPPED)
        if good:
            arm.follow()

    def _rests(self, good: bool) -> bool:
        """Whether the torque was to go, and the joints stand."""
        if not self._off_at_rest:
            return False
        stands = good and self._cycles > _FIRST_CYCLES and self._arm.first_moving() < 0
        return stands or self._cycles > self._ramp_cycles

    def _is_deaf(self) -> bool:
        """Whether the emergency stop has not been heard for too long: it counts as pressed, as its broken wire does."""
        if not self._operator.has_button or self._behaviour.box_in_op:
            self._deaf = 0
            return False
        self._deaf += 1
        if self._deaf <= self._deaf_cycles:
            return False
        self._blackboard.event(Code.BUTTON_UNHEARD, -1, _DEAF_S)
        return True
