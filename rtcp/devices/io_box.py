"""The IO box: inputs, outputs, a counter; terminals with an assigned function, and the joystick."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final

from rtcp.config.model import (
    BEYOND_FULL,
    GripperConfig,
    InputConfig,
    InputsConfig,
    JoystickConfig,
    NamedTerminal,
    OutputsConfig,
    SlaveConfig,
)
from rtcp.devices.driver import DeviceError, Driver
from rtcp.fieldbus.pdo import STRUCT_CODES, ImageLayout
from rtcp.ipc.schema import Field


class IoBox(Driver):
    """Inputs and outputs as bit fields, bit 0 is number 1. `decode` sets `inputs`, `counter`; `encode` takes `outputs`.

    The channels are named `inputs` and `outputs` in the device's file, and `counter` where the box has one: without it
    the counter stays 0.

    Raises:
        DeviceError: the description lacks a channel, or one is not an integer of whole bytes.
    """

    REQUIRED_OUTPUTS = ("outputs",)
    REQUIRED_INPUTS = ("inputs",)

    def __init__(self, slave: SlaveConfig, period_s: float) -> None:
        super().__init__(slave, period_s)
        self._inputs = _field(self, self.tpdo, "inputs")
        self._outputs, at = _field(self, self.rpdo, "outputs")
        self._counter = _field(self, self.tpdo, "counter") if self.tpdo.find("counter") else None
        self._around = (bytes(at), bytes(self.output_bytes - at - self._outputs.size))
        self.inputs = 0
        self.outputs = 0
        self.counter = 0

    def decode(self, data: bytes) -> None:
        """Decode the inputs of the cycle (`input_bytes` long)."""
        single, at = self._inputs
        self.inputs = single.unpack_from(data, at)[0]
        if self._counter is not None:
            single, at = self._counter
            self.counter = single.unpack_from(data, at)[0]

    def encode(self) -> bytes:
        """Return the outputs of the cycle."""
        before, after = self._around
        return before + self._outputs.pack(self.outputs) + after

    def safe(self) -> None:
        """Keep the outputs: a gripper on one would drop its object."""

    def fields(self) -> Sequence[Field]:
        """Return inputs, outputs and, where there is one, the counter."""
        published = [
            Field("inputs", _type(self.tpdo, "inputs"), "", "Levels of the inputs, bit 0 is input 1."),
            Field("outputs", _type(self.rpdo, "outputs"), "", "Levels of the outputs, bit 0 is output 1."),
        ]
        counted = Field("counter", _type(self.tpdo, "counter"), "", "Counts of the encoder.")
        return published if self._counter is None else [*published, counted]

    def publish(self, values: list[Any], at: int) -> None:
        """Write them into the record."""
        values[at] = self.inputs
        values[at + 1] = self.outputs
        if self._counter is not None:
            values[at + 2] = self.counter

    @property
    def output_count(self) -> int:
        """Number of outputs."""
        return 8 * self._outputs.size

    def set_output(self, number: int, value: bool) -> None:
        """Switch output `number` (1 to 16) on or off.

        Raises:
            DeviceError: no such output.
        """
        if not 1 <= number <= self.output_count:
            raise DeviceError(f"{self.name} has no output {number}; it has 1 to {self.output_count}")
        bit = 1 << number - 1
        self.outputs = self.outputs | bit if value else self.outputs & ~bit


def _type(image: ImageLayout, name: str) -> str:
    channel = image.find(name)
    return "int32" if channel is None else channel.type


def _field(box: Driver, image: ImageLayout, name: str) -> tuple[struct.Struct, int]:
    channel = image.find(name)
    assert channel is not None
    if channel.bit_offset % 8 or channel.type not in STRUCT_CODES or "int" not in channel.type:
        raise DeviceError(
            f"{box.device}: channel {name} is {channel.type} at bit {channel.bit_offset}; "
            "it must be an integer of 8, 16, 32 or 64 bits at a whole byte"
        )
    return struct.Struct("<" + STRUCT_CODES[channel.type]), channel.bit_offset // 8


class Switch:
    """A debounced input. `active` is `before` until a level has lasted for the debounce time, and again when no level
    has lasted for four times as long, as at a loose contact.

    Args:
        config: number, polarity, debounce; None: no such input, `active` is always `before`.
        before: value without a stable level.
        cycle_s: interval of the calls of `read`, s.
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
        """Whether its level has lasted for the debounce time, or no such input exists."""
        return not self._bit or self._stable >= self._debounce

    def forget(self) -> None:
        """Become inactive until an active level has lasted for the debounce time."""
        self.active = self._candidate = False
        self._stable = -1
        self._restless = 0

    def read_active(self, levels: int) -> None:
        """Update from the levels of a cycle; never clear an active input."""
        if not self.active or bool(levels & self._bit) is not self._inverted:
            self.read(levels)

    def read(self, levels: int) -> None:
        """Update from the levels of all inputs of a cycle."""
        if not self._bit:
            return
        level = bool(levels & self._bit) is not self._inverted
        if level is self._candidate and self._stable > self._debounce:
            return
        if level is not self._candidate:
            self._candidate = level
            self._stable = 0
        elif self._stable <= self._debounce:
            self._stable += 1
        if self._stable >= self._debounce:
            self.active = level
            self._restless = 0
            return
        self._restless += 1
        if self._restless > RESTLESS * self._debounce:
            self.active = self._before


