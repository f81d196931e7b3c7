"""What the states of the machine share: the parts of the loop, facts that outlive a state, checks of a cycle."""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.gripper import DrivenGripper
from rtcp.control.homing import HomingSequence
from rtcp.control.joint_group import Joints
from rtcp.control.operator import Operator
from rtcp.control.part import Device, Part, PartContext
from rtcp.control.partners import Partners
from rtcp.devices.io_box import IoBox
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import (
    ClockLost,
    ControllerFailed,
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

_IN_FAULT = frozenset({DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE})


class Context(PartContext):
    """One for the machine; a state reads it and calls it, and writes only what is said to be a state's to write.

    Args:
        config: timeouts, how many cycles may be lost, and the stop reactions.
        arm: its joints.
        gripper: one with a drive of its own, or None.
        operator: the inputs and outputs with a function.
        devices: the slaves that are no drives.
        blackboard: where events go, and where the lease is.
        service: the thread beside the cycle.
        discipline: follows the reference clock, or None without distributed clocks.
        partners: of the arm in a cell.
        processes: beside motion.
    """

    def __init__(
        self,
        config: ArmConfig,
        arm: Arm,
        gripper: DrivenGripper | None,
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
        self.arm = arm
        self.gripper = gripper
        self.joints = Joints(arm, [] if gripper is None else [gripper])
        self.operator = operator
        if partners is not None:
            arm.trajectory_guard.neighbours = partners.watch(arm.state, arm.limits, self.period_s)
        cell = () if partners is None else (partners,)
        self.parts: list[Part] = [*self.joints.groups, operator, *processes, *devices, *cell]
        """The parts of the cycle; the operator and processes write outputs before their slaves encode them."""
        self.boxes = [
            (device.slot + 1, device.driver if isinstance(device.driver, IoBox) else None)
            for device in devices
            if device.name in config.boxes
        ]
        """Position on the cable and driver of each of the configuration's boxes; None: its driver is no IO box's."""
        self.blackboard = blackboard
        self.service = service
        self.homing = HomingSequence(arm, self.joints, self.period_s)
        self.reactions = reactions(config.stops)
        self._discipline = discipline
        self._lost_limit = config.bus.lost_cycles
        self._clock_cycles = round(config.ethercat.clock_lost_s / self.period_s)
        self._unlocked = 0
        self.entered = 0
        """Cycle in which the machine changed to its state."""
        self.lost = 0
        """Cycles in a row without it."""
        self.wkc_error_count = 0
        """Cycles without it, less those with it, 0 to `bus.lost_cycles`."""
        self.lease = 0
        """Lease of the commander whose motion runs; 0: the joystick's, which needs none."""
        self.limited = False
        """Written by states: whether the stop under way ends in the state stopped by limit."""
        self.pending: ClockLost | None = None
        """A fault that begins as soon as the controlled stop that it caused has come to rest."""

    # -- the cycle ------------------------------------------------------------------------------------------------

    def begin_cycle(self, good: bool) -> None:
        """Count the cycle; `good`: the exchange had the expected working counter."""
        self.cycle += 1
        self.good = good
        if good:
            self.lost = 0
            if self.wkc_error_count:
                self.wkc_error_count -= 1
            self.operator.read()
            return
        self.lost += 1
        if self.wkc_error_count < self._lost_limit:
            self.wkc_error_count += 1

    @property
    def waited(self) -> int:
        """Cycles since the machine changed to its state."""
        return self.cycle - self.entered

    def cycles(self, seconds: float) -> int:
        """Return how many cycles a time lasts."""
        return round(seconds / self.period_s)

    def publish(self, event: Event) -> None:
        """Report an event that changes no state."""
        self.blackboard.event(event)

    def explain(self, what: str, error: Exception) -> None:
        """Let an exception be put into the log, not by this thread."""
        self.service.explain_error(what, error)

    @property
    def clock_locked(self) -> bool:
        """Whether there is no reference clock, or the cycle is locked to it."""
        return self._discipline is None or self._discipline.locked

    @property
    def stop_box_in_op(self) -> bool:
        """Whether there is a box for the emergency stop, and in OP."""
        position = self.operator.stop_position
        return position > 0 and self.blackboard.in_op(position)

    def clear_lost_boxes(self) -> None:
        """Clear the outputs of each box that is not in OP; where it was the first slave lost, until the reset."""
        for position, box in self.boxes:
            if box is not None and (self.service.lost_slave == position or not self.blackboard.in_op(position)):
                self.operator.clear_outputs(box)

    def make_safe(self) -> None:
        """Tell every part to set its outputs to their safe state."""
        for part in self.parts:
            part.safe()

    # -- what ends a state from outside ---------------------------------------------------------------------------

    def bus_fault(self) -> Event | None:
        """Return what was lost of frames, slaves and clock, or what a part has reported."""
        if self.reported is not None:
            return self.reported
        # Not those in a row alone: one good cycle in ten would keep an arm moving that is hardly heard.
        if not self.good and self.wkc_error_count >= self._lost_limit:
            return ProcessDataLost(self.lost, self._lost_limit)
        if self.service.lost_slave:
            return SlaveLost(self.service.lost_slave)
        self._unlocked = 0 if self.clock_locked else self._unlocked + 1
        if self._unlocked > self._clock_cycles and self.pending is None:
            self._unlocked = 0
            return ClockLost(self.config.ethercat.clock_lost_s)
        return None

    def lease_held(self, lease: int) -> bool:
        """Return whether the commander of `lease` still holds it; 0: the joystick, which needs none."""
        if not lease:
            return True
        held, renewed, duration = self.blackboard.lease()
        return held == lease and self.now_ns - renewed <= duration

    def permission_lost(self, lease: int) -> Event | None:
        """Return why what moves for the commander of `lease` has to stop, or None."""
        if not self.operator.permitted:
            return PermissionWithdrawn()
        return None if self.lease_held(lease) else LeaseExpired()

    def is_controlled(self, event: Event) -> bool:
        """Return whether the reaction to an event leaves the drives enabled."""
        return self.reactions[type(event)] is StopReaction.CONTROLLED_STOP

    def drive_event(self, kind: type[DriveFault] | type[DriveLeftEnabled], axis: int) -> Event:
        """Return the event of a drive, whose error code is looked up; one that shows a fault is in fault."""
        self.service.explain_drive(axis)
        drive = self.joints.drives[axis]
        if drive.state in _IN_FAULT:
            kind = DriveFault
        return kind(axis, drive.state, drive.statusword)

    def wrong_drive_mode(self, axis: int) -> Event:
        """Return the event of a drive that does not change its mode."""
        drive = self.joints.drives[axis]
        return DriveModeTimeout(axis, drive.mode_display, DriveMode(drive.mode))

    # -- one cycle of an enabled arm ------------------------------------------------------------------------------

    def track(self) -> Event | None:
        """Check what was lost and measured, then move the setpoints on by one cycle.

        Return what ends the state. Without a good cycle the setpoints stand still: the slaves missed the last ones.
        """
        arm, joints = self.arm, self.joints
        event = self.bus_fault()
        if event is not None or not self.good:
            return event
        axis = joints.first_not_enabled()
        if axis >= 0:
            return self.drive_event(DriveLeftEnabled, axis)
        event = joints.beyond_limits() or self._supervise_gripper()
        if event is not None:
            return event
        result = joints.command()
        if result is GuardResult.PASS and arm.active.ended is None:
            return None
        return self._motion_end(result)

    def track_homing(self) -> Event | None:
        """Run the homing for a cycle, supervised as any motion; return what ends the state."""
        joints, homing = self.joints, self.homing
        event = self.bus_fault()
        if event is not None or not self.good:
            return event
        axis = joints.first_not_enabled()
        if axis >= 0:
            return self.drive_event(DriveLeftEnabled, axis)
        event = self.permission_lost(self.lease)
        if event is not None:
            if not self.is_controlled(event):
                return event
            homing.stop()
        homing.step()
        event = joints.beyond_limits() or self._supervise_gripper()
        if event is not None:
            return event
        if homing.stuck:
            return self.wrong_drive_mode(homing.axis)
        if homing.still_moving:
            return HomingStillMoving(homing.axis, joints.drives[homing.axis].velocity)
        axis = joints.first_outside()
        if axis >= 0:
            # While the drive searches, and where it counts from a new zero.
            return LeftRange(axis, joints.drives[axis].position)
        if not homing.leaving and (box := self.arm.trajectory_guard.zone_at(self.arm.state.actual)) is not None:
            self.publish(HomingInBox(box))
            homing.stop()
        return None

    def _supervise_gripper(self) -> Event | None:
        """Stop a gripper that nobody commands any more; return what ends the state."""
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
        """Return what ends the motion: a guard that stops it, or its controller."""
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
