"""The Cubemars ORH drive: a CiA 402 servo drive with motor, gear and load."""

from __future__ import annotations

from math import pi
from types import MappingProxyType
from typing import ClassVar

from rtcp.virtual.device import DeviceModel, Option
from rtcp.virtual.models.cia402 import DriveState
from rtcp.virtual.models.cyclic_modes import CyclicPosition, CyclicTorque, CyclicVelocity, Hold, Motion
from rtcp.virtual.models.drive_objects import UNIT, define_objects
from rtcp.virtual.models.mechanics import GEAR_RATIO, INCREMENTS_PER_RAD, SIZES, ActuatorSize, Axis, Mechanics
from rtcp.virtual.models.profile_modes import Homing, ProfilePosition, ProfileVelocity
from rtcp.virtual.models.protection import ENCODER_RANGE, Condition, ErrorLog, FeedbackWithCondition
from rtcp.virtual.models.servo import ServoAxis
from rtcp.virtual.models.units import AxisObjects, Units
from rtcp.virtual.objects import ObjectDictionary
from rtcp.virtual.pdo import define_pdo_objects

RX_PDO = ((0x6040, 0, 16), (0x607A, 0, 32), (0x60FF, 0, 32), (0x6071, 0, 32), (0x6060, 0, 8))
TX_PDO = ((0x6041, 0, 16), (0x6064, 0, 32), (0x606C, 0, 32), (0x6077, 0, 32), (0x6061, 0, 8))
SERVO_OPTIONS = MappingProxyType({
    "load_inertia": Option(None, 0.0, 50.0, "inertia of the load at the joint, kg m^2"),
    "load_mass_moment": Option(0.0, -50.0, 50.0, "mass of the load times its distance from the axis, kg m"),
    "gravity_phase": Option(0.0, -2 * pi, 2 * pi, "0: the load stands upright at q = 0, pi: it hangs, rad"),
    "friction": Option(None, 0.0, 50.0, "Coulomb friction, Nm"),
    "viscous_friction": Option(None, 0.0, 50.0, "viscous friction, Nm s/rad"),
    "holding_torque": Option(None, 0.0, 500.0, "torque of the brake that closes with the power stage off, Nm"),
    "initial_position": Option(0.0, -20.0, 20.0, "position of the encoder at power-on, rad"),
    "velocity_share": Option(1.0, 0.0, 1.0, "fraction of the demand's speed that the position loop adds by itself"),
    "mode_bits_lag": Option(0.0, 0.0, 10.0, "time for which bits 10, 12 and 13 stay those of the former mode, s"),
    "reset_pulse": Option(0.0, 0.0, 10.0, "time for which the fault reset bit must stay set, s"),
    "keeps_set_point": Option(0.0, 0.0, 1.0, "1: profile position goes on to its set-point when it begins anew"),
})  # fmt: skip
"""Options of every axis."""
CONDITION_OPTIONS = MappingProxyType({
    "temperature": Option(30.0, -40.0, 200.0, "ambient temperature, and of the motor at power-on, C"),
    "bus_voltage": Option(48.0, 0.0, 100.0, "supply, V"),
})  # fmt: skip


def modes_of(axis: Axis, objects: AxisObjects) -> dict[int, Motion]:
    """Return the modes; in CSP 0x60FF is the speed limit, 0 means no motion."""
    period, exponent = objects.number(0x60C2, 1), objects.number(0x60C2, 2)
    return {
        0: Hold(axis),
        1: ProfilePosition(axis, objects),
        3: ProfileVelocity(axis, objects),
        6: Homing(axis, objects, GEAR_RATIO),
        8: CyclicPosition(axis, objects, objects.number(0x60FF), objects.number(0x607F), period, exponent),
        9: CyclicVelocity(axis, objects),
        10: CyclicTorque(axis, objects),
    }


