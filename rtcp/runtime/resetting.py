"""The way out of a fault: slaves back in OP, the clock followed, all at rest; then faults reset and drives disabled."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.devices.cia402 import DriveGoal
from rtcp.runtime.arm import Arm
from rtcp.runtime.codes import Code
from rtcp.runtime.failing import Failing
from rtcp.runtime.operator import Operator
from rtcp.runtime.service import Service

_RESET_S = 3.0


class Resetting:
    """Led once a cycle while the machine is in the state resetting.

    Args:
        config: the emergency stop's debounce, which a reset waits for as well.
        arm: the joints.
        operator: knows whether the button is still pressed.
        service: knows whether the slaves are back.
        failing: where a reset ends that does not succeed.
    """

    def __init__(self, config: ArmConfig, arm: Arm, operator: Operator, service: Service, failing: Failing) -> None:
        button = config.inputs.emergency_stop
        settling_s = 0.0 if button is None else button.debounce_ms * 1e-3
        self._patience = round((_RESET_S + settling_s) / (config.cycle.period_us * 1e-6))
        self._arm = arm
        self._operator = operator
        self._service = service
        self._failing = failing

    def lead(self) -> bool:
        """Do the part of a cycle in which all is back; return whether the reset is done."""
        arm = self._arm
        # What still moves is let come to rest first: its torque goes with the reset.
        arm.lead(DriveGoal.RESET if arm.first_moving() < 0 else DriveGoal.QUICK_STOPPED)
        arm.follow()
        # Whether the button is still pressed shows only now that the box is heard again.
        return arm.first_not_resting() < 0 and self._operator.button_known

    def give_up(self, good: bool, waited: int) -> None:
        """Fail where it has taken too long: `waited` cycles; `good`: the drives have answered."""
        if waited <= self._patience:
            return
        arm, failing, all_op = self._arm, self._failing, self._service.all_op
        axis = arm.first_moving()
        if axis >= 0 and good and all_op:
            failing.fail(Code.RESET_MOVING, axis, arm.all_drives[axis].velocity)
            return
        axis = arm.first_not_resting()
        if axis >= 0 and all_op:
            failing.fail_drive(Code.RESET_STUCK, axis)
        else:
            failing.fail(Code.RESET_STUCK, -1, float(all_op))
