"""The shape setter's two slaves: its control box, with circuit and rod, and the meter of u and i.

Both are this project's own designs. The box is before the meter on the cable, so that a sample belongs to the gate of
the previous frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from rtcp.virtual.device import DeviceModel, FreezableInputs, Option
from rtcp.virtual.heated_rod import Alloy, HeatedRod
from rtcp.virtual.heater_circuit import Circuit, Sampling, SensePoint
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary, Value
from rtcp.virtual.pdo import define_pdo_objects

CELLS = 48
INPUTS = (
    "Key in Auto", "Key in Manual", "Button, channel A", "Button, channel B", "Robot circuit, channel A",
    "Robot circuit, channel B",
)  # fmt: skip
"""Contacts closed by people and by the robot's controller, from bit 0."""
READY = 0x31
"""Key in Auto, both channels of the robot's circuit closed."""
_BOOL, _U8, _U16, _U32, _I16, _I32 = (
    DataType.BOOLEAN, DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32, DataType.INTEGER16,
    DataType.INTEGER32,
)  # fmt: skip
_SHOWN_S = 0.05
"""Update interval of the rod's objects, s."""
_PROFILES = {
    0x2020: "Temperature, C",
    0x2021: "Share of the bend that is set",
    0x2022: "Twist rate of the set shape, 1/m",
    0x2023: "First curvature of the set shape, 1/m",
    0x2024: "Second curvature of the set shape, 1/m",
    0x2025: "Middle of the cell, m from the first chuck",
    0x2026: "Highest temperature, C",
}
_BEND = {0x2010: "Twist rate, 1/m", 0x2011: "First curvature, 1/m", 0x2012: "Second curvature, 1/m"}


