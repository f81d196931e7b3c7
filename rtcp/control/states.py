"""The states of the machine, from start to end as in the diagram of `docs/machine.md`.

A state is a small object. `enter` is called when the machine changes to it, with the cause: the command or the event
that leads there. `update` is called once a cycle and returns the event that ends the state, or None. `leads_to` maps
each cause to the next state; only the machine (`rtcp.control.machine`) changes the state.
"""

from __future__ import annotations

from enum import Enum
from math import ceil, nan
from typing import ClassVar

from rtcp.control.context import Context
from rtcp.devices.drive import TargetState
from rtcp.ipc.commands import Disable, Enable, Halt, Home, MotionCommand, Reset, Shutdown
from rtcp.ipc.events import (
    Arrived,
    Disabled,
    DisabledUnattended,
    DisableTimeout,
    DriveFault,
    DriveLeftEnabled,
    EmergencyStop,
    EmergencyStopActivated,
    Enabled,
    EnabledInBox,
    EnableTimeout,
    EstopUnobservable,
    Event,
    FaultEvent,
    Homed,
    HomedElsewhere,
    HomingFailed,
    HomingStillMoving,
    LeaseExpired,
    LeftRange,
    LimitStopReset,
    MotionEnded,
    MovedSinceFault,
    NotSettled,
    PermissionWithdrawn,
    ProcessDataLost,
    Ready,
    ResetDone,
    ResetTimeout,
    ResetWhileMoving,
    ResetWithoutController,
    ResetWithoutFrames,
    ResetWithoutSlaves,
    ReturningToRange,
    SlavesParked,
    Stopped,
    StoppedByLimit,
    TooHeavyForCst,
    TorqueRemoved,
)
from rtcp.ipc.message import Message
from rtcp.ipc.states import DriveMode, DriveState, State
from rtcp.ipc.stop_reactions import StopReaction, quick_stop_s
from rtcp.motion.guards.output_limiter import BACK_RAD_S
from rtcp.motion.guards.trajectory_guard import GuardResult
from rtcp.motion.guards.zones import reported


class Signal(Enum):
    """Causes that are not published as events."""

    JOYSTICK_DEFLECTED = 1
    JOYSTICK_AT_REST = 2
    STOP_FOR_CLOCK = 3
    """The clock was lost, and its reaction is a controlled stop; the fault follows at standstill."""
    CLOSED = 4


Cause = Message | Signal

_TARGETS = {
    StopReaction.CONTROLLED_STOP: TargetState.ENABLED,
    StopReaction.QUICK_STOP: TargetState.QUICK_STOPPED,
    StopReaction.TORQUE_OFF: TargetState.TORQUE_OFF,
}
"""Stop reaction -> target state of the drives."""
_FAULTS: dict[type[Message] | Signal, State] = {
    FaultEvent: State.FAULT,
    EmergencyStop: State.EMERGENCY_STOP,
    Shutdown: State.CLOSING,
}
_TORQUE: dict[type[Message] | Signal, State] = {**_FAULTS, Disable: State.DISABLING}
_PERMITTED: dict[type[Message] | Signal, State] = {
    **_TORQUE,
    Halt: State.DISABLING,
    LeaseExpired: State.DISABLING,
    PermissionWithdrawn: State.DISABLING,
}
"""Transitions of the states in which joints return to their range. Only without torque does a joint stay where it is:
therefore a halt and the loss of the permission disable the drives."""