class Inputs:
    """The switches; each is read once a cycle, from the levels of its box.

    Args:
        config: which there are.
        cycle_s: the cycle, s.
    """

    __slots__ = ("arm_toggle", "emergency_stop", "enabling_switch")

    def __init__(self, config: InputsConfig, cycle_s: float) -> None:
        # Before the first inputs arrive, a configured stop counts as pressed and a permission as not given.
        self.emergency_stop = Switch(config.emergency_stop, config.emergency_stop is not None, cycle_s)
        self.enabling_switch = Switch(config.enabling_switch, config.enabling_switch is None, cycle_s)
        self.arm_toggle = Switch(config.arm_toggle, config.arm_toggle is None, cycle_s)


class Outputs:
    """The outputs with a meaning, as masks: lamps on one box, the gripper on that or another one.

    Args:
        config: which there are.
        gripper: its output, or None.
    """

    __slots__ = ("_closed", "_gripper", "_heartbeat", "_moving", "_powered")

    def __init__(self, config: OutputsConfig, gripper: GripperConfig | None) -> None:
        self._powered = _mask(config.state_lamp)
        self._moving = _mask(config.motion_lamp)
        self._heartbeat = _mask(config.heartbeat)
        self._gripper = 0 if gripper is None else _mask(gripper.output)
        self._closed = gripper is not None and gripper.closed != "off"

    def write(self, outputs: int, powered: bool, moving: bool) -> int:
        """Return `outputs` with the lamps set and the heartbeat inverted."""
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


RESTLESS: Final = 4
"""Multiple of the debounce time after which unsettled lines count as invalid."""


