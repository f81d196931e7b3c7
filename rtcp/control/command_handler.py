"""Commands of the loop: checked against lease, state and limits, then carried out or refused.

A motion command goes to the controller that names it (`rtcp.motion.controllers`); every other command has a method
here, registered by the command's class.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from math import hypot
from typing import Any, Final

from kinematics.model import LinkMass
from rtcp.config.find import is_foreign
from rtcp.config.model import ConfigError
from rtcp.control.external_axis import ExternalAxisGroup
from rtcp.control.machine import StateMachine
from rtcp.control.part import Device, Part
from rtcp.control.processes import ProcessPart
from rtcp.devices.cia402 import Cia402Drive
from rtcp.ipc import commands, events, refusals
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.layout import PLANS
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.motion.controllers.stream import StreamController
from rtcp.motion.limits import read
from rtcp.motion.speed_override import LOWEST
from rtcp.motion.state import Phase

MOST_LIMIT_ROWS: Final = 64
"""Most rows of limits, all checked in one cycle: `MOST_AXES` joints and more boxes than any configuration has."""
_LARGEST_OFFSET: Final = 100.0
_FARTHEST_PAYLOAD_M: Final = 1.0
_FIXED_DRIVE_MODE = frozenset({ControlMode.VELOCITY, ControlMode.TORQUE})
_PLANNED = (commands.RunTrajectory, commands.RunInStep, commands.RunLines)
_AUTOMATIC = frozenset({ControlMode.JOINT, ControlMode.CARTESIAN})
_STOPPED_BY_DRIVES = frozenset({State.FAULT, State.EMERGENCY_STOP})


_MOST_SETPOINTS: Final = 8
"""Most setpoints read in one cycle: a sender faster than the loop must not delay it."""


class CommandHandler:
    """Handles at most one command a cycle.

    Args:
        machine: the state machine; a command that a part names goes to that part.
        blackboard: provides commands and receives answers.
    """

    def __init__(self, machine: StateMachine, blackboard: Blackboard) -> None:
        self._machine = machine
        self._context = machine.context
        self._arm = machine.context.arm
        self._joints = machine.context.joints
        self._operator = machine.context.operator
        self._blackboard = blackboard
        self._handlers: dict[type[commands.Command], Callable[[Any, int], refusals.Refusal | None]] = {
            commands.Enable: self._enable,
            commands.Disable: self._disable,
            commands.Reset: self._reset,
            commands.SetDriveMode: self._set_drive_mode,
            commands.SetControlMode: self._set_control_mode,
            commands.Halt: self._halt,
            commands.SetOutput: self._set_output,
            commands.SetChannel: self._set_channel,
            commands.MoveGripper: self._move_gripper,
            commands.MoveAxis: self._move_axis,
            commands.RunAxis: self._move_axis,
            commands.HomeAxis: self._move_axis,
            commands.StopAxis: self._stop_axis,
            commands.SetLimits: self._set_limits,
            commands.SetSpeedOverride: self._set_speed_override,
            commands.Pause: self._pause,
            commands.Resume: self._resume,
            commands.SetTool: self._set_tool,
            commands.SetPayload: self._set_payload,
            commands.SetZero: self._set_zero,
            commands.Home: self._home,
            commands.Shutdown: self._shut_down,
        }
        stream = self._arm.controllers[commands.OpenStream]
        assert isinstance(stream, StreamController)
        self._stream = stream
        self._process_outputs = machine.context.config.process_outputs
        self._processes = [part for part in machine.context.parts if isinstance(part, ProcessPart)]
        for part in machine.context.parts:
            for kind in part.commands:
                if kind in self._handlers or issubclass(kind, commands.MotionCommand):
                    raise ConfigError([f"{part.name}: the command {kind.name} is already taken by another part"])
                self._handlers[kind] = partial(self._timed_accept, part) if part.is_timed else part.accept

    def handle(self) -> None:
        """Carry out and answer the next command; called only when one waits."""
        number, lease, command = self._blackboard.take_command()
        refusal = self._refusal(command, lease)
        try:
            self._blackboard.answer(number, refusal)
        except struct.error:
            # A field of the command is too large for the refusal, which repeats it.
            self._blackboard.answer(number, refusals.Malformed(command.number))

    def take_setpoints(self) -> None:
        """Read waiting setpoints, at most `_MOST_SETPOINTS` a cycle; those of a closed stream are dropped."""
        board, stream, state = self._blackboard, self._stream, self._arm.state
        for _ in range(_MOST_SETPOINTS):
            if not board.setpoint_waits():
                break
            number, bits, stamp_s, numbers = board.take_setpoint()
            if number == self.open_stream != 0:
                stream.put(state, bits, stamp_s, numbers)

    @property
    def open_stream(self) -> int:
        """Number of the active stream; 0: none."""
        moves = self._stream.stream and self._arm.active is self._stream and self._machine.state is State.MOVING
        return self._stream.stream if moves else 0

    def _refusal(self, command: commands.Command | refusals.Refusal, lease: int) -> refusals.Refusal | None:
        """Carry out a command, or return its refusal."""
        if isinstance(command, refusals.Refusal):
            return command
        if command.needs_lease and not (lease and self._context.lease_held(lease)):
            return refusals.NoLease()
        if command.needs_lease:
            self._context.unattended = False
        state = self._machine.state
        if state not in command.states:
            return refusals.WrongState(command.number, state)
        if command.waits_for_drive_mode and self._machine.changing_mode:
            return refusals.DriveModeChanging()
        if isinstance(command, commands.MotionCommand):
            return self._move(command, lease)
        handler = self._handlers.get(type(command))
        return handler(command, lease) if handler is not None else refusals.Malformed(command.number)

    def _timed_accept(self, part: Part, command: commands.Command, lease: int) -> refusals.Refusal | None:
        timer = self._context.timer
        began = timer.now()
        refusal = part.accept(command, lease)
        timer.check(part.name, began)
        return refusal

    # -- motion ---------------------------------------------------------------------------------------------------

    def _motion_refusal(self, modes: frozenset[ControlMode]) -> refusals.Refusal | None:
        """Return the refusal of a motion of these control modes in the present state."""
        active = self._arm.control_mode
        if active not in modes:
            return refusals.WrongControlMode(active, min(modes))
        partners = self._machine.partners
        if partners is not None and partners.group.foreign >= 0:
            return refusals.PartnerOfAnotherCell(partners.group.foreign)
        return None if self._operator.permitted else refusals.NotPermitted()

    def _move(self, command: commands.MotionCommand, lease: int) -> refusals.Refusal | None:
        arm, machine = self._arm, self._machine
        controller = arm.controllers.get(type(command))
        if not arm.drives:
            return refusals.NoArm()
        if controller is None:
            return refusals.NoGeometry()
        refusal = self._motion_refusal(controller.control_modes)
        if refusal is not None:
            return refusal
        if arm.group.under_way:
            # A motion in step cannot be replaced: its partners would continue.
            return refusals.WrongState(command.number, State.MOVING)
        if arm.speed_override.paused and not isinstance(command, commands.ExtendTrajectory):
            return refusals.MotionPaused()
        if isinstance(command, _PLANNED) and command.tool != arm.tool.number:
            return refusals.PlannedForAnotherTool(command.tool, arm.tool.number)
        continues = machine.state is State.MOVING and arm.active is controller and not arm.still
        timer = self._context.timer
        began = timer.now()
        refusal = arm.accept_motion(controller, command, continues)
        if is_foreign(controller):
            timer.check(f"controller {controller.name}", began)
        if refusal is not None:
            return refusal
        if isinstance(command, _PLANNED):
            self._blackboard.use_plan(command.slot)
        elif isinstance(command, commands.OpenStream):
            # Before the answer, after which the sender may send at once.
            self._blackboard.open_stream(command.stream)
        arm.active = controller
        if not (continues and self._context.lease == lease):
            machine.change(command, lease)
        return None

    def _home(self, command: commands.Home, lease: int) -> refusals.Refusal | None:
        arm = self._arm
        if self._external_axis(command.axis) is not None:
            return refusals.IsExternalAxis(command.axis)
        if not 0 <= command.axis < len(arm.drives):
            return refusals.UnknownAxis(command.axis, len(arm.drives) - 1)
        drive = arm.drives[command.axis]
        if not isinstance(drive, Cia402Drive) or not drive.changes_mode:
            return refusals.HomingUnsupported(command.axis)
        refusal = self._motion_refusal(_AUTOMATIC)
        if refusal is None and arm.mode is not DriveMode.CSP:
            refusal = refusals.NotInCsp()
        if refusal is None:
            self._machine.change(command, lease)
        return refusal

    def _halt(self, command: commands.Halt, lease: int) -> refusals.Refusal | None:
        self._joints.stop_others()
        for process in self._processes:
            self._context.make_part_safe(process)
        if self._machine.state is State.HOMING and not self._context.homing.ended:
            self._context.homing.stop()
        else:
            if self._machine.state is State.HOLDING:
                # Ends a program that waits.
                self._blackboard.event(events.HaltedAtRest())
            self._machine.change(command)
        return None

    # -- torque ---------------------------------------------------------------------------------------------------

    def _enable(self, command: commands.Enable, lease: int) -> refusals.Refusal | None:
        joints = self._joints
        if self._operator.emergency_stop:
            return refusals.EmergencyStopPressed()
        if not self._operator.permitted:
            return refusals.NotPermitted()
        if (refused := self._refused_by_partner()) is not None:
            return refused
        axis = joints.first_blocked()
        if axis >= 0:
            return refusals.DriveNotReady(axis, joints.drives[axis].missing)
        if not self._context.service.all_op:
            return refusals.NotInOp()
        if not self._context.clock_locked:
            return refusals.ClockNotLocked()
        axis = joints.first_moving()
        if axis >= 0:
            return refusals.NotAtStandstill(axis, joints.drives[axis].velocity)
        axis = joints.first_outside()
        if axis >= 0:
            return refusals.JointOutsideRange(axis, joints.drives[axis].position)
        if (refusal := self._too_heavy_for(self._arm.wanted_mode)) is not None:
            return refusal
        self._machine.change(command, lease)
        return None

    def _disable(self, command: commands.Disable, lease: int) -> refusals.Refusal | None:
        # The emergency stop removes the torque by itself. The answer is immediate: the commander checks the drives.
        if self._machine.state not in (State.READY, State.DISABLING, State.EMERGENCY_STOP):
            self._machine.change(command)
        return None

    def _reset(self, command: commands.Reset, lease: int) -> refusals.Refusal | None:
        in_fault = self._machine.state is not State.STOPPED_BY_LIMIT
        if in_fault and self._operator.emergency_stop and self._context.lost == 0:
            return refusals.EmergencyStopPressed()
        self._machine.change(command)
        return None

    def _refused_by_partner(self) -> refusals.Refusal | None:
        partners = self._machine.partners
        if partners is None:
            return None
        if partners.stopped >= 0:
            return refusals.PartnerStopPressed(partners.stopped)
        if partners.unread >= 0:
            return refusals.PartnerStopUnread(partners.unread)
        return refusals.PartnerOfAnotherCell(partners.group.foreign) if partners.group.foreign >= 0 else None

    def _shut_down(self, command: commands.Shutdown, lease: int) -> refusals.Refusal | None:
        self._machine.close()
        return None

    # -- modes, limits, outputs -----------------------------------------------------------------------------------

    def _set_drive_mode(self, command: commands.SetDriveMode, lease: int) -> refusals.Refusal | None:
        arm = self._arm
        if arm.control_mode in _FIXED_DRIVE_MODE:
            return refusals.DriveModeFixed(arm.control_mode, command.mode)
        if (axis := arm.first_without(command.mode)) >= 0:
            return refusals.DriveModeUnsupported(axis, command.mode)
        if (refusal := self._too_heavy_for(command.mode)) is not None:
            return refusal
        arm.configured_mode = command.mode
        self._machine.change_drive_mode(command.mode)
        return None

    def _set_control_mode(self, command: commands.SetControlMode, lease: int) -> refusals.Refusal | None:
        arm, mode = self._arm, command.mode
        if mode in (ControlMode.CARTESIAN, ControlMode.JOYSTICK) and arm.jog is None:
            return refusals.NoGeometry()
        drive_mode = arm.drive_mode_of(mode)
        if (axis := arm.first_without(drive_mode)) >= 0:
            return refusals.DriveModeUnsupported(axis, drive_mode)
        if (refusal := self._too_heavy_for(drive_mode)) is not None:
            return refusal
        arm.control_mode = mode
        arm.rest()
        self._operator.begin_joystick(self._blackboard)
        self._blackboard.event(events.ControlModeChanged(mode))
        if drive_mode is not arm.mode or self._machine.state is not State.HOLDING:
            self._machine.change_drive_mode(drive_mode)
        return None

    def _too_heavy_for(self, mode: DriveMode) -> refusals.Refusal | None:
        """Return the refusal of CST where a torque limit is below what holds the arm now, or None: it would sag.

        Without torque it is the weight that the arm's model knows; what the drives then carry is checked in ENABLING.
        """
        if mode is not DriveMode.CST:
            return None
        arm, holds = self._arm, self._machine.state is State.HOLDING
        torques = arm.held_torques() if holds else arm.gravity.torques(arm.state.actual)
        axis = arm.first_beyond_torque_limit(torques)
        return refusals.TorqueLimitTooLow(axis, abs(torques[axis]), arm.limits.torque[axis]) if axis >= 0 else None

    def _set_limits(self, command: commands.SetLimits, lease: int) -> refusals.Refusal | None:
        arm = self._arm
        if command.slot not in range(PLANS) or command.rows not in range(1, MOST_LIMIT_ROWS + 1):
            return refusals.WrongRowCount(command.rows, MOST_LIMIT_ROWS)
        new = read(self._blackboard.plan(command.slot), command.rows)
        if new is None:
            return refusals.WrongRowCount(command.rows, MOST_LIMIT_ROWS)
        if arm.group.under_way:
            return refusals.LimitsInStep()
        axis = self._joints.first_moving() if self._machine.state in _STOPPED_BY_DRIVES else -1
        if axis >= 0:
            # A drive without a ramp of its own stops under the limits.
            return refusals.NotAtStandstill(axis, self._joints.drives[axis].velocity)
        if command.widen and self._joints.first_with_torque() >= 0:
            # The speed limit of a drive is fixed while it is enabled.
            return refusals.TorquePresent()
        refusal = arm.trajectory_guard.refusal_of(arm.state, new, widen=command.widen)
        if refusal is not None:
            return refusal
        limits = arm.limits
        if self._joints.first_with_torque() >= 0:
            for axis, torque in enumerate(arm.state.actual_torque):
                most, held = new.torque[axis], abs(torque)
                if most < limits.torque[axis] and held > most:
                    return refusals.TorqueLimitTooLow(axis, held, most)
            exceeded = arm.supervision.first_exceeded(arm.samples, new)
            if exceeded is not None:
                return exceeded
        arm.set_limits(new)
        self._blackboard.event(events.LimitsChanged())
        return None

    def _set_speed_override(self, command: commands.SetSpeedOverride, lease: int) -> refusals.Refusal | None:
        override, wanted = self._arm.speed_override, command.fraction
        if not LOWEST <= wanted <= 1.0:
            return refusals.SpeedOverrideOutOfRange(wanted, LOWEST)
        context = self._context
        if wanted > override.chosen and not (lease and context.lease_held(lease)):
            return refusals.NoLease()
        if wanted > override.chosen and context.state is State.MOVING and context.lease != lease:
            # The joystick has no lease.
            return refusals.MovedByAnother()
        if wanted != override.chosen:
            override.choose(wanted)
            self._blackboard.event(events.SpeedOverrideChanged(wanted))
        return None

    def _pause(self, command: commands.Pause, lease: int) -> refusals.Refusal | None:
        arm = self._arm
        if not arm.active.pausable or arm.active.phase is not Phase.MOVE:
            return refusals.NotPausable()
        if not arm.speed_override.paused:
            arm.speed_override.pause()
            self._blackboard.event(events.Paused())
        return None

    def _resume(self, command: commands.Resume, lease: int) -> refusals.Refusal | None:
        if not self._arm.speed_override.paused:
            return refusals.NotPaused()
        self._arm.speed_override.resume()
        self._blackboard.event(events.Resumed())
        return None

    def _set_tool(self, command: commands.SetTool, lease: int) -> refusals.Refusal | None:
        arm, tool = self._arm, command.tool
        if not arm.at_rest:
            return refusals.WrongState(command.number, State.MOVING)
        if not 0 <= tool < len(self._context.config.tool_names):
            return refusals.UnknownTool(tool, len(self._context.config.tool_names) - 1)
        if tool == arm.tool.number:
            return None
        if (box := arm.trajectory_guard.zone_with(tool, arm.state.commanded)) is not None:
            return refusals.ToolInBox(tool, box)
        arm.use_tool(tool)
        self._blackboard.event(events.ToolChanged(tool))
        return None

    def _set_payload(self, command: commands.SetPayload, lease: int) -> refusals.Refusal | None:
        arm, mass, centre = self._arm, command.mass, (command.x, command.y, command.z)
        if not arm.at_rest:
            return refusals.WrongState(command.number, State.MOVING)
        if not arm.gravity.is_known:
            return refusals.MassesUnknown()
        most, away = self._context.config.payload.max_mass, hypot(*centre)
        if not 0.0 <= mass <= most:
            return refusals.PayloadTooHeavy(mass, most)
        if not away <= _FARTHEST_PAYLOAD_M:
            return refusals.PayloadTooFar(away, _FARTHEST_PAYLOAD_M)
        arm.carry(LinkMass(mass, centre))
        self._blackboard.event(events.PayloadChanged(mass))
        return None

    def _set_output(self, command: commands.SetOutput, lease: int) -> refusals.Refusal | None:
        boxes, output = self._context.boxes, command.output
        if not boxes:
            return refusals.NoOutputs()
        _, box = boxes[command.box] if 0 <= command.box < len(boxes) else (0, None)
        if box is None:
            return refusals.UnknownBox(command.box + 1, len(boxes))
        if not 1 <= output <= box.output_count:
            return refusals.UnknownOutput(output, box.output_count)
        if (box.name, output) in self._operator.reserved:
            return refusals.ReservedOutput(output)
        box.set_output(output, command.value)
        return None

    def _set_channel(self, command: commands.SetChannel, lease: int) -> refusals.Refusal | None:
        config, position, number = self._context.config, command.slave, command.channel
        slave = config.slaves[position - 1] if 1 <= position <= len(config.slaves) else None
        outputs = slave.device.outputs if slave is not None and slave.device.has_channels else ()
        output = outputs[number] if 0 <= number < len(outputs) else None
        if slave is None or output is None or (slave.name, output.name) in self._process_outputs:
            return refusals.ChannelNotSettable(position, number)
        low, high = output.range
        if not low <= command.value <= high:
            return refusals.ChannelOutOfRange(position, number, command.value, low, high)
        device = next(part for part in self._context.parts if isinstance(part, Device) and part.slot + 1 == position)
        return device.set_channel(output.name, command.value)

    def _not_permitted(self) -> refusals.Refusal | None:
        """Return why nothing beside the arm may begin to move, or None."""
        if self._operator.emergency_stop:
            return refusals.EmergencyStopPressed()
        if (refused := self._refused_by_partner()) is not None:
            return refused
        if self._context.pending is not None:
            return refusals.FaultFollows()
        return None if self._operator.permitted else refusals.NotPermitted()

    def _external_axis(self, number: int) -> ExternalAxisGroup | None:
        return next((axis for axis in self._context.axes if axis.first == number), None)

    def _move_axis(
        self, command: commands.MoveAxis | commands.RunAxis | commands.HomeAxis, lease: int
    ) -> refusals.Refusal | None:
        axis = self._external_axis(command.axis)
        if axis is None:
            return refusals.UnknownExternalAxis(command.axis)
        if (refusal := self._not_permitted()) is not None:
            return refusal
        if isinstance(command, commands.MoveAxis):
            return axis.move(command.position, command.speed, lease)
        return (
            axis.home(command.home_offset, lease)
            if isinstance(command, commands.HomeAxis)
            else axis.run(command.velocity, command.hold_s, lease)
        )

    def _stop_axis(self, command: commands.StopAxis, lease: int) -> refusals.Refusal | None:
        axis = self._external_axis(command.axis)
        if axis is None:
            return refusals.UnknownExternalAxis(command.axis)
        axis.stop()
        return None

    def _move_gripper(self, command: commands.MoveGripper, lease: int) -> refusals.Refusal | None:
        if (refusal := self._not_permitted()) is not None:
            return refusal
        gripper = self._context.gripper
        if gripper is not None:
            if not gripper.grip(not command.open, lease):
                return refusals.GripperDisabled()
        elif self._operator.has_gripper:
            self._operator.grip(not command.open)
        else:
            return refusals.NoGripper()
        self._blackboard.event(events.GripperOpens() if command.open else events.GripperCloses())
        return None

    def _set_zero(self, command: commands.SetZero, lease: int) -> refusals.Refusal | None:
        arm, drives, axis = self._arm, self._joints.drives, command.axis
        if not 0 <= axis < len(drives):
            return refusals.UnknownAxis(axis, len(drives) - 1)
        if not abs(command.offset) <= _LARGEST_OFFSET:
            return refusals.OffsetOutOfRange(axis, command.offset, _LARGEST_OFFSET)
        if self._joints.first_with_torque() >= 0:
            return refusals.TorquePresent()
        drive = drives[axis]
        drive.zero = command.offset
        if axis < len(arm.drives):
            # Already decoded in this cycle: make its record use the new zero, as its targets do.
            arm.state.actual[axis] = drive.position
        self._blackboard.event(events.ZeroSet(axis, command.offset, drive.position))
        return None