class MachineState:
    """Base of all states."""

    state: ClassVar[State]
    drives: ClassVar[str]
    """Command to the drives, for the documentation."""
    leads_to: ClassVar[dict[type[Message] | Signal, State]]
    """Cause -> next state; a class includes its subclasses."""

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Begin; `before` is the state that the machine leaves."""

    def update(self, ctx: Context) -> Event | Signal | None:
        """Do one cycle; return the event or signal that ends the state."""
        raise NotImplementedError


class Starting(MachineState):
    """From the first frame until all slaves are in OP and the clock is locked."""

    state = State.STARTING
    drives = "drives disabled; targets follow the actual positions"
    leads_to = {Ready: State.READY, FaultEvent: State.FAULT, Shutdown: State.CLOSING}

    def update(self, ctx: Context) -> Event | Signal | None:
        """Request OP once the clock is locked."""
        service, joints = ctx.service, ctx.joints
        if service.lost_slave:
            # It left OP before the first good cycle: nothing has moved, so no reset is needed.
            service.recover()
        if ctx.clock_locked:
            service.want_op()
        joints.advance(TargetState.DISABLED)
        if ctx.good:
            joints.track_actual()
        if not service.all_op:
            # Working counters are incomplete until all slaves are in OP: lost cycles do not count.
            ctx.wkc_error_count = 0
            return None
        if ctx.good and ctx.reported is None:
            return Ready()
        fault = ctx.bus_fault()
        if fault is not None:
            # Without a good cycle the box was not read, which does not mean a pressed button.
            ctx.operator.assume_released()
        return fault


class ReadyState(MachineState):
    """Slaves in OP, no torque."""

    state = State.READY
    drives = "drives disabled; targets follow the actual positions"
    leads_to = {**_FAULTS, Enable: State.ENABLING}

    def __init__(self, reaction: FaultReaction) -> None:
        self._reaction = reaction

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Count lost cycles from now on, and after a reset report joints that have moved."""
        ctx.wkc_error_count = 0
        if isinstance(cause, ResetDone):
            self._reaction.report_moved(ctx)

    def update(self, ctx: Context) -> Event | Signal | None:
        """Watch bus and drives."""
        joints = ctx.joints
        event = ctx.bus_fault()
        if event is not None or not ctx.good:
            return event
        axis = joints.first_in_fault()
        if axis >= 0:
            return ctx.drive_event(DriveFault, axis)
        joints.advance(TargetState.DISABLED)
        joints.track_actual()
        return None


