"""What every state does in a cycle. One method a state; which state an event leads to is the table of `machine`.

In a fault every drive is told to quick-stop: it ramps down by itself and holds (0x605A = 6), whatever the mode, whether
or not frames come back, and comes back to Operation Enabled only by reset and enable.
"""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.devices.cia402 import DriveGoal
from rtcp.motion.envelope import Verdict
from rtcp.motion.modes import DriveMode
from rtcp.motion.state import Reason
from rtcp.motion.watch import Watch
from rtcp.realtime.discipline import Discipline
from rtcp.runtime.arm import Arm
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.closing import TOLD_CYCLES, Closing
from rtcp.runtime.emergency_stop import EmergencyStop
from rtcp.runtime.homing_arm import HomingArm
from rtcp.runtime.machine import TABLE, WITH_TORQUE, Code, Event, State
from rtcp.runtime.operator import Operator
from rtcp.runtime.service import Service

_RESET_S = 3.0
_MODE_S = 1.0
_CLOCK_S = 1.0
_ENDS_BY_ITSELF = frozenset({Reason.STREAM_ENDED, Reason.COMMAND_ENDED})
"""Reasons that are no limit: the arm has stopped and takes commands."""
_PRESSABLE = WITH_TORQUE | {State.FAULT, State.RESETTING}
"""States that the emergency stop's input ends. On the way to OP the inputs are not yet valid; while ready no drive has
torque, and enabling is refused for as long as it is pressed."""


