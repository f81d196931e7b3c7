"""Process images as tuples of numbers: one `struct` where every channel fills whole bytes, bit by bit where not."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from rtcp.fieldbus.pdo import TYPES, ImageLayout

Number = int | float


class DeviceError(ValueError):
    """A device description that its driver cannot work with; the message is a sentence."""


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


def slots(device: str, key: str, layout: ImageLayout, names: Iterable[str]) -> tuple[int, ...]:
    """Return where `names` stand among the channels of an image.

    Args:
        device: name of the device, for the sentence.
        key: `rpdo` or `tpdo`, for the sentence.
        layout: the image.
        names: channels that the driver cannot do without.

    Raises:
        DeviceError: channels are missing; all of them are named.
    """
    wanted = tuple(names)
    at = {channel.name: i for i, channel in enumerate(layout.channels) if channel.index}
    missing = [name for name in wanted if name not in at]
    if missing:
        raise DeviceError(
            f"{device}: key `{key}` maps no {', '.join(missing)}; its kind needs {', '.join(wanted)}, "
            f"found are {', '.join(at) or 'none'}"
        )
    return tuple(at[name] for name in wanted)


def factors(layout: ImageLayout, places: Sequence[int]) -> tuple[float, ...]:
    """Return the factors (SI value = counts * factor) of the channels at `places`."""
    return tuple(layout.channels[place].factor for place in places)


def integer_range(layout: ImageLayout, place: int) -> tuple[int, int]:
    """Return the smallest and the largest counts of a channel.

    Raises:
        DeviceError: the channel is not of an integer type.
    """
    channel = layout.channels[place]
    if channel.type.startswith("uint"):
        return 0, (1 << channel.bits) - 1
    if channel.type.startswith("int"):
        return -(1 << channel.bits - 1), (1 << channel.bits - 1) - 1
    raise DeviceError(f"channel {channel.name} is {channel.type}; it must be of an integer type")
