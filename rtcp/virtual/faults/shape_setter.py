"""Faults of the shape setter's control box, and its manual contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Ge, Le

from rtcp.virtual.device import DeviceModel
from rtcp.virtual.faults.fault import DeviceFault, End, FaultRefused, Position, place_of
from rtcp.virtual.heater_circuit import CircuitFault

if TYPE_CHECKING:
    from rtcp.virtual.models.shape_setter import ShapeSetterBox

What = Literal[
    "contact_loose", "power_wire_broken", "sense_wire_broken", "gate_stuck_on", "gate_stuck_off", "relay_welded",
    "battery_weak", "voltage_offset", "current_offset", "rod_shorted", "insulation_broken", "fuse_blown",
]  # fmt: skip


def _box_at(devices: Sequence[DeviceModel], number: int) -> ShapeSetterBox:
    # Imported late: it loads numpy, and every segment loads the faults.
    from rtcp.virtual.models.shape_setter import ShapeSetterBox

    device = devices[place_of(devices, number)]
    if not isinstance(device, ShapeSetterBox):
        raise FaultRefused(f"slave {number} ({device.identity.name}) is no shape setter's box")
    return device


@dataclass(frozen=True)
class CircuitOfHeater(DeviceFault):
    """A part of the heater's circuit is defective; a blown fuse is replaced at the end."""

    name = "circuit"
    slave: Position
    what: What

    def begin(self, devices: Sequence[DeviceModel]) -> End:
        """Inject the fault."""
        circuit, fault = _box_at(devices, self.slave).circuit, CircuitFault[self.what.upper()]
        circuit.inject(fault)
        return lambda _: circuit.clear(fault)


@dataclass(frozen=True)
class Contacts(DeviceFault):
    """Closed contacts of the heater's box: bit 0 key in Auto, 1 in Manual, 2 and 3 button, 4 and 5 robot's circuit."""

    name = "contacts"
    slave: Position
    closed: Annotated[int, Ge(0), Le(0x3F)]

    def begin(self, devices: Sequence[DeviceModel]) -> End:
        """Set the contacts; restore them at the end."""
        box = _box_at(devices, self.slave)
        before, box.contacts = box.contacts, self.closed

        def back(_: int) -> None:
            box.contacts = before

        return back
