"""The DIEWU IO box: 16 digital inputs, 16 NPN outputs and a counter of AB edges."""

from __future__ import annotations

from types import MappingProxyType

from rtcp.virtual.device import DeviceModel, FreezableInputs, Option
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary, Value
from rtcp.virtual.pdo import define_pdo_objects

CHANNELS = 16
RELEASED = 0x033F
"""Inputs at rest: joystick neutral (pull-ups, 63), toggle at the arm, emergency stop closed."""
_U16, _I32 = DataType.UNSIGNED16, DataType.INTEGER32


class DiewuIoBox(DeviceModel, FreezableInputs):
    """The IO box.

    Tests set `inputs` (or one of them with `set_input`) and turn the encoder. The master can force inputs through
    0x2000 (mask, levels, duration) and set the counter through 0x2001:1.
    """

    # Placeholders: the manufacturer's numbers are unknown to this project.
    vendor_id = 0x00000D1E
    product_code = 0x00161602
    device_type = 0x00030191  # digital inputs and outputs, CiA 401
    name = "DIEWU 16DI16DO"
    group = "Digital IO"
    order_code = "DIEWU-16DI16DO"
    options = MappingProxyType({
        "counter_rate": Option(0.0, -1e6, 1e6, "AB edges a second of the encoder"),
        "inputs": Option(RELEASED, 0, 0xFFFF, "levels at the inputs at power-on, bit 0 is input 1", whole=True),
    })  # fmt: skip
    # Its clock, the first of the segment, is the reference clock.
    uses_sync0 = False

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        objects = self.objects
        self.counter_rate = self.option("counter_rate")
        self._inputs = int(self.option("inputs"))
        self._turned = 0.0
        self.broken: list[BrokenTerminals] = []
        """Input terminals with a wrong level, even if forced."""
        self._held_s = 0.0
        self._input_entry = objects[0x6000, 1]
        self._counter_entry = objects[0x6010, 1]
        self._output_entry = objects[0x7000, 1]
        self._mask_entry = objects[0x2000, 1]
        self._levels_entry = objects[0x2000, 2]
        self._terminal_entry = objects[0x2002, 0]

    def define(self, objects: ObjectDictionary) -> None:
        """Add inputs, outputs and counter with their fixed PDOs."""
        tx, rx = Access.RO | Access.TXPDO, Access.RW | Access.RXPDO
        inputs = int(self.option("inputs"))
        objects.record(0x6000, "Digital inputs", [Entry(0x6000, 1, "Inputs 0 to 15", _U16, inputs, tx)])
        objects.record(0x6010, "Encoder counter", [Entry(0x6010, 1, "Counter", _I32, 0, tx)])
        objects.record(0x7000, "Digital outputs", [Entry(0x7000, 1, "Outputs 0 to 15", _U16, 0, rx)])
        objects.record(0x2000, "Forced inputs", [
            Entry(0x2000, 1, "Mask of the forced inputs", _U16, 0, Access.RW),
            Entry(0x2000, 2, "Levels of the forced inputs", _U16, 0, Access.RW),
            Entry(0x2000, 3, "Milliseconds until release, 0: never", _U16, 0, Access.RW, on_write=self._hold),
        ])  # fmt: skip
        preset = Entry(0x2001, 1, "Preset", _I32, 0, Access.RW, on_write=self._preset)
        objects.record(0x2001, "Counter settings", [preset])
        objects.variable(0x2002, "Levels at the output terminals", _U16)
        rx_pdo, tx_pdo = {0x1600: ((0x7000, 1, 16),)}, {0x1A00: ((0x6000, 1, 16), (0x6010, 1, 32))}
        define_pdo_objects(objects, rx_pdo, tx_pdo, [0x1600], [0x1A00], fixed=True)

    def power_on(self) -> None:
        """Power on: no input is forced."""
        super().power_on()
        self._held_s = 0.0

    @property
    def inputs(self) -> int:
        """Levels at the input terminals, bit n for input n, before forcing."""
        return self._inputs

    @inputs.setter
    def inputs(self, levels: int) -> None:
        if not 0 <= levels <= 0xFFFF:
            raise ValueError(f"inputs are 16 bits, 0 to 65535, not {levels}")
        self._inputs = levels

    def set_input(self, channel: int, level: bool) -> None:
        """Set the level at input `channel`, 0 to 15; raises ValueError for any other."""
        if not 0 <= channel < CHANNELS:
            raise ValueError(f"the IO box has inputs 0 to {CHANNELS - 1}, not {channel}")
        bit = 1 << channel
        self._inputs = self._inputs | bit if level else self._inputs & ~bit

    @property
    def outputs(self) -> int:
        """Levels at the output terminals, bit n for output n; all 0 in the safe state."""
        return self._output_entry.value if self.outputs_valid else 0

    def turn(self, edges: float) -> None:
        """Turn the AB encoder by `edges`, negative for backwards; the next step counts whole edges."""
        self._turned += edges

    def set_outputs_valid(self, valid: bool) -> None:
        """Set whether the outputs are valid; invalid ones are 0 (safe state)."""
        super().set_outputs_valid(valid)
        self._terminal_entry.value = self.outputs

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds: drive the output terminals, read the inputs, count edges."""
        self._terminal_entry.value = self._output_entry.value if self.outputs_valid else 0
        if self._held_s > 0.0:
            self._held_s -= dt
            if self._held_s <= 0.0:
                # Forcing expires, lest a dead client leave the joystick deflected for ever.
                self._mask_entry.value = 0
        mask = self._mask_entry.value
        levels = self._inputs & ~mask | self._levels_entry.value & mask
        for broken in self.broken:
            levels = broken.shown(levels, dt)
        if self.freezes:
            return
        self._input_entry.value = levels
        turned = self._turned + self.counter_rate * dt
        if turned:
            whole = int(turned)
            self._turned = turned - whole
            self._counter_entry.value = (self._counter_entry.value + whole + 0x80000000) % 0x100000000 - 0x80000000

    def _hold(self, _: Entry, value: Value) -> None:
        self._held_s = int(value) * 1e-3

    def _preset(self, _: Entry, value: Value) -> None:
        self._counter_entry.value = int(value)


class BrokenTerminals:
    """Input terminals `mask` stuck at `levels`; with a `half_period` (s) they toggle."""

    def __init__(self, mask: int, levels: int, half_period: float = 0.0) -> None:
        self._mask = mask
        self._levels = levels & mask
        self._half_period = half_period
        self._passed = 0.0

    def shown(self, levels: int, dt: float) -> int:
        """Advance by `dt` seconds and return the visible levels for the true `levels`."""
        own = self._levels
        if self._half_period:
            self._passed += dt
            if self._passed // self._half_period % 2:
                own ^= self._mask
        return levels & ~self._mask | own
