"""The stick's modes: which direction of the tool each deflection is (facts, "The joystick").

| mode | forward / backward | left / right |
|---|---|---|
| 0: X-Y | +x / -x | +y / -y |
| 1: Z-yaw | -z / +z | +rz / -rz |
| 2: roll-pitch | +rx / -rx | +ry / -ry |
| 3: gripper | open / close | - |
"""

from __future__ import annotations

from typing import Protocol

from rtcp.config.model import JogConfig

GRIPPER = 3
MODES = 4
# (direction 0 to 5, sign) of forward and of left, in the modes that move the tool.
_DIRECTIONS = (((0, 1.0), (1, 1.0)), ((2, -1.0), (5, 1.0)), ((3, 1.0), (4, 1.0)))


class Shown(Protocol):
    """What the stick shows; see `rtcp.devices.io_box`."""

    forward: int
    side: int
    paddle: int
    valid: bool


class Joystick:
    """Turns what the stick shows into a tool velocity, or into the gripper's opening.

    `twist`: vx, vy, vz (m/s), wx, wy, wz (rad/s) along `frame`; `moves`: whether it is one; `grip`: True to open, False
    to close, in the cycle in which the stick asks for it, else None; `mode` as in the table.

    A stick that is deflected when it begins to count (at the start, after a mode change, when it is given back, after
    what was no code) counts only after it has been neutral.
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
        """Whether the stick is held where it opens or closes the gripper."""
        return self._gripped != 0

    def wait_for_neutral(self) -> None:
        """Count only after the stick has been neutral."""
        self._neutral_seen = False
        self._paddle = 0
        self._rest()

    def _rest(self) -> None:
        for i in range(6):
            self.twist[i] = 0.0
        self.moves = False
        self.grip = None
        self._gripped = 0

    def update(self, stick: Shown, counts: bool) -> None:
        """Take what the stick shows in this cycle; `counts`: the arm has it, and motion is permitted."""
        if not (counts and stick.valid):
            self.wait_for_neutral()
            return
        if self._paddle and not stick.paddle:
            # When the paddle is released the mode changes, and the stick has to be neutral once.
            self.mode = (self.mode + self._paddle) % MODES
            self.wait_for_neutral()
        if not (stick.forward or stick.side or stick.paddle):
            self._neutral_seen = True
            self._rest()
            return
        if not self._neutral_seen:
            return
        self._paddle = stick.paddle
        if stick.paddle:
            self._rest()
        elif self.mode == GRIPPER:
            self.grip = stick.forward > 0 if stick.forward and stick.forward != self._gripped else None
            self._gripped = stick.forward
        else:
            (along, sign), (across, other) = _DIRECTIONS[self.mode]
            for i in range(6):
                self.twist[i] = 0.0
            self.twist[along] = sign * stick.forward * self._speeds[along]
            self.twist[across] = other * stick.side * self._speeds[across]
            self.moves = True
