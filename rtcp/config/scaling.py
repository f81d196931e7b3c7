"""Scaling of a CiA 402 drive: the factors of its process data by its encoder, gear and rated torque.

The keys of `scaling` in a device's file correspond to objects of the drive, which are compared with them at the start
(`rtcp.fieldbus.scaling`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt

OBJECTS_PER_AXIS = 0x800
"""Distance of the objects of one axis from those of the next (IEC 61800-7-201, 0x6000 to 0x67FF is the first)."""

VelocityUnit = Literal["counts/s", "0.1 counts/s", "rpm", "mrpm", "urpm"]
VELOCITY_UNITS: dict[int, VelocityUnit] = {
    0x00B44700: "rpm", 0xFDB44700: "mrpm", 0xFAB44700: "urpm", 0x00B50300: "counts/s",
    0xFFB50300: "0.1 counts/s",
}  # fmt: skip
"""Velocity units by their numbers in 0x60A9: prefix, numerator and denominator in the notation of ETG.1004."""
_COUNTS: dict[VelocityUnit, float] = {"counts/s": 1.0, "0.1 counts/s": 0.1}
_RPM: dict[VelocityUnit, float] = {"rpm": 1.0, "mrpm": 1e-3, "urpm": 1e-6}
TorqueUnit = Literal["mNm", "uNm"]
TORQUE_UNITS: dict[TorqueUnit, float] = {"mNm": 1e-3, "uNm": 1e-6}
"""Nm per count of 0x6076."""
PER_MILLE = 1e-3
FACTOR_TOLERANCE = 1e-6
"""Largest relative difference of two equal factors, and of the values in a drive and in its file."""

QUANTITIES: dict[str, str] = {
    "target_position": "position",
    "position": "position",
    "position_offset": "position",
    "target_velocity": "velocity",
    "velocity": "velocity",
    "velocity_offset": "velocity",
    "profile_velocity": "velocity",
    "target_torque": "torque",
    "torque": "torque",
    "torque_offset": "torque",
}
"""Channels of a CiA 402 drive whose factors follow from the scaling."""
SOURCES = {
    "encoder_increments": "0x608F of the drive (subindex 1 by 2), or the encoder's data sheet",
    "gear_ratio": "0x6091 of the drive (subindex 1 by 2); 1 if it has none",
    "external_gear_ratio": "the gear's name plate; 1 without a gear, negative where the joint turns the other way",
    "feed_constant": "0x6092 of the drive (subindex 1 by 2); 0 if the drive does not use it",
    "velocity_unit": "0x60A9 of the drive, or the unit of 0x606C in its manual",
    "velocity_at": "the drive's manual at 0x606C; without effect for counts/s",
    "rated_torque": "0x6076 of the drive, mostly in mNm, or the name plate; or write rated_current and torque_constant",
    "torque_at": "the drive's manual at 0x6077; of an actuator with a gear mostly its output",
    "assign_activate": "AssignActivate in the maker's ESI file, as 0x0300; 0 for no distributed clock",
}
"""Where a person finds the value of a key of a device's file that no description states."""
QUICK_STOP_OPTION = 0x605A
"""Object of the first axis: quick stop option code."""
BOUNDING_OBJECTS = {
    0x6072: "max torque", 0x6080: "max motor speed",
    0x60E0: "positive torque limit", 0x60E1: "negative torque limit",
}  # fmt: skip
"""Objects of the first axis that limit the drive: 0 leaves an enabled drive without torque or motion."""


@dataclass(frozen=True)
class DriveScaling:
    """Scaling of one axis of a CiA 402 drive. At the start the drive's own objects are compared with it."""

    encoder_increments: Annotated[float, Gt(0)]
    """Encoder increments per motor revolution (0x608F); of an encoder at the output: per revolution there."""
    gear_ratio: Annotated[float, Gt(0)] = 1.0
    """Motor revolutions per revolution of the drive's output shaft (0x6091)."""
    feed_constant: Annotated[float, Ge(0)] | None = None
    """Position counts per revolution of the output shaft (0x6092); left out: computed from encoder and gear; 0: the
    drive has the object but does not use it."""
    external_gear_ratio: float = 1.0
    """Revolutions of the output shaft per revolution of the joint, by a gear that the drive does not know; not 0,
    negative: the joint turns the other way."""
    velocity_unit: VelocityUnit = "counts/s"
    """Unit of velocities (0x60A9): (tenth) position counts per second, or (thousandth, millionth) revolutions per
    minute."""
    velocity_at: Literal["motor", "output"] = "motor"
    """Which shaft's revolutions per minute they are."""
    rated_torque: Annotated[float, Gt(0)] | None = None
    """Rated torque, Nm (0x6076): torques are thousandths of it."""
    rated_torque_unit: TorqueUnit = "mNm"
    """Unit of 0x6076 in the drive."""
    torque_at: Literal["motor", "output"] = "motor"
    """Shaft of the rated torque, and of the torque constant; of an actuator with a gear mostly its output."""
    rated_current: Annotated[float, Gt(0)] | None = None
    """Rated current, A (0x6075): where torques are thousandths of it; with `torque_constant`."""
    torque_constant: Annotated[float, Gt(0)] | None = None
    """Torque by current, Nm/A."""
    max_motor_speed: Annotated[float, Gt(0)] | None = None
    """Largest speed of the motor, revolutions per minute (0x6080): a joint cannot be faster."""

    @property
    def counts_per_output_turn(self) -> float:
        """Position counts per revolution of the drive's output shaft."""
        return self.feed_constant or self.encoder_increments * self.gear_ratio

    @property
    def position(self) -> float:
        """Joint angle per position count, rad."""
        return 2.0 * math.pi / (self.counts_per_output_turn * self.external_gear_ratio)

    @property
    def velocity(self) -> float:
        """Joint speed per count of velocity, rad/s."""
        if self.velocity_unit in _COUNTS:
            return _COUNTS[self.velocity_unit] * self.position
        turns = self.external_gear_ratio * (self.gear_ratio if self.velocity_at == "motor" else 1.0)
        return _RPM[self.velocity_unit] * 2.0 * math.pi / 60.0 / turns

    @property
    def torque(self) -> float | None:
        """Joint torque per count, Nm, without losses of the gears; None: unknown."""
        rated = self.rated_torque
        if rated is None and self.rated_current is not None and self.torque_constant is not None:
            rated = self.rated_current * self.torque_constant
        turns = self.external_gear_ratio * (self.gear_ratio if self.torque_at == "motor" else 1.0)
        return None if rated is None else PER_MILLE * rated * turns

    @property
    def max_speed(self) -> float | None:
        """Largest speed of the joint, rad/s; None: unknown."""
        rpm, turns = self.max_motor_speed, abs(self.external_gear_ratio * self.gear_ratio)
        return None if rpm is None else rpm * 2.0 * math.pi / 60.0 / turns

    def factor(self, quantity: str) -> float | None:
        """Return the factor of a quantity; None: unknown."""
        return {"position": self.position, "velocity": self.velocity, "torque": self.torque}[quantity]
