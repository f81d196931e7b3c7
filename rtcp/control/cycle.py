"""The cycle.

wake -> send the outputs of the last cycle -> receive -> decode -> command -> state machine (controller -> guards ->
writer -> limiter) -> encode -> publish -> clock discipline. Nothing in here logs, blocks, opens or grows.
"""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic_ns

from rtcp.config.model import ArmConfig, Joint
from rtcp.control.arm import Arm
from rtcp.control.bus_service import BusService
from rtcp.control.command_handler import CommandHandler
from rtcp.control.context import Context
from rtcp.control.gripper import make_gripper
from rtcp.control.machine import StateMachine
from rtcp.control.operator import Operator
from rtcp.devices.cia402 import Cia402Drive, drive_of
from rtcp.devices.driver import Driver, make_driver
from rtcp.devices.io_box import IoBox
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import ClockLocked, ClockUnlocked
from rtcp.ipc.layout import (
    FLAG_ALL_OP,
    FLAG_ARM_HAS_JOYSTICK,
    FLAG_DC_LOCKED,
    FLAG_EMERGENCY_STOP,
    FLAG_ENABLED,
    FLAG_MOTION_ALLOWED,
    FLAG_SWITCHING,
    PER_JOINT,
    SCALARS,
)
from rtcp.realtime.discipline import Discipline
from rtcp.realtime.scheduling import Sleeper

_LARGEST_COUNTER = 0x7FFF
"""A damaged frame may bring a larger working counter than any segment has."""
_LONGEST_NS = 2_000_000_000
_WAY = 20
"""A frame is on its way for this part of the period at most."""
_AT = {name: at for at, (name, _) in enumerate(SCALARS[1:])}


