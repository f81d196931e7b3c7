"""What goes wrong, and the rung of the ladder that it takes: fault, emergency stop, or a controlled stop into a fault.

In a fault every drive is told to quick-stop, or to give up its torque, whatever the mode, whether or not frames come
back; it comes back to Operation Enabled only by reset and enable.
"""

from __future__ import annotations

from math import nan
from typing import TYPE_CHECKING

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.emergency_stop import EmergencyStop
from rtcp.control.faulted import Faulted
from rtcp.control.homing_arm import HomingArm
from rtcp.control.operator import Operator
from rtcp.devices.cia402 import DriveState, TargetState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.machine import TABLE, Code, Event, State
from rtcp.ipc.stops import Rung, rungs
from rtcp.motion.guards.supervision import Supervision

if TYPE_CHECKING:
    from rtcp.control.behaviour import Behaviour

_IN_FAULT = frozenset({DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE})

_NOT_REMEMBERED = frozenset({State.STARTING, State.FAULT, State.EMERGENCY_STOP, State.RESETTING})
_CLOCK_S = 1.0


class Failing:
    """Looks for what is lost or beyond its limit, and stops the arm for it.

    Args:
        behaviour: the machine's state, which it changes.
        config: rungs, and how many cycles may be lost.
        arm: the joints.
        operator: the stick waits for neutral after a stop.
        homing: one that is under way is let go of.
        faulted: leads the drives while a fault lasts.
        emergency: the emergency path.
        watch: of what is measured.
        service: knows which slave is lost.
        blackboard: where it is told.
    """

    def __init__(
        self,
        behaviour: Behaviour,
        config: ArmConfig,
        arm: Arm,
        operator: Operator,
        homing: HomingArm,
        faulted: Faulted,
        emergency: EmergencyStop,
        watch: Supervision,
        service: BusService,
        blackboard: Blackboard,
    ) -> None:
        self._behaviour = behaviour
        self._arm = arm
        self._operator = operator
        self._homing = homing
        self._faulted = faulted
        self._emergency = emergency
        self._watch = watch
        self._service = service
        self._blackboard = blackboard
        self._lost_limit = config.bus.lost_cycles
        self._clock_cycles = round(_CLOCK_S / (config.cycle.period_us * 1e-6))
        self._unlocked = 0
        self.rungs = rungs(config.stops)
        """The rung of every event."""
        self.pending = Code.NONE
        """What ends in a fault as soon as the controlled stop that it began has come to rest."""
        self.stood = [nan] * len(config.joints)
        """Where each joint was last heard before the fault or emergency stop, rad; NaN: nowhere."""
        self.turned = [0.0] * len(config.joints)
        """How fast it turned there, rad/s."""

    def fail(self, code: Code, axis: int = -1, value: float = 0.0, limit: float = 0.0) -> None:
        """Stop all drives for `code`, by its rung, and say why; what stands already holds by a quick stop."""
        self._blackboard.event(code, axis, value, limit)
        self._break(code, max(self.rungs[code], Rung.QUICK_STOP))

    def fail_drive(self, code: Code, axis: int) -> None:
        """Fail for a drive, whose error code is looked up; one that shows a fault is in it, whatever it left."""
        self._service.explain_drive(axis)
        drive = self._arm.all_drives[axis]
        if code is Code.DRIVE_LEFT_ENABLED and drive.state in _IN_FAULT:
            code = Code.DRIVE_FAULT
        self.fail(code, axis, float(drive.statusword))

    def fail_mode(self, axis: int) -> None:
        """Fail for a drive that does not take the mode."""
        self.fail(Code.MODE_STUCK, axis, float(self._arm.all_drives[axis].mode_display), float(self._arm.mode))

    def come_to_rest(self, rung: Rung) -> None:
        """End the controlled stop that `pending` began in the fault that it is; the drives hold, or are let go."""
        self._break(self.pending, rung)

    def _remember(self) -> None:
        # Where what goes wrong begins: a slave that is lost was last heard before that. Not again until the reset, as
        # by a press in the fault: its drive may be without supply by then, or back with another zero. Nor in a start,
        # in which perhaps no joint has been heard.
        if self._behaviour.state not in _NOT_REMEMBERED:
            self.stood[:] = self._arm.state.actual
            self.turned[:] = self._arm.state.actual_velocity

    def _break(self, code: Code, rung: Rung) -> None:
        self._remember()
        behaviour = self._behaviour
        behaviour.fault = code
        self.pending = Code.NONE
        self._homing.abandon()
        # Who asked for no torque is not left with an arm that holds, and a reset that fails gives none back.
        fails = behaviour.state is State.RESETTING
        behaviour.torque_off = rung is Rung.TORQUE_OFF or (fails and behaviour.torque_off)
        self._faulted.begin(behaviour.state is State.DISABLING or (fails and self._faulted.off_at_rest))
        behaviour.all_enabled = False
        self._arm.hold_target()
        self._arm.lead(TargetState.TORQUE_OFF if behaviour.torque_off else rung.goal)
        behaviour.on(Event.BROKEN)

    def stop_in_emergency(self, code: Code, axis: int = -1, value: float = 0.0, limit: float = 0.0) -> None:
        """Begin the emergency path for `code`, by its rung."""
        behaviour = self._behaviour
        if behaviour.state is State.EMERGENCY_STOP:
            return
        self._remember()
        behaviour.fault = code
        self.pending = Code.NONE
        self._homing.abandon()
        behaviour.all_enabled = False
        # For a reset that begins before its torque is off.
        behaviour.torque_off = self.rungs[code] is Rung.TORQUE_OFF
        self._faulted.begin(off_at_rest=True)
        self._emergency.begin(self.rungs[code])
        self._blackboard.event(code, axis, value, limit)
        behaviour.on(Event.EMERGENCY)

    def bus_fails(self, good: bool) -> bool:
        """Look at frames, slaves and clock; return whether what is lost ended in a fault."""
        behaviour = self._behaviour
        # Not those in a row alone: one good cycle in ten would let an arm go on that hardly hears or is heard.
        if not good and behaviour.lost_more >= self._lost_limit:
            self.fail(Code.BUS_LOST, -1, float(behaviour.lost), float(self._lost_limit))
            return True
        if self._service.lost_slave:
            self.fail(Code.SLAVE_NOT_OP, self._service.lost_slave)
            return True
        self._unlocked = 0 if behaviour.clock_followed else self._unlocked + 1
        if self._unlocked > self._clock_cycles and not self.pending:
            self._unlocked = 0
            return self._lose_clock()
        return False

    def _lose_clock(self) -> bool:
        """Stop for the clock; return whether it ended in a fault: under a controlled stop the arm still obeys."""
        behaviour, arm = self._behaviour, self._arm
        # On its way to no torque it goes on to there: who asked for none is not left with an arm that holds.
        disables = behaviour.state is State.DISABLING
        obeys = disables or (Event.WAVERS in TABLE[behaviour.state].left_by and not arm.all_still)
        if self.rungs[Code.CLOCK_LOST] is not Rung.CONTROLLED_STOP or not obeys:
            self.fail(Code.CLOCK_LOST)
            return True
        self.pending = behaviour.fault = Code.CLOCK_LOST
        self._blackboard.event(Code.CLOCK_LOST)
        if not disables:
            self._operator.wait_for_neutral()
            arm.stop()
            behaviour.on(Event.WAVERS)
        return False

    def watch_stops(self) -> bool:
        """Look at what is measured; return whether it ended in the emergency stop."""
        found = self._arm.beyond(self._watch)
        if found is None:
            return False
        self.stop_in_emergency(*found)
        return True
