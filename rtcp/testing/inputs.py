"""Contacts and joystick of a simulated arm."""

from __future__ import annotations

from rtcp.config.model import InputConfig
from rtcp.testing.simulation import Simulation


class Inputs:
    """The inputs with a function on the simulated IO box; without such a box, or such an input, nothing happens.

    At first they let the arm move: the emergency stop released, the enabling switch pressed, the joystick at rest.
    """

    def __init__(self, simulation: Simulation) -> None:
        inputs = simulation.config.inputs
        self._box = simulation.box
        self._config = inputs
        joystick = inputs.joystick
        pins = () if joystick is None else (joystick.forward, joystick.backward, joystick.left, joystick.right,
                                            joystick.mode_up, joystick.mode_down)  # fmt: skip
        self._joystick = [1 << number - 1 for number in pins]
        self._active_low = joystick is not None and joystick.active == "low"
        self.joystick(0)
        for contact in (inputs.emergency_stop, inputs.arm_toggle, inputs.enabling_switch):
            self.set(contact, contact is not inputs.emergency_stop)

    @property
    def present(self) -> bool:
        """Whether there is a box with inputs."""
        return self._box is not None

    def set(self, contact: InputConfig | None, active: bool) -> None:
        """Set the level of an input."""
        if self._box is not None and contact is not None:
            self._level(1 << contact.number - 1, active is (contact.active == "high"))

    def joystick(self, pressed: int) -> None:
        """Press the directions and paddles whose bits are set: bit 0 is forward."""
        if self._box is not None:
            for at, bit in enumerate(self._joystick):
                self._level(bit, bool(pressed >> at & 1) is not self._active_low)

    def _level(self, bit: int, high: bool) -> None:
        box = self._box
        if box is not None:
            box.inputs = box.inputs | bit if high else box.inputs & ~bit
