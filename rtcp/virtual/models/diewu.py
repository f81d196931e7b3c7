"""The DIEWU IO box: 16 digital inputs, 16 NPN outputs and a counter of AB edges."""

from __future__ import annotations

from collections import deque

from rtcp.virtual.device import Emergency, Identity
from rtcp.virtual.models.defaults import Defaults
from rtcp.virtual.models.number import number
from rtcp.virtual.models.options import IO_BOX_OPTIONS, read_options
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary, Value
from rtcp.virtual.pdo import define_pdo_objects

VENDOR_ID = 0x00000D1E
PRODUCT_CODE = 0x00161602
REVISION = 0x00010000
"""The maker's true numbers are not known to this project; these stand in for them."""

CHANNELS = 16

_U8, _U16, _U32, _I32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32, DataType.INTEGER32


class DiewuIoBox:
    """The IO box; options as in `IO_BOX_OPTIONS`.

    The world outside sets `inputs` (or one of them with `set_input`) and turns the encoder; whoever is on the bus may
    force inputs through 0x2000 (mask, levels, and for how long) and set the counter through 0x2001:1.

    Raises:
        ValueError: an option that does not exist or is out of range.
    """

    # The box uses no SYNC0 of its own; its clock, the first of the segment, is the reference of the others.
    supports_dc = True

    def __init__(self, **options: object) -> None:
        chosen = read_options("diewu-io", IO_BOX_OPTIONS, options)
        serial = int(chosen["serial"] or 0)
        self.identity = Identity(
            VENDOR_ID, PRODUCT_CODE, REVISION, serial, "DIEWU 16DI16DO", "Digital IO", "DIEWU-16DI16DO"
        )
        self.counter_rate = chosen["counter_rate"] or 0.0
        self._inputs = int(chosen["inputs"] or 0)
        self._turned = 0.0
        self._broken: list[BrokenTerminals] = []
        self._freezes = 0
        self.emergencies: deque[Emergency] = deque()
        self.objects = objects = _build_objects(self.identity, self._inputs)
        self._outputs_valid = False
        self._input_entry = number(objects, 0x6000, 1)
        self._counter_entry = number(objects, 0x6010, 1)
        self._output_entry = number(objects, 0x7000, 1)
        self._mask_entry = number(objects, 0x2000, 1)
        self._levels_entry = number(objects, 0x2000, 2)
        self._terminal_entry = number(objects, 0x2002)
        objects[0x2001, 1].on_write = self._preset
        objects[0x2000, 3].on_write = self._hold
        self._held_s = 0.0
        define_pdo_objects(
            objects,
            {0x1600: ((0x7000, 1, 16),)},
            {0x1A00: ((0x6000, 1, 16), (0x6010, 1, 32))},
            [0x1600],
            [0x1A00],
            fixed=True,
        )
        self._defaults = Defaults(objects)

    def power_on(self) -> None:
        """The supply comes back: all is as at power-on."""
        self._defaults.restore()
        self._held_s = 0.0

    @property
    def inputs(self) -> int:
        """Levels at the input terminals, bit n for input n, whatever is forced over the bus."""
        return self._inputs

    @inputs.setter
    def inputs(self, levels: int) -> None:
        if not 0 <= levels <= 0xFFFF:
            raise ValueError(f"inputs are 16 bits, 0 to 65535, not {levels}")
        self._inputs = levels

    def set_input(self, channel: int, level: bool) -> None:
        """Set the level at input `channel`, 0 to 15; raises ValueError for another one."""
        if not 0 <= channel < CHANNELS:
            raise ValueError(f"the IO box has inputs 0 to {CHANNELS - 1}, not {channel}")
        bit = 1 << channel
        self._inputs = self._inputs | bit if level else self._inputs & ~bit

    @property
    def outputs(self) -> int:
        """Levels at the output terminals, bit n for output n; all 0 in the safe state."""
        return self._output_entry.value if self._outputs_valid else 0

    def turn(self, edges: float) -> None:
        """Turn the AB encoder by so many edges, negative for backwards; whole ones are counted by the next step."""
        self._turned += edges

    def break_terminals(self, broken: BrokenTerminals) -> None:
        """Let input terminals show something else than the world, whatever is forced over the bus, until `clear`."""
        self._broken.append(broken)

    def release_terminals(self, broken: BrokenTerminals) -> None:
        """Let them show the world again."""
        self._broken.remove(broken)

    def freeze_inputs(self) -> None:
        """Let inputs and counter show what they do now, whatever is at the terminals, until they are thawed."""
        self._freezes += 1

    def thaw_inputs(self) -> None:
        """Let them show the world again; who froze them more than once thaws them as often."""
        self._freezes -= 1

    def power_off(self) -> None:
        """The supply goes: the outputs are off."""
        self.set_outputs_valid(False)

    def set_outputs_valid(self, valid: bool) -> None:
        """Tell that the outputs in the process data count (OP) or must be 0 (the safe state)."""
        self._outputs_valid = valid
        self._terminal_entry.value = self.outputs

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass: drive the output terminals, read the inputs, count edges."""
        self._terminal_entry.value = self._output_entry.value if self._outputs_valid else 0
        if self._held_s > 0.0:
            self._held_s -= dt
            if self._held_s <= 0.0:
                # Nobody has said it again: a stick that stays deflected for ever is the known accident.
                self._mask_entry.value = 0
        mask = self._mask_entry.value
        levels = self._inputs & ~mask | self._levels_entry.value & mask
        for broken in self._broken:
            levels = broken.shown(levels, dt)
        if self._freezes:
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
    """Input terminals, the bits of `mask`, that show `levels`; with a `half_period` (s) they turn over after each."""

    def __init__(self, mask: int, levels: int, half_period: float = 0.0) -> None:
        self._mask = mask
        self._levels = levels & mask
        self._half_period = half_period
        self._passed = 0.0

    def shown(self, levels: int, dt: float) -> int:
        """Let `dt` seconds pass and return what the inputs show while `levels` are true."""
        own = self._levels
        if self._half_period:
            self._passed += dt
            if self._passed // self._half_period % 2:
                own ^= self._mask
        return levels & ~self._mask | own


def _build_objects(identity: Identity, inputs: int) -> ObjectDictionary:
    objects = ObjectDictionary()
    text = DataType.VISIBLE_STRING
    objects.variable(0x1000, "Device type", _U32, 0x00030191)  # digital inputs and outputs, CiA 401
    objects.variable(0x1001, "Error register", _U8)
    objects.variable(0x1008, "Manufacturer device name", text, identity.name.encode())
    objects.variable(0x1009, "Manufacturer hardware version", text, b"1.0")
    objects.variable(0x100A, "Manufacturer software version", text, b"1.0")
    objects.record(0x1018, "Identity", [
        Entry(0x1018, 1, "Vendor ID", _U32, identity.vendor_id),
        Entry(0x1018, 2, "Product code", _U32, identity.product_code),
        Entry(0x1018, 3, "Revision number", _U32, identity.revision),
        Entry(0x1018, 4, "Serial number", _U32, identity.serial),
    ])  # fmt: skip
    tx, rx = Access.RO | Access.TXPDO, Access.RW | Access.RXPDO
    objects.record(0x6000, "Digital inputs", [Entry(0x6000, 1, "Inputs 0 to 15", _U16, inputs, tx)])
    objects.record(0x6010, "Encoder counter", [Entry(0x6010, 1, "Counter", _I32, 0, tx)])
    objects.record(0x7000, "Digital outputs", [Entry(0x7000, 1, "Outputs 0 to 15", _U16, 0, rx)])
    objects.record(0x2000, "Forced inputs", [
        Entry(0x2000, 1, "Mask of the forced inputs", _U16, 0, Access.RW),
        Entry(0x2000, 2, "Levels of the forced inputs", _U16, 0, Access.RW),
        Entry(0x2000, 3, "Milliseconds until they are let go, 0: never", _U16, 0, Access.RW),
    ])  # fmt: skip
    objects.record(0x2001, "Counter settings", [Entry(0x2001, 1, "Preset", _I32, 0, Access.RW)])
    objects.variable(0x2002, "Levels at the output terminals", _U16)
    return objects
