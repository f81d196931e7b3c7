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
from rtcp.motion.guards.braking import fastest_stoppable

_FADE_S: Final = 0.3
"""Time constant of the transition from the drive's own following error to the position loop closed here."""

_PASSED_S: Final = 0.03
"""Time constant of the transition from a passed torque to the position loop, s."""
_RISE_S: Final = 0.02
"""Shortest time in which a target torque changes by the joint's torque limit, s: what lost frames have hidden, and a
false speed that is possible, changes the torque without a jerk."""
_CSP: Final = int(DriveMode.CSP)
_SLOW_RAD_S: Final = 0.05
"""Speed, rad/s, at which a joint that would come to rest outside its range is led to the edge."""


class Commanded(Protocol):
    """The part of a drive that a writer reads and writes, in SI units."""

    position: float
    velocity: float
    mode_display: int
    target_position: float
    target_velocity: float
    target_torque: float


class DriveWriter(Protocol):
    """Writer of one drive mode for all joints."""

    mode: DriveMode

    def start(self, drives: Sequence[Commanded], torque: Sequence[float]) -> None:
        """Reset, at standstill."""

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write the targets of the drives for the setpoints `position` (rad) and `velocity` (rad/s)."""


class CspWriter:
    """CSP: writes the setpoint itself.

    After CST, in which a hand can move a joint, the targets begin where the joints are and at their velocities. They
    brake to the setpoints at the joints' acceleration.

    Args:
        joints: the joints.
        period_s: cycle time, s.
    """

    mode = DriveMode.CSP

    def __init__(self, joints: Sequence[Joint], period_s: float) -> None:
        self._period_s = period_s
        self._change = [0.0] * len(joints)
        """Largest change of the pace in a cycle, rad/s."""
        self._slow = [min(_SLOW_RAD_S, joint.velocity) for joint in joints]
        self._away = [0.0] * len(joints)
        """Distance of each target from its setpoint, rad."""
        self._pace = [0.0] * len(joints)
        self.is_braking = False
        """Whether a target is not at its setpoint yet."""

    def start(self, drives: Sequence[Commanded], torque: Sequence[float]) -> None:
        """Start at the setpoints."""
        self.is_braking = False

    def take_over(
        self, position: Sequence[float], speeds: Sequence[float], rates: Sequence[float], drives: Sequence[Commanded]
    ) -> None:
        """Start at the drives' targets with `speeds`, rad/s, and brake to `position`, rad, by `rates`, rad/s^2."""
        self.is_braking = True
        for i, drive in enumerate(drives):
            self._away[i] = drive.target_position - position[i]
            self._pace[i] = speeds[i]
            self._change[i] = rates[i] * self._period_s

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write the positions; drives with a velocity field use it as their speed limit, which the driver fills in."""
        if self.is_braking:
            self._brake()
        braking, away = self.is_braking, self._away
        for i, drive in enumerate(drives):
            drive.target_position = position[i] + away[i] if braking else position[i]
            drive.target_velocity = 0.0
            drive.target_torque = 0.0

    def _brake(self) -> None:
        away, pace, dt = self._away, self._pace, self._period_s
        self.is_braking = False
        for i, change in enumerate(self._change):
            distance, speed = away[i], pace[i]
            if abs(distance) <= change * dt and abs(speed) <= change:
                away[i] = pace[i] = 0.0
                continue
            self.is_braking = True
            slow = min(self._slow[i], fastest_stoppable(abs(distance), change, dt))
            wanted = -slow if distance > 0.0 else slow
            speed = min(max(wanted, speed - change), speed + change)
            pace[i] = speed
            away[i] = distance + speed * dt


class CsvWriter:
    """CSV: velocity of the setpoint plus a proportional correction to its position."""

    mode = DriveMode.CSV

    def __init__(self, joints: Sequence[Joint], period_s: float) -> None:
        self._gain = [joint.csv_gain for joint in joints]
        self._keep = exp(-period_s / _FADE_S)
        self._bias = [0.0] * len(self._gain)

    def start(self, drives: Sequence[Commanded], torque: Sequence[float]) -> None:
        """Start without a correction: the present following error is removed gradually."""
        for i, drive in enumerate(drives):
            self._bias[i] = drive.target_position - drive.position

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write target velocities (rad/s)."""
        gain, bias, keep = self._gain, self._bias, self._keep
        for i, drive in enumerate(drives):
            bias[i] *= keep
            drive.target_position = position[i]
            speed = velocity[i] + gain[i] * (position[i] - drive.position - bias[i])
            # A drive that still shows CSP is sent no velocity: the first one begins at 0 too.
            drive.target_velocity = 0.0 if drive.mode_display == _CSP else speed
            drive.target_torque = 0.0


