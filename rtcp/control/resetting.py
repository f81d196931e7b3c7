"""The way out of a fault: slaves back in OP, the clock followed, all at rest; then faults reset and drives disabled."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.failing import Failing
from rtcp.control.operator import Operator
from rtcp.devices.cia402 import TargetState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code

_RESET_S = 3.0
_MOVED_RAD = 0.05
"""A joint that stood at the fault does not come so far until its brake holds, nor one of the shipped arm that moved
(docs/faults.md, the ladder of stops: 0.038 rad where nothing is heard)."""
_RAN_ON_S = 1.0
"""One that moved may have gone on so long at the speed it had: other drives ramp down more slowly, and where a bus is
given more patience a joint in CSV runs on until the frames are taken for lost."""


class Resetting:
    """Led once a cycle while the machine is in the state resetting.

    Args:
        config: the emergency stop's debounce, which a reset waits for as well.
        arm: the joints.
        operator: knows whether the button is still pressed.
        service: knows whether the slaves are back.
        failing: where a reset ends that does not succeed; remembers where the joints were at the fault.
        blackboard: where it is told that one stands elsewhere.
    """

    def __init__(
        self,
        config: ArmConfig,
        arm: Arm,
        operator: Operator,
        service: BusService,
        failing: Failing,
        blackboard: Blackboard,
    ) -> None:
        button = config.inputs.emergency_stop
        settling_s = 0.0 if button is None else button.debounce_ms * 1e-3
        self._patience = round((_RESET_S + settling_s) / (config.cycle.period_us * 1e-6))
        self._arm = arm
        self._operator = operator
        self._service = service
        self._failing = failing
        self._blackboard = blackboard
        self._speeds = [joint.velocity for joint in config.joints]

    def lead(self) -> bool:
        """Do the part of a cycle in which all is back; return whether the reset is done."""
        arm = self._arm
        # What still moves is let come to rest first: its torque goes with the reset.
        arm.lead(TargetState.RESET if arm.first_moving() < 0 else TargetState.QUICK_STOPPED)
        arm.follow()
        # Whether the button is still pressed shows only now that the box is heard again.
        return arm.first_not_resting() < 0 and self._operator.button_known

    def tell_displaced(self) -> None:
        """Say which joint stands elsewhere than before the fault: it was moved, or its drive counts from another zero.

        No refusal: only who looks at the arm knows which of both it is.
        """
        here, failing = self._arm.state.actual, self._failing
        for axis, (stood, turned) in enumerate(zip(failing.stood, failing.turned, strict=True)):
            # No faster than the limit: a false speed is at times what the fault was.
            ran_on = _RAN_ON_S * min(abs(turned), self._speeds[axis])
            if abs(here[axis] - stood) > _MOVED_RAD + ran_on:
                self._blackboard.event(Code.STANDS_ELSEWHERE, axis, here[axis], stood)

    def give_up(self, good: bool, followed: bool, waited: int) -> None:
        """Fail where it has taken too long: `waited` cycles; `good`: the drives have answered.

        `followed`: the clock is. Without it no drive was told to reset: that one is not at rest is not why.
        """
        if waited <= self._patience:
            return
        arm, failing, all_op = self._arm, self._failing, self._service.all_op
        axis = arm.first_moving()
        if axis >= 0 and good and all_op:
            failing.fail(Code.RESET_MOVING, axis, arm.all_drives[axis].velocity)
            return
        axis = arm.first_not_resting()
        if axis >= 0 and all_op and followed:
            failing.fail_drive(Code.RESET_STUCK, axis)
        else:
            failing.fail(Code.RESET_STUCK, -1, float(all_op))
