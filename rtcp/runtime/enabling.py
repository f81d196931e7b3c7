"""The way to Operation Enabled: target = actual until every drive is there, in the mode that was asked for."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.devices.cia402 import DriveGoal
from rtcp.motion.watch import Watch
from rtcp.runtime.arm import Arm
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.codes import Code
from rtcp.runtime.failing import Failing


class Enabling:
    """Led once a cycle while the machine is in the state enabling.

    Args:
        config: how long it may take.
        arm: the joints.
        watch: of what is measured; it begins to count anew.
        failing: where an enabling ends that does not succeed.
        blackboard: where it is told.
    """

    def __init__(self, config: ArmConfig, arm: Arm, watch: Watch, failing: Failing, blackboard: Blackboard) -> None:
        self._patience = round(config.enable_timeout_s / (config.cycle.period_us * 1e-6))
        self._arm = arm
        self._watch = watch
        self._failing = failing
        self._blackboard = blackboard

    def lead(self, waited: int) -> bool:
        """Do the part of a cycle in which the drives have answered; return whether all are enabled.

        Args:
            waited: cycles since it began.
        """
        arm, failing = self._arm, self._failing
        axis = arm.first_outside()
        if axis >= 0:
            failing.fail(Code.LEFT_RANGE, axis, arm.all_drives[axis].position)
            return False
        axis = arm.first_in_fault()
        if axis >= 0:
            failing.fail_drive(Code.DRIVE_FAULT, axis)
            return False
        arm.lead(DriveGoal.ENABLED)
        arm.follow()
        arm.command()
        axis = arm.first_not_enabled()
        elsewhere = arm.first_in_another_mode() if axis < 0 else -1
        if axis < 0 and elsewhere < 0 and (arm.gripper is None or arm.gripper.enabled):
            self._begin()
            return True
        if waited > self._patience:
            if axis >= 0:
                failing.fail_drive(Code.ENABLE_STUCK, axis)
            else:
                failing.fail_mode(elsewhere if elsewhere >= 0 else len(arm.drives))
        return False

    def _begin(self) -> None:
        """Let what is measured count from now on, and say that the arm holds."""
        arm = self._arm
        self._watch.reset()
        if arm.gripper is not None:
            arm.gripper.watch.reset()
        self._blackboard.event(Code.ENABLED)
        distance, box = arm.guards.nearest_box(arm.state.actual)
        if distance < 0.0:
            self._blackboard.event(Code.STANDS_IN, box, distance)
