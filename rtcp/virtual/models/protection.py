"""Protection and reports of a drive: faults, condition, actual values, error log."""

from __future__ import annotations

from collections import deque
from enum import IntEnum
from math import pi
from types import MappingProxyType
from typing import Final

from rtcp.virtual.device import Emergency
from rtcp.virtual.models.drive_objects import HISTORY_LENGTH, TEMPERATURE_LOCK, VOLTAGE_LOCK
from rtcp.virtual.models.mechanics import ActuatorSize, Axis
from rtcp.virtual.models.units import AxisObjects


class ErrorCode(IntEnum):
    """Error codes 0x603F (CiA 402-2; 0x8130: CiA 301)."""

    OVER_CURRENT = 0x2310
    """Continuous over-current: the overload integrator is full."""
    OVER_VOLTAGE = 0x3210
    """Over-voltage of the DC link."""
    UNDER_VOLTAGE = 0x3220
    OVER_TEMPERATURE = 0x4310
    ENCODER = 0x7305
    """The position is unknown, so no ramp is possible."""
    COMMUNICATION = 0x8130
    """Life guard: outputs became invalid while the drive was enabled.

    EtherCAT has the sync manager watchdog in place of CANopen's life guarding; the meaning is the same: the master's
    cyclic sign of life is missing. 0x7510 would be a fault of a serial interface inside the drive.
    """
    OVER_SPEED = 0x8400
    FOLLOWING_ERROR = 0x8611
    POSITION_RANGE = 0x8612
    """Position outside the range of the encoder."""


AT_ONCE = frozenset({ErrorCode.OVER_CURRENT, ErrorCode.OVER_VOLTAGE, ErrorCode.UNDER_VOLTAGE, ErrorCode.ENCODER})
"""Faults that remove the torque at once."""
REGISTER_BITS = MappingProxyType({
    0x2: 0x03, 0x3: 0x05, 0x4: 0x09, 0x7: 0x21, 0xF: 0x81, 0x81: 0x11, 0x84: 0x21, 0x86: 0x21,
})  # fmt: skip
"""Bits of the error register 0x1001 by the class of an error code, its first one or two digits (CiA 301)."""
ENCODER_RANGE = 4 * pi
"""Range of the multi-turn encoder, two turns each way, rad; the firmware's range of 12.5 rad is just inside."""

_UNDER_VOLTAGE_LOCK: Final = 18.0
_RATED_RISE: Final = 40.0
_THERMAL_TIME: Final = 900.0
_OVERLOAD_TIME: Final = 2.0
_INTERVAL: Final = 0.005


class Condition:
    """The slow state of a drive: `temperature` (C), `bus_voltage` (V), `overload` (0 to 1, trips at 1)."""

    def __init__(self, size: ActuatorSize, temperature: float, bus_voltage: float) -> None:
        self.temperature = temperature
        self.bus_voltage = bus_voltage
        self.overload = 0.0
        self._surroundings = temperature
        self._rated_square = size.rated_torque**2
        self._average_square = size.average_torque**2
        self._overload_square = _OVERLOAD_TIME * (size.start_stop_torque**2 - self._average_square)
        self._heat = 0.0
        self._elapsed = 0.0

    def wear(self, torque: float, dt: float) -> bool:
        """Accumulate `torque` Nm for `dt` seconds; return True every 5 ms, after an update of all quantities.

        The overload integrator reaches 1 after 2 s at the start/stop torque, and never at the average load torque.
        """
        self._heat += torque * torque * dt
        self._elapsed += dt
        if self._elapsed < _INTERVAL:
            return False
        elapsed, square = self._elapsed, self._heat / self._elapsed
        self.overload = max(0.0, self.overload + (square - self._average_square) * elapsed / self._overload_square)
        settled = self._surroundings + _RATED_RISE * square / self._rated_square
        self.temperature += (settled - self.temperature) * min(1.0, elapsed / _THERMAL_TIME)
        self._heat = self._elapsed = 0.0
        return True

    def fault(self) -> int:
        """Return the present error code; 0: none."""
        if self.bus_voltage > VOLTAGE_LOCK:
            return ErrorCode.OVER_VOLTAGE
        if self.bus_voltage < _UNDER_VOLTAGE_LOCK:
            return ErrorCode.UNDER_VOLTAGE
        if self.temperature >= TEMPERATURE_LOCK:
            return ErrorCode.OVER_TEMPERATURE
        if self.overload >= 1.0:
            return ErrorCode.OVER_CURRENT
        return 0

    @property
    def warning(self) -> bool:
        """Whether a fault is near: 10 K or 4 V below the limit, or 80 % of the overload."""
        return (
            self.temperature >= TEMPERATURE_LOCK - 10.0
            or self.bus_voltage >= VOLTAGE_LOCK - 4.0
            or self.overload >= 0.8
        )


def error_register(code: int) -> int:
    """Return the bits of the error register for the class of an error code."""
    return REGISTER_BITS.get(code >> 8) or REGISTER_BITS.get(code >> 12, 0x01)


