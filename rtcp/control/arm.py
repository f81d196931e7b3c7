"""The arm: its joints as a group, with the active controller and its guard, and the writer of the drive mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil, isfinite
from typing import Any, Final

from kinematics.model import LinkMass
from rtcp.config.find import is_foreign, plugin_error
from rtcp.config.model import ArmConfig
from rtcp.control.joint_group import JointGroup
from rtcp.control.part import checked_refusal
from rtcp.devices.drive import Drive
from rtcp.ipc.commands import Command, Jog, MoveJoints
from rtcp.ipc.events import FaultEvent, MotionEnded, PushedNear, PushedNearPartner
from rtcp.ipc.refusals import ControllerRaised, Refusal
from rtcp.ipc.schema import ARM_MODES, LOAD_FIELDS, arm_fields
from rtcp.ipc.states import ControlMode, DriveMode
from rtcp.ipc.stop_reactions import longest_s
from rtcp.motion.controllers.controller import Controller, ControllerSetup, load_controllers
from rtcp.motion.controllers.jog import JogController
from rtcp.motion.drive_writers import CspWriter, CstWriter, CsvWriter, DriveWriter
from rtcp.motion.feed_forward import FeedForward
from rtcp.motion.guards.compliance import (
    PUSH_REACTION_S,
    PUSHED_CLEARANCE,
    TORQUE_MARGIN_M,
    TORQUE_REACTION_S,
    ComplianceGuard,
)
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.guards.zones import reported
from rtcp.motion.speed_override import SpeedOverride
from rtcp.motion.state import Phase, Setpoint
from rtcp.motion.step_group import StepGroup
from rtcp.motion.tool_in_use import Gravity, ToolInUse

_LARGEST_HELD = 0xFFFF_FFFF
_STOP_TIMES: Final = 2.0
"""Time that a controller of another package may take to stop: this many times the longest controlled stop."""
_NOTHING = LinkMass(0.0, (0.0, 0.0, 0.0))


class Arm(JointGroup):
    """The joints of the arm, moved by the active controller.

    Args:
        config: joints, limits, cycle, the control mode at the start.
        drives: the drive of each joint, in the order of the joints, with the index of its slave.
        plan: returns a slot of the plan area, for controllers that run plans.
        group: partners in a cell; None: none.
    """

    def __init__(
        self,
        config: ArmConfig,
        drives: Sequence[tuple[int, Drive]],
        plan: Callable[[int], memoryview[float]],
        group: StepGroup | None = None,
    ) -> None:
        self.group = group or StepGroup()
        """Partners in a cell, and the motion in step."""
        joints = config.joints
        super().__init__("arm", arm_fields(len(joints)), config, drives)
        self.trajectory_guard = TrajectoryGuard(config, self.limits, self.period_s)
        clearance = config.cartesian.clearance
        self._compliance = ComplianceGuard(
            config, self.limits, clearance + TORQUE_MARGIN_M, TORQUE_MARGIN_M, TORQUE_REACTION_S
        )
        self._pushes = ComplianceGuard(config, self.limits, PUSHED_CLEARANCE * clearance, 0.0, PUSH_REACTION_S)
        self.speed_override = SpeedOverride()
        self.tool = ToolInUse()
        self._publishes_load = False
        self._settle_tolerance = config.settle.tolerance
        self.gravity = self.output_limiter.gravity = Gravity(config, self.tool)
        self.controllers: dict[type[Command], Controller] = load_controllers(
            ControllerSetup(
                config,
                self.limits,
                self.trajectory_guard,
                self.period_s,
                plan,
                self.group,
                self.speed_override,
                self.tool,
            )
        )
        """Command class -> controller that accepts it."""
        self.raised: BaseException | None = None
        """Exception of a controller that the machine has not handled."""
        self.raised_by = ""
        """Name of the controller that raised it."""
        self._stop_s = _STOP_TIMES * longest_s(config) if joints else 0.0
        self._configured_rates = [joint.acceleration for joint in joints]
        self._stop_cycles = 0
        """Cycles left for the stop of a controller of another package; 0: none stops."""
        self._progress = (0, 0.0, 0.0)
        """What the active controller publishes: its `held`, `elapsed_s` and `duration_s`."""
        offsets = [drive.offsets for drive in self.drives]
        self.feed_forward = FeedForward(config, self.limits, self.gravity, offsets) if any(offsets) else None
        """Offsets for the drives; None: no drive takes any."""
        self._holder = self.controllers[MoveJoints]
        jog = self.controllers.get(Jog)
        self.jog = jog if isinstance(jog, JogController) and jog.has_geometry else None
        """Controller of the joystick; None where the geometry is unknown."""
        self.active = self._holder
        self.control_mode = ControlMode[config.control_mode.upper()]
        self.configured_mode = DriveMode[config.drive_mode.upper()]
        """Drive mode of moves, lines, streams and jogs."""
        self._csp, self._cst = CspWriter(joints, self.period_s), CstWriter(joints, self.period_s, self.limits.torque)
        self._writers: dict[DriveMode, DriveWriter] = {
            DriveMode.CSP: self._csp,
            DriveMode.CSV: CsvWriter(joints, self.period_s),
            DriveMode.CST: self._cst,
        }
        self.wanted_mode = self.drive_mode_of(self.control_mode)
        """Drive mode while holding; drives are enabled in CSP and then change to it."""
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
        self._writer.start(self.drives, self.held_torques())
        for drive in self.drives:
            drive.mode = mode

    def held_torques(self) -> list[float]:
        """Return the torques, Nm, with which the drives hold the arm now (`ArmState.proven_torque`)."""
        return [self.state.proven_torque(i) for i in range(len(self.drives))]

    def first_beyond_torque_limit(self, torques: Sequence[float]) -> int:
        """Return the first joint whose torque, Nm, is beyond its limit, or -1: in CST it would sag."""
        for i, most in enumerate(self.limits.torque):
            if abs(torques[i]) > most:
                return i
        return -1

    def change_mode(self, mode: DriveMode) -> None:
        """Command enabled drives to change to `mode`; only at standstill of the setpoints.

        A hand may have moved a joint away from its setpoint in CST and in CSV, and may still move it: the arm then
        holds where its joints come to rest. Nobody commanded a return. A writer that is already active continues.
        """
        if mode is self.mode:
            return
        compliant = self.mode is DriveMode.CST or (self.mode is DriveMode.CSV and mode is DriveMode.CSP)
        if not compliant:
            self.set_mode(mode)
            return
        limits, commanded = self.limits, self.state.commanded
        speeds = [
            min(max(drive.velocity, -most), most) for drive, most in zip(self.drives, limits.velocity, strict=True)
        ]
        for i, drive in enumerate(self.drives):
            # A hand may have made the joint faster than any target may be.
            speed = speeds[i]
            # The targets of this cycle arrive a cycle later than the positions were read.
            drive.target_position = drive.position + speed * self.period_s
            rest = drive.target_position + 0.5 * speed * abs(speed) / limits.acceleration[i]
            commanded[i] = min(max(rest, limits.low[i]), limits.high[i])
            self.output_limiter.latch(i, drive.target_position, speed)
        self.hold()
        self.set_mode(mode)
        if mode is DriveMode.CSP:
            self._csp.take_over(commanded, speeds, limits.acceleration, self.drives)

    @property
    def is_braking(self) -> bool:
        """Whether joints that a hand moved still brake after the change of the drive mode."""
        return self.mode is DriveMode.CSP and self._csp.is_braking

    def use_tool(self, number: int) -> None:
        """Use another tool, without a payload; only at rest."""
        self.tool.number, self.tool.payload = number, None
        self.trajectory_guard.use_tool(number)
        self._compliance.use_tool(number)
        self._pushes.use_tool(number)
        for controller in self.controllers.values():
            try:
                controller.use_tool(number)
            except BaseException as error:
                self._note(controller, error)
        self._publishes_load = True

    def carry(self, payload: LinkMass) -> None:
        """Compensate the weight of a payload; only at rest."""
        self.tool.payload = payload if payload.mass else None
        self._publishes_load = True

    def publish(self, values: list[Any]) -> None:
        """Write modes, progress, and actual and commanded values of the joints."""
        state, (held, elapsed_s, duration_s), at = self.state, self._progress, self.at
        values[at : at + len(ARM_MODES)] = (
            self.mode,
            self.control_mode,
            self.output_limiter.held | self.trajectory_guard.held | held,
            elapsed_s,
            duration_s,
            self.speed_override.fraction,
        )
        n, at = len(self.drives), at + len(ARM_MODES)
        values[at : at + 4 * n] = (*state.actual, *state.actual_velocity, *state.actual_torque, *state.commanded)
        at += 4 * n
        end = at + 5 * n
        for drive in self.drives:
            values[at:end:n] = (
                drive.target_position, drive.target_velocity, drive.target_torque, drive.state, drive.statusword,
            )  # fmt: skip
            at += 1
        if self._publishes_load:
            # The list is the same in every cycle, so values written once stay.
            payload, at = self.tool.payload or _NOTHING, self.at + len(ARM_MODES) + 9 * n
            values[at : at + len(LOAD_FIELDS)] = (self.tool.number, payload.mass, *payload.centre)
            self._publishes_load = False

    def stop(self) -> None:
        """Let the active controller come to rest."""
        controller = self.active
        self.limit_stop()
        try:
            if controller.phase is Phase.MOVE:
                controller.stop(self.state)
        except BaseException as error:
            self._note(controller, error)

    def limit_stop(self) -> None:
        """Limit the time in which a controller of another package comes to rest."""
        if self._stop_cycles == 0 and not self.still and is_foreign(self.active):
            # The configured time, longer where lower accelerations are in force.
            rates = zip(self._configured_rates, self.limits.acceleration, strict=True)
            longer = max(1.0, *(configured / rate for configured, rate in rates))
            self._stop_cycles = ceil(longer * self._stop_s / self.period_s)

    def accept_motion(self, controller: Controller, command: Command, continues: bool) -> Refusal | None:
        """Let a controller accept a command; its exception is a fault of the next cycle with torque."""
        try:
            return checked_refusal(controller.accept(command, self.state, continues))
        except BaseException as error:
            self._note(controller, error)
            return ControllerRaised(self.raised_by)

    def _note(self, controller: Controller, error: BaseException) -> None:
        self.raised, self.raised_by = plugin_error(error), controller.name

    def rest(self) -> None:
        """Hold at the setpoints; only at standstill."""
        for controller in self.controllers.values():
            try:
                controller.hold()
            except BaseException as error:
                self._note(controller, error)
        holder = self.active = self._holder
        self._stop_cycles = 0
        self._progress = (holder.held, holder.elapsed_s, holder.duration_s)

    def hold(self) -> None:
        """Hold at the last setpoint, at rest from now on."""
        self.rest()
        self.latch()

    def latch(self) -> None:
        """Restart the trajectory guard at the setpoints."""
        self.trajectory_guard.latch(self.state)

    def command(self) -> GuardResult:
        """Write the targets of this cycle: controller -> guard -> writer of the drive mode -> limiter.

        What the controller returns is checked here. Where it raises, the last targets stay, and `raised` says so.
        """
        state, drives, controller = self.state, self.drives, self.active
        try:
            setpoint = controller.update(state)
            if len(setpoint.position) != len(drives) or len(setpoint.velocity) != len(drives):
                found = f"{len(setpoint.position)} positions and {len(setpoint.velocity)} velocities"
                raise ValueError(f"the setpoint has {found}, allowed are {len(drives)}")
            if setpoint.direct:
                self._check_torques(setpoint)
            if controller.ended is not None and not isinstance(controller.ended, MotionEnded):
                raise TypeError(f"ended is {controller.ended!r:.80}, allowed is an event that ends a motion, or None")
            held = controller.held & _LARGEST_HELD
            self._progress = (held, float(controller.elapsed_s), float(controller.duration_s))
            if setpoint.direct and controller.follows_joints:
                self._look_ahead()
            if self._stop_cycles:
                self._count_stop()
            result = self.trajectory_guard.apply(state, setpoint, controller.tolerates_saturation)
        except BaseException as error:
            self._note(controller, error)
            return GuardResult.PASS
        if setpoint.direct and not self.trajectory_guard.stopping and result is not GuardResult.STOPPED:
            self._cst.pass_on(state.commanded, setpoint.torque, setpoint.weight, drives)
        else:
            self._writer.update(state.commanded, state.commanded_velocity, drives)
        self.output_limiter.check(drives)
        return result

    def _count_stop(self) -> None:
        self._stop_cycles -= 1
        if self._stop_cycles == 0 and not self.at_rest:
            raise TimeoutError("the controller was told to stop, or has ended, and its setpoints still move")

    def _check_torques(self, setpoint: Setpoint) -> None:
        count, torque, weight = len(self.drives), setpoint.torque, setpoint.weight
        if len(torque) != count or len(weight) != count:
            found = f"{len(torque)} torques and {len(weight)} weights"
            raise ValueError(f"the setpoint has {found}, allowed are {count}")
        for i in range(count):
            if not isfinite(torque[i]) or not isfinite(weight[i]):
                raise ValueError(f"axis {i}: found torque {torque[i]} and weight {weight[i]}, allowed are finite ones")

    def _look_ahead(self) -> None:
        """Stop a torque motion before the measured joints come too near to a box, a partner or the arm itself."""
        guard, state, compliance = self.trajectory_guard, self.state, self._compliance
        contact = compliance.ahead(state.actual, state.actual_velocity)
        if contact is not None:
            guard.stop_for(guard.reached(*contact))
            return
        near = compliance.partner_ahead(guard.neighbours, state.actual, state.actual_velocity)
        if near is not None:
            guard.stop_for(near)

    def pushed(self) -> FaultEvent | None:
        """Return the event of joints in CST that are about to come too near to a box, a partner or each other."""
        if self.mode is not DriveMode.CST:
            return None
        state, neighbours = self.state, self.trajectory_guard.neighbours
        near = self._pushes.partner_ahead(neighbours, state.actual, state.actual_velocity, PUSHED_CLEARANCE)
        if near is not None:
            return PushedNearPartner(near.partner, near.distance)
        contact = self._pushes.ahead(state.actual, state.actual_velocity)
        # Joints that stand there already are led out by their commander.
        if contact is None or self._pushes.is_inside:
            return None
        return PushedNear(contact[0], max(reported(*contact), 0.0))

    def first_without(self, mode: DriveMode) -> int:
        """Return the first joint whose drive does not map what `mode` needs, or -1."""
        return next((axis for axis, drive in enumerate(self.drives) if not drive.supports(mode)), -1)

    def first_unsettled(self) -> int:
        """Return the first joint that is not within `settle.tolerance` of its setpoint, or -1.

        Where a false sample of a drive is replaced, neither value alone proves that the joint is there.
        """
        actual, sample, commanded = self.state.actual, self.samples.actual, self.state.commanded
        tolerance = self._settle_tolerance
        for axis in range(len(self.drives)):
            wanted = commanded[axis]
            if not (abs(actual[axis] - wanted) <= tolerance and abs(sample[axis] - wanted) <= tolerance):
                return axis
        return -1

    @property
    def still(self) -> bool:
        """Whether the setpoints stand still."""
        return self.active.phase is Phase.HOLD

    @property
    def at_rest(self) -> bool:
        """Whether the setpoints stand still and no guard brakes."""
        return self.still and not self.trajectory_guard.stopping
