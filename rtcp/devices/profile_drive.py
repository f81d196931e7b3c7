"""A drive that makes the profiles of its motions itself: profile position (1), profile velocity (3) and homing (6).

Targets, limits and bits of the modes: CiA 402-2, clauses on profile position mode and profile velocity mode.
"""

from __future__ import annotations

from typing import Final

from rtcp.config.model import SlaveConfig
from rtcp.devices.cia402 import ENABLE_OPERATION, Cia402Drive
from rtcp.devices.drive import TargetState
from rtcp.devices.driver import integer_range
from rtcp.ipc.states import DriveState

PROFILE_POSITION: Final = 1
PROFILE_VELOCITY: Final = 3
"""Modes of operation (object 0x6060)."""
NEW_SETPOINT: Final = ENABLE_OPERATION | 0x30
"""Controlword that offers a set-point by the rising edge of bit 4; bit 5: it replaces the one under way."""
HALT: Final = ENABLE_OPERATION | 0x100
"""Controlword that ramps down and holds (0x605D), the drive stays enabled."""
TARGET_REACHED: Final = 0x0400
ACKNOWLEDGED: Final = 0x1000
"""Bits of the statusword: target reached; in profile position: the set-point was accepted."""


class ProfileDrive(Cia402Drive):
    """A drive in SI units, m or rad, whose `mode` is one of its own profiles; `controlword` is the caller's.

    `profile_velocity` (unit/s) is the speed of the next set-point. `target_velocity` (unit/s) is sent once the drive
    displays profile velocity; otherwise 0 is sent.

    Args:
        slave: the slave's name and description.
        period_s: the cycle, s.

    Raises:
        DeviceError: the description lacks a channel, or one has a type or a factor that cannot serve.
    """

    def __init__(self, slave: SlaveConfig, period_s: float) -> None:
        super().__init__(slave, period_s)
        self.profile_velocity = 0.0
        entry = self.rpdo.find("profile_velocity")
        self._profile_slot = -1 if entry is None else self.rpdo.channels.index(entry)
        self._profile_scale = 0.0 if entry is None else 1.0 / abs(entry.factor)
        self.least_profile_velocity = 0.0 if entry is None else abs(entry.factor)
        """Least speed of a set-point, one count of 0x6081, unit/s: at 0 drives stand, or take another speed."""
        self._profile_range = (0, 0) if entry is None else integer_range(entry)

    def advance(self, target: TargetState) -> bool:
        """Take the next step towards `target`; a drive is halted from the moment on in which it is enabled.

        It would otherwise continue to its set-point, which no cycle sends anew.
        """
        reached = super().advance(target)
        if self.controlword == ENABLE_OPERATION:
            self.controlword = HALT
        return reached

    def can_target(self, position: float) -> bool:
        """Return whether the drive's field can express a target position."""
        low, high = self._range
        return low <= (position + self._zero) * self._scale <= high

    def _fill(self, fields: list[int], word: int, commanded: int) -> None:
        """Fill in all outputs but the position."""
        super()._fill(fields, word, commanded)
        slot = self._profile_slot
        if slot >= 0:
            counts = self.profile_velocity * self._profile_scale
            fields[slot] = int(min(max(counts, 0.0), self._profile_range[1]))
        if commanded == PROFILE_VELOCITY == self.mode_display and self.state is DriveState.OPERATION_ENABLED:
            velocity = self._out[2]
            fields[velocity] = self._counts(self.target_velocity * self._scales[1], 1, fields[velocity])
