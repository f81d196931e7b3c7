"""The joints as one: their drives, the active controller and its guards, the writer of the drive mode, the limiter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rtcp.config.model import ArmConfig
from rtcp.control.gripper import TRACKED_RAD, DrivenGripper
from rtcp.control.part import Part
from rtcp.devices.cia402 import Cia402Drive, DriveState, TargetState
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.commands import Command, Jog, MoveJoints
from rtcp.ipc.events import EmergencyStop
from rtcp.ipc.schema import ARM_MODES, arm_fields
from rtcp.ipc.states import ControlMode, DriveMode
from rtcp.motion.controllers.controller import Controller, ControllerSetup, load_controllers
from rtcp.motion.controllers.jog import JogController
from rtcp.motion.drive_writers import CspWriter, CstWriter, CsvWriter, DriveWriter
from rtcp.motion.guards.output_limiter import OutputLimiter
from rtcp.motion.guards.supervision import Supervision
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Phase

WITH_TORQUE = frozenset({DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE})
RESTING = frozenset({DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON})
"""Drive states without torque and without a fault."""
_ENABLED = DriveState.OPERATION_ENABLED
_HOLDING = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
"""Drive states with torque: the target stands."""
_STILL_RAD_S = 0.01
RANGE_MARGIN_RAD = 0.02
"""So far outside its range a joint may stand and still be enabled, to return to the edge: an overshoot in CST must not
leave an arm that no command can move."""


class Arm(Part):
    """What a cycle does with the joints. Its setpoints move on where the machine commands it, in `command`.

    Args:
        config: joints, limits, cycle, the mode at the start.
        drives: one a joint, in the order of the joints, with the index of its slave.
        gripper: one with a drive of its own, or None. Its drive is the last of all drives, after those of the joints.
        plan: returns a slot of the plan area, for controllers that run plans.
    """

    def __init__(
        self,
        config: ArmConfig,
        drives: Sequence[tuple[int, Cia402Drive]],
        gripper: DrivenGripper | None,
        plan: Callable[[int], memoryview[float]],
    ) -> None:
        joints = config.joints
        super().__init__("arm", arm_fields(len(joints)))
        self.period_s = config.cycle.period_us * 1e-6
        self.drives = [drive for _, drive in drives]
        self.pairs = list(drives)
        self.gripper = gripper
        self.all_drives = self.drives if gripper is None else [*self.drives, gripper.drive]
        self.state = ArmState(len(joints))
        self.limits = Limits(config)
        self.trajectory_guard = TrajectoryGuard(config, self.limits, self.period_s)
        self.output_limiter = OutputLimiter(self.limits, self.period_s)
        self.controllers: dict[type[Command], Controller] = load_controllers(
            ControllerSetup(config, self.limits, self.trajectory_guard, self.period_s, plan)
        )
        """By the commands that they accept."""
        self._holder = self.controllers[MoveJoints]
        jog = self.controllers.get(Jog)
        self.jog = jog if isinstance(jog, JogController) and jog.has_geometry else None
        """The controller that the joystick commands; None where the geometry is unknown."""
        self.active = self._holder
        self.control_mode = ControlMode[config.control_mode.upper()]
        self.configured_mode = DriveMode[config.drive_mode.upper()]
        """Drive mode of moves, lines, streams and jogs."""
        self._cst = CstWriter(joints, self.period_s)
        self._writers: dict[DriveMode, DriveWriter] = {
            DriveMode.CSP: CspWriter(),
            DriveMode.CSV: CsvWriter(joints, self.period_s),
            DriveMode.CST: self._cst,
        }
        self.wanted_mode = self.drive_mode_of(self.control_mode)
        """Drive mode to hold in; drives are enabled in CSP and change then."""
        self.set_mode(self.wanted_mode)

    def drive_mode_of(self, mode: ControlMode) -> DriveMode:
        """Return the drive mode that a control mode needs."""
        if mode is ControlMode.VELOCITY:
            return DriveMode.CSV
        return DriveMode.CST if mode is ControlMode.TORQUE else self.configured_mode

    def set_mode(self, mode: DriveMode) -> None:
        """Command the drives to change to `mode`; only at standstill."""
        self.mode = mode
        self._writer = self._writers[mode]
        self._writer.start(self.drives)
        for drive in self.drives:
            drive.mode = mode

    def decode(self, data: ProcessData) -> None:
        """Read the inputs of the drives."""
        state = self.state
        actual, speed, torque = state.actual, state.actual_velocity, state.actual_torque
        read = data.input
        for axis, (slot, drive) in enumerate(self.pairs):
            drive.decode(read(slot))
            actual[axis] = drive.position
            speed[axis] = drive.velocity
            torque[axis] = drive.torque

    def encode(self, data: ProcessData) -> None:
        """Write the outputs of the drives."""
        for slot, drive in self.pairs:
            data.set_output(slot, drive.encode())

    def publish(self, values: list[Any]) -> None:
        """Write modes, progress and what the joints measure and are sent."""
        state, controller, at = self.state, self.active, self.at
        values[at : at + len(ARM_MODES)] = (
            self.mode,
            self.control_mode,
            self.output_limiter.held | self.trajectory_guard.held | controller.held,
            controller.elapsed_s,
            controller.duration_s,
        )
        n, at = len(self.drives), at + len(ARM_MODES)
        values[at : at + 4 * n] = (*state.actual, *state.actual_velocity, *state.actual_torque, *state.commanded)
        at += 4 * n
        end = at + 4 * n
        for drive in self.drives:
            sent = drive.target_position, drive.target_velocity, drive.target_torque, drive.statusword
            values[at:end:n] = sent
            at += 1

    def advance(self, target: TargetState) -> None:
        """Command every drive one step towards `target`."""
        for drive in self.all_drives:
            drive.advance(target)

    def limits_changed(self) -> None:
        """Limit the outputs by the limits in force."""
        self.output_limiter.take(self.limits)

    def stop(self) -> None:
        """Bring all that moves to rest, the gripper too."""
        if self.active.phase is Phase.MOVE:
            self.active.stop(self.state)
        if self.gripper is not None:
            self.gripper.stop()

    def rest(self) -> None:
        """Hold where the setpoints are; at standstill."""
        for controller in self.controllers.values():
            controller.hold()
        self.active = self._holder

    def hold(self) -> None:
        """Hold at the last setpoint, at rest from now on."""
        self.rest()
        self.trajectory_guard.latch(self.state)

    def track_actual(self) -> None:
        """Let setpoints and targets follow the drives that have no torque.

        The setpoint of a joint outside its range is the edge of it, so that every controller begins inside; from where
        the joint is to there the output limiter moves its target, once the drive follows it.
        """
        commanded, latch, limits = self.state.commanded, self.output_limiter.latch, self.limits
        for i, drive in enumerate(self.drives):
            if drive.state not in _HOLDING:
                low, high, here = limits.low[i], limits.high[i], drive.position
                commanded[i] = high if here > high else low if here < low else here
                drive.target_position = here
                latch(i, here)
        self.trajectory_guard.latch(self.state)
        if self.gripper is not None:
            self.gripper.track_actual()

    def command(self) -> GuardResult:
        """Write the targets of this cycle: controller -> guard -> writer of the drive mode -> limiter."""
        state, drives, controller = self.state, self.drives, self.active
        setpoint = controller.update(state)
        result = self.trajectory_guard.apply(state, setpoint, controller.tolerates_saturation)
        if setpoint.direct:
            self._cst.pass_on(state.commanded, setpoint.torque, drives)
        else:
            self._writer.update(state.commanded, state.commanded_velocity, drives)
        self.output_limiter.check(drives)
        if self.gripper is not None:
            self.gripper.command()
        return result

    def beyond_limits(self, supervision: Supervision) -> EmergencyStop | None:
        """Return what was measured of joints or gripper beyond its limit for too long, or None."""
        event = supervision.check(self.state)
        if event is None and self.gripper is not None:
            return self.gripper.beyond_limits()
        return event

    def first_not_enabled(self) -> int:
        """Return the first joint whose drive is not enabled, or -1."""
        for axis, drive in enumerate(self.all_drives):
            if drive.state is not _ENABLED:
                return axis
        return -1

    def first_with_torque(self) -> int:
        """Return the first joint whose drive gives torque: enabled, in a quick stop or reacting to a fault; or -1."""
        for axis, drive in enumerate(self.all_drives):
            if drive.state in WITH_TORQUE:
                return axis
        return -1

    def first_in_another_mode(self) -> int:
        """Return the first joint whose drive does not show the commanded mode, or -1."""
        mode = self.mode
        for axis, drive in enumerate(self.drives):
            if drive.mode_display != mode:
                return axis
        return -1

    def first_in_fault(self) -> int:
        """Return the first joint whose drive is in fault, or -1."""
        for axis, drive in enumerate(self.all_drives):
            if drive.state is DriveState.FAULT:
                return axis
        return -1

    def first_moving(self) -> int:
        """Return the first joint that does not stand still, or -1."""
        for axis, drive in enumerate(self.all_drives):
            if abs(drive.velocity) > _STILL_RAD_S:
                return axis
        return -1

    def first_without(self, mode: DriveMode) -> int:
        """Return the first joint whose drive does not map what `mode` needs, or -1."""
        return next((axis for axis, drive in enumerate(self.drives) if not drive.supports(mode)), -1)

    def first_outside(self) -> int:
        """Return the first joint that stands outside its range, or -1."""
        low, high = self.limits.low, self.limits.high
        for axis, drive in enumerate(self.drives):
            if not low[axis] - RANGE_MARGIN_RAD <= drive.position <= high[axis] + RANGE_MARGIN_RAD:
                return axis
        return len(self.drives) if self.gripper is not None and self.gripper.outside else -1

    def first_off_target(self) -> int:
        """Return the first joint that `track_actual` would move further than it can have turned, or -1."""
        tracked = self.output_limiter.sent
        for axis, drive in enumerate(self.drives):
            if drive.state not in _HOLDING and not abs(drive.position - tracked[axis]) <= TRACKED_RAD:
                return axis
        return len(self.drives) if self.gripper is not None and self.gripper.off_target else -1

    def tracked_to(self, axis: int) -> float:
        """Return where the drive of a joint, or of the gripper, was followed to, rad."""
        if axis < len(self.drives) or self.gripper is None:
            return self.output_limiter.sent[axis]
        return self.gripper.motion.position

    def beyond_range(self, axis: int) -> float:
        """Return how far beyond its range the target of a joint is, rad, or 0."""
        last, limits = self.output_limiter.sent[axis], self.limits
        return max(last - limits.high[axis], limits.low[axis] - last, 0.0)

    def first_returning(self) -> int:
        """Return the first joint whose target still returns to its range, or -1."""
        for axis in range(len(self.drives)):
            if self.beyond_range(axis) > 0.0:
                return axis
        return -1

    def first_not_resting(self) -> int:
        """Return the first joint whose drive is in fault or enabled, or -1."""
        for axis, drive in enumerate(self.all_drives):
            if drive.state not in RESTING:
                return axis
        return -1

    @property
    def still(self) -> bool:
        """Whether the setpoints stand still."""
        return self.active.phase is Phase.HOLD

    @property
    def all_still(self) -> bool:
        """Whether the gripper's setpoint stands still too, and no guard brakes: the torque may go."""
        gripper = self.gripper
        return self.still and not self.trajectory_guard.stopping and (gripper is None or not gripper.motion.moving)
