"""The operator's panel and the safety chain of the controller: mode, enabling device, Motors On, stops."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rtcp.virtual.request_socket import RequestRefused


class Mode(Enum):
    """Operating mode."""

    HAND = "hand"
    AUTO = "auto"


class Enabling(Enum):
    """Position of the three-position enabling device; only the middle one enables."""

    RELEASED = "released"
    MIDDLE = "middle"
    THROUGH = "through"


class Stop(Enum):
    """Circuits that stop the robot when they open."""

    EMERGENCY = "emergency"
    AUTOMATIC = "automatic"
    GENERAL = "general"
    SUPERIOR = "superior"


class Motors(Enum):
    """State of the motors."""

    OFF = "off"
    STOPPING = "stopping"
    """Motors on, during a stop of category 1 (IEC 60204-1, 9.2.2)."""
    ON = "on"


@dataclass(frozen=True)
class StopRule:
    """Modes in which a stop is active, and its category (IEC 60204-1, 9.2.2)."""

    modes: tuple[Mode, ...]
    category: int


_ALWAYS = (Mode.HAND, Mode.AUTO)
STOPS = {
    Stop.EMERGENCY: StopRule(_ALWAYS, 0),
    Stop.AUTOMATIC: StopRule((Mode.AUTO,), 1),
    Stop.GENERAL: StopRule(_ALWAYS, 1),
    Stop.SUPERIOR: StopRule(_ALWAYS, 1),
}
"""From ABB, Product manual IRB 2600. The emergency stop's category is configurable."""
STOPPING_TIME_S = {0: 0.15, 1: 0.4}
"""Time from full speed to rest by category, s (assumed; some tenths of a second for a loaded IRB 120)."""


class PanelRefused(RequestRefused):
    """The panel refuses the action; the message is a sentence."""


class Panel:
    """Level inputs and edges of the safety chain. Every stop is latched until a reset edge."""

    def __init__(self, mode: Mode, emergency_category: int) -> None:
        self.mode = mode
        self.enabling = Enabling.RELEASED
        self.motors = Motors.OFF
        self.category = 1
        """Category of the last stop."""
        self.latched = False
        """True: a stop requires Motors On."""
        self.open: set[Stop] = set()
        self._categories = {stop: rule.category for stop, rule in STOPS.items()} | {Stop.EMERGENCY: emergency_category}
        self._stopping_s = 0.0

    def advance(self, dt: float) -> None:
        """Advance by `dt` seconds: a stop of category 1 ends with motors off."""
        if self.motors is Motors.STOPPING:
            self._stopping_s += dt
            if self._stopping_s >= STOPPING_TIME_S[1]:
                self.motors = Motors.OFF

    def open_circuit(self, stop: Stop) -> None:
        """Open a stop's circuit; it has an effect if active in this mode."""
        self.open.add(stop)
        if self.mode in STOPS[stop].modes:
            self.latched = True
            self._stop(self._categories[stop])

    def close_circuit(self, stop: Stop) -> None:
        """Close a circuit, or release the button; this starts nothing."""
        self.open.discard(stop)

    def select_mode(self, mode: Mode) -> None:
        """Turn the key: motors go off; this starts nothing."""
        if mode is not self.mode:
            self.mode = mode
            self._stop(1)

    def hold_enabling(self, position: Enabling) -> None:
        """Move the enabling device: in Hand its middle position keeps motors on; after a full press, release it."""
        pressed = position is Enabling.MIDDLE and self.enabling is Enabling.RELEASED
        self.enabling = position
        if self.mode is not Mode.HAND:
            return
        if position is not Enabling.MIDDLE:
            self._stop(1)
        elif pressed and not self.latched and not self._active():
            self.motors = Motors.ON

    def press_motors_on(self) -> None:
        """Reset stops; in Auto switch motors on.

        Raises:
            PanelRefused: a circuit is open, or the robot is still stopping.
        """
        if active := self._active():
            raise PanelRefused(f"the {active[0].value} stop is open: close its circuit, then press Motors On")
        if self.motors is Motors.STOPPING:
            raise PanelRefused("the robot is still stopping: press Motors On when it stands")
        self.latched = False
        if self.mode is Mode.AUTO:
            self.motors = Motors.ON

    def switch_motors_off(self) -> None:
        """Motors off by system input: a stop of category 1."""
        self._stop(1)

    def _active(self) -> list[Stop]:
        return [stop for stop in Stop if stop in self.open and self.mode in STOPS[stop].modes]

    def _stop(self, category: int) -> None:
        if self.motors is Motors.OFF or (self.motors is Motors.STOPPING and category == 1):
            return
        self.category = category
        self._stopping_s = 0.0
        self.motors = Motors.STOPPING if category else Motors.OFF
