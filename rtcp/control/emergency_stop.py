"""The emergency path: quick stop without a jump before it, torque off at standstill or at once, slaves to PRE-OP.

Source: the thesis' emergency stop, which stops the network and takes the slaves to PRE-OP (facts, "The drive"). Here
the drives come to rest first, because a drive that loses its process data in motion lets the arm fall.
"""

from __future__ import annotations

from enum import Enum

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.standstill import FIRST_CYCLES, Standstill
from rtcp.devices.cia402 import TargetState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code
from rtcp.ipc.stops import Rung

_OFF_S = 1.0


class _Step(Enum):
    QUICK_STOP = 1
    TORQUE_OFF = 2
    PARKED = 3


class EmergencyStop:
    """Led once a cycle while the machine is in the state emergency stop.

    Args:
        arm: the joints.
        service: takes the slaves to PRE-OP.
        blackboard: where it is told that they are there.
        config: how long a quick stop takes, and the cycle.
    """

    def __init__(self, arm: Arm, service: BusService, blackboard: Blackboard, config: ArmConfig) -> None:
        self._arm = arm
        self._service = service
        self._blackboard = blackboard
        self._standstill = Standstill(config, arm)
        self._off_cycles = round(_OFF_S / (config.cycle.period_us * 1e-6))
        self._step = _Step.QUICK_STOP
        self._cycles = 0
        self._off = TargetState.DISABLED

    def begin(self, rung: Rung) -> None:
        """Begin with the quick stop, or without torque, in the cycle that found the reason for it."""
        hard = rung is Rung.TORQUE_OFF
        self._off = TargetState.TORQUE_OFF if hard else TargetState.DISABLED
        self._next(_Step.TORQUE_OFF if hard else _Step.QUICK_STOP)
        self._standstill.begin()
        self._arm.hold_target()
        self._arm.lead(rung.goal)

    @property
    def torque_goes(self) -> bool:
        """Whether the quick stop is over, or there was none: the drives are told to give up their torque."""
        return self._step is not _Step.QUICK_STOP

    def lead(self, good: bool) -> None:
        """Do the cycle's part; `good`: the drives have answered."""
        arm = self._arm
        self._cycles += 1
        if self._step is _Step.QUICK_STOP:
            arm.lead(TargetState.QUICK_STOPPED)
            if self._standstill.reached(good):
                if self._standstill.unheard:
                    # In which state the drives are is not known: from every one this takes their torque.
                    self._off = TargetState.TORQUE_OFF
                self._next(_Step.TORQUE_OFF)
        elif self._step is _Step.TORQUE_OFF:
            arm.lead(self._off)
            off = good and self._cycles > FIRST_CYCLES and arm.first_with_torque() < 0
            if off or self._cycles > self._off_cycles:
                self._next(_Step.PARKED)
                self._service.park()
                self._blackboard.event(Code.PARKED)
        else:
            arm.lead(self._off)
        if good:
            arm.follow()

    def _next(self, step: _Step) -> None:
        self._step = step
        self._cycles = 0