class Enabling(MachineState):
    """To Operation Enabled: target = actual until every drive is there, in CSP.

    A joint slightly outside its range then returns to the edge before any other motion. A drive follows its target some
    frames before its statusword shows that, and no limiter applies to tracked positions.
    """

    state = State.ENABLING
    drives = "drives advance to Operation Enabled; target = actual until each is there"
    leads_to = {**_PERMITTED, Enabled: State.HOLDING}

    _REPORTED_RAD = 0.001
    """Distance from its range, rad, below which a joint returns without a report: it sagged at the edge."""

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Begin in CSP, where target = actual means standstill."""
        ctx.arm.set_mode(DriveMode.CSP)
        ctx.joints.hold()
        ctx.operator.begin_joystick(ctx.blackboard)
        self._were_enabled = 0
        """Bit mask of the drives that have been enabled."""
        self._returning = False
        """Whether all drives are enabled and joints outside their range return to it."""
        self._enabled = ctx.cycle
        """Cycle in which all drives were enabled."""
        ctx.joints.reset_supervision()

    def update(self, ctx: Context) -> Event | Signal | None:
        """Advance the drives by one step."""
        joints = ctx.joints
        event = ctx.bus_fault()
        if event is not None or not ctx.good:
            return event
        event = self._drive_problem(ctx) or joints.beyond_limits()
        if event is None and joints.first_returning() >= 0:
            event = ctx.permission_lost(ctx.lease)
        if event is not None:
            return event
        joints.advance(TargetState.ENABLED)
        joints.track_actual()
        joints.command()
        axis = joints.first_not_enabled()
        wrong_mode = joints.first_in_another_mode() if axis < 0 else -1
        if axis < 0 and wrong_mode < 0:
            return self._all_enabled(ctx)
        if ctx.waited <= ctx.cycles(ctx.config.enable_timeout_s):
            return None
        if axis >= 0:
            ctx.service.explain_drive(axis)
            return EnableTimeout(axis, joints.drives[axis].state, joints.drives[axis].statusword)
        return ctx.wrong_drive_mode(wrong_mode)

    def _drive_problem(self, ctx: Context) -> Event | None:
        joints = ctx.joints
        axis = joints.first_outside()
        if axis >= 0:
            return LeftRange(axis, joints.drives[axis].position)
        axis = joints.first_in_fault()
        if axis >= 0:
            return ctx.drive_event(DriveFault, axis)
        if (problem := ctx.axis_problem()) is not None:
            return problem
        for axis, drive in enumerate(joints.drives):
            if drive.state is DriveState.OPERATION_ENABLED:
                self._were_enabled |= 1 << axis
            elif self._were_enabled >> axis & 1:
                return ctx.drive_event(DriveLeftEnabled, axis)
        return None

    def _all_enabled(self, ctx: Context) -> Event | None:
        joints = ctx.joints
        if not self._returning:
            self._returning = True
            self._enabled = ctx.cycle
            for group in joints.groups:
                for i, fastest in enumerate(group.limits.velocity):
                    beyond = group.beyond_range(i)
                    if beyond > self._REPORTED_RAD:
                        ctx.publish(ReturningToRange(group.first + i, beyond, min(BACK_RAD_S, fastest)))
        if joints.first_returning() >= 0 or not all(axis.ready for axis in ctx.axes):
            return None
        if ctx.cycle - self._enabled < ctx.cycles(ctx.config.drive_waits.brake_ms * 1e-3):
            # A torque motion and CST begin with the torque that holds the arm.
            return None
        arm = ctx.arm
        if arm.wanted_mode is DriveMode.CST:
            torques = arm.held_torques()
            axis = arm.first_beyond_torque_limit(torques)
            if axis >= 0:
                return TooHeavyForCst(axis, abs(torques[axis]), arm.limits.torque[axis])
        joints.reset_supervision()
        return Enabled()


class Holding(MachineState):
    """Enabled and at rest."""

    state = State.HOLDING
    drives = "the last setpoints, unchanged"
    leads_to = {
        **_TORQUE,
        MotionCommand: State.MOVING,
        Signal.JOYSTICK_DEFLECTED: State.MOVING,
        MotionEnded: State.STOPPING,
        Signal.STOP_FOR_CLOCK: State.STOPPING,
        DisabledUnattended: State.DISABLING,
        Home: State.HOMING,
    }

    def __init__(self) -> None:
        self.changing_mode = False
        """Whether the drives are changing their mode."""
        self._since = 0

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Hold; after enabling, in the drive mode of the control mode."""
        self.changing_mode = False
        if isinstance(cause, Reset):
            ctx.operator.require_neutral()
            ctx.publish(LimitStopReset())
        elif isinstance(cause, Enabled):
            ctx.all_enabled = True
            distance, box = ctx.arm.trajectory_guard.nearest_box(ctx.arm.state.actual)
            if distance < 0.0:
                ctx.publish(EnabledInBox(box, reported(box, -distance)))
            if ctx.arm.wanted_mode is not DriveMode.CSP:
                self.change_mode(ctx, ctx.arm.wanted_mode)

    def change_mode(self, ctx: Context, mode: DriveMode) -> None:
        """Let the drives change to `mode`; only at standstill."""
        ctx.arm.change_mode(mode)
        self.changing_mode = True
        self._since = ctx.cycle

    def update(self, ctx: Context) -> Event | Signal | None:
        """Hold, wait for a mode change, or start to move by the joystick."""
        arm, joints = ctx.arm, ctx.joints
        event = ctx.track() or ctx.take_power_off()
        if event is not None:
            return event
        if self.changing_mode:
            axis = joints.first_in_another_mode()
            self.changing_mode = axis >= 0 or arm.is_braking
            if axis >= 0 and ctx.cycle - self._since > ctx.cycles(ctx.config.drive_waits.mode_ms * 1e-3):
                return ctx.wrong_drive_mode(axis)
            return None
        return Signal.JOYSTICK_DEFLECTED if ctx.operator.jog_by_joystick(arm, ctx.blackboard) else None


