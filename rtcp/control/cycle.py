"""The cycle.

wake -> send the outputs of the last cycle -> receive -> each part's decode -> command -> state machine (controller ->
guards -> writer -> limiter) -> each part's update and encode -> publish -> clock discipline. Nothing in here logs,
blocks, opens files or allocates memory that grows.
"""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic_ns
from typing import Any, Final

from rtcp.config.find import is_foreign
from rtcp.config.model import ArmConfig, Joint
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.command_handler import CommandHandler
from rtcp.control.context import Context
from rtcp.control.external_axis import ExternalAxisGroup
from rtcp.control.gripper import make_gripper
from rtcp.control.machine import StateMachine
from rtcp.control.operator import Operator
from rtcp.control.part import Part, PluginTimer, make_devices
from rtcp.control.partners import Partners
from rtcp.control.processes import make_processes
from rtcp.devices.drive import Drive, drive_of
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.master import PacedData
from rtcp.fieldbus.system_time import SystemTime
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import ClockLocked, ClockUnlocked
from rtcp.ipc.schema import (
    CYCLE_FIELDS,
    FLAG_ALL_OP,
    FLAG_ARM_HAS_JOYSTICK,
    FLAG_DC_LOCKED,
    FLAG_EMERGENCY_STOP,
    FLAG_ENABLED,
    FLAG_MOTION_ALLOWED,
    FLAG_SWITCHING,
    GRIPPER_FIELDS,
    OPERATOR_FIELDS,
    RecordSchema,
    arm_fields,
    axis_fields,
    schema_of,
)
from rtcp.realtime.discipline import Discipline
from rtcp.realtime.scheduling import Sleeper

_LARGEST_COUNTER = 0x7FFF
"""Largest working counter in a record: a damaged frame may have a larger one than any segment."""
_LONGEST_NS: Final = 2_000_000_000
_TRANSIT_DIVISOR: Final = 20
"""Longest transit time of a frame: the period divided by this."""


