"""The measurements of the drives, checked before anything uses them.

A sample is false if the joint cannot have come there since the last accepted sample. A false sample is not used: the
position continues at the joint's velocity, and a velocity, a torque or a mode display stays as it was. After
`supervision.cycles` false samples in a row the next one is accepted. A false position or velocity is then a fault, and
so is a mode that nobody commanded; a torque can really change that fast.
"""

from __future__ import annotations

from typing import Final

from rtcp.config.model import ArmConfig
from rtcp.devices.drive import CSP, Drive
from rtcp.ipc.events import DriveModeTimeout, FaultEvent, PositionJumped, VelocityJumped
from rtcp.ipc.states import DriveMode, DriveState

_NOISE: Final = 0.05
"""Part of a joint's speed limit by which two velocities may differ without any acceleration."""
_TORQUE_STEP: Final = 0.15
"""Part of the limit of a measured torque by which the torque may change between two samples."""
_LONG_S: Final = 1e3
"""Time since the last sample before the first one, s: every first sample is possible."""


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
        self._fastest = [bounds.speed * joint.velocity for joint in joints]
        self._rates = [bounds.acceleration * joint.acceleration for joint in joints]
        self._noise = [_NOISE * joint.velocity for joint in joints]
        self._torque_steps = [_TORQUE_STEP * bounds.torque * joint.torque for joint in joints]
        self._positions, self._velocities, self._torques, self._modes = [0] * n, [0] * n, [0] * n, [0] * n
        """Consecutive false samples of each joint."""
        self._position_s, self._velocity_s = [0.0] * n, [0.0] * n
        """Time from the last accepted sample of each joint to the last sample, s."""
        self._shown, self._new = [0] * n, [0] * n
        """Last accepted mode display of each joint, and the one of its last sample."""
        self._now_ns = 0
        self._elapsed_s = 0.0
        self.event: FaultEvent | None = None
        """Fault of this cycle."""

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
            self._shown[i] = drive.mode_display
            return
        elapsed_s, found = self._elapsed_s, drive.velocity
        since_s = elapsed_s + self._velocity_s[i]
        bound = self._rates[i] * since_s + self._noise[i]
        # A comparison with NaN is false: NaN is not used either.
        if -bound <= found - velocity <= bound:
            self._velocities[i], self._velocity_s[i] = 0, 0.0
        elif self._accepts(self._velocities, i):
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
        if -bound <= drive.torque - torque <= bound or self._accepts(self._torques, i):
            self._torques[i] = 0
        else:
            drive.torque = torque
        self._check_mode(i, drive)

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