class Moving(MachineState):
    """A controller moves the arm."""

    state = State.MOVING
    drives = "the setpoints of the active controller, after the guards"
    leads_to = {
        **_TORQUE,
        MotionCommand: State.MOVING,
        Arrived: State.HOLDING,
        Signal.JOYSTICK_AT_REST: State.HOLDING,
        Halt: State.STOPPING,
        LeaseExpired: State.STOPPING,
        PermissionWithdrawn: State.STOPPING,
        MotionEnded: State.STOPPING,
        Signal.STOP_FOR_CLOCK: State.STOPPING,
    }

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Begin a motion."""
        ctx.limited = False
        self._settling = 0
        """Cycles since the setpoints came to rest."""

    def update(self, ctx: Context) -> Event | Signal | None:
        """Advance the motion by one cycle."""
        event = ctx.permission_lost(ctx.lease)
        if event is not None:
            return event
        if not ctx.lease:
            ctx.operator.jog_by_joystick(ctx.arm, ctx.blackboard)
        event, arm = ctx.track(), ctx.arm
        if event is not None or not arm.still:
            self._settling = 0
            return event
        if arm.active.tolerates_saturation:  # it has no target
            return Arrived() if ctx.lease else Signal.JOYSTICK_AT_REST
        if not ctx.good:
            return None
        axis, settle = arm.first_unsettled(), ctx.config.settle
        if axis < 0:
            return Arrived()
        self._settling += 1
        if self._settling <= ctx.cycles(settle.time_s):
            return None
        distance = abs(arm.state.actual[axis] - arm.state.commanded[axis])
        return NotSettled(axis, distance, settle.tolerance, settle.time_s)


class Stopping(MachineState):
    """A controlled stop."""

    state = State.STOPPING
    drives = "setpoints decelerate to standstill under the limits"
    leads_to = {
        **_TORQUE,
        Stopped: State.HOLDING,
        StoppedByLimit: State.STOPPED_BY_LIMIT,
        MotionEnded: State.STOPPING,
        Signal.STOP_FOR_CLOCK: State.STOPPING,
    }

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Let the controller stop, unless it or a guard stops by itself."""
        ctx.operator.require_neutral()
        if isinstance(cause, MotionEnded):
            ctx.arm.limit_stop()
            if ctx.limited:
                ctx.joints.stop_others()
        else:
            ctx.limited = ctx.limited and cause is Signal.STOP_FOR_CLOCK
            ctx.joints.stop()

    def update(self, ctx: Context) -> Event | Signal | None:
        """Decelerate; at standstill hold, or begin the fault that caused the stop."""
        arm, joints = ctx.arm, ctx.joints
        event = ctx.track()
        if event is not None:
            return event
        if ctx.pending is not None:
            return ctx.pending if joints.at_rest else None
        if not arm.at_rest:
            return None
        arm.rest()
        return StoppedByLimit() if ctx.limited else Stopped()


class StoppedByLimitState(MachineState):
    """Holds after a limit ended the motion, until a reset."""

    state = State.STOPPED_BY_LIMIT
    drives = "the setpoints at which it came to rest, unchanged"
    leads_to = {**_TORQUE, Reset: State.HOLDING, DisabledUnattended: State.DISABLING}

    def update(self, ctx: Context) -> Event | Signal | None:
        """Hold."""
        return ctx.track() or ctx.take_power_off()


class HomingState(MachineState):
    """One drive homes by itself."""

    state = State.HOMING
    drives = "one drive homes by itself (mode of operation 6), the others hold"
    leads_to = {**_PERMITTED, Homed: State.HOLDING, HomingFailed: State.HOLDING, HomedElsewhere: State.HOLDING,
                Stopped: State.HOLDING}  # fmt: skip

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Start the homing of a joint."""
        assert isinstance(cause, Home)
        ctx.homing.begin(cause.axis, cause.home_offset)

    def update(self, ctx: Context) -> Event | Signal | None:
        """Run the homing, then return the joint to its range if its home is slightly outside."""
        event = ctx.track_homing()
        if event is not None or not ctx.good:
            return event
        return ctx.homing.outcome if ctx.homing.ended and ctx.homing.returned_to_range() else None


class Disabling(MachineState):
    """A controlled stop first, then no torque."""

    state = State.DISABLING
    drives = "a controlled stop, then drives advance to Switch On Disabled; brakes close"
    leads_to = {**_FAULTS, Disabled: State.READY}

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Let the arm come to rest."""
        ctx.joints.stop()
        self._since = ctx.cycle
        self._commanded = 0
        """Number of cycles in which the drives were commanded to disable."""

    def update(self, ctx: Context) -> Event | Signal | None:
        """Stop, then disable."""
        joints = ctx.joints
        if ctx.homing.under_way:
            ctx.homing.stop()
            self._since = ctx.cycle
            return ctx.track_homing()
        if not joints.at_rest:
            # The timeout begins at standstill.
            self._since = ctx.cycle
            return ctx.track()
        fault = ctx.bus_fault() or ctx.pending
        if fault is not None or not ctx.good:
            return fault
        ctx.all_enabled = False
        joints.advance(TargetState.DISABLED)
        joints.track_actual()
        self._commanded += 1
        axis = joints.first_with_torque()
        if axis < 0:
            return Disabled() if self._commanded > ctx.answer_cycles else None
        if ctx.cycle - self._since > ctx.cycles(ctx.config.enable_timeout_s):
            ctx.service.explain_drive(axis)
            return DisableTimeout(axis, joints.drives[axis].state, joints.drives[axis].statusword)
        return None