class Cycle:
    """Everything that happens once a cycle.

    Args:
        config: the arm.
        data: the process image, slaves in SAFE-OP.
        blackboard: where commands come from and records go.
        service: the thread beside the cycle; it need not run.
        discipline: follows the reference clock, or None without distributed clocks.
        now: the clock, ns; another one where time is simulated.

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
    ) -> None:
        others = make_others(config)
        box = next(((slot, driver) for slot, driver in others if isinstance(driver, IoBox)), None)
        self.others = [one for one in others if one != box]
        """Index of the slave and driver of each device of another kind than drive and IO box."""
        self.arm = Arm(config, make_drives(config), make_gripper(config), blackboard.plan)
        self.box = None if box is None else box[1]
        self.operator = Operator(config, self.box)
        context = Context(config, self.arm, self.operator, blackboard, service, discipline)
        self.machine = StateMachine(context)
        self.commands = CommandHandler(self.machine, self.box, blackboard)
        self._context = context
        self._box_slot = -1 if box is None else box[0]
        self._data = data
        self._blackboard = blackboard
        self._service = service
        self._discipline = discipline
        self._now = now
        self._expected = data.expected_wkc
        self._period_ns = round(config.cycle.period_us * 1000)
        ahead_ns = ahead_of_sync0(config)
        # Half of what is left to SYNC0; the other half is for the frame's way.
        self._late_ns = ahead_ns // 2
        # After a frame that SYNC0 has overtaken, the next tick's would come before the same SYNC0 as that one.
        self._apart_ns = max(self._period_ns // 2, self._period_ns - ahead_ns + self._period_ns // _WAY)
        self._spin_ns = round(config.cycle.spin_us * 1000)
        self._values: list[float] = [0] * (len(SCALARS) - 1 + len(PER_JOINT) * len(self.arm.drives))
        self._locked = False
        self._shutdown = False
        self.missed = 0
        """Ticks of the grid at which no frame was sent."""
        self._compute_ns = 0
        """From an answer to the end of its cycle: known after the record of that cycle, so the next one carries it."""

    def shut_down(self) -> None:
        """Ask for a controlled stop, drives disabled, and the end of `run`. Safe from a signal handler or a thread."""
        self._shutdown = True

    def run(self) -> None:
        """Run until the end was asked for and the drives are disabled (or 2 s have passed)."""
        machine, cycle, spin = self.machine, self.cycle, self._spin_ns
        sleep = Sleeper().until
        planned = monotonic_ns() + self._period_ns
        while not machine.closed:
            sleep(planned - spin)
            while (woken := monotonic_ns()) < planned:
                pass
            planned = cycle(planned, woken)

    def cycle(self, planned: int, woken: int) -> int:
        """Do one cycle, planned at `planned` and begun at `woken` (ns of the clock); return when the next is due."""
        data, arm, machine, box = self._data, self.arm, self.machine, self.box
        data.send()
        sent = self._now()
        wkc = data.receive()
        received = self._now()
        good = wkc == self._expected
        context = self._context
        context.now_ns = arm.state.now_ns = woken
        if good:
            arm.decode(data)
            if box is not None:
                box.decode(data.input(self._box_slot))
            for slot, driver in self.others:
                driver.decode(data.input(slot))
        elif wkc > 0 and box is not None and context.box_in_op:
            # Another slave is missing, and which ones were in the frame is unknown. SOEM returns what a slave did not
            # fill in as it was, so these are the inputs of the box, of now or of before.
            box.decode(data.input(self._box_slot))
            self.operator.read_emergency_stop()
        if self._blackboard.command_waits():
            self.commands.handle()
        if self._shutdown:
            machine.close()
        machine.update(good)
        arm.encode(data)
        if box is not None:
            data.set_output(self._box_slot, box.encode())
        for slot, driver in self.others:
            data.set_output(slot, driver.encode())
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

    def _publish(self, woken: int, planned: int, received: int, wkc: int) -> None:
        """Publish the record of the cycle."""
        values, machine, discipline, box = self._values, self.machine, self._discipline, self.box
        arm, operator, context = self.arm, self.operator, self._context
        flags = FLAG_ALL_OP if self._service.all_op else 0
        offset = filtered = 0
        if discipline is not None:
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
        if operator.emergency_stop:
            flags |= FLAG_EMERGENCY_STOP
        if operator.permitted:
            flags |= FLAG_MOTION_ALLOWED
        if operator.joystick_granted:
            flags |= FLAG_ARM_HAS_JOYSTICK
        inputs = outputs = counter = 0
        if box is not None:
            inputs, outputs, counter = box.inputs, box.outputs, box.counter
        controller = arm.active
        # One slice, in the order of layout.SCALARS: cheaper than an index a field.
        values[: len(_AT)] = (
            context.cycle,
            woken,
            self._data.dc_time,
            context.state,
            arm.mode,
            arm.control_mode,
            operator.joystick_mode,
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
            inputs,
            outputs,
            counter,
            machine.fault,
            machine.limit,
            arm.output_limiter.held | arm.trajectory_guard.held | controller.held,
            machine.enables,
            machine.motions,
            controller.elapsed_s,
            controller.duration_s,
        )
        state, n = arm.state, len(arm.drives)
        at = len(_AT) + 4 * n
        values[len(_AT) : at] = (*state.actual, *state.actual_velocity, *state.actual_torque, *state.commanded)
        for drive in arm.drives:
            values[at] = drive.target_position
            values[at + n] = drive.target_velocity
            values[at + 2 * n] = drive.target_torque
            values[at + 3 * n] = drive.statusword
            at += 1
        self._blackboard.publish(values)


def make_drives(config: ArmConfig) -> list[tuple[int, Cia402Drive]]:
    """Return the driver of each joint with the index of its slave; raises DeviceError."""
    zeros = config.zero_offsets or (0.0,) * len(config.axes)
    return [drive_of(config, joint, zero) for joint, zero in zip(config.joints, zeros, strict=False)]


def make_others(config: ArmConfig) -> list[tuple[int, Driver]]:
    """Return the drivers of the slaves that are no drives, with the indices of the slaves; raises DeviceError."""
    period_s = config.cycle.period_us * 1e-6
    made = [(slot, make_driver(slave, period_s)) for slot, slave in enumerate(config.slaves)]
    return [(slot, driver) for slot, driver in made if not isinstance(driver, Cia402Drive)]


def ahead_of_sync0(config: ArmConfig) -> int:
    """Return how long before the first SYNC0 of a drive a frame leaves that is in time, ns; half a period without."""
    period_ns = round(config.cycle.period_us * 1000)
    shifts = [round(slave.device.sync0_shift_us * 1000) for slave in config.slaves if slave.device.assign_activate]
    sent = round(config.bus.send_phase * period_ns)
    return min([(shift - shifts[0] - sent) % period_ns for shift in shifts], default=period_ns // 2)


def make_discipline(config: ArmConfig) -> Discipline | None:
    """Return what follows the reference clock, or None without distributed clocks."""
    period_ns = round(config.cycle.period_us * 1000)
    shifts = [slave.device.sync0_shift_us for slave in config.slaves if slave.device.assign_activate]
    if not shifts:
        return None
    return Discipline(period_ns, round(shifts[0] * 1000 + config.bus.send_phase * period_ns))


def position_of(config: ArmConfig, joint: Joint) -> int:
    """Return the position on the cable, from 1, of the drive that moves `joint`."""
    return next(slot for slot, slave in enumerate(config.slaves, 1) if slave.name == joint.slave)
