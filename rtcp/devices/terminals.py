"""Terminals of the IO box with a meaning: inputs with polarity and debounce, lamps and the heartbeat."""

from __future__ import annotations

from rtcp.config.model import GripperConfig
from rtcp.config.operation import InputConfig, InputsConfig, OutputsConfig
from rtcp.devices.stick import RESTLESS


class Switch:
    """An input that means something when `active`. Before its first level has lasted, it has `before`; so it has again
    when its level has not come to rest for four times the debounce, as at a loose contact.

    Args:
        config: number, polarity, debounce; None: there is no such input and `before` stays.
        before: what it counts as until then, and for ever where there is none.
        cycle_s: how often `read` is called, s.
    """

    __slots__ = ("_before", "_bit", "_candidate", "_debounce", "_inverted", "_restless", "_stable", "active")

    def __init__(self, config: InputConfig | None, before: bool, cycle_s: float) -> None:
        self.active = self._before = before
        self._bit = 0 if config is None else 1 << config.number - 1
        self._inverted = config is not None and config.active == "low"
        self._debounce = 0 if config is None else round(config.debounce_ms * 1e-3 / cycle_s)
        self._candidate = before
        self._stable = self._restless = 0

    @property
    def settled(self) -> bool:
        """Whether its level has lasted for the debounce, or there is no such input."""
        return not self._bit or self._stable >= self._debounce

    def forget(self) -> None:
        """Count as not active until a level that says otherwise has lasted."""
        self.active = self._candidate = False
        self._stable = -1
        self._restless = 0

    def read_active(self, levels: int) -> None:
        """Take the levels of a cycle, but not that what is active no longer is."""
        if not self.active or bool(levels & self._bit) is not self._inverted:
            self.read(levels)

    def read(self, levels: int) -> None:
        """Take the levels of all inputs of a cycle."""
        if not self._bit:
            return
        seen = bool(levels & self._bit) is not self._inverted
        if seen is not self._candidate:
            self._candidate = seen
            self._stable = 0
        elif self._stable <= self._debounce:
            self._stable += 1
        if self._stable >= self._debounce:
            self.active = seen
            self._restless = 0
            return
        self._restless += 1
        if self._restless > RESTLESS * self._debounce:
            self.active = self._before


class Inputs:
    """The switches at the box; `read` once a cycle.

    Args:
        config: which there are.
        cycle_s: the cycle, s.
    """

    __slots__ = ("arm_toggle", "emergency_stop", "enabling_switch")

    def __init__(self, config: InputsConfig, cycle_s: float) -> None:
        # Until the box has been heard, a stop that is there counts as pressed and a permission as not given.
        self.emergency_stop = Switch(config.emergency_stop, config.emergency_stop is not None, cycle_s)
        self.enabling_switch = Switch(config.enabling_switch, config.enabling_switch is None, cycle_s)
        self.arm_toggle = Switch(config.arm_toggle, config.arm_toggle is None, cycle_s)

    def read(self, levels: int) -> None:
        """Take the levels of all inputs of a cycle."""
        self.emergency_stop.read(levels)
        self.enabling_switch.read(levels)
        self.arm_toggle.read(levels)


class Outputs:
    """The outputs with a meaning, as masks; `write` changes nothing but them.

    Args:
        config: which there are.
        gripper: its output, or None.
    """

    __slots__ = ("_closed", "_gripper", "_heartbeat", "_moving", "_powered", "meant")

    def __init__(self, config: OutputsConfig, gripper: GripperConfig | None) -> None:
        self._powered = _mask(config.state_lamp)
        self._moving = _mask(config.motion_lamp)
        self._heartbeat = _mask(config.heartbeat)
        self._gripper = 0 if gripper is None else _mask(gripper.output)
        self._closed = gripper is not None and gripper.closed == "on"
        numbers = (config.state_lamp, config.motion_lamp, config.heartbeat, None if gripper is None else gripper.output)
        self.meant = frozenset(number for number in numbers if number is not None)
        """Numbers of the outputs that nobody switches by hand."""

    def write(self, outputs: int, powered: bool, moving: bool) -> int:
        """Return `outputs` with the lamps as they have to be, and the heartbeat the other way round."""
        lamps = (self._powered if powered else 0) | (self._moving if moving else 0)
        return (outputs & ~(self._powered | self._moving) | lamps) ^ self._heartbeat

    def lamps(self, outputs: int) -> int:
        """Return `outputs` with all off that is neither a lamp nor the heartbeat."""
        return outputs & (self._powered | self._moving | self._heartbeat)

    def grip(self, outputs: int, close: bool) -> int:
        """Return `outputs` with the gripper closed or open."""
        on = close is self._closed
        return outputs | self._gripper if on else outputs & ~self._gripper


def _mask(number: int | None) -> int:
    return 0 if number is None else 1 << number - 1
