"""Modes of the joystick: tool direction of each deflection.

| mode | forward / backward | left / right |
|---|---|---|
| 0: X-Y | +x / -x | +y / -y |
| 1: Z-yaw | -z / +z | +rz / -rz |
| 2: roll-pitch | +rx / -rx | +ry / -ry |
| 3: gripper | open / close | - |
"""

from __future__ import annotations

from typing import Final, Protocol

from rtcp.config.model import JogConfig

GRIPPER: Final = 3
MODES: Final = 4
# (direction 0 to 5, sign) of forward and of left, in the modes that move the tool.
_DIRECTIONS = (((0, 1.0), (1, 1.0)), ((2, -1.0), (5, 1.0)), ((3, 1.0), (4, 1.0)))


class Shown(Protocol):
    """State of the joystick; see `rtcp.devices.io_box`."""

    forward: float
    side: float
    paddle: int
    valid: bool


class Joystick:
    """Converts the joystick's state to a tool velocity, or to opening and closing of the gripper.

    `twist`: vx, vy, vz (m/s), wx, wy, wz (rad/s) along `frame`; `moves`: whether it is not 0; `grip`: True to open,
    False to close, in the cycle of the deflection, else None; `mode` as in the table.

    A joystick that is deflected when it becomes active (at the start, after a mode change, when it gets the arm back,
    after an invalid code) is ignored until it has been neutral.
    """

    def __init__(self, config: JogConfig) -> None:
        self._speeds = (config.speed,) * 3 + (config.angular_speed,) * 3
        self.frame = config.frame
        self.mode = 0
        self.twist = [0.0] * 6
        self.moves = False
        self.grip: bool | None = None
        self._neutral_seen = False
        self._paddle = 0
        self._gripped = 0

    @property
    def holds_grip(self) -> bool:
        """True while the joystick is deflected to open or close the gripper."""
        return self._gripped != 0

    def begin(self) -> None:
        """Begin with the first mode, X-Y, once the joystick has been neutral."""
        self.mode = 0
        self.wait_for_neutral()

    def wait_for_neutral(self) -> None:
        """Ignore the joystick until it has been neutral."""
        self._neutral_seen = False
        self._paddle = 0
        self._clear()

    def _clear(self) -> None:
        for i in range(6):
            self.twist[i] = 0.0
        self.moves = False
        self.grip = None
        self._gripped = 0

    def update(self, joystick: Shown, counts: bool) -> None:
        """Update from this cycle's state; `counts`: the joystick commands the arm and motion is permitted."""
        if not (counts and joystick.valid):
            self.wait_for_neutral()
            return
        if self._paddle and not joystick.paddle:
            # Releasing the paddle changes the mode; the joystick must then be neutral once.
            self.mode = (self.mode + self._paddle) % MODES
            self.wait_for_neutral()
        if not (joystick.forward or joystick.side or joystick.paddle):
            self._neutral_seen = True
            self._clear()
            return
        if not self._neutral_seen:
            return
        self._paddle = joystick.paddle
        if joystick.paddle:
            self._clear()
        elif self.mode == GRIPPER:
            direction = (joystick.forward > 0) - (joystick.forward < 0)
            self.grip = direction > 0 if direction not in (0, self._gripped) else None
            self._gripped = direction
        else:
            (along, sign), (across, side_sign) = _DIRECTIONS[self.mode]
            for i in range(6):
                self.twist[i] = 0.0
            self.twist[along] = sign * joystick.forward * self._speeds[along]
            self.twist[across] = side_sign * joystick.side * self._speeds[across]
            self.moves = True