class ShapeSetterBox(DeviceModel, FreezableInputs):
    """Gate, relay and lamps; key, button, robot's circuit, relay feedback, fuse, insulation and battery.

    The master can force contacts through 0x2000 (mask, levels), bend the rod through 0x2010 to 0x2012 (one entry per
    cell) and 0x2013 (1: bend, 2: release, 3: new cold rod of the same kind), and read the rod from 0x2020.
    """

    vendor_id = 0x00000A55
    product_code = 0x00000010
    device_type = 0x00030191
    name = "Shape setter control box"
    group = "Digital IO"
    order_code = "RTCP-SSB"
    options = MappingProxyType({
        "inputs": Option(READY, 0, 0x3F, "contacts closed at power-on, bit 0 is the key in Auto", whole=True),
        "diameter": Option(1e-3, 0.5e-3, 3.2e-3, "diameter of the rod, m"),
        "length": Option(0.3, 0.1, 0.5, "length of the rod between the chucks, m"),
        "af": Option(-12.0, -50.0, 80.0, "temperature above which all is austenite, C"),
        "coefficient": Option(2e-4, 5e-5, 5e-4, "d rho/dT of austenite over rho at 20 C, 1/K"),
        "emissivity": Option(0.5, 0.1, 1.0, "of the rod"),
        "ambient": Option(20.0, 0.0, 40.0, "temperature of air and chucks, C"),
        "contact": Option(0.5e-3, 0.0, 0.1, "resistance of each chuck's contact, ohm"),
        "four_wire": Option(1, 0, 1, "1: the voltage is tapped at the rod, 0: at the cable lugs", whole=True),
        "alternating": Option(0, 0, 1, "1: u and i are converted in turn", whole=True),
    })  # fmt: skip
    uses_sync0 = False

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        objects = self.objects
        self._contacts = int(self.option("inputs"))
        self._outputs = [objects[0x7000, n] for n in range(1, 5)]
        self._inputs = [objects[0x6000, n] for n in range(1, 9)]
        self._chassis, self._battery = objects[0x6010, 1], objects[0x6010, 2]
        self._alive = objects[0x6010, 3]
        self._mask, self._levels = objects[0x2000, 1], objects[0x2000, 2]
        self._red = objects[0x2001, 0]
        self._shown_s = 0.0
        self.gate_was_on = False
        """True: the MOSFET conducted during the whole last step."""
        self.circuit = Circuit(
            sense_point=SensePoint.ROD if self.option("four_wire") else SensePoint.LUG,
            sampling=Sampling.ALTERNATING if self.option("alternating") else Sampling.SIMULTANEOUS,
            seed=int(self.option("serial", 1)),
        )
        self._fit_rod()

    def _fit_rod(self) -> None:
        finish, coefficient = self.option("af"), self.option("coefficient")
        alloy = Alloy(
            coefficient_austenite=coefficient, austenite_finish=finish, austenite_start=finish - 15.0,
            martensite_start=finish - 37.0, martensite_finish=finish - 52.0, emissivity=self.option("emissivity"),
        )  # fmt: skip
        self.rod = HeatedRod(
            alloy, diameter=self.option("diameter"), length=self.option("length"), ambient=self.option("ambient"),
            cells=CELLS,
        )  # fmt: skip

    def define(self, objects: ObjectDictionary) -> None:
        """Add inputs and outputs with their fixed PDOs, and the objects for tests."""
        tx, rx, rw = Access.RO | Access.TXPDO, Access.RW | Access.RXPDO, Access.RW
        inputs = (*INPUTS, "Relay closed", "Fuse intact")
        objects.record(0x6000, "Inputs", [Entry(0x6000, n, text, _BOOL, 0, tx) for n, text in enumerate(inputs, 1)])
        objects.record(0x6010, "Supervision", [
            Entry(0x6010, 1, "Insulation monitor, chuck to frame, mV", _I16, 0, tx),
            Entry(0x6010, 2, "Battery, mV", _U16, 0, tx),
            Entry(0x6010, 3, "Cycles counted", _U16, 0, tx),
        ])  # fmt: skip
        outputs = ("Gate", "Relay", "Green lamp", "Yellow lamp")
        objects.record(0x7000, "Outputs", [Entry(0x7000, n, text, _BOOL, 0, rx) for n, text in enumerate(outputs, 1)])
        objects.record(0x2000, "Forced contacts", [
            Entry(0x2000, 1, "Mask of the forced contacts", _U8, 0, rw),
            Entry(0x2000, 2, "Levels of the forced contacts", _U8, 0, rw),
        ])  # fmt: skip
        objects.variable(0x2001, "Red lamp, wired to the relay", _U8)
        for index, text in _BEND.items():
            cells = [Entry(index, n, f"Cell {n}", DataType.REAL32, 0.0, rw) for n in range(1, CELLS + 1)]
            objects.record(index, text, cells)
        # The object exists before the rod: look up the hook at the write.
        act = Entry(0x2013, 1, "1 bend, 2 release, 3 another rod", _U8, 0, rw, on_write=self._act)
        objects.record(0x2013, "Rod", [act])
        for index, text in _PROFILES.items():
            cells = [Entry(index, n, f"Cell {n}", DataType.REAL32, 0.0, Access.RO) for n in range(1, CELLS + 1)]
            objects.record(index, text, cells)
        gaps = ((0, 0, 1),) * 4
        rx_pdo = {0x1600: (*((0x7000, n, 1) for n in range(1, 5)), *gaps)}
        inputs_mapped = tuple((0x6000, n, 1) for n in range(1, 9))
        tx_pdo = {0x1A00: (*inputs_mapped, (0x6010, 1, 16), (0x6010, 2, 16), (0x6010, 3, 16))}
        define_pdo_objects(objects, rx_pdo, tx_pdo, [0x1600], [0x1A00], fixed=True)

    def _act(self, _: Entry, value: Value) -> None:
        if value == 1:
            shape = [[float(self.objects[index, n].value) for index in _BEND] for n in range(1, CELLS + 1)]
            self.rod.bend(np.array(shape))
        elif value == 2:
            self.rod.release()
        elif value == 3:
            self._fit_rod()

    @property
    def contacts(self) -> int:
        """Closed contacts before forcing; bit 0 is the key in Auto."""
        return self._contacts

    @contacts.setter
    def contacts(self, levels: int) -> None:
        self._contacts = levels

    @property
    def gate(self) -> bool:
        """Whether the gate is on in the last valid outputs."""
        return bool(self.outputs_valid and self._outputs[0].value)

    @property
    def relay(self) -> bool:
        """Whether the relay is switched on."""
        return bool(self.outputs_valid and self._outputs[1].value)

    @property
    def lamp_green(self) -> bool:
        """Whether the green lamp is on."""
        return bool(self.outputs_valid and self._outputs[2].value)

    def truth(self) -> dict[str, Any]:
        """Return outputs, main contact, current (A) and temperature (C)."""
        circuit = self.circuit
        return {
            "gate": self.gate,
            "relay": self.relay,
            "relay_closed": circuit.relay_closed,
            "current": circuit.current,
            "middle_temperature": self.rod.middle_temperature,
        }

    def step(self, dt: float) -> None:
        """Advance circuit and rod by `dt` seconds; read the contacts."""
        circuit, rod, gate = self.circuit, self.rod, self.gate
        current = circuit.step(dt, gate, self.relay, rod.resistance)
        rod.step(dt, current)
        self.gate_was_on = gate or circuit.current > 0.0
        self._red.value = int(circuit.relay_closed)
        self._shown_s += dt
        if self._shown_s >= _SHOWN_S:
            self._shown_s = 0.0
            self._show()
        if self.freezes:
            return
        mask = self._mask.value
        levels = self._contacts & ~mask | self._levels.value & mask
        levels |= circuit.relay_closed << 6 | circuit.fuse_intact << 7
        for bit, entry in enumerate(self._inputs):
            entry.value = levels >> bit & 1
        self._chassis.value = round(1e3 * circuit.chuck_to_frame_voltage)
        self._battery.value = max(0, round(1e3 * circuit.battery_voltage))
        self._alive.value = self._alive.value + 1 & 0xFFFF

    def _show(self) -> None:
        rod = self.rod
        columns = (rod.temperature, rod.set_fraction, *rod.set_shape.T, rod.positions, rod.highest_temperature)
        for index, column in zip(_PROFILES, columns, strict=True):
            for n, value in enumerate(column.tolist(), 1):
                self.objects[index, n].value = value