# -- faults -----------------------------------------------------------------------------------------------------------


class Standstill:
    """Detects the standstill of joints in a quick stop, by measurement or, without returned frames, by time.

    Args:
        ctx: duration of a quick stop, and the joints.
    """

    _STAND_S = 2.0
    """Time after the begin of a quick stop, s, at which a drive that still turns needs its brake to stop."""
    _LOST_S = 0.5
    """Least time of lost cycles before `unobservable`, s: well beyond a quick stop that began late."""

    def __init__(self, ctx: Context) -> None:
        ramp_s = quick_stop_s(ctx.config)
        self._stand_cycles = ctx.cycles(max(self._STAND_S, ramp_s))
        self._lost_limit = ctx.cycles(max(self._LOST_S, ramp_s))
        self._cycles = self._lost = 0

    def begin(self) -> None:
        """Restart; called when the quick stop begins."""
        self._cycles = self._lost = 0

    @property
    def unobservable(self) -> bool:
        """Whether cycles were lost for longer than any quick stop takes: the states of the drives are unknown."""
        return self._lost > self._lost_limit

    def reached(self, ctx: Context) -> bool:
        """Count the cycle; return whether the joints stand still, or further waiting is useless."""
        self._cycles += 1
        if not ctx.good:
            self._lost += 1
        stands = ctx.good and self._cycles > ctx.answer_cycles and ctx.joints.first_moving() < 0
        return stands or self.unobservable or self._cycles > self._stand_cycles


