"""Commands as the loop accepts them: checked against lease, state and limits, then carried out or refused.

A motion command goes to the controller that names it (`rtcp.motion.controllers`). For any other command there is a
method here, found by the command's class.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from math import hypot
from typing import Any, Final

from kinematics.model import LinkMass
from rtcp.config.model import ConfigError
from rtcp.control.machine import StateMachine
from rtcp.control.part import Device
from rtcp.control.processes import ProcessPart
from rtcp.devices.cia402 import Cia402Drive
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import (
    Command,
    Disable,
    Enable,
    ExtendTrajectory,
    Halt,
    Home,
    MotionCommand,
    MoveGripper,
    OpenStream,
    Pause,
    Reset,
    Resume,
    RunInStep,
    RunLines,
    RunTrajectory,
    SetChannel,
    SetControlMode,
    SetDriveMode,
    SetLimits,
    SetOutput,
    SetPayload,
    SetSpeedOverride,
    SetTool,
    SetZero,
    Shutdown,
)
from rtcp.ipc.events import (
    ControlModeChanged,
    GripperCloses,
    GripperOpens,
    HaltedAtRest,
    LimitsChanged,
    Paused,
    PayloadChanged,
    Resumed,
    SpeedOverrideChanged,
    ToolChanged,
    ZeroSet,
)
from rtcp.ipc.layout import PLANS
from rtcp.ipc.refusals import (
    ChannelNotSettable,
    ChannelOutOfRange,
    ClockNotLocked,
    DriveModeChanging,
    DriveModeFixed,
    DriveModeUnsupported,
    DriveNotReady,
    EmergencyStopPressed,
    GripperDisabled,
    HomingUnsupported,
    JointOutsideRange,
    Malformed,
    MassesUnknown,
    MotionPaused,
    MovedByAnother,
    NoArm,
    NoGeometry,
    NoGripper,
    NoLease,
    NoOutputs,
    NotAtStandstill,
    NotInCsp,
    NotInOp,
    NotPausable,
    NotPaused,
    NotPermitted,
    OffsetOutOfRange,
    PartnerOfAnotherCell,
    PartnerStopPressed,
    PayloadTooFar,
    PayloadTooHeavy,
    PlannedForAnotherTool,
    Refusal,
    ReservedOutput,
    SpeedOverrideOutOfRange,
    ToolInBox,
    TorqueLimitTooLow,
    TorquePresent,
    UnknownAxis,
    UnknownBox,
    UnknownOutput,
    UnknownTool,
    WrongControlMode,
    WrongRowCount,
    WrongState,
)
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.motion.controllers.stream import StreamController
from rtcp.motion.limits import read
from rtcp.motion.speed_override import LOWEST
from rtcp.motion.state import Phase

MOST_LIMIT_ROWS: Final = 64
"""`MOST_AXES` joints and more boxes than an arm is configured with: all are checked in one cycle."""
_LARGEST_OFFSET: Final = 100.0
_FARTHEST_PAYLOAD_M: Final = 1.0
_FIXED_DRIVE_MODE = frozenset({ControlMode.VELOCITY, ControlMode.TORQUE})
_PLANNED = (RunTrajectory, RunInStep, RunLines)
_AUTOMATIC = frozenset({ControlMode.JOINT, ControlMode.CARTESIAN})


_MOST_SETPOINTS: Final = 8
"""Taken in one cycle: a sender that is faster than the loop must not keep it."""


class CommandHandler:
    """Takes at most one command a cycle.

    Args:
        machine: the state machine; a command that a part names goes to that part.
        blackboard: where commands come from and answers go.
    """

    def __init__(self, machine: StateMachine, blackboard: Blackboard) -> None:
        self._machine = machine
        self._context = machine.context
        self._arm = machine.context.arm
        self._joints = machine.context.joints
        self._operator = machine.context.operator
        self._blackboard = blackboard
        self._handlers: dict[type[Command], Callable[[Any, int], Refusal | None]] = {
            Enable: self._enable,
            Disable: self._disable,
            Reset: self._reset,
            SetDriveMode: self._set_drive_mode,
            SetControlMode: self._set_control_mode,
            Halt: self._halt,
            SetOutput: self._set_output,
            SetChannel: self._set_channel,
            MoveGripper: self._move_gripper,
            SetLimits: self._set_limits,
            SetSpeedOverride: self._set_speed_override,
            Pause: self._pause,
            Resume: self._resume,
            SetTool: self._set_tool,
            SetPayload: self._set_payload,
            SetZero: self._set_zero,
            Home: self._home,
            Shutdown: self._shut_down,
        }
        stream = self._arm.controllers[OpenStream]
        assert isinstance(stream, StreamController)
        self._stream = stream
        self._process_outputs = machine.context.config.process_outputs
        self._processes = [part for part in machine.context.parts if isinstance(part, ProcessPart)]
        for part in machine.context.parts:
            for kind in part.commands:
                if kind in self._handlers or issubclass(kind, MotionCommand):
                    raise ConfigError([f"{part.name}: the command {kind.name} is already taken by another part"])
                self._handlers[kind] = part.accept

    def handle(self) -> None:
        """Carry out the next command and answer it; called only when one waits."""
        number, lease, command = self._blackboard.take_command()
        refusal = self._refusal(command, lease)
        try:
            self._blackboard.answer(number, refusal)
        except struct.error:
            # A field of the command is so large that the refusal, which counts on from it, cannot hold it.
            self._blackboard.answer(number, Malformed(command.number))

    def take_setpoints(self) -> None:
        """Follow the setpoints that wait, some a cycle; those of a stream that is not open any more are dropped."""
        board, stream, state = self._blackboard, self._stream, self._arm.state
        for _ in range(_MOST_SETPOINTS):
            if not board.setpoint_waits():
                break
            number, bits, stamp_s, numbers = board.take_setpoint()
            if number == self.open_stream != 0:
                stream.put(state, bits, stamp_s, numbers)

    @property
    def open_stream(self) -> int:
        """Number of the stream whose setpoints are followed; 0: none."""
        moves = self._stream.stream and self._arm.active is self._stream and self._machine.state is State.MOVING
        return self._stream.stream if moves else 0

    def _refusal(self, command: Command | Malformed, lease: int) -> Refusal | None:
        """Carry out a command, or return why not."""
        if isinstance(command, Malformed):
            return command
        if command.needs_lease and not (lease and self._context.lease_held(lease)):
            return NoLease()
        state = self._machine.state
        if state not in command.states:
            return WrongState(command.number, state)
        if command.waits_for_drive_mode and self._machine.changing_mode:
            return DriveModeChanging()
        if isinstance(command, MotionCommand):
            return self._move(command, lease)
        handler = self._handlers.get(type(command))
        return handler(command, lease) if handler is not None else Malformed(command.number)

    # -- motion ---------------------------------------------------------------------------------------------------

    def _motion_refusal(self, modes: frozenset[ControlMode]) -> Refusal | None:
        """Return why no motion of these control modes may begin now."""
        active = self._arm.control_mode
        if active not in modes:
            return WrongControlMode(active, min(modes))
        partners = self._machine.partners
        if partners is not None and partners.group.foreign >= 0:
            return PartnerOfAnotherCell(partners.group.foreign)
        return None if self._operator.permitted else NotPermitted()

    def _move(self, command: MotionCommand, lease: int) -> Refusal | None:
        arm, machine = self._arm, self._machine
        controller = arm.controllers.get(type(command))
        if not self._joints.drives:
            return NoArm()
        if controller is None:
            return NoGeometry()
        refusal = self._motion_refusal(controller.control_modes)
        if refusal is not None:
            return refusal
        if arm.group.under_way:
            # Nothing takes the place of a motion in step: its partners would go on.
            return WrongState(command.number, State.MOVING)
        if arm.speed_override.paused and not isinstance(command, ExtendTrajectory):
            return MotionPaused()
        if isinstance(command, _PLANNED) and command.tool != arm.tool.number:
            return PlannedForAnotherTool(command.tool, arm.tool.number)
        continues = machine.state is State.MOVING and arm.active is controller
        refusal = controller.accept(command, arm.state, continues)
        if refusal is not None:
            return refusal
        if isinstance(command, _PLANNED):
            self._blackboard.use_plan(command.slot)
        elif isinstance(command, OpenStream):
            # Before the answer: whoever opened it may send at once.
            self._blackboard.open_stream(command.stream)
        arm.active = controller
        if not (continues and self._context.lease == lease):
            machine.change(command, lease)
        return None

    def _home(self, command: Home, lease: int) -> Refusal | None:
        arm = self._arm
        if not 0 <= command.axis < len(arm.drives):
            return UnknownAxis(command.axis, len(arm.drives) - 1)
        drive = arm.drives[command.axis]
        if not isinstance(drive, Cia402Drive) or not drive.changes_mode:
            return HomingUnsupported(command.axis)
        refusal = self._motion_refusal(_AUTOMATIC)
        if refusal is None and arm.mode is not DriveMode.CSP:
            refusal = NotInCsp()
        if refusal is None:
            self._machine.change(command, lease)
        return refusal

    def _halt(self, command: Halt, lease: int) -> Refusal | None:
        self._joints.stop_others()
        for process in self._processes:
            process.safe()
        if self._machine.state is State.HOMING:
            self._context.homing.stop()
        else:
            if self._machine.state is State.HOLDING:
                # A program that waits ends by it.
                self._blackboard.event(HaltedAtRest())
            self._machine.change(command)
        return None

    # -- torque ---------------------------------------------------------------------------------------------------

    def _enable(self, command: Enable, lease: int) -> Refusal | None:
        joints = self._joints
        if self._operator.emergency_stop:
            return EmergencyStopPressed()
        if (refused := self._refused_by_partner()) is not None:
            return refused
        axis = joints.first_blocked()
        if axis >= 0:
            return DriveNotReady(axis, joints.drives[axis].missing)
        if not self._context.service.all_op:
            return NotInOp()
        if not self._context.clock_locked:
            return ClockNotLocked()
        axis = joints.first_moving()
        if axis >= 0:
            return NotAtStandstill(axis, joints.drives[axis].velocity)
        axis = joints.first_outside()
        if axis >= 0:
            return JointOutsideRange(axis, joints.drives[axis].position)
        self._machine.change(command)
        return None

    def _disable(self, command: Disable, lease: int) -> Refusal | None:
        # The emergency stop removes the torque by itself. Accepted is not done: the commander looks at the drives.
        if self._machine.state not in (State.READY, State.DISABLING, State.EMERGENCY_STOP):
            self._machine.change(command)
        return None

    def _reset(self, command: Reset, lease: int) -> Refusal | None:
        in_fault = self._machine.state is not State.STOPPED_BY_LIMIT
        if in_fault and self._operator.emergency_stop and self._context.lost == 0:
            return EmergencyStopPressed()
        self._machine.change(command)
        return None

    def _refused_by_partner(self) -> Refusal | None:
        partners = self._machine.partners
        if partners is None:
            return None
        if partners.stopped >= 0:
            return PartnerStopPressed(partners.stopped)
        return PartnerOfAnotherCell(partners.group.foreign) if partners.group.foreign >= 0 else None

    def _shut_down(self, command: Shutdown, lease: int) -> Refusal | None:
        self._machine.close()
        return None

    # -- modes, limits, outputs -----------------------------------------------------------------------------------

    def _set_drive_mode(self, command: SetDriveMode, lease: int) -> Refusal | None:
        arm = self._arm
        if arm.control_mode in _FIXED_DRIVE_MODE:
            return DriveModeFixed(arm.control_mode, command.mode)
        if (axis := arm.first_without(command.mode)) >= 0:
            return DriveModeUnsupported(axis, command.mode)
        arm.configured_mode = command.mode
        self._machine.change_drive_mode(command.mode)
        return None

    def _set_control_mode(self, command: SetControlMode, lease: int) -> Refusal | None:
        arm, mode = self._arm, command.mode
        if mode in (ControlMode.CARTESIAN, ControlMode.JOYSTICK) and arm.jog is None:
            return NoGeometry()
        drive_mode = arm.drive_mode_of(mode)
        if (axis := arm.first_without(drive_mode)) >= 0:
            return DriveModeUnsupported(axis, drive_mode)
        arm.control_mode = mode
        arm.rest()
        self._operator.require_neutral()
        self._blackboard.event(ControlModeChanged(mode))
        if drive_mode is not arm.mode or self._machine.state is not State.HOLDING:
            self._machine.change_drive_mode(drive_mode)
        else:
            arm.set_mode(drive_mode)
        return None

    def _set_limits(self, command: SetLimits, lease: int) -> Refusal | None:
        arm = self._arm
        if command.slot not in range(PLANS) or command.rows not in range(1, MOST_LIMIT_ROWS + 1):
            return WrongRowCount(command.rows, MOST_LIMIT_ROWS)
        new = read(self._blackboard.plan(command.slot), command.rows)
        if new is None:
            return WrongRowCount(command.rows, MOST_LIMIT_ROWS)
        refusal = arm.trajectory_guard.refusal_of(arm.state, new)
        if refusal is not None:
            return refusal
        limits = arm.limits
        if self._joints.first_with_torque() >= 0:
            for axis, held in enumerate(arm.state.actual_torque):
                most = new.torque[axis]
                if most < limits.torque[axis] and abs(held) > most:
                    return TorqueLimitTooLow(axis, abs(held), most)
        arm.set_limits(new)
        self._blackboard.event(LimitsChanged())
        return None

    def _set_speed_override(self, command: SetSpeedOverride, lease: int) -> Refusal | None:
        override, wanted = self._arm.speed_override, command.fraction
        if not LOWEST <= wanted <= 1.0:
            return SpeedOverrideOutOfRange(wanted, LOWEST)
        context = self._context
        if wanted > override.chosen and not (lease and context.lease_held(lease)):
            return NoLease()
        if wanted > override.chosen and context.state is State.MOVING and context.lease != lease:
            # The joystick, which holds no lease.
            return MovedByAnother()
        if wanted != override.chosen:
            override.choose(wanted)
            self._blackboard.event(SpeedOverrideChanged(wanted))
        return None

    def _pause(self, command: Pause, lease: int) -> Refusal | None:
        arm = self._arm
        if not arm.active.pausable or arm.active.phase is not Phase.MOVE:
            return NotPausable()
        if not arm.speed_override.paused:
            arm.speed_override.pause()
            self._blackboard.event(Paused())
        return None

    def _resume(self, command: Resume, lease: int) -> Refusal | None:
        if not self._arm.speed_override.paused:
            return NotPaused()
        self._arm.speed_override.resume()
        self._blackboard.event(Resumed())
        return None

    def _set_tool(self, command: SetTool, lease: int) -> Refusal | None:
        arm, tool = self._arm, command.tool
        if not arm.at_rest:
            return WrongState(command.number, State.MOVING)
        if not 0 <= tool < len(self._context.config.tool_names):
            return UnknownTool(tool, len(self._context.config.tool_names) - 1)
        if tool == arm.tool.number:
            return None
        if (box := arm.trajectory_guard.zone_with(tool, arm.state.commanded)) is not None:
            return ToolInBox(tool, box)
        arm.use_tool(tool)
        self._blackboard.event(ToolChanged(tool))
        return None

    def _set_payload(self, command: SetPayload, lease: int) -> Refusal | None:
        arm, mass, centre = self._arm, command.mass, (command.x, command.y, command.z)
        if not arm.at_rest:
            return WrongState(command.number, State.MOVING)
        if not arm.gravity.is_known:
            return MassesUnknown()
        most, away = self._context.config.payload.max_mass, hypot(*centre)
        if not 0.0 <= mass <= most:
            return PayloadTooHeavy(mass, most)
        if not away <= _FARTHEST_PAYLOAD_M:
            return PayloadTooFar(away, _FARTHEST_PAYLOAD_M)
        arm.carry(LinkMass(mass, centre))
        self._blackboard.event(PayloadChanged(mass))
        return None

    def _set_output(self, command: SetOutput, lease: int) -> Refusal | None:
        boxes, output = self._context.boxes, command.output
        if not boxes:
            return NoOutputs()
        _, box = boxes[command.box] if 0 <= command.box < len(boxes) else (0, None)
        if box is None:
            return UnknownBox(command.box + 1, len(boxes))
        if not 1 <= output <= box.output_count:
            return UnknownOutput(output, box.output_count)
        if (box.name, output) in self._operator.reserved:
            return ReservedOutput(output)
        box.set_output(output, command.value)
        return None

    def _set_channel(self, command: SetChannel, lease: int) -> Refusal | None:
        config, position, number = self._context.config, command.slave, command.channel
        slave = config.slaves[position - 1] if 1 <= position <= len(config.slaves) else None
        outputs = slave.device.outputs if slave is not None and slave.device.has_channels else ()
        output = outputs[number] if 0 <= number < len(outputs) else None
        if slave is None or output is None or (slave.name, output.name) in self._process_outputs:
            return ChannelNotSettable(position, number)
        low, high = output.range
        if not low <= command.value <= high:
            return ChannelOutOfRange(position, number, command.value, low, high)
        device = next(part for part in self._context.parts if isinstance(part, Device) and part.slot + 1 == position)
        return device.set_channel(output.name, command.value)

    def _move_gripper(self, command: MoveGripper, lease: int) -> Refusal | None:
        if self._operator.emergency_stop:
            return EmergencyStopPressed()
        if (refused := self._refused_by_partner()) is not None:
            return refused
        gripper = self._context.gripper
        if gripper is not None:
            if not self._operator.permitted:
                return NotPermitted()
            if not gripper.grip(not command.open, lease):
                return GripperDisabled()
        elif self._operator.has_gripper:
            self._operator.grip(not command.open)
        else:
            return NoGripper()
        self._blackboard.event(GripperOpens() if command.open else GripperCloses())
        return None

    def _set_zero(self, command: SetZero, lease: int) -> Refusal | None:
        arm, drives, axis = self._arm, self._joints.drives, command.axis
        if not 0 <= axis < len(drives):
            return UnknownAxis(axis, len(drives) - 1)
        if not abs(command.offset) <= _LARGEST_OFFSET:
            return OffsetOutOfRange(axis, command.offset, _LARGEST_OFFSET)
        if self._joints.first_with_torque() >= 0:
            return TorquePresent()
        drive = drives[axis]
        drive.zero = command.offset
        if axis < len(arm.drives):
            # It was decoded by now: the record of this cycle counts from the new zero, as its targets do.
            arm.state.actual[axis] = drive.position
        self._blackboard.event(ZeroSet(axis, command.offset, drive.position))
        return None