class JoystickInput:
    """State of the joystick's lines: `read` sets `forward`, `side` (left is +1), `paddle` (-1, 0, 1), `code`, `valid`.

    Args:
        config: which inputs are the joystick's, and which others have a meaning.
        cycle_s: how often `read` is called, s.
    """

    __slots__ = (
        "_byte_at", "_candidate", "_checked", "_debounce", "_inverted", "_lines", "_restless", "_stable", "code",
        "forward", "paddle", "side", "valid",
    )  # fmt: skip

    def __init__(self, config: InputsConfig, cycle_s: float) -> None:
        joystick = config.joystick
        self.forward = self.side = 0.0
        self.paddle = 0
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
        terminals = (config.arm_toggle, config.enabling_switch, config.emergency_stop)
        switches: list[InputConfig | NamedTerminal] = [terminal for terminal in terminals if terminal is not None]
        switches += config.named
        # Without a name: the only box.
        same_box = [switch for switch in switches if switch.box == joystick.box or None in (switch.box, joystick.box)]
        used = sum(1 << switch.number - 1 for switch in same_box)
        bytes_used = {(number - 1) // 8 for number in numbers}
        self._checked = sum(0xFF << 8 * byte for byte in bytes_used) & ~used

    def read(self, levels: int) -> None:
        """Update from the levels of all inputs of a cycle; a change counts once it has lasted as long as configured."""
        if not self._lines:
            return
        lines = levels & self._checked
        if lines == self._candidate and self._stable > self._debounce:
            return
        if lines != self._candidate:
            self._candidate = lines
            self._stable = 0
        elif self._stable <= self._debounce:
            self._stable += 1
        if self._stable < self._debounce:
            self._restless += 1
            if self._restless > RESTLESS * self._debounce:
                # Lines that never settle, as at a loose contact: the last direction must not continue for ever.
                self._rest()
                self.valid = False
            return
        self._restless = 0
        self.code = lines >> self._byte_at & 0xFF
        active = lines ^ self._inverted
        forward, backward, left, right, up, down = (bool(active & line) for line in self._lines)
        unassigned = active
        for line in self._lines:
            unassigned &= ~line
        deflected = forward or backward or left or right
        self.valid = not (
            unassigned or (forward and backward) or (left and right) or (up and down) or (deflected and (up or down))
        )
        if self.valid:
            self.forward = float(forward - backward)
            self.side = float(left - right)
            self.paddle = up - down
        else:
            self._rest()

    def _rest(self) -> None:
        self.forward = self.side = 0.0
        self.paddle = 0


class AnalogStick:
    """State of a joystick with an analog stick, as `JoystickInput`: `forward` and `side` are -1 to 1.

    It is neutral inside the dead zone. From its edge the speed rises to 1 at the full inclination, as the curve says. A
    value that is no number, or that no intact stick has, is not valid, and neither is a paddle beside an inclination.
    An inclination changes by the full one in the debounce time at most, and a value counts as not valid after that
    time: one false sample does nothing.

    Args:
        config: the joystick, with the stick's channels, dead zone and curve.
        drivers: the slaves that are no drives, by name.
        cycle_s: cycle time, s.

    Raises:
        DeviceError: no slave sends one of the channels.
    """

    __slots__ = (
        "_axes",
        "_curve",
        "_cycles",
        "_dead",
        "_inclined",
        "_wrong",
        "forward",
        "in_range",
        "paddle",
        "side",
        "valid",
    )  # fmt: skip

    def __init__(self, config: JoystickConfig, drivers: Mapping[str, Driver], cycle_s: float) -> None:
        analog = config.analog
        assert analog is not None
        self.forward = self.side = 0.0
        self.paddle = 0
        self.valid = self.in_range = False
        self._dead, self._curve = analog.dead_zone, analog.curve
        self._cycles = max(1, round(config.debounce_ms * 1e-3 / cycle_s))
        self._inclined = [0.0, 0.0]
        self._wrong = self._cycles
        """Cycles in a row with a value that no intact stick has."""
        self._axes: list[tuple[Driver, str, float, float]] = []
        for axis in (analog.forward, analog.left):
            slave, _, channel = axis.channel.partition(".")
            driver = drivers.get(slave)
            if driver is None or channel not in driver.values:
                raise DeviceError(f"the joystick needs the channel {axis.channel}: no slave sends it")
            self._axes.append((driver, channel, axis.neutral, 1.0 / axis.full))

    def read(self, lines: JoystickInput) -> None:
        """Update from the channels of a cycle and from the paddles of the joystick's lines."""
        inclined, intact, change = self._inclined, True, 1.0 / self._cycles
        for i, (driver, channel, neutral, scale) in enumerate(self._axes):
            inclination = (driver.values[channel] - neutral) * scale
            # False for a value that is no number, too.
            if -BEYOND_FULL <= inclination <= BEYOND_FULL:
                inclined[i] = min(max(inclination, inclined[i] - change), inclined[i] + change)
            else:
                intact = False
        self._wrong = 0 if intact else min(self._wrong + 1, self._cycles)
        self.in_range = self._wrong < self._cycles
        self.paddle = lines.paddle
        self.forward, self.side = self._speed(inclined[0]), self._speed(inclined[1])
        self.valid = self.in_range and lines.valid and not (self.paddle and (self.forward or self.side))

    def _speed(self, inclination: float) -> float:
        """Return the fraction of the joystick's speed at an inclination."""
        size = abs(inclination)
        if size <= self._dead:
            return 0.0
        speed: float = min((size - self._dead) / (1.0 - self._dead), 1.0) ** self._curve
        return speed if inclination > 0.0 else -speed