class FaultReaction:
    """Commands the drives in a fault, also during its reset: a quick stop, or no torque (CiA 402-2, 0x605E).

    Args:
        ctx: the cycle and the joints.
    """

    _ESTOP_S = 2.0
    """Time after which an emergency stop that cannot be read counts as pressed, s; the slave watcher restores a slave
    that merely left OP, even twice, sooner."""
    _MOVED_RAD = 0.05
    """Motion, rad, that a joint at rest does not reach after a fault before its brake holds (docs/faults.md)."""
    _RAN_ON_S = 1.0
    """Time, s, for which a moving joint may have continued at its speed before lost frames were detected."""
    _NOT_REMEMBERED = frozenset({State.STARTING, State.FAULT, State.EMERGENCY_STOP, State.RESETTING})

    def __init__(self, ctx: Context) -> None:
        self.standstill = Standstill(ctx)
        self._estop_cycles = ctx.cycles(self._ESTOP_S)
        self.torque_off = False
        """Whether the torque is removed: by a command, the reaction, or an emergency stop."""
        self.off_at_rest = False
        """Whether the torque is removed at standstill."""
        self.stood = [nan] * len(ctx.config.joints)
        """Last position of each joint before the fault, rad; NaN: none."""
        self.turned = [0.0] * len(ctx.config.joints)
        """Velocity of each joint at that position, rad/s."""

    def begin(self, ctx: Context, before: State, *, torque_off: bool, off_at_rest: bool) -> None:
        """Begin: reset the reaction, and remember the joints' positions.

        Args:
            ctx: the cycle and the joints.
            before: the state that the machine left.
            torque_off: whether to remove the torque at once.
            off_at_rest: whether to remove it at standstill.
        """
        self.torque_off, self.off_at_rest = torque_off, off_at_rest
        # Only when the fault begins: a lost slave was last read before that. Not by an emergency stop in the fault,
        # when drives may have no supply, and not during the start, in which perhaps no joint was read.
        if before not in self._NOT_REMEMBERED:
            self.stood[:] = ctx.arm.state.actual
            self.turned[:] = ctx.arm.state.actual_velocity
        ctx.pending = None
        ctx.all_enabled = False
        ctx.homing.abandon()
        ctx.joints.hold()
        self.standstill.begin()

    def update(self, ctx: Context) -> None:
        """Command the drives even without returned frames: slaves that receive must not keep their speed or torque."""
        joints = ctx.joints
        at_rest = not self.torque_off and self.off_at_rest and self.standstill.reached(ctx)
        if not self.torque_off and (at_rest or self._estop_unobservable(ctx)):
            self.remove_torque(ctx)
        joints.advance(TargetState.TORQUE_OFF if self.torque_off else TargetState.QUICK_STOPPED)
        if ctx.good:
            joints.track_actual()

    def remove_torque(self, ctx: Context) -> None:
        """Remove the torque from now on."""
        self.torque_off = True
        ctx.publish(TorqueRemoved())

    def report_moved(self, ctx: Context) -> None:
        """Report joints whose position differs from the one at the fault: moved, or counted from another zero.

        No refusal: only a person at the arm can tell which of the two.
        """
        here = ctx.arm.state.actual
        for axis, (stood, turned) in enumerate(zip(self.stood, self.turned, strict=True)):
            # Limited: a false speed may have caused the fault.
            ran_on = self._RAN_ON_S * min(abs(turned), ctx.config.joints[axis].velocity)
            if abs(here[axis] - stood) > self._MOVED_RAD + ran_on:
                ctx.publish(MovedSinceFault(axis, here[axis], stood))

    def _estop_unobservable(self, ctx: Context) -> bool:
        """Return whether the emergency stop could not be read for too long; like a broken wire it counts as pressed."""
        operator = ctx.operator
        if not operator.has_button or operator.unread_cycles <= self._estop_cycles:
            return False
        ctx.publish(EstopUnobservable(self._ESTOP_S))
        return True


class FaultState(MachineState):
    """A fault: drives stopped by its reaction, until a reset."""

    state = State.FAULT
    drives = "the stop reaction of the fault, whether or not frames return"
    leads_to = {
        Reset: State.RESETTING,
        Disable: State.FAULT,
        EmergencyStop: State.EMERGENCY_STOP,
        Shutdown: State.CLOSING,
    }

    def __init__(self, reaction: FaultReaction) -> None:
        self._reaction = reaction

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Stop all drives by the reaction to the event; an arm at standstill holds by a quick stop."""
        reaction = self._reaction
        if isinstance(cause, Disable):
            reaction.remove_torque(ctx)
            return
        assert isinstance(cause, Event)
        hard = ctx.reactions.get(type(cause)) is StopReaction.TORQUE_OFF or (
            before is State.DISABLING and cause is ctx.pending
        )
        # After a command to remove the torque the arm must not hold, and a failed reset must not restore the torque.
        fails = before is State.RESETTING
        reaction.begin(
            ctx,
            before,
            torque_off=hard or (fails and reaction.torque_off),
            off_at_rest=before is State.DISABLING or (fails and reaction.off_at_rest),
        )
        ctx.joints.advance(TargetState.TORQUE_OFF if reaction.torque_off else TargetState.QUICK_STOPPED)

    def update(self, ctx: Context) -> Event | Signal | None:
        """Keep the drives stopped."""
        self._reaction.update(ctx)
        return None


class EmergencyStopState(MachineState):
    """The emergency stop: quick stop, torque off at standstill or at once, slaves to PRE-OP.

    The drives come to rest before the slaves leave OP: a drive that loses its process data in motion drops the arm.
    """

    state = State.EMERGENCY_STOP
    drives = "the stop reaction of its cause; torque off and brakes closed at standstill; then the slaves to PRE-OP"
    leads_to = {Reset: State.RESETTING, Disable: State.EMERGENCY_STOP, Shutdown: State.CLOSING}

    def __init__(self, reaction: FaultReaction) -> None:
        self._reaction = reaction
        self._off = TargetState.DISABLED
        self._since = 0
        """Number of the cycle in which the torque was first commanded off."""
        self._parked = False

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Begin with the quick stop, or without torque."""
        if isinstance(cause, Disable):
            return
        assert isinstance(cause, Event)
        reaction, hard = self._reaction, ctx.reactions[type(cause)] is StopReaction.TORQUE_OFF
        reaction.begin(ctx, before, torque_off=hard, off_at_rest=True)
        self._off = TargetState.TORQUE_OFF if hard else TargetState.DISABLED
        self._since = ctx.cycle
        self._parked = False
        ctx.joints.advance(TargetState.TORQUE_OFF if hard else TargetState.QUICK_STOPPED)

    def update(self, ctx: Context) -> Event | Signal | None:
        """Stop, remove the torque, then park the slaves."""
        joints, reaction = ctx.joints, self._reaction
        if not reaction.torque_off:
            joints.advance(TargetState.QUICK_STOPPED)
            if reaction.standstill.reached(ctx):
                if reaction.standstill.unobservable:
                    # The states of the drives are unknown: this removes the torque in any of them.
                    self._off = TargetState.TORQUE_OFF
                reaction.torque_off = True
                self._since = ctx.cycle
        else:
            joints.advance(self._off)
            waited = ctx.cycle - self._since
            off = ctx.good and waited > ctx.answer_cycles and joints.first_with_torque() < 0
            if not self._parked and (off or waited > ctx.cycles(ctx.config.drive_waits.off_ms * 1e-3)):
                self._parked = True
                ctx.service.park()
                ctx.publish(SlavesParked())
        if ctx.good:
            joints.track_actual()
        return None