class ShapeSetterMeter(DeviceModel, FreezableInputs):
    """u at the rod and i of the shunt, 24 bit each, with the sample number and the state of the gate.

    With the option `samples` a PDO of u and i is assigned as often, for that many conversions a cycle (oversampling).
    """

    vendor_id = 0x00000A55
    product_code = 0x00000011
    device_type = 0x00020191
    name = "Shape setter meter"
    group = "Analog inputs"
    order_code = "RTCP-SSM"
    options = MappingProxyType({"samples": Option(1, 1, 50, "conversions of u and i a cycle", whole=True)})
    uses_sync0 = False

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        self._box: ShapeSetterBox | None = None
        self._voltage, self._current = (self.objects[0x6020, n] for n in (1, 2))
        self._sample, self._sense = (self.objects[0x6020, n] for n in (3, 4))

    def define(self, objects: ObjectDictionary) -> None:
        """Add the channels with their fixed PDO."""
        tx = Access.RO | Access.TXPDO
        objects.record(0x6020, "Measured", [
            Entry(0x6020, 1, "Voltage, counts of 15 V / (2^23 - 1)", _I32, 0, tx),
            Entry(0x6020, 2, "Current, counts of 1000 A / (2^23 - 1)", _I32, 0, tx),
            Entry(0x6020, 3, "Pairs of u and i of one instant", _U16, 0, tx),
            Entry(0x6020, 4, "Gate on during the whole conversion", _U8, 0, tx),
        ])  # fmt: skip
        measured, about = ((0x6020, 1, 32), (0x6020, 2, 32)), ((0x6020, 3, 16), (0x6020, 4, 8))
        samples = int(self.option("samples"))
        if samples == 1:
            define_pdo_objects(objects, {}, {0x1A00: (*measured, *about)}, [], [0x1A00], fixed=True)
        else:
            pdos = {0x1A00: about, 0x1A01: measured}
            define_pdo_objects(objects, {}, pdos, [], [0x1A00, *[0x1A01] * samples], fixed=True)

    def join(self, devices: Sequence[DeviceModel]) -> None:
        """Find the box with the measured circuit: the first one of the segment."""
        self._box = next((device for device in devices if isinstance(device, ShapeSetterBox)), None)

    def step(self, dt: float) -> None:
        """Write the samples of the circuit's converter."""
        box = self._box
        if box is None or self.freezes:
            return
        circuit = box.circuit
        self._voltage.value, self._current.value = circuit.voltage_count, circuit.current_count
        if (samples := int(self.option("samples"))) > 1:
            counts = [(circuit.voltage_count, circuit.current_count), *(circuit.resample() for _ in range(samples - 1))]
            self._voltage.samples, self._current.samples = zip(*counts, strict=True)
        paired = circuit.voltage_step == circuit.current_step
        self._sample.value = self._sample.value + paired & 0xFFFF
        self._sense.value = int(box.gate_was_on)