class Behaviour:
    """The machine's state and what it does with the arm.

    Args:
        config: timeouts and how many cycles may be lost.
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
        service: Service,
        discipline: Discipline | None,
    ) -> None:
        period_s = config.cycle.period_us * 1e-6
        self._arm = arm
        self._operator = operator
        self._blackboard = blackboard
        self._service = service
        self._discipline = discipline
        self._watch = Watch(config, arm.limits)
        self.homing = HomingArm(arm, period_s)
        self._emergency = EmergencyStop(arm, service, blackboard, period_s)
        self._lost_limit = config.bus.lost_cycles
        self._closes = Closing(arm, self.homing, operator, self._watch, blackboard, self._lost_limit, period_s)
        self._enable_cycles = round(config.enable_timeout_s / period_s)
        button = config.inputs.emergency_stop
        settling_s = 0.0 if button is None else button.debounce_ms * 1e-3
        self._reset_cycles = round((_RESET_S + settling_s) / period_s)
        self._mode_cycles = round(_MODE_S / period_s)
        self._clock_cycles = round(_CLOCK_S / period_s)
        self._unlocked = 0
        self._since = 0
        self._told = 0
        self._limited = False
        """Whether the stop that is under way ends in `stopped by limit`."""
        self.state = State.STARTING
        self.cycle = 0
        self.now_ns = 0
        """Instant of the cycle, ns of the loop's clock."""
        self.lost = 0
        """Cycles in a row without the expected working counter."""
        self.fault = Code.NONE
        self.limit = Reason.NONE
        """Which limit the machine was stopped by last; NONE once it is reset."""
        self.enables = 0
        self.moves = 0
        self.all_enabled = False
        self.switching = False
        """Whether a mode change is under way."""
        self.torque_off = False
        """Whether the torque was asked to be taken off in a fault."""
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
        self.lost = 0 if good else self.lost + 1
        self._arm.state.now_ns = self.now_ns
        operator = self._operator
        if good:
            operator.read()
        if operator.emergency_stop and self.state in _PRESSABLE:
            self._stop_in_emergency(Code.PRESSED)
        self._steps[self.state](good)
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
        self._told = 0
        self._since = self.cycle
        self.switching = False

    @property
    def clock_followed(self) -> bool:
        """Whether there is no reference clock to follow, or it is followed."""
        return self._discipline is None or self._discipline.locked

    @property
    def _waited(self) -> int:
        return self.cycle - self._since

    # -- what others ask ----------------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop, disable and end; once it is said, nothing else is done."""
        if self.state is not State.CLOSING:
            self.on(Event.SHUTDOWN)

    def begin_motion(self, lease: int) -> None:
        """Let the active mode move the arm, for the commander of `lease`; 0: for the stick."""
        self.lease = lease
        self.moves += 1
        self._limited = False
        self.on(Event.MOTION)

    def stop_motion(self) -> None:
        """Let the active mode come to rest."""
        self._operator.wait_for_neutral()
        self._arm.stop()
        self._limited = False
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

    # -- what goes wrong ----------------------------------------------------------------------------------------

    def _fail(self, code: Code, axis: int = -1, value: float = 0.0, limit: float = 0.0) -> None:
        self.fault = code
        self.homing.abandon()
        self.torque_off = False
        self.all_enabled = False
        self._arm.hold_target()
        self._arm.lead(DriveGoal.QUICK_STOPPED)
        self._blackboard.event(code, axis, value, limit)
        self.on(Event.BROKEN)

    def _fail_drive(self, code: Code, axis: int) -> None:
        self._service.explain_drive(axis)
        self._fail(code, axis, float(self._arm.all_drives[axis].statusword))

    def _fail_mode(self, axis: int) -> None:
        self._fail(Code.MODE_STUCK, axis, float(self._arm.all_drives[axis].mode_display), float(self._arm.mode))

    def _stop_in_emergency(self, code: Code, axis: int = -1, value: float = 0.0, limit: float = 0.0) -> None:
        if self.state is State.EMERGENCY_STOP:
            return
        self.fault = code
        self.homing.abandon()
        self.all_enabled = False
        self._emergency.begin()
        self._blackboard.event(code, axis, value, limit)
        self.on(Event.EMERGENCY)

    def _bus_fails(self, good: bool) -> bool:
        if not good and self.lost >= self._lost_limit:
            self._fail(Code.BUS_LOST, -1, float(self.lost), float(self._lost_limit))
            return True
        if self._service.lost_slave:
            self._fail(Code.SLAVE_NOT_OP, self._service.lost_slave)
            return True
        self._unlocked = 0 if self.clock_followed else self._unlocked + 1
        if self._unlocked > self._clock_cycles:
            self._unlocked = 0
            self._fail(Code.CLOCK_LOST)
            return True
        return False

    def _watch_stops(self) -> bool:
        """Look at what is measured; return whether it ended in the emergency stop."""
        found = self._arm.beyond(self._watch)
        if found is None:
            return False
        self._stop_in_emergency(*found)
        return True

    def _lead_gripper(self) -> None:
        """Let a gripper come to rest that nobody leads any more, and say why."""
        gripper, operator = self._arm.gripper, self._operator
        if gripper is None or not gripper.motion.moving or gripper.motion.stops:
            return
        if not operator.permitted:
            self._blackboard.event(Code.NOT_PERMITTED)
        elif gripper.lease and not self._leased(gripper.lease):
            self._blackboard.event(Code.LEASE_ENDED)
        elif gripper.lease or operator.holds_grip:
            return
        gripper.stop()

    def _track(self, good: bool) -> bool:
        """Move on by one cycle while enabled; return False when the state has changed by it."""
        arm = self._arm
        if self._bus_fails(good):
            return False
        if not good:
            # The slaves did not see the last targets: time stands still for the set-points too.
            return True
        axis = arm.first_not_enabled()
        if axis >= 0:
            self._fail_drive(Code.DRIVE_LEFT_ENABLED, axis)
            return False
        if self._watch_stops():
            return False
        self._lead_gripper()
        # Every drive is enabled: its controlword stays what it was, there is nothing to lead.
        verdict = arm.command()
        if verdict is Verdict.PASS and arm.motions.active.reason is Reason.NONE:
            return True
        return self._cut(verdict)

    def _cut(self, verdict: Verdict) -> bool:
        """Deal with a guard that cut the target, or a mode that ends by itself; return False when the state changed."""
        arm, mode = self._arm, self._arm.motions.active
        reason = mode.reason
        if reason is Reason.GENERATOR:
            self._fail(Code.GENERATOR)
            return False
        if verdict is Verdict.STOPPING or verdict is Verdict.STOPPED:
            guards = arm.guards
            limited = not mode.clamps
            if self.state in (State.MOVING, State.HOLDING) or (limited and not self._limited):
                self._end(guards.code, guards.axis, guards.value, guards.limit, limited)
            if verdict is Verdict.STOPPED:
                arm.motions.rest()
            return False
        if reason is not Reason.NONE and self.state is State.MOVING:
            self._end(reason, mode.axis, mode.value, mode.limit, not mode.clamps and reason not in _ENDS_BY_ITSELF)
            return False
        return True

    def _end(self, reason: Reason, axis: int, value: float, limit: float, limited: bool) -> None:
        self._operator.wait_for_neutral()
        self._blackboard.event(Code.ENDED + reason, axis, value, limit)
        self._limited = limited
        if limited:
            self.limit = reason
            if self._arm.gripper is not None:
                self._arm.gripper.stop()
        if self.state in (State.MOVING, State.HOLDING, State.STOPPING):
            self.on(Event.GUARD)

    # -- one method a state -------------------------------------------------------------------------------------

    def _starting(self, good: bool) -> None:
        service = self._service
        if self.clock_followed:
            service.want_op()
        self._arm.lead(DriveGoal.DISABLED)
        if good:
            self._arm.follow()
            if service.all_op:
                self._blackboard.event(Code.READY)
                self.on(Event.ALL_IN_OP)

    def _ready(self, good: bool) -> None:
        arm = self._arm
        if self._bus_fails(good) or not good:
            return
        axis = arm.first_in_fault()
        if axis >= 0:
            self._fail_drive(Code.DRIVE_FAULT, axis)
            return
        arm.lead(DriveGoal.DISABLED)
        arm.follow()

    def _enabling(self, good: bool) -> None:
        arm = self._arm
        if self._bus_fails(good) or not good:
            return
        axis = arm.first_outside()
        if axis >= 0:
            self._fail(Code.LEFT_RANGE, axis, arm.all_drives[axis].position)
            return
        axis = arm.first_in_fault()
        if axis >= 0:
            self._fail_drive(Code.DRIVE_FAULT, axis)
            return
        arm.lead(DriveGoal.ENABLED)
        arm.follow()
        arm.command()
        axis = arm.first_not_enabled()
        elsewhere = arm.first_in_another_mode() if axis < 0 else -1
        gripper = arm.gripper
        if axis < 0 and elsewhere < 0 and (gripper is None or gripper.enabled):
            self.enables += 1
            self.all_enabled = True
            self._watch.reset()
            if gripper is not None:
                gripper.watch.reset()
            self._blackboard.event(Code.ENABLED)
            distance, box = arm.guards.nearest_box(arm.state.actual)
            if distance < 0.0:
                self._blackboard.event(Code.STANDS_IN, box, distance)
            self.on(Event.ENABLED)
            if self.wanted_mode is not DriveMode.CSP:
                self.change_mode(self.wanted_mode)
        elif self._waited > self._enable_cycles:
            if axis >= 0:
                self._fail_drive(Code.ENABLE_STUCK, axis)
            else:
                self._fail_mode(elsewhere if elsewhere >= 0 else len(arm.drives))

    def _holding(self, good: bool) -> None:
        if not self._track(good):
            return
        if self.switching:
            axis = self._arm.first_in_another_mode()
            if axis < 0:
                self.switching = False
            elif self._waited > self._mode_cycles:
                self._fail_mode(axis)
        elif self._operator.lead_by_stick(self._arm, self._blackboard):
            self.begin_motion(0)

    def _moving(self, good: bool) -> None:
        operator, arm = self._operator, self._arm
        if not operator.permitted:
            self._blackboard.event(Code.NOT_PERMITTED)
        elif not self._leased(self.lease):
            self._blackboard.event(Code.LEASE_ENDED)
        else:
            if not self.lease:
                operator.lead_by_stick(arm, self._blackboard)
            if self._track(good) and arm.still:
                if self.lease:
                    self._blackboard.event(Code.ARRIVED)
                self.on(Event.ARRIVED)
            return
        self.stop_motion()
        self._stopping(good)

    def _leased(self, lease: int) -> bool:
        """Whether the commander of `lease` still holds it; 0: the stick, which needs none."""
        if not lease:
            return True
        held, renewed, duration = self._blackboard.lease()
        return held == lease and self.now_ns - renewed <= duration

    def _stopping(self, good: bool) -> None:
        if self._track(good) or self.state is State.STOPPING:
            if not self._arm.still or self._arm.guards.stopping:
                return
            self._blackboard.event(Code.STOPPED)
            self._arm.motions.rest()
            self.on(Event.LIMIT_STOPPED if self._limited else Event.STOPPED)

    def _stopped_by_limit(self, good: bool) -> None:
        self._track(good)

    def _lead_homing(self, good: bool) -> bool:
        """Do a homing's part of the cycle, watched as any motion; return False where it broke, or no frame came."""
        arm, homing = self._arm, self.homing
        if self._bus_fails(good) or not good:
            return False
        left = arm.first_not_enabled()
        if left >= 0:
            self._fail_drive(Code.DRIVE_LEFT_ENABLED, left)
            return False
        if not (self._operator.permitted and self._leased(self.lease)):
            homing.stop()
        homing.step()
        if self._watch_stops():
            return False
        self._lead_gripper()
        outside = arm.first_outside()
        if homing.stuck:
            self._fail_mode(homing.axis)
        elif homing.running:
            self._fail(Code.HOMING_RUNNING, homing.axis, arm.drives[homing.axis].velocity)
        elif outside >= 0:
            # While it searches, and where it begins to count anew: also a stop after the index was found does.
            self._fail(Code.LEFT_RANGE, outside, arm.all_drives[outside].position)
        else:
            # Before its home a drive does not know where it is: what can be told from its old zero is kept to.
            if not homing.leaves and (box := arm.guards.zone_at(arm.state.actual)) is not None:
                self._blackboard.event(Code.HOMING_ZONE, box)
                homing.stop()
            return True
        return False

    def _homing(self, good: bool) -> None:
        homing = self.homing
        if self._lead_homing(good) and homing.ended:
            self._blackboard.event(*homing.outcome)
            self.on(Event.HOMED if homing.homed else Event.STOPPED)

    def _disabling(self, good: bool) -> None:
        arm = self._arm
        if self.homing.under_way:
            self.homing.stop()
            self._since = self.cycle
            self._lead_homing(good)
            return
        if not arm.all_still:
            # The time for disabling begins when the arm stands.
            self._since = self.cycle
            self._track(good)
            return
        if self._bus_fails(good) or not good:
            return
        self.all_enabled = False
        arm.lead(DriveGoal.DISABLED)
        arm.follow()
        self._told += 1
        axis = arm.first_with_torque()
        if axis < 0 and self._told > TOLD_CYCLES:
            self._blackboard.event(Code.DISABLED)
            self.on(Event.DISABLED)
        elif axis >= 0 and self._waited > self._enable_cycles:
            self._fail_drive(Code.DISABLE_STUCK, axis)

    def _faulted(self, good: bool) -> None:
        # Also without frames that come back: slaves that still hear must not go on with the last speed or torque.
        self._arm.lead(DriveGoal.DISABLED if self.torque_off else DriveGoal.QUICK_STOPPED)
        if good:
            self._arm.follow()

    def _in_emergency(self, good: bool) -> None:
        self._emergency.lead(good)

    def _resetting(self, good: bool) -> None:
        arm = self._arm
        if not (good and self._service.all_op and self.clock_followed):
            self._faulted(good)
        else:
            # What still moves is let come to rest first: its torque goes with the reset.
            arm.lead(DriveGoal.RESET if arm.first_moving() < 0 else DriveGoal.QUICK_STOPPED)
            arm.follow()
            # Whether the button is still pressed shows only now that the box is heard again.
            if arm.first_not_resting() < 0 and self._operator.button_known:
                self.fault = Code.NONE
                self._blackboard.event(Code.RESET)
                self.on(Event.RESET_DONE)
                return
        if self._waited > self._reset_cycles:
            axis = arm.first_moving()
            if axis >= 0 and good and self._service.all_op:
                self._fail(Code.RESET_MOVING, axis, arm.all_drives[axis].velocity)
                return
            axis = arm.first_not_resting()
            if axis >= 0 and self._service.all_op:
                self._fail_drive(Code.RESET_STUCK, axis)
            else:
                self._fail(Code.RESET_STUCK)

    def _closing(self, good: bool) -> None:
        self.done = self._closes.lead(good, self.lost)
