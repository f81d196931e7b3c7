"""Joints that share their limits, supervision and output limiter: the arm is one group, a driven gripper another."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Final

from rtcp.config.find import is_foreign, plugin_error
from rtcp.config.model import ArmConfig
from rtcp.control.measurements import Measurements
from rtcp.control.part import Part, PartContext, PluginTimer
from rtcp.devices.cia402 import blind_outputs
from rtcp.devices.drive import Drive, TargetState, share_slaves
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.events import DriverFailed, FaultEvent
from rtcp.ipc.schema import Field
from rtcp.ipc.states import WITH_TORQUE, DriveState, Missing, State
from rtcp.motion.guards.output_limiter import OutputLimiter
from rtcp.motion.guards.supervision import Supervision
from rtcp.motion.guards.trajectory_guard import GuardResult
from rtcp.motion.limits import Limits, Values
from rtcp.motion.state import ArmState

RESTING = frozenset({DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON})
"""Drive states without torque and without a fault."""
_ENABLED = DriveState.OPERATION_ENABLED
_HOLDING = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
"""Drive states with torque, in which the target stays."""
RANGE_MARGIN_RAD: Final = 0.02
"""Largest distance of a joint from its range, rad, at which it can be enabled, to return to the edge: an overshoot in
CST must not leave an arm that no command can move."""


_NUMBERS: Final = (
    "position", "velocity", "torque", "temperature", "target_position", "target_velocity", "target_torque",
    "mode_display", "statusword",
)  # fmt: skip
"""Numbers of a drive that the loop uses."""
_NUMBER_TYPES: Final = struct.Struct("<7dbH")
"""Their types, which the record and the events can hold."""
_VALUES: Final = (*_NUMBERS, "state", "missing")


class ForeignDrive:
    """The calls of a drive's driver of another package.

    An exception of the driver, or a wrong value, is a fault of that slave and does not end the cycle: the driver is not
    called any more, its last good values stay, and its outputs are a quick stop, or no torque where the machine
    commands that, until the machine is reset.

    Args:
        slot: index of the slave.
        drive: driver of the drive.
    """

    def __init__(self, slot: int, drive: Drive) -> None:
        self.drive = drive
        self.timer: PluginTimer | None = None
        self._slot = slot
        self._failed = self._retries = False
        self._error: BaseException | None = None
        self._goal = TargetState.DISABLED
        self._sent = drive.safe_outputs

    def decode(self, data: bytes) -> None:
        """Let the driver read the inputs of the slave."""
        if self._retries:
            # The machine commands the drive in this cycle, before outputs are encoded.
            self._failed = self._retries = False
        self._call(self.drive.decode, data)

    def advance(self, target: TargetState) -> None:
        """Let the driver take the next step towards `target`."""
        self._goal = target
        self._call(self.drive.advance, target)

    def encode(self) -> bytes:
        """Return the outputs of the driver, or of a drive whose driver failed."""
        outputs = self._call(self.drive.encode)
        size = self.drive.output_bytes
        if not self._failed:
            if isinstance(outputs, bytes) and len(outputs) == size:
                self._sent = outputs
                return outputs
            self._fail(ValueError(f"encode returned {outputs!r:.80}, allowed are {size} bytes"))
        return blind_outputs(self.drive, self._goal, self._sent)

    def update(self, context: PartContext) -> None:
        """Report an exception of the driver as a fault; try the driver again in a reset."""
        if self._error is not None:
            context.explain(f"driver of slave {self.drive.name}", self._error)
            self._error = None
            context.report(DriverFailed(self._slot + 1))
        elif self._failed:
            self._retries = context.state is State.RESETTING

    def _call(self, call: Callable[..., object], *arguments: object) -> object:
        if self._failed:
            return None
        drive = self.drive
        timer = self.timer
        began = 0 if timer is None else timer.now()
        kept = [getattr(drive, name) for name in _VALUES]
        result: object = None
        try:
            result = call(*arguments)
            _NUMBER_TYPES.pack(*(getattr(drive, name) for name in _NUMBERS))
            if not isinstance(drive.state, DriveState) or not isinstance(drive.missing, Missing):
                raise TypeError(f"found the state {drive.state!r:.80} with {drive.missing!r:.80} missing")
        except BaseException as error:
            self._fail(error)
            for name, value in zip(_VALUES, kept, strict=True):
                setattr(drive, name, value)
        if timer is not None:
            timer.check(drive.name, began)
        return result

    def _fail(self, error: BaseException) -> None:
        self._failed, self._error = True, plugin_error(error)


class JointGroup(Part):
    """Drives with consecutive axis numbers. Its setpoints advance only in `command`, when the machine calls it.

    Args:
        name: name of the part.
        fields: fields of the part in the record.
        config: configuration with the `joints` of the group.
        drives: the drive of each joint, with the index of its slave.
        first: axis number of the first joint.
    """

    def __init__(
        self,
        name: str,
        fields: Sequence[Field],
        config: ArmConfig,
        drives: Sequence[tuple[int, Drive]],
        first: int = 0,
    ) -> None:
        super().__init__(name, fields)
        self.first = first
        self.period_s = config.cycle.period_us * 1e-6
        self.pairs = list(drives)
        self.drives = [drive for _, drive in drives]
        self.foreign = {i: ForeignDrive(slot, drive) for i, (slot, drive) in enumerate(drives) if is_foreign(drive)}
        """Joints, counted within the group, whose drive has a driver of another package."""
        self.returns_to_range = True
        """Whether a joint slightly outside its range returns to it when it is enabled; else it may stand anywhere."""
        self.shares_slaves = False
        """Whether one of its drives is one of several axes of a slave."""
        self.state = ArmState(len(config.joints))
        self.measurements = Measurements(config, first)
        self.samples = ArmState(len(config.joints))
        """The measurements as the drives sent them, for the supervision; its commanded values are those of `state`."""
        self.samples.commanded = self.state.commanded
        self.limits = Limits(config)
        damping = [joint.cst_damping for joint in config.joints]
        self.output_limiter = OutputLimiter(self.limits, self.period_s, damping)
        self.supervision = Supervision(config, self.limits, first)

    def decode(self, data: ProcessData) -> None:
        """Read the inputs of the drives."""
        state, samples, measurements = self.state, self.samples, self.measurements
        actual, speed, torque = state.actual, state.actual_velocity, state.actual_torque
        positions, velocities, torques = samples.actual, samples.actual_velocity, samples.actual_torque
        foreign = self.foreign
        measurements.begin(state.now_ns)
        for axis, (slot, drive) in enumerate(self.pairs):
            last_position, last_velocity, last_torque = drive.position, drive.velocity, drive.torque
            if foreign and axis in foreign:
                foreign[axis].decode(data.input(slot))
            else:
                drive.decode(data.input(slot))
            positions[axis] = drive.position
            velocities[axis] = drive.velocity
            torques[axis] = drive.torque
            measurements.check(axis, drive, last_position, last_velocity, last_torque)
            actual[axis] = drive.position
            speed[axis] = drive.velocity
            torque[axis] = drive.torque
        state.keep_torques()

    def encode(self, data: ProcessData) -> None:
        """Write the outputs of the drives."""
        if self.shares_slaves or self.foreign:
            for i, (slot, drive) in enumerate(self.pairs):
                own = self.foreign[i].encode() if i in self.foreign else drive.encode()
                slave = drive.slave
                data.set_output(slot, own if slave is None else slave.outputs(drive, own))
            return
        for slot, drive in self.pairs:
            data.set_output(slot, drive.encode())

    def update(self, context: PartContext) -> None:
        """Report what drivers of other packages have raised."""
        for drive in self.foreign.values():
            drive.update(context)

    def set_limits(self, new: Values) -> None:
        """Apply new limits."""
        self.limits.apply(new)
        for i, drive in enumerate(self.drives):
            drive.low, drive.high = self.limits.low[i], self.limits.high[i]
            drive.deceleration = self.limits.acceleration[i]
            drive.speed_limit = max(self.limits.velocity[i], self.limits.widest.velocity[i])
        self.output_limiter.take(self.limits)
        self.supervision.take(self.limits)
        self.measurements.take(self.limits)

    @property
    def at_rest(self) -> bool:
        """Whether the setpoints stand still and no guard brakes: the torque may be removed."""
        raise NotImplementedError

    def command(self) -> GuardResult:
        """Write the targets of this cycle; return the result of the trajectory guard, PASS without one."""
        raise NotImplementedError

    def stop(self) -> None:
        """Bring the setpoints to rest under the limits."""
        raise NotImplementedError

    def hold(self) -> None:
        """Hold at the last setpoint, at rest from now on."""
        raise NotImplementedError

    def latch(self) -> None:
        """Set the setpoints, moved by `track_actual`, to rest."""
        raise NotImplementedError

    def track_actual(self) -> None:
        """Let setpoints and targets follow the drives that have no torque.

        The setpoint of a joint outside its range is the range's edge, so that every controller begins inside; once the
        drive follows its target, the output limiter moves it from the joint's position to the edge.
        """
        commanded, latch, limits = self.state.commanded, self.output_limiter.latch, self.limits
        for i, drive in enumerate(self.drives):
            if drive.state not in _HOLDING:
                low, high, here = limits.low[i], limits.high[i], drive.position
                commanded[i] = high if here > high else low if here < low else here
                drive.target_position = here
                latch(i, here)
        self.latch()

    def beyond_range(self, i: int) -> float:
        """Return how far the target of joint `i`, counted within the group, is beyond its range, rad; 0 inside."""
        if not self.returns_to_range:
            return 0.0
        last, limits = self.output_limiter.sent[i], self.limits
        return max(last - limits.high[i], limits.low[i] - last, 0.0)


class Joints:
    """All joints of a platform by axis number. A method `first_...` returns -1 where there is no such joint.

    Args:
        arm: the arm, whose axes come first.
        others: groups beside the arm, which move on while a joint of the arm homes.
    """

    def __init__(self, arm: JointGroup, others: Sequence[JointGroup]) -> None:
        self.others = list(others)
        self.groups = [arm, *others]
        self.pairs = [pair for group in self.groups for pair in group.pairs]
        """Slave index and driver of each drive."""
        share_slaves(self.pairs)
        for group in self.groups:
            group.shares_slaves = any(drive.slave is not None for drive in group.drives)
        self.drives = [drive for _, drive in self.pairs]
        self.foreign = {group.first + i: drive for group in self.groups for i, drive in group.foreign.items()}
        """Joints whose drive has a driver of another package."""

    def time_foreign(self, timer: PluginTimer) -> None:
        """Let `timer` measure the drivers of other packages."""
        for drive in self.foreign.values():
            drive.timer = timer

    def advance(self, target: TargetState) -> None:
        """Command every drive one step towards `target`."""
        if self.foreign:
            for axis, drive in enumerate(self.drives):
                if axis in self.foreign:
                    self.foreign[axis].advance(target)
                else:
                    drive.advance(target)
            return
        for drive in self.drives:
            drive.advance(target)

    def track_actual(self) -> None:
        """Let setpoints and targets follow the drives that have no torque."""
        for group in self.groups:
            group.track_actual()

    def command(self) -> GuardResult:
        """Write the targets of this cycle; return the result of the arm's trajectory guard."""
        self.command_others()
        return self.groups[0].command()

    def command_others(self) -> None:
        """Write this cycle's targets of all joints beside the arm's."""
        for group in self.others:
            group.command()

    def stop(self) -> None:
        """Bring all setpoints to rest."""
        self.groups[0].stop()
        self.stop_others()

    def stop_others(self) -> None:
        """Bring the setpoints of all joints beside the arm's to rest."""
        for group in self.others:
            group.stop()

    def hold(self) -> None:
        """Hold at the last setpoints, at rest from now on."""
        for group in self.groups:
            group.hold()

    @property
    def at_rest(self) -> bool:
        """Whether all setpoints stand still and no guard brakes: the torque may be removed."""
        return all(group.at_rest for group in self.groups)

    def beyond_limits(self) -> FaultEvent | None:
        """Return the event of a measurement that was beyond its limit, or false, for too long, or None."""
        for group in self.groups:
            event = group.supervision.check(group.samples) or group.measurements.event
            if event is not None:
                return event
        return None

    def reset_supervision(self) -> None:
        """Restart the count of cycles beyond a limit."""
        for group in self.groups:
            group.supervision.reset()

    def first_not_enabled(self) -> int:
        """Return the first joint whose drive is not enabled."""
        for axis, drive in enumerate(self.drives):
            if drive.state is not _ENABLED:
                return axis
        return -1

    def first_with_torque(self) -> int:
        """Return the first joint whose drive has torque: enabled, in a quick stop or reacting to a fault."""
        for axis, drive in enumerate(self.drives):
            if drive.state in WITH_TORQUE:
                return axis
        return -1

    def first_in_another_mode(self) -> int:
        """Return the first joint whose drive does not display the commanded mode."""
        for axis, drive in enumerate(self.drives):
            if drive.mode_display != drive.mode:
                return axis
        return -1

    def first_in_fault(self) -> int:
        """Return the first joint whose drive is in fault."""
        for axis, drive in enumerate(self.drives):
            if drive.state is DriveState.FAULT:
                return axis
        return -1

    def first_blocked(self) -> int:
        """Return the first joint whose drive cannot be enabled before an action at its controller."""
        for axis, drive in enumerate(self.drives):
            if drive.missing is not Missing.NOTHING:
                return axis
        return -1

    def first_moving(self) -> int:
        """Return the first joint that does not stand still."""
        for axis, drive in enumerate(self.drives):
            if abs(drive.velocity) > drive.still:
                return axis
        return -1

    def first_not_resting(self) -> int:
        """Return the first joint whose drive is in fault or enabled."""
        for axis, drive in enumerate(self.drives):
            if drive.state not in RESTING:
                return axis
        return -1

    def first_outside(self) -> int:
        """Return the first joint outside its range by more than `RANGE_MARGIN_RAD`."""
        for group in self.groups:
            if not group.returns_to_range:
                continue
            low, high = group.limits.low, group.limits.high
            for i, drive in enumerate(group.drives):
                if not low[i] - RANGE_MARGIN_RAD <= drive.position <= high[i] + RANGE_MARGIN_RAD:
                    return group.first + i
        return -1

    def first_returning(self) -> int:
        """Return the first joint whose target still returns to its range."""
        for group in self.groups:
            for i in range(len(group.drives)):
                if group.beyond_range(i) > 0.0:
                    return group.first + i
        return -1
