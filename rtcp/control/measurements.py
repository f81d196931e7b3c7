"""The measurements of the drives, checked before anything uses them.

A sample is false if the joint cannot have come there since the last accepted sample. A false sample is not used: the
position continues at the joint's velocity, and a velocity, a torque or a mode display stays as it was. After
`supervision.cycles` false samples in a row the next one is accepted. A false position or velocity is then a fault, and
so is a mode that nobody commanded; a torque can really change that fast, up to what the drive gives. A velocity that
the positions contradict is not used either, but is no fault: it may be noise.

A value that is stuck or scaled wrongly is possible from sample to sample. It shows in the sum: the way that the speeds
make and that of the positions differ more and more.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Final

from rtcp.config.model import ArmConfig
from rtcp.devices.drive import CSP, Drive
from rtcp.ipc.events import DriveModeTimeout, FaultEvent, PositionJumped, VelocityDisagrees, VelocityJumped
from rtcp.ipc.states import DriveMode, DriveState
from rtcp.motion.limits import Limits

_NOISE: Final = 0.05
"""Part of a joint's speed limit by which two velocities may differ without any acceleration."""
_TORQUE_STEP, _TORQUE_FACTOR = 0.15, 1.5
"""Part of the limit of a measured torque by which the torque may change between two samples; the limit counts as at
least so many times that of the joint, because a peak that is cut short is not seen."""
_MOST_TORQUE: Final = 1.5
"""Largest torque that a drive may show, multiple of the largest that it gives."""
_LONG_S: Final = 1e3
"""Time since the last sample before the first one, s: every first sample is possible."""
_COMPARED_S: Final = 0.1
"""Time constant with which earlier differences of positions and speeds are forgotten, s."""
_GAP_S, _GAP_CYCLES = 0.02, 2.5
"""Longest time between two samples that are compared, s, and in cycles where those are longer: in a longer one the
speed may have changed unseen."""


