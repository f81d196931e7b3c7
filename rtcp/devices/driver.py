"""The driver of a slave: its base class, how its kind is found, process images as tuples of numbers."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from mypy_extensions import mypyc_attr

from rtcp.config.find import load_class, registered
from rtcp.config.model import SlaveConfig
from rtcp.fieldbus.pdo import TYPES, Channel, ImageLayout, layout

Number = int | float
ENTRY_POINTS = "rtcp.devices"
"""Entry point group in which a package registers its drivers: the kind is the name, the class is the object."""


class DeviceError(ValueError):
    """A device description that its driver cannot work with."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Driver:
    """Bytes of one slave's process image on one side, SI units and states on the other.

    A kind of device is one subclass: it names the channels that it cannot do without, unpacks the inputs in `decode`
    and packs the outputs in `encode`, each called once a cycle. This class keeps the layout of both images, and by
    itself offers every mapped channel: `values` (inputs) and `targets` (outputs) hold SI values by channel name. In the
    loop, `rtcp.control.cycle.Cycle.others` holds the drivers that are neither a drive nor the IO box.

    Args:
        slave: the slave's name and description.
        period_s: the cycle, s.

    Raises:
        DeviceError: a channel is missing, or has a type that cannot serve.
    """

    REQUIRED_OUTPUTS: ClassVar[tuple[str, ...]] = ()
    """Channels of `rpdo` that the driver cannot do without."""
    REQUIRED_INPUTS: ClassVar[tuple[str, ...]] = ()
    """Channels of `tpdo` that the driver cannot do without."""

    def __init__(self, slave: SlaveConfig, period_s: float) -> None:
        device = slave.device
        self.name = slave.name
        self.device = device.name
        self.rpdo, self.tpdo = layout(device.rpdo), layout(device.tpdo)
        self.output_bytes, self.input_bytes = self.rpdo.bytes, self.tpdo.bytes
        for key, image, required in (
            ("rpdo", self.rpdo, self.REQUIRED_OUTPUTS),
            ("tpdo", self.tpdo, self.REQUIRED_INPUTS),
        ):
            if missing := [name for name in required if image.find(name) is None]:
                found = ", ".join(channel.name for channel in image.channels if channel.index)
                raise DeviceError(
                    f"{device.name}: key `{key}` maps no {', '.join(missing)}; kind {device.kind} needs "
                    f"{', '.join(required)}, found are {found or 'none'}"
                )
        self.period_s = period_s
        self.codec_in, self.codec_out = make_codec(self.tpdo), make_codec(self.rpdo)
        self.values: dict[str, float] = {channel.name: 0.0 for channel in self.tpdo.channels if channel.index}
        self.targets: dict[str, float] = {channel.name: 0.0 for channel in self.rpdo.channels if channel.index}

    def decode(self, data: bytes) -> None:
        """Decode the inputs of the cycle (`input_bytes` long)."""
        for channel, counts in zip(self.tpdo.channels, self.codec_in.unpack(data), strict=True):
            if channel.index:
                self.values[channel.name] = counts * channel.factor

    def encode(self) -> bytes:
        """Return the outputs of the cycle (`output_bytes` long)."""
        return self.codec_out.pack(*(self._counts_of(channel) for channel in self.rpdo.channels))

    def _counts_of(self, channel: Channel) -> Number:
        counts = self.targets[channel.name] / channel.factor if channel.index else 0
        return counts if channel.type.startswith("float") else round(counts)


def make_driver(slave: SlaveConfig, period_s: float) -> Driver:
    """Return the driver of a slave, of the class that is registered for the kind of its device.

    Raises:
        DeviceError: no installed package has a driver for this kind, or the description cannot serve.
        PluginError: what is registered for this kind is no driver.
    """
    kind = slave.device.kind
    found = registered(ENTRY_POINTS)
    if kind not in found:
        raise DeviceError(
            f"{slave.device.name}: no driver is installed for kind {kind} (key `kind`); installed are "
            f"{', '.join(found)}"
        )
    return load_class(found[kind], Driver)(slave, period_s=period_s)


@dataclass(frozen=True)
class Codec:
    """Packs and unpacks an image; values stand in the order of the channels, padding included."""

    unpack: Callable[[bytes], tuple[Number, ...]]
    pack: Callable[..., bytes]


def make_codec(layout: ImageLayout) -> Codec:
    """Return the codec of an image; little endian, no gaps (ETG.1000.6, 5.6.5)."""
    if any(channel.type == "bool" for channel in layout.channels):
        return _bit_codec(layout)
    whole = struct.Struct("<" + "".join(TYPES[channel.type][1] for channel in layout.channels))
    return Codec(whole.unpack, whole.pack)


def _bit_codec(layout: ImageLayout) -> Codec:
    # A lone value is brought from and to its bits by the struct of its type; a bool needs none.
    parts = tuple(
        (channel.bit_offset, (1 << channel.bits) - 1, channel.bits // 8, struct.Struct("<" + TYPES[channel.type][1]))
        for channel in layout.channels
    )
    length = layout.bytes

    def unpack(data: bytes) -> tuple[Number, ...]:
        image = int.from_bytes(data, "little")
        return tuple(
            single.unpack((image >> offset & mask).to_bytes(width, "little"))[0] if width else image >> offset & 1
            for offset, mask, width, single in parts
        )

    def pack(*values: Number) -> bytes:
        image = 0
        for value, (offset, _mask, width, single) in zip(values, parts, strict=True):
            image |= (int.from_bytes(single.pack(value), "little") if width else int(bool(value))) << offset
        return image.to_bytes(length, "little")

    return Codec(unpack, pack)


def integer_range(channel: Channel) -> tuple[int, int]:
    """Return the smallest and the largest counts of a channel; raises DeviceError where it is of no integer type."""
    if channel.type.startswith("uint"):
        return 0, (1 << channel.bits) - 1
    if channel.type.startswith("int"):
        return -(1 << channel.bits - 1), (1 << channel.bits - 1) - 1
    raise DeviceError(f"channel {channel.name} is {channel.type}; it must be of an integer type")