class Resetting(MachineState):
    """Out of a fault: slaves back in OP, clock locked, all at rest; then drive faults reset and drives disabled."""

    state = State.RESETTING
    drives = "slaves return to OP, drive faults are reset, drives disabled"
    leads_to = {
        ResetDone: State.READY,
        FaultEvent: State.FAULT,
        Disable: State.FAULT,
        EmergencyStop: State.EMERGENCY_STOP,
        Shutdown: State.CLOSING,
    }

    def __init__(self, reaction: FaultReaction) -> None:
        self._reaction = reaction

    def enter(self, ctx: Context, cause: Cause, before: State) -> None:
        """Bring the slaves back."""
        # In PRE-OP the box has no inputs: the button is known once the box is back in OP.
        ctx.operator.assume_released()
        ctx.service.recover()

    def update(self, ctx: Context) -> Event | Signal | None:
        """Reset the drives that are back; fail after `drive_waits.reset_ms`."""
        joints = ctx.joints
        if ctx.reported is not None:
            return ctx.reported
        if not (ctx.good and ctx.service.all_op and ctx.clock_locked):
            self._reaction.update(ctx)
            return self._failure(ctx)
        # Moving joints come to rest first: the reset removes their torque.
        joints.advance(TargetState.RESET if joints.first_moving() < 0 else TargetState.QUICK_STOPPED)
        joints.track_actual()
        if joints.first_not_resting() < 0 and ctx.operator.button_known:
            return ResetDone()
        return self._failure(ctx)

    def _failure(self, ctx: Context) -> Event | None:
        button = ctx.config.inputs.emergency_stop
        settling_ms = 0.0 if button is None else button.debounce_ms
        if ctx.waited <= ctx.cycles((ctx.config.drive_waits.reset_ms + settling_ms) * 1e-3):
            return None
        joints, all_op = ctx.joints, ctx.service.all_op
        axis = joints.first_moving()
        if axis >= 0 and ctx.good and all_op:
            return ResetWhileMoving(axis, joints.drives[axis].velocity)
        axis = joints.first_not_resting()
        # Without the clock no drive was commanded to reset, so a drive not at rest is not the cause.
        if axis >= 0 and all_op and ctx.clock_locked:
            ctx.service.explain_drive(axis)
            return ResetTimeout(axis, joints.drives[axis].state, joints.drives[axis].statusword)
        if all_op:
            return ResetWithoutFrames()
        axis = joints.first_blocked()
        return ResetWithoutSlaves() if axis < 0 else ResetWithoutController(joints.drives[axis].missing)