class Measurements:
    """Checks the samples of all joints of a group: `begin`, then `check` for each joint, once per answered cycle.

    Args:
        config: configuration with the `joints` of the group.
        first: axis number of the first joint.
    """

    def __init__(self, config: ArmConfig, first: int) -> None:
        bounds, joints, n = config.supervision, config.joints, len(config.joints)
        self._first = first
        self._cycles = bounds.cycles
        self._tolerance = bounds.position_tolerance
        self._bounds, self._speeds = bounds, [joint.velocity for joint in joints]
        self._fastest, self._noise, self._most_gap = [0.0] * n, [0.0] * n, [0.0] * n
        self._scale(bounds.speed, self._speeds)
        self._rates = [bounds.acceleration * joint.acceleration for joint in joints]
        self._torque_steps = [_TORQUE_STEP * max(bounds.torque, _TORQUE_FACTOR) * joint.torque for joint in joints]
        self._most_torque = [_MOST_TORQUE * (joint.drive_torque or inf) for joint in joints]
        self._positions, self._velocities, self._torques, self._modes = [0] * n, [0] * n, [0] * n, [0] * n
        """Consecutive false samples of each joint."""
        self._position_s, self._velocity_s = [0.0] * n, [0.0] * n
        """Time from the last accepted sample of each joint to the last sample, s."""
        self._gaps = [0.0] * n
        """Way that the speeds of each joint have made more than its positions, rad."""
        self._shown, self._new = [0] * n, [0] * n
        """Last accepted mode display of each joint, and the one of its last sample."""
        self._longest_gap_s = max(_GAP_S, _GAP_CYCLES * config.cycle.period_us * 1e-6)
        self._now_ns = 0
        self._elapsed_s = 0.0
        self.event: FaultEvent | None = None
        """Fault of this cycle."""

    def take(self, limits: Limits) -> None:
        """Allow for speed limits and thresholds that were widened; narrower ones make no measurement false."""
        speeds = [max(configured, now) for configured, now in zip(self._speeds, limits.velocity, strict=True)]
        self._scale(max(self._bounds.speed, limits.supervision[0]), speeds)

    def _scale(self, factor: float, speeds: Sequence[float]) -> None:
        """Set what follows from the speed limits, rad/s, and the factor of the measured speed."""
        for i, speed in enumerate(speeds):
            self._fastest[i] = factor * speed
            self._noise[i] = _NOISE * speed
            self._most_gap[i] = self._bounds.velocity_gap * speed * _COMPARED_S

    def begin(self, now_ns: int) -> None:
        """Begin a cycle at an instant of the loop's clock."""
        self._elapsed_s = (now_ns - self._now_ns) * 1e-9 if self._now_ns else _LONG_S
        self._now_ns = now_ns
        self.event = None

    def check(self, i: int, drive: Drive, position: float, velocity: float, torque: float) -> None:
        """Replace the false samples of `drive`, which has decoded this cycle's.

        Args:
            i: joint, counted within the group.
            drive: its drive.
            position: accepted in the last cycle, rad.
            velocity: accepted in the last cycle, rad/s.
            torque: accepted in the last cycle, Nm.
        """
        if drive.mode < CSP:
            # While it homes, the drive begins to count from another zero.
            self._shown[i], self._gaps[i] = drive.mode_display, 0.0
            return
        elapsed_s, found = self._elapsed_s, drive.velocity
        since_s = elapsed_s + self._velocity_s[i]
        bound = self._rates[i] * since_s + self._noise[i]
        # A comparison with NaN is false: NaN is not used either.
        possible = -bound <= found - velocity <= bound
        if possible and self._is_likely(i, drive, position, velocity):
            self._velocities[i], self._velocity_s[i] = 0, 0.0
        elif not possible and self._accepts(self._velocities, i):
            self._velocity_s[i] = 0.0
            self.event = VelocityJumped(self._first + i, found, velocity, bound)
        else:
            self._velocity_s[i] = since_s
            drive.velocity = velocity
        found = drive.position
        since_s = elapsed_s + self._position_s[i]
        bound = self._fastest[i] * since_s + self._tolerance
        if -bound <= found - position <= bound:
            self._positions[i], self._position_s[i] = 0, 0.0
        elif self._accepts(self._positions, i):
            self._position_s[i] = 0.0
            self.event = PositionJumped(self._first + i, found, position, bound)
        else:
            self._position_s[i] = since_s
            drive.replace_position(position + drive.velocity * elapsed_s)
        bound = self._torque_steps[i]
        most = self._most_torque[i]
        if -most <= drive.torque <= most and (
            -bound <= drive.torque - torque <= bound or self._accepts(self._torques, i)
        ):
            self._torques[i] = 0
        else:
            drive.torque = torque
        self._check_mode(i, drive)
        if elapsed_s > self._longest_gap_s or self.event is not None or not drive.measures_velocity:
            self._gaps[i] = 0.0
            return
        # A velocity in coarse counts is cut by up to one of them.
        most = self._most_gap[i] + drive.velocity_resolution * _COMPARED_S
        gap = self._gaps[i] * (1.0 - elapsed_s / _COMPARED_S)
        gap += 0.5 * (velocity + drive.velocity) * elapsed_s - (drive.position - position)
        if not -most <= gap <= most:
            self.event = VelocityDisagrees(self._first + i, drive.velocity, abs(gap), most)
            gap = 0.0
        self._gaps[i] = gap

    def _is_likely(self, i: int, drive: Drive, position: float, velocity: float) -> bool:
        """Return whether a new velocity lies between the last one and what the positions show.

        They show it as far as they resolve it. A drive that filters its velocity follows them.
        """
        found, noise = drive.velocity, self._noise[i]
        if -noise <= found - velocity <= noise or drive.resolution == 0.0 or not drive.measures_velocity:
            return True
        shown = (drive.position - position) / self._elapsed_s
        unsure = drive.resolution / self._elapsed_s + 0.5 * self._rates[i] * self._elapsed_s
        return min(shown, velocity) - unsure <= found <= max(shown, velocity) + unsure

    def _check_mode(self, i: int, drive: Drive) -> None:
        """A mode counts as shown after as many equal samples; a drive that leaves its mode uncommanded is a fault."""
        shown, accepted = drive.mode_display, self._shown[i]
        if shown == accepted:
            self._modes[i] = 0
            return
        if drive.state is DriveState.OPERATION_ENABLED:
            if shown != self._new[i]:
                self._new[i], self._modes[i] = shown, 0
            if not self._accepts(self._modes, i):
                drive.mode_display = accepted
                return
            if accepted == drive.mode:
                self.event = DriveModeTimeout(self._first + i, shown, DriveMode(accepted))
        self._shown[i], self._modes[i] = shown, 0

    def _accepts(self, counts: list[int], i: int) -> bool:
        """Count a false sample; return whether it is accepted."""
        counts[i] += 1
        if counts[i] < self._cycles:
            return False
        counts[i] = 0
        return True
