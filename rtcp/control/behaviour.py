"""What every state does in a cycle. One method a state; which state an event leads to is the table of `machine`.

What goes wrong is in `failing`, how an enabled arm moves on by a cycle in `tracking`; longer ways have their own files.
"""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.closing import TOLD_CYCLES, Closing
from rtcp.control.emergency_stop import EmergencyStop
from rtcp.control.enabling import Enabling
from rtcp.control.failing import Failing
from rtcp.control.faulted import Faulted
from rtcp.control.homing_arm import HomingArm
from rtcp.control.operator import Operator
from rtcp.control.resetting import Resetting
from rtcp.control.tracking import Tracking
from rtcp.devices.cia402 import TargetState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Reason
from rtcp.ipc.machine import TABLE, WITH_TORQUE, Code, Event, State
from rtcp.ipc.states import DriveMode
from rtcp.ipc.stops import Rung
from rtcp.motion.guards.supervision import Supervision
from rtcp.realtime.discipline import Discipline

_MODE_S = 1.0
_PRESSABLE = WITH_TORQUE | {State.FAULT, State.RESETTING}
"""States that the emergency stop's input ends. On the way to OP the inputs are not yet valid; while ready no drive has
torque, and enabling is refused for as long as it is pressed."""
_BROUGHT_BACK = frozenset({State.FAULT, State.RESETTING, State.EMERGENCY_STOP, State.CLOSING})
"""States in which a slave that has left OP may come back to it."""