class Feedback:
    """Actual and demand values of a drive; keeps the entries, to avoid look-ups in a step."""

    def __init__(self, objects: AxisObjects, rated_torque: float) -> None:
        self.encoder_ratio = 1.0
        """Part of each turn that 0x6063 and 0x6064 show: another number than 1 plays a wrong encoder."""
        self._units = objects.units
        self._rated_torque = rated_torque
        self._statusword = objects.number(0x6041)
        self._position_demand = objects.number(0x6062)
        self._increments = objects.number(0x6063)
        self._position = objects.number(0x6064)
        self._velocity_demand = objects.number(0x606B)
        self._velocity = objects.number(0x606C)
        self._torque_demand = objects.number(0x6074)
        self._torque = objects.number(0x6077)
        self._current = objects.number(0x6078)
        self._following = objects.number(0x60F4)
        self.update_units()

    def update_units(self) -> None:
        """Apply changed units."""
        units = self._units
        self._increments_per_rad = units.increments
        self._positions, self._velocities = 1.0 / units.position, 1.0 / units.velocity
        self._torques = 1.0 / units.torque

    def publish(self, status: int, axis: Axis, following: float) -> None:
        """Write the statusword and the measurements; `following`: following error, rad."""
        mechanics = axis.mechanics
        per_rad, positions, velocities = self._increments_per_rad, self._positions, self._velocities
        increments = round(mechanics.position * per_rad * self.encoder_ratio)
        self._statusword.value = status
        self._increments.value = increments
        self._position.value = round((increments / per_rad + axis.offset) * positions)
        self._velocity.value = round(mechanics.velocity * velocities)
        # Ideal current loop: the actual torque equals the demand.
        self._torque.value = self._torque_demand.value = round(axis.torque * self._torques)
        self._position_demand.value = round(axis.demand * positions)
        self._velocity_demand.value = round(axis.reference_velocity * velocities)
        self._following.value = round(following * positions)

    def publish_condition(self, condition: Condition, torque: float) -> None:
        """Write the slow quantities: the current for `torque` Nm."""
        self._current.value = round(1000.0 * torque / self._rated_torque)


class FeedbackWithCondition(Feedback):
    """Feedback with the drive's condition in 0x2000."""

    def __init__(self, objects: AxisObjects, rated_torque: float) -> None:
        super().__init__(objects, rated_torque)
        self._temperature = objects.number(0x2000, 1)
        self._bus_voltage = objects.number(0x2000, 2)
        self._overload = objects.number(0x2000, 3)

    def publish_condition(self, condition: Condition, torque: float) -> None:
        """Write temperature, voltage, overload and current."""
        super().publish_condition(condition, torque)
        self._temperature.value = round(condition.temperature * 10.0)
        self._bus_voltage.value = round(condition.bus_voltage * 100.0)
        self._overload.value = min(0xFFFF, round(condition.overload * 1000.0))


class BoundedFeedback(Feedback):
    """Feedback that saturates at the limits of an object's bits; the position wraps at the ends in 0x607B."""

    def __init__(self, objects: AxisObjects, rated_torque: float) -> None:
        super().__init__(objects, rated_torque)
        indices = (0x6062, 0x6063, 0x6064, 0x606B, 0x606C, 0x6074, 0x6077, 0x6078, 0x60F4)
        self._bounded = [(objects.number(n), *objects.bounds(n)) for n in indices if (n, 0) in objects]
        self._ends = objects.number(0x607B, 1), objects.number(0x607B, 2)

    def publish(self, status: int, axis: Axis, following: float) -> None:
        """Write the statusword and the measurements."""
        super().publish(status, axis, following)
        lowest, highest = (end.value for end in self._ends)
        if lowest < highest:
            self._position.value = lowest + (self._position.value - lowest) % (highest - lowest + 1)
        for entry, low, high in self._bounded:
            value = entry.value
            if not low <= value <= high:
                entry.value = low if value < low else high


class ErrorLog:
    """The errors of a drive: 0x603F, 0x1001, 0x1003 and queued emergency messages."""

    def __init__(self, objects: AxisObjects, emergencies: deque[Emergency]) -> None:
        self.emergencies = emergencies
        self._code = objects.number(0x603F)
        self._register = objects.number(0x1001)
        self._count = objects.number(0x1003)
        self._fields = [objects.number(0x1003, n) for n in range(1, HISTORY_LENGTH + 1) if (0x1003, n) in objects]

    def add(self, code: int) -> None:
        """Report an error; the newest one is at 0x1003:1."""
        self._code.value = code
        self._register.value |= error_register(code)
        fields = self._fields
        for newer, older in zip(fields[-2::-1], fields[:0:-1], strict=True):
            older.value = newer.value
        if fields:
            fields[0].value = code
        self._count.value = min(len(fields), self._count.value + 1)
        self.emergencies.append(Emergency(code, self._register.value))

    def reset(self) -> None:
        """Report the absence of errors (emergency message 0x0000); the history stays."""
        self._code.value = self._register.value = 0
        self.emergencies.append(Emergency(0, 0))
