"""Drivers of slaves: base class, look-up by kind, and the codec of process images."""

from __future__ import annotations

import struct
from collections import Counter as Counts
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, ClassVar

from mypy_extensions import mypyc_attr

from rtcp.config.find import load_class, made_by, registered
from rtcp.config.model import LARGEST, SlaveConfig
from rtcp.fieldbus.pdo import STRUCT_CODES, Channel, ImageLayout, layout
from rtcp.ipc.commands import Command
from rtcp.ipc.events import Event
from rtcp.ipc.refusals import Refusal
from rtcp.ipc.schema import Field, identifier
from rtcp.ipc.states import State

Number = int | float
ENTRY_POINTS = "rtcp.devices"
"""Entry point group of drivers: name is the kind, object is the class."""


class DeviceError(ValueError):
    """A device description that its driver cannot use."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Driver:
    """Bytes of one slave's process image on one side, SI units and states on the other.

    A subclass drives one kind of device. It names its required channels, and overrides `decode` (inputs) and `encode`
    (outputs), each called once a cycle. This class holds the layout of both images and by itself offers every mapped
    channel: `values` (inputs) and `targets` (outputs) hold SI values by channel name; all of them are in the cycle
    record, named SLAVE_CHANNEL. Channels of type `bytes` are in neither: where the device has some, `arrays` holds
    those of the inputs, `array_targets` those of the outputs. A driver with commands names them in `commands` and
    overrides `accept`; a driver that acts by itself, or reports events, overrides `update`.

    Args:
        slave: the slave's name and description.
        period_s: the cycle, s.

    Raises:
        DeviceError: a channel is missing, or has an unsuitable type.
    """

    REQUIRED_OUTPUTS: ClassVar[tuple[str, ...]] = ()
    """Required channels of `rpdo`."""
    REQUIRED_INPUTS: ClassVar[tuple[str, ...]] = ()
    """Required channels of `tpdo`."""
    commands: ClassVar[tuple[type[Command], ...]] = ()
    """Commands for `accept`; each command belongs to one driver only."""

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
                mapped = ", ".join(channel.name for channel in image.channels if channel.index)
                raise DeviceError(
                    f"{device.name}: key `{key}` maps no {', '.join(missing)}; kind {device.kind} needs "
                    f"{', '.join(required)}, found are {mapped or 'none'}"
                )
        self.period_s = period_s
        self.codec_in, self.codec_out = make_codec(self.tpdo), make_codec(self.rpdo)
        self.values: dict[str, float] = {channel.name: 0.0 for channel in self.tpdo.channels if _is_number(channel)}
        self.safe_values = {entry.name: entry.safe or 0.0 for entry in device.outputs}
        """Outputs at the start and after a fault, SI."""
        self.targets: dict[str, float] = dict(self.safe_values)
        self._counters = {entry.name: Counter(entry.modulo) for entry in device.inputs if entry.modulo}
        # Only if needed: an instance with more than 30 attributes is slower in the interpreter.
        if arrays := _arrays(self.tpdo):
            self.arrays = arrays
        if arrays := _arrays(self.rpdo):
            self.array_targets = arrays
        self.safe_outputs = Driver.encode(self)
        """Output image of `safe_values`, sent when the driver has raised an exception."""
        self._input_names, self._output_names = tuple(self.values), tuple(self.targets)
        counts = Counts(channel.name for channel in self.tpdo.channels if _is_number(channel))
        self._shares = {name: 1.0 / count for name, count in counts.items() if count > 1}
        """Share of each value in the mean of a channel that has several in a cycle."""

    def decode(self, data: bytes) -> None:
        """Decode the inputs of the cycle (`input_bytes` long)."""
        for channel, counts in zip(self.tpdo.channels, self.codec_in.unpack(data), strict=True):
            if channel.index:
                if channel.type == "bytes":
                    self.arrays[channel.name] = counts.to_bytes(channel.bits // 8, "little")
                    continue
                counter = self._counters.get(channel.name)
                counts = counts if counter is None else counter.follow(counts)  # noqa: PLW2901
                self.values[channel.name] = counts * channel.factor + channel.offset
        if self._shares:
            self._average(data)

    def _average(self, data: bytes) -> None:
        """Replace the last value of each channel that has several in a cycle by their mean."""
        shares = self._shares
        for name in shares:
            self.values[name] = 0.0
        for channel, counts in zip(self.tpdo.channels, self.codec_in.unpack(data), strict=True):
            if channel.index and channel.name in shares:
                self.values[channel.name] += (counts * channel.factor + channel.offset) * shares[channel.name]

    def accept(self, command: Command) -> Refusal | None:
        """Execute one of `commands`, or return a refusal and change nothing."""
        raise NotImplementedError

    def update(self, state: State, now_ns: int) -> Event | None:
        """Execute a cycle, between `decode` and `encode`; return an event or a fault, or None.

        Args:
            state: of the machine.
            now_ns: the loop's clock, ns.
        """
        return None

    def safe(self) -> None:
        """Set the outputs to their safe values; called on a fault, on stale inputs and at the end."""
        self.targets.update(self.safe_values)

    def fields(self) -> Sequence[Field]:
        """Return its fields in the cycle record, without the slave's name; by default every mapped channel."""
        return [
            Field(
                identifier(channel.name) + ("_sent" if image is self.rpdo and channel.name in self.values else ""),
                "float64",
                channel.unit,
                f"{about} 0x{channel.index:04X}:{channel.sub_index:02X}",
            )
            for image, about in ((self.tpdo, "Input"), (self.rpdo, "Output"))
            for channel in {channel.name: channel for channel in image.channels if _is_number(channel)}.values()
        ]

    def publish(self, values: list[Any], at: int) -> None:
        """Write the values of `fields` into the record, from index `at` on."""
        for name in self._input_names:
            values[at] = self.values[name]
            at += 1
        for name in self._output_names:
            values[at] = self.targets[name]
            at += 1

    def encode(self) -> bytes:
        """Return the outputs of the cycle (`output_bytes` long)."""
        return self.codec_out.pack(*(self._counts_of(channel) for channel in self.rpdo.channels))

    def _counts_of(self, channel: Channel) -> Number:
        if not channel.index:
            return 0
        if channel.type == "bytes":
            return int.from_bytes(self.array_targets[channel.name][: channel.bits // 8], "little")
        value = self.targets[channel.name]
        if not isfinite(value):
            value = self.safe_values[channel.name]  # NaN must not end the cycle
        # The same bounds apply to a process as to a command.
        low, high = channel.limits
        counts = min(max((value - channel.offset) / channel.factor, low), high)
        return counts if channel.type in LARGEST else round(counts)


class Counter:
    """Continues the count of a counter that wraps to 0 after `modulo` counts, in either direction.

    Args:
        modulo: number of different counts; a step of more than half of it counts as a step in the other direction.
    """

    __slots__ = ("_last", "_modulo", "_total")

    def __init__(self, modulo: int) -> None:
        self._modulo = modulo
        self._last = -1
        self._total = 0

    def follow(self, counts: Number) -> int:
        """Return the unwrapped count, which begins with the first raw value; `counts`: raw value of this cycle."""
        here, modulo = int(counts) % self._modulo, self._modulo
        if self._last < 0:
            self._total = here
        else:
            step = (here - self._last) % modulo
            self._total += step - modulo if 2 * step > modulo else step
        self._last = here
        return self._total


def make_driver(slave: SlaveConfig, period_s: float) -> Driver:
    """Return the driver of a slave, of the class that is registered for the kind of its device.

    Raises:
        DeviceError: no installed package has a driver for this kind, or it cannot use the description.
        PluginError: the class registered for this kind is not a driver, or raises an exception.
    """
    kind = driver_of(slave.device.kind, slave.device.name)
    with made_by(registered(ENTRY_POINTS)[slave.device.kind]):
        driver = kind(slave, period_s=period_s)
        fields = driver.fields()
        if not all(isinstance(field, Field) for field in fields):
            raise TypeError(f"fields returned {fields!r:.80}, allowed are fields of the record")
    return driver


def driver_of(kind: str, device: str = "") -> type[Driver]:
    """Return the class that is registered for a kind of device; raises as `make_driver`."""
    drivers = registered(ENTRY_POINTS)
    if kind not in drivers:
        where = device or "a device"
        raise DeviceError(
            f"{where}: no driver is installed for kind {kind} (key `kind`); installed are {', '.join(drivers)}"
        )
    return load_class(drivers[kind], Driver)


@dataclass(frozen=True)
class Codec:
    """Packs and unpacks an image; values stand in the order of the channels, padding included."""

    unpack: Callable[[bytes], tuple[Any, ...]]
    pack: Callable[..., bytes]


def make_codec(layout: ImageLayout) -> Codec:
    """Return the codec of an image; little endian (ETG.1000.6, 5.6.5). Arrays of bytes are unsigned integers."""
    codes = [STRUCT_CODES.get(channel.type, "") for channel in layout.channels]
    if not all(codes):
        return _bit_codec(layout)
    whole = struct.Struct("<" + "".join(codes))
    return Codec(whole.unpack, whole.pack)


def _bit_codec(layout: ImageLayout) -> Codec:
    parts = tuple((channel.bit_offset, (1 << channel.bits) - 1, *_field(channel)) for channel in layout.channels)
    length = layout.bytes

    def unpack(data: bytes) -> tuple[Number, ...]:
        image = int.from_bytes(data, "little")
        return tuple(read(image >> offset & mask) for offset, mask, read, _ in parts)

    def pack(*values: Number) -> bytes:
        image = 0
        for value, (offset, _mask, _read, write) in zip(values, parts, strict=True):
            image |= write(value) << offset
        return image.to_bytes(length, "little")

    return Codec(unpack, pack)


def _field(channel: Channel) -> tuple[Callable[[int], Number], Callable[[Number], int]]:
    """Return the decoder and the encoder of a channel; the encoder raises for a value that does not fit."""
    if channel.type == "bool":
        return int, lambda value: int(bool(value))
    if channel.type.startswith("float"):
        single, width = struct.Struct("<" + STRUCT_CODES[channel.type]), channel.bits // 8
        return (
            lambda raw: single.unpack(raw.to_bytes(width, "little"))[0],
            lambda value: int.from_bytes(single.pack(value), "little"),
        )
    low, high = integer_range(channel)
    mask = (1 << channel.bits) - 1
    sign = -low

    def write(value: Number) -> int:
        if not low <= value <= high:
            raise struct.error(f"{channel.name}: {value} does not fit {channel.type}: {low} to {high}")
        return int(value) & mask

    return (lambda raw: raw - ((raw & sign) << 1)), write


def _is_number(channel: Channel) -> bool:
    return channel.index != 0 and channel.type != "bytes"


def _arrays(image: ImageLayout) -> dict[str, bytes]:
    return {entry.name: bytes(entry.bits // 8) for entry in image.channels if entry.index and entry.type == "bytes"}


def integer_range(channel: Channel) -> tuple[int, int]:
    """Return the smallest and the largest counts of a channel; raises DeviceError where it is of no integer type."""
    if channel.type.startswith(("uint", "bits", "bytes")):
        return 0, (1 << channel.bits) - 1
    if channel.type.startswith("int"):
        return -(1 << channel.bits - 1), (1 << channel.bits - 1) - 1
    raise DeviceError(f"channel {channel.name} is {channel.type}; it must be of an integer type")
