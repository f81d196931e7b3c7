"""The layout of a process image: which channel stands at which bits (ETG.1000.6, 5.6.5; little endian, no gaps)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rtcp.config.model import DeviceDescription, Pdo

# type: (bits, code of `struct`); bool stands in the image as single bits
TYPES: dict[str, tuple[int, str]] = {
    "bool": (1, ""),
    "int8": (8, "b"),
    "uint8": (8, "B"),
    "int16": (16, "h"),
    "uint16": (16, "H"),
    "int32": (32, "i"),
    "uint32": (32, "I"),
    "int64": (64, "q"),
    "uint64": (64, "Q"),
    "float32": (32, "f"),
    "float64": (64, "d"),
}


@dataclass(frozen=True)
class Channel:
    """A mapped object and its place in the image; index 0 is padding."""

    name: str
    index: int
    sub_index: int
    type: str
    factor: float
    bit_offset: int
    bits: int


@dataclass(frozen=True)
class ImageLayout:
    """The outputs or the inputs of one slave."""

    channels: tuple[Channel, ...]
    bits: int

    @property
    def bytes(self) -> int:
        """Length in bytes, the last one possibly not filled."""
        return (self.bits + 7) // 8

    def find(self, name: str) -> Channel | None:
        """Return the channel of that name, None where there is none."""
        return next((channel for channel in self.channels if channel.name == name and channel.index), None)


def layout(pdos: Sequence[Pdo]) -> ImageLayout:
    """Return where the entries of `pdos`, assigned in this order, stand."""
    channels = []
    offset = 0
    for pdo in pdos:
        for entry in pdo.channels:
            bits = TYPES[entry.type][0]
            channels.append(
                Channel(entry.name, entry.index, entry.sub_index, entry.type, entry.factor, offset, bits)
            )  # fmt: skip
            offset += bits
    return ImageLayout(tuple(channels), offset)


def layout_faults(device: DeviceDescription) -> list[str]:
    """Return a sentence for every image of `device` that cannot be exchanged.

    Fewer than 8 bits would share a byte with the next slave (SOEM maps them so), where a byte cannot be written alone.
    """
    return [
        f"{device.name}: {key} has {image.bits} bits; an image of 1 to 7 bits is not supported, add padding (index 0)"
        for key, image in (("rpdo", layout(device.rpdo)), ("tpdo", layout(device.tpdo)))
        if 0 < image.bits < 8
    ]
