"""Drive writers: targets of a drive in each cyclic synchronous mode (CiA 402: CSP, CSV, CST).

In CSP the drive closes the position loop; for CSV and CST it is closed here, so that `hold` and `move` mean the same
in all three.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp
from typing import Final, Protocol

from rtcp.config.model import Joint
from rtcp.ipc.states import DriveMode

_FADE_S: Final = 0.3
"""Time constant of the transition from the drive's own following error to the position loop closed here."""


class Commanded(Protocol):
    """The part of a drive that a writer reads and writes, in SI units."""

    position: float
    velocity: float
    torque: float
    target_position: float
    target_velocity: float
    target_torque: float


class DriveWriter(Protocol):
    """Writer of one drive mode for all joints."""

    mode: DriveMode

    def start(self, drives: Sequence[Commanded]) -> None:
        """Reset, at standstill."""

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write the targets of the drives for the setpoints `position` (rad) and `velocity` (rad/s)."""


class CspWriter:
    """CSP: writes the setpoint itself."""

    mode = DriveMode.CSP

    def start(self, drives: Sequence[Commanded]) -> None:
        """No state to reset."""

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write the positions; drives with a velocity field use it as their speed limit, which the driver fills in."""
        for i, drive in enumerate(drives):
            drive.target_position = position[i]
            drive.target_velocity = 0.0
            drive.target_torque = 0.0


class CsvWriter:
    """CSV: velocity of the setpoint plus a proportional correction to its position."""

    mode = DriveMode.CSV

    def __init__(self, joints: Sequence[Joint], period_s: float) -> None:
        self._gain = [joint.csv_gain for joint in joints]
        self._keep = exp(-period_s / _FADE_S)
        self._bias = [0.0] * len(self._gain)

    def start(self, drives: Sequence[Commanded]) -> None:
        """Start without a correction: the present following error is removed gradually."""
        for i, drive in enumerate(drives):
            self._bias[i] = drive.target_position - drive.position

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write target velocities (rad/s)."""
        gain, bias, keep = self._gain, self._bias, self._keep
        for i, drive in enumerate(drives):
            bias[i] *= keep
            drive.target_position = position[i]
            drive.target_velocity = velocity[i] + gain[i] * (position[i] - drive.position - bias[i])
            drive.target_torque = 0.0


class CstWriter:
    """CST: stiffness, damping and a bounded integral about the setpoint (an impedance without a steady-state error)."""

    mode = DriveMode.CST

    def __init__(self, joints: Sequence[Joint], period_s: float) -> None:
        self._stiffness = [joint.cst_stiffness for joint in joints]
        self._damping = [joint.cst_damping for joint in joints]
        self._integral_step = [joint.cst_integral * period_s for joint in joints]
        self._bound = [joint.torque for joint in joints]
        self._integral = [0.0] * len(self._bound)
        self._passed = False

    def start(self, drives: Sequence[Commanded]) -> None:
        """Start with the present holding torque, so that the arm does not sag."""
        self._passed = False
        for i, drive in enumerate(drives):
            bound = self._bound[i]
            self._integral[i] = min(max(drive.torque, -bound), bound)

    def pass_on(self, position: Sequence[float], torque: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write `torque` (Nm) itself, without a position loop; `position` (rad) is the actual position.

        `update` takes over without a step, from any setpoint.
        """
        integral = self._integral
        self._passed = True
        for i, drive in enumerate(drives):
            bound, wanted = self._bound[i], torque[i]
            integral[i] = bounded = bound if wanted > bound else -bound if wanted < -bound else wanted
            drive.target_position = position[i]
            drive.target_velocity = 0.0
            drive.target_torque = bounded

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write target torques (Nm)."""
        integral = self._integral
        for i, drive in enumerate(drives):
            error = position[i] - drive.position
            bound = self._bound[i]
            if self._passed:
                integral[i] -= self._stiffness[i] * error + self._damping[i] * (velocity[i] - drive.velocity)
            summed = integral[i] + self._integral_step[i] * error
            integral[i] = summed = bound if summed > bound else -bound if summed < -bound else summed
            drive.target_position = position[i]
            drive.target_velocity = 0.0
            drive.target_torque = (
                self._stiffness[i] * error + self._damping[i] * (velocity[i] - drive.velocity) + summed
            )
        self._passed = False
