"""The machine's way out: a controlled stop, torque off, end; an emergency on the way is met by its rung."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.homing_arm import HomingArm
from rtcp.control.operator import Operator
from rtcp.control.standstill import Standstill
from rtcp.devices.cia402 import TargetState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code
from rtcp.ipc.stops import Rung, quick_stop_s
from rtcp.motion.guards.supervision import Supervision
from rtcp.motion.guards.trajectory_guard import GuardResult

_CLOSING_S = 2.0
TOLD_CYCLES = 5
"""What a drive shows is older than what it was told: so many cycles later it shows what it has made of it."""


class Closing:
    """Led once a cycle while the machine is in the state closing.

    Args:
        arm: the joints.
        homing: one that is under way is brought to its end.
        operator: knows whether the emergency stop is pressed.
        watch: of the joints; the gripper has its own.
        blackboard: where it is told that an emergency was met.
        config: after how many lost cycles the bus is given up, and how long the drives are told to stop until then.
        rungs: how what goes wrong on the way is met.
    """

    def __init__(
        self,
        arm: Arm,
        homing: HomingArm,
        operator: Operator,
        watch: Supervision,
        blackboard: Blackboard,
        config: ArmConfig,
        rungs: Mapping[Code, Rung],
    ) -> None:
        period_s = config.cycle.period_us * 1e-6
        self._arm = arm
        self._homing = homing
        self._operator = operator
        self._watch = watch
        self._blackboard = blackboard
        self._lost_limit = config.bus.lost_cycles
        self._farewell_cycles = ceil(quick_stop_s(config) / period_s) + TOLD_CYCLES
        """Slaves that still listen are in OP until the joints stand: without outputs a drive's own fault stops it."""
        self._rungs = rungs
        self._patience = round(_CLOSING_S / period_s)
        self._cycles = 0
        self._told = 0
        self._hard = False
        """Whether an emergency came: what still moves is stopped by its rung."""
        self._goal = TargetState.QUICK_STOPPED
        self._standstill = Standstill(config, arm)

    def lead(self, good: bool, lost: int) -> bool:
        """Do the cycle's part; return whether all is done.

        Args:
            good: the drives have answered.
            lost: cycles in a row in which they have not.
        """
        arm = self._arm
        self._cycles += 1
        if self._ramps_down(good):
            return False
        if lost >= self._lost_limit:
            arm.lead(self._goal if self._hard else self._rungs[Code.BUS_LOST].goal)
            return lost >= self._lost_limit + self._farewell_cycles
        if self._cycles > self._patience:
            return True
        if not good:
            return False
        if self._homing.under_way and arm.first_not_enabled() < 0:
            self._homing.stop()
            self._homing.step()
            self._cycles = 0
            if self._homing.running:
                axis = self._homing.axis
                self._meet(Code.HOMING_RUNNING, axis, arm.drives[axis].velocity)
            return False
        return self._stop() and self._take_torque()

    def _ramps_down(self, good: bool) -> bool:
        """Meet a press, or a measurement beyond its limit; return whether the arm still moves after it."""
        arm = self._arm
        if not self._hard and arm.first_with_torque() >= 0:
            found = arm.beyond(self._watch) if good and arm.first_not_enabled() < 0 else None
            if found is not None:
                self._meet(*found)
            elif self._operator.emergency_stop:
                self._meet(Code.PRESSED)
        if not self._hard:
            return False
        self._standstill.reached(good)
        if self._standstill.unheard:
            self._goal = TargetState.TORQUE_OFF
        if arm.first_moving() < 0 or self._cycles > self._patience:
            return False
        arm.lead(self._goal)
        if good:
            arm.follow()
        return True

    def _meet(self, code: Code, axis: int = -1, value: float = 0.0, limit: float = 0.0) -> None:
        """Let the drives stop by themselves from now on, and say why."""
        self._hard = True
        self._goal = self._rungs[code].goal
        self._cycles = 0
        self._standstill.begin()
        self._homing.abandon()
        self._arm.hold_target()
        self._blackboard.event(code, axis, value, limit)

    def _stop(self) -> bool:
        """Bring the set-points to rest; return whether they are, or the drives do not follow them anyway."""
        arm = self._arm
        arm.stop()
        if arm.all_still or arm.first_not_enabled() >= 0:
            return True
        self._cycles = 0
        if arm.command() is GuardResult.STOPPED:
            arm.motions.rest()
        return False

    def _take_torque(self) -> bool:
        # In a fault the drives ramp down by themselves: their torque goes when they stand.
        arm = self._arm
        ramping = arm.first_with_torque() >= 0 and arm.first_not_enabled() >= 0 and arm.first_moving() >= 0
        arm.lead(TargetState.QUICK_STOPPED if ramping else TargetState.DISABLED)
        arm.follow()
        self._told = 0 if ramping else self._told + 1
        return self._told > TOLD_CYCLES and arm.first_with_torque() < 0
