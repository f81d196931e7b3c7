"""What the drive protects itself against: its faults as a table, and the slow quantities that it watches."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from types import MappingProxyType

from rtcp.virtual.models.drive_objects import TEMPERATURE_LOCK, VOLTAGE_LOCK
from rtcp.virtual.models.mechanics import ActuatorSize

OVER_CURRENT = 0x2310
OVER_VOLTAGE = 0x3210
UNDER_VOLTAGE = 0x3220
OVER_TEMPERATURE = 0x4310
COMMUNICATION = 0x8130
ENCODER = 0x7305
OVER_SPEED = 0x8400
FOLLOWING_ERROR = 0x8611
POSITION_RANGE = 0x8612


@dataclass(frozen=True)
class Fault:
    """A fault: what it is, its bits of the error register 0x1001, and whether torque must go at once."""

    name: str
    register: int
    at_once: bool = False


FAULTS = MappingProxyType({
    OVER_CURRENT: Fault("continuous over-current: the overload integrator is full", 0x03, at_once=True),
    OVER_VOLTAGE: Fault("over-voltage of the DC link", 0x05, at_once=True),
    UNDER_VOLTAGE: Fault("under-voltage of the DC link", 0x05, at_once=True),
    OVER_TEMPERATURE: Fault("over-temperature of the drive", 0x09),
    # EtherCAT has no life guarding of CANopen's; its watchdog is the sync manager's, and this code says the same:
    # the master's cyclic sign of life is missing. 0x7510 would be a fault of a serial interface inside the drive.
    COMMUNICATION: Fault("life guard: outputs became invalid while the drive was enabled", 0x11),
    ENCODER: Fault("encoder: the position is unknown, no ramp can be kept", 0x21, at_once=True),
    OVER_SPEED: Fault("over-speed", 0x21),
    FOLLOWING_ERROR: Fault("following error", 0x21),
    POSITION_RANGE: Fault("position outside the range of the encoder", 0x21),
})  # fmt: skip
"""Faults by error code 0x603F (CiA 402-2; 0x8130: CiA 301)."""

ENCODER_RANGE = 4 * pi
"""The multi-turn encoder counts two turns each way, rad; the firmware's position range of 12.5 rad ends just inside."""

_UNDER_VOLTAGE_LOCK = 18.0
_RATED_RISE = 40.0
_THERMAL_TIME = 900.0
_OVERLOAD_TIME = 2.0
_INTERVAL = 0.005


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
        """Count `torque` Nm for `dt` seconds; return True every 5 ms, when the quantities have been worked out anew.

        The overload integrator reaches 1 after 2 s of the start/stop torque and never below the average load torque.
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
        """Return the error code of what is wrong now, 0 for nothing."""
        if self.bus_voltage > VOLTAGE_LOCK:
            return OVER_VOLTAGE
        if self.bus_voltage < _UNDER_VOLTAGE_LOCK:
            return UNDER_VOLTAGE
        if self.temperature >= TEMPERATURE_LOCK:
            return OVER_TEMPERATURE
        if self.overload >= 1.0:
            return OVER_CURRENT
        return 0

    @property
    def warning(self) -> bool:
        """Whether a fault comes near: 10 K below the lock, 4 V below the lock, 80 % of the overload."""
        return (
            self.temperature >= TEMPERATURE_LOCK - 10.0
            or self.bus_voltage >= VOLTAGE_LOCK - 4.0
            or self.overload >= 0.8
        )


def error_register(code: int) -> int:
    """Return the bits of the error register that go with an error code (CiA 301, object 0x1001), by its class."""
    if code in FAULTS:
        return FAULTS[code].register
    classes = {0x2: 0x03, 0x3: 0x05, 0x4: 0x09, 0x7: 0x21, 0xF: 0x81}
    return 0x11 if code >> 8 == 0x81 else classes.get(code >> 12, 0x01)
