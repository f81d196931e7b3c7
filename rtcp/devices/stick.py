"""The joystick at the IO box: its six lines as a direction, a paddle, or no code at all (facts, "The joystick").

| byte | meaning | line pulled low |
|---|---|---|
| 63 | neutral | none |
| 62, 61 | forward, backward | 0, 1 |
| 59, 55 | left, right | 2, 3 |
| 47, 31 | paddle up, down | 4, 5 |

Two directions at once, as forward and left (58), are a code. Contradictory ones, both paddles, a paddle while the stick
is deflected, and anything else in the stick's byte are none.
"""

from __future__ import annotations

from rtcp.config.operation import InputsConfig

RESTLESS = 4
"""After so many times the debounce without rest the lines are no code."""


class Stick:
    """What the stick shows. `read` sets `forward`, `side` (left is +1) and `paddle` (-1, 0, 1), `code` and `valid`.

    Args:
        config: which inputs are the stick's, and which others have a meaning.
        cycle_s: how often `read` is called, s.
    """

    __slots__ = (
        "_byte_at", "_candidate", "_checked", "_debounce", "_inverted", "_lines", "_restless", "_stable", "code",
        "forward", "paddle", "side", "valid",
    )  # fmt: skip

    def __init__(self, config: InputsConfig, cycle_s: float) -> None:
        joystick = config.joystick
        self.forward = self.side = self.paddle = 0
        self.code = 0
        self.valid = False
        self._candidate = -1
        self._stable = self._restless = 0
        self._lines: tuple[int, ...] = ()
        self._checked = self._inverted = self._byte_at = self._debounce = 0
        if joystick is None:
            return
        numbers = (joystick.forward, joystick.backward, joystick.left, joystick.right, joystick.mode_up,
                   joystick.mode_down)  # fmt: skip
        self._lines = tuple(1 << number - 1 for number in numbers)
        self._inverted = sum(self._lines) if joystick.active == "low" else 0
        self._debounce = round(joystick.debounce_ms * 1e-3 / cycle_s)
        self._byte_at = (min(numbers) - 1) // 8 * 8
        others = (config.arm_toggle, config.enabling_switch, config.emergency_stop)
        meant = sum(1 << one.number - 1 for one in others if one is not None)
        bytes_used = {(number - 1) // 8 for number in numbers}
        self._checked = sum(0xFF << 8 * byte for byte in bytes_used) & ~meant

    def read(self, levels: int) -> None:
        """Take the levels of all inputs of a cycle; a change counts once it has lasted as long as configured."""
        if not self._lines:
            return
        seen = levels & self._checked
        if seen != self._candidate:
            self._candidate = seen
            self._stable = 0
        elif self._stable <= self._debounce:
            self._stable += 1
        if self._stable < self._debounce:
            self._restless += 1
            if self._restless > RESTLESS * self._debounce:
                # Lines that never come to rest, as at a loose contact: the last direction must not go on for ever.
                self.forward = self.side = self.paddle = 0
                self.valid = False
            return
        self._restless = 0
        self.code = seen >> self._byte_at & 0xFF
        active = seen ^ self._inverted
        forward, backward, left, right, up, down = (bool(active & line) for line in self._lines)
        rest = active
        for line in self._lines:
            rest &= ~line
        deflected = forward or backward or left or right
        self.valid = not (
            rest or (forward and backward) or (left and right) or (up and down) or (deflected and (up or down))
        )
        if self.valid:
            self.forward = forward - backward
            self.side = left - right
            self.paddle = up - down
        else:
            self.forward = self.side = self.paddle = 0
