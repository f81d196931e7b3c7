"""The behaviour `cia402`: a described servo drive of one or more axes with the units of the standard.

Position counts per revolution are in 0x6092 if the drive has it, else 0x608F times 0x6091; the unit of velocities is in
0x60A9, else position counts per second; that of accelerations in 0x60AA, else velocity counts per second; torques are
per mille of 0x6076. Revolutions and torques are those of the motor, 0x6091 is the gear (CiA 402-2, ETG.6010). Objects
that are 0 or missing get a default.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isnan, nan, pi
from types import MappingProxyType
from typing import ClassVar

from rtcp.virtual.behaviour import Behaviour, Option
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.models.cubemars import CONDITION_OPTIONS, SERVO_OPTIONS
from rtcp.virtual.models.cyclic_modes import CyclicPosition, CyclicTorque, CyclicVelocity, Hold, Motion
from rtcp.virtual.models.mechanics import SIZES, ActuatorSize, Axis, Mechanics
from rtcp.virtual.models.profile_modes import Homing, ProfilePosition, ProfileVelocity
from rtcp.virtual.models.protection import BoundedFeedback, Condition, ErrorLog
from rtcp.virtual.models.servo import ServoAxis
from rtcp.virtual.models.units import AXIS_STRIDE, LIMITLESS, AxisObjects, Units, rate_unit
from rtcp.virtual.objects import Access, DataType, Entry, Number
from rtcp.virtual.protocol import AlState

MOST_AXES = 8
"""Upper bound on the axes of a drive: their objects fill 0x6000 to 0x9FFF (ETG.6010)."""
_CONTROLWORD, _MODE_DISPLAY, _INTERPOLATION_TIME = 0x6040, 0x6061, 0x60C2
_COUNTS_PER_TURN = 65536
_ACCELERATION = 20.0
"""Default acceleration of profiles, rad/s^2."""
_QUICK_STOP = 50.0
_MODEL = SIZES["orh60"]
"""Default inertia and friction, scaled by the rated torque."""
_POSITION_LIMIT = (1 << 31) - 1
_SUPPORTED = {1: 0x607A, 3: 0x60FF, 6: 0x6098, 8: 0x607A, 9: 0x60FF, 10: 0x6071}
"""Modes, and the object that each of them requires."""
_HELD: Mapping[str, tuple[tuple[int, int], DataType, str]] = MappingProxyType({
    "following_error_window": ((0x6065, 0), DataType.UNSIGNED32, "position"),
    "following_error_timeout": ((0x6066, 0), DataType.UNSIGNED16, "ms"),
    "max_torque": ((0x6072, 0), DataType.UNSIGNED16, "torque"),
    "positive_torque_limit": ((0x60E0, 0), DataType.UNSIGNED16, "torque"),
    "negative_torque_limit": ((0x60E1, 0), DataType.UNSIGNED16, "torque"),
    "max_profile_velocity": ((0x607F, 0), DataType.UNSIGNED32, "velocity"),
    "max_motor_speed": ((0x6080, 0), DataType.UNSIGNED32, "rpm"),
    "quick_stop_deceleration": ((0x6085, 0), DataType.UNSIGNED32, "acceleration"),
    "quick_stop_option": ((0x605A, 0), DataType.INTEGER16, "code"),
    "fault_reaction_option": ((0x605E, 0), DataType.INTEGER16, "code"),
    "velocity_offset": ((0x60B1, 0), DataType.INTEGER32, "velocity"),
    "torque_offset": ((0x60B2, 0), DataType.INTEGER16, "torque"),
    "wrap_low": ((0x607B, 1), DataType.INTEGER32, "position"),
    "wrap_high": ((0x607B, 2), DataType.INTEGER32, "position"),
})  # fmt: skip
"""Options for what a drive holds beside its process data: object, type where the description lacks it, quantity."""
_MAPPABLE = Access.RW | Access.RXPDO
_MOST = 0xFFFF_FFFF
_AXIS_OPTIONS: Mapping[str, Option] = MappingProxyType({
    "rated_torque": Option(None, 0.001, 10_000.0, "Nm at the joint; left out: by 0x6076, else 28"),
    "peak_torque": Option(None, 0.001, 30_000.0, "Nm; left out: twice the rated torque"),
    "max_speed": Option(10.0, 0.01, 1000.0, "speed above which the drive fails, rad/s"),
    "counts_per_turn": Option(None, 1.0, 2.0**40, "counts of a turn of the joint; left out: by 0x608F, 0x6091, 0x6092"),
    "encoder_ratio": Option(1.0, -1e4, 1e4, "what 0x6063 and 0x6064 show of each turn, beside 1 a wrong encoder"),
    "velocity_ratio": Option(None, 1e-3, 1e6, "turns that 0x60A9 counts in for one of the joint; left out: by 0x6091"),
    "torque_ratio": Option(None, 1e-6, 1e6, "Nm at the joint for 1000 of 0x6076; left out: by 0x6091"),
    "rated_current": Option(_MODEL.rated_current, 0.001, 10_000.0, "A (0x6075)"),
    "following_error_window": Option(None, 0.0, _MOST, "rad: the drive's own fault beyond it (0x6065)"),
    "following_error_timeout": Option(None, 0.0, 0xFFFF, "ms beyond the window until that fault (0x6066)"),
    "max_torque": Option(None, 0.0, 30_000.0, "Nm at the joint that the drive gives at most (0x6072); 0: none"),
    "positive_torque_limit": Option(None, 0.0, 30_000.0, "Nm at the joint (0x60E0)"),
    "negative_torque_limit": Option(None, 0.0, 30_000.0, "Nm at the joint (0x60E1)"),
    "max_profile_velocity": Option(None, 0.0, 1000.0, "rad/s of its own profiles and of CSV (0x607F)"),
    "max_motor_speed": Option(None, 0.0, 1e6, "rpm of the motor: a fault above it (0x6080)"),
    "quick_stop_deceleration": Option(None, 0.0, 1e6, "rad/s^2 of a quick stop (0x6085)"),
    "quick_stop_option": Option(None, -32768.0, 8.0, "what a quick stop does (0x605A); 0: the torque goes off at once"),
    "fault_reaction_option": Option(None, -32768.0, 4.0, "what a fault does (0x605E); 0: the torque goes off at once"),
    "velocity_offset": Option(None, -1000.0, 1000.0, "rad/s in 0x60B1 until a master writes it"),
    "torque_offset": Option(None, -30_000.0, 30_000.0, "Nm in 0x60B2 until a master writes it"),
    "wrap_low": Option(None, -1e6, 1e6, "rad: 0x6064 and targets wrap to `wrap_high` below it (0x607B:1)"),
    "wrap_high": Option(None, -1e6, 1e6, "rad: 0x6064 and targets wrap to `wrap_low` from here on (0x607B:2)"),
    **SERVO_OPTIONS,
})  # fmt: skip


_DICTIONARY_OPTIONS: Mapping[str, Option] = MappingProxyType({
    "interpolation_ms": Option(None, 0.0, 255.0, "ms at power-on; 0x60C2 then has subindex 1 alone, in ms"),
    "interpolation_read_only": Option(None, 0.0, 255_000.0, "us; 0x60C2 then has this time and cannot be written"),
    "no_mode_display": Option(0.0, 0.0, 1.0, "1: there is no 0x6061"),
})  # fmt: skip
"""Options of the whole drive on its object dictionary, which is otherwise that of its description."""


def _options() -> Mapping[str, Option]:
    """Return the options: those of all axes, and with an axis number as prefix those of one axis."""
    own = {
        f"axis{n}_{name}": Option(None, option.low, option.high, option.meaning, listed=False)
        for n in range(1, MOST_AXES + 1)
        for name, option in _AXIS_OPTIONS.items()
    }
    return MappingProxyType({**_AXIS_OPTIONS, **_DICTIONARY_OPTIONS, **CONDITION_OPTIONS, **own})


class Cia402Drive(Behaviour):
    """A servo drive; each further axis is 0x800 after 0x6040."""

    options: ClassVar[Mapping[str, Option]] = _options()
    keeps_outputs = True

    def __init__(self, device: DeviceModel) -> None:
        super().__init__(device)
        count = next(
            (n for n in range(MOST_AXES) if (_CONTROLWORD + AXIS_STRIDE * n, 0) not in device.objects), MOST_AXES
        )
        if not count:
            raise ValueError(f"cia402 moves a drive, and {device.identity.name} has no controlword (0x6040)")
        for shift in range(0, AXIS_STRIDE * count, AXIS_STRIDE):
            if self.option("no_mode_display"):
                device.objects.remove(_MODE_DISPLAY + shift)
            self._define_interpolation_time(_INTERPOLATION_TIME + shift)
        self.axes = [_StandardAxis(self, n) for n in range(count)]
        device.servos = [axis.servo for axis in self.axes]

    def _define_interpolation_time(self, index: int) -> None:
        """Replace 0x60C2 by the one that an option describes, if any."""
        ms, fixed_us = self.option("interpolation_ms", -1.0), self.option("interpolation_read_only", -1.0)
        value, exponent = "Interpolation time period value", "Interpolation time index"
        if ms >= 0.0:
            entries = [Entry(index, 1, value, DataType.UNSIGNED8, round(ms), Access.RW)]
        elif fixed_us >= 0.0:
            entries = [Entry(index, 1, value, DataType.UNSIGNED32, round(fixed_us)),
                       Entry(index, 2, exponent, DataType.INTEGER8, -6)]  # fmt: skip
        else:
            return
        self.device.objects.record(index, "Interpolation time period", entries)
        self.device.keep_defaults(entries)

    def on_start(self) -> None:
        """Set up the axes at power-on."""
        for axis in self.axes:
            axis.read_units()
            axis.hold_settings()
            axis.servo.power_on()

    def on_state(self, old: AlState, new: AlState) -> None:
        """Apply the start-up commands and the validity of the outputs."""
        if old < AlState.SAFE_OP <= new:
            for axis in self.axes:
                axis.read_units()

    def on_outputs(self, dt: float) -> None:
        """Advance every axis."""
        valid = self.device.outputs_valid
        for axis in self.axes:
            servo = axis.servo
            if servo.outputs_valid != valid:
                servo.set_outputs_valid(valid)
            servo.step(dt)


class _StandardAxis:
    """An axis: its units and defaults, and its servo."""

    def __init__(self, drive: Behaviour, number: int) -> None:
        self._drive = drive
        self._number = number
        objects = self._objects = AxisObjects(drive.device.objects, Units(1.0, 1.0, 1.0, 1.0, 1.0), number)
        self._add_settings()
        self._rated = objects.number(0x6076)
        stated = self._rated.value * 1e-3 * self._torque_ratio
        rated_torque = self._option("rated_torque", 0.0) or stated or _MODEL.rated_torque
        size = self._size = _size_of(rated_torque, self._option("peak_torque", 2.0 * rated_torque))
        self._max_speed = Number(0)
        mechanics = Mechanics(
            size.rotor_inertia + self._option("load_inertia", size.load_inertia),
            self._option("friction", size.coulomb),
            self._option("viscous_friction", size.viscous),
            holding_torque=self._option("holding_torque", size.peak_torque),
            load_mass_moment=self._option("load_mass_moment"),
            gravity_phase=self._option("gravity_phase"),
            position=self._option("initial_position"),
        )
        self._read_units()
        self._feedback = BoundedFeedback(objects, size.rated_torque)
        self._feedback.encoder_ratio = self._option("encoder_ratio")
        condition = Condition(size, drive.option("temperature"), drive.option("bus_voltage"))
        errors = ErrorLog(objects, drive.device.emergencies)
        self.servo = ServoAxis(
            objects, size, mechanics, condition, self._feedback, errors, self._modes, self._max_speed,
            _POSITION_LIMIT * objects.units.position,
        )  # fmt: skip
        self.servo.axis.velocity_share = self._option("velocity_share", 1.0)
        self.servo.mode_bits_lag, self.servo.reset_pulse = self._option("mode_bits_lag"), self._option("reset_pulse")
        self.servo.keeps_set_point = bool(self._option("keeps_set_point"))

    def _option(self, name: str, otherwise: float = 0.0) -> float:
        drive = self._drive
        return drive.option(f"axis{self._number + 1}_{name}", drive.option(name, otherwise))

    def _add_settings(self) -> None:
        """Add the objects of the options that the description lacks."""
        dictionary, shift = self._drive.device.objects, AXIS_STRIDE * self._number
        for name, ((index, sub_index), kind, _) in _HELD.items():
            at = index + shift
            if isnan(self._option(name, nan)) or (at, sub_index) in dictionary:
                continue
            if sub_index:
                dictionary.record(at, name, [Entry(at, n, name, kind, 0, _MAPPABLE) for n in (1, 2)])
            else:
                dictionary.variable(at, name, kind, 0, _MAPPABLE)

    def hold_settings(self) -> None:
        """Set what the drive holds at power-on."""
        units = self._objects.units
        counts = {
            "position": units.position, "velocity": units.velocity, "acceleration": units.acceleration,
            "torque": units.torque, "ms": 1.0, "rpm": 1.0, "code": 1.0,
        }  # fmt: skip
        for name, (at, _, quantity) in _HELD.items():
            if not isnan(value := self._option(name, nan)):
                low, high = self._objects.bounds(*at)
                self._objects.number(*at).value = min(max(round(value / counts[quantity]), low), high)

    def read_units(self) -> None:
        """Read the units from the objects."""
        self._read_units()
        self._feedback.update_units()

    def _read_units(self) -> None:
        objects, units = self._objects, self._objects.units
        counts_per_turn = self._option("counts_per_turn", self._counts_per_turn())
        units.position = 2 * pi / counts_per_turn
        ratio = self._option("velocity_ratio", self._gear_ratio)
        units.velocity = rate_unit(objects.number(0x60A9).value, units.position, ratio) or units.position
        units.acceleration = rate_unit(objects.number(0x60AA).value, units.position, ratio) or units.velocity
        units.increments = counts_per_turn / (2 * pi)
        rated = self._rated
        if not rated.value or self._option("rated_torque", 0.0):
            rated.value = round(self._size.rated_torque * 1000.0 / self._torque_ratio)
        units.torque = rated.value * 1e-6 * self._torque_ratio
        fastest = self._option("max_speed")
        if motor_rpm := objects.number(0x6080).value:
            # In revolutions per minute of the motor, whatever 0x60A9 says (CiA 402-2, object 0x6080).
            fastest = min(fastest, motor_rpm * 2 * pi / 60 / self._gear_ratio)
        self._max_speed.value = round(fastest / units.velocity)
        kept = {at for name, (at, _, _) in _HELD.items() if not isnan(self._option(name, nan))}
        objects.fill({at: value for at, value in self._defaults(units).items() if at not in kept})

    def _counts_per_turn(self) -> float:
        """Return the position counts per joint revolution from the objects."""
        feed = self._ratio(0x6092)
        if feed:
            return feed
        return (self._ratio(0x608F) or _COUNTS_PER_TURN) * self._gear_ratio

    @property
    def _gear_ratio(self) -> float:
        """Return the motor revolutions per joint revolution."""
        return self._ratio(0x6091) or 1.0

    @property
    def _torque_ratio(self) -> float:
        return self._option("torque_ratio", self._gear_ratio)

    def _ratio(self, index: int) -> float:
        objects = self._objects
        if (index, 1) not in objects:
            return 0.0
        return float(objects.number(index, 1).value / (objects.number(index, 2).value or 1))

    def _defaults(self, units: Units) -> dict[tuple[int, int], int]:
        counts, speed = round(1.0 / units.position), round(1.0 / units.velocity)
        acceleration = round(_ACCELERATION / units.acceleration)
        limit = min(_POSITION_LIMIT, LIMITLESS)
        defaults = {
            (0x6065, 0): 0xFFFF_FFFF,
            (0x6066, 0): 100,
            (0x6067, 0): max(1, counts // 1000),
            (0x606D, 0): min(0xFFFF, max(1, speed // 100)),
            (0x606F, 0): min(0xFFFF, max(1, speed // 200)),
            (0x6075, 0): round(1000.0 * self._option("rated_current")),
            (0x6072, 0): round(1000.0 * self._size.peak_torque / self._size.rated_torque),
            (0x60E0, 0): round(1000.0 * self._size.peak_torque / self._size.rated_torque),
            (0x60E1, 0): round(1000.0 * self._size.peak_torque / self._size.rated_torque),
            (0x607F, 0): self._max_speed.value,
            (0x6081, 0): speed,
            (0x6083, 0): acceleration,
            (0x6084, 0): acceleration,
            (0x6085, 0): round(_QUICK_STOP / units.acceleration),
            (0x6098, 0): 37,
            (0x6099, 1): round(0.2 / units.velocity),
            (0x6099, 2): round(0.1 / units.velocity),
            (0x609A, 0): acceleration,
            (0x60C5, 0): 0xFFFF_FFFF,
            (0x6502, 0): sum(1 << mode - 1 for mode, index in _SUPPORTED.items() if (index, 0) in self._objects),
            (0x605A, 0): 2,
            (0x605C, 0): 1,
            (0x605D, 0): 1,
            (0x605E, 0): 2,
        }
        low, high = (self._objects.number(0x607D, n).value for n in (1, 2))
        if low >= high:
            self._objects.number(0x607D, 1).value, self._objects.number(0x607D, 2).value = -limit, limit
        return {at: value for at, value in defaults.items() if at not in _OPTION_CODES or at not in self._objects}

    def _modes(self, axis: Axis, objects: AxisObjects) -> dict[int, Motion]:
        unlimited = Number(LIMITLESS)
        period = objects.number(_INTERPOLATION_TIME, 1)
        in_ms = (_INTERPOLATION_TIME, 2) not in objects
        exponent = Number(-3) if in_ms else objects.number(_INTERPOLATION_TIME, 2)
        modes: dict[int, Motion] = {
            1: ProfilePosition(axis, objects),
            3: ProfileVelocity(axis, objects),
            6: Homing(axis, objects, self._gear_ratio),
            8: CyclicPosition(axis, objects, unlimited, unlimited, period, exponent),
            9: CyclicVelocity(axis, objects),
            10: CyclicTorque(axis, objects),
        }
        return {0: Hold(axis), **{mode: motion for mode, motion in modes.items() if (_SUPPORTED[mode], 0) in objects}}


_OPTION_CODES = frozenset({(0x605A, 0), (0x605C, 0), (0x605D, 0), (0x605E, 0)})
"""Objects for which 0 is a valid value."""


def _size_of(rated: float, peak: float) -> ActuatorSize:
    """Return an actuator of the given rated torque, Nm."""
    share = rated / _MODEL.rated_torque
    return ActuatorSize(
        "described", rated, peak, peak, rated, _MODEL.input_speed, _MODEL.rated_current, _MODEL.peak_current,
        _MODEL.rotor_inertia * share, _MODEL.load_inertia * share, _MODEL.coulomb * share, _MODEL.viscous * share,
    )  # fmt: skip
