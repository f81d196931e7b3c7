"""What a person at the arm does: stick, toggle, enabling switch, emergency stop; and what the lamps tell them."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.devices.io_box import IoBox
from rtcp.runtime.arm import Arm
from rtcp.runtime.blackboard import Blackboard


class Operator:
    """Reads the inputs that have a meaning and writes the outputs that have one.

    Args:
        config: which they are.
        box: the IO box, or None.
    """

    def __init__(self, config: ArmConfig, box: IoBox | None) -> None:
        self._box = box
        self.emergency_stop = False
        self.permitted = True
        self.arm_has_stick = False
        self.stick_mode = 0
        self.meant: frozenset[int] = frozenset()
        self.has_gripper = False

    def read(self) -> None:
        """Take the inputs of the cycle."""

    def show(self, powered: bool, moving: bool) -> None:
        """Switch the lamps and toggle the heartbeat."""

    def wait_for_neutral(self) -> None:
        """Let the stick count only after it has been neutral."""

    def grip(self, close: bool) -> None:
        """Close or open the gripper."""

    def lead_by_stick(self, arm: Arm, blackboard: Blackboard) -> bool:
        """Let the stick lead the arm; return whether it wants to move."""
        return False
