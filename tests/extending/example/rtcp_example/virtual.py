"""The terminal's virtual model, and a fault that it can have. Nothing here imports the driver."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.virtual.device import DeviceModel, Option
from rtcp.virtual.faults.fault import DeviceFault, FaultRefused, Position
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary
from rtcp.virtual.pdo import define_pdo_objects


class ThermometerModel(DeviceModel):
    """Two channels of 0.1 K; `heating` warms the second."""

    vendor_id, product_code = 0x00000E2A, 0x00000002
    name, group, order_code = "Example thermometer", "Analog inputs", "EX-2T"
    uses_sync0 = False
    options = {"heating": Option(0.0, -100.0, 100.0, "K/s")}

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        self.kelvin, self.breaks = [300.0, 300.0], 0
        self._channels = [self.objects[0x6000, channel] for channel in (1, 2)]

    def define(self, objects: ObjectDictionary) -> None:
        access = Access.RO | Access.TXPDO
        channels = [Entry(0x6000, n, f"Channel {n}", DataType.INTEGER16, 0, access) for n in (1, 2)]
        objects.record(0x6000, "Temperatures", channels)
        define_pdo_objects(objects, {}, {0x1A00: ((0x6000, 1, 16), (0x6000, 2, 16))}, [], [0x1A00], fixed=True)

    def step(self, dt: float) -> None:
        self.kelvin[1] += self.option("heating") * dt
        for channel, kelvin in zip(self._channels, self.kelvin, strict=True):
            channel.value = 0x7FFF if self.breaks else round(kelvin * 10.0)


@dataclass(frozen=True)
class WireBreak(DeviceFault):
    """The sensors of a thermometer are cut off."""

    name = "wire_break"
    slave: Position

    def begin(self, devices: Sequence[Any]) -> Callable[[int], None]:
        model = devices[self.slave - 1] if self.slave <= len(devices) else None
        if not isinstance(model, ThermometerModel):
            raise FaultRefused(f"slave {self.slave} is no thermometer")

        def join(_: int) -> None:
            model.breaks -= 1

        model.breaks += 1
        return join