class Closing(MachineState):
    """The end: a controlled stop, torque off; an emergency on the way takes its own reaction."""

    state = State.CLOSING
    drives = "a controlled stop, drives disabled; then INIT"
    leads_to = {Shutdown: State.CLOSING, Signal.CLOSED: State.OFF}

    def __init__(self, standstill: Standstill) -> None:
        self._standstill = standstill
        self._target = TargetState.QUICK_STOPPED
        self._hard = False
        """Whether an emergency occurred: moving joints are stopped by their drives."""
        self._cycles = self._commanded = 0

    def update(self, ctx: Context) -> Event | Signal | None:
        """Stop, disable, end."""
        return Signal.CLOSED if self._is_done(ctx) else None

    def _is_done(self, ctx: Context) -> bool:
        joints, lost_limit = ctx.joints, ctx.config.bus.lost_cycles
        self._cycles += 1
        if self._decelerates(ctx):
            return False
        if ctx.lost >= lost_limit:
            # Slaves that still receive frames stay in OP until standstill.
            joints.advance(self._target if self._hard else _TARGETS[ctx.reactions[ProcessDataLost]])
            return ctx.lost >= lost_limit + ceil(quick_stop_s(ctx.config) / ctx.period_s) + ctx.answer_cycles
        if self._cycles > self._longest(ctx):
            return True
        if not ctx.good:
            return False
        homing = ctx.homing
        if homing.under_way and joints.first_not_enabled() < 0:
            homing.stop()
            joints.stop_others()
            homing.step()
            self._cycles = 0
            if homing.still_moving:
                self._stop_hard(ctx, HomingStillMoving(homing.axis, joints.drives[homing.axis].velocity))
            elif (problem := ctx.axis_problem()) is not None:
                self._stop_hard(ctx, problem)
            return False
        return self._stop(ctx) and self._remove_torque(ctx)

    def _longest(self, ctx: Context) -> int:
        """Return the longest time of the end from standstill of the setpoints on, in cycles."""
        return ctx.cycles(ctx.config.drive_waits.off_ms * 2e-3)

    def _decelerates(self, ctx: Context) -> bool:
        """React to the emergency stop or a measurement beyond its limit; return whether the arm still decelerates."""
        joints = ctx.joints
        if not self._hard and joints.first_with_torque() >= 0:
            event: Event | None = None
            if ctx.good and joints.first_not_enabled() < 0:
                event = joints.beyond_limits()
            if event is None and ctx.operator.emergency_stop:
                event = EmergencyStopActivated()
            if event is not None:
                self._stop_hard(ctx, event)
        if not self._hard:
            return False
        self._standstill.reached(ctx)
        if self._standstill.unobservable:
            self._target = TargetState.TORQUE_OFF
        if joints.first_moving() < 0 or self._cycles > self._longest(ctx):
            return False
        joints.advance(self._target)
        if ctx.good:
            joints.track_actual()
        return True

    def _stop_hard(self, ctx: Context, event: Event) -> None:
        self._hard = True
        self._target = _TARGETS[ctx.reactions[type(event)]]
        self._cycles = 0
        self._standstill.begin()
        ctx.homing.abandon()
        ctx.joints.hold()
        ctx.publish(event)

    def _stop(self, ctx: Context) -> bool:
        """Bring the setpoints to rest; return whether they are at rest, or no drive follows them."""
        joints = ctx.joints
        joints.stop()
        if joints.at_rest or joints.first_not_enabled() >= 0:
            return True
        self._cycles = 0
        result = joints.command()
        event: Event | None = ctx.controller_raised()
        if event is None:
            event = ctx.axis_problem()
        if event is not None:
            self._stop_hard(ctx, event)
        elif result is GuardResult.STOPPED:
            ctx.arm.rest()
        return False

    def _remove_torque(self, ctx: Context) -> bool:
        # In a fault the drives decelerate by themselves: their torque is removed at standstill.
        joints = ctx.joints
        ramping = joints.first_with_torque() >= 0 and joints.first_not_enabled() >= 0 and joints.first_moving() >= 0
        joints.advance(TargetState.QUICK_STOPPED if ramping else TargetState.DISABLED)
        joints.track_actual()
        self._commanded = 0 if ramping else self._commanded + 1
        return self._commanded > ctx.answer_cycles and joints.first_with_torque() < 0
