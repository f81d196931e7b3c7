"""The joystick's modes: which direction of the tool each deflection is.

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
    """What the joystick shows; see `rtcp.devices.io_box`."""

    forward: int
    side: int
    paddle: int
    valid: bool


class Joystick:
    """Turns what the joystick shows into a tool velocity, or into the gripper's opening.

    `twist`: vx, vy, vz (m/s), wx, wy, wz (rad/s) along `frame`; `moves`: whether it is one; `grip`: True to open, False
    to close, in the cycle in which the joystick asks for it, else None; `mode` as in the table.

    A joystick that is deflected when it begins to count (at the start, after a mode change, when it is given back,
    after an invalid code) counts only after it has been neutral.
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
        """Whether the joystick is held where it opens or closes the gripper."""
        return self._gripped != 0

    def wait_for_neutral(self) -> None:
        """Count only after the joystick has been neutral."""
        self._neutral_seen = False
        self._paddle = 0
        self._rest()

    def _rest(self) -> None:
        for i in range(6):
            self.twist[i] = 0.0
        self.moves = False
        self.grip = None
        self._gripped = 0

    def update(self, shown: Shown, counts: bool) -> None:
        """Update from what the joystick shows in this cycle; `counts`: the arm has it, and motion is permitted."""
        if not (counts and shown.valid):
            self.wait_for_neutral()
            return
        if self._paddle and not shown.paddle:
            # When the paddle is released the mode changes, and the joystick has to be neutral once.
            self.mode = (self.mode + self._paddle) % MODES
            self.wait_for_neutral()
        if not (shown.forward or shown.side or shown.paddle):
            self._neutral_seen = True
            self._rest()
            return
        if not self._neutral_seen:
            return
        self._paddle = shown.paddle
        if shown.paddle:
            self._rest()
        elif self.mode == GRIPPER:
            self.grip = shown.forward > 0 if shown.forward and shown.forward != self._gripped else None
            self._gripped = shown.forward
        else:
            (along, sign), (across, other) = _DIRECTIONS[self.mode]
            for i in range(6):
                self.twist[i] = 0.0
            self.twist[along] = sign * shown.forward * self._speeds[along]
            self.twist[across] = other * shown.side * self._speeds[across]
            self.moves = True
