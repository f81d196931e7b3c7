"""The command that changes limits while the arm runs: one transaction, taken whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple

from rtcp.control.arm import Arm
from rtcp.control.verdict import DONE, Verdict
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code, Refusal
from rtcp.ipc.layout import PLANS
from rtcp.ipc.refusals import ImpossibleLimit, LimitsExcludeArm, LimitsExcludeJoint, LimitWidened
from rtcp.motion.limits import read

MOST_ROWS = 64
"""Six joints and more boxes than an arm is configured with: all are looked at in one cycle."""
_REFUSALS = {
    ImpossibleLimit: Refusal.LIMITS_WRONG,
    LimitWidened: Refusal.LIMITS_NARROW,
    LimitsExcludeJoint: Refusal.LIMITS_OUTSIDE,
}


class LimitOrders:
    """Takes new limits from the plan area.

    Args:
        arm: the joints.
        blackboard: where the numbers are, and who is told.
    """

    def __init__(self, arm: Arm, blackboard: Blackboard) -> None:
        self._arm = arm
        self._blackboard = blackboard

    def take(self, lease: int, numbers: Sequence[float]) -> Verdict:
        """Put the limits of the plan area into force: [slot, rows]; or say why not, and nothing has changed."""
        arm, slot, count = self._arm, numbers[0], numbers[1]
        if slot not in range(PLANS) or count not in range(1, MOST_ROWS + 1):
            return Refusal.LIMITS_WRONG, -1, count, float(MOST_ROWS)
        new = read(self._blackboard.plan(int(slot)), int(count))
        if new is None:
            return Refusal.LIMITS_WRONG, -1, count, float(MOST_ROWS)
        refused = arm.trajectory_guard.refuses(arm.state, new)
        if refused is not None:
            if isinstance(refused, LimitsExcludeArm):
                return Refusal.LIMITS_OUTSIDE, -1, 0.0, float(refused.box)
            axis, value, limit = astuple(refused)
            return _REFUSALS[type(refused)], axis, value, limit
        limits = arm.limits
        if arm.first_with_torque() >= 0:
            for axis, held in enumerate(arm.state.actual_torque):
                most = new.torque[axis]
                if most < limits.torque[axis] and abs(held) > most:
                    return Refusal.LIMITS_WEAK, axis, abs(held), most
        limits.apply(new)
        arm.output_limiter.take(limits)
        self._blackboard.event(Code.LIMITS)
        return DONE