class CubemarsDrive(DeviceModel):
    """A Cubemars ORH drive; each size is a subclass."""

    # Placeholders: the manufacturer's numbers are unknown to this project.
    vendor_id = 0x00000B5C
    product_code = 0x00040201
    device_type = 0x00020192  # servo drive, CiA 402
    group = "Servo drives"
    size: ClassVar[ActuatorSize]
    options = MappingProxyType({**SERVO_OPTIONS, **CONDITION_OPTIONS})

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        size, option = self.size, self.option
        objects = AxisObjects(self.objects, Units(UNIT, UNIT, UNIT, UNIT, INCREMENTS_PER_RAD))
        mechanics = Mechanics(
            size.rotor_inertia + option("load_inertia", size.load_inertia),
            option("friction", size.coulomb),
            option("viscous_friction", size.viscous),
            holding_torque=option("holding_torque", size.start_stop_torque),
            load_mass_moment=option("load_mass_moment"),
            gravity_phase=option("gravity_phase"),
            position=option("initial_position"),
        )
        self.servo = ServoAxis(
            objects, size, mechanics, Condition(size, option("temperature"), option("bus_voltage")),
            FeedbackWithCondition(objects, size.rated_torque), ErrorLog(objects, self.emergencies), modes_of,
            self.objects[0x6080, 0], ENCODER_RANGE,
        )  # fmt: skip
        self.servos = (self.servo,)
        self.mechanics, self.condition, self.axis = mechanics, self.servo.condition, self.servo.axis
        self.axis.velocity_share = option("velocity_share")
        self.servo.mode_bits_lag, self.servo.reset_pulse = option("mode_bits_lag"), option("reset_pulse")
        self.servo.keeps_set_point = bool(option("keeps_set_point"))
        # Kept for fast access in a step.
        self.step = self.servo.step  # type: ignore[method-assign]
        self.power_on()

    def define(self, objects: ObjectDictionary) -> None:
        """Add the objects of the drive and its PDOs, which the master may remap."""
        define_objects(objects, self.size, int(self.option("sync_error_limit")))
        define_pdo_objects(objects, {0x1600: RX_PDO}, {0x1A00: TX_PDO}, [0x1600], [0x1A00], fixed=False)

    @property
    def state(self) -> DriveState:
        """The state of the power state machine."""
        return self.servo.state

    @property
    def powered(self) -> bool:
        """Whether the power stage is on and the brake open."""
        return self.servo.powered

    def inject_fault(self, code: int) -> None:
        """Trigger the fault `code`, see `ServoAxis.inject_fault`."""
        self.servo.inject_fault(code)

    def power_on(self) -> None:
        """Power on: reset everything."""
        super().power_on()
        self.servo.power_on()

    def power_off(self) -> None:
        """Power off: no torque, the brake closes."""
        self.outputs_valid = False
        self.servo.power_off()

    def set_outputs_valid(self, valid: bool) -> None:
        """Set whether process data outputs are valid (OP) or ignored."""
        super().set_outputs_valid(valid)
        self.servo.set_outputs_valid(valid)

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds: read the RxPDO objects, move, write the TxPDO objects."""
        self.servo.step(dt)


class CubemarsOrh40(CubemarsDrive):
    """ORH40, 5.4 Nm rated."""

    size, name, order_code = SIZES["orh40"], "Cubemars ORH40", "Cubemars-ORH40"


class CubemarsOrh50(CubemarsDrive):
    """ORH50, 16 Nm rated."""

    size, name, order_code = SIZES["orh50"], "Cubemars ORH50", "Cubemars-ORH50"


class CubemarsOrh60(CubemarsDrive):
    """ORH60, 28 Nm rated."""

    size, name, order_code = SIZES["orh60"], "Cubemars ORH60", "Cubemars-ORH60"


class CubemarsOrh70(CubemarsDrive):
    """ORH70, 40 Nm rated."""

    size, name, order_code = SIZES["orh70"], "Cubemars ORH70", "Cubemars-ORH70"
