"""The IO box: 16 digital inputs, 16 digital outputs, a counter."""

from __future__ import annotations

import struct

from rtcp.config.model import DeviceDescription, SlaveConfig
from rtcp.devices.codec import DeviceError, slots
from rtcp.fieldbus.pdo import TYPES, ImageLayout, layout


class IoBox:
    """Inputs and outputs as bit fields, bit 0 is number 1. `decode` sets `inputs`, `counter`; `encode` takes `outputs`.

    The channels are named `inputs`, `outputs` and `counter` in the device's file, each of an unsigned or a signed type.
    """

    __slots__ = (
        "_counter", "_image", "_inputs", "_outputs", "counter", "input_bytes", "inputs", "name", "output_bytes",
        "outputs",
    )  # fmt: skip

    def __init__(self, slave: SlaveConfig) -> None:
        """Make the driver of `slave`.

        Raises:
            DeviceError: the description lacks a channel, or one is not an integer of whole bytes.
        """
        device = slave.device
        outputs, inputs = layout(device.rpdo), layout(device.tpdo)
        self._outputs, out_at = _field(device, "rpdo", outputs, "outputs")
        self._inputs = _field(device, "tpdo", inputs, "inputs")
        self._counter = _field(device, "tpdo", inputs, "counter")
        self.name = slave.name
        self.output_bytes, self.input_bytes = outputs.bytes, inputs.bytes
        self._image = (bytes(out_at), bytes(outputs.bytes - out_at - self._outputs.size))
        self.inputs = 0
        self.outputs = 0
        self.counter = 0

    def decode(self, data: bytes) -> None:
        """Take the inputs of the cycle (`input_bytes` long)."""
        single, at = self._inputs
        self.inputs = single.unpack_from(data, at)[0]
        single, at = self._counter
        self.counter = single.unpack_from(data, at)[0]

    def encode(self) -> bytes:
        """Return the outputs of the cycle."""
        before, after = self._image
        return before + self._outputs.pack(self.outputs) + after

    @property
    def output_count(self) -> int:
        """How many outputs there are."""
        return 8 * self._outputs.size

    def set_output(self, number: int, value: bool) -> None:
        """Switch output `number` (1 to 16) on or off.

        Raises:
            DeviceError: there is no such output.
        """
        if not 1 <= number <= self.output_count:
            raise DeviceError(f"{self.name} has no output {number}; it has 1 to {self.output_count}")
        bit = 1 << number - 1
        self.outputs = self.outputs | bit if value else self.outputs & ~bit


def _field(device: DeviceDescription, key: str, image: ImageLayout, name: str) -> tuple[struct.Struct, int]:
    channel = image.channels[slots(device.name, key, image, (name,))[0]]
    if channel.bit_offset % 8 or "int" not in channel.type:
        raise DeviceError(
            f"{device.name}: channel {name} is {channel.type} at bit {channel.bit_offset}; "
            "it must be an integer at a whole byte"
        )
    return struct.Struct("<" + TYPES[channel.type][1]), channel.bit_offset // 8