class CstWriter:
    """CST: stiffness, damping and a bounded integral about the setpoint (an impedance without a steady-state error).

    Args:
        joints: the joints.
        period_s: the cycle, s.
        limits: torque limits in force, Nm: a list that is changed in place.
    """

    mode = DriveMode.CST

    def __init__(self, joints: Sequence[Joint], period_s: float, limits: Sequence[float]) -> None:
        self._stiffness = [joint.cst_stiffness for joint in joints]
        self._damping = [joint.cst_damping for joint in joints]
        self._integral_step = [joint.cst_integral * period_s for joint in joints]
        self._bound = limits
        self._rise = period_s / _RISE_S
        self._integral = [0.0] * len(limits)
        self._fade = exp(-period_s / _PASSED_S)
        self._excess = [0.0] * len(limits)
        """Rest of the last passed torque beyond the weight and the position loop, Nm."""
        self._passed = False

    def start(self, drives: Sequence[Commanded], torque: Sequence[float]) -> None:
        """Start with the present holding torque, so that the arm does not sag.

        `update` continues it without a step also where a joint is away from its setpoint, as in CSV.
        """
        self._passed = True
        for i, drive in enumerate(drives):
            bound = self._bound[i]
            self._integral[i] = drive.target_torque = min(max(torque[i], -bound), bound)

    def pass_on(
        self,
        position: Sequence[float],
        torque: Sequence[float],
        weight: Sequence[float],
        drives: Sequence[Commanded],
    ) -> None:
        """Write `torque` (Nm) itself, without a position loop; `position` (rad) is the actual position.

        `update` takes over without a step, from any setpoint. Of the torque only `weight` (Nm), which holds the arm
        still, stays: the rest would push the arm on against the loop.
        """
        integral = self._integral
        self._passed = True
        for i, drive in enumerate(drives):
            bound, held = self._bound[i], weight[i]
            integral[i] = bound if held > bound else -bound if held < -bound else held
            drive.target_position = position[i]
            drive.target_velocity = 0.0
            self._approach(i, drive, torque[i])

    def update(self, position: Sequence[float], velocity: Sequence[float], drives: Sequence[Commanded]) -> None:
        """Write target torques (Nm)."""
        integral, excess, fade = self._integral, self._excess, self._fade
        for i, drive in enumerate(drives):
            error = position[i] - drive.position
            bound = self._bound[i]
            loop = self._stiffness[i] * error + self._damping[i] * (velocity[i] - drive.velocity)
            excess[i] = drive.target_torque - integral[i] - loop if self._passed else excess[i] * fade
            summed = integral[i] + self._integral_step[i] * error
            integral[i] = summed = bound if summed > bound else -bound if summed < -bound else summed
            drive.target_position = position[i]
            drive.target_velocity = 0.0
            self._approach(i, drive, loop + summed + excess[i])
        self._passed = False

    def _approach(self, i: int, drive: Commanded, torque: float) -> None:
        """Let the target torque approach `torque`, Nm, as fast as it may, inside the joint's bound."""
        before, bound = drive.target_torque, self._bound[i]
        change = bound * self._rise
        torque = bound if torque > bound else -bound if torque < -bound else torque
        drive.target_torque = min(max(torque, before - change), before + change)
