"""Shared data of the machine's states: parts of the loop, facts that outlive a state, checks of a cycle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rtcp.config.model import VIRTUAL, ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.external_axis import ExternalAxisGroup
from rtcp.control.gripper import DrivenGripper
from rtcp.control.homing import HomingSequence
from rtcp.control.joint_group import Joints
from rtcp.control.operator import Operator
from rtcp.control.part import Device, Part, PartContext, PluginTimer
from rtcp.control.partners import Partners
from rtcp.devices.drive import CSP
from rtcp.devices.io_box import IoBox
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import (
    AxisModeLost,
    ClockLost,
    ControllerFailed,
    ControllerRaised,
    DisabledUnattended,
    DriveFault,
    DriveLeftEnabled,
    DriveModeTimeout,
    Event,
    GeneratorFailed,
    HomingInBox,
    HomingStillMoving,
    LeaseExpired,
    LeftRange,
    MotionEnded,
    PermissionWithdrawn,
    ProcessDataLost,
    SlaveLost,
)
from rtcp.ipc.states import DriveMode, DriveState, State
from rtcp.ipc.stop_reactions import StopReaction, reactions
from rtcp.motion.guards.trajectory_guard import GuardResult
from rtcp.realtime.discipline import Discipline

_GOOD_FOR_LOST: Final = 10
"""Good cycles that make up for a lost one; 1 on the virtual bus with wider timeouts: a busy host loses many there."""
_IN_FAULT = frozenset({DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE})


def good_for_lost(config: ArmConfig) -> int:
    """Return the number of good cycles that make up for a lost one."""
    bus = config.bus
    return 1 if bus.interface == VIRTUAL and bus.timeout_scale > 1.0 else _GOOD_FOR_LOST


class Context(PartContext):
    """The machine's context; states read it and call its methods, and write only attributes documented as theirs.

    Args:
        config: timeouts, tolerated lost cycles, and the stop reactions.
        timer: names plug-ins that take too long.
        arm: its joints.
        gripper: a gripper with a drive, or None.
        axes: the external axes.
        operator: the inputs and outputs with a function.
        devices: the slaves that are no drives.
        blackboard: receives events, provides the lease.
        service: the thread beside the cycle.
        discipline: follows the reference clock; None without distributed clocks.
        partners: the arm's partners in a cell.
        processes: processes beside motion.
    """

    def __init__(
        self,
        config: ArmConfig,
        timer: PluginTimer,
        arm: Arm,
        gripper: DrivenGripper | None,
        axes: Sequence[ExternalAxisGroup],
        operator: Operator,
        devices: Sequence[Device],
        blackboard: Blackboard,
        service: BusService,
        discipline: Discipline | None,
        partners: Partners | None = None,
        processes: Sequence[Part] = (),
    ) -> None:
        super().__init__(config.cycle.period_us * 1e-6)
        self.config = config
        self.timer = timer
        self.arm = arm
        self.gripper = gripper
        self.axes = list(axes)
        self.joints = Joints(arm, [*([] if gripper is None else [gripper]), *self.axes])
        self.joints.time_foreign(timer)
        self.operator = operator
        if partners is not None:
            arm.trajectory_guard.neighbours = partners.watch(arm.state, arm.limits, self.period_s)
        cell = () if partners is None else (partners,)
        self.parts: list[Part] = [*self.joints.groups, operator, *processes, *devices, *cell]
        """Parts in the order of the cycle: operator and processes write outputs before their slaves encode them."""
        self.boxes = [
            (device.slot + 1, device.driver if isinstance(device.driver, IoBox) else None)
            for device in devices
            if device.name in config.boxes
        ]
        """Position on the cable and driver of each configured box; None: the driver is not an IO box's."""
        self.blackboard = blackboard
        self.service = service
        self.homing = HomingSequence(arm, self.joints, config)
        self.answer_cycles = config.drive_waits.answer_cycles(self.period_s)
        """Cycles after which the values of the drives answer a command: earlier ones may be older."""
        self.reactions = reactions(config.stops)
        self._discipline = discipline
        self._good_for_lost = good_for_lost(config)
        self._lost_limit = self._good_for_lost * config.bus.lost_cycles
        self._clock_cycles = round(config.ethercat.clock_lost_s / self.period_s)
        self._unlocked = 0
        self.entered = 0
        """Number of the cycle in which the machine changed to its state."""
        self.lost = 0
        """Consecutive cycles without the expected working counter."""
        self.wkc_error_count = 0
        """Cycles without the expected working counter, `good_for_lost` each, minus cycles with it; 0 to as many times
        `bus.lost_cycles`."""
        self.lease = 0
        """Lease of the commander of the enabling or the motion; 0: the joystick, which needs none."""
        self.unattended = False
        """Whether a commander was lost while it moved something, and nobody has commanded since."""
        self._commander_lost = 0
        """Number of the cycle in which that commander was lost: with a gripper the arm may hold for long before."""
        self._power_off_cycles = self.cycles(config.stops.power_off_after_s or 0.0)
        self.limited = False
        """Whether the present stop ends in the state stopped by limit; written by states."""
        self.pending: ClockLost | None = None
        """Fault that begins at standstill of the controlled stop that it caused."""

    # -- the cycle ------------------------------------------------------------------------------------------------

    def begin_cycle(self, good: bool) -> None:
        """Count the cycle; `good`: it had the expected working counter."""
        self.cycle += 1
        self.good = good
        if good:
            self.lost = 0
            if self.wkc_error_count:
                self.wkc_error_count -= 1
            self.operator.read()
            return
        self.lost += 1
        self.operator.miss()
        self.wkc_error_count = min(self.wkc_error_count + self._good_for_lost, self._lost_limit)

    @property
    def waited(self) -> int:
        """Cycles since the machine changed to its state."""
        return self.cycle - self.entered

    def cycles(self, seconds: float) -> int:
        """Return a time, s, in cycles."""
        return round(seconds / self.period_s)

    def publish(self, event: Event) -> None:
        """Report an event that changes no state."""
        self.blackboard.event(event)

    def explain(self, subject: str, error: BaseException) -> None:
        """Let the thread beside the cycle report an exception raised by `subject`."""
        self.service.explain_error(subject, error)

    @property
    def clock_locked(self) -> bool:
        """Whether there is no reference clock, or the cycle is locked to it."""
        return self._discipline is None or self._discipline.locked

    @property
    def stop_box_in_op(self) -> bool:
        """Whether the box of the emergency stop exists and is in OP."""
        position = self.operator.stop_position
        return position > 0 and self.blackboard.in_op(position)

    def clear_lost_boxes(self) -> None:
        """Clear the outputs of each box that is not in OP; of the first lost slave until the reset."""
        for position, box in self.boxes:
            if box is not None and (self.service.lost_slave == position or not self.blackboard.in_op(position)):
                self.operator.clear_outputs(box)

    def make_safe(self) -> None:
        """Set the outputs of every part to their safe state."""
        for part in self.parts:
            self.make_part_safe(part)

    def make_part_safe(self, part: Part) -> None:
        """Set the outputs of a part to their safe state; a slow plug-in is named."""
        began = self.timer.now()
        part.safe()
        if part.is_timed:
            self.timer.check(part.name, began)

    # -- external ends of a state ---------------------------------------------------------------------------------

    def bus_fault(self) -> Event | None:
        """Return the event of lost frames, slaves or clock, or one that a part has reported; None: none."""
        if self.reported is not None:
            return self.reported
        # Not only consecutive ones: each burst of lost cycles stops the joints and starts them again.
        if not self.good and self.wkc_error_count >= self._lost_limit:
            return ProcessDataLost(self.lost, self.config.bus.lost_cycles)
        if self.service.lost_slave:
            return SlaveLost(self.service.lost_slave)
        self._unlocked = 0 if self.clock_locked else self._unlocked + 1
        if self._unlocked > self._clock_cycles and self.pending is None:
            self._unlocked = 0
            return ClockLost(self.config.ethercat.clock_lost_s)
        return None

    def lease_held(self, lease: int) -> bool:
        """Return whether `lease` is current and not expired; 0: the joystick, which needs none.

        A renewal may be later than the begin of this cycle; one that lies far in the future is none.
        """
        if not lease:
            return True
        current, renewed, duration = self.blackboard.lease()
        return current == lease and -duration <= self.now_ns - renewed <= duration

    def permission_lost(self, lease: int) -> Event | None:
        """Return the event that forbids motion for the commander of `lease`, or None."""
        if not self.operator.permitted:
            return PermissionWithdrawn()
        if self.lease_held(lease):
            return None
        self.unattended, self._commander_lost = True, self.cycle
        return LeaseExpired()

    def take_power_off(self) -> DisabledUnattended | None:
        """Return, once, the event that disables the drives of an arm that holds since its commander was lost."""
        if not self.unattended or not self._power_off_cycles:
            return None
        if self.cycle - max(self.entered, self._commander_lost) < self._power_off_cycles:
            return None
        self.unattended = False
        return DisabledUnattended(self._power_off_cycles * self.period_s)

    def is_controlled(self, event: Event) -> bool:
        """Return whether the reaction to an event is a controlled stop, with the drives enabled."""
        return self.reactions[type(event)] is StopReaction.CONTROLLED_STOP

    def drive_event(self, kind: type[DriveFault] | type[DriveLeftEnabled], axis: int) -> Event:
        """Return a `DriveFault` where the drive is in fault, else `kind`; requests a report of its error code."""
        self.service.explain_drive(axis)
        drive = self.joints.drives[axis]
        if drive.state in _IN_FAULT:
            kind = DriveFault
        return kind(axis, drive.state, drive.statusword)

    def wrong_drive_mode(self, axis: int) -> Event:
        """Return the event of a drive that does not change its drive mode."""
        drive = self.joints.drives[axis]
        if drive.mode < CSP:
            return AxisModeLost(axis, drive.mode_display, drive.mode)
        return DriveModeTimeout(axis, drive.mode_display, DriveMode(drive.mode))

    # -- one cycle of an enabled arm ------------------------------------------------------------------------------

    def track(self) -> Event | None:
        """Check bus and measurements, then advance the setpoints by one cycle; return the event that ends the state.

        Without a good cycle the setpoints do not advance, as the slaves missed the last ones.
        """
        arm, joints = self.arm, self.joints
        event = self.bus_fault()
        if event is not None or not self.good:
            return event
        axis = joints.first_not_enabled()
        if axis >= 0:
            return self.drive_event(DriveLeftEnabled, axis)
        event = joints.beyond_limits() or arm.pushed() or self._supervise_others()
        if event is not None:
            return event
        result = joints.command()
        if arm.feed_forward is not None:
            arm.feed_forward.update(arm.state, arm.mode)
        if arm.raised is not None:
            return self.controller_raised()
        if result is GuardResult.PASS and arm.active.ended is None:
            return None
        return self._motion_end(result)

    def controller_raised(self) -> ControllerRaised | None:
        """Return the event of a controller that has raised an exception, or None; the log explains the exception."""
        arm, error = self.arm, self.arm.raised
        if error is None:
            return None
        arm.raised = None
        self.explain(f"controller {arm.raised_by}", error)
        return ControllerRaised(arm.raised_by)

    def track_homing(self) -> Event | None:
        """Run the homing for a cycle, supervised as any motion; return the event that ends the state."""
        joints, homing = self.joints, self.homing
        event = self.bus_fault()
        if event is not None or not self.good:
            return event
        axis = joints.first_not_enabled()
        if axis >= 0:
            return self.drive_event(DriveLeftEnabled, axis)
        event = self.permission_lost(self.lease)
        if event is not None:
            # After the end of the homing the joint returns to its range, which only the removal of torque stops.
            if homing.ended or not self.is_controlled(event):
                return event
            homing.stop()
        homing.step()
        if self.arm.feed_forward is not None:
            self.arm.feed_forward.update(self.arm.state, self.arm.mode)
        event = joints.beyond_limits() or self._supervise_others()
        if event is not None:
            return event
        if homing.stuck:
            return self.wrong_drive_mode(homing.axis)
        if homing.still_moving:
            return HomingStillMoving(homing.axis, joints.drives[homing.axis].velocity)
        axis = joints.first_outside()
        if axis >= 0:
            # During the search, and when the drive counts from a new zero.
            return LeftRange(axis, joints.drives[axis].position)
        if not homing.leaving and (box := self.arm.trajectory_guard.zone_at(self.arm.state.actual)) is not None:
            self.publish(HomingInBox(box))
            homing.stop()
        return None

    def _supervise_others(self) -> Event | None:
        return self._supervise_gripper() or self._supervise_axes()

    def axis_problem(self) -> Event | None:
        """Return the fault of an external axis in this cycle, or None."""
        for axis in self.axes:
            if axis.problem is not None:
                return axis.problem
        return None

    def _supervise_axes(self) -> Event | None:
        """Stop external axes without a commander; return the event that ends the state."""
        problem = self.axis_problem()
        if problem is not None:
            return problem
        for axis in self.axes:
            if not axis.moves_by_command:
                continue
            event = self.permission_lost(axis.lease)
            if event is None:
                continue
            if not self.is_controlled(event):
                return event
            self.publish(event)
            axis.stop()
        return None

    def _supervise_gripper(self) -> Event | None:
        """Stop a gripper without a commander; return the event that ends the state."""
        gripper = self.gripper
        if gripper is None or not gripper.motion.moving or gripper.motion.stops:
            return None
        event = self.permission_lost(gripper.lease)
        if event is not None:
            if not self.is_controlled(event):
                return event
            self.publish(event)
        elif gripper.lease or self.operator.holds_grip:
            return None
        gripper.stop()
        return None

    def _motion_end(self, result: GuardResult) -> Event | None:
        """Return the event that ends the motion: a guard stops it, or its controller has finished."""
        arm, controller = self.arm, self.arm.active
        ended: MotionEnded | None = controller.ended
        if isinstance(ended, ControllerFailed):
            return GeneratorFailed()
        limited = not controller.tolerates_saturation
        if result in (GuardResult.STOPPING, GuardResult.STOPPED):
            first = self.state in (State.MOVING, State.HOLDING) or (limited and not self.limited)
            if result is GuardResult.STOPPED:
                arm.rest()
            if not first:
                return None
            ended = arm.trajectory_guard.ended
        elif self.state is not State.MOVING:
            return None
        if ended is not None:
            self.limited = limited and ended.by_limit
        return ended
