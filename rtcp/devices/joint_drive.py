"""The drive of a joint behind a robot controller: the controller closes every loop, and people there give it power.

Its process image is that of `rtcp.config.buses`: `JOINT_OUTPUTS`, `JOINT_INPUTS`.
"""

from __future__ import annotations

from typing import Final

from rtcp.config.model import SlaveConfig
from rtcp.devices.drive import CSP, CSV, Drive, TargetState
from rtcp.ipc.states import DriveState, Missing

STAND, FOLLOW, STOP = 0, 1, 2
"""Commands to the bus: stand still, follow the targets, stop and forget what was accepted."""
_STATES: Final = tuple(DriveState)
_MISSING: Final = tuple(Missing)
_REACHED: Final = {
    TargetState.ENABLED: frozenset({DriveState.OPERATION_ENABLED}),
    TargetState.QUICK_STOPPED: frozenset(DriveState) - {DriveState.OPERATION_ENABLED},
}
_FOLLOWING: Final = frozenset({DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE})
_DISABLED: Final = frozenset(DriveState) - _FOLLOWING


class JointDrive(Drive):
    """A joint that follows position and speed references.

    The controller has torque as long as its motors are on, whatever is commanded here. `operation enabled` is shown
    only where the controller takes references and this side has commanded to follow them; without the command it is
    `switched on`, and the controller holds the joint. A quick stop is a ramp of the reference at `deceleration`.
    """

    REQUIRED_OUTPUTS = ("target_position", "target_velocity", "command")
    REQUIRED_INPUTS = ("position", "state", "missing")

    def __init__(self, slave: SlaveConfig, period_s: float, *, speed_limit: float = 0.0, zero: float = 0.0) -> None:
        super().__init__(slave, period_s, speed_limit=speed_limit, zero=zero)
        self._unpack, self._pack = self.codec_in.unpack, self.codec_out.pack
        self.command = STAND
        self.missing = Missing.CONNECTION
        self.mode_display = CSP
        self._ramping = False
        self._sent = 0.0
        """Last sent position reference, rad."""
        self._speed = 0.0
        """Last sent speed reference, rad/s."""
        self._has_velocity = self.tpdo.find("velocity") is not None
        self._encoded = 0
        """Calls of `encode` since the last `decode`: 1 in an answered cycle."""
        self._last = self._pack(0.0, 0.0, STAND)

    def supports(self, mode: int) -> bool:
        """Whether targets of a mode reach the joint: positions with their speed (CSP), and speeds (CSV)."""
        return mode in (CSP, CSV)

    def decode(self, data: bytes) -> None:
        """Decode the inputs of the cycle. Until the drive is enabled the target follows them."""
        values = self._unpack(data)
        bus_position, state, missing = values[:3]
        self.position = bus_position - self._zero
        self.velocity = values[3] if self._has_velocity else self._measured_velocity(bus_position)
        self._encoded = 0
        self.mode_display = self.mode
        self.missing = _MISSING[missing]
        drive_state = _STATES[state]
        if drive_state is not DriveState.OPERATION_ENABLED:
            # The controller stopped by itself or began a session: earlier references are void.
            self.command, self._ramping = STAND, False
        elif self.command != FOLLOW:
            drive_state = DriveState.SWITCHED_ON
        elif self._ramping:
            drive_state = DriveState.QUICK_STOP_ACTIVE
        self.state = drive_state
        if drive_state not in _FOLLOWING:
            # Includes a controller that does not follow yet: meanwhile it may move the joint.
            self.target_position = self._sent = self.position
            self._speed = 0.0

    def advance(self, target: TargetState) -> bool:
        """Take the next step towards `target` by the actual state; return whether it is reached.

        A joint that moves comes to rest by its ramp first, whatever else is commanded: there is no torque to remove.
        """
        if target is TargetState.ENABLED:
            if self.command != FOLLOW or self._ramping:
                self.latch()
                self._sent, self._speed = self.target_position, 0.0
            self.command, self._ramping = FOLLOW, False
        elif target is TargetState.QUICK_STOPPED or (self.command == FOLLOW and self._speed != 0.0):
            if self.command == FOLLOW and not self._ramping:
                # In lost cycles nothing was sent, and the controller continued at the last speed.
                lost_s = max(self._encoded - 1, 0) * self.period_s
                self._sent = self._within(self._sent + self._speed * lost_s)
                self._ramping = True
        else:
            self.command, self._ramping = STAND, False
        return self.state in _REACHED.get(target, _DISABLED)

    def encode(self) -> bytes:
        """Return the outputs of the cycle.

        With every position goes the speed that leads to it, so that the controller need not wait for a deviation before
        it moves: 0 where the target stands. CSV is the same here: the position loop is the controller's. A target that
        is no finite number leaves the last one. In a cycle without a message nothing is sent.
        """
        self._encoded += 1
        wanted = self.target_position
        if wanted - wanted != 0.0:
            wanted = self._sent
        speed = 0.0
        command = self.command
        if command == FOLLOW:
            if self._ramping:
                slower = max(abs(self._speed) - self.deceleration * self.period_s, 0.0)
                speed = slower if self._speed > 0.0 else -slower
                further = self._sent + speed * self.period_s
                wanted = self._within(further)
                if wanted != further:
                    speed = 0.0
                command = STOP
            elif self._encoded > 1:
                return self._last
            else:
                speed = (wanted - self._sent) / self.period_s
        bound = self.speed_limit
        if not -bound <= speed <= bound:
            speed = bound if speed > bound else -bound if speed < -bound else 0.0  # 0: not a number
        self._speed = speed
        self._sent = wanted
        self._last = self._pack(wanted + self._zero, speed, command)
        return self._last

    def _within(self, position: float) -> float:
        """Return a position inside the range, or at most as far outside as the last sent one, rad."""
        return min(max(position, min(self.low, self._sent)), max(self.high, self._sent))