class Behaviour:
    """The machine's state and what it does with the arm.

    Args:
        config: timeouts, how many cycles may be lost, and the ladder of stops.
        arm: the joints.
        operator: the inputs and outputs that have a meaning.
        blackboard: where events go, and where the lease is.
        service: the thread beside the cycle.
        discipline: follows the reference clock, or None without distributed clocks.
    """

    def __init__(
        self,
        config: ArmConfig,
        arm: Arm,
        operator: Operator,
        blackboard: Blackboard,
        service: BusService,
        discipline: Discipline | None,
    ) -> None:
        period_s = config.cycle.period_us * 1e-6
        self._arm = arm
        self._operator = operator
        self._blackboard = blackboard
        self._service = service
        self._discipline = discipline
        watch = Supervision(config, arm.limits)
        self.homing = HomingArm(arm, period_s)
        self._emergency = EmergencyStop(arm, service, blackboard, config)
        self._faults = Faulted(self, arm, operator, blackboard, config)
        failing = Failing(
            self, config, arm, operator, self.homing, self._faults, self._emergency, watch, service, blackboard
        )
        self._failing = failing
        self._tracking = Tracking(self, arm, operator, self.homing, failing, blackboard)
        self._enables = Enabling(config, arm, watch, failing, blackboard)
        self._resets = Resetting(config, arm, operator, service, failing, blackboard)
        self._closes = Closing(arm, self.homing, operator, watch, blackboard, config, failing.rungs)
        self._disable_cycles = round(config.enable_timeout_s / period_s)
        self._mode_cycles = round(_MODE_S / period_s)
        self._since = 0
        self._told = 0
        self.state = State.STARTING
        self.cycle = 0
        self.now_ns = 0
        """Instant of the cycle, ns of the loop's clock."""
        self.lost = 0
        """Cycles in a row without the expected working counter."""
        self.lost_more = 0
        """So many more cycles without it than with it, `bus.lost_cycles` at most."""
        self._lost_limit = config.bus.lost_cycles
        self.fault = Code.NONE
        self.limit = Reason.NONE
        """Which limit the machine was stopped by last; NONE once it is reset."""
        self.enables = 0
        self.moves = 0
        self.all_enabled = False
        self.switching = False
        """Whether a mode change is under way."""
        self.torque_off = False
        """Whether the torque is taken off in a fault, also while it is reset: it was asked for, or is the rung of what
        failed, or an emergency stop took it."""
        self.wanted_mode = arm.mode
        """The mode to hold in: drives are enabled in CSP, where target = actual means standstill, and change then."""
        self.lease = 0
        """Lease of the commander whose motion is carried out; 0: the stick's, which needs none."""
        self.done = False
        """Whether the loop may end."""
        self._steps = {
            State.STARTING: self._starting,
            State.READY: self._ready,
            State.ENABLING: self._enabling,
            State.HOLDING: self._holding,
            State.MOVING: self._moving,
            State.STOPPING: self._stopping,
            State.STOPPED_BY_LIMIT: self._stopped_by_limit,
            State.HOMING: self._homing,
            State.DISABLING: self._disabling,
            State.FAULT: self._faulted,
            State.EMERGENCY_STOP: self._in_emergency,
            State.RESETTING: self._resetting,
            State.CLOSING: self._closing,
        }

    def step(self, good: bool) -> None:
        """Do one cycle of the present state; `good`: the exchange had the expected working counter."""
        self.cycle += 1
        if good:
            self.lost = 0
            if self.lost_more:
                self.lost_more -= 1
        else:
            self.lost += 1
            if self.lost_more < self._lost_limit:
                self.lost_more += 1
        self._arm.state.now_ns = self.now_ns
        operator = self._operator
        if good:
            operator.read()
        if operator.emergency_stop and self.state in _PRESSABLE:
            self._failing.stop_in_emergency(Code.PRESSED)
        self._steps[self.state](good)
        if self.state in _BROUGHT_BACK and self._box_left_op:
            operator.forget_outputs()
        operator.show(self.all_enabled, self.state is State.MOVING)
        gripper = self._arm.gripper
        if gripper is not None and gripper.came_to_rest() and self.all_enabled:
            motion = gripper.motion
            self._blackboard.event(Code.GRIPPER_AT, len(self._arm.drives), motion.position, float(motion.gripped))

    def on(self, event: Event) -> None:
        """Change to the state that `event` leads to from the present one, as the table says."""
        self._enter(TABLE[self.state].left_by[event])

    def _enter(self, state: State) -> None:
        self.state = state
        if state is State.READY:
            # What was lost before slaves were in OP, or before a reset, is no part of what is lost from now on.
            self.lost_more = 0
        self._told = 0
        self._since = self.cycle
        self.switching = False

    @property
    def clock_followed(self) -> bool:
        """Whether there is no reference clock to follow, or it is followed."""
        return self._discipline is None or self._discipline.locked

    @property
    def box_in_op(self) -> bool:
        """Whether there is an IO box, and in OP."""
        box = self._operator.box_position
        return box > 0 and self._blackboard.in_op(box)

    def hear_press(self) -> None:
        """Take from the box of a cycle that was not good that the emergency stop is pressed, and nothing else."""
        self._operator.hear_press()

    @property
    def _box_left_op(self) -> bool:
        """Whether the IO box is not in OP; where it left first, until the reset, however soon it was back."""
        box = self._operator.box_position
        return box > 0 and (self._service.lost_slave == box or not self.box_in_op)

    @property
    def _waited(self) -> int:
        return self.cycle - self._since

    # -- what others ask ----------------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop, disable and end; once it is said, nothing else is done."""
        if self.state is not State.CLOSING:
            self.on(Event.SHUTDOWN)

    def enable(self) -> None:
        """Lead the drives to Operation Enabled; the arm stands."""
        self._enables.begin()
        self.on(Event.ENABLE)

    def begin_motion(self, lease: int) -> None:
        """Let the active mode move the arm, for the commander of `lease`; 0: for the stick."""
        self.lease = lease
        self.moves += 1
        self._tracking.limited = False
        self.on(Event.MOTION)

    def stop_motion(self) -> None:
        """Let the active mode come to rest."""
        self._operator.wait_for_neutral()
        self._arm.stop()
        self._tracking.limited = False
        self.on(Event.STOP)

    def change_mode(self, mode: DriveMode) -> None:
        """Let the enabled drives, at standstill, change to `mode`."""
        self._arm.set_mode(mode)
        self._enter(State.HOLDING)
        self.switching = True

    def home(self, axis: int, lease: int) -> None:
        """Let the drive of a joint home by itself; the arm holds, in CSP."""
        self.lease = lease
        self.homing.begin(axis)
        self.on(Event.HOME)

    def release(self) -> None:
        """Go on after a stop by a limit."""
        self.limit = Reason.NONE
        self._operator.wait_for_neutral()
        self.on(Event.RESET)
        self._blackboard.event(Code.RELEASED)

    # -- one method a state -------------------------------------------------------------------------------------

    def _starting(self, good: bool) -> None:
        service = self._service
        if service.lost_slave:
            # It fell before the first cycle in which all was well: nothing has moved yet that a person would reset.
            service.recover()
        if self.clock_followed:
            service.want_op()
        self._arm.lead(TargetState.DISABLED)
        if good:
            self._arm.follow()
        if not service.all_op:
            # Frames are not yet whole: what is lost until all slaves are in OP counts for nothing.
            self.lost_more = 0
        elif good:
            self._blackboard.event(Code.READY)
            self.on(Event.ALL_IN_OP)
        elif self._failing.bus_fails(good):
            # Where no cycle was good the box was not heard, which is no press.
            self._operator.forget_press()

    def _ready(self, good: bool) -> None:
        arm = self._arm
        if self._failing.bus_fails(good) or not good:
            return
        axis = arm.first_in_fault()
        if axis >= 0:
            self._failing.fail_drive(Code.DRIVE_FAULT, axis)
            return
        arm.lead(TargetState.DISABLED)
        arm.follow()

    def _enabling(self, good: bool) -> None:
        if self._failing.bus_fails(good) or not good or not self._enables.lead(self._waited):
            return
        self.enables += 1
        self.all_enabled = True
        self.on(Event.ENABLED)
        if self.wanted_mode is not DriveMode.CSP:
            self.change_mode(self.wanted_mode)

    def _holding(self, good: bool) -> None:
        if not self._tracking.track(good) or self.state is not State.HOLDING:
            return
        if self.switching:
            axis = self._arm.first_in_another_mode()
            if axis < 0:
                self.switching = False
            elif self._waited > self._mode_cycles:
                self._failing.fail_mode(axis)
        elif self._operator.lead_by_stick(self._arm, self._blackboard):
            self.begin_motion(0)

    def _moving(self, good: bool) -> None:
        operator, arm, unled = self._operator, self._arm, self._tracking.unled(self.lease)
        if unled is Code.NONE:
            if not self.lease:
                operator.lead_by_stick(arm, self._blackboard)
            if self._tracking.track(good) and self.state is State.MOVING and arm.still:
                if self.lease:
                    self._blackboard.event(Code.ARRIVED)
                self.on(Event.ARRIVED)
        elif self._failing.rungs[unled] is Rung.CONTROLLED_STOP:
            self._blackboard.event(unled)
            self.stop_motion()
            self._stopping(good)
        else:
            self._failing.fail(unled)

    def _stopping(self, good: bool) -> None:
        if self._tracking.track(good) or self.state is State.STOPPING:
            arm, failing = self._arm, self._failing
            if failing.pending:
                if arm.all_still:
                    failing.come_to_rest(Rung.QUICK_STOP)
                return
            if not arm.still or arm.trajectory_guard.stopping:
                return
            self._blackboard.event(Code.STOPPED)
            arm.motions.rest()
            self.on(Event.LIMIT_STOPPED if self._tracking.limited else Event.STOPPED)

    def _stopped_by_limit(self, good: bool) -> None:
        self._tracking.track(good)

    def _homing(self, good: bool) -> None:
        homing = self.homing
        if self._tracking.track_homing(good) and homing.ended and homing.leads_back():
            self._blackboard.event(*homing.outcome)
            self.on(Event.HOMED if homing.homed else Event.STOPPED)

    def _disabling(self, good: bool) -> None:
        arm = self._arm
        if self.homing.under_way:
            self.homing.stop()
            self._since = self.cycle
            self._tracking.track_homing(good)
            return
        if not arm.all_still:
            # The time for disabling begins when the arm stands.
            self._since = self.cycle
            self._tracking.track(good)
            return
        if self._failing.bus_fails(good):
            return
        if self._failing.pending:
            self._failing.come_to_rest(Rung.TORQUE_OFF)
            return
        if not good:
            return
        self.all_enabled = False
        arm.lead(TargetState.DISABLED)
        arm.follow()
        self._told += 1
        axis = arm.first_with_torque()
        if axis < 0 and self._told > TOLD_CYCLES:
            self._blackboard.event(Code.DISABLED)
            self.on(Event.DISABLED)
        elif axis >= 0 and self._waited > self._disable_cycles:
            self._failing.fail_drive(Code.DISABLE_STUCK, axis)

    def _faulted(self, good: bool) -> None:
        self._faults.lead(good)

    def _in_emergency(self, good: bool) -> None:
        self._emergency.lead(good)
        self.torque_off = self.torque_off or self._emergency.torque_goes

    def _resetting(self, good: bool) -> None:
        if not (good and self._service.all_op and self.clock_followed):
            self._faulted(good)
        elif self._resets.lead():
            self.fault = Code.NONE
            self._blackboard.event(Code.RESET)
            # After it: what was said last is what `rtcp status` shows.
            self._resets.tell_displaced()
            self.on(Event.RESET_DONE)
            return
        self._resets.give_up(good, self.clock_followed, self._waited)

    def _closing(self, good: bool) -> None:
        self.done = self._closes.lead(good, self.lost)
