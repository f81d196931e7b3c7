"""The parts of a loop put together around a process image: on a bus, or where time is simulated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rtcp.config.model import ArmConfig, Joint
from rtcp.control.arm import Arm
from rtcp.control.behaviour import Behaviour
from rtcp.control.bus_service import BusService
from rtcp.control.gripper import gripper_of
from rtcp.control.loop import Loop
from rtcp.control.operator import Operator
from rtcp.control.orders import Orders
from rtcp.control.record import Recorder
from rtcp.devices.cia402 import Cia402Drive, drive_of
from rtcp.devices.driver import Driver, make_driver
from rtcp.devices.io_box import IoBox
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.blackboard import Blackboard
from rtcp.realtime.clock import monotonic_ns
from rtcp.realtime.discipline import Discipline


@dataclass(frozen=True)
class Parts:
    """A loop and what it is made of."""

    arm: Arm
    box: IoBox | None
    operator: Operator
    behaviour: Behaviour
    orders: Orders
    recorder: Recorder
    loop: Loop


def drives_of(config: ArmConfig) -> list[tuple[int, Cia402Drive]]:
    """Return each joint's driver with the index of its slave; raises DeviceError."""
    zeros = config.zero_offsets or (0.0,) * len(config.axes)
    return [drive_of(config, joint, zero) for joint, zero in zip(config.joints, zeros, strict=False)]


def position_of(config: ArmConfig, joint: Joint) -> int:
    """Return the position on the cable, from 1, of the drive that moves `joint`."""
    return next(slot for slot, slave in enumerate(config.slaves, 1) if slave.name == joint.slave)


def others_of(config: ArmConfig) -> list[tuple[int, Driver]]:
    """Return the drivers of the slaves that are no drives, with the indices of the slaves; raises DeviceError."""
    period_s = config.cycle.period_us * 1e-6
    made = [(slot, make_driver(slave, period_s)) for slot, slave in enumerate(config.slaves)]
    return [(slot, driver) for slot, driver in made if not isinstance(driver, Cia402Drive)]


def discipline_of(config: ArmConfig) -> Discipline | None:
    """Return what follows the reference clock, or None without distributed clocks."""
    period_ns = round(config.cycle.period_us * 1000)
    shifts = [slave.device.sync0_shift_us for slave in config.slaves if slave.device.assign_activate]
    if not shifts:
        return None
    return Discipline(period_ns, round(shifts[0] * 1000 + config.bus.send_phase * period_ns))


def assemble(
    config: ArmConfig,
    data: ProcessData,
    blackboard: Blackboard,
    service: BusService,
    discipline: Discipline | None,
    now: Callable[[], int] = monotonic_ns,
) -> Parts:
    """Put a loop together.

    Args:
        config: the arm.
        data: the process image, slaves in SAFE-OP.
        blackboard: where commands come from and records go.
        service: the thread beside the cycle; it need not run.
        discipline: follows the reference clock, or None.
        now: the clock, ns.

    Raises:
        DeviceError: a device's description cannot serve.
    """
    arm = Arm(config, drives_of(config), gripper_of(config), blackboard.plan)
    others = others_of(config)
    slotted = next(((slot, driver) for slot, driver in others if isinstance(driver, IoBox)), None)
    box = None if slotted is None else slotted[1]
    operator = Operator(config, box)
    behaviour = Behaviour(config, arm, operator, blackboard, service, discipline)
    orders = Orders(config, arm, box, operator, behaviour, blackboard, service)
    recorder = Recorder(data, arm, box, operator, behaviour, blackboard, service, discipline)
    loop = Loop(
        round(config.cycle.period_us * 1000),
        round(config.cycle.spin_us * 1000),
        data,
        arm,
        slotted,
        behaviour,
        orders,
        recorder,
        blackboard,
        discipline,
        now,
        [one for one in others if one != slotted],
    )
    return Parts(arm, box, operator, behaviour, orders, recorder, loop)