class Cycle:
    """Runs the loop: exchange, parts, command, state machine and record, once a cycle.

    Args:
        config: the arm.
        data: the process image, slaves in SAFE-OP.
        blackboard: provides commands and receives records.
        service: the thread beside the cycle; it need not run.
        discipline: follows the reference clock; None without distributed clocks.
        now: clock, ns; a simulated one in tests.
        partners: the arm's partners in a cell.

    Raises:
        DeviceError: the description of a device does not suit its use.
    """

    def __init__(
        self,
        config: ArmConfig,
        data: ProcessData,
        blackboard: Blackboard,
        service: BusService,
        discipline: Discipline | None,
        now: Callable[[], int] = monotonic_ns,
        partners: Partners | None = None,
    ) -> None:
        self.devices = devices = make_devices(config)
        gripper = make_gripper(config)
        external = enumerate(config.external_axes, config.first_external)
        axes = [ExternalAxisGroup(config, axis, number) for number, axis in external]
        group = None if partners is None else partners.group
        self.arm = Arm(config, make_drives(config), blackboard.plan, group)
        self.operator = Operator(config, {device.name: device.driver for device in devices}, gripper)
        self._period_ns = round(config.cycle.period_us * 1000)
        context = Context(
            config, PluginTimer(now, self._period_ns, blackboard.event), self.arm, gripper, axes, self.operator,
            devices, blackboard, service, discipline, partners,
            make_processes(config, devices, partners),
        )  # fmt: skip
        self.joints = context.joints
        self.machine = StateMachine(context, partners)
        self.commands = CommandHandler(self.machine, blackboard)
        self.parts = context.parts
        self._context = context
        self._stop_device = next((device for device in devices if device.slot + 1 == self.operator.stop_position), None)
        at = len(CYCLE_FIELDS) - 1
        for part in self.parts:
            part.at = at
            at += sum(field.count for field in part.fields)
        self._values: list[Any] = [0] * at
        """Values of the record without its number, which the blackboard adds."""
        if blackboard.schema != schema_of(part.fields for part in self.parts):
            raise ValueError("the blackboard was made for other records: make it with `record_schema`")
        self._data = data
        self._blackboard = blackboard
        self._service = service
        self._discipline = discipline
        self._now = now
        self._expected = data.expected_wkc
        ahead_ns = ahead_of_sync0(config)
        # Half of the time to SYNC0; the other half is for the frame's transit.
        self._late_ns = ahead_ns // 2
        # After a frame that misses its SYNC0, the next tick's frame would precede the same SYNC0 as that frame.
        self._apart_ns = max(self._period_ns // 2, self._period_ns - ahead_ns + self._period_ns // _TRANSIT_DIVISOR)
        self._spin_ns = round(config.cycle.spin_us * 1000)
        self._timer = context.timer
        self._controllers_timed = any(map(is_foreign, self.arm.controllers.values()))
        self._controller_powers = "power" in config.bus.LACKS
        """Whether only a robot controller knows if the motors are on."""
        self._locked = False
        self._shutdown = False
        self.missed = 0
        """Ticks of the grid at which no frame was sent."""
        self._compute_ns = 0
        """Time from the last answer to the end of its cycle, ns; published in the next cycle's record."""

    def shut_down(self) -> None:
        """Request a controlled stop, disabled drives, and the end of `run`. Safe from a signal handler or a thread."""
        self._shutdown = True

    def run(self) -> None:
        """Run until `shut_down` was called and the drives are disabled (or 2 s have passed)."""
        machine, cycle, spin = self.machine, self.cycle, self._spin_ns
        if isinstance(self._data, PacedData):
            planned = monotonic_ns() + self._period_ns
            while not machine.closed:
                planned = self.answer(self._data, planned)
            return
        sleep = Sleeper().until
        planned = monotonic_ns() + self._period_ns
        while not machine.closed:
            sleep(planned - spin)
            while (woken := monotonic_ns()) < planned:
                pass
            planned = cycle(planned, woken)

    def answer(self, data: PacedData, planned: int) -> int:
        """Do one cycle of a bus that sets the pace: its message is due at `planned`; return when the next is due, ns.

        A message later than half a period counts as lost and begins the next cycle.
        """
        period = self._period_ns
        wkc = data.receive_until(planned + period // 2)
        woken = self._now()
        self._work(woken, wkc)
        data.send()
        self._publish(woken, planned, woken, wkc)
        self._compute_ns = self._now() - woken
        return (woken if wkc > 0 else max(planned, woken - period)) + period

    def cycle(self, planned: int, woken: int) -> int:
        """Do one cycle, planned at `planned` and begun at `woken`; return when the next is due; ns of the clock."""
        data = self._data
        data.send()
        sent = self._now()
        wkc = data.receive()
        received = self._now()
        self._work(woken, wkc)
        self._publish(woken, planned, received, wkc)
        discipline = self._discipline
        if discipline is None:
            planned += self._period_ns
        else:
            if wkc >= 0:
                discipline.observe(woken, data.dc_time)
            else:
                discipline.holdover()
            planned = discipline.next_wakeup(planned)
        finished = self._now()
        self._compute_ns = finished - received
        # Late: whole ticks are skipped, never replayed in a burst. At most one frame goes before each SYNC0 of a drive,
        # or it would do two steps in one; and two frames are never closer than half a period.
        late = self._late_ns if discipline is None or discipline.locked else 0
        earliest = max(sent + self._apart_ns, finished - late)
        if planned < earliest:
            period = self._period_ns
            skipped = (earliest - planned + period - 1) // period
            self.missed += skipped
            planned += skipped * period
        return planned

    def _work(self, woken: int, wkc: int) -> None:
        """Compute the next outputs from an answer."""
        data, machine, parts, context = self._data, self.machine, self.parts, self._context
        good = wkc == self._expected
        context.now_ns = woken
        for group in self.joints.groups:
            group.state.now_ns = woken
        self.operator.unread_cycles += 1
        if good:
            for part in parts:
                if part.is_timed:
                    self._timed(part, part.decode, data)
                else:
                    part.decode(data)
        elif wkc > 0 and self._stop_device is not None and context.stop_box_in_op:
            # A slave is missing, and which ones were in the frame is unknown. SOEM returns bytes that no slave wrote
            # unchanged, so these inputs of the box are new or old, but valid.
            self._stop_device.decode(data)
            self.operator.read_emergency_stop()
        if machine.partners is not None:
            machine.partners.read(woken)
        board, commands = self._blackboard, self.commands
        if board.command_waits():
            commands.handle()
        if board.setpoint_waits():
            commands.take_setpoints()
        if self._shutdown:
            machine.close()
        if self._controllers_timed:
            began = self._now()
            machine.update(good)
            if is_foreign(self.arm.active):
                self._timer.check(f"controller {self.arm.active.name}", began)
        else:
            machine.update(good)
        if board.stream and not commands.open_stream:
            board.open_stream(0)
        for part in parts:
            if part.is_timed:
                self._timed(part, part.update, context)
                self._timed(part, part.encode, data)
            else:
                part.update(context)
                part.encode(data)

    def _timed(self, part: Part, call: Callable[[Any], None], argument: object) -> None:
        began = self._now()
        call(argument)
        self._timer.check(part.name, began)

    def _publish(self, woken: int, planned: int, received: int, wkc: int) -> None:
        """Publish the record of the cycle."""
        values, machine, discipline = self._values, self.machine, self._discipline
        operator, context = self.operator, self._context
        flags = FLAG_ALL_OP if self._service.all_op else 0
        offset = filtered = 0
        dc_time = self._data.dc_time
        if discipline is not None:
            dc_time = discipline.system_time.extended(dc_time, woken)
            offset, filtered = discipline.raw_ns, int(discipline.filtered_ns)
            if discipline.locked:
                flags |= FLAG_DC_LOCKED
            if discipline.locked is not self._locked:
                self._locked = discipline.locked
                self._blackboard.event(ClockLocked() if self._locked else ClockUnlocked())
        if context.all_enabled:
            flags |= FLAG_ENABLED
        if machine.changing_mode:
            flags |= FLAG_SWITCHING
        if operator.emergency_stop or operator.stop_unread:
            flags |= FLAG_EMERGENCY_STOP
        if operator.permitted:
            flags |= FLAG_MOTION_ALLOWED
        if operator.joystick_granted:
            flags |= FLAG_ARM_HAS_JOYSTICK
        # One slice, in the order of CYCLE_FIELDS: cheaper than an index for each field.
        values[: len(CYCLE_FIELDS) - 1] = (
            context.cycle,
            woken,
            dc_time,
            context.state,
            flags,
            min(wkc, _LARGEST_COUNTER),
            self._expected,
            self.missed,
            context.lost,
            min(woken - planned, _LONGEST_NS),
            min(received - woken, _LONGEST_NS),
            min(self._compute_ns, _LONGEST_NS),
            offset,
            filtered,
            machine.fault,
            machine.limit,
            machine.enables,
            machine.motions,
            operator.drives_powered
            if self._controller_powers
            else int(context.all_enabled or self.joints.first_with_torque() >= 0),
            operator.e_stopped,
            operator.operating_mode,
        )
        for part in self.parts:
            if part.is_timed:
                self._timed(part, part.publish, values)
            else:
                part.publish(values)
        self._blackboard.publish(values)


def record_schema(config: ArmConfig, partners: Partners | None = None) -> RecordSchema:
    """Return the schema of this platform's cycle records; `partners`: the arm's partners in a cell.

    Raises:
        DeviceError: the description of a device does not suit its use.
        SchemaError: two slaves have names that give the same field names.
    """
    driven = config.gripper is not None and config.gripper.joint is not None
    axes = map(axis_fields, config.external_axes)
    arm = (arm_fields(len(config.joints)), GRIPPER_FIELDS if driven else (), *axes, OPERATOR_FIELDS)
    cell = () if partners is None else (partners.fields,)
    devices = make_devices(config)
    parts = (*make_processes(config, devices, partners), *devices)
    return schema_of((*arm, *(part.fields for part in parts), *cell))


def make_drives(config: ArmConfig) -> list[tuple[int, Drive]]:
    """Return the driver of each joint with the index of its slave; raises DeviceError."""
    zeros = config.zero_offsets or (0.0,) * len(config.axes)
    return [drive_of(config, joint, zero) for joint, zero in zip(config.joints, zeros, strict=False)]


def ahead_of_sync0(config: ArmConfig) -> int:
    """Return the time from a frame in time to the first SYNC0 of a drive, ns; half a period without SYNC0."""
    period_ns = round(config.cycle.period_us * 1000)
    shifts = [round(slave.device.sync0_shift_us * 1000) for slave in config.slaves if slave.device.assign_activate]
    sent = round(config.ethercat.send_phase * period_ns)
    return min([(shift - shifts[0] - sent) % period_ns for shift in shifts], default=period_ns // 2)


def make_discipline(config: ArmConfig, system_time: SystemTime | None = None) -> Discipline | None:
    """Return the clock discipline, None without distributed clocks; `system_time`: of the bus, where it has one."""
    period_ns = round(config.cycle.period_us * 1000)
    shifts = [slave.device.sync0_shift_us for slave in config.slaves if slave.device.assign_activate]
    if not shifts:
        return None
    phase_ns = round(shifts[0] * 1000 + config.ethercat.send_phase * period_ns)
    return Discipline(period_ns, phase_ns, system_time)


def address_of(config: ArmConfig, joint: Joint) -> tuple[int, int]:
    """Return the position on the cable, from 1, and the axis of the drive of `joint`."""
    return next(slot for slot, slave in enumerate(config.slaves, 1) if slave.name == joint.slave), joint.axis
