"""The shape setter's virtual slaves: outputs act on circuit and rod, the meter shows simultaneous pairs."""

from __future__ import annotations

import pytest

from rtcp.virtual.faults.fault import DeviceFault
from rtcp.virtual.faults.registry import parse
from rtcp.virtual.heater_circuit import CircuitFault
from rtcp.virtual.models.shape_setter import CELLS, READY, ShapeSetterBox, ShapeSetterMeter

DT = 0.0005
VOLTAGE, CURRENT = 15.0 / ((1 << 23) - 1), 1000.0 / ((1 << 23) - 1)


class Bench:
    """Both slaves, stepped in the order of the cable."""

    def __init__(self, **options: float) -> None:
        self.box, self.meter = ShapeSetterBox(**options), ShapeSetterMeter()
        for device in (self.box, self.meter):
            device.join([self.box, self.meter])
            device.set_outputs_valid(True)

    def run(self, seconds: float, *, gate: int = 0, relay: int = 0) -> None:
        self.box.objects[0x7000, 1].value, self.box.objects[0x7000, 2].value = gate, relay
        for _ in range(round(seconds / DT)):
            self.box.step(DT)
            self.meter.step(DT)

    def read(self, index: int, subindex: int, of: str = "box") -> float:
        return float(getattr(self, of).objects[index, subindex].value)

    @property
    def resistance(self) -> float:
        return self.read(0x6020, 1, "meter") * VOLTAGE / (self.read(0x6020, 2, "meter") * CURRENT)


def test_a_pulse_shows_the_resistance_of_the_rod_and_that_the_gate_was_on() -> None:
    bench = Bench()
    bench.run(0.05, relay=1)
    assert bench.read(0x6000, 7) == 1.0
    before = bench.read(0x6020, 3, "meter")
    bench.run(DT, gate=1, relay=1)
    assert bench.resistance == pytest.approx(bench.box.rod.resistance, rel=2e-3)
    assert bench.read(0x6020, 4, "meter") == 1.0
    assert bench.read(0x6020, 3, "meter") == before + 1
    bench.run(DT, relay=1)
    assert bench.read(0x6020, 4, "meter") == 0.0
    assert bench.read(0x2001, 0) == 1.0


def test_without_valid_outputs_gate_and_relay_are_off() -> None:
    bench = Bench()
    bench.run(0.05, gate=1, relay=1)
    hot = bench.box.rod.middle_temperature
    assert hot > 30.0
    bench.box.set_outputs_valid(False)
    bench.run(0.05, gate=1, relay=1)
    assert bench.box.circuit.current == 0.0
    assert bench.read(0x6000, 7) == 0.0
    assert bench.box.rod.middle_temperature < hot


def test_contacts_are_those_at_power_on_or_forced() -> None:
    bench = Bench()
    bench.run(DT)
    assert [bench.read(0x6000, n) for n in range(1, 7)] == [READY >> bit & 1 for bit in range(6)]
    bench.box.objects[0x2000, 1].value, bench.box.objects[0x2000, 2].value = 0x3F, 0x0E
    bench.run(DT)
    assert [bench.read(0x6000, n) for n in range(1, 7)] == [0, 1, 1, 1, 0, 0]


def test_channels_converted_in_turn_make_no_pair() -> None:
    bench = Bench(alternating=1)
    bench.run(0.1, gate=1, relay=1)
    assert bench.read(0x6020, 3, "meter") == 0.0


def test_a_bent_rod_that_was_hot_keeps_its_shape_and_another_one_is_straight() -> None:
    bench = Bench()
    for n in range(1, CELLS + 1):
        bench.box.objects[0x2011, n].value = 4.0
    entry = bench.box.objects[0x2013, 1]
    entry.on_write(entry, 1)
    bench.run(0.02, relay=1)
    bench.run(1.1, gate=1, relay=1)
    bench.run(0.2)
    middle = CELLS // 2
    assert bench.read(0x2020, middle) > 400.0
    assert bench.read(0x2021, middle) > 0.0
    assert bench.read(0x2023, middle) == pytest.approx(4.0 * bench.read(0x2021, middle), rel=0.05)
    entry.on_write(entry, 3)
    bench.run(0.1)
    assert bench.read(0x2020, middle) == pytest.approx(20.0)
    assert bench.read(0x2021, middle) == 0.0


def test_a_fault_of_the_circuit_shows_at_the_box() -> None:
    bench = Bench()
    bench.run(DT)
    assert bench.read(0x6010, 1) > 4000.0
    bench.box.circuit.inject(CircuitFault.INSULATION_BROKEN)
    bench.box.circuit.inject(CircuitFault.FUSE_BLOWN)
    bench.run(DT)
    assert bench.read(0x6010, 1) < 100.0
    assert bench.read(0x6000, 8) == 0.0


@pytest.mark.parametrize(
    ("given", "index", "subindex", "shown"),
    [
        ({"fault": "circuit", "slave": 1, "what": "fuse_blown"}, 0x6000, 8, (1.0, 0.0)),
        ({"fault": "contacts", "slave": 1, "closed": 0x0C}, 0x6000, 3, (0.0, 1.0)),
    ],
)
def test_a_fault_on_command_ends(
    given: dict[str, object], index: int, subindex: int, shown: tuple[float, float]
) -> None:
    bench = Bench()
    planned, findings = parse(given)
    assert planned is not None, findings
    assert isinstance(planned.fault, DeviceFault)
    bench.run(DT)
    assert bench.read(index, subindex) == shown[0]
    end = planned.fault.begin([bench.box, bench.meter])
    bench.run(DT)
    assert bench.read(index, subindex) == shown[1]
    end(0)
    bench.run(DT)
    assert bench.read(index, subindex) == shown[0]
